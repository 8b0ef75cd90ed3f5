"""What verbs print: one value as JSON, or as lines and tables; numbers with units; messages as rostopic has them.

Colours are click's: it drops them where standard output is no terminal, and everywhere with ``NO_COLOR``.
"""

from __future__ import annotations

import math
import os
import re
import sys
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Final, TextIO, TypeAlias
from unicodedata import combining, east_asian_width

import click
import msgspec

from rmpa.core.errors import ConfigError, RmpaError, with_places

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from logging import Logger

    from rmpa.config.settings import Settings
    from rmpa.ros.types.messages import Plain
    from rmpa.runtime.systemd import LogWriter

_INDENT: Final = "    "
# Of the levels of ``rmpa doctor`` and ``rmpa why``, on a terminal; of all others yellow.
_COLOURS: Final = {"ok": "green", "fail": "red", "skipped": "cyan"}

# A field of a message, with its indices: ``covariance[0]``.
_PART: Final = re.compile(r"(?P<name>\w+)(?P<indices>(?:\[[0-9]+\])*)", re.ASCII)
_TIME: Final = {"secs", "nsecs"}
# In place of what no other person is to see.
GONE: Final = "[redacted]"
# All up to the last @ of a word, as passwords may have any character; units of systemd have one too.
USER_INFO: Final = re.compile(
    r"(?<!\S)((?:[\w.-]+=)?[\"'(<\[]{0,4}(?:[a-zA-Z][\w+.-]*://|(?:tcp|udp|tls|quic|wss?)/)?)"
    r"\S+@(?![\w.-]*\.(?:service|socket|target)\b)"
)


