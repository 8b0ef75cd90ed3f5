"""Values as ROS 1's bytes: sizes, layout and bounds of a type.

Sizes of ROS types on the wire, their ``struct`` codes, and the bounds of a type.

ROS 1 is little-endian and unpadded (wiki.ros.org/msg). ``byte`` is an int8 and ``char`` an uint8, as in genpy.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from cbor2 import CBORTag

from rmpa.ros.types.definitions import DefinitionError
from rmpa.ros.types.messages import MessageError
from rmpa.web import limits

if TYPE_CHECKING:
    from rmpa.ros.types.definitions import Field, Specification

CODES: Final = {
    "bool": "?",
    "int8": "b",
    "byte": "b",
    "uint8": "B",
    "char": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
SIZES: Final = {"?": 1, "b": 1, "B": 1, "h": 2, "H": 2, "i": 4, "I": 4, "q": 8, "Q": 8, "f": 4, "d": 8}
TIMES: Final = {"time": "II", "duration": "ii"}
BYTES: Final = ("uint8", "char")
"""Types whose arrays are base64 in JSON and byte strings in CBOR."""
CBOR_TAGS: Final = {"H": 69, "I": 70, "Q": 71, "b": 72, "h": 77, "i": 78, "q": 79, "f": 85, "d": 86}
"""Little-endian typed arrays (RFC 8746), by ``struct`` code."""
HEADER: Final = "std_msgs/Header"


class Layout:
    """Sizes of a type and of all that it embeds.

    Args:
        name: The type.
        known: The type and all that it embeds; no type contains itself.

    Raises:
        DefinitionError: A message without elements would already have too many values or bytes.
    """

    def __init__(self, name: str, known: Mapping[str, Specification]) -> None:
        self.name = name
        self.known = known
        self._values: dict[str, int] = {}
        self._sizes: dict[str, int] = {}
        if self.values(name) > limits.TYPE_VALUES_MAX or self.size(name) > limits.TYPE_SIZE_MAX:
            problem = f"has {self.values(name)} values and {self.size(name)} bytes at least"
            remedy = f"up to {limits.TYPE_VALUES_MAX} values and {limits.TYPE_SIZE_MAX} bytes are converted"
            raise DefinitionError(name, problem, f"{remedy}; subscribe with cbor-raw")

    def fields(self, name: str) -> tuple[Field, ...]:
        """The fields of a type."""
        return self.known[name].fields

    def values(self, name: str) -> int:
        """Values of a message whose arrays of any length are empty, itself included."""
        if name not in self._values:
            self._values[name] = 1 + sum(map(self._field_values, self.fields(name)))
        return self._values[name]

    def size(self, name: str) -> int:
        """Bytes of the smallest message: all zero, and the default."""
        if name not in self._sizes:
            self._sizes[name] = sum(map(self.field_size, self.fields(name)))
        return self._sizes[name]

    def field_size(self, field: Field) -> int:
        """Bytes of the field's default."""
        if field.array and field.size is None:
            return 4
        return self.item_size(field.type) * (1 if field.size is None else field.size)

    def item_size(self, kind: str) -> int:
        """Bytes of the default of a type, which may be a primitive."""
        if kind == "string":
            return 4
        if kind in TIMES:
            return 8
        return SIZES[CODES[kind]] if kind in CODES else self.size(kind)

    def is_flat(self, name: str) -> bool:
        """Whether a message is a few numbers only, without arrays and strings."""
        size = self.size(name)
        return size > 0 and self.values(name) <= limits.INLINE_MAX and all(map(self._flat_field, self.fields(name)))

    def _flat_field(self, field: Field) -> bool:
        if field.array or field.type == "string":
            return False
        return field.primitive or self.is_flat(field.type)

    def _field_values(self, field: Field) -> int:
        if field.primitive or (field.array and field.size is None):
            return 1
        return self.values(field.type) * (1 if field.size is None else field.size)


# Writes values of JSON or CBOR as ROS 1 bytes, by closures that are made for each type.
#
# Fields that are not given are zero, false or empty. A header's stamp that is not given is the present time.


_NANO: Final = 1_000_000_000
_TAG_CODES: Final = {tag: code for code, tag in CBOR_TAGS.items()} | {64: "B"}
_STAMP: Final = struct.Struct("<IIII")
_LENGTH: Final = struct.Struct("<I")
_KEYS: Final = {"secs": 0, "nsecs": 1, "sec": 0, "nanosec": 1}


@dataclass(slots=True)
class Writing:
    """The message that is being written.

    Args:
        now_ns: The present time in nanoseconds, for headers and ``"now"``.
    """

    now_ns: int
    out: bytearray = dataclass_field(default_factory=bytearray)
    missing: list[str] = dataclass_field(default_factory=list)
    """The first fields that were not given."""

    @property
    def now(self) -> tuple[int, int]:
        """Seconds and nanoseconds."""
        return divmod(self.now_ns, _NANO)


class WrongValueError(Exception):
    """A value does not fit; each level around it puts its field's name in front of `path`."""

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.path: list[str] = []

    def __str__(self) -> str:
        where = ".".join(reversed(self.path)).replace(".[", "[")
        return f"{where}: {self.args[0]}" if where else str(self.args[0])


