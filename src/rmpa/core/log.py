"""The formats of log records: one line of text, or one JSON object a line; and failures that are only logged."""

from __future__ import annotations

import codecs
import json
import logging
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

    from _typeshed import SupportsWrite

# Looked up at import: without a free file descriptor the codec's file could not be opened to log the shortage.
_ESCAPE: Final = codecs.getencoder("unicode_escape")


def room_of(logger: str) -> str:
    """The room that a logger belongs to: ``rmpa.mesh.io.mesh`` gives ``mesh``."""
    parts = logger.split(".")
    return parts[1] if parts[0] == "rmpa" and len(parts) > 1 else parts[0]


@contextmanager
def logged_failure(log: logging.Logger, text: str, *args: object) -> Iterator[None]:
    """Log an exception of the block, and go on behind it.

    For one of several that are called in turn: the failure of one must not keep the others from being called.

    Args:
        log: The caller's logger.
        text: What failed, as a format of ``logging``.
        args: For ``text``.
    """
    try:
        yield
    except Exception:
        log.exception("! " + text, *args)  # noqa: G003 - the mark in front of the caller's own format


def _one_line(text: str) -> str:
    """The text with control characters escaped: a peer's text must not forge lines or move the terminal's cursor."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\t" else _ESCAPE(c)[0].decode("ascii") for c in text)


class TextFormatter(logging.Formatter):
    """``12:00:01.250 warning mesh       ! text``; local time, a traceback on the following lines."""

    def format(self, record: logging.LogRecord) -> str:
        """One record."""
        when = datetime.fromtimestamp(record.created).astimezone()
        clock = f"{when:%H:%M:%S}.{int(record.msecs):03d}"
        line = f"{clock} {record.levelname.lower():<7} {room_of(record.name):<9} {_one_line(record.getMessage())}"
        if record.exc_info:
            line += "\n" + self.formatException(record.exc_info)
        return line


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time (ISO 8601, UTC), level, room, logger, text, and traceback if there is one."""

    def format(self, record: logging.LogRecord) -> str:
        """One record."""
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "room": room_of(record.name),
            "logger": record.name,
            "text": record.getMessage(),
        }
        if record.exc_info:
            fields["traceback"] = self.formatException(record.exc_info)
        return json.dumps(fields, ensure_ascii=False)


def configure_logging(level: str, stream: SupportsWrite[str], *, as_json: bool) -> None:
    """Send every record of ``level`` and above to ``stream``, replacing the earlier configuration.

    Args:
        level: As in ``Settings.log_level``.
        stream: Usually stderr, for an agent through ``runtime.log_writer``; stdout is for a command's result.
        as_json: JSON lines instead of text.
    """
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonFormatter() if as_json else TextFormatter())
    root = logging.getLogger()
    for old in root.handlers[:]:
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level.upper())
    # A lost log line (the reader of a pipe is gone) must not print a traceback for every further line.
    logging.raiseExceptions = False
