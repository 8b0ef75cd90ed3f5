"""The gateway's own graph: what its neighbours get of the modules, and what the modules get of its neighbours.

Whole modules and gateways run in one process, on loopback; what a neighbour of a gateway would be is the test.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace

import pytest

from rmpa.agent.agent import Agent
from rmpa.bridge.policy import is_outside
from rmpa.config.settings import Settings
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.core.identity import OUTSIDE_GUID
from rmpa.gateway.foreign import foreign_origin
from rmpa.gateway.own_graph import AgentGraph
from rmpa.gateway.rules import ForeignSource, MeshSource, SourceKind
from rmpa.ros.wire.tcpros import ServiceDescription, TopicDescription
from tests.agent.test_agent import Sink, node, until
from tests.agent.test_services import connect, provider, serving

STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"
STRING = TopicDescription("std_msgs/String", STRING_MD5, "string data\n")
SCAN = ForeignSource(SourceKind.TOPIC, "warehouse", "arm", "/talker", "/scan", "std_msgs/String")
ADD = ForeignSource(SourceKind.SERVICE, "warehouse", "arm", "/adder", "/add", "a/Add")
TALKER, ADDER = "/rmpa/warehouse/arm/talker", "/rmpa/warehouse/arm/adder"


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
        for settings in (*modules, *(replace(each, relay=True) for each in gateways)):
            agent = Agent(settings)
            graph = AgentGraph(agent, settings) if settings.relay else None
            if graph is not None:
                agent.bridge.add(graph)
            await agent.start()
            stack.push_async_callback(agent.close)
            there.agents.append(agent)
            if graph is not None:
                await graph.begin()
                stack.push_async_callback(graph.end)
                there.graphs.append(graph)
        wanted = len(there.agents) - 1
        await until(lambda: all(len(list(agent.bridge.sessions.linked())) == wanted for agent in there.agents))
        yield there


@pytest.fixture
async def mesh(settings: Callable[..., Settings]) -> AsyncIterator[Joined]:
    """The module ``a`` and the gateway ``g``."""
    async with joined([settings("a")], [settings("g")]) as there:
        yield there


class Seen:
    """What a neighbour gets of the sources of its gateway's graph."""

    def __init__(self, graph: AgentGraph) -> None:
        self.now: dict[tuple[SourceKind, str, str], MeshSource] = {}
        graph.watch(self._changed)

    def _changed(self, source: MeshSource, there: bool) -> None:
        key = (source.kind, source.here, source.proxy)
        if there:
            assert key not in self.now
            self.now[key] = source
        else:
            assert self.now.pop(key) == source

    def of(self, name: str) -> list[MeshSource]:
        return [source for source in self.now.values() if source.here == name]

    async def one(self, name: str) -> MeshSource:
        """The only source of this name, once it is there."""
        await until(lambda: self.of(name))
        (source,) = self.of(name)
        return source


class Tapped:
    """What a tap gets."""

    def __init__(self, graph: AgentGraph, source: MeshSource) -> None:
        self.texts: list[str] = []
        self.descriptions: list[TopicDescription] = []
        self.lost: list[str] = []
        self.tap = graph.tap(
            source,
            lambda body: self.texts.append(bytes(body[4:]).decode()),
            self.descriptions.append,
            self.lost.append,
        )


class Wanted(list[bool]):
    """The changes of the demand for a foreign topic."""

    @property
    def now(self) -> bool:
        return bool(self) and self[-1]


def string(text: str) -> bytes:
    """A serialized std_msgs/String."""
    return len(text).to_bytes(4, "little") + text.encode()


async def twice(request: bytes) -> bytes:
    if request == b"bad":
        raise PeerRefused("warehouse", "no such thing")
    return request * 2


async def described() -> ServiceDescription:
    return ServiceDescription("a/Add", STRING_MD5)


# --- what neighbours get of the modules -----------------------------------------------------------------------------


