"""A node's slave API, for tests of cores."""

from __future__ import annotations

import asyncio
from typing import Self

from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call
from rmpa.ros.http.server import XmlRpcServer
from rmpa.ros.wire.xmlrpc import RosFault, XmlRpcValue

STRING = "std_msgs/String"


class Slave:
    """Notes what it is told; it can be slow. Without a name it is as a roscpp node that publishes nothing."""

    def __init__(self, name: str = "") -> None:
        self.name = name
        self.publications: list[list[str]] = []
        self.subscriptions: list[list[str]] = []
        self.calls: list[tuple[str, list[XmlRpcValue]]] = []
        self.lists = 0
        # Whether it refuses to say what it has, as a client library without these methods.
        self.error = False
        self.go = asyncio.Event()
        self.go.set()
        self.at_once = self.most_at_once = 0
        self.server = XmlRpcServer(self._answer)

    async def __aenter__(self) -> Self:
        await self.server.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.go.set()
        await self.server.close()

    @property
    def uri(self) -> str:
        return f"http://127.0.0.1:{self.server.port}/"

    @property
    def updates(self) -> list[tuple[XmlRpcValue, XmlRpcValue]]:
        """The lists of publishers that it was told, by topic."""
        return [(params[1], params[2]) for method, params in self.calls if method == "publisherUpdate"]

    async def _answer(self, method: str, params: tuple[XmlRpcValue, ...]) -> XmlRpcValue:
        match method:
            case "getName" if self.name:
                await self.go.wait()
                return [1, "", self.name]
            case "getPublications" | "getSubscriptions":
                await self.go.wait()
                self.lists += 1
                found = self.publications if method == "getPublications" else self.subscriptions
                return [-1, "not implemented", []] if self.error else [1, "", [*found]]
            case "getName" | "requestTopic":
                raise RosFault(-1, f"{method}: unknown method name")
        self.calls.append((method, list(params)))
        self.at_once += 1
        self.most_at_once = max(self.at_once, self.most_at_once)
        await self.go.wait()
        self.at_once -= 1
        return [1, "", 0]

    async def publish(self, core: RosCore, topic: str) -> None:
        self.publications.append([topic, STRING])
        await call(core.uri, "registerPublisher", self.name or "/nameless", topic, STRING, self.uri)

    async def subscribe(self, core: RosCore, topic: str) -> None:
        self.subscriptions.append([topic, STRING])
        await call(core.uri, "registerSubscriber", self.name or "/nameless", topic, STRING, self.uri)
