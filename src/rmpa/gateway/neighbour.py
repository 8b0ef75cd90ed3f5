"""What passes between the gateway's graph and its neighbours (other sites, ROS 2): sources, and values of Zenoh.

The gateway is a peer of the mesh that relays. Its core has the proxies of the modules at its site, which are *mesh
sources*; a neighbour carries those out. What a neighbour brings in are *foreign sources*; they become proxies in the
same core, which the relay offers to the modules (``gateway.own_graph``).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, StrEnum
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


# Kind, name here, and node here.
SourceKey = tuple[SourceKind, str, str]


class Neighbour(Protocol):
    """One kind of neighbour, which the gateway starts and closes."""

    def start(self) -> None:
        """Begin, in the event loop: the graph and the session are there."""

    async def close(self) -> None:
        """Take back everything."""

    def report(self) -> dict[str, object]:
        """What ``rmpa site`` and the snapshot show of it, as JSON values."""


# Values of Zenoh that the neighbours and ``gateway.zenoh`` share. The library is imported only by the latter.


class ZenohPriority(IntEnum):
    """Zenoh's priorities; a lower number goes first."""

    REAL_TIME = 1
    INTERACTIVE_HIGH = 2
    INTERACTIVE_LOW = 3
    DATA_HIGH = 4
    DATA = 5
    DATA_LOW = 6
    BACKGROUND = 7


@dataclass(frozen=True, slots=True)
class ZenohQos:
    """The QoS of one publisher, and the bounds of its queue in this process.

    Args:
        reliable: Zenoh's reliability ``RELIABLE``; else ``BEST_EFFORT``.
        block: Congestion control ``BLOCK`` (it waits in a thread of its own); else ``DROP``.
        priority: Zenoh's priority.
        messages: Messages that wait at most; above it the oldest is dropped, and counted.
        bytes: Bytes that wait at most; one message always fits.
        cache: Samples that a later subscriber gets (an advanced publisher); 0: an ordinary publisher.
    """

    reliable: bool = True
    block: bool = True
    priority: ZenohPriority = ZenohPriority.DATA
    messages: int = 1000
    bytes: int = 64 * 1024 * 1024
    cache: int = 0


@dataclass(frozen=True, slots=True)
class ZenohSample:
    """One message that was received.

    Args:
        key: Its key.
        payload: Its bytes.
        attachment: Its attachment; empty if it has none.
    """

    key: str
    payload: bytes
    attachment: bytes


@dataclass(frozen=True, slots=True)
class ZenohReply:
    """One answer to ``get``.

    Args:
        key: The key that was answered; empty for an error.
        payload: The answer, or the error's text in UTF-8.
        attachment: Its attachment; empty if it has none.
        ok: Whether it is an answer and no error.
    """

    key: str
    payload: bytes
    attachment: bytes
    ok: bool