async def test_topics_are_sources_with_module_node_and_type_and_a_tap_gets_every_message(mesh: Joined) -> None:
    (graph,), (a, g) = mesh.graphs, mesh.agents
    seen, large = Seen(graph), "x" * 3_000_000
    async with node("talker", a) as talker, node("local", g) as local:
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        await local.advertise("/own", "std_msgs/String")
        kind, run, own_run = "std_msgs/String", a.bridge.relay.instance, g.bridge.relay.instance
        source = await seen.one("/chatter")
        assert source == MeshSource(
            SourceKind.TOPIC, "a", run, "/talker", "/chatter", kind, "/chatter", "/rmpa/a/talker"
        )
        own = MeshSource(SourceKind.TOPIC, "g", own_run, "/local", "/own", kind, "/own", "/local")
        assert await seen.one("/own") == own
        assert {each.here for each in seen.now.values() if each.kind is SourceKind.TOPIC} == {"/chatter", "/own"}
        assert publisher.subscribers == 0
        tapped = Tapped(graph, source)
        await until(lambda: publisher.subscribers and tapped.descriptions)
        (description,) = tapped.descriptions
        assert tapped.tap.description == description
        assert (description.type, description.md5sum) == (kind, STRING_MD5)
        assert "string data" in description.definition
        texts = [*(f"number {i}" for i in range(200)), large, "last"]
        for text in texts:
            publisher.publish(publisher.make({"data": text}))
        await until(lambda: tapped.texts == texts)
        assert "/rmpa/gateway" in g.core.subscribers("/chatter")
        tapped.tap.close()
        await until(lambda: not publisher.subscribers)
        assert "/rmpa/gateway" not in g.core.subscribers("/chatter")
    await until(lambda: not seen.of("/chatter"))
    assert Seen(graph).now == seen.now, "who comes later is told the same"


async def test_a_tap_follows_a_node_that_restarts(mesh: Joined) -> None:
    (graph,), (_, g) = mesh.graphs, mesh.agents
    seen = Seen(graph)
    async with node("talker", g) as talker:
        await talker.advertise("/own", "std_msgs/String", latch=True)
        source = await seen.one("/own")
        tapped = Tapped(graph, source)
        await until(lambda: tapped.descriptions)
    await until(lambda: tapped.lost and not seen.of("/own"))
    async with node("talker", g) as talker:
        publisher = await talker.advertise("/own", "std_msgs/String", latch=True)
        publisher.publish(publisher.make({"data": "again"}))
        await until(lambda: tapped.texts == ["again"])
        assert seen.of("/own") == [source]


async def test_a_module_s_service_is_described_and_called(mesh: Joined) -> None:
    (graph,) = mesh.graphs
    seen = Seen(graph)
    async with serving(mesh.agents[0]) as server:
        source = await seen.one("/add")
        assert (source.module, source.node, source.proxy) == ("a", "/adder", "/rmpa/a/adder")
        assert (await graph.describe(source)).type == "a/Add"
        for body in (b"", b"1", b"x" * 3_000_000):
            assert bytes(await graph.call(source, memoryview(body), 20.0)) == body
        server.keeps = True
        with pytest.raises(RmpaError, match=r"within 0\.[12]"):  # the module's own deadline may be the first
            await graph.call(source, b"slow", 0.2)
    await until(lambda: not seen.of("/add"))
    with pytest.raises(UnreachableError):
        await graph.call(source, b"gone", 1.0)


# --- what modules get of neighbours ---------------------------------------------------------------------------------


async def test_a_foreign_topic_appears_at_each_module_under_its_site(mesh: Joined) -> None:
    (graph,), (a, g) = mesh.graphs, mesh.agents
    seen, wanted, sink = Seen(graph), Wanted(), Sink()
    async with node("hearer", a) as hearer:
        shown = graph.show_topic(SCAN, wanted.append)
        await until(lambda: TALKER in a.core.publishers("/scan"))
        assert TALKER in g.core.publishers("/scan")
        assert (shown.problem, wanted) == ("", [])
        subscriber = await hearer.subscribe("/scan", "std_msgs/String", sink)
        await until(lambda: wanted.now)
        assert subscriber.publishers == 0, "it waits for the description"
        shown.describe(STRING)
        await until(lambda: subscriber.publishers)
        texts = [*(f"number {i}" for i in range(100)), "x" * 2_000_000]
        assert [shown.publish(string(text)) for text in texts] == [0] * 101
        await until(lambda: sink.heard == texts)
        assert not seen.of("/scan"), "it is no source of the mesh"
        await subscriber.close()
        await until(lambda: wanted == [True, False])
        shown.close()
        await until(lambda: not a.core.publishers("/scan"))
        assert not g.core.publishers("/scan")
        await until(lambda: TALKER not in g.core.state().nodes)


