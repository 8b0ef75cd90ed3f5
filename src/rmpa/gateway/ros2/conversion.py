"""Conversion of messages between ROS 1's bytes and CDR, for each pair of types and for actions.

An action type of ROS 1 and its counterpart in ROS 2: the types that rosidl makes of it, and their conversions.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys.base import normalize_fieldname

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway.ros2.transcoder import Items, Number, Part, Side, Text, Transcoder, on_side
from rmpa.gateway.ros2.types import check_ros1_size, ros2_name, snake_case
from rmpa.ros.types.definitions import Specification
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rmpa.gateway.ros2.mapping import ActionRule, FieldPaths
    from rmpa.gateway.ros2.types import Ros2Types
    from rmpa.ros.types.definitions import Field
    from rmpa.ros.wire.tcpros import Buffer


# The layout of a pair of types: what their messages are made of, in order, for the transcoder.


HEADER: Final = "std_msgs/msg/Header"
TIMES: Final = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}
"""ROS 1's primitive times, and the messages of ROS 2 that have the same 8 bytes."""
_TIME_LAYOUT: Final = Number(4, 2)
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
            return (Number(4, side=Side.ROS1), _TIME_LAYOUT, Text())  # seq, stamp, frame_id
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
                return (_TIME_LAYOUT,) if TIMES.get(field.type) == desc[1] else None
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
            number = _TIME_LAYOUT if field.type in TIMES else Number(_SIZES.get(field.type, 0))
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


# Conversion of messages between ROS 1's serialization and ROS 2's CDR.
#
# Where the fields that both types have are in one order and of one size, the bytes are converted without making
# objects (``transcoder``). Else each field goes to the one of the same name, or as a mapping file says; numbers are
# checked for their range. A field that only one side has, as ``seq`` of a header, is 0 or empty there. As in
# ros1_bridge, two types of which *each* has fields that the other lacks are no pair: a rule must say what goes
# where.


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


PART: Final = "/_action/"
"""Stands between an action's name and those of its services and topics in ROS 2."""
CANCEL_TYPE: Final = "action_msgs/srv/CancelGoal"
STATUS_TYPE: Final = "action_msgs/msg/GoalStatusArray"
_UUID: Final = ("goal_id", (Nodetype.NAME, "unique_identifier_msgs/msg/UUID"))
_TIME: Final = ("stamp", (Nodetype.NAME, "builtin_interfaces/msg/Time"))
_INFO: Final = (Nodetype.NAME, "action_msgs/msg/GoalInfo")


class ActionPair:
    """Converts goals, results and feedback of one action type.

    Args:
        kinds: ROS 1's goal, result and feedback, without their wrapping.
        rule: Its counterpart, ``package/action/Name``, and the fields if a mapping file lists them.
        types: ROS 2's types; the action's are learnt from ROS 1's fields if they are not known.

    Raises:
        NoConversion: The types are no pair.
    """

    def __init__(self, kinds: Sequence[MessageType], rule: ActionRule, types: Ros2Types) -> None:
        goal, result, feedback = kinds
        self.name: Final = rule.name
        """``package/action/Name`` of ROS 2."""
        self.ros1: Final = goal.name.removesuffix("Goal")
        """``package/Name`` of ROS 1."""
        if rule.has_fields and f"{rule.name}_Goal" not in types:
            raise NoConversion(
                f"the rule of {self.ros1} maps fields to {rule.name}, whose definition is not known here"
            )
        for part, kind in zip(("Goal", "Result", "Feedback"), kinds, strict=True):
            types.learn({name: each for name, each in kind.specifications.items() if name != kind.name})
            types.define_as(f"{rule.name}_{part}", kind.specifications[kind.name])
        self.types: Final = _define(rule.name, types)
        """The type of each service and topic in ROS 2, and its hash."""
        self.goal: Final = Conversion(goal, f"{rule.name}_Goal", types, rule.goal)
        """Converts goals, without the id."""
        self.feedback: Final = Conversion(feedback, f"{rule.name}_Feedback", types, rule.feedback)
        """Converts feedback, without the id."""
        self.result: Final = result
        """ROS 1's result."""
        wrapped = f"{self.ros1}GetResultResponse"
        both = Specification.parse(wrapped, f"int8 status\n{result.name} result\n")
        paths = rule.result and {"status": "status", **{f"result.{a}": f"result.{b}" for a, b in rule.result.items()}}
        known = {**result.specifications, wrapped: both}
        self._result = Conversion(MessageType(wrapped, known), f"{rule.name}_GetResult_Response", types, paths)
        self.no_result: Final = result.serialize(result.make(None))
        """A result of ROS 1 without values, for goals that have none."""

    def result_to_ros2(self, status: int, result: bytes) -> bytes:
        """``GetResult_Response``.

        Raises:
            ConversionError: The result does not fit ROS 2's type.
        """
        return self._result.to_ros2(bytes((status,)) + result)

    def result_to_ros1(self, raw: bytes) -> tuple[int, bytes]:
        """Status and result of a ``GetResult_Response``.

        Raises:
            ConversionError: The bytes are no such response.
        """
        made = self._result.to_ros1(raw)
        return made[0], made[1:]


def _define(name: str, types: Ros2Types) -> dict[str, tuple[str, str]]:
    """Define the types of one action of ROS 2, as rosidl_parser does."""
    own: dict[str, Any] = {part: (Nodetype.NAME, f"{name}_{part}") for part in ("Goal", "Result", "Feedback")}
    number = (Nodetype.BASE, ("int8", 0))
    sent = [("accepted", (Nodetype.BASE, ("bool", 0))), _TIME]
    types.define_service(f"{name}_SendGoal", [_UUID, ("goal", own["Goal"])], sent)
    types.define_service(f"{name}_GetResult", [_UUID], [("status", number), ("result", own["Result"])])
    types.define(f"{name}_FeedbackMessage", [_UUID, ("feedback", own["Feedback"])])
    cancelled = [("return_code", number), ("goals_canceling", (Nodetype.SEQUENCE, (_INFO, 0)))]
    types.define_service(CANCEL_TYPE, [("goal_info", _INFO)], cancelled)
    kinds = {
        "send_goal": f"{name}_SendGoal",
        "get_result": f"{name}_GetResult",
        "cancel_goal": CANCEL_TYPE,
        "feedback": f"{name}_FeedbackMessage",
        "status": STATUS_TYPE,
    }
    return {part: (kind, types.type_hash(kind)) for part, kind in kinds.items()}


def action_name(type_name: str, part: str) -> str:
    """``package/Name`` of the action that has a topic of this type of ROS 1; empty for none."""
    return type_name.removesuffix(part) if type_name.endswith(part) and not type_name.endswith(f"/{part}") else ""