class Painted(str):
    """A line that is escaped and coloured already."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Table:
    """A table under its headings.

    No cell is cut. Where a table is wider than the terminal, each row is a paragraph: the first cell, then the others
    behind their headings.

    Args:
        titles: From left to right, ``NAME, STATE, >COUNT``: cells below a ``>`` are aligned to the right.
        rows: One text a column.
        colours: One name of a colour a row, for the second column on terminals; empty for none.
    """

    titles: str
    rows: Iterable[Sequence[str]]
    colours: Sequence[str | None] = ()


# Lines and tables; control characters in lines and cells are escaped when they are printed.
Text: TypeAlias = "str | Table | Iterable[Text]"


def begin_log(settings: Settings, notes: Iterable[str], log: Logger, to: TextIO | LogWriter) -> bool:
    """Log as the settings say, first the notes on them; return whether the journal of systemd takes the lines."""
    from rmpa.core.log import configure_logging
    from rmpa.runtime.systemd import in_journal

    journal = in_journal(os.environ, sys.stderr.fileno())
    configure_logging(settings.log_level, to, as_json=settings.log_json, in_journal=journal)
    for note in notes:
        log.warning("! %s [doubtful-setting]", note)
    return journal


def print_text(*text: Text) -> None:
    """Print lines and tables, each at once."""
    for item in text:
        if isinstance(item, str):
            click.echo(with_places(item if isinstance(item, Painted) else printable(item)))
        elif isinstance(item, Table):
            import shutil

            width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
            click.echo("\n".join(_table_lines(item, width)))
        else:
            for each in item:
                print_text(each)


def json_text(value: object) -> str:
    """A value as JSON; msgspec structs are objects, NaN and infinity are null."""
    return msgspec.json.encode(value).decode()


def print_json(value: object) -> None:
    """One JSON document on one line of standard output, at once."""
    click.echo(json_text(value))


def _table_lines(table: Table, width: int | None) -> Iterator[str]:
    titles = table.titles.split(", ")
    rows = [[printable(cell) for cell in row] for row in table.rows]
    right, titles = [title.startswith(">") for title in titles], [title.removeprefix(">") for title in titles]
    wide = [max(map(_columns, cells)) for cells in zip(titles, *rows, strict=True)]
    if width is not None and sum(wide) + 2 * (len(wide) - 1) > width:
        for row, colour in zip_longest(rows, table.colours):
            yield click.style(row[0], bold=True)
            yield from _paragraph(titles[1:], row[1:], colour, width)
        return
    for number, (row, colour) in enumerate(zip_longest([titles, *rows], [None, *table.colours])):
        padding = [" " * (most - _columns(cell)) for most, cell in zip(wide, row, strict=True)]
        cells = [*row[:1], *(click.style(cell, fg=colour) if colour else cell for cell in row[1:2]), *row[2:]]
        line = "  ".join(p + c if r else c + p for p, c, r in zip(padding, cells, right, strict=True)).rstrip()
        yield click.style(line, bold=True) if width is not None and not number else line


def _paragraph(titles: Sequence[str], cells: Sequence[str], colour: str | None, width: int) -> Iterator[str]:
    """The cells of a row behind the first one, each behind its heading, as many on a line as fit."""
    line = painted = ""
    for number, (title, cell) in enumerate(zip(titles, cells, strict=True)):
        if cell in ("", "-"):
            continue
        fact = f"{title.strip().lower()}: {cell}"
        if line and len(_INDENT) + _columns(line) + 2 + _columns(fact) > width:
            yield _INDENT + painted
            line = painted = ""
        between = ", " if line else ""
        line += between + fact
        painted += between + (click.style(fact, fg=colour) if colour and not number else fact)
    yield _INDENT + painted


def _columns(text: str) -> int:
    """The columns of a terminal that a text takes."""
    if text.isascii():
        return len(text)
    return sum((not combining(c)) + (east_asian_width(c) in "FW") for c in text)


def paint(text: str, colour: str | None) -> Painted:
    """A text in a colour; its control characters are escaped."""
    return Painted(click.style(printable(text), fg=colour) if colour else printable(text))


def paint_level(text: str, level: str) -> Painted:
    """A text in the colour of a result."""
    return paint(text, _COLOURS.get(level, "yellow"))


def warn(text: str, code: str = "") -> None:
    """One line on stderr with a code of ``core.codes``, yellow on a terminal; control characters are escaped."""
    click.secho(f"! {with_places(printable(text))}" + (f" [{code}]" if code else ""), err=True, fg="yellow")


def print_error(error: object, code: str) -> None:
    """``rmpa: … [code]`` on stderr. It may hold the words of a peer or a node: control characters are escaped."""
    first, *more = f"rmpa: {error}".split("\n")
    click.echo(with_places("\n".join(map(printable, (f"{first} [{code}]", *more)))), err=True)


def confirm(question: str) -> bool:
    """Ask the user on the terminal, on standard error, also where standard input is used up; no answer is a no.

    Raises:
        ConfigError: There is nothing to read an answer from.
    """
    from pathlib import Path

    click.echo(f"{question} [y/N] ", err=True, nl=False)
    line = sys.stdin.readline()
    if not line:
        try:
            with Path("/dev/tty").open(encoding="utf-8") as terminal:
                line = terminal.readline()
        except OSError:
            click.echo(err=True)
            raise ConfigError(
                "the question", "has no answer: there is no terminal", "add --yes", code="not-confirmed"
            ) from None
    return line.strip().lower() in {"y", "yes"}


def printable(text: str) -> str:
    """Text from the network without characters that move a terminal's cursor: each is escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def duration(seconds: float | None) -> str:
    """A time: ``432 µs``, ``12.3 ms``, ``4.2 s``, ``3 min 20 s``, ``2 h 5 min``, ``3 d 4 h``; ``-`` for none."""
    if seconds is None or math.isnan(seconds):
        return "-"
    length = abs(seconds)
    if length < 0.9995e-3:
        return f"{seconds * 1e6:.0f} µs"
    if length < 1:
        return f"{seconds * 1e3:.{2 if length < 0.09995 else 0}f} ms"
    if length < 59.95:
        return f"{seconds:.1f} s"
    whole = round(length)
    sign = "-" if seconds < 0 else ""  # a clock may be behind by hours; floor division would round away from zero
    if whole < 3600:
        return f"{sign}{whole // 60} min {whole % 60} s"
    if whole < 86400:
        return f"{sign}{whole // 3600} h {whole % 3600 // 60} min"
    return f"{sign}{whole // 86400} d {whole % 86400 // 3600} h"


def size(count: float | None) -> str:
    """A number of bytes: ``17 B``, ``1.23 kB``, ``45.6 MB`` (powers of 1000); ``-`` for none."""
    if count is None or math.isnan(count):
        return "-"
    if abs(count) < 999.5:
        return f"{count:.0f} B"
    power = 1
    while abs(count := count / 1000) >= 999.5 and power < 4:
        power += 1
    digits = 2 if abs(count) < 9.995 else 1 if abs(count) < 99.95 else 0
    return f"{count:.{digits}f} {'kMGT'[power - 1]}B"


def without_passwords(text: str) -> str:
    """A text whose addresses have no user names and passwords."""
    return USER_INFO.sub(rf"\1{GONE}@", text)


