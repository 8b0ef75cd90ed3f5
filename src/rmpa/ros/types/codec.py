"""Messages as values: ROS 1 bytes to dictionaries for JSON, CBOR and YAML, and back, compiled once for each type.

ROS 1 is little-endian and unpadded (wiki.ros.org/msg). ``byte`` is an int8 and ``char`` an uint8, as in genpy.

A reader is a function whose text is generated: runs of numbers are read in one step of ``struct``, and arrays of
numbers without a loop in Python. The text has only names of fields, which the definitions' parser has checked, and
numbers. A writer is made of closures: what it costs is checking the values.

rosbags, whose objects become dictionaries in a second step, takes 1.3 times (a laser scan) to 7.6 times (transforms)
as long.
"""

from __future__ import annotations

import functools
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import msgspec

from rmpa.core.limits import MIB
from rmpa.ros.types.definitions import DefinitionError, MessageError, parse_definition
from rmpa.ros.types.values import CODES, SIZES, TAGS, TIMES, Written, WrongValueError, encoded, shown

if TYPE_CHECKING:
    from rmpa.ros.types.definitions import DefinedType, Field, Specification

# Compiled types in the cache of the process; a module has some 50 types. The least recently used is dropped.
_CODECS_MAX: Final = 512
# Values that a message without elements in its arrays of any length has; a covariance has 36, a type rarely 200.
_TYPE_VALUES_MAX: Final = 100_000
# Bytes of the smallest message of a type: it has fixed arrays of this size together.
_TYPE_SIZE_MAX: Final = 16 * MIB
# Values read for each byte of a message: messages within arrays that have no bytes could be any number.
_VALUES_PER_BYTE: Final = 16
# Values that any message may have besides those for its bytes.
_VALUES_FREE: Final = 10_000
# Numbers of an embedded message that are read in one step with those around it.
_INLINE_MAX: Final = 64
# Fields that were not given and are named to the client.
_MISSING_NAMED: Final = 8

# Bytes of the default of each primitive.
_DEFAULTS: Final = {**SIZES, "string": 4, "time": 8, "duration": 8}
_HEADER: Final = "std_msgs/Header"
_SHORT: Final = "they end too early"
_LENGTH: Final = struct.Struct("<I")
_TIME_KEYS: Final = {"secs": 0, "nsecs": 1, "sec": 0, "nanosec": 1}

Values: TypeAlias = dict[str, Any]
# Reads a message. It raises ``MessageError`` for bytes that are not one; strings that are not UTF-8 have U+FFFD in
# place of the wrong bytes, since JSON and CBOR have text only.
Read: TypeAlias = Callable[[memoryview], Values]
_Write: TypeAlias = Callable[[Any, "Written"], None]


class _MalformedError(Exception):
    """Bytes are not a message; the text says why."""


