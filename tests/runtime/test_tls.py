"""Streams over TLS, and the records below them."""

from __future__ import annotations

import asyncio
import random
import socket
import ssl

import pytest

from rmpa.core.errors import LocalProtocolError
from rmpa.core.limits import KIB, MIB
from rmpa.core.outbox import Outbox
from rmpa.runtime.stream import Stream
from rmpa.runtime.tls import INCOMPLETE, SecureSocket, TlsHandshake
from tests.runtime.message_streams import End
from tests.runtime.secure_pairs import SecurePairs, make_context
from tests.trust.authority import Authority
from tests.waiting import until

pytest.importorskip("cryptography")


def _transfer(sender: SecureSocket, receiver: SecureSocket, messages: list[list[bytes]], room: int) -> bytes:
    """Send messages as a stream does, and read them with a buffer of ``room`` bytes."""
    total = sum(len(part) for parts in messages for part in parts)
    left = [memoryview(b"".join(parts)) if len(parts) > 1 else memoryview(parts[0]) for parts in messages]
    got, view = bytearray(), memoryview(bytearray(room))
    while len(got) < total:
        if left:
            try:
                sent = sender.sendmsg((left[0],))
                left[0] = left[0][sent:]
                if not left[0]:
                    left.pop(0)
            except BlockingIOError:
                pass
        elif sender.pending:
            sender.flush()
        try:
            count = receiver.recv_into(view)
            assert count
            got += view[: max(count, 0)]
        except BlockingIOError:
            continue
    return bytes(got)


def test_a_message_is_one_record(tls: SecurePairs) -> None:
    one, other = tls.secured()
    assert one.sendmsg((b"h" * 24, memoryview(b"x" * 64))) == 88
    assert not one.pending
    assert len(tls.sockets[1].recv(4096, socket.MSG_PEEK)) == 88 + 22
    view = memoryview(bytearray(4096))
    assert other.recv_into(view) == 88
    assert view[:88] == b"h" * 24 + b"x" * 64
    with pytest.raises(BlockingIOError):
        other.recv_into(view)


def test_nothing_is_readable_on_the_way(tls: SecurePairs) -> None:
    one, _ = tls.secured()
    one.sendmsg((b"a secret text that is long enough",))
    assert b"secret" not in tls.sockets[1].recv(4096)


@pytest.mark.parametrize("most", [1, 7, 1460, 1 << 20])
@pytest.mark.parametrize("room", [1, 100, 65536])
def test_bytes_survive_slow_sockets_and_small_buffers(tls: SecurePairs, most: int, room: int) -> None:
    rng = random.Random(f"{most} {room}")
    sizes = (1, 24, 88, 5000, 16384, 16385, 40000) if min(most, room) > 7 else (1, 24, 88, 500)
    messages = [[rng.randbytes(size)] for size in sizes]
    one, other = tls.secured(most, most)
    for sender, receiver in ((one, other), (other, one)):
        assert _transfer(sender, receiver, messages, room) == b"".join(part for parts in messages for part in parts)


def test_parts_are_taken_in_order_and_at_most_so_many(tls: SecurePairs) -> None:
    one, other = tls.secured()
    parts = [bytes([n]) * size for n, size in enumerate((24, 100_000, 24, 16_000, 3, 200_000))]
    whole = b"".join(parts)
    taken = one.sendmsg(parts)
    assert taken == 128 * 1024
    got, view = bytearray(), memoryview(bytearray(65536))
    while len(got) < taken:
        if one.pending:
            one.flush()
        try:
            got += view[: max(other.recv_into(view), 0)]
        except BlockingIOError:
            continue
    assert got == whole[:taken]


def test_a_peer_that_does_not_read_is_not_written_to(tls: SecurePairs) -> None:
    one, _ = tls.secured()
    taken = 0
    while not one.pending:
        taken += one.sendmsg((bytes(65536),))
        assert taken < 1 << 26
    with pytest.raises(BlockingIOError):
        one.sendmsg((b"more",))
    assert not one.flush()


