"""Sites in one process: gateways with a graph in memory, joined by Zenoh in memory, or by a real router."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from rmpa.bridge.policy import OPEN_GATE, BridgeContext, PermissionGate
from rmpa.config.peer_rules import ServiceRule
from rmpa.config.rules import CrossingRule
from rmpa.config.settings import ServiceSettings, Settings
from rmpa.core.contract import Contracts
from rmpa.core.statistics import Counters
from rmpa.gateway import limits
from rmpa.gateway.rules import CrossingRules
from rmpa.gateway.sites import topics
from rmpa.gateway.sites.keys import SiteGateway
from rmpa.gateway.sites.site import SiteNeighbour
from rmpa.gateway.sites.topics import ImportedTopic, SiteContext
from rmpa.gateway.topics import ExportedTopic
from rmpa.ros.wire.tcpros import TopicDescription
from tests.gateway.memory_graph import MemoryGraph, MemoryTopic
from tests.gateway.memory_zenoh import MemoryZenoh, eventually

MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


def site_context(
    name: str, graph: Any, session: Any, rules: CrossingRules | None = None, timeout: float = 30.0
) -> SiteContext:
    """What the parts of a site share; calls take ``timeout`` seconds at most."""
    services = ServiceSettings(rules=(ServiceRule(("/**",), timeout),))
    bridge = BridgeContext.of(Settings(services=services))
    return SiteContext(name, graph, session, rules or CrossingRules(), bridge, Contracts(()), Counters())


def described(latching: bool = False, md5sum: str = MD5, type_name: str = "odd_msgs/Odd") -> TopicDescription:
    """A header of a type that no other program knows."""
    return TopicDescription(type_name, md5sum, "string data\n", latching)


@dataclass(eq=False)
class Site:
    """One gateway of a site."""

    neighbour: SiteNeighbour
    graph: MemoryGraph
    session: Any

    def topic(self, name: str, node: str = "/talker") -> MemoryTopic:
        """A topic that is shown here."""
        return self.graph.topics[name, node]

    def shows(self, name: str, node: str = "/talker") -> bool:
        return (name, node) in self.graph.topics

    def exported(self, name: str, to: str = "") -> ExportedTopic:
        """A topic that goes out, to all or ``to`` one site."""
        entries = self.neighbour.exports.entries
        entry = next(each for each in entries if (each.announced.name, each.announced.to) == (name, to))
        export = self.neighbour.topics.exported(entry)
        assert export is not None
        return export

    def imported(self, name: str) -> ImportedTopic:
        """A topic that comes in."""
        (entry,) = (each for each in self.neighbour.imports.entries if each.source.name == name)
        topic = self.neighbour.imported[entry.source, entry.announced.name]
        assert isinstance(topic, ImportedTopic)
        return topic

    async def subscribed(self, name: str, node: str = "/talker") -> MemoryTopic:
        """Subscribe to a topic of the other site, and wait until its messages come."""
        await eventually(lambda: self.shows(name, node))
        topic = self.topic(name, node)
        topic.on_demand(True)
        await eventually(lambda: topic.description)
        return topic


@dataclass(eq=False)
class SiteBed:
    """Gateways of one network, which makes their sessions."""

    network: Any
    opened: list[Site] = field(default_factory=list)

    async def session(self) -> Any:
        made = self.network.session()
        return made if isinstance(self.network, MemoryZenoh) else await made

    async def site(
        self,
        name: str,
        rank: int = 100,
        *,
        graph: MemoryGraph | None = None,
        rules: tuple[CrossingRule, ...] = (),
        gate: PermissionGate = OPEN_GATE,
    ) -> Site:
        """Open one more gateway, and start it."""
        session, graph = await self.session(), graph or MemoryGraph()
        own = SiteGateway(name, rank, f"{len(self.opened) + 1:032x}")
        context = site_context(name, graph, session, CrossingRules(rules, gate=gate))
        site = Site(SiteNeighbour(context, own), graph, session)
        self.opened.append(site)
        site.neighbour.start()
        return site

    async def pair(self) -> tuple[Site, Site]:
        """The sites ``yard`` and ``hall``, which lead."""
        sites = await self.site("yard"), await self.site("hall")
        await eventually(lambda: all(site.neighbour.leads for site in sites))
        return sites


@contextlib.asynccontextmanager
async def site_bed(network: Any = None) -> AsyncIterator[SiteBed]:
    """A network without gateways, in memory by default; what they wait for is short, and all is closed at the end."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "LEADER_PATIENCE", 0.02)
        for name in ("_TAP_LINGER", "_DEMAND_LINGER", "_IDLE_CHECK"):
            patch.setattr(topics, name, 0.05)
        made = SiteBed(network or MemoryZenoh())
        try:
            yield made
        finally:
            for site in made.opened:
                await site.neighbour.close()
