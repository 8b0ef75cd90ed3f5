"""Two gateways of one site: two ways to one origin, of which each module has one; and what is told of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.policy import OUTSIDE_GUID, is_outside
from rmpa.gateway.foreign import foreign_origin
from rmpa.gateway.rules import ForeignSource, SourceKind
from rmpa.ros.wire.tcpros import ServiceDescription
from tests.agent.test_agent import Sink, node, until
from tests.agent.test_services import connect, provider, serving
from tests.gateway.graph.gateways import (
    STRING,
    STRING_MD5,
    Seen,
    Wanted,
    foreign_service,
    foreign_topic,
    joined,
    string,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings

PROXY = "/rmpa/warehouse/arm/talker"


def uri(agent: Agent, topic: str = "/scan") -> str:
    """The slave API of the proxy of the foreign topic in a module's graph; empty if there is none."""
    return agent.core.publishers(topic).get(PROXY, "")


async def add(request: bytes) -> bytes:
    return request * 2


async def described() -> ServiceDescription:
    return ServiceDescription("a/Add", STRING_MD5)


async def test_the_origin_of_a_site_is_the_same_at_all_its_gateways() -> None:
    origin = foreign_origin(foreign_topic())
    assert (origin.name, origin.node, origin.guid) == ("warehouse", "/arm/talker", OUTSIDE_GUID)
    assert origin.instance == "789188b721dd14a7e7f1c6bf92906707"
    assert is_outside(origin)
    ros2 = foreign_origin(ForeignSource(SourceKind.TOPIC, "ros2", "", "/ns/talker", "/chatter", "std_msgs/String"))
    assert (ros2.name, ros2.node) == ("ros2", "/ns/talker")


async def test_a_standby_shows_what_the_leader_has_but_as_no_source_of_its_own(
    settings: Callable[..., Settings],
) -> None:
    async with joined([settings("a")], [settings("g1"), settings("g2")]) as mesh:
        first, second = mesh.graphs
        (a, _, g2) = mesh.agents
        seen = Seen(second)
        shown = first.show_topic(foreign_topic(), Wanted())
        service = first.show_service(foreign_service(), add, described)
        await until(lambda: uri(a) and uri(g2) and provider(a) and provider(g2))
        assert not seen.of("/scan")
        assert not seen.of("/add")
        shown.close()
        service.close()
        await until(lambda: not uri(a) and not uri(g2) and not provider(g2))


async def test_two_gateways_that_both_have_a_source_show_it_once(settings: Callable[..., Settings]) -> None:
    async with (
        joined([settings("a")], [settings("g1"), settings("g2")]) as mesh,
        node("hearer", mesh.agents[0]) as hearer,
    ):
        agents, wants, sink = mesh.agents, [Wanted(), Wanted()], Sink()
        shown = [graph.show_topic(foreign_topic(), want) for graph, want in zip(mesh.graphs, wants, strict=True)]
        for one in shown:
            one.describe(STRING)
        await until(lambda: all(uri(agent) for agent in agents))
        await hearer.subscribe("/scan", "std_msgs/String", sink)
        await until(lambda: any(want.now for want in wants))
        assert not all(want.now for want in wants)
        assert all(list(agent.core.publishers("/scan")) == [PROXY] for agent in agents)
        best = wants.index(next(want for want in wants if want.now))
        shown[best].close()
        await until(lambda: wants[1 - best].now)
        shown[1 - best].publish(string("still there"))
        await until(lambda: sink.count(1))


async def test_a_module_s_own_service_goes_before_one_of_another_site(settings: Callable[..., Settings]) -> None:
    async with joined([settings("a"), settings("b")], [settings("g")]) as mesh:
        (graph,) = mesh.graphs
        (a, b, g) = mesh.agents
        shown = graph.show_service(foreign_service(), add, described)
        await until(lambda: provider(b) == "/rmpa/warehouse/arm/adder")
        async with serving(a):
            await until(lambda: provider(b) == "/rmpa/a/adder")
            await until(lambda: provider(g) == "/rmpa/a/adder")
            assert "a" in shown.problem
            connection = await connect(b)
            assert await connection.call(b"1", 20.0) == (True, b"1")
            connection.close()
        await until(lambda: provider(b) == "/rmpa/warehouse/arm/adder")
        assert shown.problem == ""
