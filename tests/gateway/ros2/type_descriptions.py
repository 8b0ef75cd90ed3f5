"""What a ROS 2 node answers that is asked for a type: its service's response, made with rosbags alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rosbags.interfaces import Nodetype

from rmpa.gateway.ros2 import types as type_description
from rmpa.gateway.ros2.types import embedded

if TYPE_CHECKING:
    from rmpa.gateway.ros2.types import Ros2Types

IDS = {name: number for number, name in type_description._BASES.items() if number not in (13, 21)}
PACKAGE = "type_description_interfaces/msg/"


def response(types: Ros2Types, name: str) -> bytes:
    """A true response: the type and all that it embeds."""
    every = dict.fromkeys(embedded(types.store, name))
    return respond({each: [(key, *_numbers(desc)) for key, desc in types.store.fielddefs[each][1]] for each in every})


def respond(types: dict[str, list[tuple[str, int, int, int, str]]], *, ok: bool = True, why: str = "") -> bytes:
    """Any response.

    Args:
        types: Name to fields: name, type's number, capacity, capacity of strings, nested type. The first is meant.
        ok: Whether the node says that it knows the type.
        why: Why it does not.
    """
    store = type_description._store()
    made: Any = store.types

    def one(name: str) -> Any:
        fields = [
            made[f"{PACKAGE}Field"](key, made[f"{PACKAGE}FieldType"](number, capacity, text, nested), "")
            for key, number, capacity, text, nested in types[name]
        ]
        return made[f"{PACKAGE}IndividualTypeDescription"](name, fields)

    first, *others = types
    described = made[f"{PACKAGE}TypeDescription"](one(first), [one(each) for each in others])
    message = made[type_description._RESPONSE](ok, why, described, [], [])
    return bytes(store.serialize_cdr(message, type_description._RESPONSE))


def _inner(desc: Any) -> Any:
    return desc[1][0] if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else desc


def _numbers(desc: Any) -> tuple[int, int, int, str]:
    inner, more, capacity = _inner(desc), 0, 0
    if desc[0] == Nodetype.ARRAY:
        more, capacity = 48, desc[1][1]
    elif desc[0] == Nodetype.SEQUENCE:
        more, capacity = (96, desc[1][1]) if desc[1][1] else (144, 0)
    if inner[0] == Nodetype.NAME:
        return more + 1, capacity, 0, str(inner[1])
    return more + IDS[inner[1][0]], capacity, 0, ""
