"""Messages as Python objects: serialize, deserialize, and convert from and to plain values.

``rosbags`` and numpy are imported when the first message is built or read: the agent forwards bytes and starts
without them. MD5 sums and definitions need neither.
"""

from __future__ import annotations

import functools
import itertools
import math
import struct
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, TypeAlias, Union

from rmpa.core.errors import RmpaError
from rmpa.core.limits import UINT32_MAX
from rmpa.ros import limits
from rmpa.ros.types.definitions import (
    DefinitionError,
    Field,
    Specification,
    full_text,
    known_specifications,
    md5sum,
    parse_definition,
)
from rmpa.ros.wire.tcpros import TopicDescription

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from rmpa.ros.wire.tcpros import Buffer

# Message types from publishers' headers in the cache of a process; the least recently used is dropped.
_RECEIVED_TYPES_MAX: Final = 256

# A value of YAML or JSON.
Plain: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, list["Plain"], dict[str, "Plain"], None
]

_TIMES: Final = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}
_NANO: Final = 1_000_000_000
_SEQ: Final = struct.Struct("<I")
_FLOATS: Final = frozenset(("float32", "float64"))
# Characters of a wrong value in an error.
_SHOWN: Final = 80
_DTYPES: Final = {"bool": "bool_", "byte": "int8", "char": "uint8"}


class MessageError(RmpaError):
    """A value does not fit a message type, or bytes are not a message of it."""

    code = "invalid-message"


