"""Links at rest: both ends agree, silence of a link in use is still noticed within a second."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from rmpa.mesh import limits
from rmpa.mesh.connection import ConnectionState
from rmpa.mesh.frames import Frame, FrameKind
from rmpa.mesh.keepalive import ACCEPTOR_KEEPALIVE_FACTOR, WAKE_PINGS, rest_lease
from tests.mesh.worlds import ACCEPTOR, DIALLER, HIGH, LOW, Side, Time, deliver, exchange, pair, pass_time


def run(one: Side, other: Side, time: Time, seconds: float) -> int:
    """Let both run on a path without delay; return how often a timer fired."""
    end, fired = time.now + seconds, 0
    while True:
        due = min((t for each in (one, other) if (t := each.next_timer()) is not None), default=end + 1)
        if due > end:
            time.now = end
            return fired
        time.now = max(time.now, due)
        for each in (one, other):
            timer = each.next_timer()
            if timer is not None and timer <= time.now:
                fired += 1
                each.handle_timer(time.now)
        exchange(one, other, time)


def resting(*sides: Side) -> list[bool]:
    return [each.rests for each in sides]


def rest(one: Side, other: Side, time: Time) -> None:
    for each in (one, other):
        each.need(time.now, needed=False)
    exchange(one, other, time)
    assert resting(one, other) == [True, True]


def test_silence_is_worth_a_check_at_the_pace_of_the_link(dialler: Side, acceptor: Side, time: Time) -> None:
    """In use within a second, at rest before the long lease ends, and soon when it is needed again."""
    assert dialler.keepalive.quiet_after == limits.GHOST_QUIET < limits.EXPRESS_LEASE
    rest(dialler, acceptor, time)
    assert limits.IDLE_KEEPALIVE_INTERVAL < dialler.keepalive.quiet_after < limits.IDLE_LEASE
    dialler.need(time.now, needed=True)  # and no answer comes
    assert dialler.keepalive.quiet_after == limits.GHOST_QUIET


@pytest.mark.parametrize("peers", [3, 13])
def test_an_agent_wakes_once_for_the_keepalives_of_all_its_resting_links(peers: int) -> None:
    """The other sides' agents have times of their own; what they send is not counted here."""
    rng, time = random.Random(peers), Time()
    links = []
    for number in range(peers):
        far = replace(HIGH, instance=rng.randbytes(16))
        ours, theirs = (LOW, far) if number % 2 else (far, LOW)
        dialler = Side(DIALLER, ours, time, expected=theirs.guid)
        acceptor = Side(ACCEPTOR, theirs, time)
        deliver(dialler.take_output(), acceptor, time.now)
        exchange(dialler, acceptor, time)
        rest(dialler, acceptor, time)
        links.append((dialler, acceptor) if number % 2 else (acceptor, dialler))
        time.now += rng.random() / peers
    run_all(links, time, 20.0)
    fired, pings = run_all(links, time, 600.0)
    assert len(fired) <= 600 / limits.IDLE_KEEPALIVE_INTERVAL + 1
    assert pings <= peers * 2 * (600 / limits.IDLE_KEEPALIVE_INTERVAL + 1), "a ping and its pong, one way each"
    assert all(each.state is ConnectionState.UP for pair_ in links for each in pair_)


def run_all(links: list[tuple[Side, Side]], time: Time, seconds: float) -> tuple[set[int], int]:
    """Let all links run; return the milliseconds at which timers of the first sides fired, and how often any sent."""
    end, sent = time.now + seconds, 0
    fired: set[int] = set()
    machines = [(pair_, each) for pair_ in links for each in pair_]
    while True:
        due, (pair_, each) = min(
            (((t if (t := m[1].next_timer()) is not None else end + 1), m) for m in machines), key=lambda x: x[0]
        )
        if due > end:
            time.now = end
            return fired, sent
        time.now = max(time.now, due)
        each.handle_timer(time.now)
        if each is pair_[0]:
            fired.add(round(time.now * 1000))
        if each.output:
            sent += 2
        exchange(*pair_, time)


@pytest.mark.parametrize(
    ("peers", "interval", "lease"), [(3, 15.0, 46.0), (150, 15.0, 46.0), (170, 17.0, 52.0), (999, 19.0, 58.0)]
)
def test_keepalives_at_rest_are_rarer_with_more_peers(peers: int, interval: float, lease: float) -> None:
    """Three of them and a second fit into the lease."""
    assert rest_lease(peers) == pytest.approx(lease) == 3 * interval + 1
    assert lease <= limits.LINK_LEASE_MAX
    assert 2 * interval * ACCEPTOR_KEEPALIVE_FACTOR < lease


