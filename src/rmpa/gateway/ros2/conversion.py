"""Conversion of messages between ROS 1's serialization and ROS 2's CDR.

Where the fields that both types have are in one order and of one size, the bytes are converted without making
objects (``transcoder``). Else each field goes to the one of the same name, or as a mapping file says; numbers are
checked for their range. A field that only one side has, as ``seq`` of a header, is 0 or empty there. As in
ros1_bridge, two types of which *each* has fields that the other lacks are no pair: a rule must say what goes where.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys.base import normalize_fieldname

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway.ros2.layout import HEADER, TIMES, Layouts, name2_of
from rmpa.gateway.ros2.transcoder import Transcoder
from rmpa.gateway.ros2.type_size import check_ros1_size
from rmpa.gateway.ros2.types import ros2_name, snake_case

if TYPE_CHECKING:
    from rmpa.gateway.ros2.mapping import FieldPaths
    from rmpa.gateway.ros2.types import Ros2Types
    from rmpa.ros.types.definitions import Field
    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.wire.tcpros import Buffer

_EMPTY_MEMBER: Final = "structure_needs_at_least_one_member"
_UNSIGNED: Final = ("uint8", "char")
_LITTLE_ENDIAN: Final = b"\x00\x01"


class NoConversion(RmpaError):  # noqa: N818 - the name says what happened
    """Two types are no pair; the text says which fields, and what to write."""


class ConversionError(RmpaError):
    """A message does not fit the other side's type."""


