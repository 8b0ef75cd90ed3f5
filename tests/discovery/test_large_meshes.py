"""Membership among a thousand agents: no storm at a start."""

from __future__ import annotations

import random
from ipaddress import IPv4Address
from typing import TYPE_CHECKING

import pytest

from rmpa.core import limits as core_limits
from rmpa.core.identity import Guid, Identity
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.membership import BURST_OFFSETS
from tests.discovery.test_membership import Harness

if TYPE_CHECKING:
    from rmpa.discovery.endpoints import OutgoingBeacon

MEMBERS = 1000


def member(number: int) -> Identity:
    guid = Guid.of(IPv4Address(0x0A010000 + number), 40000)
    return Identity(guid, number.to_bytes(16, "big"), f"module{number}")


class Agent(Harness):
    """A started membership protocol among members that the test plays."""

    def __init__(self) -> None:
        super().__init__(member(9999), rng=random.Random(5).random)
        self.sequence = 0

    def hears(self, number: int, kind: BeaconKind, *, lease: float = 16.0) -> None:
        self.sequence += 1
        self.hear(Beacon(kind, member(number), round(1000 * lease), self.sequence))

    def meet(self, count: int, *, linked: bool = False) -> None:
        """So many members have been there for long; all had a link, which has ended unless they are ``linked``."""
        for number in range(count):
            self.hears(number, BeaconKind.HEARTBEAT)
            self.membership.link_up(member(number), self.now)
            if not linked:
                self.membership.link_down(member(number).guid, self.now)
        self.membership.outputs()
        self.membership.events()


def answers(outputs: list[OutgoingBeacon]) -> list[str]:
    return [o.address[0] for o in outputs if o.address and o.beacon.kind is BeaconKind.ANSWER]


def multicasts(outputs: list[OutgoingBeacon]) -> list[Beacon]:
    return [o.beacon for o in outputs if o.address is None]


def test_a_thousand_agents_that_start_at_once_do_not_answer_each_other() -> None:
    agent = Agent()
    sent = []
    for offset in BURST_OFFSETS:
        sent += agent.run(1000.0 + offset + 0.01 - agent.now)
        for number in range(MEMBERS):
            agent.hears(number, BeaconKind.ANNOUNCE)
    sent += agent.run(3.0)
    assert len(agent.membership.endpoints.views()) == MEMBERS
    assert len(answers(sent)) <= (limits.MANY_MEMBERS + 1) * len(BURST_OFFSETS)
    assert len(multicasts(sent)) <= len(BURST_OFFSETS) + 1


def test_a_newcomer_gets_the_answers_of_a_large_mesh_spread_over_seconds() -> None:
    times = []
    for seed in range(8):
        agent = Agent()
        agent.run(1.0)
        agent.membership._rng = random.Random(seed).random
        agent.meet(MEMBERS)
        agent.run(9.2)
        agent.hears(5000, BeaconKind.ANNOUNCE)
        began = agent.now
        agent.membership.outputs()
        while not agent.run(0.05):  # its answer, or a multicast that comes before it
            assert agent.now - began <= MEMBERS / limits.ANSWERS_PER_SECOND + 0.1
        times.append(agent.now - began)
    assert max(times) - min(times) > 1.0


def test_a_newcomer_that_is_linked_meanwhile_is_not_answered() -> None:
    agent = Agent()
    agent.run(1.0)
    agent.meet(MEMBERS)
    agent.hears(5000, BeaconKind.ANNOUNCE)
    agent.membership.link_up(member(5000), agent.now)
    assert not answers(agent.run(3.0))


def test_many_newcomers_are_answered_by_one_multicast() -> None:
    agent = Agent()
    agent.run(1.0)
    agent.meet(MEMBERS)
    agent.run(0.1)
    for number in range(5000, 5300):
        agent.hears(number, BeaconKind.ANNOUNCE)
    sent = agent.run(MEMBERS / limits.ANSWERS_PER_SECOND + 0.7)
    assert not answers(sent)
    assert 1 <= len(multicasts(sent)) <= 2


def test_heartbeats_come_every_five_seconds_in_a_mesh_of_any_size() -> None:
    agent = Agent()
    agent.run(1.0)
    agent.meet(300, linked=True)
    beats = [b for b in multicasts(agent.run(60.0)) if b.kind is BeaconKind.HEARTBEAT]
    assert 12 <= len(beats) <= 14
    assert {b.lease_ms for b in beats} == {1000 * core_limits.PEER_LEASE}


def test_forged_peers_never_displace_one_that_was_linked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "STRANGERS_MAX", 64)
    agent = Agent()
    agent.run(1.0)
    agent.meet(1)
    agent.membership.events()
    for number in range(1, limits.STRANGERS_MAX + 100):
        agent.hears(number, BeaconKind.ANNOUNCE, lease=120.0)
    for _ in range(40):
        agent.run(1.0)
        agent.hears(0, BeaconKind.HEARTBEAT, lease=61.0)
        for number in range(6000, 6020):
            agent.hears(number + agent.sequence, BeaconKind.ANNOUNCE, lease=120.0)
    lost = [event.identity.name for event in agent.membership.events() if event.change == "lost"]
    assert lost
    assert member(0).name not in lost


def test_in_a_flood_all_agents_of_a_large_mesh_send_a_hundred_announcements_a_second_together() -> None:
    agent = Agent()
    agent.meet(200, linked=True)
    agent.run(5.0)
    sent = []
    for _ in range(400):  # each pause of the reading
        agent.membership.beacons_lost(agent.now)
        sent += agent.run(0.05)
    announced = [beacon for beacon in multicasts(sent) if beacon.kind is BeaconKind.ANNOUNCE]
    assert len(announced) == pytest.approx(20 * 100 / 200, abs=1)
