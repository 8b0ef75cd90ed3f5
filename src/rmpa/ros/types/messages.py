"""Messages as Python objects: serialize, deserialize, and convert from and to plain values.

``rosbags`` and numpy are imported when the first message is built or read: the agent forwards bytes and starts
without them. MD5 sums and definitions need neither.
"""

from __future__ import annotations

import functools
import itertools
import struct
import time
from typing import TYPE_CHECKING, Any, Final, TypeAlias, Union

from rmpa.core.limits import UINT32_MAX
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.definitions import (
    DefinedType,
    DefinitionError,
    Field,
    MessageError,
    Specification,
    full_text,
    known_specifications,
    md5sum,
    parse_definition,
)
from rmpa.ros.types.values import GivenMessage, WrongValueError, ros2_name
from rmpa.ros.wire.tcpros import Buffer, TopicDescription

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rosbags.typesys.store import Typestore


# Message types from texts in the cache of a process; the least recently used is dropped.
_LEARNT_TYPES_MAX: Final = 512

# A value of YAML or JSON.
Plain: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, list["Plain"], dict[str, "Plain"], None
]

__all__ = ["HeaderNumbers", "MessageError", "MessageType", "Plain", "given_values"]

_SEQ: Final = struct.Struct("<I")


class MessageType(DefinedType):
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
        """Make a type from its publisher's header; the last ``_LEARNT_TYPES_MAX`` types are cached.

        Args:
            name: ``package/Name``.
            definition: The full text.
            md5: The publisher's md5 sum, with which that of the text is compared; empty for no comparison.

        Raises:
            DefinitionError: The text is malformed, or has another md5 sum.
            LimitExceeded: The text is too long.
        """
        learnt = learnt_type(name, definition)
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
        """Serialize a message object, or what ``make`` makes one of, without a length in front.

        Raises:
            MessageError: A field has a value that its type does not allow; the text names it.
        """
        if not hasattr(message, "__msgtype__"):
            return bytes(self._from(message))
        try:
            return bytes(self._store.serialize_ros1(message, ros2_name(self.name)))
        except Exception:  # noqa: BLE001 - rosbags does not check values: the exception depends on the field
            return bytes(self._from(message))

    def deserialize(self, raw: Buffer) -> Any:
        """Deserialize bytes to a message object, with numpy arrays for arrays of numbers.

        Raises:
            MessageError: The bytes are too short, too long, or a string in them is not UTF-8.
        """
        try:
            return self._store.deserialize_ros1(bytes(raw), ros2_name(self.name))
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
        return self._store.deserialize_ros1(self._from(values), ros2_name(self.name))

    def given(self, message: object = None, fields: Mapping[str, object] | None = None) -> Any:
        """The message object that a program gives: itself, plain values as for ``make``, or fields by name.

        Raises:
            MessageError: It is of another type, has both a message and fields, or a value does not fit.
        """
        given: Any = given_values(self.name, message, fields)
        return given if hasattr(given, "__msgtype__") else self.make(given)

    def to_plain(self, message: object) -> dict[str, Plain]:
        """Convert a message object to plain values; times are ``{secs, nsecs}``."""
        return codec_for(self).plain_values(memoryview(self.serialize(message)))

    @functools.cached_property
    def _store(self) -> Typestore:
        # rosbags has most of the types that rmpa brings, but not TFMessage.
        if self._learnt or ros2_name(self.name) not in _known_store().types:
            return _learnt_store(self.name, self.specifications)
        return _known_store()

    def _from(self, values: Any) -> memoryview:
        """The bytes of what a program or the command line gives."""
        written = GivenMessage(time.time_ns())
        try:
            codec_for(self).fill(values, written)
        except WrongValueError as error:
            raise MessageError(str(error)) from None
        return memoryview(written.out)


def given_values(name: str, message: object, fields: Mapping[str, object] | None) -> object:
    """The message object or the plain values that a program gives; arguments and errors are those of ``given``."""
    if fields and message is not None:
        raise MessageError(f"{name}: a message and fields are given; give one or the other")
    of = getattr(message, "__msgtype__", None)
    if of is not None and of != ros2_name(name):
        raise MessageError(f"a message of type {name} is wanted, not of {of.replace('/msg/', '/')}")
    return fields or message


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


@functools.cache
def _known_store() -> Typestore:
    from rosbags.typesys import Stores  # noqa: PLC0415 - see the module's docstring

    from rmpa.ros.types.typestore import Ros1Store  # noqa: PLC0415

    return Ros1Store(Stores.ROS1_NOETIC)


@functools.lru_cache(maxsize=_LEARNT_TYPES_MAX)
def learnt_type(name: str, definition: str, source: str = "") -> MessageType:
    """A type from its full text, cached with its serialization code, which takes some 10 ms to generate."""
    return MessageType(name, parse_definition(name, definition), source)


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
            store.register(get_types_from_msg(text, ros2_name(each.name)))
    except (TypesysError, SyntaxError, ValueError) as error:
        raise DefinitionError(name, f"rosbags cannot read its definition: {error}") from error
    return store
