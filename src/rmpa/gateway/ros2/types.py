"""Types of ROS 2: fields, hashes and sizes; and the sequence numbers of a topic's publishers."""

from __future__ import annotations

import re
from copy import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rmpa.core.errors import ConfigError, RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.format import NO_HASH, Ros2Attachment
from rmpa.ros.limits import DEFINITION_DEPTH_MAX
from rmpa.ros.types.definitions import Field, Specification

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.ros.types.installed import ServiceType


# A field of ROS 1 to one of ROS 2, each a path with dots.
FieldPaths = dict[str, str]


class TypePair(NamedTuple):
    """A type of ROS 2 for one of ROS 1.

    Args:
        name: ``package/msg/Name``, ``package/srv/Name`` or ``package/action/Name``.
        paths: The fields by path, if a rule lists them, else they go by name. Of a message they are under ``""``, of
            a service under ``request`` and ``response``, of an action under ``goal``, ``result`` and ``feedback``.
    """

    name: str
    paths: Mapping[str, FieldPaths] = {}

    @property
    def fields(self) -> FieldPaths | None:
        """The fields of a message, if a rule lists them."""
        return self.paths.get("")


class Ros2Sequences:
    """Counts gaps in the numbers that each publisher gives its messages.

    Attributes:
        lost: Messages that publishers sent and that did not come.
    """

    def __init__(self) -> None:
        self._last: dict[bytes, int] = {}
        self.lost = 0

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
            return False
        self._last[attachment.gid] = attachment.sequence
        if last is not None and attachment.sequence > last + 1:
            self.lost += attachment.sequence - last - 1
        return True

    def forget(self) -> None:
        """Begin anew: what comes next was not missed."""
        self._last.clear()


# The types of ROS 2. Their fields, their hashes, and the ROS 2 form of a type that ROS 1 defines.
#
# rosbags knows the types of each ROS 2 distribution. A type that it does not know, because a user defined it, is made
# from its ROS 1 definition: ROS 2 packages that were ported keep the fields, ``time`` and ``duration`` become
# messages of builtin_interfaces, and ``Header`` loses ``seq``. If the port differs, its hash differs (REP 2016), and
# the gateway reports that instead of sending what the other side would misread.


# The ROS 2 distributions whose types are known, with rosbags' store of each.
DISTRIBUTIONS: Final = {
    name.removeprefix("ROS2_").lower(): store
    for name, store in Stores.__members__.items()
    if name.startswith("ROS2_")
}
# Distributions before REP 2016: their endpoints have no type hash.
WITHOUT_HASH: Final = frozenset(("dashing", "eloquent", "foxy", "galactic", "humble"))
# ROS 1's primitive times, and the messages of ROS 2 that have the same 8 bytes.
TIMES: Final = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}
# The one field of a type of ROS 2 that has none.
EMPTY_MEMBER: Final = "structure_needs_at_least_one_member"
# rosidl makes ``char`` of a definition an unsigned byte (rosidl_adapter), and hashes it so; ROS 1's is one too.
_BASE_NAMES: Final = {"char": "uint8"}
_ARRAYS: Final = (Nodetype.ARRAY, Nodetype.SEQUENCE)
_HUMP: Final = re.compile(r"(?<=[a-z0-9])(?=[A-Z])")
# The fields of a type of ROS 2, each with what rosbags calls its description.
Fields = list[tuple[str, Any]]


@dataclass(frozen=True, slots=True)
class Ros2Field(Field):
    """One field of a type of ROS 2; an embedded type is ``package/msg/Name``.

    Args:
        bound: The most elements of a sequence; 0 for any.
        text: The most bytes of a string; 0 for any.
    """

    bound: int = 0
    text: int = 0


def ros2_fields(described: Fields) -> Iterator[Ros2Field]:
    """The fields of a type as rosbags describes them."""
    for name, desc in described:
        array = desc[0] in _ARRAYS
        inner, count = desc[1] if array else (desc, 0)
        kind, text = (str(inner[1]), 0) if inner[0] == Nodetype.NAME else inner[1]
        fixed = desc[0] == Nodetype.ARRAY
        yield Ros2Field(name, kind, array, count if fixed else None, 0 if fixed else count, text)


def _described(fields: Iterable[Field]) -> Fields:
    """The fields of a type of ROS 1 as rosbags describes those of its ROS 2 form."""
    made: Fields = []
    for field in fields:
        if field.primitive and field.type not in TIMES:
            kind: tuple[Nodetype, Any] = (Nodetype.BASE, (_BASE_NAMES.get(field.type, field.type), 0))
        else:
            kind = (Nodetype.NAME, TIMES.get(field.type) or ros2_name(field.type))
        if field.array:
            kind = (Nodetype.SEQUENCE if field.size is None else Nodetype.ARRAY, (kind, field.size or 0))
        made.append((snake_case(field.name), kind))
    return made


