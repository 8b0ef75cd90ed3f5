"""Types of ROS 2: hashes, descriptions and sizes; and the sequence numbers of a topic's publishers.

The sequence numbers of one topic's publishers: what was lost, and what came twice. A machine without I/O.
"""

from __future__ import annotations

import functools
import re
from copy import copy
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rmpa.core.errors import ConfigError, RemoteProtocolError
from rmpa.gateway import limits
from rmpa.ros.limits import DEFINITION_DEPTH_MAX, DEFINITION_FIELDS_MAX

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.gateway.ros2.format import Ros2Attachment
    from rmpa.ros.types.definitions import Field, Specification
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.wire.tcpros import Buffer


class Ros2Sequences:
    """Counts gaps in the numbers that each publisher gives its messages."""

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}
        self.lost = 0
        """Messages that publishers sent and that did not come."""
        self.repeated = 0
        """Messages that came again."""

    def accept(self, attachment: Ros2Attachment, *, history: bool) -> bool:
        """Take in a message.

        Args:
            attachment: What came with it.
            history: Whether late messages may be those of a history, which came already.

        Returns:
            Whether it is new. A number that falls without a history is taken for a publisher that counts anew.
        """
        last = self._last.pop(attachment.gid, None)
        if last is None and len(self._last) >= limits.ROS2_PUBLISHERS_MAX:
            del self._last[next(iter(self._last))]
        if last is not None and history and 0 < attachment.sequence <= last:
            self._last[attachment.gid] = last
            self.repeated += 1
            return False
        self._last[attachment.gid] = attachment.sequence
        if last is not None and attachment.sequence > last + 1:
            self.lost += attachment.sequence - last - 1
        return True

    def forget(self) -> None:
        """Begin anew: what comes next was not missed."""
        self._last.clear()


# How large a type is with all that it embeds: definitions of a few bytes can embed types billions of times.


def check_size(name: str, fields_of: Callable[[str], Iterable[tuple[str, int]]]) -> None:
    """Check a type, in time linear in the fields of the types that it embeds.

    Args:
        name: The type.
        fields_of: A type's fields: for each the embedded type (empty for none), and the elements of an array of fixed
            length (else 1).

    Raises:
        RemoteProtocolError: It embeds itself, is nested too deeply, or is larger than ``limits.ROS2_PARTS_MAX`` or
            ``limits.ROS2_ARRAY_MAX`` allow.
    """
    known: dict[str, tuple[int, int]] = {}

    def measure(each: str, inside: tuple[str, ...]) -> tuple[int, int]:
        if each in inside or len(inside) > DEFINITION_DEPTH_MAX:
            raise RemoteProtocolError(f"{each} contains itself, or is nested too deeply")
        if each not in known:
            parts = elements = 1
            for embedded, count in fields_of(each):
                within = measure(embedded, (*inside, each)) if embedded else (1, 1)
                parts += within[0]
                elements += count * within[1]
            known[each] = parts, elements
        return known[each]

    parts, elements = measure(name, ())
    if parts > limits.ROS2_PARTS_MAX:
        raise RemoteProtocolError(f"{name} has more than {limits.ROS2_PARTS_MAX} fields with those of its types")
    if elements > limits.ROS2_ARRAY_MAX:
        raise RemoteProtocolError(f"{name} has arrays of more than {limits.ROS2_ARRAY_MAX} elements")


def check_ros1_size(name: str, specifications: Mapping[str, Specification]) -> None:
    """Check a type of ROS 1; errors as for ``check_size``."""

    def fields_of(each: str) -> Iterable[tuple[str, int]]:
        for field in specifications[each].fields if each in specifications else ():
            yield "" if field.primitive else field.type, field.size or 1

    check_size(name, fields_of)


# The types of ROS 2: their fields, their hashes, and the ROS 2 form of a type that ROS 1 defines.
#
# rosbags knows the types of each ROS 2 distribution. A type that it does not know, because a user defined it, is
# made
# from its ROS 1 definition: ROS 2 packages that were ported keep the fields, ``time`` and ``duration`` become
# messages
# of builtin_interfaces, and ``Header`` loses ``seq``. If the port differs, its hash differs (REP 2016), and the
# gateway
# reports that instead of sending what the other side would misread.


DISTRIBUTIONS: Final = {
    name.removeprefix("ROS2_").lower(): store
    for name, store in Stores.__members__.items()
    if name.startswith("ROS2_")
}
"""The ROS 2 distributions whose types are known, with rosbags' store of each."""
WITHOUT_HASH: Final = frozenset(("dashing", "eloquent", "foxy", "galactic", "humble"))
"""Distributions before REP 2016: their endpoints have no type hash."""
_TIMES: Final = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}
_BASE_NAMES: Final = {"char": "uint8"}
"""rosidl makes ``char`` of a definition an unsigned byte (rosidl_adapter), and hashes it so; ROS 1's is one too."""
_EMPTY_MEMBER: Final = "structure_needs_at_least_one_member"
_EVENT_INFO: Final = "service_msgs/msg/ServiceEventInfo"
NO_HASH: Final = "TypeHashNotSupported"
"""What stands for the hash in the keys of distributions that have none."""


