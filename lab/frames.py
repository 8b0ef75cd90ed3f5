"""Samples as pandas tables: one row a message, a second or a process; how they are kept as CSV, and what they tell.

CSV knows texts only, so a manifest keeps what each column holds: ``int``, ``float``, ``bool``, ``str`` or ``none``,
and ``?`` behind it where values are missing, which are empty in the file. Tables of messages have ``sequence``, and
``due_ns`` and ``came_ns`` (what came) or ``late_ns`` (how late the source itself was); columns before it tell the
flows of one table apart (``topic``, ``rate``, ``size``). Times are of CLOCK_MONOTONIC.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TextIO

import pandas as pd

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from lab.experiments.model import Value

# By the letter of numpy's kind.
_KINDS: Final = {"b": "bool", "i": "int", "u": "int", "f": "float"}
# What a column is read as; ``number`` is of runs that were measured before pandas kept them.
_TYPES: Final = {
    "none": "float64",
    "bool": "bool",
    "int": "int64",
    "float": "float64",
    "number": "float64",
    "str": "str",
}


def frame(columns: Iterable[str], rows: Iterable[tuple[Value, ...]]) -> pd.DataFrame:
    """A table of these rows, as many values each as there are columns."""
    return pd.DataFrame.from_records(list(rows), columns=list(columns))


def kinds(table: pd.DataFrame) -> dict[str, str]:
    """What each column holds, by its name.

    Raises:
        ValueError: A column holds what cannot be told apart in a text, or two columns have one name.
    """
    if not table.columns.is_unique:
        raise ValueError(f"two columns of {', '.join(table.columns)} have one name")
    return {name: _kind(name, table[name]) for name in table.columns}


def write(file: TextIO, table: pd.DataFrame) -> None:
    """Write a table under the names of its columns (RFC 4180); the file was opened with ``newline=""``."""
    table.to_csv(file, index=False, lineterminator="\n")


def read(file: TextIO, held: Mapping[str, str]) -> pd.DataFrame:
    """Read a table whose columns hold what ``kinds`` said.

    Raises:
        ValueError: The file holds something else.
    """
    if unknown := sorted({kind.removesuffix("?") for kind in held.values()} - _TYPES.keys()):
        raise ValueError(f"{unknown[0]!r} is not what a column may hold")
    types = {name: "float64" if kind == "int?" else _TYPES[kind.removesuffix("?")] for name, kind in held.items()}
    table = pd.read_csv(file, dtype=types, na_values=["", "nan"], keep_default_na=False, skip_blank_lines=False)
    if list(table.columns) != list(held):
        raise ValueError(f"it has the columns {', '.join(table.columns)}, not {', '.join(held)}")
    if list(table.index) != list(range(len(table))):
        raise ValueError("its rows have more values than there are columns")  # pandas takes the first as an index
    return table.fillna({name: "" for name, kind in held.items() if kind == "str"})


def _kind(name: str, values: pd.Series) -> str:
    there = values.dropna()
    lacks = "?" if len(there) < len(values) else ""
    if there.empty and values.dtype.kind == "O":
        return "none"
    if values.dtype.kind in _KINDS:
        return _KINDS[values.dtype.kind] + lacks
    found = sorted({type(value).__name__ for value in there})
    if found != ["str"]:
        raise ValueError(f"column {name} holds {', '.join(found)}")
    if there.str.contains("[\r\n\0]").any():
        raise ValueError(f"column {name} holds a text of several lines")
    if lacks and (there == "").any():
        raise ValueError(f"column {name} holds empty texts and values that are missing, which look alike in a file")
    return "str" + lacks


# --- what they tell -------------------------------------------------------------------------------------------------


def where(table: pd.DataFrame, **values: Value) -> pd.DataFrame:
    """The rows that have these values."""
    for name, value in values.items():
        table = table[table[name] == value]
    return table


def pairs(table: pd.DataFrame, **values: Value) -> list[tuple[int, int]]:
    """``(sequence, came_ns)`` of the rows with these values, as ``statistics`` wants them."""
    found = where(table, **values)
    return list(zip(found["sequence"].tolist(), found["came_ns"].tolist(), strict=True))


def latencies(table: pd.DataFrame, **values: Value) -> list[float]:
    """From due to there, ms, of the rows with these values: with all that held the message back at its source."""
    found = where(table, **values)
    return ((found["came_ns"] - found["due_ns"]) / 1e6).tolist()


def source_periods(table: pd.DataFrame, hz: float, **values: Value) -> list[float]:
    """Seconds between what the source sent: the part of the jitter that no way can take away."""
    late = where(table, **values).sort_values("sequence")["late_ns"]
    return (1 / hz + late.diff().dropna() / 1e9).tolist()


def counting_from(table: pd.DataFrame, first: int) -> pd.DataFrame:
    """The rows of messages from this number on: without those that came before all was warm."""
    return table[table["sequence"] >= first].reset_index(drop=True)


def lost(arrivals: pd.DataFrame, sent: pd.DataFrame, **values: Value) -> int:
    """How many of the messages that were sent never came."""
    return len({*where(sent, **values)["sequence"]}) - len({*where(arrivals, **values)["sequence"]})