class MessageType:
    """One message type.

    Args:
        name: ``package/Name``.
        specifications: The type and all that it embeds, by name; by default those that rmpa brings.
            ``rmpa.ros.types.find`` finds those of this machine's packages.
        source: The file of the definition; empty for one that rmpa brings or that a publisher sent.

    Raises:
        DefinitionError: The type is not known, or malformed.
    """

    def __init__(
        self, name: str, specifications: Mapping[str, Specification] | None = None, source: str = ""
    ) -> None:
        self.name = name
        self.source = source
        self._learnt = specifications is not None
        self.specifications = specifications if specifications is not None else known_specifications(name)
        self.md5sum = md5sum(name, self.specifications)
        self.definition = full_text(name, self.specifications)

    @classmethod
    def learn(cls, name: str, definition: str, md5: str = "") -> MessageType:
        """Make a type from its publisher's header; the last ``_RECEIVED_TYPES_MAX`` types are cached.

        Args:
            name: ``package/Name``.
            definition: The full text.
            md5: The publisher's md5 sum, with which that of the text is compared; empty for no comparison.

        Raises:
            DefinitionError: The text is malformed, or has another md5 sum.
            LimitExceeded: The text is too long.
        """
        learnt = _learn(name, definition)
        if md5 and learnt.md5sum != md5:
            raise DefinitionError(name, f"its definition has the md5 sum {learnt.md5sum}, its publisher says {md5}")
        return learnt

    def describe(self, *, latching: bool = False) -> TopicDescription:
        """The description for a publisher's header."""
        return TopicDescription(self.name, self.md5sum, self.definition, latching)

    @property
    def fields(self) -> tuple[Field, ...]:
        """The fields, in order."""
        return self.specifications[self.name].fields

    def serialize(self, message: object) -> bytes:
        """Serialize a message object, without a length in front.

        Raises:
            MessageError: A field has a value that its type does not allow; the text names it.
        """
        try:
            return bytes(self._store.serialize_ros1(message, _inner(self.name)))
        except Exception:  # noqa: BLE001 - rosbags does not check values: the exception depends on the field
            checked = self._make(self.name, self._attributes(self.name, message, ""), "", deep=True)
            return bytes(self._store.serialize_ros1(checked, _inner(self.name)))

    def deserialize(self, raw: Buffer) -> Any:
        """Deserialize bytes to a message object, with numpy arrays for arrays of numbers.

        Raises:
            MessageError: The bytes are too short, too long, or a string in them is not UTF-8.
        """
        try:
            return self._store.deserialize_ros1(bytes(raw), _inner(self.name))
        except Exception as error:
            raise MessageError(f"{len(raw)} bytes are not a {self.name}: {error}") from error

    def make(self, values: Plain | Mapping[str, object] = None) -> Any:
        """Make a message object from plain values; missing fields are 0, empty or false, as in ROS.

        Args:
            values: A mapping of fields; or a list of all fields in order; or the value itself if the type has one
                field only. Times are ``{secs, nsecs}`` or seconds.

        Raises:
            MessageError: A field is unknown, or its value does not fit.
        """
        return self._make(self.name, values, "")

    def given(self, message: object = None, fields: Mapping[str, object] | None = None) -> Any:
        """The message object that a program gives: itself, plain values as for ``make``, or fields by name.

        Raises:
            MessageError: It is of another type, has both a message and fields, or a value does not fit.
        """
        if fields:
            if message is not None:
                raise MessageError(f"{self.name}: a message and fields are given; give one or the other")
            return self.make(fields)
        of = getattr(message, "__msgtype__", None)
        if of is not None and of != _inner(self.name):
            raise MessageError(f"a message of type {self.name} is wanted, not of {of.replace('/msg/', '/')}")
        plain: Any = message
        return message if of is not None else self.make(plain)

    def to_plain(self, message: object) -> dict[str, Plain]:
        """Convert a message object to plain values; times are ``{secs, nsecs}``."""
        return self._plain(self.name, message)

    # --- inside -----------------------------------------------------------------------------------------------

    @functools.cached_property
    def _store(self) -> Typestore:
        # rosbags has most of the types that rmpa brings, but not TFMessage.
        if self._learnt or _inner(self.name) not in _known_store().types:
            return _learnt_store(self.name, self.specifications)
        return _known_store()

    def _make(self, name: str, values: Any, path: str, *, deep: bool = False) -> object:
        """A message object from plain values; message objects in them are taken as they are, unless ``deep``."""
        fields = self.specifications[name].fields
        if getattr(values, "__msgtype__", None) == _inner(name):
            given: Mapping[str, object] = self._attributes(name, values, path)
        elif values is None:
            given = {}
        elif isinstance(values, Mapping):
            given = values
        elif isinstance(values, list):
            if values and len(values) != len(fields):
                raise MessageError(f"{path or name} has {len(fields)} fields, not {len(values)}")
            given = dict(zip((field.name for field in fields), values, strict=False))
        elif len(fields) == 1:
            given = {fields[0].name: values}
        else:
            raise MessageError(f"{path or name} is made of the fields {_names(fields)}, not of {_short(values)}")
        if given and (unknown := given.keys() - {field.name for field in fields}):
            raise MessageError(f"{path or name} has no field {min(map(_short, unknown))}; it has {_names(fields)}")
        within = f"{path}." if path else ""
        made: dict[str, Any] = {
            _python_name(field.name): self._value(field, given.get(field.name), within + field.name, deep=deep)
            for field in fields
        }
        if not fields:
            made["structure_needs_at_least_one_member"] = 0
        return self._store.types[_inner(name)](**made)

    def _attributes(self, name: str, message: object, path: str) -> dict[str, object]:
        """The values of a message object, as its program set them: lists in place of arrays, mappings in it."""
        try:
            return {
                field.name: getattr(message, _python_name(field.name)) for field in self.specifications[name].fields
            }
        except AttributeError:
            raise MessageError(f"{path or name} is a message of {name}, not {_short(message)}") from None

    def _value(self, field: Field, value: Any, path: str, *, deep: bool) -> object:
        if not field.array:
            return self._scalar(field, value, path, deep=deep)
        if isinstance(value, str) and field.type in ("uint8", "char"):
            value = list(_text(value, path).encode())
        items = [] if value is None else value
        if not isinstance(items, list | str):
            items = _sequence(field, value, path)
            if not isinstance(items, list):
                return items
        if not isinstance(items, list):
            raise MessageError(f"{path} is a list of {field.type}, not {_short(value)}")
        is_numbers = field.primitive and field.type not in ("string", *_TIMES)
        if not items and is_numbers:
            return _numbers(field, None, field.size or 0)
        items = items or [None] * (field.size or 0)
        if field.size is not None and len(items) != field.size:
            raise MessageError(f"{path} has {field.size} elements, not {len(items)}")
        made = [self._scalar(field, item, path, deep=deep) for item in items]
        return _numbers(field, made, len(made)) if is_numbers else made

    def _scalar(self, field: Field, value: Any, path: str, *, deep: bool) -> object:
        is_time = field.type in _TIMES
        if is_time or not field.primitive:
            inner = _TIMES[field.type] if is_time else _inner(field.type)
            if not deep and getattr(value, "__msgtype__", None) == inner:
                return value
        if is_time:
            secs, nsecs = _time(field.type, value, path)
            return self._store.types[_TIMES[field.type]](sec=secs, nanosec=nsecs)
        if not field.primitive:
            return self._make(field.type, value, path, deep=deep)
        if not isinstance(value, bool | int | float | str | list | dict | None) and hasattr(value, "item"):
            value = value.item()  # numpy's
        return _primitive(field.type, value, path)

    def _plain(self, name: str, message: object) -> dict[str, Plain]:
        plain: dict[str, Plain] = {}
        for field in self.specifications[name].fields:
            value = getattr(message, _python_name(field.name))
            if not field.array:
                plain[field.name] = self._plain_scalar(field, value)
            elif hasattr(value, "tolist"):
                plain[field.name] = value.tolist()
            else:
                plain[field.name] = [self._plain_scalar(field, item) for item in value]
        return plain

    def _plain_scalar(self, field: Field, value: Any) -> Plain:
        if field.type in _TIMES:
            return {"secs": int(value.sec), "nsecs": int(value.nanosec)}
        if field.primitive:
            plain: Plain = value
            return plain
        return self._plain(field.type, value)


