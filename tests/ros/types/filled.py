"""Values other than zero for each field of any message type."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rmpa.ros.types.definitions import Field, Specification, known_specifications
from rmpa.ros.types.messages import MessageType


def filled(known: Mapping[str, Specification], name: str, seed: int) -> dict[str, Any]:
    """Values for all fields of a type; ``seed`` makes them differ."""
    values: dict[str, Any] = {}
    for number, field in enumerate(known[name].fields):
        mark = (seed + number) % 90 + 1

        def one(mark: int, field: Field = field) -> Any:
            if not field.primitive:
                return filled(known, field.type, mark)
            made: dict[str, Any] = {"string": f"é{mark}", "bool": bool(mark % 2)}
            if field.type in ("time", "duration"):
                return {"secs": mark, "nsecs": mark + 1}
            return made.get(field.type, mark / 4 if field.type.startswith("float") else mark)

        count = field.size or mark % 3 + 1
        values[field.name] = [one(mark + index) for index in range(count)] if field.array else one(mark)
    return values


def read_as(message: Any, values: Any) -> Any:
    """What another serializer has read, an object of rosbags, in the form of some values."""
    if isinstance(values, list):
        return [read_as(*each) for each in zip(message, values, strict=True)]
    if not isinstance(values, dict):
        return message.item() if hasattr(message, "item") else message
    if values.keys() == {"secs", "nsecs"}:
        return {"secs": message.sec, "nsecs": message.nanosec}
    return {name: read_as(getattr(message, name), value) for name, value in values.items()}


def filled_message(name: str, seed: int = 1) -> bytes:
    """A message of a shipped type, serialized by rosbags."""
    kind = MessageType(name)
    return kind.serialize(kind.make(filled(known_specifications(name), name, seed)))
