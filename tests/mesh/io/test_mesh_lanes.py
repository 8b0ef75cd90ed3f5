"""The two lanes of a link on loopback: they come up together, bulk falls alone, messages in parts, fences."""

from __future__ import annotations

import asyncio
import hashlib
import socket
from collections.abc import Awaitable, Callable
from dataclasses import replace

import pytest

from rmpa.config.settings import LaneSettings
from rmpa.core.identity import Guid, Identity
from rmpa.mesh.frames import Frame, FrameKind, Lane, pack_data_header
from rmpa.mesh.io.lane import BULK_UNSENT_BYTES, EXPRESS_UNSENT_BYTES, LINK_UNACKED, LaneSender
from rmpa.mesh.io.link import Connection, PeerLink
from tests.mesh.io.meshes import DEADLINE, Peer, linked_pair, peers, raw, until

HAND_MADE = Identity(Guid.of("127.0.0.1", 9), b"h" * 16, "hand_made")


def large(number: int, size: int) -> bytes:
    """Bytes without repetitions."""
    block = hashlib.sha256(number.to_bytes(4, "big")).digest()
    return b"".join(hashlib.sha256(block + n.to_bytes(4, "big")).digest() for n in range(size // 32 + 1))[:size]


def bulk_of(link: PeerLink) -> Connection:
    bulk = link.bulk_connection
    assert bulk is not None
    return bulk


# --- coming up ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lanes", "options"),
    [
        (LaneSettings(express_dscp=46, express_priority=5, bulk_dscp=8, bulk_priority=2), [(46, 5), (8, 2)]),
        (LaneSettings(), [(48, 6), (0, 0)]),
    ],
)
async def test_the_sockets_of_both_lanes_have_their_options(
    lanes: LaneSettings, options: list[tuple[int, int]]
) -> None:
    async with peers(2, lanes=lanes) as (one, other):
        await until(lambda: one.both_lanes(other) and other.both_lanes(one), "both lanes")
        for peer, far in ((one, other), (other, one)):
            express = peer.link(far)
            both = [(express.connection, EXPRESS_UNSENT_BYTES), (bulk_of(express), BULK_UNSENT_BYTES)]
            for (connection, unsent), (dscp, priority) in zip(both, options, strict=True):
                sock = connection.sock
                assert sock.getsockopt(socket.IPPROTO_IP, socket.IP_TOS) == dscp << 2
                assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_PRIORITY) == priority
                assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT) == unsent
                assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
                unacked = sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT)
                assert unacked == round(LINK_UNACKED * 1000)
            assert not peer.mesh.counters["link.option_refused"]


def hold_bulk(peer: Peer, *, fails: int = 0, until_set: asyncio.Event | None = None) -> None:
    """Let dials of bulk lanes fail, or wait."""
    real: Callable[..., Awaitable[socket.socket]] = peer.mesh.dialler.connect
    left = [None] * fails

    async def connect(endpoint: tuple[str, int], lane: Lane, *rest: float) -> socket.socket:
        if lane is Lane.BULK and left:
            left.pop()
            raise ConnectionRefusedError
        if lane is Lane.BULK and until_set is not None:
            await until_set.wait()
        return await real(endpoint, lane, *rest)

    peer.mesh.dialler.connect = connect  # type: ignore[assignment, method-assign]


# --- messages -----------------------------------------------------------------------------------------------------


async def test_each_route_has_its_own_bound_and_drops_its_own() -> None:
    async with linked_pair() as (one, other):
        lane = one.link(other).bulk
        lane.set_terms(8, 2, spared=True)
        lane.send(7, 0, 0, bytes(32 << 20))
        dropped = [lane.send(8, number, 0, b"%d" % number) for number in range(5)]
        assert dropped == [0, 0, 1, 1, 1]
        lane.send(9, 0, 0, b"other")
        await until(lambda: len(other.data) == 4, "what was kept")
        assert other.messages(8) == [(3, b"3"), (4, b"4")]
        assert other.messages(9) == [(0, b"other")]
        assert one.link(other).info().dropped == 3
        assert [link.info().dropped for link in one.mesh.links()] == [3]


# --- the bulk lane falls alone ------------------------------------------------------------------------------------


