"""A ROS core, nodes of it, a hub, and a client that writes down what it gets."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import AsyncIterator, Coroutine
from typing import Any

from rmpa.core.contract import Contracts
from rmpa.core.errors import RmpaError
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.node.node import Node
from rmpa.web.hub.hub import Hub, HubClient
from rmpa.web.hub.node_link import EVERYTHING, FULL, NodeRules, Rights
from rmpa.web.hub.topics import ClientPublication, ReceivedMessage
from tests.waiting import until

_names = itertools.count(1)


@contextlib.asynccontextmanager
async def local_core() -> AsyncIterator[RosCore]:
    core = RosCore("127.0.0.1", 0)
    await core.start()
    try:
        yield core
    finally:
        await core.close()


def node(core: RosCore, name: str = "") -> Node:
    """A node that is not started."""
    return Node(name or f"node{next(_names)}", master_uri=core.uri, environment=RosEnvironment())


async def listen(node: Node, topic: str) -> list[bytes]:
    """The messages that a node gets of a topic from now on."""
    heard: list[bytes] = []
    await node.subscribe(topic, callback=lambda message: heard.append(message.raw))
    return heard


@contextlib.asynccontextmanager
async def running_hub(
    core: RosCore,
    rules: NodeRules = EVERYTHING,
    *,
    contracts: Contracts | None = None,
    until_known: bool = True,
) -> AsyncIterator[Hub]:
    """A hub; it has its node, and has read the graph and the parameters, unless ``until_known`` is false."""

    async def where() -> str:
        return core.uri

    async with Hub(
        where,
        lambda uri, updated: Node("rmpa_web", master_uri=uri, environment=RosEnvironment(), on_param_update=updated),
        rules=rules,
        contracts=contracts,
    ) as hub:
        hub.start()
        if until_known:
            await until(lambda: hub.graph.loaded.is_set() and hub.params.loaded.is_set())
        yield hub


async def subscribed(hub: Hub, count: int) -> None:
    """Wait until the hub's clients have so many subscriptions."""
    await until(lambda: sum(len(each.users) for each in hub.topics.subscribed.values()) >= count)


class Heard:
    """A subscription of a client, and what came of it."""

    def __init__(self, client: HubClient, topic: str, type_: str | None = None) -> None:
        self.messages: list[ReceivedMessage] = []
        self.errors: list[RmpaError] = []
        self.others: list[str] = []
        take, fail = self.messages.append, self.errors.append
        self.subscription = client.subscribe(topic, type_, take, fail, self.others.append)

    @property
    def payloads(self) -> list[bytes]:
        return [bytes(message.payload) for message in self.messages]

    def close(self) -> None:
        self.subscription.close()


class FakeClient(HubClient):
    """One client of a hub, without a protocol."""

    def __init__(self, hub: Hub, rights: Rights = FULL) -> None:
        super().__init__(hub, "test", rights)
        self.errors: list[RmpaError] = []
        self.results: list[Any] = []
        hub.connect(self)

    def hear(self, topic: str, type_: str | None = None) -> Heard:
        return Heard(self, topic, type_)

    def talk(self, topic: str, type_: str = "std_msgs/String", *, latch: bool = False) -> ClientPublication:
        return self.advertise(topic, type_, self.errors.append, latch=latch)

    def start(self, work: Coroutine[Any, Any, Any]) -> None:
        """Do something whose result comes later."""
        self.run(work, self.results.append, self.errors.append)

    def close(self) -> None:
        self.hub.disconnect(self)