def pick(plain: Plain, path: list[str]) -> Plain:
    """Return one field of a message.

    Args:
        plain: The message.
        path: Names from the outside in, each perhaps with indices: ``["pose", "covariance[0]"]``.

    Raises:
        RmpaError: There is no such field or element.
    """
    for part in path:
        match = _PART.fullmatch(part)
        if match is None:
            raise RmpaError(f"{part!r} is not a field; one looks like name or name[0]", code="invalid-value")
        if not isinstance(plain, dict) or match["name"] not in plain:
            known = ", ".join(plain) if isinstance(plain, dict) else "none"
            raise RmpaError(f"no field {match['name']!r} in the message; it has {known}", code="invalid-value")
        plain = plain[match["name"]]
        for index in re.findall(r"[0-9]+", match["indices"]):
            if not isinstance(plain, list) or int(index) >= len(plain):
                raise RmpaError(f"no element {index} in {match['name']!r}", code="invalid-value")
            plain = plain[int(index)]
    return plain


def shorten(plain: Plain, *, arrays: bool, strings: bool) -> Plain:
    """A copy of a message in which a note of the length replaces each array, and each string, if wanted."""
    if isinstance(plain, dict):
        return {name: shorten(value, arrays=arrays, strings=strings) for name, value in plain.items()}
    if isinstance(plain, list):
        if arrays:
            return _Note(f"<array length: {len(plain)}>")
        return [shorten(value, arrays=arrays, strings=strings) for value in plain]
    return _Note(f"<string length: {len(plain)}>") if isinstance(plain, str) and strings else plain


class _Note(str):
    """A text in place of a value, printed without quotes."""

    __slots__ = ()


def to_text(plain: Plain, indent: str = "") -> str:
    """A message in the format of ``rostopic echo``, with control characters escaped."""
    if isinstance(plain, dict):
        return "\n".join(_field(name, value, indent) for name, value in plain.items())
    return indent + _scalar(plain)


def _field(name: str, value: Plain, indent: str) -> str:
    if isinstance(value, dict):
        return f"{indent}{name}:" + ("\n" + to_text(value, indent + "  ") if value else " {}")
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return f"{indent}{name}:\n" + "\n".join(f"{indent}  -\n{to_text(item, indent + '    ')}" for item in value)
    return f"{indent}{name}: {_scalar(value)}"


def _scalar(value: Plain) -> str:
    if isinstance(value, list):
        if any(isinstance(item, dict) for item in value):
            return "\n".join(f"-\n{to_text(item, '  ')}" for item in value)
        return f"[{', '.join(map(_scalar, value))}]"
    if isinstance(value, str) and not isinstance(value, _Note):
        lines = value.replace("\\", "\\\\").replace('"', '\\"').split("\n")
        return '"' + "\\n".join(map(printable, lines)) + '"'
    return str(value)


def flatten(plain: Plain, name: str = "field") -> Iterator[tuple[str, str]]:
    """Columns and cells in the format of ``rostopic echo -p``: times in nanoseconds, elements of arrays numbered."""
    if isinstance(plain, dict) and plain.keys() == _TIME:
        yield name, str(plain["secs"] * 1_000_000_000 + plain["nsecs"])  # type: ignore[operator] # both are numbers
    elif isinstance(plain, dict):
        for field, value in plain.items():
            yield from flatten(value, f"{name}.{field}")
    elif isinstance(plain, list):
        for index, value in enumerate(plain):
            yield from flatten(value, f"{name}{index}")
    else:
        yield name, printable(str(int(plain) if isinstance(plain, bool) else plain))


def read_values(texts: tuple[str, ...]) -> Plain:
    """Read a message's values from the command line: none, one YAML value, or one for each field in order.

    Raises:
        ConfigError: It is not YAML.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    values: list[Plain] = []
    for text in texts:
        try:
            values.append(YAML(typ="safe", pure=True).load(text))
        except (YAMLError, ValueError) as error:
            problem = getattr(error, "problem", None) or str(error)
            raise ConfigError("VALUES", f"not YAML: {problem}", f"in {text!r}") from None
    if len(values) == 1 and values[0] is not None:
        return values[0]
    return values or None


def fill_stamps(values: Plain, now_ns: int) -> Plain:
    """Replace ``auto`` (a header) and ``now`` (a stamp) by the time, as rostopic does."""
    secs, nsecs = divmod(now_ns, 1_000_000_000)
    stamp: dict[str, Plain] = {"secs": secs, "nsecs": nsecs}
    if isinstance(values, list):
        return [fill_stamps(value, now_ns) for value in values]
    if not isinstance(values, dict):
        return {"stamp": stamp} if values == "auto" else values
    filled: dict[str, Plain] = {}
    for name, value in values.items():
        if name == "header" and value == "auto":
            filled[name] = {"stamp": stamp}
        elif name == "stamp" and value == "now":
            filled[name] = stamp
        else:
            filled[name] = fill_stamps(value, now_ns) if isinstance(value, dict | list) else value
    return filled