@pytest.mark.parametrize("by_dialler", [True, False])
async def test_small_messages_go_on_while_the_bulk_lane_is_gone(by_dialler: bool) -> None:
    async with linked_pair() as (one, other):
        held = asyncio.Event()
        hold_bulk(one, until_set=held)
        for sender, receiver in ((one, other), (other, one)):
            sender.link(receiver).bulk.send(7, 1, 0, large(1, 200_000))
        await until(lambda: bool(one.data and other.data), "before the cut")
        victim = one.link(other) if by_dialler else other.link(one)
        before = [one.link(other), other.link(one)]
        infos = [link.info() for link in before]
        bulk_of(victim).sock.shutdown(socket.SHUT_RDWR)
        await until(lambda: bool(one.lanes_lost and other.lanes_lost), "both know")
        for sender, receiver in ((one, other), (other, one)):
            link = sender.link(receiver)
            assert link.bulk_connection is None
            assert link.bulk._stream is None
            assert link.connection.up
            link.bulk.send(7, 2, 0, large(2, 300_000))
            link.bulk.send(7, 3, 0, b"small behind it")
            for number in range(50):
                link.express.send(8, number, 0, b"cmd")
        await until(lambda: len(one.messages(8)) == len(other.messages(8)) == 50, "commands meanwhile")
        assert one.messages(7) == other.messages(7) == [(1, large(1, 200_000))]
        held.set()
        await until(lambda: len(one.messages(7)) == len(other.messages(7)) == 3, "what waited")
        for peer in (one, other):
            assert peer.messages(7)[1:] == [(2, large(2, 300_000)), (3, b"small behind it")]
            assert not peer.downs
            assert len(peer.ups) == len(peer.lanes_lost) == 1
            assert peer.mesh.counters["link.bulk_lost"] == 1
        assert [one.link(other), other.link(one)] == before
        for now, was in zip([link.info() for link in before], infos, strict=True):
            assert now.bytes_in >= was.bytes_in + 300_000, "the counts of the connection before are kept"
            assert now.bytes_out >= was.bytes_out + 300_000


async def test_rest_of_a_torn_message_is_not_sent() -> None:
    async with linked_pair() as (one, other):
        lane = one.link(other).bulk
        parcel = lane.open(7, 200_000, 1, 0)
        lane.extend(parcel, bytes(100_000))
        await until(lambda: bool(other._begun), "its first half")
        bulk_of(one.link(other)).sock.shutdown(socket.SHUT_RDWR)
        await until(lambda: bool(one.lanes_lost and other.lanes_lost), "cut")
        lane.extend(parcel, bytes(50_000))
        await until(lambda: one.both_lanes(other) and other.both_lanes(one), "it is back")
        lane.extend(parcel, bytes(50_000))
        lane.send(7, 2, 0, b"next")
        await until(lambda: bool(other.data), "the next one")
        assert other.data == [(7, 2, 0, b"next")]
        assert len(one.lanes_lost) == len(other.lanes_lost) == 1, "nor did its pieces disturb the new one"


# --- fences -------------------------------------------------------------------------------------------------------


async def test_both_lanes_end_with_the_link() -> None:
    async with linked_pair() as (one, other):
        link = one.link(other)
        one.mesh.peer_gone(other.identity.guid)
        other.mesh.peer_gone(one.identity.guid)
        link.close("maintenance")
        await until(lambda: not one.mesh.connections() and not other.mesh.connections(), "all connections are closed")
        assert one.downs == [(link, "maintenance")]
        assert not one.lanes_lost, "the whole link is gone, and that is what is told"
        assert link.express.ended
        assert link.bulk.ended
        assert link.bulk.send(1, 1, 0, b"x") == link.express.send(1, 1, 0, b"x") == 0
        assert link.bulk.outbox.waiting(1) == 0


