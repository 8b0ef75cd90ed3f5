"""A ROS core, nodes of it, a hub, and a client that writes down what it gets."""

from __future__ import annotations

import contextlib
import itertools
from typing import TYPE_CHECKING, TypeVar

from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.node.node import Node
from rmpa.web.hub.hub import Hub
from rmpa.web.hub.node_link import EVERYTHING, FULL, Rights
from rmpa.web.hub.requests import Answer, Failed, GraphChanged, ReceivedMessage
from tests.ros.node.peers import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.web.hub.node_link import NodeRules
    from rmpa.web.hub.requests import HubRequest

_A = TypeVar("_A", bound=Answer)
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


@contextlib.asynccontextmanager
async def running_hub(core: RosCore, rules: NodeRules = EVERYTHING) -> AsyncIterator[Hub]:
    """A hub that has its node, and has read the graph and the parameters."""

    async def where() -> str:
        return core.uri

    async with Hub(
        where,
        lambda uri, updated: Node("rmpa_web", master_uri=uri, environment=RosEnvironment(), on_param_update=updated),
        rules=rules,
    ) as hub:
        hub.start()
        await until(lambda: hub.graph.loaded.is_set() and hub.params.loaded.is_set())
        yield hub


class FakeClient:
    """One client of a hub."""

    def __init__(self, hub: Hub, rights: Rights = FULL) -> None:
        self.hub = hub
        self.answers: list[Answer] = []
        self.client = hub.connect("test", rights, self.answers.append)
        self._handles = itertools.count(1)

    def handle(self) -> int:
        return next(self._handles)

    def ask(self, request: HubRequest) -> None:
        self.hub.ask(self.client, request)

    def close(self) -> None:
        self.hub.disconnect(self.client)

    def of(self, kind: type[_A], handle: int | None = None) -> list[_A]:
        """All answers of a kind."""
        return [a for a in self.answers if isinstance(a, kind) and (handle is None or a.handle == handle)]

    def payloads(self, handle: int) -> list[bytes]:
        """What a subscription has received."""
        return [bytes(message.payload) for message in self.of(ReceivedMessage, handle)]

    async def answer(self, kind: type[_A], handle: int) -> _A:
        """Wait for the answer to a request."""
        await until(lambda: self.of(kind, handle) or self.of(Failed, handle))
        found = self.of(kind, handle)
        assert found, self.of(Failed, handle)
        return found[-1]

    async def failure(self, handle: int) -> Failed:
        """Wait for the failure of a request."""
        await until(lambda: self.of(Failed, handle))
        return self.of(Failed, handle)[-1]

    def graph(self) -> GraphChanged:
        return self.of(GraphChanged)[-1]
