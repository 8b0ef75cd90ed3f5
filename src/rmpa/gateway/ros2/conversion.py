"""Conversion of messages between ROS 1's bytes and CDR, for each pair of types.

Where the fields that both types have are in one order and of one size, the bytes are converted without making objects
(``transcoder``). Else the values are read, each goes to the field of the same name, or as a mapping file says, and
they are written; numbers are checked for their range. A field that only one side has, as ``seq`` of a header, is 0 or
empty there. As in ros1_bridge, two types of which *each* has fields that the other lacks are no pair: a rule must say
what goes where.
"""

from __future__ import annotations

import functools
import struct
from typing import TYPE_CHECKING, Any, Final

from rosbags.serde import SerdeError

from rmpa.core.errors import RmpaError
from rmpa.core.limits import UINT32_MAX
from rmpa.gateway.ros2.transcoder import HEAD, LayoutPart, Transcoder
from rmpa.gateway.ros2.types import EMPTY_MEMBER, TIMES, FieldPaths, Ros2Field, Ros2Types, check_size, snake_case
from rmpa.ros.types.codec import MessageCodec
from rmpa.ros.types.definitions import Field, Specification
from rmpa.ros.types.values import CODES, SIZES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.wire.tcpros import Buffer

    # The fields of a type of one side by its name.
    FieldsOf = Callable[[str], Iterable[Field]]

# Numbers of one byte keep their bits under each of these names; other numbers are equal if they have one name.
_ONE_BYTE: Final = ("byte", "char", "int8", "uint8")
_LITTLE_ENDIAN: Final = HEAD[:2]
# What is raised for bytes that are not a message; rosbags does not check everything itself.
MALFORMED: Final = (
    SerdeError,
    RmpaError,
    struct.error,
    ValueError,
    KeyError,
    IndexError,
    AssertionError,
    OverflowError,
)


class NoConversion(RmpaError):  # noqa: N818 - the name says what happened
    """Two types are no pair; the text says which fields, and what to write."""

    code = "no-conversion"


class ConversionError(RmpaError):
    """A message does not fit the other side's type."""

    code = "no-conversion"


def _is_call(ros2: str) -> bool:
    """Whether a type is of a request, a response, or a part of an action."""
    return ros2.split("/")[1] != "msg"


class Ros2Codec:
    """Reads and writes the CDR of one type of ROS 2 as values, whose times are ``{sec, nanosec}``.

    Args:
        types: ROS 2's types.
        name: The type.

    Raises:
        KeyError: It or a type within it is not known.
        ValueError: Its messages are too much work.
        DefinitionError: Likewise.
    """

    def __init__(self, types: Ros2Types, name: str) -> None:
        known: dict[str, Specification] = {}
        todo = [name]
        while todo:
            each = todo.pop()
            if each not in known:
                known[each] = Specification(each, "", types.fields(each), ())
                todo += known[each].depends()
        fields = known[name].fields
        parts = [part for field in fields for part in _parts_of(field, types.fields)]
        self._transcoder = Transcoder(parts, padded=_is_call(name))
        self._codec = MessageCodec(name, known)

    def read(self, raw: Buffer) -> dict[str, Any]:
        """The values of CDR with its head; arrays of numbers are memoryviews.

        Raises:
            ValueError: The bytes are not such a message.
            struct.error: They are too short.
            MessageError: They claim too many values.
        """
        return self._codec.views(memoryview(self._transcoder.to_ros1(raw)))

    def write(self, values: Mapping[str, Any]) -> bytes:
        """The CDR of values; what is not given is 0 or empty.

        Raises:
            MessageError: A value does not fit.
            ValueError: A string or sequence is longer than its bound.
        """
        return self._transcoder.to_cdr(self._codec.write(values, 0).out)


