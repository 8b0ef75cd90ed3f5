"""States of the monitor, and their changes as JSON merge patches (RFC 7396, docs/design/monitor-protocol.md).

A state is a tree of JSON values whose objects have no member that is null: there a missing member says "not known".
So a null in a patch always removes. Arrays are replaced as a whole.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, TypeAlias, Union

import msgspec

if TYPE_CHECKING:
    from collections.abc import Mapping

Value: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, list["Value"], dict[str, "Value"], None
]
Tree: TypeAlias = dict[str, Value]
VERSION: Final = 1
SUBPROTOCOL: Final = "rmpa.monitor.v1"
"""The WebSocket subprotocol; a version that older pages cannot read has another one."""
LOG_TOPIC: Final = "/rosout_agg"
"""The messages of all nodes, from one publisher: ``/rosout`` would be a connection to each node."""


def difference(old: Mapping[str, Value], new: Mapping[str, Value]) -> Tree:
    """The merge patch that makes ``new`` of ``old``; empty where they are equal.

    Parts that are the same object in both cost nothing. ``1``, ``1.0`` and ``True`` are different values.
    """
    patch: Tree = {key: None for key in old if key not in new}
    for key, value in new.items():
        before = old.get(key)
        if before is value:
            continue
        if isinstance(value, dict) and isinstance(before, dict):
            if inner := difference(before, value):
                patch[key] = inner
        elif before != value or msgspec.json.encode(before) != msgspec.json.encode(value):
            patch[key] = value
    return patch


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
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)
