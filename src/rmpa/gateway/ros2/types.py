"""The types of ROS 2: their fields, their hashes, and the ROS 2 form of a type that ROS 1 defines.

rosbags knows the types of each ROS 2 distribution. A type that it does not know, because a user defined it, is made
from its ROS 1 definition: ROS 2 packages that were ported keep the fields, ``time`` and ``duration`` become messages
of builtin_interfaces, and ``Header`` loses ``seq``. If the port differs, its hash differs (REP 2016), and the gateway
reports that instead of sending what the other side would misread.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rmpa.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.ros.types.definitions import Field, Specification
    from rmpa.ros.types.service_types import ServiceType

DISTRIBUTIONS: Final = {
    name.removeprefix("ROS2_").lower(): store
    for name, store in Stores.__members__.items()
    if name.startswith("ROS2_")
}
"""The ROS 2 distributions whose types are known, with rosbags' store of each."""
WITHOUT_HASH: Final = frozenset(("dashing", "eloquent", "foxy", "galactic", "humble"))
"""Distributions before REP 2016: their endpoints have no type hash."""
_TIMES: Final = {"time": "builtin_interfaces/msg/Time", "duration": "builtin_interfaces/msg/Duration"}
_BASES: Final = {"char": "uint8", "byte": "octet"}
"""ROS 1's names of bytes: its ``char`` is unsigned, its ``byte`` is ROS 2's ``byte`` (an octet)."""
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
        self.store.fielddefs = dict(known_types.fielddefs)
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

    def service_hash(self, service: ServiceType) -> str:
        """The hash of a service type, as it stands in keys and tokens.

        rosidl hashes a service as a message with three members: request, response and the event that service
        introspection publishes (rosidl_generator_type_description). The fields of request and response are learnt.

        Args:
            service: The ROS 1 type of the same name.
        """
        if self.distribution in WITHOUT_HASH:
            return NO_HASH
        package, _, base = service.name.partition("/")
        name = f"{package}/srv/{base}"
        if name not in self._hashes:
            self._learn_service(name, service)
            self._hashes[name] = self.store.hash_rihs01(name)
        return self._hashes[name]

    def _learn_service(self, name: str, service: ServiceType) -> None:
        request, response, event = (f"{name}_{part}" for part in ("Request", "Response", "Event"))
        made: dict[str, Any] = {}
        for part, kind in ((request, service.request), (response, service.response)):
            self.learn({key: each for key, each in kind.specifications.items() if key != kind.name})
            made[part] = ([], [_field(field) for field in kind.fields] or [_EMPTY_FIELD])
        # rosbags has ROS 2's char for the GID; rosidl says uint8, and that is what is hashed.
        gid = ((Nodetype.BASE, ("uint8", 0)), 16)
        made[_EVENT_INFO] = (
            [],
            [
                ("event_type", (Nodetype.BASE, ("uint8", 0))),
                ("stamp", (Nodetype.NAME, _TIMES["time"])),
                ("client_gid", (Nodetype.ARRAY, gid)),
                ("sequence_number", (Nodetype.BASE, ("int64", 0))),
            ],
        )
        made[event] = (
            [],
            [
                ("info", (Nodetype.NAME, _EVENT_INFO)),
                ("request", (Nodetype.SEQUENCE, ((Nodetype.NAME, request), 1))),
                ("response", (Nodetype.SEQUENCE, ((Nodetype.NAME, response), 1))),
            ],
        )
        members = (("request_message", request), ("response_message", response), ("event_message", event))
        made[name] = ([], [(member, (Nodetype.NAME, kind)) for member, kind in members])
        self.store.fielddefs.pop(_EVENT_INFO, None)
        self.store.types.pop(_EVENT_INFO, None)
        self.store.register({key: each for key, each in made.items() if key not in self})


_EMPTY_FIELD: Final = (_EMPTY_MEMBER, (Nodetype.BASE, ("uint8", 0)))


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
        kind = (Nodetype.ARRAY if field.size else Nodetype.SEQUENCE, (kind, field.size))
    return snake_case(field.name), kind


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