class HeaderNumbers:
    """Numbers the messages of one publisher in ``header.seq``: 1, 2, 3 …, as rospy does.

    A type has such a number where its first field is ``std_msgs/Header header``, as for roscpp.
    """

    def __init__(self, kind: MessageType) -> None:
        self._has_header = kind.fields[:1] == (Field("header", "std_msgs/Header"),)
        self._numbers = itertools.count(1)  # of threads that publish at one time, each gets its own

    def stamp(self, payload: Buffer) -> Buffer:
        """The next message, numbered; itself where its type has no number."""
        number = next(self._numbers)
        if not self._has_header:
            return payload
        return b"".join((_SEQ.pack(number & UINT32_MAX), memoryview(payload)[_SEQ.size :]))


# The integers of each type; of times the seconds, and the nanoseconds likewise.
_RANGES: Final = {
    f"{sign}int{bits}": (0, (1 << bits) - 1) if sign else (-(1 << bits - 1), (1 << bits - 1) - 1)
    for sign in ("u", "")
    for bits in (8, 16, 32, 64)
} | {"byte": (-128, 127), "char": (0, 255), "time": (0, (1 << 32) - 1), "duration": (-(1 << 31), (1 << 31) - 1)}
_FLOAT32: Final = struct.Struct("<f").pack


def _primitive(kind: str, value: Plain, path: str) -> bool | float | str:
    if kind == "string":
        if value is None or isinstance(value, str | int | float):
            return "" if value is None else _text(value, path)
    elif kind == "bool":
        if value is None or isinstance(value, bool | int):
            return bool(value)
    elif kind in _FLOATS:
        if value is None or isinstance(value, int | float):
            return _float(kind, 0 if value is None else value, path)
        if isinstance(value, str) and value.lstrip("+-.").lower() in ("nan", "inf"):
            return float(value.replace(".", ""))
    elif value is None or isinstance(value, int):
        return _integer(kind, value or 0, path)
    raise MessageError(f"{path} is a {kind}, not {_short(value)}")


def _integer(kind: str, value: int, path: str) -> int:
    low, high = _RANGES[kind]
    if low <= value <= high:
        return int(value)
    raise MessageError(f"{path}: {_short(value)} does not fit {kind} ({low} to {high})")


def _float(kind: str, value: float, path: str) -> float:
    try:
        number = float(value)
        if kind == "float32":
            _FLOAT32(number)
    except OverflowError:
        raise MessageError(f"{path}: {_short(value)} does not fit {kind}") from None
    return number


def _text(value: str | float, path: str) -> str:
    try:
        text = str(value)
        text.encode()
    except UnicodeEncodeError:
        raise MessageError(f"{path} has half of a surrogate pair, which is no character") from None
    except ValueError:
        raise MessageError(f"{path} is a string, not {_short(value)}") from None
    return text


