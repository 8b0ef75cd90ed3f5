"""The membership protocol, alone and in pairs, under a clock that is an argument."""

from __future__ import annotations

import random
from copy import deepcopy
from dataclasses import replace
from ipaddress import IPv4Address
from typing import TYPE_CHECKING

import pytest

from rmpa.core import limits as core_limits
from rmpa.core.identity import Guid, Identity
from rmpa.discovery import limits, membership
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.endpoints import (
    CANDIDATE_LIFETIME,
    CANDIDATE_RETRY_MAX,
    CANDIDATES_BURST,
    CANDIDATES_PER_SECOND,
    GOODBYE_LATE,
    LEASE_MAX,
    LEASE_MIN,
)
from rmpa.discovery.membership import BURST_AGAIN_OFFSETS, BURST_JITTER, BURST_OFFSETS, MembershipProtocol, PeerEvent

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.discovery.endpoints import OutgoingBeacon

T0 = 1000.0


def who(number: int, run: int = 1, name: str = "") -> Identity:
    """Peer ``number`` at 10.0.0.number, in its ``run``-th run."""
    return Identity(
        Guid.of(f"10.0.0.{number}", 40000 + number, run), bytes([number, run] * 8), name or f"peer{number}"
    )


class Speaker:
    """Makes one run's beacons, numbered."""

    def __init__(self, identity: Identity, start: int = 0) -> None:
        self.identity = identity
        self.sequence = start

    def __call__(self, kind: BeaconKind = BeaconKind.HEARTBEAT, *gossip: Guid, lease: float = 16.0) -> Beacon:
        self.sequence += 1
        return Beacon(kind, self.identity, round(lease * 1000), self.sequence, gossip)


class Harness:
    """A started membership protocol, that of peer 1 where no other is named, with a clock in hand."""

    def __init__(
        self, own: Identity | None = None, *, multicast: bool = True, rng: Callable[[], float] = lambda: 0.0
    ) -> None:
        self.now = T0
        self.membership = MembershipProtocol(own or who(1), rng=rng, multicast=multicast)
        self.membership.start(T0)

    def hear(self, beacon: Beacon, *, multicast: bool = True, source: tuple[str, int] | None = None) -> None:
        self.membership.receive(beacon, source or beacon.identity.guid.endpoint, self.now, multicast=multicast)

    def run(self, seconds: float) -> list[OutgoingBeacon]:
        """Let time pass; return what was sent meanwhile."""
        sent = self.membership.outputs()
        end = self.now + seconds
        while (timer := self.membership.next_timer()) is not None and timer <= end:
            self.now = max(self.now, timer)
            self.membership.handle_timer(self.now)
            sent += self.membership.outputs()
        self.now = end
        return sent

    def present(self) -> list[str]:
        return [view.run.identity.name for view in self.membership.endpoints.views() if view.present]


@pytest.fixture
def one() -> Harness:
    harness = Harness()
    harness.run(1.0)
    return harness


@pytest.fixture
def small_roster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "STRANGERS_MAX", 64)
    monkeypatch.setattr(core_limits, "PEERS_MAX", 256)


def restarted(before: Identity, now: Identity) -> list[PeerEvent]:
    return [
        PeerEvent("lost", before, reason=membership.RESTARTED),
        PeerEvent("found", now, now.guid.endpoint),
    ]


def unicasts(outputs: list[OutgoingBeacon], kind: BeaconKind) -> list[tuple[str, int]]:
    return [o.address for o in outputs if o.address and o.beacon.kind is kind]


def test_burst_is_followed_by_heartbeats_only() -> None:
    harness = Harness()
    kinds = [(o.beacon.kind, o.beacon.sequence) for o in harness.run(4.9) if o.address is None]
    assert kinds == [(BeaconKind.ANNOUNCE, n) for n in range(1, len(BURST_OFFSETS) + 1)]
    later = harness.run(10.0)
    assert [o.beacon.kind for o in later] == [BeaconKind.HEARTBEAT] * 2


def test_jitter_stays_in_its_bounds() -> None:
    membership = MembershipProtocol(who(1), rng=lambda: 0.999, multicast=True)
    membership.start(T0)
    assert membership.next_timer() == pytest.approx(T0 + 0.1 + BURST_JITTER, abs=0.001)
    membership.handle_timer(T0 + 1)
    assert membership.next_timer() == pytest.approx(T0 + 4.5, abs=0.01)


