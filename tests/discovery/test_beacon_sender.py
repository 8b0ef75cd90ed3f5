"""The beacons of one agent: numbered in order, with gossip that fits their receiver, and none behind a goodbye."""

from __future__ import annotations

from rmpa.core.counters import Counters
from rmpa.core.identity import Guid, Identity
from rmpa.discovery import limits
from rmpa.discovery.announcing import BeaconSender
from rmpa.discovery.beacon import BeaconKind
from rmpa.discovery.endpoints import Endpoint, EndpointTable, PeerInstance

OWN = Identity(Guid.of("10.0.0.1", 40_001, 7), bytes(16), "own")


class Bench:
    """A sender, and the peers that it knows."""

    def __init__(self, *, multicast: bool = True) -> None:
        self.endpoints = EndpointTable()
        self.counters = Counters()
        self.sender = BeaconSender(OWN, self.endpoints, 3.0, self.counters, multicast=multicast)

    def peer(self, number: int, address: str = "10.0.0.2") -> PeerInstance:
        """A peer that was heard by multicast at 0."""
        guid = Guid.of(address, 40_000 + number, 7)
        peer = PeerInstance(Identity(guid, bytes([number]) * 16, f"p{number}"), 0.0, 0.0, "multicast", 3.0)
        peer.multicast_at = 0.0
        self.endpoints[guid.place] = Endpoint({peer.identity.instance: peer}, peer, member=peer.identity)
        self.endpoints.index(guid.place)
        return peer


def test_beacons_of_all_kinds_are_numbered_in_order() -> None:
    bench = Bench()
    bench.sender.send_multicast(BeaconKind.ANNOUNCE, 0.0)
    bench.sender.send(BeaconKind.HEARTBEAT, ("10.0.0.2", 1))
    bench.sender.send_answer(bench.peer(2), 0.0)
    assert [sent.beacon.sequence for sent in bench.sender.take()] == [1, 2, 3]
    assert bench.sender.take() == []


def test_nothing_is_sent_behind_a_goodbye() -> None:
    bench = Bench()
    bench.sender.send_goodbye([bench.peer(2)])
    sent = bench.sender.take()
    assert [one.address for one in sent] == [None, ("10.0.0.2", 40_002)]
    assert {one.beacon.kind for one in sent} == {BeaconKind.GOODBYE}
    bench.sender.send(BeaconKind.ANNOUNCE, ("10.0.0.2", 1))
    assert bench.sender.take() == []


def test_an_address_gets_one_answer_in_a_while_and_the_others_are_counted() -> None:
    bench = Bench()
    peer = bench.peer(2)
    for now in (0.0, limits.ANSWER_INTERVAL / 2, limits.ANSWER_INTERVAL):
        bench.sender.send_answer(peer, now)
    assert len(bench.sender.take()) == 2
    assert bench.counters["beacon.answer_limited"] == 1


def test_loopback_peers_are_not_told_to_other_hosts() -> None:
    bench = Bench()
    far, near = bench.peer(2), bench.peer(3, "127.0.0.1")
    assert bench.sender.gossip([far, near], None, 0.0) == (far.identity.guid,)
    assert bench.sender.gossip([far, near], near, 0.0) == (far.identity.guid,)
    assert bench.sender.gossip([near], far, 0.0) == ()


def test_peers_whose_multicasts_are_not_heard_get_unicasts() -> None:
    heard = Bench()
    peer = heard.peer(2)
    assert heard.sender.unheard_by_multicast(limits.MULTICAST_SILENCE) == []
    assert heard.sender.unheard_by_multicast(limits.MULTICAST_SILENCE + 0.1) == [peer]
    without = Bench(multicast=False)
    other = without.peer(2)
    assert without.sender.unheard_by_multicast(0.0) == [other]
