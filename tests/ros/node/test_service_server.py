from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator, Mapping

import pytest

from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import ServiceDescription, encode_header, server_header
from tests.ros.node.peers import RawSubscriber
from tests.waiting import DEADLINE, until

MD5 = "6a2e34150c00229791cc89ff309fff21"
ADD = ServiceDescription("rospy_tutorials/AddTwoInts", MD5)


@pytest.fixture
async def node() -> AsyncIterator[SlaveNode]:
    made = SlaveNode("/server", "127.0.0.1", "http://127.0.0.1:11311/")
    await made.start()
    yield made
    while OPENED:
        OPENED.pop().close()
    await made.close()


def add(call: ServiceCall) -> None:
    a, b = struct.unpack("<qq", call.request)
    call.reply(True, struct.pack("<q", a + b))


def echo(call: ServiceCall) -> None:
    call.reply(True, call.request)


class Later:
    """Describes the service when ``known`` is set."""

    def __init__(self) -> None:
        self.asked = 0
        self.known: asyncio.Future[ServiceDescription | str] = asyncio.get_running_loop().create_future()

    async def __call__(self) -> ServiceDescription | str:
        self.asked += 1
        return await asyncio.shield(self.known)


def serve(node: SlaveNode, *args: object, **kwargs: object) -> ServiceEndpoint:
    kwargs.setdefault("description", ADD)
    endpoint = ServiceEndpoint("/add", "/server", *args, **kwargs)  # type: ignore[arg-type] # handed through
    node.add_service(endpoint)
    return endpoint


class RawClient(RawSubscriber):
    """A bare client."""

    @classmethod
    async def call(cls, node: SlaveNode, **fields: str) -> RawClient:
        """Connect and send a header."""
        header = {"topic": "", "type": "", "service": "/add", "md5sum": "*", **fields}
        return await cls.connect(address_of(node), buffer=0, **header)

    @classmethod
    async def early(cls, node: SlaveNode, md5sum: str = MD5, *, buffer: int = 0, **fields: str) -> RawClient:
        """Connect and send header and request at once."""
        made = await cls.dial(address_of(node), buffer=buffer)
        await made.send(encode_header({"service": "/add", "callerid": "/c", "md5sum": md5sum, **fields}) + TWO)
        return made

    async def reply(self) -> tuple[int, bytes]:
        """The next reply."""
        while len(self.data) < 5 or len(self.data) < 5 + struct.unpack_from("<I", self.data, 1)[0]:
            await self._more()
        ok, size = struct.unpack_from("<BI", self.data)
        body, self.data = self.data[5 : 5 + size], self.data[5 + size :]
        return ok, body


def address_of(node: SlaveNode) -> tuple[str, int]:
    """Where the node's services are."""
    return "127.0.0.1", int(node.service_uri.rpartition(":")[2])


def framed(body: bytes) -> bytes:
    return struct.pack("<I", len(body)) + body


TWO = framed(struct.pack("<qq", 20, 22))
FORTY_TWO = (1, struct.pack("<q", 42))


OPENED: list[ServiceConnection] = []


async def connect(node: SlaveNode, caller: str = "/c", service: str = "/add") -> ServiceConnection:
    """A connection of ours, which ends with the test."""
    OPENED.append(await ServiceConnection.open(node.service_uri, service, caller))
    return OPENED[-1]


async def test_a_call_is_answered_and_the_connection_closed(node: SlaveNode) -> None:
    endpoint = serve(node, add)
    client = await RawClient.call(node)
    header = await client.header()
    assert header == server_header("/server", ADD)
    await client.send(TWO)
    assert await client.reply() == FORTY_TWO
    assert await client.ended()
    assert (endpoint.calls, endpoint.failed, len(endpoint._clients)) == (1, 0, 0)


@pytest.mark.trap(24)
@pytest.mark.parametrize("word", ["1", "true", "True"])
async def test_a_persistent_connection_goes_on(node: SlaveNode, word: str) -> None:
    serve(node, add)
    client = await RawClient.call(node, persistent=word)
    await client.header()
    for _ in range(3):
        await client.send(TWO)
        assert await client.reply() == FORTY_TWO


