"""The failure detector as a machine: what it sends, and what it concludes."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING

import pytest

from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.discovery import limits
from rmpa.discovery.swim.events import (
    MemberFailed,
    MemberHeardOf,
    MemberLeft,
    MemberOffers,
    MemberRefuted,
    MemberSuspected,
    SendSwim,
    SwimEvent,
)
from rmpa.discovery.swim.failure_detector import FailureDetector
from rmpa.discovery.swim.packets import MemberState, News, SwimKind, SwimPacket

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

START = 100.0


class Mesh:
    """Detectors that know each other, without loss or delay; ``dropped`` says which packets get lost."""

    def __init__(self, count: int, *, active: bool = True) -> None:
        self.now = START
        self.identities = [
            Identity(Guid.of(f"10.0.0.{n + 1}", 40000, 1), random.Random(n).randbytes(16), f"m{n}")
            for n in range(count)
        ]
        self.detectors = [FailureDetector(i, rng=random.Random(n).random) for n, i in enumerate(self.identities)]
        self.by_address = {i.guid.endpoint: d for i, d in zip(self.identities, self.detectors, strict=True)}
        self.events: list[list[SwimEvent]] = [[] for _ in range(count)]
        self.sent: list[tuple[int, SendSwim]] = []
        self.dropped: Callable[[int, SendSwim], bool] = lambda *_: False
        self.dead: set[int] = set()
        for detector in self.detectors:
            detector.set_active(self.now, active=active)
            for identity in self.identities:
                detector.add(identity, self.now)

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while True:
            self.flush()
            timers = [
                (at, n)
                for n, d in enumerate(self.detectors)
                if n not in self.dead and (at := d.next_timer()) is not None
            ]
            at, number = min(timers, default=(end + 1, 0))
            if at > end:
                break
            self.now = max(self.now, at)
            self.detectors[number].handle_timer(self.now)
        self.now = end

    def flush(self) -> None:
        busy = True
        while busy:
            busy = False
            for n, detector in enumerate(self.detectors):
                if n in self.dead:
                    continue
                self.events[n] += detector.events()
                for output in detector.outputs():
                    busy = True
                    self.sent.append((n, output))
                    target = self.by_address.get(output.address)
                    if target is None or self.detectors.index(target) in self.dead or self.dropped(n, output):
                        continue
                    packet = SwimPacket.parse(output.packet.serialize(), 0)
                    target.receive(packet, self.identities[n].guid.endpoint, self.now)

    def state(self, at: int, of: int) -> MemberState | None:
        identity = self.identities[of]
        view = self.detectors[at].member(identity.guid, identity.instance)
        return view.state if view is not None else None

    def kinds(self, sender: int) -> list[SwimKind]:
        return [output.packet.kind for n, output in self.sent if n == sender]


def of(events: Iterable[SwimEvent], kind: type) -> list[SwimEvent]:
    return [event for event in events if isinstance(event, kind)]


def test_each_member_probes_one_a_second_and_each_is_probed_within_two() -> None:
    mesh = Mesh(8)
    mesh.run(20)
    for n in range(8):
        assert 19 <= mesh.kinds(n).count(SwimKind.PROBE) <= 21
        assert SwimKind.PROBE_REQUEST not in mesh.kinds(n)
    probed = {output.address for _, output in mesh.sent if output.packet.kind is SwimKind.PROBE}
    assert len(probed) == 8
    mesh.sent.clear()
    mesh.run(2.01)
    assert {o.address for _, o in mesh.sent if o.packet.kind is SwimKind.PROBE} == probed


def test_a_dead_member_is_known_to_all_within_five_seconds() -> None:
    mesh = Mesh(8)
    mesh.run(3)
    mesh.dead.add(3)
    mesh.run(5)
    for n in set(range(8)) - {3}:
        failed = of(mesh.events[n], MemberFailed)
        assert failed == [MemberFailed(mesh.identities[3].guid, mesh.identities[3].instance)]
        assert mesh.state(n, 3) is None


def test_lost_packets_to_one_member_are_made_up_for_by_indirect_probes() -> None:
    mesh = Mesh(6)
    cut = {mesh.identities[0].guid.endpoint: 1, mesh.identities[1].guid.endpoint: 0}
    mesh.dropped = lambda n, output: cut.get(output.address) == n
    mesh.run(60)
    assert SwimKind.FORWARDED_ACK in {output.packet.kind for _, output in mesh.sent}
    for n in range(6):
        assert not of(mesh.events[n], MemberSuspected)


def test_a_suspected_member_refutes_by_its_incarnation() -> None:
    mesh = Mesh(5)
    mesh.run(2)
    victim = mesh.identities[2]
    forged = News(victim.guid, victim.instance[:8], MemberState.SUSPECT, 0, 0, bytes(8))
    accuser = mesh.identities[0]
    packet = SwimPacket(SwimKind.NEWS, accuser.guid, accuser.instance, 0, 1, active=True, news=(forged,))
    mesh.detectors[1].receive(packet, accuser.guid.endpoint, mesh.now)
    assert mesh.state(1, 2) is MemberState.SUSPECT
    mesh.run(5)
    assert len(of(mesh.events[1], MemberRefuted)) == 1
    assert not of(mesh.events[1], MemberFailed)
    for n in (0, 1, 3, 4):
        view = mesh.detectors[n].member(victim.guid, victim.instance)
        assert view is not None
        assert (view.state, view.incarnation) == (MemberState.ALIVE, 1)


def test_a_process_that_was_stopped_accuses_no_other() -> None:
    mesh = Mesh(6)
    mesh.run(2.3)
    late = mesh.detectors[0]
    mesh.dead.add(0)
    mesh.run(3)
    mesh.dead.clear()
    late.handle_timer(mesh.now)  # before the packets that wait are read
    mesh.run(10)
    assert not of(mesh.events[0], MemberSuspected)
    assert late.counters["swim.late"] >= 1


def test_an_agent_that_hears_nothing_accuses_no_other_and_vouches_for_none() -> None:
    mesh = Mesh(6)
    mesh.run(2)
    mesh.dropped = lambda *_: True
    mesh.run(30)
    other = mesh.identities[1]
    assert not of(mesh.events[0], MemberSuspected)
    assert mesh.detectors[0].view().health > 0
    assert not mesh.detectors[0].vouches(other.guid, other.instance, mesh.now)


def test_a_member_that_is_heard_is_not_suspected_although_it_does_not_answer() -> None:
    mesh = Mesh(5)
    mesh.dropped = lambda sender, _: sender == 0  # it hears all the others, and nothing that it sends arrives
    mesh.run(20.0)
    assert not [event for event in mesh.events[0] if isinstance(event, MemberSuspected | MemberFailed)]
    assert all(
        MemberFailed(mesh.identities[0].guid, mesh.identities[0].instance) in mesh.events[n] for n in range(1, 5)
    )


def test_a_linked_member_is_never_held_to_have_failed() -> None:
    mesh = Mesh(6)
    mesh.run(2)
    victim = mesh.identities[3]
    mesh.detectors[0].set_linked(victim.guid, victim.instance, linked=True)
    mesh.dead.add(3)
    mesh.run(10)
    assert of(mesh.events[0], MemberSuspected)
    assert not of(mesh.events[0], MemberFailed)
    assert of(mesh.events[1], MemberFailed)
    mesh.detectors[0].set_linked(victim.guid, victim.instance, linked=False)
    mesh.run(limits.SUSPICION_LINKED)
    assert of(mesh.events[0], MemberFailed)


def test_a_member_that_leaves_is_known_at_once() -> None:
    mesh = Mesh(12)
    mesh.run(2)
    mesh.detectors[5].leave()
    mesh.flush()
    mesh.dead.add(5)
    mesh.run(2)
    for n in set(range(12)) - {5}:
        assert of(mesh.events[n], MemberLeft)
        assert not of(mesh.events[n], MemberSuspected)


def test_a_version_of_offers_reaches_all() -> None:
    mesh = Mesh(12)
    mesh.run(2)
    mesh.detectors[4].set_version(7, mesh.now)
    mesh.run(2)
    identity = mesh.identities[4]
    for n in set(range(12)) - {4}:
        assert of(mesh.events[n], MemberOffers) == [MemberOffers(identity.guid, identity.instance, 7)]
    assert len({detector.digest for detector in mesh.detectors}) == 1


def test_tables_that_differ_are_compared_until_they_agree() -> None:
    mesh = Mesh(12)
    mesh.run(2)
    other = mesh.identities[5]
    mesh.detectors[0].learn_version(other.guid, other.instance, 9, mesh.now)
    mesh.detectors[0]._news.stop()  # the news is lost: only comparisons are left
    assert len({detector.digest for detector in mesh.detectors}) == 2
    mesh.run(12)
    assert SwimKind.TABLE in {output.packet.kind for _, output in mesh.sent}
    assert len({detector.digest for detector in mesh.detectors}) == 1


def test_an_inactive_detector_answers_probes_and_sends_nothing_else() -> None:
    mesh = Mesh(4)
    mesh.detectors[2].set_active(mesh.now, active=False)
    mesh.run(10)
    assert set(mesh.kinds(2)) == {SwimKind.ACK}
    for n in (0, 1, 3):
        assert not of(mesh.events[n], MemberSuspected)


def test_a_detector_that_failures_switch_off_finds_the_other_dead_first() -> None:
    mesh = Mesh(20)
    mesh.run(5)
    mesh.dead = set(range(8, 20))
    living = range(8)
    switched_off: set[int] = set()
    for _ in range(200):
        mesh.run(0.1)
        for n in set(living) - switched_off:
            if of(mesh.events[n], MemberFailed):
                mesh.detectors[n].set_active(mesh.now, active=False)
                switched_off.add(n)
    assert switched_off == set(living)
    for n in living:
        assert len(of(mesh.events[n], MemberFailed)) == 12, f"member {n} was switched off with dead ones unfound"
    mesh.run(limits.SWIM_LINGER)
    before = len(mesh.sent)
    mesh.run(5)
    assert not any(mesh.detectors[n].view().active for n in living)
    assert len(mesh.sent) == before, "nothing is probed after that"


def test_a_detector_that_is_switched_on_again_in_time_goes_on() -> None:
    mesh = Mesh(6)
    mesh.run(5)
    mesh.dead = {5}
    mesh.run(8)
    for n in range(5):
        mesh.detectors[n].set_active(mesh.now, active=False)
    mesh.run(1)
    for n in range(5):
        mesh.detectors[n].set_active(mesh.now, active=True)
    mesh.run(2 * limits.SWIM_LINGER)
    assert all(mesh.detectors[n].view().active for n in range(5))


def test_a_member_that_is_heard_of_alone_is_reported_and_not_probed() -> None:
    mesh = Mesh(4)
    stranger = Identity(Guid.of("10.0.0.99", 40000), bytes(range(16)), "x")
    accuser = mesh.identities[0]
    news = News(stranger.guid, stranger.instance[:8], MemberState.ALIVE, 2, 5)
    packet = SwimPacket(SwimKind.NEWS, accuser.guid, accuser.instance, 0, 1, active=True, news=(news,))
    mesh.detectors[1].receive(packet, accuser.guid.endpoint, mesh.now)
    mesh.run(3)
    assert of(mesh.events[1], MemberHeardOf) == [MemberHeardOf(stranger.guid, stranger.instance[:8])]
    assert mesh.detectors[1].knows(stranger.instance)
    assert stranger.guid.endpoint not in {output.address for _, output in mesh.sent}
    mesh.detectors[1].add(stranger, mesh.now)
    view = mesh.detectors[1].member(stranger.guid, stranger.instance)
    assert view is not None
    assert (view.incarnation, view.version) == (2, 5)


def test_what_strangers_say_is_not_believed() -> None:
    mesh = Mesh(4)
    victim = mesh.identities[2]
    lie = News(victim.guid, victim.instance[:8], MemberState.LEFT, 9, 0)
    packet = SwimPacket(SwimKind.NEWS, Guid.of("10.9.9.9", 1), bytes(16), 0, 1, active=True, news=(lie,))
    mesh.detectors[0].receive(packet, ("10.9.9.9", 1), mesh.now)
    mesh.flush()
    assert mesh.state(0, 2) is MemberState.ALIVE
    assert mesh.detectors[0].counters["swim.stranger"] == 1


@pytest.mark.parametrize("leap", [limits.INCARNATION_LEAP + 1, 0xFFFFFFFF])
def test_an_incarnation_far_ahead_is_refused(leap: int) -> None:
    mesh = Mesh(4)
    liar, victim = mesh.identities[0], mesh.identities[2]
    news = tuple(
        News(i.guid, i.instance[:8], MemberState.SUSPECT, leap, 0, bytes(8)) for i in (victim, mesh.identities[1])
    )
    packet = SwimPacket(SwimKind.NEWS, liar.guid, liar.instance, 0, 1, active=True, news=news)
    mesh.detectors[1].receive(packet, liar.guid.endpoint, mesh.now)
    assert mesh.state(1, 2) is MemberState.ALIVE
    assert mesh.detectors[1].view().incarnation == 0


def test_another_run_at_the_same_place_is_another_member() -> None:
    mesh = Mesh(4)
    mesh.run(1)
    old = mesh.identities[2]
    new = Identity(old.guid, bytes(range(16)), old.name)
    mesh.detectors[0].add(new, mesh.now)
    assert mesh.state(0, 2) is None
    assert mesh.detectors[0].member(new.guid, new.instance) is not None
    assert mesh.detectors[0].view().members == 3


def test_news_about_loopback_members_stays_on_their_machine() -> None:
    mesh = Mesh(3)
    local = Identity(Guid.of("127.0.0.1", 40000), bytes(range(16)), "x")
    mesh.detectors[0].add(local, mesh.now)
    assert mesh.detectors[0].member(local.guid, local.instance) is None


def test_the_queue_sends_news_about_four_times_log_n_times_in_all() -> None:
    mesh = Mesh(12)
    mesh.run(2)
    mesh.sent.clear()
    mesh.detectors[4].set_version(7, mesh.now)
    mesh.run(30)
    sent = sum(1 for n, o in mesh.sent if n == 0 and any(x.version == 7 for x in o.packet.news))
    assert 0 < sent <= limits.NEWS_SENT_FACTOR * 2
    assert all(detector.view().news == 0 for detector in mesh.detectors)


@pytest.mark.parametrize("seed", range(5))
def test_whatever_a_member_says_the_tables_stay_bounded(seed: int) -> None:
    rng = random.Random(seed)
    mesh = Mesh(6)
    mesh.run(1)
    detector, liar = mesh.detectors[0], mesh.identities[1]
    for number in range(400):
        entries = []
        for _ in range(rng.randint(0, 20)):
            one = rng.choice(mesh.identities)
            known = rng.random() < 0.5
            guid = one.guid if known else Guid.of("10.5.0.1", rng.randint(1, 65535))
            run = one.instance[:8] if known else rng.randbytes(8)
            state = rng.choice(list(MemberState))
            accuser = rng.randbytes(8) if state is MemberState.SUSPECT else b""
            entries.append(News(guid, run, state, rng.randint(0, 9), rng.randint(0, 9), accuser))
        kind = rng.choice([SwimKind.NEWS, SwimKind.TABLE, SwimKind.SYNC])
        packet = SwimPacket(
            kind,
            liar.guid,
            liar.instance,
            0,
            number,
            rng.getrandbits(64),
            active=True,
            news=tuple(entries),
            buckets=tuple(rng.getrandbits(32) for _ in range(64)) if kind is SwimKind.SYNC else (),
            wanted=rng.getrandbits(64) if kind is SwimKind.TABLE else 0,
        )
        detector.receive(packet, liar.guid.endpoint, mesh.now)
        detector.events()
        assert sum(len(o.packet.serialize()) for o in detector.outputs()) < 40_000
        mesh.now += 0.05
        detector.handle_timer(mesh.now)
    assert detector.view().members <= 5
    assert len(detector._hearsay) <= limits.MEMBERS_HEARSAY_MAX
    assert detector.view().news <= limits.NEWS_QUEUE_MAX