@pytest.mark.parametrize("way", ["express", "bulk"])
async def test_fence_is_answered_after_all_messages_before_it(way: str) -> None:
    async with linked_pair() as (one, other):
        lane: LaneSender = getattr(one.link(other), way)
        seen: list[list[int]] = []
        taken = one.on_mark

        def on_mark(link: PeerLink, kind: FrameKind, route: int, sequence: int) -> None:
            taken(link, kind, route, sequence)
            seen.append([number for number, _ in other.messages(7)])

        one.mesh.handlers = replace(one.mesh.handlers, mark=on_mark)
        for number in range(4):
            lane.send(7, 2 * number, 0, large(number, 2_000_000 if number % 2 else 100))
            lane.fence(7, number + 1)
            lane.send(7, 2 * number + 1, 0, b"behind it")
        await until(lambda: len(one.marks) == 4, "all answers")
        assert one.marks == [(FrameKind.FENCED, 7, number) for number in (1, 2, 3, 4)]
        for number, arrived in enumerate(seen):
            assert arrived[: 2 * number + 1] == list(range(2 * number + 1))
        assert not other.marks, "a fence is answered, and told to nobody"


async def test_fence_waits_for_the_lanes_connection() -> None:
    async with linked_pair() as (one, other):
        held = asyncio.Event()
        hold_bulk(one, until_set=held)
        bulk_of(one.link(other)).sock.shutdown(socket.SHUT_RDWR)
        await until(lambda: bool(one.lanes_lost and other.lanes_lost), "cut")
        lane = one.link(other).bulk
        lane.set_terms(7, 1, spared=True)
        lane.send(7, 1, 0, b"dropped")
        lane.fence(7, 1)
        lane.send(7, 2, 0, b"kept")
        lane.fence(7, 2)
        held.set()
        await until(lambda: len(one.marks) == 2, "both answers")
        assert one.marks == [(FrameKind.FENCED, 7, 1), (FrameKind.FENCED, 7, 2)]
        assert other.messages(7) == [(2, b"kept")]


async def test_fence_on_an_unused_link_is_not_answered() -> None:
    """An answer would mean that the messages were delivered."""
    async with peers(1) as (one,):
        sock, _ = await raw(one, HAND_MADE, lease=60.0)
        await until(lambda: bool(one.ups), "a link")
        one.ups[0].use(used=False)
        before = one.ups[0].info().bytes_in
        loop = asyncio.get_running_loop()
        data = pack_data_header(3, 7, 1, 0) + b"not"
        await loop.sock_sendall(sock, data + Frame(FrameKind.FENCE, route=7, sequence=1).serialize())
        await until(lambda: one.ups[0].info().bytes_in >= before + 2 * 24 + 3, "read")
        one.ups[0].use(used=True)
        await loop.sock_sendall(sock, data + Frame(FrameKind.FENCE, route=7, sequence=2).serialize())
        kept = b""
        answers: list[int] = []
        while not answers:
            kept += await asyncio.wait_for(loop.sock_recv(sock, 4096), DEADLINE)
            while (parsed := Frame.parse(kept)) is not None:
                kept = kept[parsed[1] :]
                answers += [parsed[0].sequence] * (parsed[0].kind is FrameKind.FENCED)
        assert answers == [2]
        assert len(one.data) == 1
        sock.close()
        await until(lambda: not one.mesh.connections(), "closed")


async def test_acknowledgements_overtake_data() -> None:
    async with linked_pair() as (one, other):
        link = one.link(other)
        link.express.send(7, 1, 0, bytes(32 << 20))
        link.mark(FrameKind.ACK, 9, (1 << 32) + 5)
        await until(lambda: bool(other.marks), "the acknowledgement")
        assert other.marks == [(FrameKind.ACK, 9, 5)]
        assert not other.data


# --- a lane on demand ---------------------------------------------------------------------------------------------


async def test_what_a_peer_asks_waits_after_a_stop_until_the_link_is_proven() -> None:
    async with linked_pair() as (one, other):
        link, done = one.link(other), list[str]()
        link.when_proven(lambda: done.append("at once"))
        link.connection.doubted = bulk_of(link).doubted = True
        link.when_proven(lambda: done.append("in turn"))
        assert done == ["at once"]
        link.when_proven(lambda: done.append("behind it"))
        await link.ping()
        await bulk_of(link).measure()
        await until(lambda: len(done) == 3, "the answers")
        assert done == ["at once", "in turn", "behind it"]
        link.connection.doubted = True
        link.when_proven(lambda: done.append("never"))
        link.abort("the peer had ended it")
        await until(lambda: bool(one.downs), "the end")
        assert len(done) == 3