class MessageCodec:
    """Converts messages of one type.

    Args:
        name: ``package/Name``.
        known: The type and all that it embeds, by name; no type contains itself.

    Raises:
        DefinitionError: The smallest message of the type is too large (``limits``).
    """

    def __init__(self, name: str, known: Mapping[str, Specification]) -> None:
        self.name = name
        self.known = known
        self._measures: dict[str, tuple[int, int, bool]] = {}
        self._writers: dict[str, _Write] = {}
        values, size, _ = self.measure(name)
        if values > _TYPE_VALUES_MAX or size > _TYPE_SIZE_MAX:
            problem = f"has {values} values and {size} bytes at least"
            remedy = f"up to {_TYPE_VALUES_MAX} values and {_TYPE_SIZE_MAX} bytes are converted"
            raise DefinitionError(name, problem, f"{remedy}; subscribe with cbor-raw")

    def measure(self, name: str) -> tuple[int, int, bool]:
        """Values and bytes of a message with empty arrays of any length; and whether it is a few numbers only."""
        if name not in self._measures:
            values, size, flat = 1, 0, True
            for field in self.known[name].fields:
                if field.array and field.size is None:
                    values, size, flat = values + 1, size + 4, False
                    continue
                primitive = (1, _DEFAULTS.get(field.type, 0), field.type != "string")
                inner = primitive if field.primitive else self.measure(field.type)
                count = 1 if field.size is None else field.size
                values += 1 if field.primitive else count * inner[0]
                size += count * inner[1]
                flat = flat and inner[2] and not field.array
            self._measures[name] = values, size, flat and size > 0 and values <= _INLINE_MAX
        return self._measures[name]

    def item_size(self, kind: str) -> int:
        """Bytes of the default of a type, which may be a primitive."""
        return _DEFAULTS[kind] if kind in _DEFAULTS else self.measure(kind)[1]

    @functools.cached_property
    def json_values(self) -> Read:
        """Makes values for msgspec, which writes NaN and infinity as null, and memoryviews (of uint8) in base64."""
        return self._reader(lambda view, code: view if code == "B" else _cast(view, code).tolist())

    def json(self, payload: memoryview) -> bytes:
        """The message as a JSON object.

        Raises:
            MessageError: The bytes are not a message of this type.
        """
        return msgspec.json.encode(self.json_values(payload))

    @functools.cached_property
    def cbor_values(self) -> Read:
        """Makes values for cbor2, with arrays of numbers as tagged bytes (RFC 8746)."""
        from cbor2 import CBORTag  # noqa: PLC0415 - of the extra "web"

        return self._reader(lambda view, code: bytes(view) if code == "B" else CBORTag(TAGS[code], bytes(view)))

    @functools.cached_property
    def plain_values(self) -> Read:
        """Makes values with lists in place of arrays."""
        return self._reader(lambda view, code: _cast(view, code).tolist())

    @functools.cached_property
    def views(self) -> Read:
        """Makes values whose arrays of numbers are memoryviews of the message."""
        return self._reader(_cast)

    def _reader(self, array: Callable[[memoryview, str], Any]) -> Read:
        names: dict[str, Any] = {"_slice": _slice, "_strings": _strings, "_charge": _charge, "_array": array}
        text = _ReaderText(self, names).text()
        exec(compile(text, f"<reader of {self.name}>", "exec"), names)  # noqa: S102 - see the module's docstring
        read = names["read_0"]
        spare = _VALUES_FREE + self.measure(self.name)[0]

        def convert(payload: memoryview) -> Values:
            size = len(payload)
            try:
                values: Values
                values, at = read(payload, 0, [spare + _VALUES_PER_BYTE * size])
                if at == size:
                    return values
                problem = f"{size - at} are left over"
            except struct.error:
                problem = _SHORT
            except _MalformedError as error:
                problem = str(error)
            raise MessageError(f"{size} bytes are not a {self.name}: {problem}")

        return convert

    def write(self, values: Any, now_ns: int) -> Written:
        """The message of a mapping of fields; those that are not given are zero, false or empty, and stamps now.

        Args:
            values: The fields. Arrays of numbers may also be lists, tagged bytes (RFC 8746), and those of uint8
                base64 or bytes.
            now_ns: The present time (UTC) in nanoseconds.

        Raises:
            MessageError: A field is unknown, or a value does not fit.
        """
        written = Written(now_ns)
        try:
            self.fill(values, written)
        except WrongValueError as error:
            raise MessageError(f"{self.name}: {error}") from None
        return written

    def write_arguments(self, values: Any, now_ns: int) -> Written:
        """As ``write``, also from a list of the fields in order; None is no arguments (rosbridge's ``args``)."""
        if isinstance(values, list | tuple):
            fields = self.known[self.name].fields
            if len(values) > len(fields):
                raise MessageError(f"{self.name}: has {len(fields)} fields, not {len(values)}")
            values = dict(zip((field.name for field in fields), values, strict=False))
        if values is not None and not isinstance(values, Mapping):
            raise MessageError(f"{self.name}: arguments are an object or a list, not {shown(values)}")
        return self.write(values or {}, now_ns)

    @functools.cached_property
    def fill(self) -> _Write:
        """Writes values; it raises ``WrongValueError``."""
        return self._message(self.name, top=True)

    def _message(self, name: str, *, top: bool = False) -> _Write:
        """The closure of a message type; ``top`` fills in a header that is not given."""
        specification = self.known[name]
        fields = [
            (each.name, self._field(each), self._default(each), self._filled(name, each, top=top))
            for each in specification.fields
        ]
        known = frozenset(label for label, *_ in fields)

        def write(values: Any, written: Written) -> None:
            if not isinstance(values, Mapping):
                values = written.fields(specification, values)
            if not known.issuperset(values):
                unknown = next(key for key in values if key not in known)
                has = ", ".join(label for label, *_ in fields) or "none"
                raise WrongValueError(f"{name} has no field {shown(unknown)}; it has {has}")
            label, absent = "", written.absent
            try:
                for label, write_field, default, filled in fields:
                    if label in values and (value := values[label]) is not absent:
                        write_field(value, written)
                    elif filled is not None and written.stamps:
                        write_field(filled, written)
                    else:
                        written.out += bytes(default)
                        if name != _HEADER and len(written.missing) < _MISSING_NAMED:
                            written.missing.append(label)
            except WrongValueError as error:
                error.path.append(label)
                raise
            if len(written.out) > written.size_max:
                raise WrongValueError(f"the message is longer than {written.size_max} bytes")

        return write

    def _default(self, field: Field) -> int:
        """Bytes of the field's default."""
        if field.array and field.size is None:
            return 4
        return self.item_size(field.type) * (1 if field.size is None else field.size)

    @staticmethod
    def _filled(name: str, field: Field, *, top: bool) -> Any:
        """What stands for a field that is not given, if not zero: a header with the present time."""
        if top and field.type == _HEADER and not field.array:
            return {}
        return "now" if name == _HEADER and field.name == "stamp" else None

    def _field(self, field: Field) -> _Write:
        if not field.array:
            return self._item(field.type)
        if field.type in CODES:
            return _numbers(field)
        item = self._item(field.type)

        def write(values: Any, written: Written) -> None:
            values = written.array(field, values)
            _count(field, len(values), written)
            _each(item, values, written)

        return write

    def _item(self, kind: str) -> _Write:
        if kind == "string":
            return _text
        if kind in TIMES:
            return _time(kind)
        if kind in CODES:
            return _number(kind)
        if kind not in self._writers:
            self._writers[kind] = self._message(kind)
        return self._writers[kind]