Write: TypeAlias = Callable[[Any, Writing], None]


def compile_writer(layout: Layout) -> Callable[[Any, int], Writing]:
    """Make the function that writes messages of a type from a mapping of fields.

    Its second argument is the present time in nanoseconds. It raises `MessageError` for a value that does not fit.
    """
    write = _Compiler(layout).message(layout.name, top=True)

    def convert(values: Any, now_ns: int) -> Writing:
        writing = Writing(now_ns)
        try:
            write(values, writing)
        except WrongValueError as error:
            raise MessageError(f"{layout.name}: {error}") from None
        return writing

    return convert


class _Compiler:
    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._made: dict[str, Write] = {}

    def message(self, name: str, *, top: bool = False) -> Write:
        """The closure of a message type; `top` fills in a header that is not given."""
        if top:
            return self._message(name, top=True)
        if name not in self._made:
            self._made[name] = self._message(name, top=False)
        return self._made[name]

    def _message(self, name: str, *, top: bool) -> Write:
        layout = self._layout
        fields = [(each.name, self._field(each), layout.field_size(each)) for each in layout.fields(name)]
        headers = frozenset(
            each.name for each in layout.fields(name) if top and each.type == HEADER and not each.array
        )
        known = frozenset(label for label, _, _ in fields)
        is_header = name == HEADER
        size_of_all = layout.size(name)

        def write(values: Any, writing: Writing) -> None:
            if not isinstance(values, Mapping):
                raise WrongValueError(f"is a {name} (an object), not {shown(values)}")
            if not values and not headers and not is_header:
                _default(writing, size_of_all, [label for label, _, _ in fields] if not writing.missing else [])
                return
            if not known.issuperset(values):
                unknown = next(key for key in values if key not in known)
                has = ", ".join(label for label, _, _ in fields) or "none"
                raise WrongValueError(f"{name} has no field {shown(unknown)}; it has {has}")
            for label, write_field, size in fields:
                if label in values:
                    try:
                        write_field(values[label], writing)
                    except WrongValueError as error:
                        error.path.append(label)
                        raise
                elif label in headers:
                    writing.out += _STAMP.pack(0, *_unsigned(writing.now), 0)
                elif is_header and label == "stamp":
                    writing.out += _STAMP.pack(0, *_unsigned(writing.now), 0)[4:12]
                else:
                    writing.out += bytes(size)
                    if not is_header and len(writing.missing) < limits.MISSING_NAMED:
                        writing.missing.append(label)
            if len(writing.out) > limits.WRITTEN_MAX:
                raise WrongValueError(f"the message is longer than {limits.WRITTEN_MAX} bytes")

        return write

    def _field(self, field: Field) -> Write:
        if not field.array:
            return self._scalar(field.type)
        if field.type in BYTES:
            return _byte_array(field)
        if field.type in CODES:
            return _number_array(field)
        item = self._scalar(field.type)

        def write(values: Any, writing: Writing) -> None:
            _count(field, len(_list(field, values)), writing)
            for index, value in enumerate(values):
                try:
                    item(value, writing)
                except WrongValueError as error:
                    error.path.append(f"[{index}]")
                    raise

        return write

    def _scalar(self, kind: str) -> Write:
        if kind == "string":
            return _text
        if kind in TIMES:
            return _time(kind)
        if kind in CODES:
            return _number(kind)
        return self.message(kind)


def shown(value: object) -> str:
    """A wrong value for an error, shortened; never the whole of a large one."""
    if isinstance(value, Mapping):
        return f"an object of {len(value)} fields"
    if isinstance(value, list | tuple):
        return f"a list of {len(value)}"
    if isinstance(value, bytes | bytearray | memoryview):
        return f"{len(value)} bytes"
    if isinstance(value, int) and value.bit_length() > 256:  # str() of a huge one is slow or refused
        return f"an integer of {value.bit_length()} bits"
    if isinstance(value, str):
        cut = value[: limits.SHOWN].encode("utf-8", "backslashreplace").decode()
        return repr(cut) if len(value) <= limits.SHOWN else f"{cut!r}…"
    return type(value).__name__ if isinstance(value, CBORTag) else repr(value)[: limits.SHOWN]


def _default(writing: Writing, size: int, missing: list[str]) -> None:
    """Write a message of which no field is given."""
    writing.out += bytes(size)
    writing.missing += missing[: limits.MISSING_NAMED]
    if len(writing.out) > limits.WRITTEN_MAX:
        raise WrongValueError(f"the message is longer than {limits.WRITTEN_MAX} bytes")


def _unsigned(now: tuple[int, int]) -> tuple[int, int]:
    return max(0, min(now[0], 0xFFFFFFFF)), now[1]


def _list(field: Field, values: Any) -> Sequence[Any]:
    if not isinstance(values, list | tuple):
        raise WrongValueError(f"is a list ({field}), not {shown(values)}")
    return values


def _count(field: Field, count: int, writing: Writing) -> None:
    if field.size is not None and count != field.size:
        raise WrongValueError(f"has {field.size} elements ({field}), not {count}")
    if field.size is None:
        writing.out += _LENGTH.pack(count)


