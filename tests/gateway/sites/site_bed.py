"""Sites in one process: gateways with a graph in memory, joined by a real Zenoh router."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from rmpa.bridge.context import BridgeContext
from rmpa.bridge.policy import OPEN_GATE
from rmpa.config.peer_rules import ServiceRule
from rmpa.config.settings import ServiceSettings, Settings
from rmpa.core.contract import Contracts
from rmpa.core.counters import Counters
from rmpa.gateway.rules import CrossingRules, MeshSource, SourceKind
from rmpa.gateway.sites.keys import SiteGateway
from rmpa.gateway.sites.site import SiteNeighbour
from rmpa.gateway.sites.topics import SiteContext
from rmpa.ros.wire.tcpros import TopicDescription
from tests.gateway.memory_graph import MemoryGraph, MemoryTap, MemoryTopic
from tests.gateway.zenoh_bed import ZenohBed, bed, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.bridge.policy import PermissionGate
    from rmpa.config.rules import CrossingRule
    from rmpa.core.contract import ContractRule
    from rmpa.gateway.sites.topics import ImportedTopic
    from rmpa.gateway.topics import Export
    from rmpa.gateway.zenoh.session import OpenSession

MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


def site_context(
    name: str,
    graph: object,
    session: object,
    rules: CrossingRules | None = None,
    contracts: tuple[ContractRule, ...] = (),
    timeout: float = 30.0,
) -> SiteContext:
    """What the parts of a site share; calls take ``timeout`` seconds at most."""
    services = ServiceSettings(rules=(ServiceRule(("/**",), timeout),))
    bridge = BridgeContext.of(Settings(services=services))
    made: tuple[Any, Any] = graph, session
    return SiteContext(name, *made, rules or CrossingRules(), bridge, Contracts(contracts), Counters())


def described(latching: bool = False, md5sum: str = MD5, type_name: str = "odd_msgs/Odd") -> TopicDescription:
    """A header of a type that no other program knows."""
    return TopicDescription(type_name, md5sum, "string data\n", latching)


class SiteGraph(MemoryGraph):
    """A graph whose publishers answer later, and give their latched message to each new connection."""

    def __init__(self) -> None:
        super().__init__()
        self.latched: dict[MeshSource, bytes] = {}

    def add(
        self, name: str, description: TopicDescription, *, module: str = "arm", node: str = "/talker", run: str = "0"
    ) -> MeshSource:
        """A node of a module publishes."""
        proxy = f"/rmpa/{module}{node}"
        source = MeshSource(SourceKind.TOPIC, module, run * 32, node, name, description.type, name, proxy)
        self._publishers[source.kind, name, proxy] = description
        return self._add(source)

    def describe_anew(self, source: MeshSource, description: TopicDescription) -> None:
        """The publisher starts again with another definition."""
        self._publishers[source.kind, source.here, source.proxy] = description
        for tap in self.taps:
            if tap.source == source:
                asyncio.get_running_loop().call_soon(self._describe, tap, tap.on_described)  # type: ignore[attr-defined]

    def send(self, source: MeshSource, body: bytes) -> int:
        if self._publishers[source.kind, source.here, source.proxy].latching:
            self.latched[source] = body
        return super().send(source, body)

    def tap(
        self,
        source: MeshSource,
        on_message: Callable[[memoryview], None],
        on_described: Callable[[TopicDescription], None],
        on_lost: Callable[[str], None],
        *,
        listener: str = "",
    ) -> MemoryTap:
        tap = LateTap(self, source, on_message, None, on_described)
        asyncio.get_running_loop().call_soon(self._describe, tap, on_described)
        return tap

    def _describe(self, tap: MemoryTap, on_described: Callable[[TopicDescription], None]) -> None:
        source = tap.source
        if isinstance(tap, LateTap) and tap.closed:
            return
        tap.description = self._publishers[source.kind, source.here, source.proxy]
        if tap not in self.taps:
            self.taps.append(tap)
        on_described(tap.description)
        if source in self.latched:
            tap.on_message(memoryview(self.latched[source]))


@dataclass(eq=False)
class LateTap(MemoryTap):
    """A tap that is connected after a turn of the loop."""

    on_described: Callable[[TopicDescription], None]
    closed: bool = False

    def close(self) -> None:
        self.closed = True
        super().close()


@dataclass(eq=False)
class Site:
    """One gateway of a site."""

    neighbour: SiteNeighbour
    graph: SiteGraph
    session: OpenSession

    def topic(self, name: str, node: str = "/talker") -> MemoryTopic:
        """A topic that is shown here."""
        return self.graph.topics[name, node]

    def shows(self, name: str, node: str = "/talker") -> bool:
        return (name, node) in self.graph.topics

    def exported(self, name: str, to: str = "") -> Export:
        """A topic that goes out, to all or ``to`` one site."""
        entries = self.neighbour.exports.entries
        entry = next(each for each in entries if (each.announced.name, each.announced.to) == (name, to))
        export = self.neighbour.topics.exported(entry)
        assert export is not None
        return export

    def imported(self, name: str) -> ImportedTopic:
        """A topic that comes in."""
        (entry,) = (each for each in self.neighbour.imports.entries if each.source.name == name)
        topic = self.neighbour.topics.imported(entry)
        assert topic is not None
        return topic

    async def subscribed(self, name: str, node: str = "/talker") -> MemoryTopic:
        """Subscribe to a topic of the other site, and wait until its messages come."""
        await until(lambda: self.shows(name, node))
        topic = self.topic(name, node)
        topic.on_demand(True)
        await until(lambda: topic.description)
        return topic


@dataclass(eq=False)
class SiteBed:
    """Gateways at one router."""

    zenoh: ZenohBed
    opened: list[Site] = field(default_factory=list)

    async def site(
        self,
        name: str,
        rank: int = 100,
        *,
        graph: SiteGraph | None = None,
        rules: tuple[CrossingRule, ...] = (),
        contracts: tuple[ContractRule, ...] = (),
        gate: PermissionGate = OPEN_GATE,
    ) -> Site:
        """Open one more gateway, and start it."""
        session = await self.zenoh.session()
        graph = graph if graph is not None else SiteGraph()
        own = SiteGateway(name, rank, f"{len(self.opened) + 1:032x}")
        context = site_context(name, graph, session, CrossingRules(rules, gate=gate), contracts)
        site = Site(SiteNeighbour(context, own), graph, session)
        self.opened.append(site)
        site.neighbour.start()
        return site

    async def pair(self) -> tuple[Site, Site]:
        """The sites ``yard`` and ``hall``, which lead."""
        sites = await self.site("yard"), await self.site("hall")
        await until(lambda: all(site.neighbour.leads for site in sites))
        return sites


@contextlib.asynccontextmanager
async def site_bed() -> AsyncIterator[SiteBed]:
    """A router without gateways; everything is closed at the end."""
    async with bed() as zenoh:
        made = SiteBed(zenoh)
        try:
            yield made
        finally:
            for site in made.opened:
                await site.neighbour.close()
