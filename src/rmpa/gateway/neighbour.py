"""What a neighbour of the gateway (other sites, ROS 2) carries between its graph and the gateway's own one.

The gateway is a peer of the mesh that relays. Its core has the proxies of the modules at its site, which are *mesh
sources*; a neighbour carries those out. What a neighbour brings in are *foreign sources*; they become proxies in the
same core, which the relay offers to the modules (``gateway.graph``).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol


class SourceKind(StrEnum):
    """What a source is; the value is its chunk in the keys of sites."""

    TOPIC = "t"
    SERVICE = "s"


@dataclass(frozen=True, slots=True)
class MeshSource:
    """A topic of one publisher, or a service, that a module at this site has.

    Args:
        kind: What it is.
        module: The module's name.
        instance: The module's run, 32 hexadecimal digits.
        node: The node in the module's graph, ``/like/this``.
        name: The topic or service in the module's graph.
        type: ``package/Name``; ``*`` for a service whose server was not asked.
        here: The topic or service in the gateway's graph.
        proxy: The node in the gateway's graph.
    """

    kind: SourceKind
    module: str
    instance: str
    node: str
    name: str
    type: str
    here: str
    proxy: str


@dataclass(frozen=True, slots=True)
class ForeignSource:
    """A topic of one publisher, or a service, that a neighbour has.

    Args:
        kind: What it is.
        site: The site's name, or ``ros2``: its proxies are ``/rmpa/<site>/…``.
        module: The module at that site; empty where the neighbour has none.
        node: The node in the module's graph.
        name: The topic or service in the gateway's graph, after the rules for names.
        type: ``package/Name`` of ROS 1.
    """

    kind: SourceKind
    site: str
    module: str
    node: str
    name: str
    type: str


class Neighbour(Protocol):
    """One kind of neighbour, which the gateway starts and closes."""

    def start(self) -> None:
        """Begin, in the event loop: the graph and the session are there."""

    async def close(self) -> None:
        """Take back everything."""

    def report(self) -> dict[str, object]:
        """What ``rmpa site`` and the snapshot show of it, as JSON values."""