class Conversion:
    """Converts messages of one pair of types.

    Args:
        ros1: The type of ROS 1.
        ros2: ``package/msg/Name`` of ROS 2.
        types: ROS 2's types, which know it.
        fields: The fields by path, if a mapping file lists them.

    Raises:
        NoConversion: The types are no pair.
    """

    def __init__(self, ros1: MessageType, ros2: str, types: Ros2Types, fields: FieldPaths | None = None) -> None:
        self.ros1 = ros1
        self.ros2 = ros2
        self._store = types.store
        self._fields = fields
        try:
            check_ros1_size(ros1.name, ros1.specifications)
        except RemoteProtocolError as error:
            raise NoConversion(str(error)) from error
        if fields is None:
            self._check_fields(ros1.name, ros2)
        else:
            self._check_paths(fields)
        layouts = Layouts(ros1.specifications, self._store.fielddefs)
        parts = layouts.of(ros1.name, ros2) if fields is None else None
        try:
            self._transcoder = Transcoder(parts) if parts is not None else None
        except ValueError as error:
            raise NoConversion(f"{ros1.name} and {ros2} cannot be converted: {error}") from error

    @property
    def direct(self) -> bool:
        """Whether the bytes are converted without making objects."""
        return self._transcoder is not None

    def to_ros2(self, raw: Buffer) -> bytes:
        """Convert a serialized message of ROS 1, without a length in front, to CDR (little-endian, with its head).

        Raises:
            ConversionError: The bytes are not such a message, or a value does not fit ROS 2's type.
        """
        try:
            if self._transcoder is not None:
                return self._transcoder.to_cdr(raw)
            message = self.ros1.deserialize(raw)
            if self._fields is None:
                made = self._make(self.ros1.name, self.ros2, message)
            else:
                made = self._zero(self.ros2)
                for path1, path2 in self._fields.items():
                    self._set(made, path2, self._convert_path(message, path1, path2))
            return bytes(self._store.serialize_cdr(made, self.ros2))
        except _ERRORS as error:
            raise ConversionError(f"cannot convert a {self.ros1.name} to {self.ros2}: {error}") from error

    def to_ros1(self, raw: Buffer) -> bytes:
        """Convert CDR with its head to a serialized message of ROS 1, without a length in front; ``seq`` is 0.

        Raises:
            ConversionError: The bytes are not such a message, or a value does not fit ROS 1's type.
        """
        try:
            if self._transcoder is not None and bytes(raw[:2]) == _LITTLE_ENDIAN:
                return self._transcoder.to_ros1(raw)
            message = self._store.deserialize_cdr(bytes(raw), self.ros2)
            if self._fields is None:
                values = self._values(self.ros1.name, self.ros2, message)
            else:
                values = {}
                for path1, path2 in self._fields.items():
                    self._put(values, path1, self._value_of_path(message, path1, path2))
            return self.ros1.serialize(self.ros1.make(values))
        except _ERRORS as error:
            raise ConversionError(f"cannot convert a {self.ros2} to {self.ros1.name}: {error}") from error

    # --- whether two types are a pair --------------------------------------------------------------------------

    def _ros1_fields(self, name: str) -> tuple[Field, ...]:
        return self.ros1.specifications[name].fields

    def _ros2_fields(self, name: str) -> dict[str, Any]:
        return {key: desc for key, desc in self._store.fielddefs[name][1] if key != _EMPTY_MEMBER}

    def _check_fields(self, ros1: str, ros2: str) -> None:
        """Check that the fields of one type are all in the other, at any depth."""
        fields2 = self._ros2_fields(ros2)
        ones = {name2_of(field.name, fields2): field for field in self._ros1_fields(ros1)}
        if ros2_name(ros1) == HEADER:
            ones.pop("seq", None)
        only1, only2 = sorted(ones.keys() - fields2.keys()), sorted(fields2.keys() - ones.keys())
        if only1 and only2:
            raise NoConversion(
                f"{ros1} has {', '.join(only1)}, and {ros2} has {', '.join(only2)} instead: write fields_1_to_2 in a "
                "mapping file"
            )
        for name in ones.keys() & fields2.keys():
            self._check_field(ones[name], fields2[name], f"{ros1} and {ros2}: {name}")

    def _check_field(self, field: Field, desc: Any, where: str) -> None:
        inner = desc
        if (desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)) != field.array:
            raise NoConversion(f"{where} is an array on one side only")
        if field.array:
            inner = desc[1][0]
            if desc[0] == Nodetype.ARRAY and field.size != desc[1][1]:
                raise NoConversion(
                    f"{where} has {'any number of' if field.size is None else field.size} elements, or {desc[1][1]}"
                )
        if inner[0] == Nodetype.NAME:
            if field.primitive and TIMES.get(field.type) != inner[1]:
                raise NoConversion(f"{where} is a {field.type}, or a {inner[1]}")
            if not field.primitive:
                self._check_fields(field.type, inner[1])
        elif not field.primitive or field.type in TIMES or (field.type == "string") != (inner[1][0] == "string"):
            raise NoConversion(f"{where} is a {field.type}, or a {inner[1][0]}")

    def _check_paths(self, fields: FieldPaths) -> None:
        for path1, path2 in fields.items():
            field, desc = self._field1(path1), self._desc2(path2)
            self._check_field(field, desc, f"{self.ros1.name}.{path1} and {self.ros2}.{path2}")

    def _field1(self, path: str) -> Field:
        """The field of ROS 1 at a path."""
        name, found = self.ros1.name, None
        for part in path.split("."):
            inside = self._ros1_fields(name) if found is None or not (found.primitive or found.array) else ()
            found = next((field for field in inside if field.name == part), None)
            if found is None:
                raise NoConversion(f"{self.ros1.name} has no field {path}")
            name = found.type
        if found is None:
            raise NoConversion(f"{self.ros1.name} has no field {path!r}")
        return found

    def _desc2(self, path: str) -> Any:
        """The field of ROS 2 at a path."""
        desc: Any = (Nodetype.NAME, self.ros2)
        for part in path.split("."):
            fields = self._ros2_fields(desc[1]) if desc[0] == Nodetype.NAME else {}
            if part not in fields:
                raise NoConversion(f"{self.ros2} has no field {path}")
            desc = fields[part]
        return desc

    # --- ROS 1 to ROS 2 ------------------------------------------------------------------------------------------

    def _make(self, ros1: str, ros2: str, message: Any) -> Any:
        """Make ROS 2's object of a ROS 1 object."""
        made: dict[str, Any] = {}
        ones = {snake_case(field.name): field for field in self._ros1_fields(ros1)}
        ones.update((field.name, field) for field in self._ros1_fields(ros1))
        for name, desc in self._store.fielddefs[ros2][1]:
            field = ones.get(name)
            if field is None:
                made[normalize_fieldname(name)] = self._zero_of(desc)
            else:
                value = getattr(message, normalize_fieldname(field.name))
                made[normalize_fieldname(name)] = self._value2(field, desc, value, name)
        return self._store.types[ros2](**made)

    def _value2(self, field: Field, desc: Any, value: Any, where: str) -> Any:
        if not field.array:
            return self._scalar2(field, desc, value, where)
        inner, count = desc[1]
        if desc[0] == Nodetype.SEQUENCE and count and len(value) > count:
            raise ConversionError(f"{where} has {len(value)} elements; ROS 2 allows {count}")
        if field.type == "byte" and inner[1][0] != "int8":
            value = value.view("uint8")
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            return _as_array(value, inner[1][0], where)
        return [self._scalar2(field, inner, item, where) for item in value]

    def _scalar2(self, field: Field, desc: Any, value: Any, where: str) -> Any:
        if desc[0] == Nodetype.NAME:
            if field.primitive:  # a time
                return self._store.types[desc[1]](sec=_signed(value.sec), nanosec=value.nanosec)
            if ros2_name(field.type) == desc[1] == HEADER:
                stamp = self._store.types[TIMES["time"]](_signed(value.stamp.sec), value.stamp.nanosec)
                return self._store.types[HEADER](stamp=stamp, frame_id=value.frame_id)
            return self._make(field.type, desc[1], value)
        base, bound = desc[1]
        if base == "string":
            if bound and len(value.encode()) > bound:
                raise ConversionError(f"{where} has {len(value.encode())} bytes; ROS 2 allows {bound}")
            return value
        if field.type == "byte" and base in _UNSIGNED:  # signed in ROS 1 (wiki.ros.org/msg), an octet in ROS 2
            value &= 0xFF
        return _as_number(value, base, where)

    def _convert_path(self, message: Any, path1: str, path2: str) -> Any:
        value = message
        for part in path1.split("."):
            value = getattr(value, normalize_fieldname(part))
        return self._value2(self._field1(path1), self._desc2(path2), value, path2)

    def _set(self, message: Any, path: str, value: Any) -> None:
        *parents, last = path.split(".")
        for part in parents:
            message = getattr(message, normalize_fieldname(part))
        object.__setattr__(message, normalize_fieldname(last), value)  # rosbags' dataclasses may be frozen

    def _zero(self, ros2: str) -> Any:
        fields = self._store.fielddefs[ros2][1]
        return self._store.types[ros2](**{normalize_fieldname(name): self._zero_of(desc) for name, desc in fields})

    def _zero_of(self, desc: Any) -> Any:
        if desc[0] == Nodetype.NAME:
            return self._zero(desc[1])
        if desc[0] == Nodetype.BASE:
            return "" if desc[1][0] == "string" else _as_number(0, desc[1][0], "")
        inner, count = desc[1]
        count = count if desc[0] == Nodetype.ARRAY else 0
        if inner[0] == Nodetype.BASE and inner[1][0] != "string":
            return _as_array([0] * count, inner[1][0], "")
        return [self._zero_of(inner) for _ in range(count)]

    # --- ROS 2 to ROS 1 ------------------------------------------------------------------------------------------

    def _values(self, ros1: str, ros2: str, message: Any) -> dict[str, Any]:
        """Make values for ROS 1's object, by ROS 1's names of the fields."""
        fields2 = self._ros2_fields(ros2)
        values = {}
        for field in self._ros1_fields(ros1):
            name = name2_of(field.name, fields2)
            if name in fields2:
                value = getattr(message, normalize_fieldname(name))
                values[field.name] = self._value1(field, fields2[name], value)
        return values

    def _value1(self, field: Field, desc: Any, value: Any) -> Any:
        if not field.array:
            return self._scalar1(field, desc, value)
        if desc[1][0][0] == Nodetype.BASE:
            return value.view("int8") if field.type == "byte" and value.dtype == "uint8" else value
        return [self._scalar1(field, desc[1][0], item) for item in value]

    def _scalar1(self, field: Field, desc: Any, value: Any) -> Any:
        if desc[0] != Nodetype.NAME:
            if field.type == "byte":
                return value - 256 if value > 127 else value
            return value & 0xFF if desc[1][0] == "byte" and field.type in _UNSIGNED else value
        if not field.primitive:
            return self._values(field.type, desc[1], value)
        sec = int(value.sec)
        return {"secs": sec & 0xFFFFFFFF if field.type == "time" else sec, "nsecs": int(value.nanosec)}

    def _value_of_path(self, message: Any, path1: str, path2: str) -> Any:
        value = message
        for part in path2.split("."):
            value = getattr(value, normalize_fieldname(part))
        return self._value1(self._field1(path1), self._desc2(path2), value)

    @staticmethod
    def _put(values: dict[str, Any], path: str, value: Any) -> None:
        *parents, last = path.split(".")
        for part in parents:
            values = values.setdefault(part, {})
        values[last] = value


