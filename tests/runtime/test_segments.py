"""Small segments on the wire, whatever the kernel would join: counted by the kernel itself, on loopback."""

from __future__ import annotations

import os
import socket
import struct
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.runtime.segments import SegmentedSocket

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

SIZE = 1200


class Taker:
    """In place of a socket: takes as much as it is told, and remembers the pieces."""

    def __init__(self, room: Sequence[int]) -> None:
        self.room = list(room)
        self.packets: list[bytearray] = [bytearray()]

    def sendmsg(self, parts: Sequence[memoryview], ancillary: object, flags: int) -> int:
        assert flags == socket.MSG_EOR
        assert not ancillary
        data = b"".join(parts)
        room = self.room.pop(0) if self.room else len(data)
        if not room:
            raise BlockingIOError
        self.packets[-1] += data[:room]
        if room >= len(data):
            self.packets.append(bytearray())
        return min(room, len(data))


@given(
    st.lists(st.lists(st.binary(max_size=60), max_size=5), max_size=8),
    st.lists(st.integers(0, 30), max_size=20),
    st.integers(1, 20),
)
def test_no_packet_is_larger_and_no_byte_is_lost(messages: list[list[bytes]], room: list[int], size: int) -> None:
    taker = Taker(room)
    sock = SegmentedSocket(taker, size)  # type: ignore[arg-type]  # what it uses of one
    for message in messages:
        rest = b"".join(message)
        parts: Sequence[bytes] = message
        while rest:
            try:
                sent = sock.sendmsg(parts)
            except BlockingIOError:
                sent = 0
            rest = rest[sent:]
            parts = [rest]
    assert b"".join(taker.packets) == b"".join(part for message in messages for part in message)
    assert all(len(packet) <= size for packet in taker.packets)


def test_smaller_size_begins_a_new_packet() -> None:
    taker = Taker([700, 300, 300, 300])
    sock = SegmentedSocket(taker, 1200)  # type: ignore[arg-type]  # what it uses of one
    assert sock.sendmsg([bytes(1000)]) == 700
    sock.size = 512
    assert sock.sendmsg([bytes(300)]) == 300


def test_an_error_behind_bytes_that_left_comes_with_the_next_call() -> None:
    taker = Taker([10, 10, 0])
    sock = SegmentedSocket(taker, 10)  # type: ignore[arg-type]  # likewise
    assert sock.sendmsg([bytes(25)]) == 20
    taker.room = [0]
    with pytest.raises(BlockingIOError):
        sock.sendmsg([bytes(5)])


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as client:
        accepted, _ = server.accept()
        with accepted:
            yield client, accepted


def segments_out(sock: socket.socket) -> int:
    """Segments with data that the kernel has sent (tcpi_data_segs_out)."""
    found: int = struct.unpack_from("=156xI", sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 256))[0]
    return found


def test_the_kernel_joins_nothing(pair: tuple[socket.socket, socket.socket]) -> None:
    """On loopback it would send up to 64 KiB at once."""
    sender, receiver = pair
    data = os.urandom(50 * SIZE)
    before = segments_out(sender)
    assert SegmentedSocket(sender, SIZE).sendmsg([data[:1000], data[1000:]]) == len(data)
    got = b""
    while len(got) < len(data):
        got += receiver.recv(1 << 16)
    assert got == data
    assert segments_out(sender) - before >= 50


def test_the_rest_is_the_sockets(pair: tuple[socket.socket, socket.socket]) -> None:
    sender, receiver = pair
    sock = SegmentedSocket(sender, SIZE)
    receiver.sendall(b"abc")
    buffer = bytearray(8)
    assert sock.recv_into(memoryview(buffer)) == 3
    sock.shutdown(socket.SHUT_WR)
    assert receiver.recv(1) == b""
    sock.close()
    assert sender.fileno() < 0
