"""The client of the measurements reads what servers send, whole or in pieces, and keeps no more than it should."""

from __future__ import annotations

import asyncio
import threading

import pytest
from aiohttp import WSMsgType, web
from hypothesis import given, settings
from hypothesis import strategies as st

from lab.bed.processes import BedError
from lab.web.websocket import BINARY, TEXT, Frame, FrameReader, WebSocket
from rmpa.web.gateways.frame_writer import Opcode, frame_header


def sent(opcode: Opcode, payload: bytes) -> bytes:
    return frame_header(opcode, len(payload)) + payload


@settings(deadline=None)
@given(st.lists(st.sampled_from([0, 1, 125, 126, 127, 65_535, 65_536]), max_size=4), st.integers(7, 70_000))
def test_frames_of_all_lengths_are_read_however_they_arrive(sizes: list[int], step: int) -> None:
    data = b"".join(sent(Opcode.BINARY, bytes(size)) for size in sizes)
    reader = FrameReader()
    frames = [frame for at in range(0, len(data), step) for frame in reader.feed(data[at : at + step])]
    assert frames == [Frame(BINARY, size, bytes(size)) for size in sizes]


def test_only_the_beginning_of_a_payload_is_kept() -> None:
    reader = FrameReader()
    reader.keep = 3
    data = sent(Opcode.TEXT, b"abcdef") + sent(Opcode.TEXT, b"x")
    frames = [frame for at in range(len(data)) for frame in reader.feed(data[at : at + 1])]
    assert frames == [Frame(TEXT, 6, b"abc"), Frame(TEXT, 1, b"x")]


class Echo:
    """A server of another library's making, in a thread; it pings before each answer."""

    def __init__(self) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self.port = asyncio.run_coroutine_threadsafe(self._start(), self._loop).result()

    async def _start(self) -> int:
        app = web.Application()
        app.router.add_get("/echo", self._echo)
        self._runner = web.AppRunner(app, shutdown_timeout=1)
        await self._runner.setup()
        await web.TCPSite(self._runner, "127.0.0.1", 0).start()
        port: int = self._runner.addresses[0][1]
        return port

    async def _echo(self, request: web.Request) -> web.WebSocketResponse:
        client = web.WebSocketResponse(protocols=("p",), autoping=False)
        await client.prepare(request)
        await client.send_str(f"hello {client.ws_protocol}")
        async for message in client:
            if message.type is WSMsgType.PONG:
                await client.send_str(f"pong {message.data.decode()}")
                continue
            await client.ping(b"there?")
            await (client.send_str(message.data[::-1]) if message.type is WSMsgType.TEXT else client.close())
        return client

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._runner.cleanup(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


def test_it_talks_to_a_server() -> None:
    server = Echo()
    try:
        with WebSocket(server.port, "/echo", "p") as client:
            assert client.receive().payload == b"hello p"
            client.send("abc" * 100)
            assert client.receive() == Frame(TEXT, 300, b"cba" * 100)
            assert client.receive().payload == b"pong there?"
            client.send(b"end")
            with pytest.raises(BedError, match="closed"):
                client.receive()
        with pytest.raises(BedError, match="404"):
            WebSocket(server.port, "/other")
    finally:
        server.close()
