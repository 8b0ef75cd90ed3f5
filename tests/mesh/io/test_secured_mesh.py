"""Meshes with TLS on both lanes, over real sockets: links, and refusals with their reasons at both ends."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from dataclasses import replace
from functools import partial

import pytest

from rmpa.mesh.peering import Peer as KnownPeer

pytest.importorskip("cryptography")

from rmpa.core.identity import Guid, Identity
from rmpa.core.limits import MIB
from rmpa.mesh import limits
from rmpa.mesh.frames import Frame, FrameKind, Lane, Refusal, Refuse
from rmpa.mesh.io.link import PeerLink
from rmpa.runtime.tls import TlsHandshake
from rmpa.trust.permissions import TrustReason
from rmpa.trust.store import ALPN_LINK, join_context
from tests.mesh.io.members import Member, meshes
from tests.mesh.io.meshes import DEADLINE, Peer, introduce, until
from tests.trust.authority import Authority

DAY = 86_400.0


@pytest.fixture(scope="module")
def lab() -> Authority:
    return Authority()


def _has_all(peer: Peer) -> bool:
    return len(peer.data) == 2 and bool(peer.controls)


def status(at: Peer, of: Peer) -> KnownPeer[PeerLink]:
    return next(s for s in at.mesh.peering.peers() if s.identity.guid == of.identity.guid)


async def test_members_link_by_both_lanes_and_messages_cross(lab: Authority) -> None:
    async with meshes(Member(lab, "arm"), Member(lab, "base")) as (arm, base):
        await until(lambda: arm.both_lanes(base) and base.both_lanes(arm), "both lanes")
        large = bytes(range(256)) * (16 * MIB // 256)
        for one, other in ((arm, base), (base, arm)):
            one.link(other).express.send(1, 7, 0, b"small")
            one.link(other).bulk.send(2, 8, 0, large)
            one.link(other).send_control(b'{"op":"x"}')
        for peer in (arm, base):
            await until(partial(_has_all, peer), "all messages")
            assert peer.messages(1) == [(7, b"small")]
            assert peer.messages(2)[0][1] == large
        assert arm.mesh.counters.as_dict() == base.mesh.counters.as_dict() == {}


def _bad(lab: Authority, what: str) -> Member:
    """A module that is no member, for one reason."""
    if what == "foreign":
        return Member(Authority(), "arm")
    return Member(lab, "arm", issued={"expired": 8 * DAY, "clock": -DAY}.get(what, 0.0))


@pytest.mark.parametrize("other", ["foreign", "expired", "clock", "name", "revoked"])
@pytest.mark.parametrize("dials", [True, False])
async def test_refusals_have_their_reason_at_both_ends(lab: Authority, other: str, dials: bool) -> None:
    good = Member(lab, "base")
    bad, name = _bad(lab, other), "crane" if other == "name" else "arm"
    if other == "revoked":
        good.revoke("arm")
    securities, names = ((bad, good), (name, "base")) if dials else ((good, bad), ("base", name))
    async with meshes(*securities, names=names) as (low, high):
        await until(
            lambda: status(low, high).state == "refused" and other in status(low, high).last_error,
            "the dialler shows it",
        )
        await until(lambda: high.mesh.counters[f"link.refused.{other}"] > 0, "the acceptor counts it")
        assert low.mesh.counters[f"link.refused.{other}"] > 0
        assert not low.ups or not low.linked(high)
        await until(lambda: other in status(high, low).last_error, "the acceptor shows it")


@pytest.mark.parametrize("bad", ["foreign", "expired"])
async def test_a_dialler_learns_why_its_certificate_is_refused(lab: Authority, bad: str) -> None:
    """What comes when the dialler's own handshake is done; nobody dials the other way."""
    mine = _bad(lab, bad)
    judge = Member(lab, "base")
    mine.client_context.verify_mode = ssl.CERT_NONE  # so that only the acceptor finds something wrong
    async with meshes(mine, judge, found=False) as (low, high):
        low.mesh.peer_found(high.identity)
        for _ in range(3):
            await until(lambda: bool(low.mesh.peering.peers()[0].last_error), "refused")
            assert status(low, high).last_error.startswith(f"{bad}:")
            assert status(low, high).state == "refused"
            low.mesh.peer_gone(high.identity.guid)
            await until(lambda: not low.mesh.peering.peers(), "forgotten")
            low.mesh.peer_found(high.identity)


