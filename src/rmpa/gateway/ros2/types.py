"""The types of ROS 2: their fields, their hashes, and the ROS 2 form of a type that ROS 1 defines.

rosbags knows the types of each ROS 2 distribution. A type that it does not know, because a user defined it, is made
from its ROS 1 definition: ROS 2 packages that were ported keep the fields, ``time`` and ``duration`` become messages
of builtin_interfaces, and ``Header`` loses ``seq``. If the port differs, its hash differs (REP 2016), and the gateway
reports that instead of sending what the other side would misread.
"""

from __future__ import annotations

import re
from copy import copy
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from rmpa.ros.types.definitions import Field, Specification
    from rmpa.ros.types.installed import ServiceType

DISTRIBUTIONS: Final = {
    name.removeprefix("ROS2_").lower(): store
    for name, store in Stores.__members__.items()
    if name.startswith("ROS2_")
}
"""The ROS 2 distributions whose types are known, with rosbags' store of each."""
WITHOUT_HASH: Final = frozenset(("dashing", "eloquent", "foxy", "galactic", "humble"))
"""Distributions before REP 2016: their endpoints have no type hash."""
_TIMES: Final = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}
_BASES: Final = {"char": "uint8"}
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
            self.define_service(name, _fields(service.request.fields), _fields(service.response.fields))
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
        self.define(name, _fields(specification.fields))

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


def _fields(fields: Iterable[Field]) -> Fields:
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
        kind = (Nodetype.BASE, (_BASES.get(field.type, field.type), 0))
    else:
        kind = (Nodetype.NAME, ros2_name(field.type))
    if field.array:
        kind = (Nodetype.SEQUENCE if field.size is None else Nodetype.ARRAY, (kind, field.size or 0))
    return snake_case(field.name), kind


def _rosidl(desc: Any) -> Any:
    """A description of rosbags, which has ``char`` as a type of its own, as rosidl has it."""
    if desc[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return desc[0], (_rosidl(desc[1][0]), desc[1][1])
    return (desc[0], (_BASES.get(desc[1][0], desc[1][0]), desc[1][1])) if desc[0] == Nodetype.BASE else desc


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