class Ros2Types:
    """The types that ROS 2 nodes of one distribution have.

    Args:
        distribution: Its name, such as ``jazzy``.

    Raises:
        ConfigError: The distribution is not known.
    """

    def __init__(self, distribution: str) -> None:
        if distribution not in DISTRIBUTIONS:
            known = ", ".join(sorted(DISTRIBUTIONS))
            raise ConfigError("gateway.ros2.distribution", f"{distribution!r} is not known", f"one of {known}")
        self.distribution = distribution
        known_types = get_typestore(DISTRIBUTIONS[distribution])
        self.store = Typestore()
        self.store.fielddefs = {
            name: (constants, [(field, _rosidl(desc)) for field, desc in fields])
            for name, (constants, fields) in known_types.fielddefs.items()
        }
        self.store.types = dict(known_types.types)
        self._hashes: dict[str, str] = {}

    def __contains__(self, name: object) -> bool:
        """Whether the fields of ``package/msg/Name`` are known."""
        return name in self.store.fielddefs

    def learn(self, specifications: Mapping[str, Specification]) -> None:
        """Take in the ROS 2 form of types that ROS 1 defines; types that are known stay as they are.

        Args:
            specifications: ``package/Name`` to its fields, with all types that they embed.
        """
        made: dict[str, Any] = {
            ros2_name(name): ([], [_field(field) for field in each.fields] or [_EMPTY_FIELD])
            for name, each in specifications.items()
            if ros2_name(name) not in self
        }
        if made:
            self.store.register(made)

    def variant(self, fields: Mapping[str, Any]) -> Ros2Types:
        """Another version of some types: a copy in which they have other fields.

        Args:
            fields: ``package/msg/Name`` to its constants and fields, in rosbags' form.
        """
        made = copy(self)
        made.store = Typestore()
        made.store.fielddefs = {key: each for key, each in self.store.fielddefs.items() if key not in fields}
        made.store.types = {key: each for key, each in self.store.types.items() if key not in fields}
        made._hashes = {}  # noqa: SLF001 - its own class
        made.take(fields)
        return made

    def take(self, fields: Mapping[str, Any]) -> None:
        """Take in types of ROS 2 in rosbags' form; those that are known stay as they are."""
        if made := {key: each for key, each in fields.items() if key not in self}:
            self.store.register(made)

    def type_hash(self, name: str) -> str:
        """The hash of a message type, as it stands in keys and tokens.

        Args:
            name: ``package/msg/Name``.

        Raises:
            KeyError: The type is not known.
        """
        if self.distribution in WITHOUT_HASH:
            return NO_HASH
        if name not in self._hashes:
            self._hashes[name] = self.store.hash_rihs01(name)
        return self._hashes[name]

    def service_hash(self, service: ServiceType, name: str = "") -> str:
        """The hash of a service type, as it stands in keys and tokens; its request and response are learnt.

        Args:
            service: The ROS 1 type that has the fields.
            name: ``package/srv/Name`` of ROS 2; by default of ROS 1's name.
        """
        package, _, base = service.name.partition("/")
        name = name or f"{package}/srv/{base}"
        if name not in self:
            for kind in (service.request, service.response):
                self.learn({key: each for key, each in kind.specifications.items() if key != kind.name})
            self.define_service(
                name, _definition_fields(service.request.fields), _definition_fields(service.response.fields)
            )
        return self.type_hash(name)

    def define(self, name: str, fields: Fields) -> None:
        """Take in a type of ROS 2 by its fields; one that is known stays as it is.

        Args:
            name: ``package/msg/Name``, or what rosidl makes of actions and services.
            fields: Each field's name and what rosbags calls its description.
        """
        if name not in self:
            self.store.register({name: ([], fields or [_EMPTY_FIELD])})

    def define_as(self, name: str, specification: Specification) -> None:
        """Take in a type of ROS 2 with the fields of one of ROS 1; one that is known stays as it is."""
        self.define(name, _definition_fields(specification.fields))

    def define_service(self, name: str, request: Fields, response: Fields) -> None:
        """Take in a service type.

        rosidl describes it as a message with three members: request, response, and the event that service
        introspection publishes (rosidl_generator_type_description).

        Args:
            name: ``package/srv/Name``, or ``package/action/Name_SendGoal``.
            request: The request's fields.
            response: The response's fields.
        """
        event = f"{name}_Event"
        parts = {f"{name}_Request": request, f"{name}_Response": response}
        for part, fields in parts.items():
            self.define(part, fields)
        one = [(Nodetype.SEQUENCE, ((Nodetype.NAME, part), 1)) for part in parts]
        self.define(event, [("info", (Nodetype.NAME, _EVENT_INFO)), ("request", one[0]), ("response", one[1])])
        members = zip(("request_message", "response_message", "event_message"), (*parts, event), strict=True)
        self.define(name, [(member, (Nodetype.NAME, kind)) for member, kind in members])


