"""Parked peers: not dialled by themselves, and at once when something needs them."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Address

from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.mesh import limits
from rmpa.mesh.peering import Peering
from rmpa.mesh.peering_events import CloseLink, Dial, LinkDown, LinkDownCause, LinkUp, PeeringOutput
from tests.mesh.worlds import HIGH, LOW

AGAIN = Identity(Guid.of("10.0.0.2", 40002, 2), b"A" * 16, "high")


def dials(outputs: list[PeeringOutput]) -> list[tuple[str, int]]:
    return [output.endpoints[0] for output in outputs if isinstance(output, Dial)]


def parked(ours: Identity, peer: Identity) -> Peering:
    """A machine whose one peer was linked, and is parked since 20 s."""
    peering = Peering(ours, rng=lambda: 0.5, alive=lambda _: True)
    peering.peer_found(peer, 0.0)
    peering.link_up(1, peer, 1.0, dialled=ours.guid < peer.guid)
    peering.take()
    peering.link_down(1, "parked", 20.0, parked=True)
    (down,) = peering.take()
    assert isinstance(down, LinkDown)
    assert down.cause is LinkDownCause.PARKED
    return peering


def test_a_parked_peer_is_not_dialled_by_itself() -> None:
    for ours, peer in ((LOW, HIGH), (HIGH, LOW)):
        peering = parked(ours, peer)
        assert peering.next_timer() is None
        peering.peer_found(peer, 25.0, source="10.0.0.9")
        peering.handle_timer(10_000.0)
        assert peering.take() == []
        (status,) = peering.peers()
        assert (status.state, status.last_error, status.since) == ("parked", "", 20.0)


def test_both_sides_dial_a_parked_peer_at_once_when_something_needs_it() -> None:
    for ours, peer in ((LOW, HIGH), (HIGH, LOW)):
        peering = parked(ours, peer)
        peering.want(peer.guid, 30.0)
        assert dials(peering.take()) == [peer.guid.endpoint]
        peering.want(peer.guid, 30.1)
        assert peering.take() == [], "one dial is enough"
        peering.link_up(2, peer, 30.2, dialled=True)
        assert peering.take() == [LinkUp(2, peer)]
        assert peering.peers()[0].state == "linked"


def test_a_dial_of_both_sides_at_once_leaves_one_link() -> None:
    low, high = parked(LOW, HIGH), parked(HIGH, LOW)
    low.want(HIGH.guid, 30.0)
    high.want(LOW.guid, 30.0)
    for peering, peer, first in ((low, HIGH, True), (high, LOW, False)):
        peering.take()
        peering.link_up(2, peer, 30.1, dialled=not first)
        peering.link_up(3, peer, 30.1, dialled=first)
        outputs = peering.take()
        kept = [each.link_id for each in outputs if isinstance(each, LinkUp)]
        closed = [each.link_id for each in outputs if isinstance(each, CloseLink)]
        assert kept[-1] == 3, "the one that the lower GUID dialled"
        assert closed == [2]


def test_a_wanted_peer_that_does_not_answer_is_dialled_again() -> None:
    peering = parked(LOW, HIGH)
    peering.want(HIGH.guid, 30.0)
    peering.take()
    peering.dial_failed(HIGH.guid, "refused", 30.1)
    assert peering.peers()[0].state == "waiting"
    due = peering.next_timer()
    assert due is not None
    assert due - 30.1 <= 2 * limits.BACKOFF_FIRST
    peering.handle_timer(due)
    assert dials(peering.take())


def test_another_run_of_a_parked_peer_is_linked() -> None:
    peering = parked(LOW, HIGH)
    peering.peer_found(AGAIN, 30.0)
    assert dials(peering.take()) == [AGAIN.guid.endpoint]


def test_a_parked_peer_that_is_gone_is_forgotten_and_linked_when_it_is_back() -> None:
    peering = parked(LOW, HIGH)
    peering.peer_gone(HIGH.guid, 30.0)
    assert peering.peers() == []
    peering.want(HIGH.guid, 31.0)
    assert peering.take() == []
    peering.peer_found(HIGH, 40.0)
    assert dials(peering.take()) == [HIGH.guid.endpoint]


def test_a_peer_that_no_beacon_announces_is_not_parked() -> None:
    """Nothing would tell that it is gone."""
    peering = Peering(LOW, rng=lambda: 0.5, alive=lambda _: True)
    peering.link_up(1, HIGH, 1.0, dialled=False)
    peering.take()
    peering.link_down(1, "parked", 20.0, parked=True)
    (down,) = peering.take()
    assert isinstance(down, LinkDown)
    assert down.cause is LinkDownCause.ENDED
    due = peering.next_timer()
    assert due is not None
    peering.handle_timer(due)
    assert dials(peering.take()) == [HIGH.guid.endpoint]


def test_a_parked_peer_with_another_address_is_dialled_there() -> None:
    peering = parked(LOW, HIGH)
    peering.peer_found(replace(HIGH, addresses=(IPv4Address("192.168.0.2"),)), 25.0, source="172.16.0.2")
    peering.want(HIGH.guid, 30.0)
    (dial,) = peering.take()
    assert isinstance(dial, Dial)
    assert [host for host, _ in dial.endpoints] == ["172.16.0.2", "10.0.0.2", "192.168.0.2"]


def test_all_parked_peers_are_linked_again_when_the_mesh_is_small_again() -> None:
    low, high = parked(LOW, HIGH), parked(HIGH, LOW)
    for peering, latest in ((low, 35.0), (high, 35.0 + limits.DIAL_FALLBACK)):
        peering.unpark(30.0, 10.0)
        due = peering.next_timer()
        assert due is not None
        assert 30.0 < due <= latest
        peering.handle_timer(due)
        assert dials(peering.take())
