"""Links at rest: both ends agree, silence of a link in use is still noticed within a second."""

from __future__ import annotations

import random

import pytest

from rmpa.mesh import limits
from rmpa.mesh.connection import ConnectionState
from rmpa.mesh.frames import Frame, FrameKind
from rmpa.mesh.keepalive import ACCEPTOR_KEEPALIVE_FACTOR, rest_lease
from tests.mesh.worlds import Side, Time, deliver, exchange, pair, pass_time


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