def test_what_epoll_does_not_see_is_said(tls: SecurePairs) -> None:
    one, other = tls.secured()
    one.sendmsg((b"x" * 1000,))
    view = memoryview(bytearray(400))
    assert other.recv_into(view) == 400
    assert other.readable
    assert other.recv_into(view) == 400
    assert other.recv_into(view) == 200
    assert not other.readable


def test_a_part_of_a_record_is_a_sign_of_life(tls: SecurePairs) -> None:
    one, other = tls.secured(10)
    one.sendmsg((b"x" * 100,))
    view = memoryview(bytearray(4096))
    assert other.recv_into(view) == INCOMPLETE
    while not one.flush():
        pass
    assert other.recv_into(view) == 100


def test_the_end_is_the_end(tls: SecurePairs) -> None:
    one, other = tls.secured()
    one.sendmsg((b"bye",))
    one.shutdown(socket.SHUT_WR)
    view = memoryview(bytearray(100))
    assert other.recv_into(view) == 3
    assert other.recv_into(view) == 0
    assert other.recv_into(view) == 0
    other.sendmsg((b"last words",))
    assert one.recv_into(view) == 10


@pytest.mark.parametrize("room", [3, 100])
@pytest.mark.parametrize("before", [b"", b"bye"])
def test_what_follows_the_end_is_not_read(tls: SecurePairs, before: bytes, room: int) -> None:
    one, other = tls.secured()
    if before:
        one.sendmsg((before,))
    with pytest.raises(ssl.SSLError):
        one._tls.unwrap()
    tls.sockets[0].send(one._outgoing.read() + bytes(500))
    view = memoryview(bytearray(room))
    if before:
        assert other.recv_into(view) == len(before)
    assert other.recv_into(view) == 0


def test_an_end_in_the_middle_is_the_end(tls: SecurePairs) -> None:
    one, other = tls.secured(10)
    one.sendmsg((b"x" * 100,))
    one.close()
    view = memoryview(bytearray(100))
    assert other.recv_into(view) == INCOMPLETE
    assert other.recv_into(view) == 0


def test_changed_bytes_end_the_connection(tls: SecurePairs) -> None:
    _, other = tls.secured()
    tls.sockets[0].send(b"\x17\x03\x03\x00\x20" + bytes(32))
    with pytest.raises(ssl.SSLError):
        other.recv_into(memoryview(bytearray(100)))


def test_plain_bytes_end_the_connection(tls: SecurePairs) -> None:
    _, other = tls.secured()
    tls.sockets[0].send(bytes(100))
    with pytest.raises(ssl.SSLError):
        other.recv_into(memoryview(bytearray(100)))


def test_bytes_behind_the_handshake_are_read_first(tls: SecurePairs) -> None:
    client, server = TlsHandshake(tls.contexts[0], server_side=False), TlsHandshake(tls.contexts[1], server_side=True)
    with pytest.raises(LocalProtocolError):
        client.secure(tls.sockets[0])
    client.receive(b"")
    server.receive(client.take_output())
    client.receive(server.take_output())
    assert client.done
    flight = client.take_output()
    one = client.secure(tls.sockets[0])
    one.sendmsg((b"hello",))
    server.receive(flight + tls.sockets[1].recv(4096))
    assert server.done
    other = server.secure(tls.sockets[1])
    assert other.readable
    view = memoryview(bytearray(100))
    assert other.recv_into(view) == 5
    assert bytes(view[:5]) == b"hello"


def test_a_foreign_ca_is_told_to_the_other_side(tls: SecurePairs) -> None:
    foreign = make_context(Authority(), server_side=False)
    client, server = TlsHandshake(foreign, server_side=False), TlsHandshake(tls.contexts[1], server_side=True)
    client.receive(b"")
    server.receive(client.take_output())
    with pytest.raises(ssl.SSLCertVerificationError) as caught:
        client.receive(server.take_output())
    assert caught.value.verify_code in {18, 19, 20, 21}
    with pytest.raises(ssl.SSLError, match="ALERT_UNKNOWN_CA"):
        server.receive(client.take_output())


pytest.importorskip("cryptography")


