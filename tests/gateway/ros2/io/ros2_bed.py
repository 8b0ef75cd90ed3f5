"""A gateway's neighbour ROS 2 in memory, beside a program of ROS 2, for tests of its parts."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, cast

from rmpa.config.rules import GatewaySettings, Ros2Settings
from rmpa.gateway.ros2.format import EntityKind, Ros2Attachment, Ros2Endpoint, Ros2Node, Ros2Qos, parse_token
from rmpa.gateway.ros2.graph import gid_of
from rmpa.gateway.ros2.ros2 import Ros2Neighbour
from rmpa.gateway.ros2.types import Ros2Types
from rmpa.ros.types.messages import MessageType
from tests.gateway.memory_graph import MemoryGraph, MemoryTopic
from tests.gateway.memory_zenoh import MemoryZenoh, eventually

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.config.rules import CrossingRule
    from rmpa.core.contract import Contracts
    from rmpa.gateway.zenoh.threads import ZenohSample

STRING = MessageType("std_msgs/String")


def find_none(name: str) -> MessageType:
    """A machine without ROS 1 packages: only what rmpa brings."""
    return MessageType(name)


def string(text: str) -> bytes:
    return STRING.serialize(STRING.make({"data": text}))


class Ros2Publisher:
    """A publisher of a ROS 2 program: its token, and its messages with numbers."""

    def __init__(self, bed: Ros2TopicBed, endpoint: Ros2Endpoint) -> None:
        self.endpoint = endpoint
        self._bed = bed
        self._publisher = bed.ros2.publisher(endpoint.key(), zenoh_qos(endpoint.qos), self._matching)
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


def zenoh_qos(qos: Ros2Qos) -> Any:
    from rmpa.gateway.zenoh.threads import ZenohQos

    return ZenohQos(cache=qos.depth if qos.latched else 0)


class Ros2TopicBed:
    """A gateway, and one program of ROS 2 in the same network."""

    def __init__(
        self,
        rules: tuple[CrossingRule, ...] = (),
        ros2: Ros2Settings | None = None,
        contracts: Contracts | None = None,
    ) -> None:
        self.network = MemoryZenoh()
        self.graph = MemoryGraph()
        self.ros2 = self.network.session()
        settings = GatewaySettings(rules=rules, ros2=ros2 or Ros2Settings())
        self.neighbour = Ros2Neighbour(
            cast("Any", self.graph), cast("Any", self.network.session()), settings, contracts, find_none
        )
        self.types = Ros2Types(settings.ros2.distribution)
        self._numbers = iter(range(1, 1000))

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

    def subscribe(self, name: str, heard: list[ZenohSample], **more: Any) -> list[Any]:
        """A subscription of a ROS 2 program, with its token."""
        endpoint = self.endpoint(EntityKind.SUBSCRIPTION, name, **more)
        history = endpoint.qos.latched
        declared = self.ros2.subscribe(endpoint.key(), heard.append, history=history)
        return [declared, self.ros2.token(endpoint.token())]

    def cdr(self, name: str, **values: Any) -> bytes:
        return bytes(self.types.store.serialize_cdr(self.types.store.types[name](**values), name))

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


@contextlib.asynccontextmanager
async def topic_bed(**more: Any) -> AsyncIterator[Ros2TopicBed]:
    bed = Ros2TopicBed(**more)
    bed.neighbour.start()
    try:
        yield bed
    finally:
        await bed.neighbour.close()
        assert not bed.graph.taps
        assert all(f"/{bed.ros2.zid}/" in key for key in bed.network.token_keys), "all tokens were taken back"