@pytest.mark.trap(23)
async def test_callers_behind_probes_that_have_just_left_are_answered(
    node: SlaveNode, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = serve(node, add, later := Later(), description=None)
    probes = [await RawClient.call(node, probe="1") for _ in range(3)]
    await until(lambda: len(endpoint._clients) == 3)
    caller = await RawClient.call(node)
    await until(lambda: len(endpoint._clients) == 4)
    await caller.send(TWO)
    for probe in probes:
        probe.close()
    later.known.set_result(ADD)  # the probes' ends are read in the turn of the loop before the one that opens them
    assert (await caller.header())["type"] == ADD.type
    assert await caller.reply() == FORTY_TWO
    caller.close()
    await until(lambda: not len(endpoint._clients))
    assert not caplog.records


async def test_callers_behind_one_that_fails_are_answered(node: SlaveNode, caplog: pytest.LogCaptureFixture) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    endpoint = serve(node, add, later := Later(), description=None, on_mismatch=broken)
    await RawClient.call(node, md5sum="0" * 32)
    await until(lambda: len(endpoint._clients) == 1)
    caller = await RawClient.call(node)
    await until(lambda: len(endpoint._clients) == 2)
    await caller.send(TWO)
    later.known.set_result(ADD)
    await caller.header()
    assert await caller.reply() == FORTY_TWO
    assert "could not be answered" in caplog.text


async def test_a_refused_description_is_asked_for_again(node: SlaveNode) -> None:
    answers: list[ServiceDescription | str] = [ADD, "the peer is away"]

    async def describe() -> ServiceDescription | str:
        return answers.pop()

    serve(node, add, describe, description=None)
    client = await RawClient.call(node)
    assert await client.header() == {"error": "the peer is away"}
    assert await client.ended()
    client = await RawClient.call(node)
    assert (await client.header())["md5sum"] == MD5


async def test_a_description_that_fails_is_an_error_to_the_client(node: SlaveNode) -> None:
    async def describe() -> ServiceDescription | str:
        raise UnreachableError("agent", "base")

    serve(node, add, describe, description=None)
    client = await RawClient.call(node)
    assert await client.header() == {"error": "no agent answers at base"}


@pytest.mark.trap(23)
async def test_probes_are_answered_and_may_leave_unread(node: SlaveNode, caplog: pytest.LogCaptureFixture) -> None:
    endpoint = serve(node, add)
    probe = await RawClient.call(node, probe="1")
    assert (await probe.header())["type"] == ADD.type
    probe.close()
    for _ in range(20):
        (await RawClient.call(node, probe="1")).close()
    await until(lambda: not len(endpoint._clients))
    assert endpoint.calls == 0
    assert not caplog.records


async def test_another_md5_sum_is_refused_loudly(node: SlaveNode) -> None:
    told: list[str] = []

    def on_mismatch(fields: Mapping[str, str], text: str) -> None:
        told.append(f"{fields['callerid']}: {text}")

    serve(node, add, on_mismatch=on_mismatch)
    client = await RawClient.call(node, md5sum="0" * 32, callerid="/old")
    text = (await client.header())["error"]
    assert text.startswith("client [/old] wants service /add to have md5sum [000")
    assert told == [f"/old: {text}"]
    assert await client.ended()


async def test_an_unknown_service_is_a_clear_error(node: SlaveNode) -> None:
    with pytest.raises(
        PeerRefused, match=r"service /none: its server refused: \[/server\] does not offer .*\[/none\]"
    ):
        await connect(node, service="/none")


async def test_a_server_that_raises_is_an_error_to_the_client(
    node: SlaveNode, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(call: ServiceCall) -> None:
        raise RmpaError("no link to base") if call.request else ZeroDivisionError

    serve(node, fails)
    connection = await connect(node)
    assert await connection.call(b"1") == (False, b"no link to base")
    assert not caplog.records
    ok, text = await connection.call(b"")
    assert (ok, text) == (False, b"service [/add]: [/server] failed at this call; its log says why")
    assert "ZeroDivisionError" in caplog.text


async def test_the_deadline_answers_for_a_silent_server(node: SlaveNode) -> None:
    calls: list[ServiceCall] = []
    gone: list[bool] = []

    def silent(call: ServiceCall) -> None:
        call.on_gone = lambda: gone.append(True)
        calls.append(call)

    endpoint = serve(node, silent, timeout=0.05)
    connection = await connect(node)
    assert await connection.call(b"1") == (False, b"service [/add] did not answer within 0.05 s")
    assert gone == [True]
    calls[0].reply(True, b"late")  # must not become the answer to the next call
    endpoint.serve = echo
    assert await connection.call(b"2") == (True, b"2")
    assert (endpoint.calls, endpoint.failed) == (2, 1)


async def test_a_client_that_leaves_in_the_middle_of_a_call_ends_it(node: SlaveNode) -> None:
    started, cancelled = asyncio.Event(), asyncio.Event()

    def never(call: ServiceCall) -> None:
        call.on_gone = cancelled.set
        started.set()

    endpoint = serve(node, never)
    client = await RawClient.call(node)
    await client.header()
    await client.send(TWO)
    async with asyncio.timeout(DEADLINE):
        await started.wait()
        client.close()
        await cancelled.wait()
    assert len(endpoint._clients) == 0


async def test_oversized_request_is_refused_and_connection_goes_on(
    node: SlaveNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "SERVICE_MESSAGE_MAX", 100_000)
    endpoint = serve(node, add)
    client = await RawClient.call(node, persistent="1")
    await client.header()
    await client.send(framed(bytes(300_000)) + TWO)
    text = b"request of 300000 bytes to service [/add] exceeds the limit of 100000"
    assert await client.reply() == (0, text)
    assert await client.reply() == FORTY_TWO
    assert (endpoint.calls, endpoint.failed) == (2, 1)
    once = await RawClient.call(node)
    await once.header()
    await once.send(framed(bytes(300_000)))
    assert await once.reply() == (0, text)
    assert await once.ended()
    endpoint.serve = lambda call: call.reply(True, bytes(100_001))
    connection = await connect(node)
    ok, answer = await connection.call(b"")
    assert (ok, answer) == (False, b"response of 100001 bytes of service [/add] exceeds the limit of 100000")
    with pytest.raises(ServiceFailed, match="request of 100001 bytes exceeds the limit of 100000"):
        await connection.call(bytes(100_001))


async def test_a_client_that_sends_ahead_without_end_is_closed(
    node: SlaveNode, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits, "SERVICE_MESSAGE_MAX", 100_000)
    serve(node, lambda _call: None)
    client = await RawClient.call(node, persistent="1", callerid="/flood")
    await client.header()
    with contextlib.suppress(ConnectionError):
        async with asyncio.timeout(DEADLINE):
            while True:
                await client.send(TWO * 1000)
    assert "/flood: what was sent ahead of a reply" in caplog.text


async def test_a_silent_client_is_closed(node: SlaveNode, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.ros.node.service_server.SERVICE_STALL", 0.05)
    endpoint = serve(node, add)
    silent = await RawClient.call(node)
    half = await RawClient.call(node, persistent="1")
    idle = await RawClient.call(node, persistent="1")
    for client in (silent, half, idle):
        await client.header()
    await half.send(TWO[:9])
    assert await silent.ended()
    assert await half.ended()
    assert len(endpoint._clients) == 1  # persistent ones may wait for their next call as long as they like
    await idle.send(TWO)
    assert await idle.reply() == FORTY_TWO


async def test_a_client_that_does_not_read_is_served_no_further(node: SlaveNode) -> None:
    endpoint = serve(node, lambda call: call.reply(True, bytes(200_000)))
    client = await RawClient.early(node, "*", buffer=4096, persistent="1")
    await client.header()
    await client.send(TWO * 499)
    calls = -1
    while calls != endpoint.calls:
        calls = endpoint.calls
        await asyncio.sleep(0.05)
    assert calls < 100  # what the kernel's buffers took, some megabytes
    client.close()
    await until(lambda: not len(endpoint._clients))


async def test_a_node_that_ends_answers_what_is_under_way() -> None:
    node = SlaveNode("/server", "127.0.0.1", "")
    await node.start()
    large = bytes(3_000_000)
    endpoint = serve(node, lambda call: call.reply(True, large) if call.request else None)
    busy = await connect(node)
    reading = await connect(node)
    answers = [asyncio.create_task(busy.call(b"")), asyncio.create_task(reading.call(b"1"))]
    await until(lambda: endpoint.calls == 2)
    await node.close()
    assert await answers[0] == (False, b"service [/add] is no longer offered by [/server]")
    assert await answers[1] == (True, large)


async def test_the_server_that_does_not_speak_is_an_error() -> None:
    async def slam(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(10)
        writer.close()

    server = await asyncio.start_server(slam, "127.0.0.1", 0)
    uri = f"rosrpc://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    with pytest.raises((RemoteProtocolError, UnreachableError)):
        await ServiceConnection.open(uri, "/add", "/c")
    server.close()
    await server.wait_closed()