def test_an_unknown_peer_is_found_and_answered_by_unicast(one: Harness) -> None:
    speaker = Speaker(who(2))
    one.hear(speaker())
    assert one.membership.events() == [PeerEvent("found", who(2), ("10.0.0.2", 40002))]
    assert unicasts(one.membership.outputs(), BeaconKind.ANSWER) == [("10.0.0.2", 40002)]
    one.now += 1
    one.hear(speaker())
    assert one.membership.events() == []
    assert one.membership.outputs() == []


def test_the_answer_also_goes_where_the_packet_came_from(one: Harness) -> None:
    one.hear(Speaker(who(2))(), source=("192.0.2.9", 5555))
    assert unicasts(one.membership.outputs(), BeaconKind.ANSWER) == [("10.0.0.2", 40002), ("192.0.2.9", 5555)]


def test_each_announce_is_answered_but_not_faster_than_the_limit(one: Harness) -> None:
    speaker = Speaker(who(2))
    answered = 0
    for _ in range(10):
        one.hear(speaker(BeaconKind.ANNOUNCE))
        answered += len(unicasts(one.membership.outputs(), BeaconKind.ANSWER))
        one.now += limits.ANSWER_INTERVAL / 2
    assert answered == 5
    assert one.membership.counters["beacon.answer_limited"] == 5


def test_an_answer_is_not_answered(one: Harness) -> None:
    one.hear(Speaker(who(2))(BeaconKind.ANSWER), multicast=False)
    assert one.membership.events()
    assert one.membership.outputs() == []


def test_forged_beacons_do_not_make_an_amplifier(one: Harness) -> None:
    for i in range(400):
        host = Guid.of(IPv4Address(0x0A010000 + i), 4000)
        beacon = Speaker(replace(who(2), guid=host, instance=i.to_bytes(16, "big")))()
        one.hear(beacon, source=("192.0.2.7", i + 1))
    assert len(unicasts(one.membership.outputs(), BeaconKind.ANSWER)) <= limits.ANSWERS_PER_SECOND


def test_a_recognised_module_is_told_where_we_are_and_changes_nothing(one: Harness) -> None:
    """It has an older group key: it was away, or it was revoked and lies about itself and about others."""
    one.hear(Speaker(who(2))())
    one.run(1.0)
    one.membership.events()
    before, liars = deepcopy(one.membership.endpoints.views()), [Speaker(who(n), 1 << 20) for n in range(2, 100)]
    for liar in liars:
        for kind in BeaconKind:
            one.membership.recognise(liar(kind, who(200).guid), ("10.0.0.99", 4000), 7)
    sent = one.membership.outputs()
    assert len(sent) == 2 * len(liars), "an announcement and a heartbeat are answered"
    for output in sent:
        assert output.address
        assert (output.beacon.kind, output.beacon.gossip, output.key) == (BeaconKind.ANSWER, (), 7)
    assert one.membership.endpoints.views() == before
    assert one.membership.events() == []


def test_our_own_echo_is_ignored(one: Harness) -> None:
    one.hear(Speaker(who(1))())
    assert (one.membership.events(), one.membership.outputs()) == ([], [])
    assert one.membership.counters["beacon.echo"] == 1


@pytest.mark.parametrize(("asked", "granted"), [(0.0, LEASE_MIN), (4e6, LEASE_MAX)])
def test_a_lease_has_bounds(one: Harness, asked: float, granted: float) -> None:
    one.hear(Speaker(who(2))(lease=asked))
    one.run(granted - 0.1)
    assert one.present() == ["peer2"]
    one.run(0.2)
    assert one.present() == []


def test_a_link_alone_finds_a_peer(one: Harness) -> None:
    one.membership.link_up(who(2), one.now)
    assert one.membership.events() == [PeerEvent("found", who(2))]


def test_goodbye_and_its_late_shadow(one: Harness) -> None:
    speaker = Speaker(who(2))
    late = speaker()
    one.hear(speaker())
    newest = speaker()
    one.hear(speaker(BeaconKind.GOODBYE))
    assert one.membership.events()[-1] == PeerEvent("lost", who(2), reason=membership.GOODBYE)
    one.hear(late)
    one.hear(newest)
    assert one.membership.events() == []
    assert one.membership.counters["beacon.late"] == 2
    one.hear(speaker())
    assert one.present() == ["peer2"]


