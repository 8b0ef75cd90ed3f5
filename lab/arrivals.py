"""What sources and sinks noted, read out of the tables of a cell.

``arrivals``: one row a message that came, ``sent``: one a message that was published. Both have ``sequence``; columns
before it tell one flow of the table from another (``topic``, ``rate``, ``size``).
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Final

from lab.experiments.model import Table
from lab.experiments.report import words

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from lab.experiments.model import Value

ARRIVALS: Final = ("sequence", "due_ns", "came_ns")
"""The last columns of a table of what came."""
SENT: Final = ("sequence", "late_ns")
"""The last columns of a table of what was sent: how late the source itself was."""


def pairs(table: Table, **where: Value) -> list[tuple[int, int]]:
    """``(sequence, came_ns)`` of the rows with these values, as ``statistics`` wants them."""
    return list(_pairs(table, "sequence", "came_ns", where))


def latencies(table: Table, **where: Value) -> list[float]:
    """From due to there, ms, of the rows with these values: with all that held the message back at its source."""
    return [(came - due) / 1e6 for due, came in _pairs(table, "due_ns", "came_ns", where)]


def source_periods(table: Table, hz: float, **where: Value) -> list[float]:
    """Seconds between what the source sent: the part of the jitter that no way can take away."""
    late = sorted(_pairs(table, "sequence", "late_ns", where))
    return [1 / hz + (b - a) / 1e9 for (_, a), (_, b) in itertools.pairwise(late)]


def counting_from(table: Table, first: int) -> Table:
    """The rows of messages from this number on: without those that came before all was warm."""
    at = table.columns.index("sequence")
    return Table(table.columns, [row for row in table.rows if _whole(row[at]) >= first])


def lost(arrivals: Table, sent: Table, **where: Value) -> int:
    """How many of the messages that were sent never came."""
    return len({number for number, _ in _pairs(sent, "sequence", "late_ns", where)}) - len(
        {number for number, _ in pairs(arrivals, **where)}
    )


def counted(value: float | None, digits: int = 3, factor: float = 1.0) -> str:
    """A figure for a table, in another unit if a factor is given; a dash for what is not known."""
    return words.number(None if value is None else value * factor, digits)


def _pairs(table: Table, first: str, second: str, where: dict[str, Value]) -> Iterator[tuple[int, int]]:
    columns: Sequence[str] = table.columns
    a, b = columns.index(first), columns.index(second)
    asked: Iterable[tuple[int, Value]] = [(columns.index(name), value) for name, value in where.items()]
    for row in table.rows:
        if all(row[at] == value for at, value in asked):
            yield _whole(row[a]), _whole(row[b])


def _whole(value: Value) -> int:
    if isinstance(value, int):
        return value
    raise ValueError(f"{value!r} is no whole number")