async def test_a_foreign_service_is_called_by_a_node_of_a_module(mesh: Joined) -> None:
    (graph,), (a, g) = mesh.graphs, mesh.agents
    seen = Seen(graph)
    shown = graph.show_service(ADD, twice, described)
    await until(lambda: provider(a) == ADDER)
    connection = await connect(a)
    assert connection.description.type == "a/Add"
    assert await connection.call(b"12", 20.0) == (True, b"1212")
    ok, error = await connection.call(b"bad", 20.0)
    assert (ok, b"no such thing" in error) == (False, True)
    connection.close()
    assert not seen.of("/add")
    shown.close()
    await until(lambda: provider(a) == "" == provider(g))


async def test_of_two_sources_of_one_name_and_node_the_second_waits(mesh: Joined) -> None:
    (graph,), (a, _) = mesh.graphs, mesh.agents
    first, second = (graph.show_topic(SCAN, Wanted().append) for _ in range(2))
    assert first.problem == ""
    assert "its name" in second.problem
    first.close()
    assert second.problem == ""
    second.describe(STRING)
    await until(lambda: a.core.publishers("/scan"))
    for bad in (replace(SCAN, name="not global"), replace(SCAN, site="a site")):
        refused = graph.show_topic(bad, Wanted().append)
        assert (bad.name if bad.name != SCAN.name else bad.site) in refused.problem
        refused.close()


# --- two gateways of one site, which are two ways to one origin -----------------------------------------------------


async def test_the_origin_of_a_site_is_the_same_at_all_its_gateways() -> None:
    origin = foreign_origin(SCAN)
    assert (origin.name, origin.node, origin.guid) == ("warehouse", "/arm/talker", OUTSIDE_GUID)
    assert origin.instance == "789188b721dd14a7e7f1c6bf92906707"
    assert is_outside(origin)
    ros2 = foreign_origin(replace(SCAN, site="ros2", module="", node="/ns/talker"))
    assert (ros2.name, ros2.node) == ("ros2", "/ns/talker")


async def test_of_two_gateways_a_standby_shows_what_the_leader_has_and_both_show_a_source_once(
    settings: Callable[..., Settings],
) -> None:
    async with (
        joined([settings("a")], [settings("g1"), settings("g2")]) as mesh,
        node("hearer", mesh.agents[0]) as hearer,
    ):
        (first, second), agents = mesh.graphs, mesh.agents
        wants, seen, sink = [Wanted(), Wanted()], Seen(second), Sink()

        def shown_at() -> list[bool]:
            return [list(agent.core.publishers("/scan")) == [TALKER] for agent in agents]

        shown = [first.show_topic(SCAN, wants[0].append)]
        service = first.show_service(ADD, twice, described)
        await until(lambda: all(shown_at()) and all(provider(agent) == ADDER for agent in agents))
        assert not seen.now, "what the leader has is no source of the standby's own"
        service.close()
        await until(lambda: not any(provider(agent) for agent in agents))
        shown.append(second.show_topic(SCAN, wants[1].append))
        for one in shown:
            one.describe(STRING)
        await hearer.subscribe("/scan", "std_msgs/String", sink)
        await until(lambda: any(want.now for want in wants))
        assert not all(want.now for want in wants)
        assert all(shown_at())
        best = wants.index(next(want for want in wants if want.now))
        shown[best].close()
        await until(lambda: wants[1 - best].now)
        shown[1 - best].publish(string("still there"))
        await until(lambda: sink.count(1))
        shown[1 - best].close()
        await until(lambda: not any(agent.core.publishers("/scan") for agent in agents))


async def test_a_module_s_own_service_goes_before_one_of_another_site(settings: Callable[..., Settings]) -> None:
    async with joined([settings("a"), settings("b")], [settings("g")]) as mesh:
        (graph,), (a, b, g) = mesh.graphs, mesh.agents
        shown = graph.show_service(ADD, twice, described)
        await until(lambda: provider(b) == ADDER)
        async with serving(a):
            await until(lambda: provider(b) == "/rmpa/a/adder" == provider(g))
            assert "a" in shown.problem
            connection = await connect(b)
            assert await connection.call(b"1", 20.0) == (True, b"1")
            connection.close()
        await until(lambda: provider(b) == ADDER)
        assert shown.problem == ""
