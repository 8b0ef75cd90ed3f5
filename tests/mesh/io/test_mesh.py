"""A mesh over real sockets: links, and how they end."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import gc
import socket
import sys
import weakref
from collections.abc import Iterator
from dataclasses import replace
from ipaddress import IPv4Address
from typing import Final

import pytest

from rmpa.config.settings import LaneSettings
from rmpa.core.identity import Guid, Identity
from rmpa.core.limits import KIB, MIB
from rmpa.core.statistics import Counters
from rmpa.mesh import limits
from rmpa.mesh.frames import FrameKind, Lane, Refusal, Refuse
from rmpa.mesh.io.lane import (
    BULK_WINDOW_MAX,
    BULK_WINDOW_MIN,
    DIAL_ATTEMPTS,
    EXPRESS_UNSENT_BYTES,
    Dialler,
    bound_queue,
    may_use_bbr,
    repeats_quickly,
)
from rmpa.mesh.io.link import Connection, PeerLink
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import DESCRIPTORS
from tests.mesh.io.meshes import Peer, linked_pair, peers, raw, until
from tests.runtime.descriptors_left import descriptors_left

_SIOCOUTQNSD = 0x894B  # linux/sockios.h: bytes that were not sent yet


async def test_of_several_addresses_whichever_answers_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """The GUID's own address does not answer, the next one refuses, at the third another program answers."""
    one, other = sorted((Peer(1, host="127.0.0.4"), Peer(2, host="127.0.0.4")), key=lambda p: p.identity.guid)
    connect = one.mesh.dialler.connect  # where packets are swallowed

    async def through(endpoint: tuple[str, int], lane: Lane, within: float = limits.DIAL_TIMEOUT) -> socket.socket:
        if endpoint[0] == "127.0.0.1":
            await asyncio.sleep(within)
            raise TimeoutError
        return await connect(endpoint, lane, within)

    monkeypatch.setattr(one.mesh.dialler, "connect", through)
    stranger = await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.3", other.port)
    try:
        await one.mesh.start()
        await other.mesh.start()
        began = asyncio.get_running_loop().time()
        addresses = tuple(map(IPv4Address, ("127.0.0.2", "127.0.0.3", "127.0.0.4")))
        one.mesh.peer_found(replace(other.identity, addresses=addresses))
        await until(lambda: one.linked(other) and other.linked(one), "a link")
        assert one.link(other).remote_endpoint[0] == "127.0.0.4"
        assert asyncio.get_running_loop().time() - began < sum(DIAL_ATTEMPTS)
    finally:
        stranger.close()
        await stranger.wait_closed()
        await one.mesh.close()
        await other.mesh.close()


async def test_a_restarted_peer_has_the_link_at_rest_of_its_former_run_checked() -> None:
    """The former run's host lost its power: no connection ended, and at rest the silence is noticed late."""
    async with linked_pair(lanes=False) as (one, other):
        successor = replace(other.identity, guid=Guid.of("127.0.0.1", other.port, 1), instance=b"s" * 16)

        async def answer() -> int:
            sock, frame = await raw(one, successor)
            sock.close()
            assert frame.kind is FrameKind.REFUSE
            return Refuse.parse(frame.payload).code

        assert await answer() == Refusal.DUPLICATE  # the link is in use: two live runs
        one.link(other).need(needed=False)
        other.link(one).need(needed=False)
        await until(lambda: one.link(other).rests, "the link rests")
        assert await answer() == Refusal.ALREADY_LINKED  # it may dial again soon
        assert not one.link(other).rests  # and the link is asked for a sign of life meanwhile
        await until(lambda: not other.link(one).rests, "the live run answers")
        assert await answer() == Refusal.DUPLICATE
        assert one.linked(other)


async def test_another_domain_is_refused_with_what_to_do(caplog: pytest.LogCaptureFixture) -> None:
    async with peers(1) as (one,):
        stranger = Identity(Guid.of("127.0.0.1", 9), b"s" * 16, "stranger", domain=7)
        sock, answer = await raw(one, stranger)
        sock.close()
        assert answer.kind is FrameKind.REFUSE
        assert Refuse.parse(answer.payload).code == Refusal.DOMAIN
        assert "--domain" in Refuse.parse(answer.payload).text
        assert one.mesh.counters["link.refused.domain"] == 1
        await until(lambda: not one.mesh.connections(), "the link ended")
        assert [r.message for r in caplog.records if "domain" in r.message and r.levelname == "WARNING"] == [
            f"! refused a link with stranger at 127.0.0.1: {Refuse.parse(answer.payload).text} [peer-refused]"
        ]


