"""What commands print: lines, tables, JSON, and numbers with units.

Colours are click's: it drops them where standard output is no terminal, and everywhere with ``NO_COLOR``.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Final

import click
import msgspec

from rmpa.observe.peer_info import CheckLevel

if TYPE_CHECKING:
    from collections.abc import Sequence

_ANY_WIDTH: Final = 10_000
"""Columns of a terminal that no table needs."""
_INDENT: Final = "    "
_UNITS: Final = ("B", "kB", "MB", "GB", "TB")
LEVEL_COLOURS: Final = {
    CheckLevel.OK: "green",
    CheckLevel.WARN: "yellow",
    CheckLevel.FAIL: "red",
    CheckLevel.SKIPPED: "cyan",
    CheckLevel.UNKNOWN: "yellow",
    CheckLevel.STALE: "yellow",
}
"""Of the results of ``rmpa doctor`` and ``rmpa why``, on a terminal."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table: its heading, and whether its cells are aligned to the right, as numbers are."""

    title: str
    right: bool = False


def json_text(value: object) -> str:
    """A value as JSON; msgspec structs are objects, NaN and infinity are null."""
    return msgspec.json.encode(value).decode()


def print_json(value: object) -> None:
    """One JSON document on one line of standard output, at once."""
    click.echo(json_text(value))


def print_table(columns: Sequence[Column], rows: Sequence[Sequence[str]], *, colours: Sequence[str] = ()) -> None:
    """Print a table under its headings: by rich on a terminal, as aligned plain text elsewhere.

    No cell is cut. Where a table is wider than the terminal, each row is a paragraph: the first cell, then the others
    behind their headings.

    Args:
        columns: From left to right.
        rows: One text a column; control characters are escaped here.
        colours: One name of a colour a row, for the second column on terminals; empty for none.
    """
    rows = [[printable(cell) for cell in row] for row in rows]
    if sys.stdout.isatty():
        _print_rich(columns, rows, colours)
        return
    # Not by rich: it takes seconds over the ten thousand topics that a peer may have.
    lines = [[column.title for column in columns], *rows]
    width = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    for line in lines:
        cells = (t.rjust(w) if c.right else t.ljust(w) for c, t, w in zip(columns, line, width, strict=True))
        sys.stdout.write("  ".join(cells).rstrip() + "\n")


def _print_rich(columns: Sequence[Column], rows: Sequence[Sequence[str]], colours: Sequence[str]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column.title, justify="right" if column.right else "left", no_wrap=True)
    for row, style in zip_longest(rows, colours, fillvalue=""):
        table.add_row(*(Text(cell, style=style if index == 1 else "") for index, cell in enumerate(row)))
    if console.measure(table, options=console.options.update(width=_ANY_WIDTH)).maximum <= console.width:
        console.print(table)
        return
    for row, style in zip_longest(rows, colours, fillvalue=""):
        console.print(Text(row[0], style="bold"), overflow="fold")
        line = Text()
        for index, (column, cell) in enumerate(zip(columns[1:], row[1:], strict=True)):
            if cell in ("", "-"):
                continue
            fact = Text(f"{column.title.strip().lower()} {cell}", style="" if index else style)
            if line and len(_INDENT) + line.cell_len + 2 + fact.cell_len > console.width:
                console.print(_INDENT, line, sep="", overflow="fold")
                line = Text()
            line = Text(", ").join((line, fact)) if line else fact
        console.print(_INDENT, line, sep="", overflow="fold")


def warn(text: str) -> None:
    """One line on stderr, yellow on a terminal; control characters are escaped."""
    click.secho(f"! {printable(text)}", err=True, fg="yellow")


def print_error(error: object) -> None:
    """``rmpa: …`` on stderr. An error may hold the words of a peer or a node: control characters are escaped."""
    click.echo("\n".join(map(printable, f"rmpa: {error}".split("\n"))), err=True)


def print_line(text: str = "", colour: str | None = None) -> None:
    """One line on standard output at once; control characters are escaped, and terminals show the colour."""
    text = printable(text)
    click.echo(text if colour is None else click.style(text, fg=colour))


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
    if length < 0.09995:
        return f"{seconds * 1e3:.2f} ms"
    if length < 1:
        return f"{seconds * 1e3:.0f} ms"
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
    power = 0
    while abs(count) >= 999.5 and power < len(_UNITS) - 1:
        count /= 1000
        power += 1
    if power == 0:
        return f"{count:.0f} B"
    digits = 2 if abs(count) < 9.995 else 1 if abs(count) < 99.95 else 0
    return f"{count:.{digits}f} {_UNITS[power]}"
