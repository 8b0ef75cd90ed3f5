"""Messages as values: read from ROS 1's bytes, compiled for each type.

The conversions of one message type, compiled when they are first used and kept for the process.
"""

from __future__ import annotations

import enum
import functools
import struct
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import msgspec
from cbor2 import CBORTag

from rmpa.ros.types.definitions import parse_definition
from rmpa.ros.types.messages import MessageError
from rmpa.web import limits
from rmpa.web.values.writer import BYTES, CBOR_TAGS, CODES, SIZES, TIMES, Layout, compile_writer, shown

if TYPE_CHECKING:
    from rmpa.ros.types.definitions import Field
    from rmpa.ros.types.messages import MessageType
    from rmpa.web.values.writer import Writing


# Reads ROS 1 bytes to values, by a function that is generated for each type.
#
# Runs of numbers are read in one step of ``struct``, arrays of numbers without a loop in Python. The generated
# text has
# only names of fields, which the definitions' parser has checked, and numbers.


Values: TypeAlias = dict[str, Any]
Reader: TypeAlias = Callable[[memoryview], Values]
_Read: TypeAlias = Callable[[memoryview, int, list[int]], tuple[Values, int]]


class Flavour(enum.Enum):
    """What the values are for."""

    JSON = "json"
    """Arrays of uint8 and char are memoryviews of the message (msgspec writes base64), of other numbers lists."""
    CBOR = "cbor"
    """Arrays of uint8 and char are bytes, of other numbers tagged bytes (RFC 8746), of bool lists."""


class _TooShortError(Exception):
    """A length in the message goes beyond its end."""


class _TooManyError(Exception):
    """More values than the message's bytes allow."""


def compile_reader(layout: Layout, flavour: Flavour) -> Reader:
    """Make the function that reads messages of a type.

    It raises `MessageError` for bytes that are not a message of the type. Strings that are not UTF-8 have U+FFFD in
    place of the wrong bytes, since JSON and CBOR have text only.
    """
    read = _Compiler(layout, flavour).function(layout.name)
    values = layout.values(layout.name)

    def convert(payload: memoryview) -> Values:
        left = [limits.VALUES_FREE + limits.VALUES_PER_BYTE * len(payload) + values]
        try:
            made, at = read(payload, 0, left)
        except (struct.error, _TooShortError):
            raise MessageError(f"{len(payload)} bytes are not a {layout.name}: they end too early") from None
        except _TooManyError:
            raise MessageError(f"{len(payload)} bytes are not a {layout.name}: they claim too many values") from None
        if at != len(payload):
            raise MessageError(f"{len(payload)} bytes are not a {layout.name}: {len(payload) - at} are left over")
        return made

    return convert


# --- what the generated functions call ---------------------------------------------------------------------------


def _text(buf: memoryview, at: int, size: int) -> str:
    if at + size > len(buf):
        raise _TooShortError
    return str(buf[at : at + size], "utf-8", "replace")


def _slice(buf: memoryview, at: int, size: int) -> memoryview:
    if at + size > len(buf):
        raise _TooShortError
    return buf[at : at + size]


def _bools(buf: memoryview) -> list[bool]:
    return [value != 0 for value in buf]


def _times(buf: memoryview, codes: str) -> list[dict[str, int]]:
    return [{"secs": secs, "nsecs": nsecs} for secs, nsecs in struct.iter_unpack(f"<{codes}", buf)]


def _numbers(buf: memoryview, code: str) -> list[int] | list[float]:
    if sys.byteorder == "little":
        return buf.cast(code).tolist()  # type: ignore[call-overload, no-any-return]
    return list(struct.unpack(f"<{len(buf) // SIZES[code]}{code}", buf))


def _tagged(buf: memoryview, code: str) -> CBORTag:
    return CBORTag(CBOR_TAGS[code], bytes(buf))


def _texts(buf: memoryview, at: int, count: int) -> tuple[list[str], int]:
    texts = []
    if at + 4 * count > len(buf):
        raise _TooShortError
    for _ in range(count):
        (size,) = _LENGTH(buf, at)
        at += 4
        texts.append(_text(buf, at, size))
        at += size
    return texts, at


def _charge(left: list[int], values: int) -> None:
    left[0] -= values
    if left[0] < 0:
        raise _TooManyError