def test_a_forged_goodbye_is_refuted_by_a_later_beacon(one: Harness) -> None:
    speaker = Speaker(who(2))
    one.hear(speaker())
    one.hear(Speaker(who(2), speaker.sequence + 1000)(BeaconKind.GOODBYE))
    assert one.membership.events()[-1] == PeerEvent("lost", who(2), reason=membership.GOODBYE)
    one.run(GOODBYE_LATE)
    one.hear(speaker())
    assert [event.change for event in one.membership.events()] == ["found"]


def test_a_forged_goodbye_of_a_linked_peer_is_forgotten_with_its_next_heartbeat(one: Harness) -> None:
    speaker = Speaker(who(2))
    one.hear(speaker())
    one.membership.link_up(who(2), one.now)
    one.hear(Speaker(who(2), speaker.sequence)(BeaconKind.GOODBYE))
    assert one.membership.events()[-1] == PeerEvent("doubted", who(2)), "a link at rest is to show whether it works"
    one.run(1.0)
    one.hear(speaker())
    one.hear(speaker())
    one.membership.link_down(who(2).guid, one.now)
    assert one.present() == ["peer2"], "as after any lost link, its lease begins"


def test_a_stranger_that_says_goodbye_is_not_met(one: Harness) -> None:
    one.hear(Speaker(who(2))(BeaconKind.GOODBYE))
    assert (one.membership.events(), one.membership.outputs(), one.membership.endpoints.views()) == ([], [], [])


def test_we_say_goodbye_and_nothing_after_it(one: Harness) -> None:
    one.hear(Speaker(who(2))())
    one.hear(Speaker(who(3))(), multicast=False)
    one.run(6)
    one.membership.goodbye(one.now)
    outputs = one.membership.outputs()
    assert [o.beacon.kind for o in outputs] == [BeaconKind.GOODBYE] * 2
    assert unicasts(outputs, BeaconKind.GOODBYE) == [("10.0.0.3", 40003)]
    one.hear(Speaker(who(4))())
    assert one.membership.next_timer() is None
    assert one.membership.outputs() == []


def test_a_link_of_a_replaced_run_that_falls_late_changes_nothing(one: Harness) -> None:
    one.membership.link_up(who(2), one.now)
    one.membership.link_up(who(2, 2), one.now)
    assert [e.change for e in one.membership.events()] == ["found", "lost", "found"]
    one.membership.link_down(who(2).guid, one.now, who(2).instance)
    assert one.membership.endpoints.views()[0].run.linked


def twins(one: Harness, *, linked: bool = False) -> tuple[Speaker, Speaker]:
    """Two live peers with one GUID address, heard until it is beyond doubt."""
    left, right = Speaker(who(2, name="left")), Speaker(who(2, run=2, name="right"))
    one.hear(left())
    if linked:
        one.membership.link_up(who(2, name="left"), one.now)
    one.run(2.5)
    one.hear(right())
    one.run(2.5)
    one.hear(left())
    one.run(2.5)
    one.hear(right())
    return left, right


def test_two_live_peers_with_one_guid_stay_out_until_one_is_silent(one: Harness) -> None:
    left, right = twins(one)
    events = one.membership.events()
    assert [e.change for e in events] == ["found", "lost", "found", "conflict", "lost"]
    assert events[-1].reason == membership.CONFLICT
    assert one.present() == []
    text = events[3].text
    assert "two live peers share one GUID address 10.0.0.2:40002" in text
    assert "--port" in text
    assert "NAT" in text
    views = one.membership.endpoints.views()
    assert {v.run.identity.name for v in views} == {"left", "right"}
    assert all(v.conflicts for v in views)
    for _ in range(6):
        one.run(2.5)
        one.hear(left())
        one.hear(right())
    assert one.membership.events() == []
    for _ in range(8):
        one.run(2.5)
        one.hear(left())
    assert one.membership.events() == [PeerEvent("found", who(2, name="left"), ("10.0.0.2", 40002))]
    assert one.present() == ["left"]


def test_a_conflict_ends_with_a_goodbye(one: Harness) -> None:
    _, right = twins(one)
    one.membership.events()
    one.hear(right(BeaconKind.GOODBYE))
    one.run(0)
    assert [e.change for e in one.membership.events()] == ["found"]
    assert one.present() == ["left"]


