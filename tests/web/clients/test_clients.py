"""WebSocket clients at both sockets, with nodes of a core."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import socket
import ssl
import struct
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from rmpa.core.contract import ContractRule, Contracts, Priority
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageType
from rmpa.web.hub.node_link import FULL
from rmpa.web.server.process import CertificateFiles, tls_context
from tests.ros.node.peers import STRING
from tests.waiting import until
from tests.web.clients.server import Client, running_server
from tests.web.hub.client import listen, subscribed

ONE, TWO = b"\x03\0\0\0one", b"\x03\0\0\0two"
FOXGLOVE = "foxglove.websocket.v1"
BYTES = MessageType("std_msgs/UInt8MultiArray")


async def subscribe(client: Client, *topics: str) -> None:
    """Subscribe to the channels of topics, numbered from 0, as soon as they are advertised."""
    found: dict[str, int] = {}
    while not found.keys() >= {*topics}:
        found |= {each["topic"]: each["id"] for each in (await client.next("advertise"))["channels"]}
    wanted = [{"id": number, "channelId": found[topic]} for number, topic in enumerate(topics)]
    await client.send("subscribe", subscriptions=wanted)


def payload_of(size: int) -> bytes:
    """A message with data in which a part that is left out or twice would show."""
    return bytes(BYTES.serialize(BYTES.make({"data": (bytes(range(250)) * (size // 250 + 1))[:size]})))


# --- rosbridge ---


async def test_rosbridge_publishes_subscribes_and_calls(core: RosCore, talker: Node) -> None:
    async with running_server(core) as server, server.client() as client:
        await talker.advertise_service("/set", "std_srvs/SetBool", lambda r: {"success": r.data, "message": "done"})
        heard = await listen(talker, "/out")
        await client.send("advertise", topic="/out", type="std_msgs/String")
        await client.send("publish", topic="/out", msg={"data": "one"})
        await until(lambda: heard == [ONE])
        publisher = await talker.advertise("/in", STRING)
        await client.send("subscribe", topic="/in", type="std_msgs/String", throttle_rate=20, queue_length=5)
        await publisher.wait_for_subscriber()
        for payload in (ONE, TWO):
            publisher.publish_raw(payload)
        for text in ("one", "two"):
            assert (await client.next("publish"))["msg"] == {"data": text}
        await client.send("call_service", service="/set", id="7", args={"data": True})
        answer = await client.next("service_response")
        assert (answer["id"], answer["values"]) == ("7", {"success": True, "message": "done"})
        await until(lambda: {"/in", "/out"} <= server.hub.graph.topics.keys())
        await client.send("call_service", service="/rosapi/topics", id="8")
        assert {"/in", "/out"} <= {*(await client.next("service_response"))["values"]["topics"]}


async def test_rosbridge_counts_its_clients(core: RosCore) -> None:
    async with running_server(core) as server, server.client() as client:
        await client.send("subscribe", topic="/client_count", type="std_msgs/Int32")
        assert (await client.next("publish"))["msg"] == {"data": 1}
        async with server.client():
            assert (await client.next("publish"))["msg"] == {"data": 2}
        assert (await client.next("publish"))["msg"] == {"data": 1}
        await client.send("subscribe", topic="/connected_clients")
        (connected,) = (await client.next("publish"))["msg"]["clients"]
        assert connected["ip_address"] == "127.0.0.1"


# --- Foxglove ---


async def test_large_messages_arrive_whole_by_tls_at_a_client_that_reads_late(core: RosCore, talker: Node) -> None:
    files = Path(__file__).parents[1] / "server" / "tls"
    tls = tls_context(CertificateFiles(str(files / "cert.pem"), str(files / "key.pem")))
    assert tls is not None
    trusted = ssl.create_default_context(cafile=files / "cert.pem")
    payload = payload_of(10_000_000)
    async with running_server(core, tls=(tls, trusted)) as server, server.client(FOXGLOVE) as client:
        publisher = await talker.advertise("/map", BYTES)
        await subscribe(client, "/map")
        await publisher.wait_for_subscriber()
        await subscribed(server.hub, len(server.hub.clients))
        client.socket._reader._protocol.pause_reading()
        (connection,) = server.sockets.connections
        before = connection.sent
        publisher.publish_raw(payload)
        await until(lambda: connection.sent > before)
        publisher.publish_raw(payload[:100])
        client.socket._reader._protocol.resume_reading()
        assert [(await client.next_bytes())[13:] for _ in range(2)] == [payload, payload[:100]]


async def test_a_client_that_stops_reading_costs_its_bound_and_no_other_a_message(
    core: RosCore, talker: Node
) -> None:
    payload = payload_of(500_000)
    async with running_server(core) as server:
        publisher = await talker.advertise("/image", BYTES)
        async with server.client(FOXGLOVE) as stuck, server.client(FOXGLOVE) as reader:
            sock = stuck.socket.get_extra_info("socket")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            await subscribe(stuck, "/image")
            await subscribe(reader, "/image")
            await subscribed(server.hub, len(server.hub.clients))
            await publisher.wait_for_subscriber()
            stuck.socket._reader._protocol.pause_reading()
            for _ in range(45):
                publisher.publish_raw(payload)
                assert (await reader.next_bytes())[13:] == payload
            queues = sorted((each.queue.bytes, each.queue.dropped_total) for each in server.sockets.connections)
            assert queues[0] == (0, 0)
            assert 0 < queues[1][0] <= 16 << 20
            assert queues[1][1] > 0
            figures = server.sockets.figures()["foxglove"]
            assert (figures.clients, figures.queued, figures.dropped) == (2, *queues[1])
            stuck.socket._response.connection.transport.abort()  # type: ignore[union-attr]
            await until(lambda: len(server.sockets.connections) == 1)
            gone = server.sockets.figures()["foxglove"]
            assert (gone.clients, gone.queued, gone.dropped) == (1, 0, figures.dropped)


async def test_the_hub_has_nothing_left_of_a_client_that_went(
    core: RosCore, talker: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.web.limits.SUBSCRIPTION_LINGER", 0.01)
    monkeypatch.setattr("rmpa.web.limits.UNADVERTISE_DELAY", 0.01)
    async with running_server(core) as server:
        publisher = await talker.advertise("/t", STRING)
        for protocols in ((), (FOXGLOVE,)):
            async with server.client(*protocols) as client:
                if protocols:
                    await subscribe(client, "/t")
                else:
                    await client.send("subscribe", topic="/t")
                    await client.send("advertise", topic="/u", type="std_msgs/String")
                    await until(lambda: core.publishers("/u"))
                await publisher.wait_for_subscriber()
                client.socket._response.connection.transport.abort()  # type: ignore[union-attr]
                await until(lambda: not server.hub.clients)
            await until(lambda: publisher.subscribers == 0 and not core.publishers("/u"))
        assert not server.sockets.connections
        assert not server.hub.topics.subscribed


@contextlib.asynccontextmanager
async def cable(port: int) -> AsyncIterator[tuple[int, asyncio.Event]]:
    """A port in front of another, and what is set while bytes pass: all others wait, as over a cut."""
    up, tasks = asyncio.Event(), set[asyncio.Future[None]]()
    up.set()

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(1 << 16):
                await up.wait()
                writer.write(data)
        finally:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", port)
        tasks.update(map(asyncio.ensure_future, (pump(reader, back), pump(there, writer))))

    server = await asyncio.start_server(accept, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1], up
    finally:
        server.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def test_what_tcp_kept_over_a_cut_is_dropped_where_commands_may_not_be_old(core: RosCore, talker: Node) -> None:
    async with (
        running_server(core, dataclasses.replace(FULL, command_age=0.5)) as server,
        cable(server.port) as (port, up),
        server.session.ws_connect(f"ws://127.0.0.1:{port}/") as socket,
    ):
        heard = await listen(talker, "/cmd")
        client = Client(socket)
        answers: list[dict[str, Any]] = []

        async def read() -> None:
            async for message in socket:
                answers.append(json.loads(message.data))  # noqa: PERF401 - each is looked at as it comes

        reading = asyncio.ensure_future(read())  # and answer the pings
        await client.send("advertise", topic="/cmd", type="std_msgs/String")
        while not heard:
            await client.send("publish", topic="/cmd", msg={"data": "go"})
            await asyncio.sleep(0.02)
        up.clear()
        await client.send("publish", topic="/cmd", msg={"data": "old"})
        await client.send("call_service", service="/rosout/get_loggers", id="old")
        await asyncio.sleep(0.6)
        up.set()
        await until(lambda: any("s late" in str(each.get("values")) for each in answers))
        assert any(each["op"] == "status" and "/cmd: it may have come" in each["msg"] for each in answers)
        while not any(b"new" in each for each in heard):
            await client.send("publish", topic="/cmd", msg={"data": "new"})
            await asyncio.sleep(0.02)
        assert not [each for each in heard if b"old" in each]
        await socket.close()
        await reading


async def test_a_command_overtakes_the_images_that_wait(core: RosCore, talker: Node) -> None:
    payload = payload_of(500_000)
    contracts = Contracts((ContractRule(("/cmd",), (), {"priority": Priority.HIGH}),))
    async with running_server(core, contracts=contracts) as server, server.client(FOXGLOVE) as client:
        image, command = [await talker.advertise(*each) for each in (("/image", BYTES), ("/cmd", STRING))]
        await subscribe(client, "/image", "/cmd")
        await image.wait_for_subscriber()
        await command.wait_for_subscriber()
        client.socket._reader._protocol.pause_reading()
        (connection,) = server.sockets.connections
        images = 0
        while sum(connection.queue.waiting.values()) < 5:
            image.publish_raw(payload)
            images += 1
            await asyncio.sleep(0.01)
        command.publish_raw(ONE)
        await until(lambda: len(connection.queue.waiting) == 2)
        client.socket._reader._protocol.resume_reading()
        order = [struct.unpack_from("<BI", await client.next_bytes())[1] for _ in range(images + 1)]
        assert order.index(1) <= images - 4
