"""Message definitions as text: parses them, assembles full definitions, and computes MD5 sums.

Pure and without numpy. Sources: wiki.ros.org/msg and genmsg. Full text (``gendeps --cat``) and MD5 sum are equal to
genmsg's to the byte: publishers and subscribers compare the sums, bags store the text.
"""

from __future__ import annotations

import functools
import hashlib
import json
import re
import struct
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import LimitExceeded, RmpaError
from rmpa.core.identity import is_type_name
from rmpa.core.limits import UINT32_MAX
from rmpa.ros import limits
from rmpa.ros.wire.tcpros import LENGTH, TopicDescription, pack_text

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

SEPARATOR: Final = "=" * 80
PRIMITIVES: Final = frozenset(
    {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}
    | {"bool", "byte", "char", "float32", "float64", "string", "time", "duration"}
)
_HEADER: Final = "std_msgs/Header"
_FIELD_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_FIELD_TYPE: Final = re.compile(r"(?P<base>[A-Za-z0-9_/]+)(?P<array>\[(?P<size>0|[1-9][0-9]{0,8})?\])?")


@dataclass
class DefinitionError(RmpaError):
    """A message definition cannot be used."""

    type: str
    problem: str
    remedy: str = ""
    what: str = "message type"
    code = "unknown-type"

    def __str__(self) -> str:
        """The type, the problem and the remedy."""
        remedy = f"; {self.remedy}" if self.remedy else ""
        return f"{self.what} {self.type}: {self.problem}{remedy}"


@dataclass
class UnknownTypeError(DefinitionError):
    """No definition of a type was found.

    Attributes:
        fetchable: Whether a publisher may supply the definition; ``False`` if rmpa brings the other types of its
            package.
    """

    fetchable: bool = True


class MessageError(RmpaError):
    """A value does not fit a message type, or bytes are not a message of it."""

    code = "invalid-message"


class DefinedType:
    """What codecs of a message type are made of: its name and its full text."""

    name: str
    definition: str


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message type.

    Args:
        name: The name, as written.
        type: A primitive, or ``package/Name``.
        array: Whether it is an array.
        size: The length of a fixed-size array, which may be 0; ``None`` for one of any length.
    """

    name: str
    type: str
    array: bool = False
    size: int | None = None

    @property
    def primitive(self) -> bool:
        """Whether the field's type is built in."""
        return self.type in PRIMITIVES

    def __str__(self) -> str:
        """The type with its brackets."""
        return f"{self.type}[{'' if self.size is None else self.size}]" if self.array else self.type


@dataclass(frozen=True, slots=True)
class Specification:
    """The definition of one message type, without those that it embeds.

    Args:
        name: ``package/Name``.
        text: The type's own text.
        fields: The fields, in order.
        constants: ``type name=value`` in order, in the form in which the MD5 sum is computed.
    """

    name: str
    text: str
    fields: tuple[Field, ...]
    constants: tuple[str, ...]

    @classmethod
    def parse(cls, name: str, text: str) -> Specification:
        """Read one type's text.

        Raises:
            DefinitionError: A line is neither a field nor a constant.
        """
        if not is_type_name(name):
            raise DefinitionError(name[:80], "is not a type's name", "write it like std_msgs/String")
        fields: list[Field] = []
        constants: list[str] = []
        for line in text.split("\n"):
            clean = line.partition("#")[0].strip()
            if not clean:
                continue
            if "=" in clean:
                constants.append(_constant(name, line, clean))
            else:
                fields.append(_field(name, clean))
        if len(fields) + len(constants) > limits.DEFINITION_FIELDS_MAX:
            raise LimitExceeded(f"definition of {name} (in lines)", len(fields), limits.DEFINITION_FIELDS_MAX)
        return cls(name, text, tuple(fields), tuple(constants))

    def depends(self) -> Iterator[str]:
        """The embedded types, each once, in the order of the fields."""
        return iter(dict.fromkeys(field.type for field in self.fields if not field.primitive))


def _constant(name: str, line: str, clean: str) -> str:
    kind, _, rest = clean.partition(" ")
    if kind not in PRIMITIVES or kind in ("time", "duration"):
        raise DefinitionError(name, f"{clean[:80]!r} is not a constant")
    if kind == "string":
        # genmsg reads the line as written: the name is behind its first blank (and has the type in it, where blanks
        # indent the line), and the value is all behind the first "=", a "#" included.
        left, _, value = line.partition("=")
        return f"string {left.partition(' ')[2].strip()}={value.strip()}"
    constant, _, value = rest.partition("=")
    return f"{kind} {constant.strip()}={value.strip()}"