def test_a_working_link_survives_a_conflict(one: Harness) -> None:
    twins(one, linked=True)
    events = one.membership.events()
    assert [e.change for e in events if e.change != "doubted"] == ["found", "conflict"]
    assert one.present() == ["left"]
    one.membership.link_down(who(2).guid, one.now)
    assert [e.change for e in one.membership.events()] == ["lost"]


def test_another_run_at_the_place_of_a_linked_peer_has_its_link_checked(one: Harness) -> None:
    """A peer that lost its power and is back: its link, if it is at rest, would be noticed as dead after 16 s."""
    one.membership.link_up(who(2), one.now, ("10.0.0.2", 40002))
    assert [e.change for e in one.membership.events()] == ["found"]
    new = Speaker(who(2, run=2))
    one.now += 1
    one.hear(new())
    assert one.membership.events() == [PeerEvent("doubted", who(2))]
    one.now += 1.5  # the link was asked, and did not answer
    one.membership.link_down(who(2).guid, one.now, who(2).instance)
    assert [e.change for e in one.membership.events()] == ["lost", "found"]


def test_the_end_of_a_link_is_no_sign_that_its_run_lives(one: Harness) -> None:
    """A module lost its power and is back; a heartbeat of its new run was lost just when the old link fell."""
    one.membership.link_up(who(2), one.now)
    new = Speaker(who(2, run=2))
    for _ in range(2):
        one.run(5)
        one.hear(new())
    one.run(limits.HEARTBEAT_LATE + 1)
    one.membership.events()
    one.membership.link_down(who(2).guid, one.now)
    assert one.membership.events() == []
    one.run(3)
    one.hear(new())
    assert one.membership.events() == restarted(who(2), who(2, run=2))


def test_somebody_else_with_our_guid(one: Harness) -> None:
    twin = Speaker(who(1, run=9, name="twin"))
    one.hear(twin())
    one.run(5)
    one.hear(twin())
    (event,) = one.membership.events()
    assert event.change == "conflict"
    assert event.reason == "own_guid"
    assert "twin has our own GUID address 10.0.0.1:40001" in event.text
    for _ in range(3):
        one.run(5)
        one.hear(twin())
    assert one.membership.events() == []
    assert [v.run.identity.name for v in one.membership.endpoints.views()] == ["twin"]
    one.run(20)
    assert one.membership.endpoints.views() == []


def test_two_peers_of_one_name_both_stay_and_it_is_said_once(one: Harness) -> None:
    first, second = Speaker(who(2, name="base")), Speaker(who(3, name="base"))
    for _ in range(3):
        one.hear(first())
        one.hear(second())
        one.run(5)
    conflicts = [e for e in one.membership.events() if e.change == "conflict"]
    assert [c.text for c in conflicts] == [
        (
            "two modules are named base: 10.0.0.3:40003#1 and 10.0.0.2:40002#1, so rules and commands that name it "
            "may mean either; rename one: rmpa up --name"
        )
    ]
    assert one.present() == ["base", "base"]
    assert all("rename one" in view.conflicts[0] for view in one.membership.endpoints.views())


def moved(identity: Identity, port: int) -> Identity:
    """The same machine and name, another run at another port."""
    return replace(identity, guid=Guid.of(identity.guid.address, port, 9), instance=bytes([port & 255] * 16))


def test_live_peer_of_the_same_name_and_machine_is_a_conflict(one: Harness) -> None:
    first = Speaker(who(2, name="base"))
    second = Speaker(moved(first.identity, 50000))
    one.hear(first())
    one.run(1)
    one.hear(second())
    one.run(4)
    one.membership.link_up(second.identity, one.now)
    one.hear(first())
    events = one.membership.events()
    assert [e.reason for e in events if e.change == "conflict"] == ["name"]
    assert one.present() == ["base", "base"]


def test_name_conflict_needs_proof_that_both_are_alive(one: Harness) -> None:
    first, second = Speaker(who(2, name="base")), Speaker(who(3, name="base"))
    one.hear(first())
    one.run(1)
    one.hear(second())
    assert not [e for e in one.membership.events() if e.change == "conflict"]
    assert not any(view.conflicts for view in one.membership.endpoints.views())
    one.run(1)
    one.hear(first())
    assert [e.reason for e in one.membership.events() if e.change == "conflict"] == ["name"]