def test_a_link_at_rest_takes_the_pace_of_a_mesh_that_grows_and_shrinks(
    dialler: Side, acceptor: Side, time: Time
) -> None:
    """The lease is promised before the side is silent for so long; a link in use stays as it is."""
    rest(dialler, acceptor, time)
    few = run(dialler, acceptor, time, 600.0)
    for each in (dialler, acceptor):
        each.keepalive.pace.rest_lease = rest_lease(999)
    run(dialler, acceptor, time, 20.0)
    assert dialler.keepalive.remote_lease == acceptor.keepalive.remote_lease == 58.0
    many = run(dialler, acceptor, time, 600.0)
    assert many < few
    assert dialler.state is acceptor.state is ConnectionState.UP
    dialler.need(time.now, needed=True)
    exchange(dialler, acceptor, time)
    assert dialler.keepalive.remote_lease == acceptor.keepalive.remote_lease == limits.EXPRESS_LEASE
    rest(dialler, acceptor, time)
    for each in (dialler, acceptor):
        each.keepalive.pace.rest_lease = rest_lease(2)
    run(dialler, acceptor, time, 60.0)
    assert dialler.keepalive.remote_lease == acceptor.keepalive.remote_lease == limits.IDLE_LEASE
    assert few - 2 <= run(dialler, acceptor, time, 600.0) <= few + 2


@pytest.mark.parametrize("who", [0, 1])
def test_the_clock_is_measured_anew_as_soon_as_a_rest_ends(time: Time, who: int) -> None:
    both = pair(time)
    rest(*both, time)
    run(*both, time, 604.0)
    heard = {each: len(each.events) for each in both}
    stale = [each.clock.estimate(time.now) for each in both]
    both[who].need(time.now, needed=True)
    run(*both, time, 0.2)
    for each, before in zip(both, stale, strict=True):
        now = each.clock.estimate(time.now)
        assert now is not None
        assert before is not None
        assert now[1] < before[1] / 3, "the old one is of seconds ago"
        pongs = [event for event in each.events[heard[each] :] if event[0] == "pong"]
        assert len(pongs) >= WAKE_PINGS, "one of several is quick even on a busy path"


def test_a_suspend_of_this_machine_is_not_the_peers_silence_and_the_next_use_asks_it(
    dialler: Side, acceptor: Side, time: Time
) -> None:
    rest(dialler, acceptor, time)
    time.now += 3600.0
    dialler.handle_timer(time.now)
    assert not dialler.seen("closed")
    dialler.need(time.now, needed=True)
    pass_time(dialler, time, limits.WAKE_TIMEOUT + 0.01)
    assert dialler.state is ConnectionState.CLOSED, "the peer has gone meanwhile"


@pytest.mark.parametrize("needed", [False, True])
def test_bits_of_later_versions_in_a_pace_frame_are_ignored(
    dialler: Side, acceptor: Side, time: Time, *, needed: bool
) -> None:
    rest(dialler, acceptor, time)
    frame = Frame(FrameKind.PACE, route=0xFFFFFFFC | needed, sequence=16_000).serialize()
    deliver(frame, dialler, time.now)
    assert dialler.rests is not needed


@pytest.mark.parametrize("claimed", [0, 1, 10**9])
def test_a_claimed_lease_is_held_within_bounds(dialler: Side, time: Time, claimed: int) -> None:
    deliver(Frame(FrameKind.PACE, route=1, sequence=claimed).serialize(), dialler, time.now)
    pass_time(dialler, time, limits.LINK_LEASE_MAX + 1.0)
    assert dialler.state is ConnectionState.CLOSED


@pytest.mark.parametrize("seed", range(30))
def test_whatever_both_say_when_they_agree_in_the_end(seed: int) -> None:
    """Frames are under way for up to 0.3 s: no lease is broken, and both end with the pace of what they said last."""
    rng, time = random.Random(seed), Time()
    both = pair(time)
    wires: tuple[list[tuple[float, bytes]], list[tuple[float, bytes]]] = ([], [])
    last = [True, True]
    for step in range(4000):
        time.now += 0.01
        for number, each in enumerate(both):
            link = each
            if step < 3000 and rng.random() < 0.01:
                last[number] = rng.random() < 0.5
                link.need(time.now, needed=last[number])
            if (due := link.next_timer()) is not None and due <= time.now:
                link.handle_timer(time.now)
            if link.output:
                at = max([time.now + rng.random() * 0.3, *(when for when, _ in wires[number])])
                wires[number].append((at, link.take_output()))
            while wires[1 - number] and wires[1 - number][0][0] <= time.now:
                deliver(wires[1 - number].pop(0)[1], link, time.now)
    assert all(each.state is ConnectionState.UP for each in both)
    assert [each.rests for each in both] == [not any(last)] * 2
