"""The log: one line of text or one JSON object a record, repeated refusals once, failures that are only logged."""

from __future__ import annotations

import codecs
import json
import logging
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from rmpa.core import codes, limits
from rmpa.core.errors import with_places

if TYPE_CHECKING:
    from collections.abc import Iterator

    from _typeshed import SupportsWrite

    from rmpa.core.statistics import Counters

# A refusal of one kind from one address is logged at most once in this time; the rest are counted.
LOG_INTERVAL: Final = 5.0
# Looked up at import: without a free file descriptor the codec's file could not be opened to log the shortage.
_ESCAPE: Final = codecs.getencoder("unicode_escape")


class RefusalLog:
    """Counts each refusal, and logs each kind (name and address) at most once in ``LOG_INTERVAL`` seconds.

    At most ``limits.LOG_LINES_MAX`` lines of one name are written in that time, over all addresses.

    Args:
        logger: Gets the lines, at WARNING.
        counters: Counts every refusal, logged or not.
    """

    __slots__ = ("_counters", "_last", "_lines", "_logger")

    def __init__(self, logger: logging.Logger, counters: Counters) -> None:
        self._logger = logger
        self._counters = counters
        # By kind: when it was logged last, and how many are suppressed since then; the oldest line first.
        self._last: dict[tuple[str, str], tuple[float, int]] = {}
        # By name: the start of the interval, the lines written in it, and the lines suppressed in it.
        self._lines: dict[str, tuple[float, int, int]] = {}

    def count(self, name: str) -> None:
        """Count ``name`` without a line in the log."""
        self._counters.add(name)

    def refuse(self, now: float, name: str, who: str, text: str) -> None:
        """Count ``name``, and log ``text`` within the limits.

        Args:
            now: Monotonic seconds.
            name: The counter's name; with ``who`` it makes the kind.
            who: The source address of the refused item, without the port (a port scanner has many).
            text: What happened and what to do, for the user.
        """
        self._counters.add(name)
        kind = name, who
        last, suppressed = self._last.get(kind, (float("-inf"), 0))
        if now - last < LOG_INTERVAL:
            self._last[kind] = (last, suppressed + 1)
            return
        since, lines, hidden = self._lines.get(name, (now, 0, 0))
        if now - since >= LOG_INTERVAL:
            since, lines = now, 0
        if lines >= limits.LOG_LINES_MAX:
            self._lines[name] = (since, lines, hidden + 1)
            return
        self._lines[name] = (since, lines + 1, 0)
        self._last.pop(kind, None)
        self._last[kind] = (now, 0)
        if len(self._last) > limits.LOG_KINDS_MAX:
            del self._last[next(iter(self._last))]
        more = f" ({suppressed + hidden} more like this since the last line)" if suppressed + hidden else ""
        self._logger.warning("! %s%s [%s]", text, more, codes.of_counter(name))


def _room_of(logger: str) -> str:
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


# By the level's number, the greatest that fits: the priority of a line in a journal (sd-daemon(3)).
_PRIORITIES: Final = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6, logging.NOTSET: 7}


class _Formatter(logging.Formatter):
    """One record as text, or as one JSON object a line; ``configure_logging`` says which."""

    as_json = False
    in_journal = False

    def format(self, record: logging.LogRecord) -> str:
        """``12:00:01.250 warning mesh       ! text``; local time, a traceback on the following lines.

        In a journal, which has the time itself: ``<4>warning mesh       ! text``, each line with its priority.
        In JSON: time (ISO 8601, UTC), level, room, logger, text, and code and traceback if there is one.
        A line with a traceback and without a code tells of a fault in RMPA.
        """
        level, room = record.levelname.lower(), _room_of(record.name)
        trace = self.formatException(record.exc_info) if record.exc_info else ""
        text = with_places(record.getMessage())
        if not (code := codes.of_line(text)) and trace and record.levelno >= logging.WARNING:
            code = "internal-error"
            text += f" [{code}]"
        if not self.as_json:
            line = f"{level:<7} {room:<9} {_one_line(text)}"
            lines = f"{line}\n{trace}" if trace else line
            if self.in_journal:
                priority = next(word for number, word in _PRIORITIES.items() if number <= record.levelno)
                return "\n".join(f"<{priority}>{each}" for each in lines.split("\n"))
            clock = f"{datetime.fromtimestamp(record.created).astimezone():%H:%M:%S}.{int(record.msecs):03d}"
            return f"{clock} {lines}"
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": level,
            "room": room,
            "logger": record.name,
            "text": text,
        } | ({"code": code} if code else {})
        return json.dumps(fields | {"traceback": trace} if trace else fields, ensure_ascii=False)


def configure_logging(level: str, stream: SupportsWrite[str], *, as_json: bool, in_journal: bool = False) -> None:
    """Send every record of ``level`` and above to ``stream``, replacing the earlier configuration.

    Args:
        level: As in ``Settings.log_level``.
        stream: Usually stderr, for an agent through ``runtime.process``; stdout is for a command's result.
        as_json: JSON lines instead of text.
        in_journal: Whether ``stream`` leads to systemd's journal: text then has priorities, and no time of its own.
    """
    handler = logging.StreamHandler(stream)
    formatter = _Formatter()
    formatter.as_json, formatter.in_journal = as_json, in_journal
    handler.setFormatter(formatter)
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    # A lost log line (the reader of a pipe is gone) must not print a traceback for every further line.
    logging.raiseExceptions = False
