"""What a neighbour of the gateway (other sites, ROS 2) needs of the gateway's own graph.

The gateway is a peer of the mesh that relays. Its core has the proxies of the modules at its site, which are *mesh
sources*; a neighbour carries those out. What a neighbour brings in are *foreign sources*; they become proxies in the
same core, which the relay offers to the modules. ``gateway.graph`` implements ``OwnGraph``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.ros.wire.services import ServiceDescription
    from rmpa.ros.wire.tcpros import Buffer, TopicDescription


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


class Tap(Protocol):
    """A subscription to one local source; it reconnects by itself until it is closed or the source is gone."""

    @property
    def description(self) -> TopicDescription | None:
        """The publisher's header; ``None`` until it is connected."""

    def close(self) -> None:
        """End it; no callback is called afterwards."""


class ForeignTopic(Protocol):
    """A foreign topic in the gateway's graph."""

    @property
    def problem(self) -> str:
        """Why it is not in the graph, or not understood by its subscribers; empty for nothing."""

    def describe(self, description: TopicDescription) -> None:
        """Set its type, md5 sum, definition and latching; until then its subscribers wait.

        Raises:
            ValueError: Type or md5 sum is missing.
        """

    def publish(self, body: Buffer) -> int:
        """Send one message (the TCPROS body without its length); return the messages dropped for slow subscribers."""

    def forget_latched(self) -> None:
        """Drop the latched message: its publisher is gone."""

    def close(self) -> None:
        """Take it out of the graph."""


class ForeignService(Protocol):
    """A foreign service in the gateway's graph."""

    @property
    def problem(self) -> str:
        """Why it is not in the graph; empty for nothing."""

    def close(self) -> None:
        """Take it out of the graph; calls under way get an error."""


class OwnGraph(Protocol):
    """The gateway's graph. Everything is called in the event loop, callbacks too."""

    @property
    def name(self) -> str:
        """The gateway's name among its peers."""

    @property
    def sources(self) -> Mapping[tuple[SourceKind, str, str], MeshSource]:
        """The local sources by kind, ``here`` and ``proxy``. What came from a neighbour is not among them."""

    def watch(self, on_change: Callable[[MeshSource, bool], None]) -> None:
        """Call ``on_change(source, there)`` for each source that is there now, and at each change."""

    def tap(
        self,
        source: MeshSource,
        on_message: Callable[[memoryview], None],
        on_described: Callable[[TopicDescription], None],
        on_lost: Callable[[str], None],
        *,
        listener: str = "",
    ) -> Tap:
        """Subscribe to a local topic.

        Args:
            source: The topic.
            on_message: ``(body)``: without its length; the view is valid during the call only.
            on_described: The publisher's header, at each connection, before its first message.
            on_lost: ``(reason)``: the connection ended or was refused; it is tried again while the source is there.
            listener: The node that the publisher sees; by default one of the gateway. Clients of actions want the one
                that publishes the status.
        """

    async def describe(self, source: MeshSource) -> ServiceDescription:
        """Ask a local service for its type.

        Raises:
            RmpaError: Its server does not answer.
        """

    async def call(self, source: MeshSource, request: Buffer, timeout: float) -> bytes | bytearray:  # noqa: ASYNC109
        """Call a local service.

        Args:
            source: The service.
            request: Serialized.
            timeout: Seconds for all.

        Returns:
            The serialized response.

        Raises:
            PeerRefused: The server answered with an error; its text is the error's.
            RmpaError: The server could not be reached, or did not answer in time.
        """

    def show_topic(self, source: ForeignSource, on_demand: Callable[[bool], None]) -> ForeignTopic:
        """Put a foreign topic into the graph, with its own proxy node and origin.

        Args:
            source: The topic.
            on_demand: ``(wanted)``: a first node or module has subscribed, or the last one has left.
        """

    def show_service(
        self,
        source: ForeignSource,
        serve: Callable[[bytes], Awaitable[bytes]],
        describe: Callable[[], Awaitable[ServiceDescription]],
    ) -> ForeignService:
        """Put a foreign service into the graph.

        Args:
            source: The service.
            serve: Awaited with each request for its response; an ``RmpaError`` is the client's error.
            describe: Awaited once a client or a module asks for its type; an ``RmpaError`` is the client's error.
        """


class Neighbour(Protocol):
    """One kind of neighbour, which the gateway starts and closes."""

    def start(self) -> None:
        """Begin, in the event loop: the graph and the session are there."""

    async def close(self) -> None:
        """Take back everything."""

    def report(self) -> dict[str, object]:
        """What ``rmpa site`` and the snapshot show of it, as JSON values."""
