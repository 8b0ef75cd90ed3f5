"""Parked peers: not dialled by themselves, and at once when something needs them."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Address

from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.mesh import limits
from rmpa.mesh.handshake import Hello, Refusal, Refuse
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
        (status,) = peering.peers()
        assert (status.state, status.since) == ("dialling", 30.0)
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


class Crossing:
    """Both sides want each other's parked link at once; what is on its way is delivered in the order of a test.

    Link 1 is dialled by the lower GUID, link 2 by the higher one. What one side sends on one connection stays in
    order, as TCP keeps it.
    """

    def __init__(self) -> None:
        self.sides = {"low": parked(LOW, HIGH), "high": parked(HIGH, LOW)}
        self.who = {"low": LOW, "high": HIGH}
        self.wires: dict[tuple[int, str], list[Refuse | str]] = {(1, "low"): ["opened"], (2, "high"): ["opened"]}
        self.ups: dict[str, list[int]] = {"low": [], "high": []}
        for me, other in (("low", HIGH), ("high", LOW)):
            self.sides[me].want(other.guid, 30.0)
            assert dials(self.sides[me].take())

    def choices(self) -> list[tuple[int, str]]:
        return sorted(wire for wire, queue in self.wires.items() if queue)

    def deliver(self, wire: tuple[int, str]) -> None:
        """Deliver the next event of a connection at one side."""
        (link, me), what = wire, self.wires[wire].pop(0)
        peering, other = self.sides[me], "low" if me == "high" else "high"
        theirs = self.who[other]
        if isinstance(what, Refuse):
            assert what.code == Refusal.ALREADY_LINKED
            peering.dial_refused(theirs.guid, what, 30.0)
        elif what == "opened":
            if peering.dial_opened(theirs.guid, 30.0):
                self.send(link, other, "hello")
        elif what == "hello":
            refuse = peering.judge(Hello.of(theirs, lease=1.0, expected=self.who[me].guid), 30.0)
            self.send(link, other, refuse or "welcome")
            if refuse is None:
                peering.link_up(link, theirs, 30.0, dialled=False)
        else:
            peering.link_up(link, theirs, 30.0, dialled=True, endpoint=theirs.guid.endpoint)
        for output in peering.take():
            assert isinstance(output, LinkUp), "no link is replaced"
            self.ups[me].append(output.link_id)

    def send(self, link: int, to: str, what: Refuse | str) -> None:
        self.wires.setdefault((link, to), []).append(what)


def test_dials_that_cross_make_one_link_that_is_never_replaced_in_any_order() -> None:
    """What is sent over the first link, such as a service call, would be lost with it."""
    todo: list[list[tuple[int, str]]] = [[]]
    ends = set()
    while todo:
        path = todo.pop()
        world = Crossing()
        for wire in path:
            world.deliver(wire)
        choices = world.choices()
        todo.extend([*path, choice] for choice in choices)
        if not choices:
            assert world.ups["low"] == world.ups["high"], path
            ends.add(tuple(world.ups["low"]))
            assert all(peering.next_timer() is None for peering in world.sides.values()), "nothing is dialled again"
    assert ends == {(1,), (2,)}, "whichever side was first"


def test_a_hello_without_an_answer_does_not_keep_the_peers_dial_away() -> None:
    hello = Hello.of(HIGH, lease=1.0, expected=LOW.guid)
    low = parked(LOW, HIGH)
    low.want(HIGH.guid, 30.0)
    assert low.dial_opened(HIGH.guid, 30.0)
    assert low.judge(hello, 30.0) is not None
    assert low.judge(replace_instance(hello), 30.0) is None, "another run of the peer"
    assert low.judge(hello, 30.0 + limits.CROSSING_TIME) is None
    low.dial_failed(HIGH.guid, "no answer", 30.1)
    assert low.judge(hello, 30.2) is None


def test_the_dial_of_a_peer_that_was_never_linked_is_accepted_beside_ones_own() -> None:
    low = Peering(LOW, rng=lambda: 0.5, alive=lambda _: True)
    low.peer_found(HIGH, 0.0)
    assert low.dial_opened(HIGH.guid, 0.1)
    assert low.judge(Hello.of(HIGH, lease=1.0, expected=LOW.guid), 0.1) is None


def replace_instance(hello: Hello) -> Hello:
    return replace(hello, instance=AGAIN.instance)


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
