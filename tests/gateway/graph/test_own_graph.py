"""The gateway's own graph: what its neighbours get of the modules, and what the modules get of its neighbours."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.gateway.rules import SourceKind
from rmpa.ros.wire.tcpros import ServiceDescription
from tests.agent.test_agent import Sink, node, until
from tests.agent.test_services import connect, provider, serving
from tests.gateway.graph.gateways import (
    STRING,
    STRING_MD5,
    Seen,
    Tapped,
    Wanted,
    foreign_service,
    foreign_topic,
    joined,
    string,
    text,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.config.settings import Settings


async def test_a_module_s_topic_is_a_source_with_its_module_node_and_type(settings: Callable[..., Settings]) -> None:
    async with (
        joined([settings("a")], [settings("g")]) as mesh,
        node("talker", mesh.agents[0]) as talker,
        node("local", mesh.agents[1]) as local,
    ):
        (graph,) = mesh.graphs
        seen = Seen(graph)
        await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: seen.of("/chatter"))
        (source,) = seen.of("/chatter")
        assert (source.kind, source.module, source.node, source.name) == (
            SourceKind.TOPIC,
            "a",
            "/talker",
            "/chatter",
        )
        assert (source.kind, source.type, source.proxy) == (SourceKind.TOPIC, "std_msgs/String", "/rmpa/a/talker")
        (a, g) = mesh.agents
        assert source.instance == a.bridge.relay.instance
        await local.advertise("/own", "std_msgs/String")
        await until(lambda: seen.of("/own"))
        (source,) = seen.of("/own")
        assert (source.module, source.node, source.proxy) == ("g", "/local", "/local")
        assert source.instance == g.bridge.relay.instance
        assert dict(graph.sources) == seen.now
        assert not seen.of("/rosout")
        assert not any(source.here.startswith("/rmpa") for source in seen.now.values())
        await talker.close()
        await until(lambda: not seen.of("/chatter"))
        assert dict(graph.sources) == seen.now


async def test_a_tap_gets_every_message_and_is_the_only_demand(settings: Callable[..., Settings]) -> None:
    async with joined([settings("a")], [settings("g")]) as mesh, node("talker", mesh.agents[0]) as talker:
        (graph,) = mesh.graphs
        seen = Seen(graph)
        publisher = await talker.advertise("/chatter", "std_msgs/String")
        await until(lambda: seen.of("/chatter"))
        assert publisher.subscribers == 0
        tapped = Tapped(graph, seen.of("/chatter")[0])
        await until(lambda: publisher.subscribers and tapped.descriptions)
        (description,) = tapped.descriptions
        assert tapped.tap.description == description
        assert (description.type, description.md5sum) == ("std_msgs/String", STRING_MD5)
        assert "string data" in description.definition
        large = "x" * 3_000_000
        for i in range(200):
            publisher.publish(publisher.make({"data": f"number {i}"}))
        publisher.publish(publisher.make({"data": large}))
        publisher.publish(publisher.make({"data": "last"}))
        await until(lambda: len(tapped.bodies) == 202)
        heard = [text(body) for body in tapped.bodies]
        assert heard == [*(f"number {i}" for i in range(200)), large, "last"]
        assert "/rmpa/gateway" in mesh.agents[1].core.subscribers("/chatter")
        tapped.tap.close()
        await until(lambda: not publisher.subscribers)
        assert "/rmpa/gateway" not in mesh.agents[1].core.subscribers("/chatter")


async def test_a_tap_follows_a_node_that_restarts(settings: Callable[..., Settings]) -> None:
    async with joined([settings("a")], [settings("g")]) as mesh:
        (graph,) = mesh.graphs
        (_, g) = mesh.agents
        seen = Seen(graph)
        async with node("talker", g) as talker:
            await talker.advertise("/own", "std_msgs/String", latch=True)
            await until(lambda: seen.of("/own"))
            source = seen.of("/own")[0]
            tapped = Tapped(graph, source)
            await until(lambda: tapped.descriptions)
        await until(lambda: tapped.lost and not seen.of("/own"))
        async with node("talker", g) as talker:
            publisher = await talker.advertise("/own", "std_msgs/String", latch=True)
            publisher.publish(publisher.make({"data": "again"}))
            await until(lambda: tapped.bodies)
            assert text(tapped.bodies[-1]) == "again"
            assert seen.of("/own") == [source]


async def test_a_module_s_service_is_described_and_called(settings: Callable[..., Settings]) -> None:
    async with joined([settings("a")], [settings("g")]) as mesh:
        (graph,) = mesh.graphs
        seen = Seen(graph)
        async with serving(mesh.agents[0]) as server:
            await until(lambda: seen.of("/add"))
            (source,) = seen.of("/add")
            assert (source.kind, source.module, source.node, source.proxy) == (
                SourceKind.SERVICE,
                "a",
                "/adder",
                "/rmpa/a/adder",
            )
            assert (await graph.describe(source)).type == "a/Add"
            for body in (b"", b"1", b"x" * 3_000_000):
                assert bytes(await graph.call(source, memoryview(body), 20.0)) == body
            server.keeps = True
            with pytest.raises(UnreachableError):
                await graph.call(source, b"slow", 0.2)
        await until(lambda: not seen.of("/add"))
        with pytest.raises(UnreachableError):
            await graph.call(source, b"gone", 1.0)


async def test_a_foreign_topic_appears_at_each_module_under_its_site(settings: Callable[..., Settings]) -> None:
    async with (
        joined([settings("a")], [settings("g")]) as mesh,
        node("hearer", mesh.agents[0]) as hearer,
    ):
        (graph,) = mesh.graphs
        (a, g) = mesh.agents
        seen, wanted, sink = Seen(graph), Wanted(), Sink()
        shown = graph.show_topic(foreign_topic(), wanted)
        await until(lambda: "/rmpa/warehouse/arm/talker" in a.core.publishers("/scan"))
        assert "/rmpa/warehouse/arm/talker" in g.core.publishers("/scan")
        assert shown.problem == ""
        assert wanted.changes == []
        subscriber = await hearer.subscribe("/scan", "std_msgs/String", sink)
        await until(lambda: wanted.now)
        assert subscriber.publishers == 0, "it waits for the description"
        shown.describe(STRING)
        await until(lambda: subscriber.publishers)
        for i in range(100):
            assert shown.publish(string(f"number {i}")) == 0
        shown.publish(string("x" * 2_000_000))
        await until(lambda: sink.count(101))
        assert sink.heard[:100] == [f"number {i}" for i in range(100)]
        assert len(sink.heard[100]) == 2_000_000
        assert not seen.of("/scan"), "it is no source of the mesh"
        await subscriber.close()
        await until(lambda: not wanted.now)
        assert wanted.changes == [True, False]
        shown.close()
        await until(lambda: not a.core.publishers("/scan"))
        assert not g.core.publishers("/scan")
        await until(lambda: "/rmpa/warehouse/arm/talker" not in g.core.state().nodes)


async def test_a_foreign_service_is_called_by_a_node_of_a_module(settings: Callable[..., Settings]) -> None:
    async def serve(request: bytes) -> bytes:
        if request == b"bad":
            raise PeerRefused("warehouse", "no such thing")
        return request * 2

    async def describe() -> ServiceDescription:
        return ServiceDescription("a/Add", STRING_MD5)

    async with joined([settings("a")], [settings("g")]) as mesh:
        (graph,) = mesh.graphs
        (a, g) = mesh.agents
        seen = Seen(graph)
        shown = graph.show_service(foreign_service(), serve, describe)
        await until(lambda: provider(a) == "/rmpa/warehouse/arm/adder")
        connection = await connect(a)
        assert connection.description.type == "a/Add"
        assert await connection.call(b"12", 20.0) == (True, b"1212")
        ok, error = await connection.call(b"bad", 20.0)
        assert not ok
        assert b"no such thing" in error
        connection.close()
        assert not seen.of("/add")
        shown.close()
        await until(lambda: provider(a) == "" == provider(g))


async def test_of_two_sources_of_one_name_and_node_the_second_waits(settings: Callable[..., Settings]) -> None:
    async with joined([settings("a")], [settings("g")]) as mesh:
        (graph,) = mesh.graphs
        (a, _) = mesh.agents
        first = graph.show_topic(foreign_topic(), Wanted())
        second = graph.show_topic(foreign_topic(), Wanted())
        assert first.problem == ""
        assert "its name" in second.problem
        first.close()
        assert second.problem == ""
        second.describe(STRING)
        await until(lambda: a.core.publishers("/scan"))
        bad = graph.show_topic(foreign_topic(name="not global"), Wanted())
        assert "not global" in bad.problem
        bad.close()
        bad = graph.show_topic(foreign_topic(site="a site"), Wanted())
        assert "a site" in bad.problem
