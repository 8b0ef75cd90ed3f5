"""Whole modules and gateways in one process, on loopback; what a neighbour of a gateway would be is the test."""

from __future__ import annotations

from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from rmpa.agent.agent import Agent
from rmpa.gateway.own_graph import AgentGraph
from rmpa.gateway.rules import ForeignSource, MeshSource, SourceKind
from rmpa.ros.wire.tcpros import TopicDescription
from tests.agent.test_agent import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.config.settings import Settings

STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
STRING = TopicDescription("std_msgs/String", STRING_MD5, "string data\n")


@dataclass
class Joined:
    """Modules and gateways that are joined; the graphs are those of the gateways, in order."""

    agents: list[Agent] = field(default_factory=list)
    graphs: list[AgentGraph] = field(default_factory=list)


@asynccontextmanager
async def joined(modules: list[Settings], gateways: list[Settings]) -> AsyncIterator[Joined]:
    """Start modules and gateways, and wait until each is linked with each."""
    there = Joined()
    async with AsyncExitStack() as stack:
        for settings in modules:
            agent = Agent(settings)
            await agent.start()
            stack.push_async_callback(agent.close)
            there.agents.append(agent)
        for settings in gateways:
            relaying = replace(settings, relay=True)
            agent = Agent(relaying)
            graph = AgentGraph(agent, relaying)
            agent.bridge.add(graph)
            await agent.start()
            stack.push_async_callback(agent.close)
            await graph.begin()
            stack.push_async_callback(graph.end)
            there.agents.append(agent)
            there.graphs.append(graph)
        wanted = len(there.agents) - 1
        await until(lambda: all(len(list(agent.bridge.sessions.linked())) == wanted for agent in there.agents))
        yield there


class Seen:
    """What a neighbour gets of the sources of its gateway's graph."""

    def __init__(self, graph: AgentGraph) -> None:
        self.now: dict[tuple[SourceKind, str, str], MeshSource] = {}
        self.changes: list[tuple[str, bool]] = []
        graph.watch(self._changed)

    def _changed(self, source: MeshSource, there: bool) -> None:
        key = (source.kind, source.here, source.proxy)
        self.changes.append((source.here, there))
        if there:
            assert key not in self.now
            self.now[key] = source
        else:
            assert self.now.pop(key) == source

    def of(self, name: str) -> list[MeshSource]:
        return [source for source in self.now.values() if source.here == name]


class Tapped:
    """What a tap gets."""

    def __init__(self, graph: AgentGraph, source: MeshSource) -> None:
        self.bodies: list[bytes] = []
        self.descriptions: list[TopicDescription] = []
        self.lost: list[str] = []
        self.tap = graph.tap(
            source, lambda body: self.bodies.append(bytes(body)), self.descriptions.append, self.lost.append
        )


class Wanted:
    """The demand for a foreign topic."""

    def __init__(self) -> None:
        self.changes: list[bool] = []

    def __call__(self, wanted: bool) -> None:
        self.changes.append(wanted)

    @property
    def now(self) -> bool:
        return bool(self.changes) and self.changes[-1]


def foreign_topic(
    name: str = "/scan", site: str = "warehouse", module: str = "arm", node: str = "/talker"
) -> ForeignSource:
    return ForeignSource(SourceKind.TOPIC, site, module, node, name, "std_msgs/String")


def foreign_service(name: str = "/add", site: str = "warehouse", module: str = "arm") -> ForeignSource:
    return ForeignSource(SourceKind.SERVICE, site, module, "/adder", name, "a/Add")


def text(body: bytes) -> str:
    """The text of a serialized std_msgs/String."""
    return body[4:].decode()


def string(text: str) -> bytes:
    """A serialized std_msgs/String."""
    return len(text).to_bytes(4, "little") + text.encode()
