"""Tables of samples as CSV (RFC 4180) that anything can read, and back without a value that has become another.

CSV knows texts only. So the manifest keeps what each column holds: ``int``, ``float``, ``number`` (both), ``bool``
(``true``, ``false``), ``str``, ``none``; behind it ``?`` where values are missing, which are empty in the file.
"""

from __future__ import annotations

import csv
from typing import TYPE_CHECKING, Final, TextIO

from lab.experiments.model import Table, Value

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

_KINDS: Final[dict[frozenset[type], str]] = {
    frozenset(): "none",
    frozenset({bool}): "bool",
    frozenset({int}): "int",
    frozenset({float}): "float",
    frozenset({int, float}): "number",
    frozenset({str}): "str",
}
_BREAKS: Final = frozenset("\r\n\0")
"""What no text may hold: each row is one line, for whatever else reads the file."""


def kinds(table: Table) -> dict[str, str]:
    """What each column holds, by its name.

    Raises:
        ValueError: A row has another length, a column holds values that cannot be told apart in a text, or two
            columns have one name.
    """
    if len(set(table.columns)) != len(table.columns):
        raise ValueError(f"two columns of {', '.join(table.columns)} have one name")
    for number, row in enumerate(table.rows):
        if len(row) != len(table.columns):
            raise ValueError(f"row {number} has {len(row)} values, there are {len(table.columns)} columns")
    return {name: _kind(name, (row[at] for row in table.rows)) for at, name in enumerate(table.columns)}


def write(file: TextIO, table: Table) -> None:
    """Write a table under the names of its columns; the file was opened with ``newline=""``."""
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows([_text(value) for value in row] for row in table.rows)


def read(file: TextIO, held: dict[str, str]) -> Table:
    """Read a table.

    Args:
        file: Opened with ``newline=""``.
        held: What its columns hold, as ``kinds`` said.

    Raises:
        ValueError: The file holds something else.
    """
    rows = csv.reader(file)
    columns = tuple(next(rows, ()))
    if columns != tuple(held):
        raise ValueError(f"it has the columns {', '.join(columns)}, not {', '.join(held)}")
    of = [_reader(kind) for kind in held.values()]
    return Table(columns, [_row(of, row) for row in rows])


def _row(of: Sequence[Callable[[str], Value]], row: Sequence[str]) -> tuple[Value, ...]:
    return tuple(value(text) for value, text in zip(of, row, strict=True))


def _kind(column: str, values: Iterable[Value]) -> str:
    types: set[type] = set()
    empty = False
    for value in values:
        types.add(type(value))
        empty = empty or value == ""
        if isinstance(value, str) and not _BREAKS.isdisjoint(value):
            raise ValueError(f"column {column} holds a text of several lines")
    lacks = type(None) in types
    kind = _KINDS.get(frozenset(types - {type(None)}))
    if kind is None:
        raise ValueError(f"column {column} holds {', '.join(sorted(one.__name__ for one in types))}")
    if lacks and empty:
        raise ValueError(f"column {column} holds empty texts and values that are missing, which look alike in a file")
    return f"{kind}?" if lacks and kind != "none" else kind


def _text(value: Value) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    return repr(value) if isinstance(value, float) else str(value)


def _reader(kind: str) -> Callable[[str], Value]:
    of = _READERS.get(kind.removesuffix("?"))
    if of is None:
        raise ValueError(f"{kind!r} is not what a column may hold")
    return (lambda text: of(text) if text else None) if kind.endswith("?") else of


def _bool(text: str) -> bool:
    if text not in ("true", "false"):
        raise ValueError(f"{text!r} is neither true nor false")
    return text == "true"


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        return float(text)


def _nothing(text: str) -> None:
    if text:
        raise ValueError(f"{text!r} stands where nothing should")


_READERS: Final[dict[str, Callable[[str], Value]]] = {
    "none": _nothing,
    "bool": _bool,
    "int": int,
    "float": float,
    "number": _number,
    "str": str,
}