def _field(name: str, clean: str) -> Field:
    parts = clean.split()
    match = _FIELD_TYPE.fullmatch(parts[0])
    if len(parts) != 2 or match is None or not _FIELD_NAME.fullmatch(parts[1]):
        raise DefinitionError(name, f"{clean[:80]!r} is neither a field nor a constant")
    base = match["base"]
    if base == "Header" and match["array"] is None:
        base = _HEADER
    elif base not in PRIMITIVES and "/" not in base:
        base = f"{name.partition('/')[0]}/{base}"
    if base not in PRIMITIVES and not is_type_name(base):
        raise DefinitionError(name, f"{base[:80]!r} is not a type")
    return Field(parts[1], base, match["array"] is not None, int(match["size"]) if match["size"] else None)


def parse_definition(name: str, text: str) -> dict[str, Specification]:
    """Read a full definition: the type's own text, then ``MSG:`` blocks of all embedded types.

    Returns:
        The types by name; the type itself is the first.

    Raises:
        DefinitionError: The text is malformed, an embedded type is missing, or a type contains itself.
        LimitExceeded: The text is longer than ``limits.DEFINITION_MAX``.
    """
    if len(text) > limits.DEFINITION_MAX:
        raise LimitExceeded(f"definition of {name[:80]}", len(text), limits.DEFINITION_MAX)
    blocks = re.split(rf"\n?^{SEPARATOR}=*\n", text, flags=re.MULTILINE)
    found = {name: Specification.parse(name, blocks[0])}
    for block in blocks[1:]:
        head, _, rest = block.partition("\n")
        if not head.startswith("MSG:"):
            raise DefinitionError(name, f"{head[:80]!r} stands where 'MSG: package/Name' must be")
        embedded = head[4:].strip()
        found.setdefault(embedded, Specification.parse(embedded, rest))
    _walk(name, found)
    return found


def _walk(
    name: str, known: Mapping[str, Specification], order: dict[str, None] | None = None, inside: tuple[str, ...] = ()
) -> dict[str, None]:
    """All embedded types, each once, depth first: the order of ``gendeps``."""
    order = {} if order is None else order
    if len(inside) > limits.DEFINITION_DEPTH_MAX:
        raise DefinitionError(name, f"is nested deeper than {limits.DEFINITION_DEPTH_MAX} types")
    if name not in known:
        raise DefinitionError(name, "is not defined", f"{inside[-1]} embeds it" if inside else "")
    for embedded in known[name].depends():
        if embedded in inside or embedded == name:
            raise DefinitionError(embedded, "contains itself")
        # Each type is visited once: a hostile definition could make the walk exponential.
        if embedded not in order:
            order[embedded] = None
            _walk(embedded, known, order, (*inside, name))
    return order


def md5sum(name: str, known: Mapping[str, Specification], response: str = "") -> str:
    """The MD5 sum of a message type; with ``response`` that of the service type whose two halves they are.

    Raises:
        DefinitionError: An embedded type is missing, or a type contains itself.
    """
    text, sums = "", dict[str, str]()
    for half in filter(None, (name, response)):
        _walk(half, known)
        text += _md5_text(half, known, sums)
    return _hash(text)


def _md5_text(name: str, known: Mapping[str, Specification], sums: dict[str, str]) -> str:
    lines = list(known[name].constants)
    for field in known[name].fields:
        if not field.primitive and field.type not in sums:
            sums[field.type] = _hash(_md5_text(field.type, known, sums))
        lines.append(f"{sums.get(field.type, field)} {field.name}")
    return "\n".join(lines).strip()


def _hash(text: str) -> str:
    return hashlib.md5(text.encode(errors="surrogateescape"), usedforsecurity=False).hexdigest()


def full_text(name: str, known: Mapping[str, Specification]) -> str:
    """The full definition, as rospy and roscpp send it.

    Raises:
        DefinitionError: An embedded type is missing, or a type contains itself.
    """
    parts = [known[name].text + "\n"]
    parts += [f"{SEPARATOR}\nMSG: {embedded}\n{known[embedded].text}\n" for embedded in _walk(name, known)]
    return "".join(parts)[:-1]


