"""The failure detector and the membership protocol together, without sockets."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import pytest

from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.events import Event, LossReason, PeerFound, PeerLost, SendUnicast
from rmpa.discovery.member_watch import MemberWatch
from rmpa.discovery.membership import MembershipProtocol
from rmpa.discovery.swim.failure_detector import FailureDetector
from rmpa.discovery.swim.packets import MemberState, News, SwimKind, SwimPacket

if TYPE_CHECKING:
    from rmpa.discovery.beacon import Address

OWN = Identity(Guid.of("10.0.0.1", 40000), bytes(range(16)), "own")
PEER = Identity(Guid.of("10.0.0.2", 40000), bytes(range(1, 17)), "peer")
OTHER = Identity(Guid.of("10.0.0.3", 40000), bytes(range(2, 18)), "other")


class Agent:
    def __init__(self) -> None:
        self.now = 100.0
        self.detector = FailureDetector(OWN, rng=random.Random(1).random)
        self.membership = MembershipProtocol(OWN, rng=random.Random(2).random, vouches=self.detector.vouches)
        self.watch = MemberWatch(self.detector, self.membership)
        self.events: list[Event] = []
        self.sent_to: set[Address] = set()
        self.membership.start(self.now)
        self.detector.set_active(self.now, active=True)

    def flush(self) -> None:
        while (found := self.watch.events(self.now)) or (events := self.membership.events()):
            for event in [] if found else events:
                self.watch.membership_changed(event, self.now)
                self.events.append(event)

    def beacon(self, identity: Identity, kind: BeaconKind = BeaconKind.HEARTBEAT, sequence: int = 1) -> None:
        beacon = Beacon(kind, identity, 16_000, sequence)
        self.membership.receive(beacon, identity.guid.endpoint, self.now, multicast=True)
        self.flush()

    def meet(self, identity: Identity) -> None:
        """A link that comes up and is ended again."""
        self.membership.link_up(identity, self.now)
        self.watch.link_up(identity, self.now, answers_probes=True)
        self.watch.link_down(identity.guid, identity.instance)
        self.membership.link_down(identity.guid, self.now, identity.instance)
        self.flush()

    def hears(self, sender: Identity, *news: News) -> None:
        packet = SwimPacket(SwimKind.NEWS, sender.guid, sender.instance, 0, 1, active=True, news=news)
        self.detector.receive(packet, sender.guid.endpoint, self.now)
        self.flush()

    def answer(self, *members: Identity) -> None:
        """These members answer the probes that were sent to them."""
        by_address = {member.guid.endpoint: member for member in members}
        for output in self.detector.outputs():
            self.sent_to.add(output.address)
            member, probe = by_address.get(output.address), output.packet
            if member is not None and probe.kind is SwimKind.PROBE:
                subject = (member.guid, member.instance[:8])
                ack = SwimPacket(
                    SwimKind.ACK, member.guid, member.instance, 0, probe.sequence, subject=subject, active=True
                )
                self.detector.receive(ack, output.address, self.now)

    def run(self, seconds: float, talker: Identity | None = None) -> None:
        """Let time pass; ``talker`` sends something each second, and it alone answers probes."""
        for _ in range(round(seconds)):
            self.now += 1.0
            if talker is not None:
                self.hears(talker)
            self.membership.handle_timer(self.now)
            while (at := self.detector.next_timer()) is not None and at <= self.now:
                self.detector.handle_timer(at)
                if talker is not None:
                    self.answer(talker)
            self.flush()

    def watched(self, identity: Identity) -> bool:
        return self.detector.member(identity.guid, identity.instance) is not None


def test_a_member_is_watched_once_its_link_has_said_that_it_answers() -> None:
    agent = Agent()
    agent.beacon(PEER)
    assert not agent.watched(PEER)
    agent.meet(PEER)
    assert agent.watched(PEER)
    agent.beacon(OTHER)
    agent.membership.link_up(OTHER, agent.now)
    agent.watch.link_up(OTHER, agent.now, answers_probes=False)
    assert not agent.watched(OTHER), "it is of an older version"


def test_a_member_of_an_earlier_release_gets_no_packet_and_is_lost_with_its_lease() -> None:
    agent = Agent()
    agent.meet(PEER)
    agent.beacon(OTHER)
    agent.membership.link_up(OTHER, agent.now)
    agent.watch.link_up(OTHER, agent.now, answers_probes=False)
    agent.run(30, talker=PEER)
    assert OTHER in [view.identity for view in agent.membership.peers()], "its link stands"
    agent.beacon(OTHER, sequence=2)
    agent.watch.link_down(OTHER.guid, OTHER.instance)
    agent.membership.link_down(OTHER.guid, agent.now, OTHER.instance)
    agent.run(10, talker=PEER)
    assert OTHER in [view.identity for view in agent.membership.peers()], "its beacons may come still"
    agent.run(10, talker=PEER)
    assert PeerLost(OTHER, LossReason.SILENCE) in agent.events
    assert agent.sent_to == {PEER.guid.endpoint}


def test_a_packet_of_a_member_shows_that_it_answers() -> None:
    agent = Agent()
    agent.beacon(PEER)
    agent.hears(PEER)
    assert agent.watched(PEER)


def test_a_failed_member_is_lost_with_its_own_reason_and_a_beacon_brings_it_back() -> None:
    agent = Agent()
    agent.meet(PEER)
    agent.meet(OTHER)
    agent.run(12, talker=OTHER)
    assert PeerLost(PEER, LossReason.FAILED) in agent.events
    assert [view.identity for view in agent.membership.peers()] == [OTHER]
    agent.beacon(PEER)
    assert isinstance(agent.events[-1], PeerFound)
    view = agent.detector.member(PEER.guid, PEER.instance)
    assert view is not None
    assert view.state is MemberState.SUSPECT, "it has to refute that it has failed"


def test_a_linked_member_is_not_lost() -> None:
    agent = Agent()
    agent.meet(OTHER)
    agent.membership.link_up(PEER, agent.now)
    agent.watch.link_up(PEER, agent.now, answers_probes=True)
    agent.run(20, talker=OTHER)
    assert PEER in [view.identity for view in agent.membership.peers()]
    assert not any(isinstance(event, PeerLost) and event.identity == PEER for event in agent.events)


def test_a_member_that_others_still_reach_keeps_its_lease() -> None:
    agent = Agent()
    agent.meet(PEER)
    agent.meet(OTHER)
    for _ in range(60):
        agent.run(1)
        agent.answer(PEER, OTHER)
    assert {view.identity for view in agent.membership.peers()} == {PEER, OTHER}
    agent.detector.set_active(agent.now, active=False)
    agent.run(120)
    assert agent.membership.peers() == ()
    assert PeerLost(PEER, LossReason.SILENCE) in agent.events


@pytest.mark.parametrize("how", ["beacon", "news"])
def test_a_goodbye_ends_the_watch(how: str) -> None:
    agent = Agent()
    agent.beacon(PEER)
    agent.meet(PEER)
    agent.meet(OTHER)
    if how == "beacon":
        agent.beacon(PEER, BeaconKind.GOODBYE, 2)
    else:
        agent.hears(OTHER, News(PEER.guid, PEER.instance[:8], MemberState.LEFT, 0, 0))
    assert agent.events[-1] == PeerLost(PEER, LossReason.GOODBYE)
    assert not agent.watched(PEER)


@pytest.mark.parametrize("how", ["beacon", "news"])
def test_a_member_that_did_not_say_goodbye_is_back_with_its_answer(how: str) -> None:
    agent = Agent()
    agent.beacon(PEER)
    agent.meet(PEER)
    agent.meet(OTHER)
    if how == "beacon":
        agent.beacon(PEER, BeaconKind.GOODBYE, 100)
    else:
        agent.hears(OTHER, News(PEER.guid, PEER.instance[:8], MemberState.LEFT, 0, 0))
    agent.membership.outputs()
    agent.detector.outputs()
    agent.now += limits.GOODBYE_CHECK
    agent.membership.handle_timer(agent.now)
    asked = [one for one in agent.membership.outputs() if isinstance(one, SendUnicast)]
    assert (PEER.guid.endpoint, BeaconKind.ANNOUNCE) in [(one.address, one.beacon.kind) for one in asked]
    agent.beacon(PEER, BeaconKind.ANSWER, 2)
    assert isinstance(agent.events[-1], PeerFound)
    assert agent.watched(PEER)
    probes = [one.address for one in agent.detector.outputs() if one.packet.kind is SwimKind.PROBE]
    assert probes == [PEER.guid.endpoint], "it hears that it is said to have left, and refutes that everywhere"


def test_news_of_an_unknown_member_leads_to_an_announcement() -> None:
    agent = Agent()
    agent.meet(OTHER)
    agent.membership.outputs()
    agent.hears(OTHER, News(PEER.guid, PEER.instance[:8], MemberState.ALIVE, 0, 3))
    addresses = [getattr(output, "address", None) for output in agent.membership.outputs()]
    assert PEER.guid.endpoint in addresses
    assert not agent.watched(PEER)
    agent.beacon(PEER)
    assert agent.watched(PEER)