def test_a_peer_with_our_own_name() -> None:
    one = Harness(who(1, name="base"))
    one.hear(Speaker(who(2, name="base"))())
    assert [e.reason for e in one.membership.events() if e.change == "conflict"] == ["name"]


def test_a_peer_that_changes(one: Harness) -> None:
    speaker = Speaker(who(2))
    one.hear(speaker())
    one.membership.events()
    speaker.identity = replace(who(2), addresses=(IPv4Address("192.0.2.2"),))
    one.hear(speaker())
    assert one.membership.events() == [PeerEvent("changed", speaker.identity)]


def test_a_handshake_without_addresses_changes_nothing(one: Harness) -> None:
    full = replace(who(2), addresses=(IPv4Address("192.0.2.2"),))
    one.hear(Speaker(full)())
    one.membership.events()
    one.membership.link_up(who(2), one.now)
    assert one.membership.events() == []
    assert one.membership.endpoints.views()[0].run.identity == full


def test_gossip_leads_to_announcements_that_end(one: Harness) -> None:
    one.hear(Speaker(who(2))(BeaconKind.ANSWER, who(3).guid), multicast=False)
    sent = one.membership.outputs() + one.run(CANDIDATE_LIFETIME)
    greeted = [a for a in unicasts(sent, BeaconKind.ANNOUNCE) if a == ("10.0.0.3", 40003)]
    assert 5 <= len(greeted) <= 10
    assert ("10.0.0.3", 40003) not in unicasts(one.run(100), BeaconKind.ANNOUNCE)
    assert one.present() == []


def test_announcements_go_on_while_gossip_mentions_the_address(one: Harness) -> None:
    speaker = Speaker(who(2))
    for _ in range(20):
        one.hear(speaker(BeaconKind.HEARTBEAT, who(3).guid))
        one.run(5)
    one.membership.outputs()
    assert ("10.0.0.3", 40003) in unicasts(one.run(CANDIDATE_RETRY_MAX), BeaconKind.ANNOUNCE)


def test_gossip_carries_the_observed_address(one: Harness) -> None:
    """Its GUID's address may be of a network that whoever is told cannot reach."""
    one.hear(Speaker(who(2))(), source=("172.16.0.2", 40002))
    one.hear(Speaker(who(3))(BeaconKind.ANNOUNCE), multicast=False)
    answers = [o.beacon for o in one.membership.outputs() if o.address and o.address[0] == "10.0.0.3"]
    assert [(b.gossip, b.observed) for b in answers] == [((who(2).guid,), (("172.16.0.2", 40002),))]


def test_gossiped_address_of_an_unknown_peer_is_contacted(one: Harness) -> None:
    known = replace(who(4), addresses=(IPv4Address("172.16.0.4"),))
    one.hear(Speaker(known)())
    one.membership.outputs()
    places = (("172.16.0.2", 40002), ("172.16.0.4", 40004), ("10.0.0.1", 40001), ("127.0.0.1", 40005))
    one.hear(replace(Speaker(who(3))(BeaconKind.ANSWER, who(2).guid), observed=places), multicast=False)
    sent = one.membership.outputs() + one.run(1)
    assert set(unicasts(sent, BeaconKind.ANNOUNCE)) == {("10.0.0.2", 40002), ("172.16.0.2", 40002)}
    one.hear(Speaker(who(2))(BeaconKind.ANSWER), multicast=False, source=("172.16.0.2", 40002))
    assert "peer2" in one.present()
    one.membership.outputs()
    assert unicasts(one.run(CANDIDATE_LIFETIME / 2), BeaconKind.ANNOUNCE) == []


def test_gossip_is_bounded(one: Harness) -> None:
    speaker = Speaker(who(2))
    for i in range(20):
        guids = [Guid.of(IPv4Address(0x0A020000 + 100 * i + j), 1) for j in range(limits.BEACON_GOSSIP_MAX)]
        one.hear(speaker(BeaconKind.HEARTBEAT, *guids))
    greeted = unicasts(one.membership.outputs(), BeaconKind.ANNOUNCE)
    assert len(greeted) == CANDIDATES_BURST
    assert one.membership.counters["gossip.full"]


def test_loopback_peers_are_not_told_to_other_hosts(one: Harness) -> None:
    one.hear(Speaker(replace(who(3), guid=Guid.of("127.0.0.1", 40003)))())
    one.membership.outputs()
    one.hear(Speaker(who(2))())
    one.hear(Speaker(replace(who(4), guid=Guid.of("127.0.0.1", 40004)))())
    (far, near) = [o.beacon.gossip for o in one.membership.outputs() if o.beacon.kind is BeaconKind.ANSWER]
    assert (far, len(near)) == ((), 2)