async def test_unread_control_frames_close_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.mesh.io.link.CONNECTION_URGENT_BYTES", MIB)
    async with peers(1) as (one,):
        sock, _ = await raw(one, Identity(Guid.of("127.0.0.1", 9), b"s" * 16, "deaf"), lease=60.0)
        await until(lambda: bool(one.ups), "a link")
        for _ in range(64):
            one.ups[0].send_control(bytes(MIB // 2))
        await until(lambda: bool(one.downs), "closed")
        assert "deaf does not read" in one.downs[0][1]
        sock.close()


def test_kernel_queue_stays_short_for_a_slow_peer() -> None:
    """Messages in the agent's own queue can be overtaken; a pong behind megabytes of data was 5 s late."""
    counters = Counters()
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as sock:
        Dialler(LaneSettings(), counters).tune(sock, Lane.EXPRESS)
        sock.setblocking(False)
        with server.accept()[0]:  # reads nothing
            with contextlib.suppress(BlockingIOError):
                while True:
                    sock.send(bytes(16 * KIB))
            unsent = fcntl.ioctl(sock, _SIOCOUTQNSD, bytes(4))
    assert int.from_bytes(unsent, sys.byteorder) <= 2 * EXPRESS_UNSENT_BYTES
    assert counters.as_dict() == {}


_LINUX_TCP: Final = {"rto_min_us": 45, "rto_max_ms": 44, "thin_linear_timeouts": 16}
"""Of linux/tcp.h; a kernel may lack them."""


def _tcp(sock: socket.socket, name: int) -> int | None:
    try:
        return sock.getsockopt(socket.IPPROTO_TCP, name)
    except OSError:
        return None


def test_lost_packets_are_repeated_sooner_on_the_express_lane_alone() -> None:
    counters = Counters()
    with socket.socket() as plain, socket.socket() as express, socket.socket() as bulk:
        dialler = Dialler(LaneSettings(), counters)
        for lane in (Lane.EXPRESS, Lane.BULK):  # an accepted connection says late which lane it is
            dialler.tune(bulk, lane)
        dialler.tune(express, Lane.EXPRESS)
        found = {name: [_tcp(sock, name) for sock in (plain, express, bulk)] for name in _LINUX_TCP.values()}
        bulk_control = bulk.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16).rstrip(b"\0")
        usual_control = plain.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16).rstrip(b"\0")
    for usual, quick, slow in found.values():
        if usual is not None and quick is not None:
            assert (quick != usual, slow) == (True, usual)
    if repeats_quickly():
        assert found[_LINUX_TCP["rto_min_us"]][1] in range(5000, 12_000)
    assert bulk_control == (b"bbr" if may_use_bbr() else usual_control)
    assert counters.as_dict() == {}, "an option that this kernel lacks is no fault"


def test_without_bbr_the_window_follows_the_rate() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as sock:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"reno")
        before = sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
        bound_queue(sock)
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) == before, "no rate is known"
        with server.accept()[0] as other:
            for _ in range(64):
                sock.sendall(bytes(16 * KIB))
                other.recv(16 * KIB, socket.MSG_WAITALL)
        bound_queue(sock)
        bound = sock.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)
        assert bound != before
        assert BULK_WINDOW_MIN <= bound <= BULK_WINDOW_MAX