def _signed(seconds: int) -> int:
    """ROS 1's unsigned seconds of a time as ROS 2's signed ones: the same 32 bits."""
    return int(seconds) - (1 << 32) if seconds >= 1 << 31 else int(seconds)


def _dtype(base: str) -> str:
    return {"octet": "uint8", "byte": "uint8", "char": "uint8", "bool": "bool"}.get(base, base)


def _as_array(values: Any, base: str, where: str) -> Any:
    import numpy as np  # noqa: PLC0415 - it takes 70 ms, and most types need no arrays

    wanted = np.dtype(_dtype(base))
    given = np.asarray(values)
    if given.dtype == wanted:
        return given
    if wanted.kind in "iu" and given.size:
        bounds = np.iinfo(wanted)
        if given.dtype.kind == "f" or given.min() < bounds.min or given.max() > bounds.max:
            raise ConversionError(f"{where}: {given.min()} to {given.max()} do not fit {base}")
    return given.astype(wanted)


def _as_number(value: Any, base: str, where: str) -> Any:
    if base == "bool":
        return bool(value)
    if base.startswith("float"):
        return float(value)
    import numpy as np  # noqa: PLC0415 - see above

    if base == "byte" and isinstance(value, int) and 127 < value < 256:
        value -= 256  # rosbags has one byte signed, and an array of them unsigned
    bounds = np.iinfo(np.dtype("int8" if base == "byte" else _dtype(base)))
    if not isinstance(value, int) or not bounds.min <= value <= bounds.max:
        raise ConversionError(f"{where}: {value} does not fit {base} ({bounds.min} to {bounds.max})")
    return int(value)


_ERRORS: Final = (
    SerdeError,
    RmpaError,
    struct.error,
    ValueError,
    KeyError,
    IndexError,
    AssertionError,
    OverflowError,
)
"""What rosbags raises for bytes that are not a message; it does not check everything itself."""