def _sequence(field: Field, value: Any, path: str) -> Any:
    """Convert a value for an array: a numpy array or bytes to an array of the field's type, all else to a list.

    Raises:
        MessageError: The value is no sequence, or does not fit the field.
    """
    if isinstance(value, tuple):
        return list(value)
    raw = isinstance(value, bytes | bytearray | memoryview) and field.type in ("uint8", "char", "byte", "int8")
    if not raw and not (hasattr(value, "dtype") and value.ndim):
        raise MessageError(f"{path} is a list of {field.type}, not {_short(value)}")
    if not field.primitive or field.type in ("string", *_TIMES):
        return list(value)
    import numpy as np  # noqa: PLC0415 - see the module's docstring

    kind = np.dtype(_DTYPES.get(field.type, field.type))
    # A copy: the caller may change its array later.
    given = np.frombuffer(value, kind).copy() if raw else np.asarray(value).ravel()
    if field.size is not None and given.size != field.size:
        raise MessageError(f"{path} has {field.size} elements, not {given.size}")
    if given.dtype == kind:
        return given if raw else given.copy()
    whole = kind.kind in "iu"
    if given.dtype.kind not in ("biu" if whole or kind.kind == "b" else "biuf"):
        raise MessageError(f"{path} is a list of {field.type}, not of {given.dtype}")
    if whole and given.size:
        low, high = _RANGES[field.type]
        if int(given.min()) < low or int(given.max()) > high:
            raise MessageError(f"{path}: {given.min()} to {given.max()} do not fit {field.type} ({low} to {high})")
    with np.errstate(over="ignore"):
        made = given.astype(kind)
    if kind.kind == "f" and (np.isinf(made) & np.isfinite(given)).any():
        raise MessageError(f"{path}: {given.min()} to {given.max()} do not fit {field.type}")
    return made


def _numbers(field: Field, values: list[object] | None, count: int) -> object:
    """An array of the field's numbers; zeros without values."""
    import numpy as np  # noqa: PLC0415 - see the module's docstring

    dtype = _DTYPES.get(field.type, field.type)
    return np.zeros(count, dtype) if values is None else np.array(values, dtype)


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


def _short(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # Python refuses to write out an integer of thousands of digits
        return "a number of too many digits"
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}…"


def _time(kind: str, value: Any, path: str) -> tuple[int, int]:
    secs: Any = value
    nsecs: Any = 0
    if value is None:
        return 0, 0
    if getattr(value, "__msgtype__", None) == _TIMES[kind]:
        secs, nsecs = value.sec, value.nanosec
    elif isinstance(value, Mapping) and value.keys() <= {"secs", "nsecs", "sec", "nanosec"}:
        secs, nsecs = value.get("secs", value.get("sec", 0)), value.get("nsecs", value.get("nanosec", 0))
    elif isinstance(value, float) and math.isfinite(value * _NANO):
        secs, nsecs = divmod(round(value * _NANO), _NANO)
    if isinstance(value, bool) or not isinstance(secs, int) or not isinstance(nsecs, int):
        raise MessageError(f"{path} is a {kind}, {{secs: 0, nsecs: 0}} or seconds, not {_short(value)}")
    return _integer(kind, secs, f"{path}.secs"), _integer(kind, nsecs, f"{path}.nsecs")


def _names(fields: Sequence[Field]) -> str:
    return ", ".join(field.name for field in fields) or "none"


@functools.cache
def _inner(name: str) -> str:
    """Convert ``package/Name`` to rosbags' form, ``package/msg/Name``."""
    package, _, base = name.partition("/")
    return f"{package}/msg/{base}"


@functools.cache
def _python_name(name: str) -> str:
    from rosbags.typesys.base import normalize_fieldname  # noqa: PLC0415 - see the module's docstring

    return normalize_fieldname(name)


@functools.cache
def _known_store() -> Typestore:
    from rosbags.typesys import Stores  # noqa: PLC0415 - see the module's docstring

    from rmpa.ros.types.typestore import Ros1Store  # noqa: PLC0415

    return Ros1Store(Stores.ROS1_NOETIC)


@functools.lru_cache(maxsize=_RECEIVED_TYPES_MAX)
def _learn(name: str, definition: str) -> MessageType:
    return MessageType(name, parse_definition(name, definition))


def _learnt_store(name: str, specifications: Mapping[str, Specification]) -> Typestore:
    from rosbags.typesys import Stores, get_types_from_msg  # noqa: PLC0415 - see the module's docstring
    from rosbags.typesys.base import TypesysError  # noqa: PLC0415

    from rmpa.ros.types.typestore import Ros1Store  # noqa: PLC0415

    store = Ros1Store(Stores.EMPTY)
    try:
        for each in specifications.values():
            # Made from the parsed fields: serialization needs no comments and constants, and rosbags parses some
            # lines differently.
            text = "".join(f"{field} {field.name}\n" for field in each.fields)
            store.register(get_types_from_msg(text, _inner(each.name)))
    except (TypesysError, SyntaxError, ValueError) as error:
        raise DefinitionError(name, f"rosbags cannot read its definition: {error}") from error
    return store
