"""WebSocket clients at both gateways, with nodes of a core."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import socket
import ssl
import struct
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aiohttp

from rmpa.ros.types.messages import MessageType
from rmpa.web.hub.node_link import FULL, READ_ONLY
from rmpa.web.server.process import CertificateFiles, tls_context
from tests.ros.node.peers import DEADLINE, LATCHED, STRING, until
from tests.web.gateways.server import Client, Server, running_server
from tests.web.hub.client import node, subscribed

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.ros.core.embedded import RosCore
    from rmpa.ros.node.endpoints import Publisher

ONE, TWO = b"\x03\0\0\0one", b"\x03\0\0\0two"
FOXGLOVE = "foxglove.websocket.v1"
BYTES = MessageType("std_msgs/UInt8MultiArray")


async def channel_of(client: Client, topic: str) -> dict[str, Any]:
    while True:
        for channel in (await client.next("advertise"))["channels"]:
            if channel["topic"] == topic:
                found: dict[str, Any] = channel
                return found


# --- rosbridge ---


async def test_rosbridge_publishes_subscribes_and_calls(core: RosCore) -> None:
    async with running_server(core) as server, node(core, "server") as other, server.client() as client:
        await other.advertise_service("/set", "std_srvs/SetBool", lambda r: {"success": r.data, "message": "done"})
        heard: list[bytes] = []
        await other.subscribe("/out", callback=lambda message: heard.append(message.raw))
        await client.send("advertise", topic="/out", type="std_msgs/String")
        await client.send("publish", topic="/out", msg={"data": "one"})
        await until(lambda: heard == [ONE])
        publisher = await other.advertise("/in", STRING)
        await client.send("subscribe", topic="/in", type="std_msgs/String")
        await publisher.wait_for_subscriber()
        publisher.publish_raw(TWO)
        assert (await client.next("publish"))["msg"] == {"data": "two"}
        await client.send("call_service", service="/set", id="7", args={"data": True})
        answer = await client.next("service_response")
        assert answer == {
            "op": "service_response",
            "service": "/set",
            "id": "7",
            "values": {"success": True, "message": "done"},
            "result": True,
        }
        await until(lambda: {"/in", "/out"} <= server.hub.graph.topics.keys())
        await client.send("call_service", service="/rosapi/topics", id="8")
        topics = (await client.next("service_response"))["values"]["topics"]
        assert {"/in", "/out"} <= set(topics)


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


async def test_a_read_only_rosbridge_client_sees_topics_but_no_parameters(core: RosCore) -> None:
    async with (
        running_server(core, READ_ONLY) as server,
        node(core, "talker") as talker,
        server.client() as client,
    ):
        await talker.set_param("/secret", 5)
        (await talker.advertise("/t", LATCHED, latch=True)).publish_raw(ONE)
        await client.send("subscribe", topic="/t", type="std_msgs/String")
        assert (await client.next("publish"))["msg"] == {"data": "one"}
        await until(lambda: server.hub.params.value("/secret") == 5)
        await client.send("call_service", service="/rosapi/get_param", id="1", args={"name": "/secret"})
        assert (await client.next("service_response"))["values"]["value"] == "null"
        await client.send("advertise", topic="/cmd_vel", type="geometry_msgs/Twist")
        assert "may not publish" in (await client.next("status"))["msg"]
        assert not core.publishers("/cmd_vel")


# --- Foxglove ---


async def test_large_messages_arrive_whole_by_tls_at_a_client_that_reads_late(core: RosCore) -> None:
    files = Path(__file__).parents[1] / "server" / "tls"
    tls = tls_context(CertificateFiles(str(files / "cert.pem"), str(files / "key.pem")))
    assert tls is not None
    trusted = ssl.create_default_context(cafile=files / "cert.pem")
    payload = bytes(BYTES.serialize(BYTES.make({"data": bytes(range(250)) * 40_000})))
    async with (
        running_server(core, tls=(tls, trusted)) as server,
        node(core, "mapper") as mapper,
        server.client(FOXGLOVE) as client,
    ):
        publisher = await mapper.advertise("/map", BYTES)
        channel = await channel_of(client, "/map")
        await client.send("subscribe", subscriptions=[{"id": 1, "channelId": channel["id"]}])
        await publisher.wait_for_subscriber()
        await subscribed(server.hub, len(server.hub.clients))
        client.socket._reader._protocol.pause_reading()
        (connection,) = server.gateways.connections
        before = connection.sent
        publisher.publish_raw(payload)
        await until(lambda: connection.sent > before)
        publisher.publish_raw(payload[:100])
        client.socket._reader._protocol.resume_reading()
        assert (await client.next_bytes())[13:] == payload
        assert (await client.next_bytes())[13:] == payload[:100]


async def test_a_client_that_stops_reading_costs_its_bound_and_no_other_a_message(core: RosCore) -> None:
    payload = bytes(BYTES.serialize(BYTES.make({"data": [7] * 500_000})))
    async with running_server(core) as server, node(core, "camera") as camera:
        publisher = await camera.advertise("/image", BYTES)
        async with server.client(FOXGLOVE) as stuck, server.client(FOXGLOVE) as reader:
            sock = stuck.socket.get_extra_info("socket")
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            for client in (stuck, reader):
                channel = await channel_of(client, "/image")
                await client.send("subscribe", subscriptions=[{"id": 1, "channelId": channel["id"]}])
            await subscribed(server.hub, len(server.hub.clients))
            await publisher.wait_for_subscriber()
            stuck.socket._reader._protocol.pause_reading()
            for _ in range(45):
                publisher.publish_raw(payload)
                assert (await reader.next_bytes())[13:] == payload
            queues = sorted((each.queue.bytes, each.queue.dropped_total) for each in server.gateways.connections)
            assert queues[0] == (0, 0)
            assert 0 < queues[1][0] <= 16 << 20
            assert queues[1][1] > 0
            figures = server.gateways.figures()["foxglove"]
            assert (figures.clients, figures.queued, figures.dropped) == (2, *queues[1])
            stuck.socket._response.connection.transport.abort()  # type: ignore[union-attr]
            await until(lambda: len(server.gateways.connections) == 1)
            gone = server.gateways.figures()["foxglove"]
            assert (gone.clients, gone.queued, gone.dropped) == (1, 0, figures.dropped)


async def _under_way(server: Server, publisher: Publisher, client: Client, payload: bytes) -> None:
    """Have the client subscribe, stop reading, and be sent a message that the kernel does not take whole."""
    channel = await channel_of(client, "/map")
    await client.send("subscribe", subscriptions=[{"id": 1, "channelId": channel["id"]}])
    await subscribed(server.hub, len(server.hub.clients))
    await publisher.wait_for_subscriber()
    client.socket._reader._protocol.pause_reading()
    publisher.publish_raw(payload)
    (connection,) = server.gateways.connections
    await until(lambda: connection.unsent - connection.queue.bytes > 1_000_000)


async def test_the_server_s_close_frame_comes_behind_a_large_message_under_way(core: RosCore) -> None:
    payload = bytes(BYTES.serialize(BYTES.make({"data": bytes(range(250)) * 80_000})))
    async with running_server(core) as server, node(core, "mapper") as mapper, server.client(FOXGLOVE) as client:
        await _under_way(server, await mapper.advertise("/map", BYTES), client, payload)
        closing = asyncio.ensure_future(server.gateways.close())
        await asyncio.sleep(0)
        client.socket._reader._protocol.resume_reading()
        assert (await client.next_bytes())[13:] == payload
        async with asyncio.timeout(DEADLINE):
            while (message := await client.socket.receive()).type != aiohttp.WSMsgType.CLOSE:
                assert message.type == aiohttp.WSMsgType.TEXT
        assert message.data == 1001
        await closing


async def test_a_client_that_closes_amid_a_large_message_gets_its_close_frame(core: RosCore) -> None:
    payload = bytes(BYTES.serialize(BYTES.make({"data": bytes(range(250)) * 80_000})))
    async with running_server(core) as server, node(core, "mapper") as mapper, server.client(FOXGLOVE) as client:
        await _under_way(server, await mapper.advertise("/map", BYTES), client, payload)
        await client.socket._writer.close(4000)
        await until(lambda: not server.gateways.connections)
        client.socket._reader._protocol.resume_reading()
        assert (await client.next_bytes())[13:] == payload
        async with asyncio.timeout(DEADLINE):
            message = await client.socket.receive()
        assert (message.type, message.data) == (aiohttp.WSMsgType.CLOSE, 1000)


async def test_the_hub_has_nothing_left_of_a_client_that_went(core: RosCore, monkeypatch: Any) -> None:
    monkeypatch.setattr("rmpa.web.limits.SUBSCRIPTION_LINGER", 0.01)
    monkeypatch.setattr("rmpa.web.limits.UNADVERTISE_DELAY", 0.01)
    async with running_server(core) as server, node(core, "talker") as talker:
        publisher = await talker.advertise("/t", STRING)
        for protocols in ((), (FOXGLOVE,)):
            async with server.client(*protocols) as client:
                if protocols:
                    channel = await channel_of(client, "/t")
                    await client.send("subscribe", subscriptions=[{"id": 1, "channelId": channel["id"]}])
                else:
                    await client.send("subscribe", topic="/t")
                    await client.send("advertise", topic="/u", type="std_msgs/String")
                    await until(lambda: core.publishers("/u"))
                await publisher.wait_for_subscriber()
                client.socket._response.connection.transport.abort()  # type: ignore[union-attr]
                await until(lambda: not server.hub.clients)
            await until(lambda: publisher.subscribers == 0 and not core.publishers("/u"))
        assert not server.gateways.connections
        assert not server.hub.topics.names


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


async def test_what_tcp_kept_over_a_cut_is_dropped_where_commands_may_not_be_old(core: RosCore) -> None:
    rights = dataclasses.replace(FULL, command_age=1.0)
    heard: list[bytes] = []
    async with (
        running_server(core, rights) as server,
        node(core, "robot") as robot,
        cable(server.port) as (port, up),
        server.session.ws_connect(f"ws://127.0.0.1:{port}/") as socket,
    ):
        await robot.subscribe("/cmd", callback=lambda message: heard.append(message.raw))
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
        await asyncio.sleep(1.2)
        up.set()
        await until(lambda: any("s late" in str(each.get("values")) for each in answers))
        assert any(each["op"] == "status" and "/cmd: it may have come" in each["msg"] for each in answers)
        while not any(b"new" in each for each in heard):
            await client.send("publish", topic="/cmd", msg={"data": "new"})
            await asyncio.sleep(0.02)
        assert not [each for each in heard if b"old" in each]
        await socket.close()
        await reading


async def test_a_command_overtakes_the_images_that_wait(core: RosCore) -> None:
    payload = bytes(BYTES.serialize(BYTES.make({"data": [7] * 500_000})))
    priorities: list[str] = []

    def priority(topic: str) -> int:
        priorities.append(topic)
        return int(topic == "/cmd")

    async with (
        running_server(core, priority=priority) as server,
        node(core, "camera") as camera,
        server.client(FOXGLOVE) as client,
    ):
        image = await camera.advertise("/image", BYTES)
        command = await camera.advertise("/cmd", STRING)
        found: dict[str, int] = {}
        while not {"/image", "/cmd"} <= found.keys():
            found |= {each["topic"]: each["id"] for each in (await client.next("advertise"))["channels"]}
        subscriptions = [{"id": 0, "channelId": found["/image"]}, {"id": 1, "channelId": found["/cmd"]}]
        await client.send("subscribe", subscriptions=subscriptions)
        await image.wait_for_subscriber()
        await command.wait_for_subscriber()
        client.socket._reader._protocol.pause_reading()
        (connection,) = server.gateways.connections
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
        assert set(priorities) == {"/image", "/cmd"}