async def test_a_module_without_a_certificate_is_refused(lab: Authority) -> None:
    async with meshes(Member(lab, "base")) as (base,):
        context = join_context()
        context.set_alpn_protocols([ALPN_LINK])
        reader, writer = await asyncio.open_connection("127.0.0.1", base.port, ssl=context)
        frame = Frame.parse(await asyncio.wait_for(reader.read(), DEADLINE))
        assert frame is not None
        refuse = Refuse.parse(frame[0].payload)
        assert (refuse.code, "it has no certificate" in refuse.text) == (TrustReason.FOREIGN, True)
        assert base.mesh.counters["link.refused.foreign"] == 1
        assert not base.mesh.connections()
        writer.close()


@pytest.mark.parametrize("answer", [Refusal.DUPLICATE, TrustReason.REVOKED, TrustReason.UNSECURED, None])
async def test_a_refusal_without_proof_is_shown_and_sets_no_pause(
    lab: Authority, monkeypatch: pytest.MonkeyPatch, answer: int | None
) -> None:
    """Anything may answer instead of TLS, by a refusal in plain or by other bytes, and is dialled again as before."""
    monkeypatch.setattr("rmpa.mesh.peering.REFUSED_RETRY", 1000.0)
    refuse = Frame(FrameKind.REFUSE, Refuse(answer or 0, "go away").serialize()).serialize()
    dials = 0

    async def refused(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal dials
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            assert await reader.readexactly(1) == b"\x16"
            dials += 1
            writer.write(b"HTTP/1.1 400 Bad Request" if answer is None else refuse)
            await writer.drain()
        writer.close()

    server = await asyncio.start_server(refused, "127.0.0.1", 0)
    async with server, meshes(Member(lab, "arm"), found=False) as (arm,):
        guid = Guid.of("127.0.0.1", server.sockets[0].getsockname()[1], 0)
        arm.mesh.peer_found(Identity(guid, b"i" * 16, "base"))
        await until(lambda: dials >= 3, "dialled again")
        await until(lambda: arm.mesh.peering.peers()[0].state == "refused", "shown")
        shown = "unsecured" if answer == TrustReason.UNSECURED else "downgrade"
        assert arm.mesh.peering.peers()[0].last_error.startswith(shown)
        assert (answer is None) != ("go away" in arm.mesh.peering.peers()[0].last_error)


async def test_another_modules_run_cannot_be_taken_over(lab: Authority) -> None:
    """A member that claims the instance of another one, under its own name."""
    async with meshes(Member(lab, "arm"), Member(lab, "base")) as (arm, base):
        await until(lambda: arm.both_lanes(base) and base.both_lanes(arm), "both lanes")
        thief = Peer(arm.number, name="thief", security=Member(lab, "thief"))
        try:
            assert thief.identity.instance == arm.identity.instance
            await thief.mesh.start()
            thief.mesh.peer_found(base.identity)
            await until(lambda: base.mesh.counters["link.refused.name"] > 0, "refused")
            assert base.linked(arm)
            assert not thief.ups or not thief.linked(base)
        finally:
            await thief.mesh.close()


@pytest.mark.parametrize("lane", [Lane.EXPRESS, Lane.BULK])
async def test_nor_while_its_link_is_silent(lab: Authority, monkeypatch: pytest.MonkeyPatch, lane: Lane) -> None:
    """A member that claims instance and address of another one, under its own name."""
    async with meshes(Member(lab, "arm"), Member(lab, "base")) as (arm, base):
        await until(lambda: arm.both_lanes(base) and base.both_lanes(arm), "both lanes")
        monkeypatch.setattr(PeerLink, "alive", False)
        thief = Peer(arm.number, name="thief", security=Member(lab, "thief"))
        try:
            await thief.mesh.start()
            await _claim(thief, arm, base, lane)
            await until(lambda: base.mesh.counters["link.refused.name"] > 0, "refused")
            assert base.both_lanes(arm)
            assert not base.downs
        finally:
            await thief.mesh.close()


async def test_a_bulk_lane_joins_the_link_of_its_own_module_only(
    lab: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also if its link came up after its hello was judged."""
    async with meshes(Member(lab, "arm"), Member(lab, "base")) as (arm, base):
        await until(lambda: arm.both_lanes(base) and base.both_lanes(arm), "both lanes")
        lane = base.link(arm).bulk_connection
        monkeypatch.setattr(base.mesh._securing, "prove", lambda *_: None)
        thief = Peer(arm.number, name="thief", security=Member(lab, "thief"))
        try:
            await thief.mesh.start()
            await _claim(thief, arm, base, Lane.BULK)
            await until(lambda: not thief.mesh.connections(), "closed")
            assert base.link(arm).bulk_connection is lane
        finally:
            await thief.mesh.close()


async def _claim(thief: Peer, victim: Peer, at: Peer, lane: Lane) -> None:
    """Dial with one's own name and certificate, and the run and address of another module."""
    thief.mesh.identity = replace(victim.identity, name="thief")
    sock = await _dial(at)
    secured = await thief.mesh._secure(sock)
    thief.mesh._open(sock, ("127.0.0.1", at.port), expected=at.identity.guid, lane=lane, secured=secured)


async def test_a_test_of_reachability_is_no_failure(lab: Authority) -> None:
    async with meshes(Member(lab, "base")) as (base,):
        for _ in range(50):
            (await _dial(base)).close()
        sock = await _dial(base)
        sock.send(b"\x16\x03")
        sock.close()
        await until(lambda: not unproven(base), "all are over")
        assert base.mesh.counters["link.refused.plain"] == 0


def unproven(peer: Peer) -> int:
    """Connections without a finished handshake."""
    assert peer.mesh._securing is not None
    return len(peer.mesh._securing._unproven)


async def _dial(peer: Peer, source: str = "127.0.0.1") -> socket.socket:
    sock = socket.socket()
    sock.bind((source, 0))
    sock.setblocking(False)
    await asyncio.get_running_loop().sock_connect(sock, ("127.0.0.1", peer.port))
    return sock


async def test_a_handshake_one_byte_at_a_time_is_done(lab: Authority) -> None:
    member = Member(lab, "arm")
    async with meshes(Member(lab, "base")) as (base,):
        loop, sock = asyncio.get_running_loop(), await _dial(base)
        handshake = TlsHandshake(member.client_context, server_side=False)
        handshake.receive(b"")
        async with asyncio.timeout(DEADLINE):
            while not handshake.done:
                for byte in handshake.take_output():
                    sock.send(bytes([byte]))
                    await asyncio.sleep(0)
                handshake.receive(await loop.sock_recv(sock, 65536))
        await loop.sock_sendall(sock, handshake.take_output())
        await until(lambda: len(base.mesh.connections()) == 1, "it is a connection of the mesh")
        sock.close()


async def test_accepting_pauses_for_a_flood(lab: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.mesh.io.securing.UNPROVEN_BURST", 20)
    monkeypatch.setattr(limits, "UNPROVEN_RATE", 0.1)
    async with meshes(Member(lab, "arm"), Member(lab, "base"), found=False) as (arm, base):
        for _ in range(22):
            (await _dial(base)).close()
        await until(lambda: base.mesh.counters["link.paused"] > 0, "paused")
        introduce([arm, base])
        await until(lambda: base.linked(arm), "and goes on")


@pytest.mark.parametrize("rest", [b"", b"\x16\x03\x01\x02\x00\x01", b"\x16garbage" * 20])
async def test_a_handshake_that_stands_still_or_is_none_is_given_up(
    lab: Authority, monkeypatch: pytest.MonkeyPatch, rest: bytes
) -> None:
    monkeypatch.setattr("rmpa.mesh.io.securing.SECURING_TIMEOUT", 0.3)
    async with meshes(Member(lab, "base")) as (base,):
        sock = await _dial(base)
        sock.send(rest)
        counters = base.mesh.counters
        await until(lambda: counters["link.unfinished"] + counters["link.refused.downgrade"] == 1, "given up")
        assert counters["link.refused.downgrade"] == (b"garbage" in rest)
        assert not base.mesh.connections()
        sock.close()


async def test_a_handshake_that_has_not_begun_leaves_no_socket_when_the_mesh_ends(lab: Authority) -> None:
    ours, theirs = socket.socketpair()
    async with meshes(Member(lab, "arm")) as (arm,):
        with ours, theirs:
            ours.setblocking(False)
            securing = arm.mesh._securing
            assert securing is not None
            securing.accept(ours, ("127.0.0.1", 1))
            (task,) = securing._unproven
            await arm.mesh.close()
            assert task.cancelled()
            assert ours.fileno() == -1


async def test_one_certificate_has_a_bounded_number_of_connections(
    lab: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its two lanes, a run that begins before the other ends, and no hundreds of agents with one certificate."""
    monkeypatch.setattr(limits, "CONNECTIONS_PER_NAME", 4)
    names = ("arm", "arm", "arm", "base", "crane")
    async with meshes(*(Member(lab, name) for name in names), names=names, found=False) as peers:
        *arms, base, crane = peers
        for arm in arms[:2]:
            introduce([arm, base])
            await until(lambda arm=arm: arm.both_lanes(base) and base.both_lanes(arm), "both lanes of both runs")  # type: ignore[misc]
        introduce([arms[2], base])
        await until(lambda: "arm has 4 connections here" in status(arms[2], base).last_error, "the refusal is told")
        assert "rmpa trust revoke arm" in status(arms[2], base).last_error
        await until(lambda: base.mesh.counters["link.refused.busy"] > 0, "the acceptor counts it")
        introduce([crane, base])
        await until(lambda: crane.both_lanes(base), "another module links")
        await arms[0].mesh.close()
        await until(lambda: arms[2].both_lanes(base), "there is room again")


@pytest.mark.parametrize("dialler", [True, False])
async def test_a_revoked_module_is_gone_at_once_at_both_ends(lab: Authority, dialler: bool) -> None:
    members = Member(lab, "arm"), Member(lab, "base")
    async with meshes(*members) as (arm, base):
        await until(lambda: arm.both_lanes(base) and base.both_lanes(arm), "both lanes")
        judge, other = (arm, base) if dialler else (base, arm)
        members[not dialler].revoke(other.mesh.identity.name)
        assert not judge.linked(other), "without waiting for the other side"
        assert judge.downs[0][1].startswith("revoked:")
        await until(lambda: bool(other.downs), "the other side sees it")
        assert "revoked" in other.downs[0][1]
        await until(lambda: status(other, judge).last_error.startswith("revoked"), "it is shown there")
        await until(lambda: not judge.mesh.connections(), "both lanes ended")


async def test_a_plain_module_learns_that_the_mesh_is_secured(lab: Authority) -> None:
    async with meshes(None, Member(lab, "base")) as (plain, secured):
        await until(lambda: status(plain, secured).state == "refused", "refused")
        assert "plain" in status(plain, secured).last_error
        assert "rmpa trust join" in status(plain, secured).last_error
        assert secured.mesh.counters["link.refused.plain"] > 0
        assert not plain.ups


async def test_a_member_never_falls_back_to_plain(lab: Authority) -> None:
    async with meshes(Member(lab, "arm"), None) as (secured, plain):
        await until(lambda: status(secured, plain).state == "refused", "refused")
        assert "unsecured" in status(secured, plain).last_error
        assert plain.mesh.counters["link.refused.unsecured"] > 0
        assert not secured.ups
        assert not plain.ups


async def test_silent_connections_leave_room_for_members(lab: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
    """The oldest ones of the busiest address are closed, so that a member need not wait until they are given up."""
    monkeypatch.setattr("rmpa.mesh.io.securing.SECURING_TIMEOUT", 1000.0)
    monkeypatch.setattr(limits, "PENDING_CONNECTIONS_MAX", limits.PENDING_PER_ADDRESS + 2)
    members = Member(lab, "arm"), Member(lab, "base")
    async with meshes(*members, found=False) as (arm, base):
        silent = [await _dial(base) for _ in range(limits.PENDING_PER_ADDRESS + 4)]
        await until(lambda: base.mesh.counters["link.pending_full"] == 4, "four closed")
        assert unproven(base) == limits.PENDING_PER_ADDRESS
        silent += [await _dial(base, "127.0.0.2") for _ in range(6)]
        await until(lambda: base.mesh.counters["link.pending_full"] == 8, "the place is shared")
        for sock in silent[:8]:
            assert await asyncio.wait_for(asyncio.get_running_loop().sock_recv(sock, 1), DEADLINE) == b""
        introduce([arm, base])
        await until(lambda: base.both_lanes(arm), "linked at once")
        assert base.mesh.counters["link.unfinished"] == 0
        for sock in silent:
            sock.close()
