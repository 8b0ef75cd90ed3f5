"""What commands print: aligned columns in a pipe, a coloured table on a terminal, JSON where it was asked for."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import click
import msgspec

from rmpa.observe.check import CheckLevel

if TYPE_CHECKING:
    from collections.abc import Sequence

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
    """One column of a table.

    Args:
        title: Its heading.
        right: Whether numbers stand in it, to be aligned at their ends.
    """

    title: str
    right: bool = False


def print_json(value: object, *, flush: bool = False) -> None:
    """One JSON document on one line; msgspec structs and figures that are not numbers (as null) included."""
    sys.stdout.write(msgspec.json.encode(value).decode() + "\n")
    if flush:
        sys.stdout.flush()


def print_line(text: str = "") -> None:
    """One line at once, so that a pipe sees it when it happens."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def print_table(columns: Sequence[Column], rows: Sequence[Sequence[str]], *, colours: Sequence[str] = ()) -> None:
    """A table under its headings.

    Args:
        columns: From left to right.
        rows: One text a column.
        colours: One name of a colour a row, for terminals; empty for none.
    """
    if sys.stdout.isatty():
        _print_rich(columns, rows, colours)
        return
    width = widths(columns, rows)  # once: a peer may have ten thousand topics
    for row in ([column.title for column in columns], *rows):
        sys.stdout.write(align(columns, row, width) + "\n")


def widths(columns: Sequence[Column], rows: Sequence[Sequence[str]]) -> list[int]:
    """How wide each column is."""
    return [
        max(len(c.title), *(len(row[i]) for row in rows)) if rows else len(c.title) for i, c in enumerate(columns)
    ]


def align(columns: Sequence[Column], row: Sequence[str], width: Sequence[int]) -> str:
    """One row in plain text, two spaces between columns, none at its end."""
    cells = (t.rjust(w) if c.right else t.ljust(w) for c, t, w in zip(columns, row, width, strict=True))
    return "  ".join(cells).rstrip()


def _print_rich(columns: Sequence[Column], rows: Sequence[Sequence[str]], colours: Sequence[str]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column.title, justify="right" if column.right else "left", no_wrap=True)
    for number, row in enumerate(rows):
        style = colours[number] if number < len(colours) else ""
        table.add_row(*(Text(cell, style=style if index == 1 else "") for index, cell in enumerate(row)))
    Console().print(table)


def warn(text: str) -> None:
    """One line on stderr, yellow on a terminal."""
    click.secho(f"! {text}", err=True, fg="yellow" if coloured(err=True) else None)


def coloured(*, err: bool = False) -> bool:
    """Whether colours are wanted: a terminal, and no NO_COLOR (no-color.org)."""
    import os

    return (sys.stderr if err else sys.stdout).isatty() and not os.environ.get("NO_COLOR")


def printable(text: str) -> str:
    """Text from the network, without what would move a terminal's cursor."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def duration(seconds: float | None) -> str:
    """How long: ``432 µs``, ``12.3 ms``, ``4.2 s``, ``3 min 20 s``, ``2 h 5 min``, ``3 d 4 h``; ``-`` for none."""
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
    """How many bytes: ``17 B``, ``1.23 kB``, ``45.6 MB`` (powers of 1000); ``-`` for none."""
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
