"""What messages are made of: values as JSON and CBOR have them, or as programs and the command line give them."""

from __future__ import annotations

import binascii
import contextlib
import functools
import math
import struct
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.limits import MIB, UINT32_MAX
from rmpa.ros import limits

if TYPE_CHECKING:
    from rmpa.ros.types.definitions import Field, Specification

# Bytes of a message that is written from values.
WRITTEN_MAX: Final = 64 * MIB

# The ``struct`` code of each number.
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
SIZES: Final = {kind: struct.calcsize(f"<{code}") for kind, code in CODES.items()}
TIMES: Final = {"time": "II", "duration": "ii"}
# Little-endian typed arrays (RFC 8746), by ``struct`` code.
TAGS: Final = {"H": 69, "I": 70, "Q": 71, "b": 72, "h": 77, "i": 78, "q": 79, "f": 85, "d": 86}
_TAG_CODES: Final = {tag: code for code, tag in TAGS.items()} | {64: "B"}
_TIMES: Final = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}
_NANO: Final = 1_000_000_000
_DTYPES: Final = {"bool": "bool_", "byte": "int8", "char": "uint8"}


class WrongValueError(Exception):
    """A value does not fit; each level around it puts its field's name in front of ``path``."""

    def __init__(self, problem: str) -> None:
        super().__init__(problem)
        self.path: list[str] = []

    def __str__(self) -> str:
        where = ".".join(reversed(self.path)).replace(".[", "[")
        return f"{where}: {self.args[0]}" if where else str(self.args[0])


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
    return type(value).__name__ if hasattr(value, "tag") else repr(value)[: limits.SHOWN]


def encoded(text: str) -> bytes:
    """A text in UTF-8."""
    try:
        return text.encode()
    except UnicodeEncodeError:
        raise WrongValueError("has half of a surrogate pair, which is no character") from None


class Written:
    """A message that is written from values as JSON and CBOR have them; its methods take or refuse other ones.

    Args:
        now_ns: The present time (UTC) in nanoseconds, for stamps that are not given and for ``"now"``.

    Attributes:
        missing: The first fields that were not given; a header and its fields do not count.
        absent: The value of a field that is not given.
        stamps: Whether the stamp of a header is the present time where it is not given.
        size_max: The most bytes.
    """

    absent: object = object()
    stamps = True
    size_max = WRITTEN_MAX

    def __init__(self, now_ns: int) -> None:
        seconds, nanoseconds = divmod(now_ns, 1_000_000_000)
        self.now = {"secs": max(0, min(seconds, UINT32_MAX)), "nsecs": nanoseconds}
        self.out = bytearray()
        self.missing: list[str] = []

    @property
    def payload(self) -> bytes:
        """The ROS 1 bytes."""
        return bytes(self.out)

    def fields(self, known: Specification, values: Any) -> Mapping[str, Any]:
        """The fields of a message that is no mapping."""
        raise WrongValueError(f"is a {known.name} (an object), not {shown(values)}")

    def text(self, value: Any) -> str:
        """A string that is none."""
        raise WrongValueError(f"is a string, not {shown(value)}")

    def time(self, kind: str, value: Any) -> Mapping[str, Any]:
        """A time that is no mapping."""
        if isinstance(value, str) and value == "now" and kind == "time":
            return self.now
        raise WrongValueError(f"is a {kind} ({{secs, nsecs}}), not {shown(value)}")

    def number(self, kind: str, value: Any) -> float:
        """A number or boolean that is none."""
        raise WrongValueError(f"is a {kind}, not {shown(value)}")

    def array(self, field: Field, values: Any) -> Sequence[Any]:
        """The elements of an array as a list."""
        if not isinstance(values, list | tuple):
            raise WrongValueError(f"is a list ({field}), not {shown(values)}")
        return values

    def numbers(self, field: Field, values: Any) -> Any:
        """An array of numbers as the bytes of the field's kind, else as a list."""
        code = CODES[field.type]
        if code == "B" and isinstance(values, str):
            try:
                return binascii.a2b_base64(values, strict_mode=True)
            except ValueError:
                raise WrongValueError(f"is base64 ({field}), not {shown(values)}") from None
        if code == "B" and isinstance(values, bytes | bytearray):
            return bytes(values)
        if isinstance(values, memoryview):
            return values.cast("B") if values.format == code and sys.byteorder == "little" else values.tolist()
        if (tag := getattr(values, "tag", None)) is None:
            return self.array(field, values)
        given = _TAG_CODES.get(tag) if isinstance(tag, int) else None
        raw = values.value
        if given is None or not isinstance(raw, bytes) or len(raw) % struct.calcsize(f"<{given}"):
            raise WrongValueError("is a typed array of little-endian numbers (RFC 8746), not another tag")
        return raw if given == code else [value for (value,) in struct.iter_unpack(f"<{given}", raw)]


