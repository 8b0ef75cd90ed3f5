"""Where in a TOML text a key or an element stands: ``tomllib`` does not say."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.config.values import Place


def value_at(table: object, place: Place) -> object:
    """The value at a place of a parsed file; ``None`` if there is none."""
    for part in place:
        in_table = isinstance(table, dict) and part in table
        in_list = isinstance(table, list) and isinstance(part, int) and part < len(table)
        if not in_table and not in_list:
            return None
        table = table[part]  # type: ignore[index] # one of the two, as just seen
    return table


def line_of(text: str, place: Place) -> int | None:
    """The line, from 1, on which the key or element at a place begins in a valid TOML text; ``None`` if it has none.

    A prefix of whole lines is valid TOML only if no statement is left open. So the first valid prefix that contains
    the place ends with its statement, and the last valid prefix before that ends where the statement begins. An
    element of a list is searched within its statement.
    """
    lines = text.split("\n")
    begin = 0
    for end in range(1, len(lines) + 1):
        try:
            table = tomllib.loads("\n".join(lines[:end]))
        except (ValueError, RecursionError):
            continue
        if value_at(table, place) is not None:
            return _element_line(lines, begin, end, place)
        begin = end
    return None


def _element_line(lines: list[str], begin: int, end: int, place: Place) -> int:
    """The line of a place in the statement between two lines: not its first only for an element of a list."""
    if begin + 1 == end:
        return end
    inline = value_at(tomllib.loads("\n".join(lines[begin:end])), place) is not None
    indices = [part for part in (place if inline else place[-1:]) if isinstance(part, int)]
    if not indices:
        return begin + 1
    for stop in range(begin + 1, end):
        try:
            value: object = tomllib.loads("\n".join(lines[begin:stop]) + "\n]")
        except ValueError:
            continue
        while isinstance(value, dict) and value:
            value = next(iter(value.values()))
        if isinstance(value, list) and len(value) > indices[0]:
            return stop
    return end