def ends(tls: SecurePairs, most: int = 1 << 30, there: int = 1 << 30) -> tuple[End, End]:
    one, other = (
        End(sock, secure=secure) for sock, secure in zip(tls.sockets, tls.secured(most, there), strict=True)
    )
    return one, other


@pytest.mark.parametrize("most", [1 << 30, 1000])
async def test_all_sizes_in_order_both_ways(tls: SecurePairs, most: int) -> None:
    one, other = ends(tls, most, most)
    sizes = [0, 1, 3, 100, 16380, 16384, 65532, 200_000, 3 * MIB if most > 1000 else 9, 5, 7] * 2
    messages = [bytes([i]) * size for i, size in enumerate(sizes)]
    for message in messages:
        one.send(message)
        other.send(message[::-1])
    await until(lambda: len(one.got) == len(other.got) == len(messages))
    assert other.got == one.got == messages
    assert one.stream.bytes_out == other.stream.bytes_in == sum(sizes) + 4 * len(sizes)
    assert not one.stream.pending_bytes


async def test_ciphertext_never_comes_into_a_kept_outbox(tls: SecurePairs) -> None:
    """What waits for the next connection is plain text, and nothing of it was sent as a part."""
    one, _ = tls.secured()
    outbox = Outbox(1 << 20, 1 << 30)
    stream = Stream(
        tls.sockets[0],
        on_bytes=lambda view: (len(view), 0),
        on_close=lambda _: None,
        outbox=Outbox(1, 1),
        secure=one,
    )
    stream.adopt(outbox, None)
    message = b"plain text " * 1000
    while not outbox.waiting_entries or outbox.waiting_entries < 5:
        stream.send((message,), 1)
    waiting = outbox.pending_bytes
    stream.close()
    assert outbox.pending_bytes == waiting
    assert b"".join(bytes(part) for part in outbox.head(1 << 20)).endswith(message)
    assert set(b"".join(bytes(part) for part in outbox.head(1 << 20))) == set(message)


async def test_a_peer_that_does_not_read_costs_nothing(tls: SecurePairs) -> None:
    """Neither a loop that is busy, nor more memory than the outbox may have, nor more than a record in ciphertext."""
    one, _ = tls.secured()
    end = End(tls.sockets[0], Outbox(1 << 20, MIB), one)
    dropped = 0
    for _ in range(400):
        dropped += end.send(bytes(64 * KIB))
    assert dropped > 100
    assert end.stream.pending_bytes <= MIB + 128 * KIB
    turns = 0
    calls = 0
    real = end.stream._writable

    def count() -> None:
        nonlocal calls
        calls += 1
        real()

    end.stream._loop.add_writer(end.stream._fd, count)
    while turns < 50:
        await asyncio.sleep(0.001)
        turns += 1
    assert calls <= 2


async def test_the_last_bytes_leave_before_the_end(tls: SecurePairs) -> None:
    one, other = ends(tls, 50)
    one.send(b"x" * 5000)
    assert not one.stream.pending_bytes, "the outbox has nothing, and yet not all is sent"
    one.stream.finish()
    await until(lambda: bool(other.ends))
    assert other.got == [b"x" * 5000]
    assert other.ends == [None]


async def test_drained_waits_for_ciphertext(tls: SecurePairs) -> None:
    one, other = ends(tls, 50)
    one.send(b"x" * 5000)
    await one.stream.drained(20)
    await until(lambda: other.got == [b"x" * 5000])


async def test_bytes_behind_the_handshake_are_read(tls: SecurePairs) -> None:
    """They are in OpenSSL already when the stream is made, so the loop does not report them."""
    one, other = tls.secured()
    one.sendmsg((b"\0\0\0\5hello",))
    ciphertext = b""
    while not ciphertext:
        try:
            ciphertext = tls.sockets[1].recv(65536)
        except BlockingIOError:
            await asyncio.sleep(0)
    other._incoming.write(ciphertext)
    other.readable = True
    end = End(tls.sockets[1], secure=other)
    await until(lambda: end.got == [b"hello"])
