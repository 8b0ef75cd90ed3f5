"""A gateway's neighbour ROS 2 in memory, beside a program of ROS 2, for tests of its parts."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any, cast

from rmpa.config.rules import CrossingRule, GatewaySettings, Ros2Settings
from rmpa.gateway.ros2.asking import SERVICE_TYPE
from rmpa.gateway.ros2.format import EntityKind, Ros2Attachment, Ros2Endpoint, Ros2Node, Ros2Qos, gid_of, parse_token
from rmpa.gateway.ros2.ros2 import Ros2Neighbour
from rmpa.gateway.ros2.types import Ros2Types
from rmpa.gateway.zenoh.threads import ZenohQos, ZenohSample
from rmpa.ros.types.messages import MessageType
from tests.gateway.memory_graph import MemoryGraph, MemoryTopic
from tests.gateway.memory_zenoh import MemoryQuery, MemoryZenoh, eventually
from tests.gateway.ros2.type_descriptions import response

STRING = MessageType("std_msgs/String")
NO_TYPE = "RIHS01_" + "0" * 64
"""The hash of no type."""


def string(text: str) -> bytes:
    return STRING.serialize(STRING.make({"data": text}))


class Ros2Publisher:
    """A publisher of a ROS 2 program: its token, and its messages with numbers."""

    def __init__(self, bed: Ros2Bed, endpoint: Ros2Endpoint) -> None:
        self.endpoint = endpoint
        self._bed = bed
        qos = ZenohQos(cache=endpoint.qos.depth if endpoint.qos.latched else 0)
        self._publisher = bed.ros2.publisher(endpoint.key(), qos, self._matching)
        self._token = bed.ros2.token(endpoint.token())
        self.wanted = False
        self.gid = gid_of(endpoint.token())
        self.sequence = 0

    def _matching(self, there: bool) -> None:
        self.wanted = there

    def put(self, payload: bytes, *, skip: int = 0) -> None:
        self.sequence += 1 + skip
        self._publisher.put(payload, Ros2Attachment(self.sequence, 1, self.gid).serialize())

    def say(self, text: str, *, skip: int = 0) -> None:
        self.put(self._bed.cdr("std_msgs/msg/String", data=text), skip=skip)

    def close(self) -> None:
        self._token.close()
        self._publisher.close()


class Ros2Subscription:
    """A subscription of a ROS 2 program: its token, and what it has heard."""

    def __init__(self, bed: Ros2Bed, endpoint: Ros2Endpoint) -> None:
        self.heard: list[ZenohSample] = []
        history = endpoint.qos.latched
        self._declared = bed.ros2.subscribe(endpoint.key(), self.heard.append, history=history)
        self._token = bed.ros2.token(endpoint.token())

    def close(self) -> None:
        self._declared.close()
        self._token.close()


class Ros2Bed:
    """A gateway, and one program of ROS 2 in the same network."""

    def __init__(self, rules: tuple[CrossingRule, ...] = (), ros2: Ros2Settings | None = None) -> None:
        self.network = MemoryZenoh()
        self.graph = MemoryGraph()
        self.ros2 = self.network.session()
        self.settings = GatewaySettings(rules=rules, ros2=ros2 or Ros2Settings())
        self.neighbour = self.gateway()
        self.types = Ros2Types(self.settings.ros2.distribution)
        self._numbers = iter(range(1, 1000))

    def gateway(self) -> Ros2Neighbour:
        """One more gateway at the same graph, on a machine without packages of ROS 1."""
        session = cast("Any", self.network.session())
        return Ros2Neighbour(cast("Any", self.graph), session, self.settings, find=MessageType)

    def endpoint(
        self,
        kind: EntityKind,
        name: str,
        type_name: str = "std_msgs/msg/String",
        node: str = "/bot",
        *,
        qos: Ros2Qos | None = None,
        type_hash: str = "",
    ) -> Ros2Endpoint:
        number = next(self._numbers)
        made = Ros2Node(0, self.ros2.zid, number, node)
        hashed = type_hash or self.types.type_hash(type_name)
        return Ros2Endpoint(made, number, kind, name, type_name, hashed, qos or Ros2Qos())

    def publisher(self, name: str, **more: Any) -> Ros2Publisher:
        return Ros2Publisher(self, self.endpoint(EntityKind.PUBLISHER, name, **more))

    def subscribe(self, name: str, **more: Any) -> Ros2Subscription:
        return Ros2Subscription(self, self.endpoint(EntityKind.SUBSCRIPTION, name, **more))

    def server(
        self, name: str, type_name: str, answer: Callable[[MemoryQuery], None] = lambda _: None, **more: Any
    ) -> Any:
        """A server of ROS 2: its queryable, and its token, which is returned."""
        endpoint = self.endpoint(EntityKind.SERVICE, name, type_name, **more)
        self.ros2.queryable(endpoint.key(), answer)
        return self.ros2.token(endpoint.token())

    def describes(self, node: str, types: Ros2Types, *names: str) -> list[bytes]:
        """A node of ROS 2 describes types; returns what it was asked."""
        asked: list[bytes] = []

        def describe(query: MemoryQuery) -> None:
            asked.append(query.payload)
            (name,) = (each for each in names if each.encode() in query.payload)
            query.answer(response(types, name))

        self.server(f"{node}/get_type_description", SERVICE_TYPE, describe, node=node, type_hash=NO_TYPE)
        return asked

    def cdr(self, name: str, *more: Any, **values: Any) -> bytes:
        return cdr(self.types, name, *more, **values)

    def read(self, raw: bytes, name: str = "std_msgs/msg/String") -> Any:
        return self.types.store.deserialize_cdr(raw, name)

    def own(self, kind: EntityKind) -> list[Ros2Endpoint]:
        """What the gateway shows in ROS 2's graph."""
        parsed = [parse_token(key) for key in self.network.token_keys if f"/{self.ros2.zid}/" not in key]
        return [each for each in parsed if isinstance(each, Ros2Endpoint) and each.kind is kind]

    def topic(self, name: str, node: str = "/bot") -> MemoryTopic | None:
        return self.graph.topics.get((name, node))

    async def shown(self, name: str, node: str = "/bot") -> MemoryTopic:
        """A topic of ROS 2, once it is in the gateway's graph."""
        await eventually(lambda: self.topic(name, node))
        return self.graph.topics[name, node]

    async def subscribed(self, publisher: Ros2Publisher) -> MemoryTopic:
        """The topic of a publisher, once a node here subscribes and the publisher hears of it."""
        topic = await self.shown(publisher.endpoint.name, publisher.endpoint.node.name)
        topic.on_demand(True)
        await eventually(lambda: publisher.wanted)
        return topic

    @property
    def problems(self) -> dict[str, str]:
        return self.neighbour.context.problems


def cdr(types: Ros2Types, name: str, *more: Any, **values: Any) -> bytes:
    """A message of ROS 2."""
    return bytes(types.store.serialize_cdr(types.store.types[name](*more, **values), name))


@contextlib.asynccontextmanager
async def ros2_bed(**more: Any) -> AsyncIterator[Ros2Bed]:
    bed = Ros2Bed(**more)
    bed.neighbour.start()
    try:
        yield bed
    finally:
        await bed.neighbour.close()
        assert not bed.graph.taps
        assert all(f"/{bed.ros2.zid}/" in key for key in bed.network.token_keys), "all tokens were taken back"