class Conversion:
    """Converts messages of one pair of types.

    Args:
        ros1: The type of ROS 1.
        ros2: ``package/msg/Name`` of ROS 2.
        types: ROS 2's types, which know it.
        fields: The fields by path, if a mapping file lists them.

    Attributes:
        transcoder: What converts the bytes without making values, if that can be.

    Raises:
        NoConversion: The types are no pair.
    """

    def __init__(self, ros1: MessageType, ros2: str, types: Ros2Types, fields: FieldPaths | None = None) -> None:
        self.ros1 = ros1
        self.ros2 = ros2
        self._types = types
        # What goes where, if a mapping file says it.
        self._mapped: list[tuple[list[str], list[str], Field, Ros2Field]] | None = None
        self.transcoder: Transcoder | None = None
        try:
            check_size(ros1.name, self._fields1)
            if fields is None:
                parts = self._common_parts(ros1.name, ros2)
                self.transcoder = Transcoder(parts, padded=_is_call(ros2)) if parts is not None else None
            else:
                self._mapped = [self._map(*paths) for paths in fields.items()]
            if self.transcoder is None:
                _ = self._codecs
        except NoConversion:
            raise
        except (RmpaError, ValueError) as error:
            raise NoConversion(f"{ros1.name} and {ros2} cannot be converted: {error}") from error

    def to_ros2(self, raw: Buffer) -> bytes:
        """Convert a serialized message of ROS 1, without a length in front, to CDR (little-endian, with its head).

        Raises:
            ConversionError: The bytes are not such a message, or a value does not fit ROS 2's type.
        """
        try:
            if self.transcoder is not None:
                return self.transcoder.to_cdr(raw)
            codec1, codec2 = self._codecs
            return codec2.write(self._convert(codec1.views(memoryview(raw)), to_ros1=False))
        except MALFORMED as error:
            raise ConversionError(f"cannot convert a {self.ros1.name} to {self.ros2}: {error}") from error

    def to_ros1(self, raw: Buffer) -> bytes:
        """Convert CDR with its head to a serialized message of ROS 1, without a length in front; ``seq`` is 0.

        Raises:
            ConversionError: The bytes are not such a message, or a value does not fit ROS 1's type.
        """
        try:
            if bytes(raw[:2]) != _LITTLE_ENDIAN:
                store = self._types.store
                raw = bytes(store.serialize_cdr(store.deserialize_cdr(bytes(raw), self.ros2), self.ros2))
            if self.transcoder is not None:
                return self.transcoder.to_ros1(raw)
            codec1, codec2 = self._codecs
            return codec1.write(self._convert(codec2.read(raw), to_ros1=True), 0).payload
        except MALFORMED as error:
            raise ConversionError(f"cannot convert a {self.ros2} to {self.ros1.name}: {error}") from error

    @functools.cached_property
    def _codecs(self) -> tuple[MessageCodec, Ros2Codec]:
        return MessageCodec(self.ros1.name, self.ros1.specifications), Ros2Codec(self._types, self.ros2)

    def _fields1(self, name: str) -> tuple[Field, ...]:
        known = self.ros1.specifications.get(name)
        return known.fields if known is not None else ()

    def _fields2(self, name: str) -> dict[str, Ros2Field]:
        return {field.name: field for field in self._types.fields(name)}

    def _common_parts(self, name1: str, name2: str) -> tuple[LayoutPart, ...] | None:
        """The parts of a message of both types; ``None`` if order or size of their common fields differ.

        Raises:
            NoConversion: Each has fields that the other lacks, or a field is of another kind.
        """
        fields2 = self._fields2(name2)
        ones = {name2_of(field.name, fields2): field for field in self._fields1(name1)}
        only1, only2 = sorted(ones.keys() - fields2), sorted(fields2.keys() - ones.keys() - {EMPTY_MEMBER})
        if only1 and only2:
            raise NoConversion(
                f"{name1} has {', '.join(only1)}, and {name2} has {', '.join(only2)} instead: write fields_1_to_2 in "
                "a mapping file"
            )
        common = {
            name: self._both(ones[name], fields2[name], f"{name1} and {name2}: {name}")
            for name in fields2
            if name in ones
        }
        if [name for name in ones if name in fields2] != list(common):
            return None
        parts: list[LayoutPart] = []
        waiting = list(fields2.values())
        for name, field in ones.items():
            if name not in common:
                parts += _parts_of(field, self._fields1, in2=False)
                continue
            while waiting[0].name != name:
                parts += _parts_of(waiting.pop(0), self._types.fields, in1=False)
            waiting.pop(0)
            both = common[name]
            if both is None:
                return None
            parts += both
        return (*parts, *(part for field in waiting for part in _parts_of(field, self._types.fields, in1=False)))

    def _both(self, field: Field, other: Ros2Field, where: str) -> tuple[LayoutPart, ...] | None:
        """The parts of a field that both sides have; ``None`` and errors as for ``_common_parts``."""
        if field.array != other.array:
            raise NoConversion(f"{where} is an array on one side only")
        if other.size not in (None, field.size):
            size = "any number of" if field.size is None else field.size
            raise NoConversion(f"{where} has {size} elements, or {other.size}")
        named = "/" in other.type
        parts: tuple[LayoutPart, ...] | None = None
        if TIMES.get(field.type) == other.type:
            parts = (LayoutPart(4, 2),)
        elif named and not field.primitive:
            parts = self._common_parts(field.type, other.type)
        elif (
            named
            or not field.primitive
            or field.type in TIMES
            or (field.type == "string") != (other.type == "string")
        ):
            raise NoConversion(f"{where} is a {field.type}, or a {other.type}")
        elif field.type == "string":
            parts = (LayoutPart(bound=other.text, name=field.name),)
        elif field.type == other.type or {field.type, other.type}.issubset(_ONE_BYTE):
            parts = (LayoutPart(SIZES[other.type]),)
        if parts is None or field.size != other.size:
            return None
        return (_array(parts, field.size, other.bound, field.name),) if field.array else parts

    def _map(self, path1: str, path2: str) -> tuple[list[str], list[str], Field, Ros2Field]:
        """The two fields of a rule; errors as for ``_common_parts``."""
        field = _field_at(self.ros1.name, path1, self._fields1)
        other = _field_at(self.ros2, path2, self._types.fields)
        self._both(field, other, f"{self.ros1.name}.{path1} and {self.ros2}.{path2}")
        return path1.split("."), path2.split("."), field, other

    def _convert(self, values: dict[str, Any], *, to_ros1: bool) -> dict[str, Any]:
        if self._mapped is None:
            return self._by_name(self.ros1.name, self.ros2, values, to_ros1=to_ros1)
        made: dict[str, Any] = {}
        for path1, path2, field, other in self._mapped:
            source, (*outer, last) = (path2, path1) if to_ros1 else (path1, path2)
            value: Any = values
            for part in source:
                value = value[part]
            into = made
            for part in outer:
                into = into.setdefault(part, {})
            into[last] = self._value(field, other, value, to_ros1=to_ros1)
        return made

    def _by_name(self, name1: str, name2: str, values: dict[str, Any], *, to_ros1: bool) -> dict[str, Any]:
        fields2, made = self._fields2(name2), {}
        for field in self._fields1(name1):
            other = fields2.get(name2_of(field.name, fields2))
            if other is not None:
                source, target = (other, field) if to_ros1 else (field, other)
                made[target.name] = self._value(field, other, values[source.name], to_ros1=to_ros1)
        return made

    def _value(self, field: Field, other: Ros2Field, value: Any, *, to_ros1: bool) -> Any:
        if isinstance(value, list):
            return [self._value(field, other, each, to_ros1=to_ros1) for each in value]
        target = (field if to_ros1 else other).type
        if isinstance(value, dict):
            if not field.primitive:
                return self._by_name(field.type, other.type, value, to_ros1=to_ros1)
            # The same 32 bits are unsigned seconds of a time in ROS 1, and signed ones in ROS 2.
            seconds, nanoseconds = value.values()
            signed = not to_ros1 or field.type == "duration"
            return {"sec": _bits(seconds, 32) if signed else seconds & UINT32_MAX, "nanosec": nanoseconds}
        if field.type in (other.type, "string"):
            return value
        if field.type in _ONE_BYTE and other.type in _ONE_BYTE:  # a ``byte`` is signed in ROS 1, an octet in ROS 2
            if isinstance(value, memoryview):
                return value.cast("B").cast(CODES[target])  # type: ignore[call-overload]
            return _bits(value, 8) if CODES[target] == "b" else value & 0xFF
        if isinstance(value, memoryview):
            return self._value(field, other, value.tolist(), to_ros1=to_ros1)
        return bool(value) if target == "bool" else value + 0  # a bool is no number to the codec


