"""Frames over a real connection whose reader takes as much as the test wants."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
import tracemalloc
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.web.gateways.frame_writer import FrameWriter, Opcode, frame_header
from tests.ros.node.peers import DEADLINE, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

PAYLOAD = bytes(range(251)) * 16_000
"""4 MB, in which a part that is left out or twice would show."""


async def no_drain() -> None: ...


class Reader:
    """The client's end."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        self.bytes = bytearray()

    async def read(self, count: int) -> None:
        """Read until there are so many bytes in all."""
        async with asyncio.timeout(DEADLINE):
            while len(self.bytes) < count:
                data = await asyncio.get_running_loop().sock_recv(self.sock, 37_501)
                assert data, "the connection has ended"
                self.bytes += data


@contextlib.asynccontextmanager
async def connection(count: int = 1) -> AsyncIterator[list[tuple[FrameWriter, asyncio.Transport, Reader]]]:
    """So many connections; the kernel takes a few KB of each."""
    loop = asyncio.get_running_loop()
    made = []
    for _ in range(count):
        near, far = socket.socketpair()
        near.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8192)
        near.setblocking(False)
        far.setblocking(False)
        transport, _ = await loop.connect_accepted_socket(asyncio.Protocol, near)
        made.append((FrameWriter(transport, no_drain), transport, Reader(far)))
    try:
        yield made
    finally:
        for writer, transport, reader in made:
            writer.close()
            transport.abort()
            reader.sock.close()
        await asyncio.sleep(0)


async def test_frames_arrive_whole_and_in_order_at_a_slow_reader() -> None:
    async with connection() as [(writer, transport, reader)]:
        expected = bytearray()
        for number in range(3):
            parts = (bytes([number]) * 13, b"", memoryview(PAYLOAD)[number:])
            writer.write(Opcode.BINARY, parts)
            expected += frame_header(Opcode.BINARY, 13 + len(PAYLOAD) - number) + b"".join(parts)
            # Behind the first bytes of a large frame, which has not left: it must not get into it.
            writer.write(Opcode.PING, ())
            writer.write(Opcode.PONG, (b"answer",))
            expected += b"\x89\x00" + b"\x8a\x06answer"
        assert writer.unsent > len(PAYLOAD)
        await reader.read(len(expected))
        assert reader.bytes == expected
        await until(lambda: writer.unsent == 0)
        writer.write(Opcode.TEXT, (b"next",))
        await reader.read(len(expected) + 6)
        assert reader.bytes[len(expected) :] == b"\x81\x04next"
        assert transport.get_write_buffer_size() == 0


async def test_what_waits_for_many_readers_is_kept_once() -> None:
    async with connection(8) as made:
        tracemalloc.start()
        try:
            for writer, _, _ in made:
                writer.write(Opcode.BINARY, (b"head", PAYLOAD))
            grown, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert all(writer.unsent > len(PAYLOAD) // 2 for writer, _, _ in made)
        assert grown < len(PAYLOAD) // 4


async def test_drain_waits_for_the_reader_and_for_nothing_else() -> None:
    async with connection() as [(writer, _, reader)]:
        await asyncio.wait_for(writer.drain(), DEADLINE)
        writer.write(Opcode.BINARY, (PAYLOAD,))
        draining = asyncio.ensure_future(writer.drain())
        await reader.read(len(PAYLOAD) // 2)
        assert not draining.done()
        await reader.read(len(PAYLOAD))
        await asyncio.wait_for(draining, DEADLINE)


async def test_a_close_frame_that_another_writes_comes_behind_a_frame_under_way() -> None:
    async with connection() as [(writer, transport, reader)]:
        writer.write(Opcode.BINARY, (PAYLOAD,))
        draining = asyncio.ensure_future(writer.drain())
        await reader.read(100_000)
        writer.hand_over()
        transport.write(b"\x88\x02" + struct.pack("!H", 1001))
        writer.write(Opcode.PING, ())  # nothing is lost or overtakes, whatever still comes
        await asyncio.wait_for(draining, DEADLINE)
        expected = frame_header(Opcode.BINARY, len(PAYLOAD)) + PAYLOAD + b"\x88\x02\x03\xe9" + b"\x89\x00"
        await reader.read(len(expected))
        assert reader.bytes == expected


async def test_a_reader_that_goes_ends_the_connection_and_the_wait() -> None:
    async with connection() as [(writer, transport, reader)]:
        writer.write(Opcode.BINARY, (PAYLOAD,))
        draining = asyncio.ensure_future(writer.drain())
        await reader.read(100_000)
        reader.sock.close()
        await asyncio.wait_for(draining, DEADLINE)
        await until(transport.is_closing)
        writer.write(Opcode.BINARY, (PAYLOAD,))
        assert writer.is_closing
        assert writer.unsent == 0


@pytest.mark.parametrize("by_close", [True, False])
async def test_nothing_is_written_to_a_connection_that_was_closed(by_close: bool) -> None:
    async with connection() as [(writer, transport, reader)]:
        writer.write(Opcode.BINARY, (PAYLOAD,))
        draining = asyncio.ensure_future(writer.drain())
        await asyncio.sleep(0)
        if by_close:
            writer.close()
        transport.abort()
        with contextlib.suppress(AssertionError):
            await reader.read(len(PAYLOAD))
        assert len(reader.bytes) < len(PAYLOAD)
        await asyncio.wait_for(draining, DEADLINE)


class TlsTransport:
    """What a frame writer needs of a transport with TLS."""

    def __init__(self) -> None:
        self.written: list[bytes] = []

    def get_extra_info(self, name: str) -> Any:
        return object() if name in ("socket", "sslcontext") else None

    def get_write_buffer_size(self) -> int:
        return 0

    def is_closing(self) -> bool:
        return False

    def write(self, data: bytes) -> None:
        self.written.append(bytes(data))


async def test_with_tls_the_transport_writes() -> None:
    transport: Any = TlsTransport()
    writer = FrameWriter(transport, no_drain)
    writer.write(Opcode.BINARY, (b"head", memoryview(PAYLOAD)))
    assert b"".join(transport.written) == frame_header(Opcode.BINARY, len(PAYLOAD) + 4) + b"head" + PAYLOAD
    assert transport.written[1] == PAYLOAD