async def test_what_waits_for_a_link_that_ends_is_counted() -> None:
    async with linked_pair(lanes=False) as (one, other):
        lane = one.link(other).express
        dropped = sum(lane.send(1, number, 0, bytes(MIB // 8)) for number in range(200))
        waiting = lane.outbox.waiting_entries
        assert (waiting > 50, dropped) == (True, 0)
        other.kill()
        await until(lambda: bool(one.downs), "it is down")
        assert waiting - 2 <= one.mesh.counters["link.discarded"] <= waiting, "but for what was on its way"


async def test_status_of_an_unreachable_peer_says_why() -> None:
    async with peers(1) as (one,):
        free = socket.socket()
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        ghost = Identity(Guid.of("127.0.0.1", port, 65535), b"g" * 16, "ghost")
        if ghost.guid < one.identity.guid:
            ghost = Identity(Guid.of("127.255.255.254", port), b"g" * 16, "ghost")
        one.mesh.peer_found(ghost)
        await until(lambda: one.mesh.counters["link.dial_failed"] >= 2, "two attempts")
        (status,) = one.mesh.peering.peers()
        assert status.state in ("waiting", "dialling")
        assert "refused" in status.last_error.lower()


async def test_no_file_descriptors_left_pauses_and_recovers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runtime_limits, "ACCEPT_PAUSE", 0.01)
    async with peers(2, found=False) as (one, other):
        before = DESCRIPTORS.counters["descriptors.refused.link"]
        with descriptors_left(1):  # for the socket that dials
            other.mesh.peer_found(one.identity)
            await until(lambda: DESCRIPTORS.counters["descriptors.refused.link"] >= before + 3, "pauses")
            assert not other.linked(one)
        await until(lambda: one.linked(other), "a link after the pause")


async def test_a_dial_without_file_descriptors_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    """It used to end the task without a word, and that peer was never dialled again."""
    async with peers(2, found=False) as (one, other):
        real = socket.socket
        full = [True, True]

        def none_left(*args: object, **options: object) -> socket.socket:
            if full:
                full.pop()
                raise OSError(errno.EMFILE, "Too many open files")
            return real(*args, **options)  # type: ignore[arg-type]

        monkeypatch.setattr("rmpa.runtime.accept.socket.socket", none_left)
        one.mesh.peer_found(other.identity)
        other.mesh.peer_found(one.identity)
        await until(lambda: one.linked(other) and other.linked(one), "linked after all")
        assert not full


async def test_silent_connections_from_one_address_are_bounded() -> None:
    async with peers(1) as (one,):
        writers = []
        for _ in range(limits.PENDING_PER_ADDRESS + 4):
            _, writer = await asyncio.open_connection("127.0.0.1", one.port)
            writers.append(writer)
        await until(lambda: one.mesh.counters["link.pending_full"] == 4, "four closed")
        assert len(one.mesh.connections()) == limits.PENDING_PER_ADDRESS
        for writer in writers:
            writer.close()


STRANGER = Identity(Guid.of("127.0.0.1", 9), b"s" * 16, "stranger")


def how(peer: Peer) -> tuple[bool, bool]:
    """Of the only link that went down: whether its agent crashed, and whether the peer may soon be back."""
    ((link, _),) = peer.downs
    return link.crashed, link.silent


async def test_a_killed_agent_is_a_crash() -> None:
    async with linked_pair() as (one, other):
        other.kill()
        await until(lambda: bool(one.downs), "it is seen")
        assert how(one)[0]
        await until(lambda: bool(other.downs), "its own side")
        assert how(other)[0] is False, "it gave up the link itself"


async def test_a_peer_that_breaks_the_protocol_has_not_crashed() -> None:
    async with peers(1) as (one,):
        sock, _ = await raw(one, STRANGER, lease=60.0)
        await until(lambda: bool(one.ups), "a link")
        await asyncio.get_running_loop().sock_sendall(sock, b"\xff" * 64)
        await until(lambda: bool(one.downs), "closed")
        assert how(one) == (False, False)


@pytest.mark.parametrize(("instance", "silent"), [(b"s", True), (b"t", False)])
async def test_a_link_that_another_one_replaces_leaves_direct_connections_alone(
    instance: bytes, monkeypatch: pytest.MonkeyPatch, *, silent: bool
) -> None:
    monkeypatch.setattr(limits, "GHOST_QUIET", 0.0)  # the first one counts as quiet at once
    async with peers(1) as (one,):
        await raw(one, STRANGER, lease=60.0)
        await until(lambda: bool(one.ups), "a link")
        _, answer = await raw(one, Identity(STRANGER.guid, instance * 16, "stranger"), lease=60.0)
        assert answer.kind is FrameKind.WELCOME
        await until(lambda: len(one.ups) == 2, "the same run of it by another path, or another run")
        assert how(one) == (True, silent)


MB = 1 << 20


@pytest.fixture
def no_collector() -> Iterator[None]:
    gc.disable()
    yield
    gc.enable()


def references(one: Peer, other: Peer) -> list[weakref.ref[PeerLink] | weakref.ref[Connection]]:
    """A peer's link to another one, and its two connections."""
    link = one.link(other)
    assert link.bulk_connection is not None
    return [weakref.ref(link), weakref.ref(link.connection), weakref.ref(link.bulk_connection)]


@pytest.mark.usefixtures("no_collector")
@pytest.mark.parametrize("way", ["close", "abort", "end"])
async def test_an_ended_link_is_gone_with_what_waited(way: str) -> None:
    async with linked_pair(lanes=False) as (one, other):
        one.link(other).bulk._on_wanted()
        await until(lambda: one.link(other).bulk_connection is not None, "a bulk lane")
        await until(lambda: other.link(one).bulk_connection is not None, "a bulk lane")
        links = [*references(one, other), *references(other, one)]
        for _ in range(20):
            one.link(other).bulk.send(1, 1, 0, bytes(MB))
        assert one.link(other).info().queued
        if way == "end":
            await other.mesh.close()
        else:
            getattr(one.link(other), way)("the test says so")
        for peer in (one, other):
            await until(lambda peer=peer: peer.downs, "the end")  # type: ignore[misc]
        for peer in (one, other):
            for seen in (peer.ups, peer.downs, peer.clocks, peer.lanes_lost):
                seen.clear()
        await until(lambda: not any(link() for link in links), "nobody holds the old links")
