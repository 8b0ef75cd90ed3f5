"""A gateway's own graph in memory, for tests of neighbours: the test's sources, and what neighbours show."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from rmpa.core.errors import PeerRefused
from rmpa.gateway.rules import ForeignSource, MeshSource, SourceKind
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import Buffer, ServiceDescription, TopicDescription

Key = tuple[SourceKind, str, str]


@dataclass(eq=False)
class MemoryTap:
    """A subscription to a source of the test, which is connected after a turn of the loop."""

    graph: MemoryGraph
    source: MeshSource
    on_message: Callable[[memoryview], None]
    on_described: Callable[[TopicDescription], None]
    listener: str
    description: TopicDescription | None = None
    closed: bool = False

    def close(self) -> None:
        self.closed = True
        self.graph.taps = [tap for tap in self.graph.taps if tap is not self]

    def describe(self) -> None:
        """Connect: the publisher's header, and its latched message; again if the publisher has started anew."""
        if self.closed:
            return
        if self not in self.graph.taps:
            self.graph.taps.append(self)
        self.description = self.graph.publishers[_key(self.source)]
        self.on_described(self.description)
        if self.source in self.graph.latched:
            self.on_message(memoryview(self.graph.latched[self.source]))


@dataclass(eq=False)
class MemoryTopic:
    """A topic that a neighbour shows."""

    graph: MemoryGraph
    source: ForeignSource
    on_demand: Callable[[bool], None]
    problem: str = ""
    description: TopicDescription | None = None
    messages: list[bytes] = field(default_factory=list)

    def describe(self, description: TopicDescription) -> None:
        self.description = description

    def publish(self, body: Buffer) -> int:
        self.messages.append(bytes(body))
        return 0

    def forget_latched(self) -> None:
        self.messages.append(b"forgotten")

    def close(self) -> None:
        if self.graph.topics.get((self.source.name, self.source.node)) is self:  # another may have its name
            del self.graph.topics[self.source.name, self.source.node]


@dataclass(eq=False)
class MemoryService:
    """A service that a neighbour shows."""

    graph: MemoryGraph
    source: ForeignSource
    serve: Callable[[bytes], Awaitable[bytes]]
    describe: Callable[[], Awaitable[ServiceDescription]]
    problem: str = ""

    def close(self) -> None:
        self.graph.services.pop(self.source.name)


class MemoryGraph:
    """The own graph of a gateway named ``gate``."""

    name = "gate"

    def __init__(self) -> None:
        self.sources: dict[Key, MeshSource] = {}
        self._watches: list[Callable[[MeshSource, bool], None]] = []
        self._servers: dict[Key, tuple[ServiceType, Callable[[bytes], bytes]]] = {}
        self.publishers: dict[Key, TopicDescription] = {}
        self.latched: dict[MeshSource, bytes] = {}
        self.taps: list[MemoryTap] = []
        self.topics: dict[tuple[str, str], MemoryTopic] = {}
        self.services: dict[str, MemoryService] = {}

    # --- what the test declares ------------------------------------------------------------------------------------

    def add(
        self, name: str, description: TopicDescription, node: str = "/talker", *, module: str = "arm"
    ) -> MeshSource:
        """A node of a module publishes."""
        source = _source(SourceKind.TOPIC, name, description.type, node, module)
        self.publishers[_key(source)] = description
        return self._add(source)

    def publisher(self, name: str, kind: MessageType, node: str = "/talker", latching: bool = False) -> MeshSource:
        """A node of the module ``arm`` publishes."""
        return self.add(name, kind.describe(latching=latching), node)

    def server(
        self, name: str, kind: ServiceType, serve: Callable[[bytes], bytes], node: str = "/server"
    ) -> MeshSource:
        """A node of the module ``arm`` has a service."""
        source = _source(SourceKind.SERVICE, name, "*", node)
        self._servers[_key(source)] = kind, serve
        return self._add(source)

    def remove(self, source: MeshSource) -> None:
        """A source is gone."""
        del self.sources[_key(source)]
        for watch in self._watches:
            watch(source, False)

    def send(self, source: MeshSource, body: bytes) -> int:
        """A publisher publishes; returns how many neighbours listen."""
        if self.publishers[_key(source)].latching:
            self.latched[source] = body
        taps = [tap for tap in self.taps if tap.source == source]
        for tap in taps:
            tap.on_message(memoryview(body))
        return len(taps)

    def describe_anew(self, source: MeshSource, description: TopicDescription) -> None:
        """The publisher starts again with another definition."""
        self.publishers[_key(source)] = description
        for tap in self.taps:
            asyncio.get_running_loop().call_soon(tap.describe)

    def _add(self, source: MeshSource) -> MeshSource:
        self.sources[_key(source)] = source
        for watch in self._watches:
            watch(source, True)
        return source

    # --- as AgentGraph ---------------------------------------------------------------------------------------------

    def watch(self, on_change: Callable[[MeshSource, bool], None]) -> None:
        self._watches.append(on_change)
        for source in list(self.sources.values()):
            on_change(source, True)

    def tap(
        self,
        source: MeshSource,
        on_message: Callable[[memoryview], None],
        on_described: Callable[[TopicDescription], None],
        _on_lost: Callable[[str], None],
        *,
        listener: str = "",
    ) -> MemoryTap:
        tap = MemoryTap(self, source, on_message, on_described, listener)
        asyncio.get_running_loop().call_soon(tap.describe)
        return tap

    async def describe(self, source: MeshSource) -> ServiceDescription:
        return self._servers[_key(source)][0].describe()

    async def call(self, source: MeshSource, request: Buffer, _timeout: float) -> bytes:
        try:
            return self._servers[_key(source)][1](bytes(request))
        except ValueError as error:
            raise PeerRefused(source.node, str(error)) from error

    def show_topic(self, source: ForeignSource, on_demand: Callable[[bool], None]) -> MemoryTopic:
        topic = self.topics[source.name, source.node] = MemoryTopic(self, source, on_demand)
        return topic

    def show_service(
        self,
        source: ForeignSource,
        serve: Callable[[bytes], Awaitable[bytes]],
        describe: Callable[[], Awaitable[ServiceDescription]],
    ) -> MemoryService:
        service = self.services[source.name] = MemoryService(self, source, serve, describe)
        return service


def _source(kind: SourceKind, name: str, type_name: str, node: str, module: str = "arm") -> MeshSource:
    return MeshSource(kind, module, "0" * 32, node, name, type_name, name, f"/rmpa/{module}{node}")


def _key(source: MeshSource) -> Key:
    return source.kind, source.here, source.proxy
