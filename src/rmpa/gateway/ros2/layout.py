"""The layout of a pair of types: what their messages are made of, in order, for the transcoder."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype

from rmpa.gateway.ros2.transcoder import Items, Number, Part, Side, Text, on_side
from rmpa.gateway.ros2.types import ros2_name, snake_case

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.ros.types.definitions import Field, Specification

HEADER: Final = "std_msgs/msg/Header"
TIMES: Final = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}
"""ROS 1's primitive times, and the messages of ROS 2 that have the same 8 bytes."""
_TIME: Final = Number(4, 2)
_SIZES: Final = {
    **dict.fromkeys(("bool", "byte", "char", "int8", "uint8", "octet"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
"""Bytes of the numbers of both sides, and their alignment in CDR."""
_BYTES: Final = dict.fromkeys(("byte", "char", "int8", "uint8", "octet"), "byte")
"""Numbers of one byte mean the same under each of these names; other numbers have to have one name."""


class Layouts:
    """Finds the layouts of pairs of types.

    Args:
        ros1: The fields of ROS 1's types by name.
        ros2: The fields of ROS 2's types by name, as rosbags has them.
    """

    def __init__(self, ros1: Mapping[str, Specification], ros2: Mapping[str, Any]) -> None:
        self._ros1 = ros1
        self._ros2 = ros2

    def of(self, name1: str, name2: str) -> tuple[Part, ...] | None:
        """The parts of a message of both types; ``None`` if order or size of their common fields differ."""
        fields2 = dict(self._ros2[name2][1])
        if ros2_name(name1) == name2 == HEADER:
            return (Number(4, side=Side.ROS1), _TIME, Text())  # seq, stamp, frame_id
        ones = {name2_of(field.name, fields2): field for field in self._ros1[name1].fields}
        if [name for name in ones if name in fields2] != [name for name in fields2 if name in ones]:
            return None
        parts: list[Part] = []
        waiting = list(fields2.items())
        for name, field in ones.items():
            if name not in fields2:
                parts += on_side(self._only1(field), Side.ROS1)
                continue
            while waiting[0][0] != name:
                parts += on_side(self._only2(waiting.pop(0)[1]), Side.ROS2)
            both = self._field(field, waiting.pop(0)[1])
            if both is None:
                return None
            parts += both
        for _, desc in waiting:
            parts += on_side(self._only2(desc), Side.ROS2)
        return tuple(parts)

    def _field(self, field: Field, desc: Any) -> tuple[Part, ...] | None:
        """The parts of a field that both sides have."""
        if not field.array:
            return self._scalar(field, desc)
        if desc[0] != (Nodetype.SEQUENCE if field.size is None else Nodetype.ARRAY):
            return None
        inner, count = desc[1]
        parts = self._scalar(field, inner)
        if parts is None or (field.size is not None and field.size != count):
            return None
        return (_array(parts, field.size, count if field.size is None else 0, field.name),)

    def _scalar(self, field: Field, desc: Any) -> tuple[Part, ...] | None:
        if desc[0] == Nodetype.NAME:
            if field.primitive:
                return (_TIME,) if TIMES.get(field.type) == desc[1] else None
            return self.of(field.type, desc[1])
        if desc[0] != Nodetype.BASE or not field.primitive:
            return None
        base, bound = desc[1]
        if field.type == base == "string":
            return (Text(bound=bound, name=field.name),)
        same = _BYTES.get(field.type, field.type) == _BYTES.get(base, base)
        return (Number(_SIZES[base]),) if same and base in _SIZES else None

    def _only1(self, field: Field) -> tuple[Part, ...]:
        if field.primitive:
            number = _TIME if field.type in TIMES else Number(_SIZES.get(field.type, 0))
            parts: tuple[Part, ...] = (Text() if field.type == "string" else number,)
        else:
            parts = tuple(part for each in self._ros1[field.type].fields for part in self._only1(each))
        return (_array(parts, field.size),) if field.array else parts

    def _only2(self, desc: Any) -> tuple[Part, ...]:
        if desc[0] == Nodetype.NAME:
            return tuple(part for _, each in self._ros2[desc[1]][1] for part in self._only2(each))
        if desc[0] == Nodetype.BASE:
            return (Text(),) if desc[1][0] == "string" else (Number(_SIZES[desc[1][0]]),)
        inner, count = desc[1]
        return (_array(self._only2(inner), count if desc[0] == Nodetype.ARRAY else None),)


def name2_of(name: str, fields2: Iterable[str]) -> str:
    """ROS 2's name of a field of ROS 1."""
    return name if name in fields2 else snake_case(name)


def _array(parts: tuple[Part, ...], count: int | None, bound: int = 0, name: str = "") -> Part:
    """An array; one of a fixed number of numbers is numbers, so that it is copied with its neighbours."""
    if count is not None and len(parts) == 1 and isinstance(parts[0], Number):
        return Number(parts[0].size, parts[0].count * count, parts[0].side)
    return Items(parts, count, Side.BOTH, bound, name)