def codec_for(kind: DefinedType) -> MessageCodec:
    """The codec of a type; the last ``_CODECS_MAX`` are kept. Errors as for ``MessageCodec``."""
    return _codec(kind.name, kind.definition)


@functools.lru_cache(maxsize=_CODECS_MAX)
def _codec(name: str, definition: str) -> MessageCodec:
    return MessageCodec(name, parse_definition(name, definition))


def _slice(buf: memoryview, at: int, size: int) -> memoryview:
    if at + size > len(buf):
        raise _MalformedError(_SHORT)
    return buf[at : at + size]


def _strings(buf: memoryview, at: int, count: int) -> tuple[list[str], int]:
    texts = []
    if at + 4 * count > len(buf):
        raise _MalformedError(_SHORT)
    for _ in range(count):
        (size,) = _LENGTH.unpack_from(buf, at)
        at += 4
        texts.append(str(_slice(buf, at, size), "utf-8", "replace"))
        at += size
    return texts, at


def _cast(buf: memoryview, code: str) -> memoryview:
    if sys.byteorder == "big":
        size = struct.calcsize(f"<{code}")
        buf = memoryview(struct.pack(f"{len(buf) // size}{code}", *struct.unpack(f"<{len(buf) // size}{code}", buf)))
    return buf.cast(code)  # type: ignore[call-overload, no-any-return]