_LENGTH: Final = struct.Struct("<I").unpack_from
_NAMES: Final = {
    "_text": _text,
    "_slice": _slice,
    "_bools": _bools,
    "_times": _times,
    "_numbers": _numbers,
    "_tagged": _tagged,
    "_texts": _texts,
    "_charge": _charge,
}


# --- the generator -----------------------------------------------------------------------------------------------


class _Compiler:
    """Generates the functions of a type and of those that it embeds; each once."""

    def __init__(self, layout: Layout, flavour: Flavour) -> None:
        self.layout = layout
        self._flavour = flavour
        self._names: dict[str, Any] = dict(_NAMES)
        self._made: dict[str, str] = {}

    def function(self, name: str) -> _Read:
        """The function of a type: (bytes, offset, values left) to (values, offset)."""
        read: _Read = self._names[self.function_name(name)]
        return read

    def function_name(self, name: str) -> str:
        """The name of a type's function, which is generated where it is missing."""
        if name not in self._made:
            label = f"read_{len(self._made)}"
            self._made[name] = label
            source = _Body(self, name).source(label)
            exec(compile(source, f"<reader of {name}>", "exec"), self._names)  # noqa: S102 - see the module's docstring
        return self._made[name]

    def bind(self, value: object) -> str:
        """A name by which generated text reaches a value."""
        label = f"c{len(self._names)}"
        self._names[label] = value
        return label

    def array(self, field: Field, view: str) -> str:
        """The expression for an array of primitives of fixed size in `view`."""
        if field.type in TIMES:
            return f"_times({view}, {TIMES[field.type]!r})"
        if field.type == "bool":
            return f"_bools({view})"
        cbor = self._flavour is Flavour.CBOR
        if field.type in BYTES:
            return f"bytes({view})" if cbor else view
        return f"{'_tagged' if cbor else '_numbers'}({view}, {CODES[field.type]!r})"


class _Body:
    """The text of one function: a run of numbers is collected until something else follows."""

    def __init__(self, compiler: _Compiler, name: str) -> None:
        self._compiler = compiler
        self._layout = compiler.layout
        self._name = name
        self._lines: list[str] = []
        self._codes = ""
        self._variables: list[str] = []
        self._count = 0

    def source(self, label: str) -> str:
        items = [f"{field.name!r}: {self._field(field)}" for field in self._layout.fields(self._name)]
        self._flush()
        body = "".join(f"    {line}\n" for line in self._lines)
        return f"def {label}(buf, at, left):\n{body}    return {{{', '.join(items)}}}, at\n"

    def _variable(self) -> str:
        self._count += 1
        return f"v{self._count}"

    def _number(self, code: str) -> str:
        variable = self._variable()
        self._codes += code
        self._variables.append(variable)
        return variable

    def _flush(self) -> None:
        if not self._codes:
            return
        run = struct.Struct(f"<{self._codes}")
        read = self._compiler.bind(run.unpack_from)
        self._lines.append(f"({', '.join(self._variables)},) = {read}(buf, at)")
        self._lines.append(f"at += {run.size}")
        self._codes, self._variables = "", []

    def _flat(self, kind: str) -> str:
        """The expression for a primitive of fixed size or a flat message, from numbers of the run."""
        if kind in TIMES:
            secs, nsecs = (self._number(code) for code in TIMES[kind])
            return f"{{'secs': {secs}, 'nsecs': {nsecs}}}"
        if kind in CODES:
            return self._number(CODES[kind])
        fields = self._layout.fields(kind)
        return f"{{{', '.join(f'{field.name!r}: {self._flat(field.type)}' for field in fields)}}}"

    def _field(self, field: Field) -> str:
        if field.array:
            return self._array(field)
        if field.type == "string":
            size = self._number("I")
            self._flush()
            text = self._variable()
            self._lines += [f"{text} = _text(buf, at, {size})", f"at += {size}"]
            return text
        if field.primitive or self._layout.is_flat(field.type):
            return self._flat(field.type)
        self._flush()
        value = self._variable()
        self._lines.append(f"{value}, at = {self._compiler.function_name(field.type)}(buf, at, left)")
        return value

    def _array(self, field: Field) -> str:
        count = str(field.size) if field.size is not None else self._number("I")
        self._flush()
        value = self._variable()
        if field.type == "string":
            self._lines.append(f"{value}, at = _texts(buf, at, {count})")
            return value
        size = self._layout.item_size(field.type)
        if field.primitive:
            view = f"_slice(buf, at, {count} * {size})"
            self._lines += [f"{value} = {self._compiler.array(field, view)}", f"at += {count} * {size}"]
            return value
        self._lines.append(f"_charge(left, {count} * {self._layout.values(field.type)})")
        if self._layout.is_flat(field.type):
            self._flat_messages(field, value, count, size)
        else:
            read = self._compiler.function_name(field.type)
            item = self._variable()
            self._lines += [
                f"{value} = []",
                f"for _ in range({count}):",
                f"    {item}, at = {read}(buf, at, left)",
                f"    {value}.append({item})",
            ]
        return value

    def _flat_messages(self, field: Field, value: str, count: str, size: int) -> None:
        expression = self._flat(field.type)
        codes, variables = self._codes, self._variables
        self._codes, self._variables = "", []
        step = self._compiler.bind(struct.Struct(f"<{codes}").iter_unpack)
        items = f"{step}(_slice(buf, at, {count} * {size}))"
        self._lines += [
            f"{value} = [{expression} for ({', '.join(variables)},) in {items}]",
            f"at += {count} * {size}",
        ]