def _rosidl(desc: Any) -> Any:
    """A description of rosbags, which has ``char`` as a type of its own, as rosidl has it."""
    if desc[0] in _ARRAYS:
        return desc[0], (_rosidl(desc[1][0]), desc[1][1])
    return (desc[0], (_BASE_NAMES.get(desc[1][0], desc[1][0]), desc[1][1])) if desc[0] == Nodetype.BASE else desc


def ros2_name(name: str) -> str:
    """``package/Name`` of ROS 1 as ROS 2's ``package/msg/Name``; roslib's ``Header`` is std_msgs'."""
    package, _, base = name.partition("/")
    return f"{package}/msg/{base}" if base else "std_msgs/msg/Header"


def snake_case(name: str) -> str:
    """The name of a field as ROS 2 wants it: ``K`` is ``k``, ``frameId`` is ``frame_id``."""
    return _HUMP.sub("_", name).lower()


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
        begin = get_typestore(DISTRIBUTIONS[distribution])
        self.store = Typestore()
        self.store.fielddefs = {
            name: (constants, [(field, _rosidl(desc)) for field, desc in fields])
            for name, (constants, fields) in begin.fielddefs.items()
        }
        self.store.types = dict(begin.types)
        self._hashes: dict[str, str] = {}

    def __contains__(self, name: object) -> bool:
        """Whether the fields of ``package/msg/Name`` are known."""
        return name in self.store.fielddefs

    def fields(self, name: str) -> tuple[Ros2Field, ...]:
        """The fields of a type.

        Raises:
            KeyError: The type is not known.
        """
        return tuple(ros2_fields(self.store.fielddefs[name][1]))

    def take(self, types: Mapping[str, Any]) -> None:
        """Take in types in rosbags' form, constants and fields by name; those that are known stay as they are."""
        if made := {
            name: (constants, fields or [(EMPTY_MEMBER, (Nodetype.BASE, ("uint8", 0)))])
            for name, (constants, fields) in types.items()
            if name not in self
        }:
            self.store.register(made)

    def learn(self, specifications: Mapping[str, Specification]) -> None:
        """Take in the ROS 2 form of types that ROS 1 defines, with all that they embed, by ``package/Name``."""
        self.take({ros2_name(name): ([], _described(each.fields)) for name, each in specifications.items()})

    def define_as(self, name: str, specification: Specification) -> None:
        """Take in a type of ROS 2 with the fields of one of ROS 1."""
        self.take({name: ([], _described(specification.fields))})

    def define_service(self, name: str, request: Fields, response: Fields) -> None:
        """Take in a service type.

        rosidl describes it as a message with three members: request, response, and the event that service
        introspection publishes (rosidl_generator_type_description).

        Args:
            name: ``package/srv/Name``, or ``package/action/Name_SendGoal``.
            request: The request's fields.
            response: The response's fields.
        """
        kinds = [f"{name}_Request", f"{name}_Response", f"{name}_Event"]
        named = [(Nodetype.NAME, kind) for kind in kinds]
        one = [(Nodetype.SEQUENCE, (each, 1)) for each in named]
        info = (Nodetype.NAME, "service_msgs/msg/ServiceEventInfo")
        event = [("info", info), ("request", one[0]), ("response", one[1])]
        members = zip(("request_message", "response_message", "event_message"), named, strict=True)
        for kind, fields in zip((*kinds, name), (request, response, event, list(members)), strict=True):
            self.take({kind: ([], fields)})

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

    def known_hash(self, name: str) -> str:
        """The hash of a type; that which stands for none if the type is not known."""
        return self.type_hash(name) if name in self else NO_HASH

    def service_hash(self, service: ServiceType, name: str = "") -> str:
        """The hash of a service type, as it stands in keys and tokens; its request and response are learnt.

        Args:
            service: The ROS 1 type that has the fields.
            name: ``package/srv/Name`` of ROS 2; by default of ROS 1's name.
        """
        name = name or service.name.replace("/", "/srv/")
        if name not in self:
            for kind in (service.request, service.response):
                self.learn({key: each for key, each in kind.specifications.items() if key != kind.name})
            self.define_service(name, _described(service.request.fields), _described(service.response.fields))
        return self.type_hash(name)


# How large a type is with all that it embeds. Definitions of a few bytes can embed types billions of times.


def check_size(name: str, fields_of: Callable[[str], Iterable[Field]]) -> None:
    """Check a type, in time linear in the fields of the types that it embeds.

    Args:
        name: The type.
        fields_of: The fields of a type of either ROS; none of one that is not known.

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
            for field in fields_of(each):
                within = (1, 1) if field.primitive else measure(field.type, (*inside, each))
                parts += within[0]
                elements += (field.size or 1) * within[1]
            known[each] = parts, elements
        return known[each]

    parts, elements = measure(name, ())
    if parts > limits.ROS2_PARTS_MAX:
        raise RemoteProtocolError(f"{name} has more than {limits.ROS2_PARTS_MAX} fields with those of its types")
    if elements > limits.ROS2_ARRAY_MAX:
        raise RemoteProtocolError(f"{name} has arrays of more than {limits.ROS2_ARRAY_MAX} elements")
