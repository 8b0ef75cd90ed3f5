"""Links that are parked and made again, over real sockets on loopback."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from rmpa.mesh import limits
from tests.mesh.io.meshes import Peer, linked_pair, until

if TYPE_CHECKING:
    from rmpa.mesh.io.link import PeerLink


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Links park within a moment."""
    monkeypatch.setattr(limits, "PARK_AFTER", 0.05)
    monkeypatch.setattr(limits, "IDLE_KEEPALIVE_INTERVAL", 0.05)


def link_of(peer: Peer) -> PeerLink:
    (link,) = peer.mesh.links()
    return link


def joined(one: Peer, other: Peer) -> bool:
    """Whether both use the same connection: for a moment each may use the one that it dialled."""
    if not one.mesh.links() or not other.mesh.links():
        return False
    return bool(link_of(one).connection.sock.getsockname() == link_of(other).connection.sock.getpeername())


async def park(*peers: Peer) -> None:
    downs = [len(peer.downs) for peer in peers]
    for peer in peers:
        link_of(peer).need(needed=False, parks=True)
    await until(lambda: all(len(peer.downs) > n for peer, n in zip(peers, downs, strict=True)), "both are parked")


async def test_both_sides_park_and_one_that_wants_the_other_links_again() -> None:
    async with linked_pair() as (one, other):
        await park(one, other)
        assert [peer.mesh.peers()[0].state for peer in (one, other)] == ["parked", "parked"]
        assert all(peer.downs[-1][0].parked and peer.downs[-1][0].silent for peer in (one, other))
        assert [peer.mesh.counters["link.parked"] for peer in (one, other)] == [1, 1]
        assert not one.mesh.counters["link.down"]
        await until(lambda: not one.mesh.connections() and not other.mesh.connections(), "no socket is left")
        for wanting, wanted in ((one, other), (other, one)):
            wanting.mesh.want(wanted.identity.guid)
            await until(lambda: bool(one.mesh.links() and other.mesh.links()), "linked again")
            link_of(wanting).send_control(b"{}")
            await until(lambda wanted=wanted: b"{}" in wanted.controls, "a frame crosses")  # type: ignore[misc]
            wanted.controls.clear()
            await park(one, other)


async def test_both_sides_that_want_each_other_at_once_get_one_link() -> None:
    async with linked_pair() as (one, other):
        for _ in range(5):
            await park(one, other)
            one.mesh.want(other.identity.guid)
            other.mesh.want(one.identity.guid)
            await until(lambda: joined(one, other), "one link, the same at both sides")
            link_of(one).send_control(b"a")
            link_of(other).send_control(b"b")
            await until(lambda: b"a" in other.controls and b"b" in one.controls, "frames cross both ways")
            one.controls.clear()
            other.controls.clear()


async def test_frames_are_neither_lost_nor_doubled_while_the_link_comes_and_goes() -> None:
    """Each side sends at moments that hit every phase; what was held back is in the link that went down."""
    async with linked_pair() as (one, other):
        sent: dict[Peer, list[bytes]] = {one: [], other: []}
        for number in range(60):
            sender, taker = (one, other) if number % 2 else (other, one)
            for peer in (one, other):
                if peer.mesh.links():
                    link_of(peer).need(needed=False, parks=True)
            await asyncio.sleep(0.004 * (number % 30))
            payload = b'{"n":%d}' % number
            sent[sender].append(payload)
            if not sender.mesh.links():
                sender.mesh.want(taker.identity.guid)
                await until(lambda sender=sender: bool(sender.mesh.links()), "linked")  # type: ignore[misc]
            link = link_of(sender)
            link.send_control(payload)
            await until(
                lambda taker=taker, payload=payload, link=link: payload in taker.controls or payload in link.held,  # type: ignore[misc]
                "the frame came, or was held back",
            )
            if payload in link.held:
                await until(
                    lambda link=link, taker=taker, payload=payload: not link.used or payload in taker.controls,  # type: ignore[misc]
                    "the other side decided",
                )
                if payload not in taker.controls:
                    assert link.parked
                    taker.controls.append(payload)  # the room above sends it over the next link
        for sender, taker in ((one, other), (other, one)):
            assert sorted(taker.controls) == sorted(sent[sender])


async def test_a_parked_peer_that_restarted_is_linked_in_its_new_run() -> None:
    async with linked_pair() as (one, other):
        await park(one, other)
        port = other.port
        await other.mesh.close()
        again = Peer(other.number, 1, port)
        try:
            await again.mesh.start()
            one.mesh.peer_found(again.identity)
            again.mesh.peer_found(one.identity)
            await until(lambda: bool(one.mesh.links()), "linked with the new run")
            assert link_of(one).identity.is_same_run(again.identity)
        finally:
            await again.mesh.close()
