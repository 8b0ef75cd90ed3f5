"""What comes and goes around ``rmpa web``: topics of a node, clients of all protocols, the views of one page.

The usual pace is taken to be: a view is opened every ten seconds, a client comes every five, a topic every twenty,
and some modules leave or return every twenty. Here each is ten times as fast.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from typing import TYPE_CHECKING, Any, Final

import aiohttp

from rmpa.ros.node.node import Node
from rmpa.web.foxglove.protocol import SUBPROTOCOLS
from rmpa.web.monitor.messages import SUBPROTOCOL

if TYPE_CHECKING:
    import random

    from lab.bed.chromium import Chromium
    from rmpa.ros.node.endpoints import Publisher

VIEW_EVERY: Final = 1.0
CLIENT_EVERY: Final = 0.5
TOPIC_EVERY: Final = 2.0
MESH_EVERY: Final = 2.0
"""Seconds; each change of the mesh is of a few modules and of sixteen topics."""
_TOPICS: Final = 8
_RATE: Final = 20.0
"""Hz, of the topics together in turn."""
_SIZE: Final = 4096
_TYPE: Final = "std_msgs/UInt8MultiArray"
_STAY: Final = (0.5, 6.0)
"""Seconds that a client stays: the shortest and the longest."""
_CONNECT_WITHIN: Final = 30.0
KINDS: Final = ("rosbridge json", "rosbridge cbor-raw", "foxglove", "monitor")
_VIEWS: Final = ("", "topics", "services", "params", "resources", "alarms", "log", "module/pc", "module/module_03")


class Topics:
    """Topics of one node, of which one is replaced by another now and then; messages go over all of them in turn.

    Args:
        master_uri: Of the core.
    """

    def __init__(self, master_uri: str) -> None:
        self._master_uri = master_uri
        self.names: list[str] = []
        """Those that are there."""
        self.made = 0
        """Topics so far."""

    async def run(self) -> None:
        """Run until this is cancelled."""
        async with Node("soak_source", master_uri=self._master_uri) as node:
            publishers = [await self._advertise(node) for _ in range(_TOPICS)]
            message = (0).to_bytes(8, "little") + _SIZE.to_bytes(4, "little") + bytes(_SIZE)
            loop = asyncio.get_running_loop()
            change_at = loop.time() + TOPIC_EVERY
            while True:
                for publisher in publishers:
                    publisher.publish_raw(message)
                    await asyncio.sleep(1 / _RATE)
                if loop.time() > change_at:
                    change_at += TOPIC_EVERY
                    self.names.pop(0)
                    await publishers.pop(0).close()
                    publishers.append(await self._advertise(node))

    async def _advertise(self, node: Node) -> Publisher:
        self.made += 1
        name = f"/soak/topic_{self.made}"
        publisher = await node.advertise(name, _TYPE)
        self.names.append(name)
        return publisher


class Clients:
    """Clients that come, subscribe and leave; one in four leaves without a word, one in four stops reading before.

    Args:
        port: Of ``rmpa web``.
        topics: What they subscribe to.
        rng: Decides what each does.
    """

    def __init__(self, port: int, topics: Topics, rng: random.Random) -> None:
        self._url = f"http://127.0.0.1:{port}/"
        self._topics = topics
        self._rng = rng
        self.problems: list[str] = []
        self.messages = dict.fromkeys(KINDS, 0)
        """Frames with data that came, by the kind of client."""
        self.came = 0

    async def run(self) -> None:
        """Run until this is cancelled; all clients have left then."""
        async with aiohttp.ClientSession() as session, asyncio.TaskGroup() as group:
            while True:
                group.create_task(self._visit(session, self._rng.choice(KINDS), self._rng.uniform(*_STAY)))
                await asyncio.sleep(CLIENT_EVERY)

    async def _visit(self, session: aiohttp.ClientSession, kind: str, stay: float) -> None:
        self.came += 1
        path = "monitor" if kind == "monitor" else ""
        protocols = {"monitor": (SUBPROTOCOL,), "foxglove": SUBPROTOCOLS}.get(kind, ())
        leaves = self._rng.choice(("well", "well", "silently", "stalled"))
        try:
            async with asyncio.timeout(_CONNECT_WITHIN):
                client = await session.ws_connect(self._url + path, protocols=protocols, max_msg_size=0)
            async with client:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(stay):
                        await self._talk(client, kind)
                if leaves == "stalled":
                    await asyncio.sleep(stay)
                if leaves != "well":
                    connection = client.get_extra_info("socket")
                    if connection is not None:
                        with contextlib.suppress(OSError):
                            connection.shutdown(socket.SHUT_RDWR)
        except (aiohttp.ClientError, TimeoutError) as error:
            self.problems.append(f"a {kind} client: {error!r}")

    async def _talk(self, client: aiohttp.ClientWebSocketResponse, kind: str) -> None:
        if kind.startswith("rosbridge"):
            compression = "cbor-raw" if kind.endswith("raw") else "none"
            for topic in [*self._topics.names]:
                await client.send_json({"op": "subscribe", "topic": topic, "compression": compression})
            await client.send_json({"op": "call_service", "service": "/rosapi/topics", "id": "1"})
        async for frame in client:
            if frame.type is aiohttp.WSMsgType.BINARY:
                self.messages[kind] += 1
            elif frame.type is aiohttp.WSMsgType.TEXT:
                await self._answer(client, kind, json.loads(frame.data))
        self.problems.append(f"the server closed the connection of a {kind} client: {client.close_code}")

    async def _answer(self, client: aiohttp.ClientWebSocketResponse, kind: str, message: dict[str, Any]) -> None:
        op = message.get("op")
        if op in ("publish", "patch"):
            self.messages[kind] += 1
        if op in ("state", "patch"):
            await client.send_json({"op": "ack", "n": message["n"]})
        elif op == "advertise":
            wanted = [
                {"id": channel["id"], "channelId": channel["id"]}
                for channel in message["channels"]
                if channel["topic"].startswith("/soak/")
            ]
            await client.send_json({"op": "subscribe", "subscriptions": wanted})


class Views:
    """One page that stays open; its views change.

    Args:
        page: The browser.
        port: Of ``rmpa web``.
        topics: Of which it shows live values.
        rng: Decides what is shown.
    """

    def __init__(self, page: Chromium, port: int, topics: Topics, rng: random.Random) -> None:
        self._page = page
        self._port = port
        self._topics = topics
        self._rng = rng
        self.turn = asyncio.Lock()
        """Held while the page is measured."""
        self.shown = 0

    async def open(self) -> None:
        """Open the first page."""
        await self._page.look(still=False)
        await self._page.goto(f"http://127.0.0.1:{self._port}/")
        await self._page.wait("window.rmpa && window.rmpa.state && document.querySelector('[data-module]')")

    async def run(self) -> None:
        """Run until this is cancelled."""
        while True:
            view = self._rng.choice((*_VIEWS, "topic", "topic"))
            if view == "topic" and self._topics.names:
                view = f"topic/{self._rng.choice(self._topics.names).replace('/', '%2F')}"
            async with self.turn:
                await self.show(view)
            await asyncio.sleep(VIEW_EVERY)

    async def show(self, view: str) -> None:
        """Show a view: the part of the address behind ``#/``."""
        self.shown += 1
        await self._page.run(f"location.hash = {json.dumps('#/' + view)}")
