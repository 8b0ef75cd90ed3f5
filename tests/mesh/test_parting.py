"""Links that both sides end for now: only by agreement, and no frame of either side is lost."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import LocalProtocolError
from rmpa.mesh import frames, limits
from rmpa.mesh.connection import ConnectionState
from rmpa.mesh.connection_events import ConnectionClosed, ControlReceived, Parted, PartingEnded
from rmpa.mesh.frames import Frame, FrameKind, PaceFlag
from rmpa.mesh.handshake import Feature
from tests.mesh.worlds import Side, Time, deliver, exchange, pair

if TYPE_CHECKING:
    from rmpa.mesh.connection_events import ConnectionEvent


def of(side: Side, kind: type[ConnectionEvent]) -> list[ConnectionEvent]:
    return [event for event in side.events if isinstance(event, kind)]


def run(one: Side, other: Side, time: Time, seconds: float) -> None:
    """Let both run on a path without delay."""
    end = time.now + seconds
    while True:
        due = min((t for each in (one, other) if (t := each.link.next_timer()) is not None), default=end + 1)
        if due > end:
            time.now = end
            return
        time.now = max(time.now, due)
        for each in (one, other):
            each.link.handle_timer(time.now)
        exchange(one, other, time)


def willing(dialler: Side, acceptor: Side, time: Time) -> None:
    for each in (dialler, acceptor):
        each.link.need(time.now, needed=False, parks=True)
    exchange(dialler, acceptor, time)


def until_asked(dialler: Side, acceptor: Side, time: Time) -> None:
    """Both are willing, and the dialler is about to ask: its next timer does it."""
    willing(dialler, acceptor, time)
    while (due := dialler.link.next_timer()) is not None:
        time.now = due
        dialler.link.handle_timer(due)
        asked = frames_of(dialler.link.take_output())
        if any(frame.kind is FrameKind.PACE for frame in asked):
            deliver(b"".join(frame.serialize() for frame in asked), acceptor.link, time.now)
            return
        deliver(b"".join(frame.serialize() for frame in asked), acceptor.link, time.now)
        deliver(acceptor.link.take_output(), dialler.link, time.now)
    raise AssertionError("the dialler never asked")


def frames_of(data: bytes) -> list[Frame]:
    found = []
    while data:
        parsed = Frame.parse(data)
        assert parsed is not None
        found.append(parsed[0])
        data = data[parsed[1] :]
    return found


def test_both_willing_sides_part_after_a_while_and_both_know_it() -> None:
    time = Time()
    dialler, acceptor = pair(time)
    willing(dialler, acceptor, time)
    run(dialler, acceptor, time, limits.PARK_AFTER - 1)
    assert dialler.link.state is acceptor.link.state is ConnectionState.UP
    run(dialler, acceptor, time, 1 + limits.IDLE_KEEPALIVE_INTERVAL)
    assert of(dialler, Parted)
    assert of(acceptor, Parted)
    assert acceptor.last() == ConnectionClosed("low left: low parked the link")
    dialler.link.lost("closed")
    assert isinstance(dialler.last(), ConnectionClosed)


@pytest.mark.parametrize("unwilling", [0, 1])
def test_one_unwilling_side_keeps_the_link(unwilling: int) -> None:
    time = Time()
    both = pair(time)
    both[1 - unwilling].link.need(time.now, needed=False, parks=True)
    both[unwilling].link.need(time.now, needed=False)
    exchange(*both, time)
    run(*both, time, 10 * limits.PARK_AFTER)
    assert [each.link.state for each in both] == [ConnectionState.UP] * 2


@pytest.mark.parametrize("needing", [0, 1])
def test_need_begins_the_time_anew(needing: int) -> None:
    time = Time()
    both = pair(time)
    willing(*both, time)
    run(*both, time, limits.PARK_AFTER - 1)
    both[needing].link.need(time.now, needed=True)
    exchange(*both, time)
    run(*both, time, 2)
    both[needing].link.need(time.now, needed=False, parks=True)
    exchange(*both, time)
    run(*both, time, limits.PARK_AFTER - 1)
    assert [each.link.state for each in both] == [ConnectionState.UP] * 2
    run(*both, time, 1 + limits.IDLE_KEEPALIVE_INTERVAL)
    assert of(both[0], Parted)


@pytest.mark.parametrize("who", [0, 1])
def test_a_version_that_cannot_park_keeps_the_link(who: int) -> None:
    time = Time()
    both = pair(time)
    remote = both[1 - who].link.remote
    assert remote is not None
    both[1 - who].link.remote = replace(remote, features=Feature.PACE)  # ``who`` is of such a version
    both[1 - who].link.need(time.now, needed=False, parks=True)
    both[who].link.need(time.now, needed=False)
    exchange(*both, time)
    assert not both[who].link.remote_parks
    run(*both, time, 10 * limits.PARK_AFTER)
    assert [each.link.state for each in both] == [ConnectionState.UP] * 2


def test_what_the_acceptor_sent_before_it_agreed_arrives_before_the_bye() -> None:
    time = Time()
    dialler, acceptor = pair(time)
    until_asked(dialler, acceptor, time)
    answer = acceptor.link.take_output()
    assert acceptor.link.holding
    late = acceptor.link.control(b"{}")
    deliver(late + answer, dialler.link, time.now)  # as TCP has it: sent first, read first
    assert ControlReceived(b"{}") in dialler.events
    assert of(dialler, Parted)


def test_an_acceptor_that_begins_to_need_the_link_is_told_that_it_is_parked() -> None:
    """A parks while B begins to want: B holds back, hears the bye at once, and dials."""
    time = Time()
    dialler, acceptor = pair(time)
    until_asked(dialler, acceptor, time)
    acceptor.link.need(time.now, needed=True)
    answer = frames_of(acceptor.link.take_output())
    assert [frame.kind for frame in answer if frame.kind is FrameKind.PACE] == [FrameKind.PACE]
    assert acceptor.link.holding
    deliver(b"".join(frame.serialize() for frame in answer), dialler.link, time.now)
    deliver(dialler.link.take_output(), acceptor.link, time.now)
    assert of(acceptor, Parted)
    assert isinstance(acceptor.last(), ConnectionClosed)


def test_a_dialler_that_begins_to_need_the_link_meanwhile_keeps_it() -> None:
    time = Time()
    dialler, acceptor = pair(time)
    until_asked(dialler, acceptor, time)
    dialler.link.need(time.now, needed=True)
    acceptor.link.need(time.now, needed=True)
    agreed = acceptor.link.take_output()
    deliver(agreed, dialler.link, time.now)
    assert not of(dialler, Parted)
    deliver(dialler.link.take_output(), acceptor.link, time.now)
    assert of(acceptor, PartingEnded)
    assert not acceptor.link.holding
    exchange(dialler, acceptor, time)
    assert [each.link.rests for each in (dialler, acceptor)] == [False, False]
    run(dialler, acceptor, time, 60.0)
    assert [each.link.state for each in (dialler, acceptor)] == [ConnectionState.UP] * 2


def test_an_acceptor_that_waits_for_a_bye_that_a_cut_swallows_notices_the_cut() -> None:
    time = Time()
    dialler, acceptor = pair(time)
    until_asked(dialler, acceptor, time)
    deliver(acceptor.link.take_output(), dialler.link, time.now)
    assert of(dialler, Parted)
    dialler.link.take_output()  # lost
    acceptor.link.need(time.now, needed=True)
    begun = time.now
    while acceptor.link.state is ConnectionState.UP:
        due = acceptor.link.next_timer()
        assert due is not None
        time.now = max(time.now, due)
        acceptor.link.handle_timer(time.now)
    assert not of(acceptor, Parted)
    assert time.now - begun <= limits.HANDSHAKE_TIMEOUT + 0.01
    assert acceptor.last() == ConnectionClosed(str(getattr(acceptor.last(), "reason", "")))


def test_a_bye_that_says_parked_without_an_agreement_is_a_bye() -> None:
    time = Time()
    dialler, acceptor = pair(time)
    deliver(frames.bye("forged", parked=True).serialize(), acceptor.link, time.now)
    assert not of(acceptor, Parted)
    assert isinstance(acceptor.last(), ConnectionClosed)
    deliver(
        Frame(FrameKind.PACE, route=PaceFlag.PARKS | PaceFlag.PARTING, sequence=16_000).serialize(), dialler.link, 1
    )
    assert not of(dialler, Parted), "it did not ask"


def test_a_parked_connection_sends_nothing_more() -> None:
    time = Time()
    dialler, acceptor = pair(time)
    willing(dialler, acceptor, time)
    run(dialler, acceptor, time, limits.PARK_AFTER + limits.IDLE_KEEPALIVE_INTERVAL)
    dialler.link.need(time.now, needed=True)
    assert not dialler.link.has_output
    with pytest.raises(LocalProtocolError):
        dialler.link.ping(time.now)