Fields = list[tuple[str, Any]]
"""The fields of a type of ROS 2, each with what rosbags calls its description."""


def _definition_fields(fields: Iterable[Field]) -> Fields:
    return [_field(field) for field in fields]


_EMPTY_FIELD: Final[tuple[str, Any]] = (_EMPTY_MEMBER, (Nodetype.BASE, ("uint8", 0)))


def ros2_name(name: str) -> str:
    """``package/Name`` of ROS 1 as ROS 2's ``package/msg/Name``; roslib's ``Header`` is std_msgs'."""
    package, _, base = name.partition("/")
    return f"{package}/msg/{base}" if base else "std_msgs/msg/Header"


def _field(field: Field) -> tuple[str, Any]:
    if field.type in _TIMES:
        kind: tuple[Nodetype, Any] = (Nodetype.NAME, _TIMES[field.type])
    elif field.primitive:
        kind = (Nodetype.BASE, (_BASE_NAMES.get(field.type, field.type), 0))
    else:
        kind = (Nodetype.NAME, ros2_name(field.type))
    if field.array:
        kind = (Nodetype.SEQUENCE if field.size is None else Nodetype.ARRAY, (kind, field.size or 0))
    return snake_case(field.name), kind


def _rosidl(desc: Any) -> Any:
    """A description of rosbags, which has ``char`` as a type of its own, as rosidl has it."""
    if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return desc[0], (_rosidl(desc[1][0]), desc[1][1])
    return (desc[0], (_BASE_NAMES.get(desc[1][0], desc[1][0]), desc[1][1])) if desc[0] == Nodetype.BASE else desc


_HUMP: Final = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")


def snake_case(name: str) -> str:
    """The name of a field as ROS 2 wants it: ``K`` is ``k``, ``frameId`` is ``frame_id``."""
    return _HUMP.sub("_", name).lower()


def embedded(store: Typestore, name: str) -> Iterator[str]:
    """The types that a type embeds, at any depth, and itself; each may come more than once."""
    yield name
    for _, desc in store.fielddefs[name][1]:
        inner = desc[1][0] if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else desc
        if inner[0] == Nodetype.NAME:
            yield from embedded(store, str(inner[1]))


# The service ``~/get_type_description`` of ROS 2 nodes (REP 2016): its request, and the fields in its response.
#
# A response is checked before it is used: rosbags makes Python code of the names in it.


SERVICE: Final = "get_type_description"
"""The last part of the service's name; the others are its node's."""
SERVICE_TYPE: Final = "type_description_interfaces/srv/GetTypeDescription"
_REQUEST: Final = f"{SERVICE_TYPE}_Request"
_RESPONSE: Final = f"{SERVICE_TYPE}_Response"
_DESCRIPTION: Final = "type_description_interfaces/msg/TypeDescription"
_BASES: Final = {
    **dict(enumerate(("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64"), 2)),
    10: "float32",
    11: "float64",
    13: "uint8",
    15: "bool",
    16: "byte",
    17: "string",
    21: "string",
}
"""type_description_interfaces/msg/FieldType, without those that ROS 1 lacks. ``char`` of C++ (13) is one octet."""
_NESTED: Final = 1
_BOUNDED_STRING: Final = 21
_TYPE_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(msg|srv|action)/[A-Za-z][A-Za-z0-9_]*")
_FIELD_NAME: Final = re.compile(r"[a-z][a-z0-9_]*")
_ARRAY, _BOUNDED, _UNBOUNDED = 48, 96, 144
"""What is added to a type's number for an array of fixed size, a bounded and an unbounded sequence of it."""


def type_request(name: str, type_hash: str) -> bytes:
    """The CDR of a request for the description of ``package/msg/Name`` with a hash."""
    store = _store()
    message = store.types[_REQUEST](type_name=name, type_hash=type_hash, include_type_sources=False)
    return bytes(store.serialize_cdr(message, _REQUEST))