@dataclass(frozen=True, slots=True)
class Written:
    """A message from values.

    Args:
        payload: The ROS 1 bytes.
        missing: The first fields that were not given; a header and its fields do not count.
    """

    payload: bytes
    missing: tuple[str, ...] = ()


class MessageCodec:
    """Converts messages of one type.

    Args:
        name: ``package/Name``.
        definition: The full text with all that it embeds.

    Raises:
        DefinitionError: The definition is malformed, or its smallest message is too large (`limits`).
        LimitExceeded: The definition is too long.
    """

    def __init__(self, name: str, definition: str) -> None:
        self.name = name
        self._layout = Layout(name, parse_definition(name, definition))

    def json_values(self, payload: memoryview) -> Values:
        """Values for msgspec, which writes NaN and infinity as null, and memoryviews in base64.

        Raises:
            MessageError: The bytes are not a message of this type.
        """
        return self._json(payload)

    def json(self, payload: memoryview) -> bytes:
        """The message as a JSON object; errors as for `json_values`."""
        return msgspec.json.encode(self._json(payload))

    def cbor_values(self, payload: memoryview) -> Values:
        """Values for cbor2; errors as for `json_values`."""
        return self._cbor(payload)

    def write(self, values: Any, now_ns: int) -> Written:
        """The ROS 1 bytes of a mapping of fields. `now_ns` (UTC) is for stamps that are not given and for ``"now"``.

        Raises:
            MessageError: A field is unknown, or a value does not fit.
        """
        writing = self._write(values, now_ns)
        return Written(bytes(writing.out), tuple(writing.missing))

    def write_arguments(self, values: Any, now_ns: int) -> Written:
        """As `write`, also from a list of the fields in order; None is no arguments (rosbridge's ``args``)."""
        if isinstance(values, list | tuple):
            fields = self._layout.fields(self.name)
            if len(values) > len(fields):
                raise MessageError(f"{self.name}: has {len(fields)} fields, not {len(values)}")
            values = dict(zip((field.name for field in fields), values, strict=False))
        if values is not None and not isinstance(values, Mapping):
            raise MessageError(f"{self.name}: arguments are an object or a list, not {shown(values)}")
        return self.write(values or {}, now_ns)

    @functools.cached_property
    def _json(self) -> Reader:
        return compile_reader(self._layout, Flavour.JSON)

    @functools.cached_property
    def _cbor(self) -> Reader:
        return compile_reader(self._layout, Flavour.CBOR)

    @functools.cached_property
    def _write(self) -> Callable[[Any, int], Writing]:
        return compile_writer(self._layout)


def codec_for(kind: MessageType) -> MessageCodec:
    """The codec of a type; the last `limits.CODECS_MAX` are kept.

    Raises:
        DefinitionError: As for `MessageCodec`.
        LimitExceeded: Likewise.
    """
    return _codec(kind.name, kind.definition)


@functools.lru_cache(maxsize=limits.CODECS_MAX)
def _codec(name: str, definition: str) -> MessageCodec:
    return MessageCodec(name, definition)
