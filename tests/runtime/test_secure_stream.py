"""The stream over TLS: slow and hostile sockets, large messages both ways, and what must not wait or be lost."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("cryptography")

from rmpa.core.limits import KIB, MIB
from rmpa.core.outbox import Outbox
from rmpa.runtime.stream import Stream
from tests.runtime.message_streams import End

if TYPE_CHECKING:
    from collections.abc import Callable

    from tests.runtime.secure_pairs import SecurePairs


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(30):
        while not condition():
            await asyncio.sleep(0.001)


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
        outbox=outbox,
        keep=True,
        secure=one,
    )
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
