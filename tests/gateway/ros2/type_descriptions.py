"""What a ROS 2 node answers that is asked for a type: its service's response, made with rosbags alone."""

from __future__ import annotations

from typing import Any

from rmpa.gateway.ros2 import asking as type_description
from rmpa.gateway.ros2.types import Ros2Field, Ros2Types

IDS = {name: number for number, name in type_description._BASES.items() if number not in (13, 21)}
PACKAGE = "type_description_interfaces/msg/"


def response(types: Ros2Types, name: str) -> bytes:
    """A true response: the type and all that it embeds."""
    every: dict[str, list[tuple[str, int, int, int, str]]] = {}
    todo = [name]
    while todo:
        if (each := todo.pop()) not in every:
            every[each] = [(field.name, *_numbers(field)) for field in types.fields(each)]
            todo += [field.type for field in types.fields(each) if not field.primitive]
    return respond(every)


def respond(types: dict[str, list[tuple[str, int, int, int, str]]], *, ok: bool = True, why: str = "") -> bytes:
    """Any response.

    Args:
        types: Name to fields: name, type's number, capacity, capacity of strings, nested type. The first is meant.
        ok: Whether the node says that it knows the type.
        why: Why it does not.
    """
    store = type_description.service_types().store
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


def _numbers(field: Ros2Field) -> tuple[int, int, int, str]:
    more, capacity = 0, field.size or field.bound
    if field.array:
        more = 48 if field.size is not None else 96 if field.bound else 144
    if not field.primitive:
        return more + 1, capacity, 0, field.type
    return more + IDS[field.type], capacity, 0, ""