def _charge(left: list[int], values: int) -> None:
    left[0] -= values
    if left[0] < 0:
        raise _MalformedError("they claim too many values")


class _ReaderText:
    """Generates the functions of a type and of those that it embeds; a run of numbers is collected until its end.

    Each function takes the bytes, an offset and the number of values that are left, and returns values and offset.
    """

    def __init__(self, codec: MessageCodec, names: dict[str, Any]) -> None:
        self._codec = codec
        self._names = names
        self._types: list[str] = []
        self._lines: list[str] = []
        self._codes = ""
        self._run: list[str] = []
        self._count = 0

    def text(self) -> str:
        """The text of all functions; ``read_0`` is that of the codec's type."""
        self._function(self._codec.name)
        return "".join(map(self._body, self._types))  # more types are added on the way

    def _function(self, name: str) -> str:
        if name not in self._types:
            self._types.append(name)
        return f"read_{self._types.index(name)}"

    def _body(self, name: str) -> str:
        self._lines = []
        items = [f"{field.name!r}: {self._field(field)}" for field in self._codec.known[name].fields]
        self._flush()
        body = "".join(f"    {line}\n" for line in self._lines)
        return f"def {self._function(name)}(buf, at, left):\n{body}    return {{{', '.join(items)}}}, at\n"

    def _variable(self) -> str:
        self._count += 1
        return f"v{self._count}"

    def _number(self, code: str) -> str:
        self._codes += code
        self._run.append(self._variable())
        return self._run[-1]

    def _take_run(self, method: str) -> tuple[str, str, int]:
        """The run's variables, the name of a method of its ``Struct``, and its bytes; a new one begins."""
        run, variables = struct.Struct(f"<{self._codes}"), ", ".join(self._run)
        self._codes, self._run = "", []
        bound = f"c{len(self._names)}"
        self._names[bound] = getattr(run, method)
        return variables, bound, run.size

    def _flush(self) -> None:
        if self._codes:
            variables, unpack, size = self._take_run("unpack_from")
            self._lines += [f"({variables},) = {unpack}(buf, at)", f"at += {size}"]

    def _flat(self, kind: str) -> str:
        """The expression for a primitive of fixed size or a flat message, from numbers of the run."""
        if kind in TIMES:
            secs, nsecs = (self._number(code) for code in TIMES[kind])
            return f"{{'secs': {secs}, 'nsecs': {nsecs}}}"
        if kind in CODES:
            return self._number(CODES[kind])
        fields = self._codec.known[kind].fields
        return f"{{{', '.join(f'{field.name!r}: {self._flat(field.type)}' for field in fields)}}}"

    def _field(self, field: Field) -> str:
        if not field.array and field.type != "string" and (field.primitive or self._codec.measure(field.type)[2]):
            return self._flat(field.type)
        value = self._variable()
        if field.array:
            count = str(field.size) if field.size is not None else self._number("I")
            self._flush()
            self._lines += self._array(field, value, count)
        elif field.type == "string":
            size = self._number("I")
            self._flush()
            self._lines += [f"{value} = str(_slice(buf, at, {size}), 'utf-8', 'replace')", f"at += {size}"]
        else:
            self._flush()
            self._lines.append(f"{value}, at = {self._function(field.type)}(buf, at, left)")
        return value

    def _array(self, field: Field, value: str, count: str) -> list[str]:
        if field.type == "string":
            return [f"{value}, at = _strings(buf, at, {count})"]
        size = f"{count} * {self._codec.item_size(field.type)}"
        view, skip = f"_slice(buf, at, {size})", f"at += {size}"
        if field.type in CODES and field.type != "bool":
            return [f"{value} = _array({view}, {CODES[field.type]!r})", skip]
        values, _, flat = (0, 0, True) if field.primitive else self._codec.measure(field.type)
        lines = [f"_charge(left, {count} * {values})"] if values else []
        if flat:
            expression = self._flat(field.type)
            variables, step, _ = self._take_run("iter_unpack")
            return [*lines, f"{value} = [{expression} for ({variables},) in {step}({view})]", skip]
        item = f"item, at = {self._function(field.type)}(buf, at, left)"
        return [*lines, f"{value} = []", f"for _ in range({count}):", f"    {item}", f"    {value}.append(item)"]