def _text(value: Any, writing: Writing) -> None:
    if not isinstance(value, str):
        raise WrongValueError(f"is a string, not {shown(value)}")
    try:
        raw = value.encode()
    except UnicodeEncodeError:
        raise WrongValueError("has half of a surrogate pair, which is no character") from None
    writing.out += _LENGTH.pack(len(raw))
    writing.out += raw
    if len(writing.out) > limits.WRITTEN_MAX:
        raise WrongValueError(f"the message is longer than {limits.WRITTEN_MAX} bytes")


def _time(kind: str) -> Write:
    pack = struct.Struct(f"<{TIMES[kind]}").pack

    def write(value: Any, writing: Writing) -> None:
        if value == "now" and kind == "time":
            writing.out += pack(*_unsigned(writing.now))
            return
        if not isinstance(value, Mapping) or not value.keys() <= _KEYS.keys():
            raise WrongValueError(f"is a {kind} ({{secs, nsecs}}), not {shown(value)}")
        parts = [0, 0]
        for key, part in value.items():
            parts[_KEYS[key]] = _integer(part, kind)
        try:
            writing.out += pack(*parts)
        except struct.error:
            raise WrongValueError(f"does not fit a {kind}: {shown(parts[0])} s, {shown(parts[1])} ns") from None

    return write


def _integer(value: Any, kind: str) -> int:
    if isinstance(value, float) and value.is_integer():
        return int(value)  # some languages write 3.0 for 3
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    raise WrongValueError(f"is a {kind}, not {shown(value)}")


def _convert(kind: str, code: str) -> Callable[[Any], bool | int | float]:
    """Check one number, for what ``struct`` does not take or takes too gladly."""

    def boolean(value: Any) -> bool:
        if isinstance(value, bool) or (isinstance(value, int) and value in (0, 1)):
            return bool(value)
        raise WrongValueError(f"is a bool, not {shown(value)}")

    def real(value: Any) -> float:
        if value is None:
            return float("nan")  # JSON has no NaN; null is what is sent for it
        if isinstance(value, int | float) and not isinstance(value, bool):
            try:
                return float(value)
            except OverflowError:
                pass
        raise WrongValueError(f"is a {kind}, not {shown(value)}")

    def whole(value: Any) -> int:
        return _integer(value, kind)

    return boolean if code == "?" else real if code in "fd" else whole


def _number(kind: str) -> Write:
    code = CODES[kind]
    pack, convert = struct.Struct(f"<{code}").pack, _convert(kind, code)

    def write(value: Any, writing: Writing) -> None:
        try:
            writing.out += pack(convert(value))
        except (struct.error, OverflowError):
            raise WrongValueError(f"does not fit {kind}: {shown(value)}") from None

    return write


def _number_array(field: Field) -> Write:
    code = CODES[field.type]
    one = _number(field.type)

    def write(values: Any, writing: Writing) -> None:
        values = _untagged(values, code)
        if isinstance(values, bytes):
            _count(field, len(values) // SIZES[code], writing)
            writing.out += values
            return
        _count(field, len(_list(field, values)), writing)
        # struct takes True for 1 and 2 for True; those lists are few, and go the slow way.
        if code != "?" and bool not in set(map(type, values)):
            try:
                writing.out += struct.pack(f"<{len(values)}{code}", *values)
            except (struct.error, OverflowError):
                pass
            else:
                return
        for index, value in enumerate(values):
            try:
                one(value, writing)
            except WrongValueError as error:
                error.path.append(f"[{index}]")
                raise

    return write


def _untagged(values: Any, code: str) -> Any:
    """A typed array as bytes where its element type is `code`, else as a list; other values as they are."""
    if not isinstance(values, CBORTag):
        return values
    given = _TAG_CODES.get(values.tag) if isinstance(values.tag, int) else None  # type: ignore[redundant-expr] # cbor2 may say a str
    raw = values.value
    if given is None or not isinstance(raw, bytes) or len(raw) % SIZES[given]:
        raise WrongValueError("is a typed array of little-endian numbers (RFC 8746), not another tag")
    return raw if given == code else list(struct.unpack(f"<{len(raw) // SIZES[given]}{given}", raw))


def _byte_array(field: Field) -> Write:
    def write(values: Any, writing: Writing) -> None:
        values = _untagged(values, "B")
        if isinstance(values, str):
            try:
                raw = binascii.a2b_base64(values, strict_mode=True)
            except ValueError:
                raise WrongValueError(f"is base64 ({field}), not {shown(values)}") from None
        elif isinstance(values, bytes | bytearray | memoryview):
            raw = bytes(values)
        else:
            try:
                raw = bytes([_integer(value, field.type) for value in _list(field, values)])
            except ValueError:
                raise WrongValueError(f"has a number that does not fit {field.type} (0 to 255)") from None
        _count(field, len(raw), writing)
        writing.out += raw
        if len(writing.out) > limits.WRITTEN_MAX:
            raise WrongValueError(f"the message is longer than {limits.WRITTEN_MAX} bytes")

    return write