def name2_of(name: str, fields2: Iterable[str]) -> str:
    """ROS 2's name of a field of ROS 1."""
    return name if name in fields2 else snake_case(name)


def _parts_of(field: Field, fields_of: FieldsOf, *, in1: bool = True, in2: bool = True) -> tuple[LayoutPart, ...]:
    """The parts of a field of one side, and whether both sides have it."""
    bound, text = (field.bound, field.text) if isinstance(field, Ros2Field) else (0, 0)
    if field.type == "string":
        parts: tuple[LayoutPart, ...] = (LayoutPart(in1=in1, in2=in2, bound=text, name=field.name),)
    elif field.type in TIMES:
        parts = (LayoutPart(4, 2, in1=in1, in2=in2),)
    elif field.primitive:
        parts = (LayoutPart(SIZES[field.type], in1=in1, in2=in2),)
    else:
        parts = tuple(part for each in fields_of(field.type) for part in _parts_of(each, fields_of, in1=in1, in2=in2))
    return (_array(parts, field.size, bound, field.name, in1=in1, in2=in2),) if field.array else parts


def _array(
    parts: tuple[LayoutPart, ...], size: int | None, bound: int, name: str, *, in1: bool = True, in2: bool = True
) -> LayoutPart:
    """An array; one of a fixed number of numbers is numbers, so that it is copied with its neighbours."""
    if size is not None and len(parts) == 1 and parts[0].size:
        count = 1 if parts[0].count is None else parts[0].count
        return LayoutPart(parts[0].size, count * size, in1=parts[0].in1, in2=parts[0].in2)
    return LayoutPart(0, size, parts, in1, in2, bound, name)


def _field_at(name: str, path: str, fields_of: Any) -> Any:
    """The field at a path."""
    root, found = name, None
    for part in path.split("."):
        inside = fields_of(name) if found is None or not (found.primitive or found.array) else ()
        found = next((field for field in inside if field.name == part), None)
        if found is None:
            raise NoConversion(f"{root} has no field {path}")
        name = found.type
    return found


def _bits(number: int, bits: int) -> int:
    """The signed number of the same bits."""
    number &= (1 << bits) - 1
    return number - (1 << bits) if number >> bits - 1 else number
