"""The identity of a peer, as in beacons and in the mesh's handshake."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core import limits

if TYPE_CHECKING:
    from ipaddress import IPv4Address

    from rmpa.core.guid import Guid

_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


def peer_name_problem(name: str) -> str | None:
    """The error text for an invalid peer name; ``None`` for a valid one.

    A peer's name becomes a part of its proxies' names in the ROS graph, so it is a ROS base name (REP 144).
    """
    if not name:
        return "a peer's name cannot be empty"
    if len(name) > limits.PEER_NAME_MAX:
        return f"a peer's name has at most {limits.PEER_NAME_MAX} characters"
    if not _NAME.fullmatch(name):
        return f"{name!r} is not a ROS base name (a letter, then letters, digits and _)"
    return None


def peer_name_from(text: str) -> str:
    """The nearest valid peer name for a host name: ``my-robot.local`` gives ``my_robot``."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", text.partition(".")[0])[: limits.PEER_NAME_MAX - 2]
    if not name or not name[0].isalpha():
        name = f"m_{name}" if name else "module"
    return name


@dataclass(frozen=True, slots=True)
class Identity:
    """One run of one agent.

    Args:
        guid: Its GUID, with the address and port at which peers should contact it.
        instance: 128 random bits (16 bytes), new at each start; distinguishes two peers with the same GUID.
        name: Its name, a ROS base name, unique among its peers.
        domain: Only peers of the same domain join.
        addresses: Its other numeric IPv4 addresses, best first; may be empty.

    Raises:
        ValueError: A part is out of its range.
    """

    guid: Guid
    instance: bytes
    name: str
    domain: int = 0
    addresses: tuple[IPv4Address, ...] = ()

    def __post_init__(self) -> None:
        if len(self.instance) != limits.INSTANCE_ID_BYTES:
            raise ValueError(f"an instance id has {limits.INSTANCE_ID_BYTES} bytes, not {len(self.instance)}")
        if problem := peer_name_problem(self.name):
            raise ValueError(problem)
        if not 0 <= self.domain <= limits.DOMAIN_MAX:
            raise ValueError(f"a domain id is between 0 and {limits.DOMAIN_MAX}, not {self.domain}")

    @property
    def endpoints(self) -> tuple[tuple[str, int], ...]:
        """The addresses to dial, best first: the GUID's own, then the others, without duplicates."""
        port = self.guid.port
        return tuple(dict.fromkeys([self.guid.endpoint, *((str(a), port) for a in self.addresses)]))

    def is_same_run(self, other: Identity) -> bool:
        """Whether two identities are of one run of one agent.

        The instance alone does not tell: each member of a mesh hears it, and may claim it. In a secured mesh only the
        name is proved.
        """
        return self.instance == other.instance and self.name == other.name

    def is_same_module(self, other: Identity, *, secured: bool) -> bool:
        """Whether two identities are of one module, perhaps of two runs of its agent.

        Args:
            other: The other identity.
            secured: Whether the mesh is secured. There the name alone tells, because the certificate proves it;
                else the same address and port do as well, since a module may have got another name.
        """
        return self.name == other.name or (not secured and self.guid.place == other.guid.place)

    def __str__(self) -> str:
        """``base (10.0.0.1:40001#7)``."""
        return f"{self.name} ({self.guid})"