def _count(field: Field, count: int, written: Written) -> None:
    if field.size is not None and count != field.size:
        raise WrongValueError(f"has {field.size} elements ({field}), not {count}")
    if field.size is None:
        written.out += _LENGTH.pack(count)


def _each(write: _Write, values: Sequence[Any], written: Written) -> None:
    index = 0
    try:
        for index, value in enumerate(values):  # noqa: B007 - the error has it
            write(value, written)
    except WrongValueError as error:
        error.path.append(f"[{index}]")
        raise


def _text(value: Any, written: Written) -> None:
    text = value if isinstance(value, str) else written.text(value)
    raw = text.encode() if text.isascii() else encoded(text)
    written.out += _LENGTH.pack(len(raw))
    written.out += raw


def _time(kind: str) -> _Write:
    pack = struct.Struct(f"<{TIMES[kind]}").pack

    def write(value: Any, written: Written) -> None:
        if not isinstance(value, Mapping):
            value = written.time(kind, value)
        elif not value.keys() <= _TIME_KEYS.keys():
            raise WrongValueError(f"is a {kind} ({{secs, nsecs}}), not {shown(value)}")
        parts = [0, 0]
        for key, part in value.items():
            parts[_TIME_KEYS[key]] = _integer(part, kind)
        try:
            written.out += pack(*parts)
        except struct.error:
            raise WrongValueError(f"does not fit a {kind}: {shown(parts[0])} s, {shown(parts[1])} ns") from None

    return write


def _boolean(value: Any, kind: str) -> bool:
    if isinstance(value, bool) or (isinstance(value, int) and value in (0, 1)):
        return bool(value)
    raise WrongValueError(f"is a {kind}, not {shown(value)}")


def _real(value: Any, kind: str) -> float:
    if value is None:
        return float("nan")  # JSON has no NaN; null is what is sent for it
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError:
            pass
    raise WrongValueError(f"is a {kind}, not {shown(value)}")


def _integer(value: Any, kind: str) -> int:
    if isinstance(value, float) and value.is_integer():
        return int(value)  # some languages write 3.0 for 3
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    raise WrongValueError(f"is a {kind}, not {shown(value)}")


def _number(kind: str) -> _Write:
    """One number: what ``struct`` does not take, or takes too gladly, is checked before."""
    convert: Callable[[Any, str], float] = {"?": _boolean, "f": _real, "d": _real}.get(CODES[kind], _integer)
    pack = struct.Struct(f"<{CODES[kind]}").pack

    def write(value: Any, written: Written) -> None:
        try:
            try:
                written.out += pack(convert(value, kind))
            except WrongValueError:
                written.out += pack(written.number(kind, value))
        except (struct.error, OverflowError):
            raise WrongValueError(f"does not fit {kind}: {shown(value)}") from None

    return write


def _numbers(field: Field) -> _Write:
    code, size = CODES[field.type], SIZES[field.type]
    item = _number(field.type)

    def write(values: Any, written: Written) -> None:
        values = written.numbers(field, values)
        if isinstance(values, bytes | memoryview):
            _count(field, len(values) // size, written)
            written.out += values
            return
        _count(field, len(values), written)
        # struct takes True for 1 and 2 for True; those lists are few, and go the slow way.
        if code != "?" and bool not in set(map(type, values)):
            try:
                written.out += struct.pack(f"<{len(values)}{code}", *values)
            except (struct.error, OverflowError):
                pass
            else:
                return
        _each(item, values, written)

    return write
