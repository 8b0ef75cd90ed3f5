"""Differences of two states as JSON merge patches (RFC 7396).

A state is a tree of JSON values whose objects have no member that is null: there a missing member says "not known".
So a null in a patch always removes. Arrays are replaced as a whole.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, TypeAlias, Union

if TYPE_CHECKING:
    from collections.abc import Mapping

Value: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, list["Value"], dict[str, "Value"], None
]
Tree: TypeAlias = dict[str, Value]

_MISSING: Final = object()


def difference(old: Mapping[str, Value], new: Mapping[str, Value]) -> Tree:
    """The merge patch that makes ``new`` of ``old``; empty where they are equal.

    Parts that are the same object in both cost nothing. ``1``, ``1.0`` and ``True`` are different values.
    """
    patch: Tree = {}
    for key, value in new.items():
        before = old.get(key, _MISSING)
        if before is value:
            continue
        if isinstance(value, dict) and isinstance(before, dict):
            if inner := difference(before, value):
                patch[key] = inner
        elif not _same(before, value):
            patch[key] = value
    patch.update((key, None) for key in old if key not in new)
    return patch


def apply(state: Value, patch: Value) -> Value:
    """``state`` with a merge patch applied, as RFC 7396 describes it; neither argument is changed."""
    if not isinstance(patch, dict):
        return patch
    result: Tree = dict(state) if isinstance(state, dict) else {}
    for key, value in patch.items():
        if value is None:
            result.pop(key, None)
        else:
            result[key] = apply(result.get(key), value)
    return result


def without_nulls(value: object) -> Value:
    """A value for a state: without members that are null, arrays as lists, NaN and infinities left out as unknown.

    In an array, what is unknown stays, as null.
    """
    if isinstance(value, dict):
        members = ((str(key), without_nulls(inner)) for key, inner in value.items())
        return {key: inner for key, inner in members if inner is not None}
    if isinstance(value, list | tuple):
        return [without_nulls(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)


def _same(one: object, other: object) -> bool:
    if type(one) is not type(other):
        return False
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(_same(one[key], other[key]) for key in one)
    return one == other