def parse_type_response(raw: Buffer) -> dict[str, Any]:
    """Read a response: the fields of the type and of all that it embeds, in rosbags' form, without constants.

    Raises:
        RemoteProtocolError: It is malformed, too large, or has a field that neither side's ROS has; or the node does
            not know the type, and the text says why.
    """
    if len(raw) > limits.ROS2_DESCRIPTION_MAX:
        raise RemoteProtocolError(f"a type's description has {len(raw)} bytes; at most {limits.ROS2_DESCRIPTION_MAX}")
    try:
        message: Any = _store().deserialize_cdr(bytes(raw), _RESPONSE)
    except (SerdeError, ValueError, IndexError, AssertionError, OverflowError) as error:
        raise RemoteProtocolError(f"a type's description is malformed: {error}") from error
    if not message.successful:
        raise RemoteProtocolError(f"the node does not describe the type: {message.failure_reason[:200]}")
    described = message.type_description
    all_types = (described.type_description, *described.referenced_type_descriptions)
    if len(all_types) > limits.ROS2_DESCRIBED_TYPES_MAX:
        raise RemoteProtocolError(f"a type's description has {len(all_types)} types")
    made: dict[str, Any] = {_type_name(each.type_name): ([], _fields(each)) for each in all_types}
    _check_size(made)
    return made


def _type_name(name: str) -> str:
    if len(name) > limits.ROS2_NAME_MAX or _TYPE_NAME.fullmatch(name) is None:
        raise RemoteProtocolError(f"{name[:80]!r} is not the name of a type of ROS 2")
    return name


def _fields(described: Any) -> list[tuple[str, Any]]:
    if len(described.fields) > DEFINITION_FIELDS_MAX:
        raise RemoteProtocolError(f"{described.type_name} has {len(described.fields)} fields")
    if not described.fields:  # ROS 2's have one at least; elements without bytes may be claimed without end
        raise RemoteProtocolError(f"{described.type_name[:80]} has no fields")
    for field in described.fields:
        if len(field.name) > limits.ROS2_NAME_MAX or _FIELD_NAME.fullmatch(field.name) is None:
            raise RemoteProtocolError(f"{field.name[:80]!r} is not the name of a field of ROS 2")
    names = [field.name for field in described.fields]
    if len(set(names)) < len(names):
        raise RemoteProtocolError(f"{described.type_name} has two fields of one name")
    return [(field.name, _desc(field.type)) for field in described.fields]


def _check_size(types: dict[str, Any]) -> None:
    """Check that no type contains itself, and how much each is with all that it embeds."""

    def fields_of(name: str) -> Iterator[tuple[str, int]]:
        for _, desc in types[name][1] if name in types else ():
            inner = desc[1][0] if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else desc
            count = desc[1][1] if desc[0] == Nodetype.ARRAY else 1
            yield str(inner[1]) if inner[0] == Nodetype.NAME else "", count

    for name in types:
        check_size(name, fields_of)


def _desc(kind: Any) -> Any:
    number, capacity = int(kind.type_id), int(kind.capacity)
    for base, node in ((_UNBOUNDED, Nodetype.SEQUENCE), (_BOUNDED, Nodetype.SEQUENCE), (_ARRAY, Nodetype.ARRAY)):
        if number > base:
            if base == _ARRAY and not capacity:
                raise RemoteProtocolError("a field is an array of no elements")
            return (node, (_inner(kind, number - base), 0 if base == _UNBOUNDED else capacity))
    return _inner(kind, number)


def _inner(kind: Any, number: int) -> Any:
    if number == _NESTED:
        return (Nodetype.NAME, _type_name(kind.nested_type_name))
    if number not in _BASES:
        raise RemoteProtocolError(f"a field has the type {number} of REP 2016, which ROS 1 lacks (wide characters)")
    bound = int(kind.string_capacity) if number == _BOUNDED_STRING else 0
    return (Nodetype.BASE, (_BASES[number], bound))


@functools.cache
def _store() -> Typestore:
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    store = Typestore()
    store.fielddefs, store.types = dict(jazzy.fielddefs), dict(jazzy.types)
    text: Any = (Nodetype.BASE, ("string", 0))
    flag: Any = (Nodetype.BASE, ("bool", 0))
    sources, extra = (f"type_description_interfaces/msg/{each}" for each in ("TypeSource", "KeyValue"))
    response: list[tuple[str, Any]] = [
        ("successful", flag),
        ("failure_reason", text),
        ("type_description", (Nodetype.NAME, _DESCRIPTION)),
        ("type_sources", (Nodetype.SEQUENCE, ((Nodetype.NAME, sources), 0))),
        ("extra_information", (Nodetype.SEQUENCE, ((Nodetype.NAME, extra), 0))),
    ]
    request: list[tuple[str, Any]] = [("type_name", text), ("type_hash", text), ("include_type_sources", flag)]
    store.register({_REQUEST: ([], request), _RESPONSE: ([], response)})
    return store