def test_loopback_gossip_from_afar_is_not_believed(one: Harness) -> None:
    one.hear(Speaker(who(2))(BeaconKind.ANSWER, Guid.of("127.0.0.1", 40000)), multicast=False)
    assert unicasts(one.run(5), BeaconKind.ANNOUNCE) == []


def test_an_answer_carries_gossip_but_not_the_listener(one: Harness) -> None:
    one.hear(Speaker(who(3))())
    one.membership.outputs()
    one.hear(Speaker(who(2))())
    (answer,) = [o for o in one.membership.outputs() if o.address]
    assert answer.beacon.gossip == (who(3).guid,)


def test_seeds_get_announcements_until_they_are_members() -> None:
    seed = ("10.9.0.1", 11411)
    one = Harness()
    one.membership.set_seeds([seed, seed])
    assert unicasts(one.membership.outputs(), BeaconKind.ANNOUNCE) == [seed]
    one.run(1)
    assert unicasts(one.run(10), BeaconKind.ANNOUNCE) == [seed] * 2
    one.hear(Speaker(who(2))(BeaconKind.ANSWER), multicast=False, source=seed)
    assert unicasts(one.run(10), BeaconKind.ANNOUNCE) == []


def test_change_of_interfaces_sends_a_shorter_burst(one: Harness) -> None:
    one.membership.interfaces_changed(one.now, (IPv4Address("10.8.0.1"),))
    sent = [o for o in one.run(1) if o.address is None]
    assert [o.beacon.kind for o in sent] == [BeaconKind.ANNOUNCE] * len(BURST_AGAIN_OFFSETS)
    assert sent[0].beacon.identity.addresses == (IPv4Address("10.8.0.1"),)


def test_while_a_flood_pushes_beacons_out_an_agent_announces_itself_twice_a_second(one: Harness) -> None:
    sent = []
    for _ in range(200):  # each pause of the reading
        one.membership.beacons_lost(one.now)
        sent += one.run(0.05)
    announced = [o for o in sent if o.address is None and o.beacon.kind is BeaconKind.ANNOUNCE]
    assert len(announced) == pytest.approx(2 * 10, abs=2)
    assert [o.beacon.kind for o in one.run(10)] == [BeaconKind.ANNOUNCE, BeaconKind.HEARTBEAT, BeaconKind.HEARTBEAT]


@pytest.mark.usefixtures("small_roster")
def test_membership_is_bounded_and_links_go_first(one: Harness) -> None:
    for i in range(2 * limits.STRANGERS_MAX):
        guid = Guid.of(IPv4Address(0x0A010000 + i), 4000)
        one.hear(Speaker(replace(who(2), guid=guid, instance=i.to_bytes(16, "big"), name=f"n{i}"))())
    assert len(one.membership.endpoints.views()) == limits.STRANGERS_MAX
    assert one.membership.counters["roster.full"]
    for i in range(core_limits.PEERS_MAX):
        guid = Guid.of(IPv4Address(0x0A020000 + i), 4000)
        linked = replace(who(3), guid=guid, instance=(1 << 64 | i).to_bytes(16, "big"), name=f"linked{i}")
        one.membership.link_up(linked, one.now)
    assert "linked3" in one.present()
    assert not any(name.startswith("n") for name in one.present())
    assert len(one.membership.endpoints.views()) == core_limits.PEERS_MAX - 1


# --- rosters full of peers that somebody invents -----------------------------------------------------------------


def forged(number: int) -> Identity:
    guid = Guid.of(IPv4Address(0x0A010000 + number), 4000)
    return replace(who(2), guid=guid, instance=number.to_bytes(16, "big"), name=f"n{number}")


def flood(one: Harness, count: int, *, first: int = 0) -> None:
    """So many peers say once that they are there, for two minutes."""
    for number in range(first, first + count):
        one.hear(Speaker(forged(number))(BeaconKind.ANNOUNCE, lease=120.0))
        one.membership.outputs()
        one.membership.events()