@functools.cache
def packaged_texts(file: str) -> Mapping[str, str]:
    """The definitions in a data file of this package, by the type's name."""
    # Not by importlib.resources, which takes 10 ms of every start.
    texts: dict[str, str] = json.loads(Path(__file__).with_name(file).read_bytes())
    return texts


def complete(known: dict[str, Specification], find: Callable[[str], str | None]) -> None:
    """Add all types that the given ones embed, directly or not.

    Args:
        known: Types by name; the embedded ones are added.
        find: Returns the own text of a type, or ``None``.

    Raises:
        UnknownTypeError: An embedded type is not found.
        DefinitionError: An embedded type is malformed.
        LimitExceeded: All together are longer than ``limits.DEFINITION_MAX``.
    """
    size = 0
    todo = [(name, embedded) for name in known for embedded in known[name].depends()]
    while todo:
        outer, name = todo.pop()
        if name in known:
            continue
        text = find(name)
        if text is None:
            raise UnknownTypeError(name, f"is not known here, and {outer} embeds it")
        size += len(text)
        if size > limits.DEFINITION_MAX:
            raise LimitExceeded(f"definition of {outer} with all that it embeds", size, limits.DEFINITION_MAX)
        known[name] = Specification.parse(name, text)
        todo += [(name, embedded) for embedded in known[name].depends()]


def known_text(name: str) -> str | None:
    """The own text of a type that rmpa brings, or ``None``."""
    return packaged_texts("definitions.json").get(name)


def known_types() -> tuple[str, ...]:
    """The names of all types that rmpa brings."""
    return tuple(packaged_texts("definitions.json"))


@functools.lru_cache(maxsize=256)
def known_specifications(name: str) -> Mapping[str, Specification]:
    """A type that rmpa brings, and all that it embeds.

    Raises:
        DefinitionError: The type is not one that rmpa brings.
    """
    text = known_text(name)
    if text is None:
        raise UnknownTypeError(
            name, "is not one that comes with rmpa", "its definition is learnt from a publisher of that type"
        )
    found = {name: Specification.parse(name, text)}
    complete(found, known_text)
    return found


def known_description(name: str) -> TopicDescription:
    """The description of a type that rmpa brings, for a publisher's header.

    Its text is that of ROS's own publishers: rosbag and others compute the md5 sum from it.

    Raises:
        DefinitionError: The type is not one that rmpa brings.
    """
    known = known_specifications(name)
    return TopicDescription(name, md5sum(name, known), full_text(name, known))


# Serializes ``diagnostic_msgs/DiagnosticArray`` (REP 107), which an agent publishes on /diagnostics. The code is
# written by hand, because the agent needs few messages, and rosbags with numpy would double its memory.


ARRAY_TYPE: Final = "diagnostic_msgs/DiagnosticArray"
_ARRAY_HEADER: Final = struct.Struct("<III")
_SECOND: Final = 1_000_000_000


class DiagnosticLevel(IntEnum):
    """``level`` of a ``DiagnosticStatus``."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True, slots=True)
class DiagnosticStatus:
    """One ``diagnostic_msgs/DiagnosticStatus``.

    Args:
        level: The worst level of the component.
        name: The component; unique in an array.
        message: The status in a few words.
        hardware_id: The reporting module.
        values: Figures and facts, for people.
    """

    level: DiagnosticLevel
    name: str
    message: str
    hardware_id: str
    values: Mapping[str, str]

    def serialize(self) -> bytes:
        """Serialize the status as one element of the array."""
        parts = [bytes((self.level,)), *map(pack_text, (self.name, self.message, self.hardware_id))]
        parts.append(LENGTH.pack(len(self.values)))
        for key, value in self.values.items():
            parts += (pack_text(key), pack_text(value))
        return b"".join(parts)


def frame_array(sequence: int, stamp_ns: int, statuses: Iterable[bytes]) -> bytes:
    """Assemble a whole message with its length in front, as TCPROS sends it.

    Args:
        sequence: ``header.seq``, modulo 2^32.
        stamp_ns: ``header.stamp``, nanoseconds of the wall clock.
        statuses: Results of ``DiagnosticStatus.serialize``.
    """
    elements = tuple(statuses)
    seconds, nanoseconds = divmod(stamp_ns, _SECOND)
    header = _ARRAY_HEADER.pack(sequence & UINT32_MAX, seconds & UINT32_MAX, nanoseconds) + pack_text("")
    body = b"".join((header, LENGTH.pack(len(elements)), *elements))
    return LENGTH.pack(len(body)) + body