class GivenMessage(Written):
    """A message from what programs and the command line give, such as other messages, numpy's arrays and seconds."""

    absent = None
    stamps = False
    size_max = limits.MESSAGE_MAX

    def fields(self, known: Specification, values: Any) -> Mapping[str, Any]:
        """Of a message, a list of all fields in order, or the value of the only field."""
        names = [field.name for field in known.fields]
        if values is None:
            return {}
        if getattr(values, "__msgtype__", None) == ros2_name(known.name):
            try:
                return {name: getattr(values, python_name(name)) for name in names}
            except AttributeError as error:
                raise WrongValueError(f"{known.name} has {error.name} here, and not in the version given") from None
        if isinstance(values, list):
            if values and len(values) != len(names):
                raise WrongValueError(f"{known.name} has {len(names)} fields, not {len(values)}")
            return dict(zip(names, values, strict=False))
        if len(names) == 1:
            return {names[0]: values}
        has = ", ".join(names) or "none"
        raise WrongValueError(f"{known.name} is made of the fields {has}, not of {shown(values)}")

    def text(self, value: Any) -> str:
        """Of a number its digits."""
        value = _scalar(value)
        if value is None:
            return ""
        if isinstance(value, int | float):
            with contextlib.suppress(ValueError):  # Python refuses to write out an integer of thousands of digits
                return str(value)
        return super().text(value)

    def time(self, kind: str, value: Any) -> Mapping[str, Any]:
        """Of a message, or of seconds."""
        if value is None:
            return {}
        if getattr(value, "__msgtype__", None) == _TIMES[kind]:
            return {"secs": value.sec, "nsecs": value.nanosec}
        if isinstance(value, float) and math.isfinite(value * _NANO):
            secs, nsecs = divmod(round(value * _NANO), _NANO)
            return {"secs": secs, "nsecs": nsecs}
        return {"secs": value} if isinstance(value, int) else super().time(kind, value)

    def number(self, kind: str, value: Any) -> float:
        """Of numpy's scalars and booleans, and of the words for what is no number."""
        value = _scalar(value)
        if value is None:
            return 0
        if isinstance(value, int | float) and (CODES[kind] in "fd" or isinstance(value, int)):
            return bool(value) if kind == "bool" else value
        if isinstance(value, str) and CODES[kind] in "fd" and value.lstrip("+-.").lower() in ("nan", "inf"):
            return float(value.replace(".", ""))
        return super().number(kind, value)

    def array(self, field: Field, values: Any) -> Sequence[Any]:
        """Of numpy's array of objects too; an empty one is a fixed one's default."""
        if hasattr(values, "dtype") and values.ndim:
            values = list(values)
        return super().array(field, values) or [None] * (field.size or 0)

    def numbers(self, field: Field, values: Any) -> Any:
        """Of text in arrays of bytes, of bytes, and of numpy's arrays."""
        if CODES[field.type] == "B" and isinstance(values, str):
            return encoded(values)
        if isinstance(values, bytes | bytearray | memoryview):
            return bytes(values) if CODES[field.type] in "bB" else self.array(field, values)
        if hasattr(values, "dtype") and values.ndim:
            return _of_numpy(field, values)
        values = super().numbers(field, values)
        is_list = isinstance(values, list | tuple) and type(None) in set(map(type, values))
        return [0 if each is None else each for each in values] if is_list else values


def _scalar(value: Any) -> Any:
    return value.item() if hasattr(value, "item") else value  # numpy's


def _of_numpy(field: Field, given: Any) -> memoryview:
    """The bytes of a numpy array that are those of the field's numbers."""
    import numpy as np  # noqa: PLC0415 - see the module's docstring

    kind = np.dtype(_DTYPES.get(field.type, field.type)).newbyteorder("<")
    given = np.ascontiguousarray(given).ravel()
    if given.dtype.kind not in ("biuf" if kind.kind == "f" else "biu"):
        raise WrongValueError(f"is a list ({field}), not one of {given.dtype}")
    with np.errstate(over="ignore"):
        made = given.astype(kind, copy=False)
    if made is not given and kind.kind != "b":
        lost = np.isinf(made) & np.isfinite(given) if kind.kind == "f" else made != given
        if lost.any():
            raise WrongValueError(f"does not fit {field.type}: {given.min()} to {given.max()}")
    return memoryview(made.view(np.uint8))


@functools.cache
def ros2_name(name: str) -> str:
    """Convert ``package/Name`` to rosbags' form, ``package/msg/Name``."""
    package, _, base = name.partition("/")
    return f"{package}/msg/{base}"


@functools.cache
def python_name(name: str) -> str:
    """The attribute of a field: some names are words of Python."""
    from rosbags.typesys.base import normalize_fieldname  # noqa: PLC0415 - see the module's docstring

    return normalize_fieldname(name)