def test_who_spoke_once_and_has_no_link_is_not_passed_on_for_long(one: Harness) -> None:
    flood(one, 100)
    one.membership.link_up(who(3), one.now)
    one.run(limits.MULTICAST_SILENCE)
    for output in one.run(60.0):
        assert set(output.beacon.gossip) <= {who(3).guid}
    one.hear(Speaker(who(2))(BeaconKind.ANNOUNCE), multicast=False)
    (answer,) = one.membership.outputs()
    assert answer.beacon.gossip == (who(3).guid,)


def test_announcements_to_many_forged_addresses_are_few(one: Harness) -> None:
    speaker, sent = Speaker(who(2)), 0
    for second in range(60):
        for part in range(8):
            guids = [Guid.of(IPv4Address(0x0A020000 + 64 * part + j), 1) for j in range(limits.BEACON_GOSSIP_MAX)]
            one.hear(speaker(BeaconKind.HEARTBEAT, *guids))
        sent += len(unicasts(one.membership.outputs() + one.run(1.0), BeaconKind.ANNOUNCE))
        assert sent <= CANDIDATES_BURST + (second + 1) * CANDIDATES_PER_SECOND
    assert sent >= 40 * CANDIDATES_PER_SECOND


@pytest.mark.usefixtures("small_roster")
def test_in_a_full_membership_a_stranger_takes_the_place_of_one_that_missed_a_heartbeat(one: Harness) -> None:
    flood(one, limits.STRANGERS_MAX)
    one.hear(Speaker(who(3))())
    assert "peer3" not in one.present()
    one.membership.link_up(who(4), one.now)
    assert "peer4" in one.present(), "a link proves that it is there"
    one.run(limits.HEARTBEAT_LATE)
    one.hear(Speaker(who(3))())
    assert "peer3" in one.present()


def test_old_forged_beacon_takes_no_endpoint_when_the_link_falls(one: Harness) -> None:
    one.hear(Speaker(who(2))())
    one.membership.link_up(who(2), one.now)
    one.run(1)
    one.hear(Speaker(replace(who(2, 2), name="eve"))(BeaconKind.ANNOUNCE, lease=120.0))
    one.run(limits.HEARTBEAT_LATE + 1)
    one.membership.events()
    one.membership.link_down(who(2).guid, one.now)
    assert one.membership.events() == []
    assert one.present() == ["peer2"]


def test_who_had_a_link_is_known(one: Harness) -> None:
    assert one.membership.is_verified(who(1).guid, who(1).instance), "our own echo"
    one.hear(Speaker(who(2))())
    assert not one.membership.is_verified(who(2).guid, who(2).instance)
    one.membership.link_up(who(2), one.now)
    assert one.membership.is_verified(who(2).guid, who(2).instance)
    assert not one.membership.is_verified(who(2).guid, who(2, 2).instance)
    one.membership.link_down(who(2).guid, one.now)
    assert one.membership.is_verified(who(2).guid, who(2).instance), "it is no forgery without its link either"


def test_indexes_agree_with_the_endpoints() -> None:
    """The remembered answers against a look at every endpoint, over a thousand random events."""
    rng = random.Random(3)
    one = Harness()
    speakers = [Speaker(replace(who(2 + n // 2, 1 + n % 2), name=f"name{n % 5}")) for n in range(24)]
    for _ in range(1500):
        speaker = rng.choice(speakers)
        what = rng.randrange(8)
        if what < 5:
            kind = rng.choice([*BeaconKind])
            one.hear(speaker(kind, lease=rng.choice([2.0, 16.0])), multicast=rng.random() < 0.5)
        elif what == 5:
            one.membership.link_up(speaker.identity, one.now)
        elif what == 6:
            one.membership.link_down(speaker.identity.guid, one.now)
        one.run(rng.choice([0.0, 0.1, 3.0]))
        one.membership.events()
        table = one.membership.endpoints
        endpoints = [endpoint for _, endpoint in sorted(table.items())]
        timers = [at for endpoint in endpoints if (at := endpoint.next_timer()) is not None]
        due, first = table.timers.next(), min(timers, default=None)
        assert due == first or (due is not None and first is not None and due < first)  # heartbeats move it later
        members = {place: e.current for place, e in table.items() if e.member is not None}
        assert table.members == members
        assert [e.identity for e in members.values() if e] == [e.member for e in table.values() if e.member]
        for name in {f"name{n}" for n in range(5)}:
            having = [e for e in endpoints if e.current is not None and e.current.identity.name == name]
            assert table.with_name(name) == having
