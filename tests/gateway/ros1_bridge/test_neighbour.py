"""The neighbour against programs of plain eclipse-zenoh that do what zenoh-bridge-ros1 does, in its format."""

from __future__ import annotations

import asyncio
import contextlib
import json
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.config.gateway_rules import Crossing, CrossingRule
from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.gateway.ros1_bridge import limits
from rmpa.gateway.ros1_bridge.io.neighbour import Ros1BridgeNeighbour
from rmpa.gateway.sites.rules import CrossingRules
from rmpa.gateway.zenoh.config import ZenohConfig
from rmpa.ros.types.find import find_message_type, find_service_type
from tests.gateway.memory_graph import MemoryGraph
from tests.gateway.zenoh_bed import ZenohBed, bed, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

zenoh = pytest.importorskip("zenoh")

STRING = find_message_type("std_msgs/String")
TRIGGER = find_service_type("std_srvs/Trigger")
STRING_KEY = f"{b'std_msgs/String'.hex()}/{STRING.md5sum}/*"
TRIGGER_KEY = f"{b'std_srvs/Trigger'.hex()}/{TRIGGER.describe().md5sum}/*"


class Bridge:
    """What zenoh-bridge-ros1 does with Zenoh (its discovery.rs, abstract_bridge.rs)."""

    def __init__(self, session: Any) -> None:
        self.session = session
        self._beacons: dict[str, Any] = {}
        self.heard: set[str] = set()
        self._listening = session.declare_subscriber(
            "ros1_discovery_info/*/*/*/*/*/*/**", lambda sample: self.heard.add(str(sample.key_expr))
        )
        self.samples: list[bytes] = []

    def announce(self, kind: str, key: str) -> None:
        self._beacons[f"ros1_discovery_info/*/{kind}/{key}"] = self.session.declare_publisher(
            f"ros1_discovery_info/*/{kind}/{key}",
            reliability=zenoh.Reliability.BEST_EFFORT,
            allowed_destination=zenoh.Locality.REMOTE,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.BACKGROUND,
        )
        self.beat()

    def silence(self, kind: str, key: str) -> None:
        self._beacons.pop(f"ros1_discovery_info/*/{kind}/{key}").undeclare()

    def beat(self) -> None:
        for beacon in self._beacons.values():
            beacon.put(b"")

    def announced(self, kind: str, key: str) -> bool:
        """Whether another announces this, in whichever namespace of discovery."""
        return any(heard.split("/", 3)[2:] == [kind, key] for heard in self.heard)

    def bridge_from_zenoh(self, key: str) -> Any:
        return self.session.declare_subscriber(key, lambda sample: self.samples.append(sample.payload.to_bytes()))

    def bridge_to_zenoh(self, key: str) -> Any:
        return self.session.declare_publisher(
            key,
            reliability=zenoh.Reliability.RELIABLE,
            allowed_destination=zenoh.Locality.REMOTE,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def serve(self, key: str, answer: Callable[[bytes], bytes]) -> Any:
        def asked(query: Any) -> None:
            if query.payload is not None:  # the bridge never answers a query without a payload
                query.reply(query.key_expr, answer(query.payload.to_bytes()))

        return self.session.declare_queryable(key, asked)

    async def call(self, key: str, request: bytes) -> Any:
        return await asyncio.to_thread(lambda: list(self.session.get(key, payload=request, timeout=5.0)))


async def open_bridge(net: ZenohBed) -> Bridge:
    config = zenoh.Config()
    for key, value in ZenohConfig(connect=(net.endpoint,)).entries().items():
        config.insert_json5(key, json.dumps(value))
    return Bridge(await asyncio.to_thread(lambda: zenoh.open(config)))


class Setting:
    """A gateway's neighbour over a graph in memory, and a bridge."""

    def __init__(self, net: ZenohBed, graph: MemoryGraph, neighbour: Ros1BridgeNeighbour, bridge: Bridge) -> None:
        self.net = net
        self.graph = graph
        self.neighbour = neighbour
        self.bridge = bridge

    async def beating(self, condition: Callable[[], object]) -> None:
        """Wait, while the bridge announces as it does."""
        async with asyncio.timeout(30):
            while not condition():
                self.bridge.beat()
                await asyncio.sleep(0.05)


@contextlib.asynccontextmanager
async def joined(*rules: CrossingRule) -> AsyncIterator[Setting]:
    async with bed() as net:
        graph = MemoryGraph()
        neighbour = Ros1BridgeNeighbour(graph, await net.session(), CrossingRules(rules), "*", lambda _: 5.0)
        bridge = await open_bridge(net)
        try:
            neighbour.start()
            yield Setting(net, graph, neighbour, bridge)
        finally:
            await neighbour.close()
            await asyncio.to_thread(bridge.session.close)


async def test_a_topic_of_a_module_reaches_a_bridge_once_it_subscribes() -> None:
    async with joined() as its:
        source = its.graph.publisher("/chatter", STRING)
        await until(lambda: its.bridge.announced("pub", f"{STRING_KEY}/chatter"))
        assert its.graph.send(source, b"nobody hears it") == 0
        its.bridge.bridge_from_zenoh(f"{STRING_KEY}/chatter")
        await until(lambda: its.graph.taps)
        body = STRING.serialize(STRING.make({"data": "hello"}))
        its.graph.send(source, body)
        await until(lambda: its.bridge.samples)
        assert its.bridge.samples == [body]


async def test_a_topic_of_an_unknown_type_is_announced_with_the_sum_of_its_publisher() -> None:
    kind = type(STRING).learn("robots/Arm", "float64 angle\n")
    async with joined() as its:
        its.graph.publisher("/arm", kind)
        await until(lambda: its.bridge.announced("pub", f"{b'robots/Arm'.hex()}/{kind.md5sum}/*/arm"))
        await until(lambda: not its.graph.taps)  # it was asked for its type, and nothing more


async def test_a_topic_of_a_bridge_comes_once_a_node_subscribes_and_goes_with_its_presence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(limits, "PRESENCE_LEASE", 1.0)
    async with joined() as its:
        key = f"{STRING_KEY}/chatter"
        its.bridge.announce("pub", key)
        await its.beating(lambda: its.graph.topics)
        (topic,) = its.graph.topics.values()
        assert (topic.source.name, topic.source.site, topic.source.type) == (
            "/chatter",
            "ros1_bridge",
            "std_msgs/String",
        )
        assert topic.description == STRING.describe()
        publisher = its.bridge.bridge_to_zenoh(key)
        assert not publisher.matching_status.matching
        topic.on_demand(True)
        await its.beating(lambda: publisher.matching_status.matching)
        await its.beating(lambda: its.bridge.announced("sub", key))
        publisher.put(b"\x02\x00\x00\x00hi")
        await its.beating(lambda: topic.messages)
        topic.on_demand(False)
        await its.beating(lambda: not publisher.matching_status.matching)
        its.bridge.silence("pub", key)
        await until(lambda: not its.graph.topics)
        assert topic.messages == [b"\x02\x00\x00\x00hi"]


async def test_a_bridge_calls_a_service_of_a_module_and_gets_its_error_as_one() -> None:
    def serve(request: bytes) -> bytes:
        if request:
            raise ValueError("no such request")
        return b"\x01\x02\x00\x00\x00ok"

    async with joined() as its:
        its.graph.server("/stop", TRIGGER, serve)
        key = f"{TRIGGER_KEY}/stop"
        await until(lambda: its.bridge.announced("srv", key))
        (reply,) = await its.bridge.call(key, b"")
        assert reply.ok.payload.to_bytes() == b"\x01\x02\x00\x00\x00ok"
        (refused,) = await its.bridge.call(key, b"x")
        assert refused.err.payload.to_bytes() == b"no such request"


async def test_a_node_calls_a_service_of_a_bridge_also_with_an_empty_request() -> None:
    async with joined() as its:
        key = f"{TRIGGER_KEY}/stop"
        served = its.bridge.serve(key, lambda request: b"done" + request)
        its.bridge.announce("srv", key)
        await its.beating(lambda: its.graph.services)
        await its.beating(lambda: its.bridge.announced("cl", key))
        service = its.graph.services["/stop"]
        assert await service.serve(b"") == b"done"
        assert (await service.describe()).md5sum == TRIGGER.describe().md5sum
        served.undeclare()
        with pytest.raises(UnreachableError, match="zenoh-bridge-ros1"):
            await service.serve(b"")
        refusing = its.bridge.session.declare_queryable(key, lambda query: query.reply_err(b"it is off"))
        with pytest.raises(PeerRefused, match="it is off"):
            await service.serve(b"")
        refusing.undeclare()


async def test_rules_hold_and_rename() -> None:
    rules = (
        CrossingRule(names=("/secret/**",), crossing=Crossing.NONE),
        CrossingRule(name="/{site}{name}", crossing=Crossing.IN),
    )
    async with joined(*rules) as its:
        its.graph.publisher("/mine", STRING)
        for name in ("secret/key", "chatter"):
            its.bridge.announce("pub", f"{STRING_KEY}/{name}")
        await its.beating(lambda: its.graph.topics)
        await its.beating(lambda: len(its.neighbour.report()["refused"]) == 2)  # type: ignore[arg-type]
        assert [topic.source.name for topic in its.graph.topics.values()] == ["/ros1_bridge/chatter"]
        assert not its.bridge.announced("pub", f"{STRING_KEY}/mine")


async def test_what_another_gateway_announces_or_sends_is_left_to_the_sites() -> None:
    async with joined() as its:
        other_graph = MemoryGraph()
        other = Ros1BridgeNeighbour(other_graph, await its.net.session(), CrossingRules(), "*", lambda _: 5.0)
        other.start()
        try:
            source = other_graph.publisher("/chatter", STRING)
            key = f"{STRING_KEY}/chatter"
            await until(lambda: its.bridge.announced("pub", key))
            its.bridge.announce("pub", key)
            await its.beating(lambda: its.graph.topics)
            (topic,) = its.graph.topics.values()
            topic.on_demand(True)
            await its.beating(lambda: other_graph.taps)
            other_graph.send(source, b"of the other gateway")
            publisher = its.bridge.bridge_to_zenoh(key)
            await its.beating(lambda: publisher.matching_status.matching)
            publisher.put(b"of the bridge")
            await its.beating(lambda: topic.messages)
            assert topic.messages == [b"of the bridge"]
        finally:
            await other.close()


async def test_hostile_presence_is_counted_and_does_nothing() -> None:
    async with joined() as its:
        bad = its.bridge.session.declare_publisher("ros1_discovery_info/*/pub/zz/no-sum/*/chatter")
        await its.beating(lambda: bad.put(b"") or its.neighbour.report()["malformed"])
        assert not its.graph.topics
