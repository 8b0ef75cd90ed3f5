"""One source's way to one peer, with a clock that is told the time and a link that writes down what it is given."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule

from rmpa.bridge.data.io.route_sender import ReliableRouteSender, RouteSender, make_route_sender
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, History, Priority, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.mesh import limits as mesh_limits
from rmpa.runtime import limits as runtime_limits
from tests.bridge.io.doubles import Clock, Link, running

if TYPE_CHECKING:
    from collections.abc import Iterator

SMALL = b"s" * 8
LARGE = b"L" * (mesh_limits.EXPRESS_MESSAGE_MAX + 1)
ROW = mesh_limits.EXPRESS_AGAIN_MESSAGES
RELIABLE = Contract(reliability=Reliability.RELIABLE)


@pytest.fixture
def clock() -> Iterator[Clock]:
    with running(Clock()) as made:
        yield made


def best_effort(link: Link, contract: Contract | None = None, *, large: bool = False) -> RouteSender:
    leg = make_route_sender(link, 7, contract or Contract(), 0, large=large)
    assert not leg.reliable
    return leg


def reliable(link: Link, contract: Contract = RELIABLE, *, large: bool = False) -> ReliableRouteSender:
    leg = make_route_sender(link, 7, contract, 5, large=large)
    assert isinstance(leg, ReliableRouteSender)
    assert leg.reliable
    return leg


def answer(link: Link, leg: RouteSender) -> None:
    leg.fenced(link.fences.popleft()[1])


def on_bulk(link: Link, leg: RouteSender) -> None:
    leg.message(0, LARGE)
    answer(link, leg)
    assert leg.lane == "bulk"


# --- best effort ----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("clock")
def test_small_messages_go_at_once_numbered_from_1_with_their_stamp() -> None:
    link = Link()
    leg = best_effort(link)
    for n in range(5):
        assert leg.message(100 + n, memoryview(SMALL + bytes([n]))) == 0
    assert link.sent == [("express", n + 1, SMALL + bytes([n])) for n in range(5)]
    assert link.stamps == [100, 101, 102, 103, 104]
    assert set(link.routes) == {7}
    assert (leg.lane, leg.large, leg.dropped, leg.skipped) == ("express", False, 0, 0)


@pytest.mark.usefixtures("clock")
def test_the_first_large_one_and_what_follows_wait_for_the_fence_and_keep_their_order() -> None:
    link = Link()
    leg = best_effort(link)
    leg.message(0, b"1")
    buffer = bytearray(LARGE)
    leg.message(0, memoryview(buffer))
    buffer[:] = b"x" * len(buffer)  # the stream's buffer is used again
    leg.message(0, b"3")
    leg.message(0, LARGE)
    assert link.log == [("express", "message", 7, 1), ("express", "fence", 7, 1)]
    assert (leg.lane, leg.large) == ("express", True)
    leg.fenced(99)
    assert len(link.sent) == 1
    answer(link, leg)
    assert link.sent == [("express", 1, b"1"), ("bulk", 2, LARGE), ("bulk", 3, b"3"), ("bulk", 4, LARGE)]
    leg.message(0, b"5")
    assert link.sent[-1] == ("bulk", 5, b"5")
    leg.fenced(1)
    assert len(link.sent) == 5, "answered twice"


def test_from_express_to_bulk_and_back_again(clock: Clock) -> None:
    link = Link()
    leg = best_effort(link)
    on_bulk(link, leg)
    clock.advance(mesh_limits.EXPRESS_AGAIN_AFTER)
    for _ in range(ROW - 1):
        leg.message(0, SMALL)
    assert set(link.lanes) == {"bulk"}
    leg.message(0, SMALL)
    leg.message(0, SMALL)
    assert list(link.fences) == [("bulk", 2)]
    answer(link, leg)
    leg.message(0, SMALL)
    assert link.lanes[-3:] == ["express"] * 3
    assert link.numbers == list(range(1, ROW + 4))
    leg.message(0, LARGE)
    assert list(link.fences) == [("express", 3)]
    answer(link, leg)
    assert link.sent[-1][:2] == ("bulk", ROW + 4)


def test_a_large_one_while_the_way_back_is_fenced_does_not_go_by_the_express_lane(clock: Clock) -> None:
    link = Link()
    leg = best_effort(link)
    on_bulk(link, leg)
    clock.advance(mesh_limits.EXPRESS_AGAIN_AFTER)
    for _ in range(ROW):
        leg.message(0, SMALL)
    held = len(link.sent)
    leg.message(0, LARGE)
    leg.message(0, SMALL)
    assert not leg.begin(0, 1 << 20)
    answer(link, leg)
    assert link.lanes[held:] == ["express"], "the small one in front of it"
    answer(link, leg)
    assert link.lanes[held:] == ["express", "bulk", "bulk"]
    assert link.numbers == list(range(1, len(link.sent) + 1))


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize(("history", "kept"), [(History.KEEP_LAST, 3), (History.KEEP_ALL, 10)])
def test_what_is_held_keeps_to_the_depth_and_the_newest_stay(history: History, kept: int) -> None:
    link = Link()
    leg = best_effort(link, Contract(depth=3, history=history), large=True)
    drops = [leg.message(0, bytes([n])) for n in range(10)]
    assert drops == [0] * kept + [1] * (10 - kept)
    assert leg.dropped == 10 - kept
    answer(link, leg)
    assert [payload[0] for _, _, payload in link.sent] == list(range(10 - kept, 10))
    assert link.numbers == list(range(11 - kept, 11)), "the gap says how many are missing"


def test_what_is_held_keeps_to_the_bytes_but_one_message_always_fits(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_limits, "LINK_QUEUE_BYTES", 1000)
    link = Link()
    leg = best_effort(link, large=True)
    assert leg.message(0, bytes(400)) == 0
    assert leg.message(0, bytes(400)) == 0
    assert leg.message(0, bytes(300)) == 1
    assert leg.message(0, bytes(5000)) == 2
    assert leg.message(0, bytes(1000)) == 1
    answer(link, leg)
    assert [len(payload) for _, _, payload in link.sent] == [1000]
    clock.advance(mesh_limits.EXPRESS_AGAIN_AFTER)
    for _ in range(ROW):
        leg.message(0, b"")
    assert link.fences
    assert leg.message(0, bytes(1000)) == 0, "the count of bytes began anew"


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize(
    ("priority", "lane"), [(Priority.HIGH, "express"), (Priority.NORMAL, None), (Priority.LOW, "bulk")]
)
def test_the_priority_outweighs_the_size(priority: Priority, lane: str | None) -> None:
    link = Link()
    leg = best_effort(link, Contract(priority=priority))
    assert bool(link.fences) is (priority is Priority.LOW), "a low one changes its lane before its first message"
    if link.fences:
        answer(link, leg)
    leg.message(0, SMALL)
    leg.message(0, LARGE)
    if link.fences:
        answer(link, leg)
    assert link.lanes == ([lane] * 2 if lane else ["express", "bulk"])


@pytest.mark.usefixtures("clock")
def test_a_source_that_is_known_to_be_large_changes_its_lane_before_its_first_message() -> None:
    link = Link()
    leg = best_effort(link, large=True)
    assert list(link.fences) == [("express", 1)]
    assert leg.large
    answer(link, leg)
    leg.message(0, LARGE)
    assert link.lanes == ["bulk"]


@pytest.mark.usefixtures("clock")
def test_bulk_lost_while_the_fence_is_on_the_express_lane_its_answer_is_waited_for() -> None:
    link = Link()
    leg = best_effort(link, large=True)
    leg.message(0, SMALL)
    leg.lane_lost()
    assert not link.sent, "the fence is on the other lane"
    answer(link, leg)
    assert link.lanes == ["bulk"]


def test_bulk_lost_nothing_of_it_comes_behind_what_goes_by_the_express_lane_now(clock: Clock) -> None:
    """What waits for the lane's next connection would come late; the fence behind it would never be answered."""
    link = Link()
    leg = best_effort(link)
    on_bulk(link, leg)
    clock.advance(mesh_limits.EXPRESS_AGAIN_AFTER)
    for _ in range(ROW):
        leg.message(0, SMALL)
    number = link.fences.popleft()[1]
    link.log.clear()
    leg.lane_lost()
    assert link.log == [("bulk", "discard", 7), ("express", "message", 7, ROW + 1)]
    leg.fenced(number)
    leg.message(0, SMALL)
    assert link.numbers == list(range(1, ROW + 3))
    assert link.bulk.terms[7] == (core_limits.ROUTE_QUEUE_MESSAGES, mesh_limits.BULK_STALE_AGE, False), "they hold on"


@pytest.mark.usefixtures("clock")
def test_bulk_lost_without_a_fence_what_waits_for_its_next_connection_stays() -> None:
    link = Link()
    leg = best_effort(link)
    on_bulk(link, leg)
    link.log.clear()
    leg.lane_lost()
    assert link.log == []
    leg.message(0, LARGE)
    assert link.log == [("bulk", "message", 7, 2)]


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize(
    ("contract", "depth", "ages", "strict"),
    [
        (Contract(), core_limits.ROUTE_QUEUE_MESSAGES, (runtime_limits.STALE_AGE, mesh_limits.BULK_STALE_AGE), False),
        (Contract(depth=3), 3, (runtime_limits.STALE_AGE, mesh_limits.BULK_STALE_AGE), False),
        (Contract(depth=3, lifespan=0.5), 3, (0.5, 0.5), True),
        (
            Contract(depth=3, history=History.KEEP_ALL),
            mesh_limits.KEEP_ALL_MESSAGES,
            (runtime_limits.STALE_AGE, mesh_limits.BULK_STALE_AGE),
            False,
        ),
        (
            Contract(depth=3, lifespan=0.5, reliability=Reliability.RELIABLE),
            mesh_limits.KEEP_ALL_MESSAGES,
            (None, None),
            False,
        ),
    ],
)
def test_both_lanes_are_told_what_may_wait(
    contract: Contract, depth: int, ages: tuple[float | None, ...], strict: bool
) -> None:
    link = Link()
    make_route_sender(link, 7, contract, 1, large=False)
    assert link.express.terms == {7: (depth, ages[0], strict)}
    assert link.bulk.terms == {7: (depth, ages[1], strict)}


@pytest.mark.usefixtures("clock")
def test_what_a_lane_dropped_is_told_to_the_caller() -> None:
    link = Link()
    leg = best_effort(link)
    link.drops.extend([3, 0, 2])
    assert [leg.message(0, SMALL) for _ in range(3)] == [3, 0, 2]
    assert leg.dropped == 0, "the lane's own count has them"


@pytest.mark.usefixtures("clock")
def test_sequences_wrap() -> None:
    link = Link()
    leg = best_effort(link)
    leg.sequence = (1 << 32) - 2
    for _ in range(3):
        leg.message(0, SMALL)
    leg.message(0, LARGE)
    answer(link, leg)
    assert link.numbers == [(1 << 32) - 1, 0, 1, 2]


# --- best effort, in parts ------------------------------------------------------------------------------------

BIG = 300_000


@pytest.mark.usefixtures("clock")
def test_parts_go_as_they_come_once_the_lane_is_right() -> None:
    link = Link()
    leg = best_effort(link)
    assert not leg.begin(11, BIG), "the first one is what changes the lane: it is wanted whole"
    leg.message(11, bytes(BIG))
    assert not leg.begin(12, BIG), "and so is what comes before the fence is answered"
    leg.message(12, bytes(BIG))
    answer(link, leg)
    assert leg.begin(13, BIG)
    link.drops.extend([1, 2])
    assert leg.part(memoryview(bytes(BIG - 1))) == 1
    assert leg.part(memoryview(b"z")) == 2
    assert [(lane, number, len(payload)) for lane, number, payload in link.sent] == [
        ("bulk", 1, BIG),
        ("bulk", 2, BIG),
        ("bulk", 3, BIG),
    ]
    assert link.stamps == [11, 12, 13]
    assert link.sent[-1][2][-1:] == b"z"


@pytest.mark.usefixtures("clock")
def test_parts_of_an_urgent_topic_go_by_the_express_lane() -> None:
    link = Link()
    leg = best_effort(link, Contract(priority=Priority.HIGH))
    assert leg.begin(0, BIG)
    leg.part(bytes(BIG))
    assert link.lanes == ["express"]


@pytest.mark.usefixtures("clock")
def test_an_abort_takes_its_number_with_it_and_the_next_one_begins_anew() -> None:
    link = Link()
    leg = best_effort(link, large=True)
    answer(link, leg)
    leg.begin(0, BIG)
    leg.part(bytes(10))
    leg.abort()
    leg.abort()
    assert leg.part(bytes(10)) == 0
    assert link.log[-2:] == [("bulk", "open", 7, 1, BIG), ("bulk", "abandon", 7, 1)]
    leg.message(0, LARGE)
    assert link.numbers == [2]


# --- down-sampling --------------------------------------------------------------------------------------------


def test_of_too_many_the_newest_goes_when_its_turn_comes(clock: Clock) -> None:
    link = Link()
    leg = best_effort(link, Contract(max_rate=10.0))
    for n in range(10):
        leg.message(n, bytes([n]))
        clock.advance(0.008)
    assert [payload[0] for _, _, payload in link.sent] == [0]
    clock.advance(0.1)
    assert [payload[0] for _, _, payload in link.sent] == [0, 9]
    assert link.stamps == [0, 9], "the time of publication, not that of the turn"
    assert link.numbers == [1, 2], "what was left out is no gap"
    assert (leg.skipped, leg.dropped) == (8, 0)
    assert clock.due == []


def test_a_newer_one_that_comes_on_the_beat_takes_the_place_of_the_one_that_waits(clock: Clock) -> None:
    link = Link()
    leg = best_effort(link, Contract(max_rate=10.0))
    leg.message(0, b"a")
    clock.advance(0.05)
    leg.message(0, b"b")
    clock.advance(0.045)  # a tenth of the interval early is on time
    leg.message(0, b"c")
    clock.advance(1.0)
    assert [payload for _, _, payload in link.sent] == [b"a", b"c"]
    assert leg.skipped == 1


def test_a_pause_costs_the_next_one_nothing(clock: Clock) -> None:
    link = Link()
    leg = best_effort(link, Contract(max_rate=10.0))
    for n in range(5):
        leg.message(0, bytes([n]))
        clock.advance(1.0)
    assert len(link.sent) == 5
    assert leg.skipped == 0


@pytest.mark.parametrize("hertz", [30.01, 29.99, 30.0])
def test_a_source_of_nearly_the_same_rate_loses_only_what_it_has_too_many_of(clock: Clock, hertz: float) -> None:
    link = Link()
    leg = best_effort(link, Contract(max_rate=30.0))
    for _ in range(9_000):
        leg.message(0, SMALL)
        clock.advance(1 / hertz)
    assert leg.skipped <= 4
    assert len(link.sent) + leg.skipped >= 8_999


@settings(deadline=None, max_examples=60)
@given(st.sampled_from([1.0, 30.0, 200.0]), st.lists(st.floats(0, 3), min_size=1, max_size=80))
def test_any_source_keeps_to_the_rate_and_ends_with_its_newest(rate: float, gaps: list[float]) -> None:
    with running(Clock()) as clock:
        link, went = Link(), []
        leg = best_effort(link, Contract(max_rate=rate))
        for number, gap in enumerate(gaps):
            before = len(link.sent)
            leg.message(number, number.to_bytes(4, "big"))
            if len(link.sent) > before:
                went.append(clock.now)
            until = clock.now + gap / rate
            while clock.now < until:
                before = len(link.sent)
                clock.advance(min([until, *(due for due in clock.due if due > clock.now)]) - clock.now)
                if len(link.sent) > before:
                    went.append(clock.now)
        clock.advance(10 / rate)
        order = [int.from_bytes(payload, "big") for _, _, payload in link.sent]
        assert order == sorted(set(order))
        assert order[-1] == len(gaps) - 1, "the newest is never lost"
        assert leg.skipped == len(gaps) - len(order)
        for first in range(len(went)):
            for last in range(first + 1, len(went)):
                assert last - first <= (went[last] - went[first]) * rate + 0.6 + 1e-3


def test_a_throttled_topic_of_large_messages_is_wanted_whole_and_changes_its_lane_too(clock: Clock) -> None:
    link = Link()
    leg = best_effort(link, Contract(max_rate=10.0))
    for n in range(4):
        assert not leg.begin(n, BIG)
        leg.message(n, bytes(BIG))
    answer(link, leg)
    clock.advance(0.1)
    assert link.lanes == ["bulk", "bulk"]
    assert link.stamps == [0, 3]


def test_nothing_more_happens_when_it_is_closed(clock: Clock) -> None:
    link = Link()
    leg = best_effort(link, Contract(max_rate=10.0))
    leg.message(0, b"a")
    leg.message(0, b"b")
    leg.close()
    clock.advance(1.0)
    assert len(link.sent) == 1
    held = best_effort(link, large=True)
    held.message(0, LARGE)
    held.close()
    answer(link, held)
    held.lane_lost()
    held.message(0, SMALL)
    held.acknowledged(3)
    assert not held.begin(0, BIG)
    assert len(link.sent) == 1


# --- reliable -------------------------------------------------------------------------------------------------


def test_the_window_bounds_what_is_under_way_and_acknowledgements_move_it(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mesh_limits, "RELIABLE_WINDOW_MESSAGES", 4)
    link = Link()
    leg = reliable(link)
    for n in range(10):
        assert leg.message(n, bytes([n])) == 0
    assert link.numbers == [1, 2, 3, 4]
    leg.acknowledged(2)
    assert link.numbers == [1, 2, 3, 4, 5, 6]
    leg.acknowledged(6)
    leg.acknowledged(10)
    assert [payload[0] for _, _, payload in link.sent] == list(range(10))
    assert link.stamps == list(range(10))
    assert leg.sender.idle
    assert clock.due == [], "TCP repeats; no timer of ours does"


@pytest.mark.usefixtures("clock")
def test_beyond_its_bounds_the_oldest_is_lost_and_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_limits, "RELIABLE_WINDOW_MESSAGES", 2)
    link = Link()
    leg = reliable(link, Contract(reliability=Reliability.RELIABLE, depth=5))
    lost = [leg.message(0, bytes([n])) for n in range(9)]
    # 1 and 2 are under way: to drop them frees no place that is known to be lost.
    assert sum(lost) == leg.dropped == 2
    leg.acknowledged(2)
    leg.acknowledged(6)
    leg.acknowledged(8)
    assert link.numbers == [1, 2, 5, 6, 7, 8, 9]


@pytest.mark.usefixtures("clock")
def test_it_is_wanted_whole_and_changes_its_lane_behind_a_fence() -> None:
    link = Link()
    leg = reliable(link)
    leg.message(0, SMALL)
    assert not leg.begin(0, BIG)
    leg.message(0, bytes(BIG))
    leg.message(0, SMALL)
    assert link.log == [("express", "message", 7, 1), ("express", "fence", 7, 1)]
    leg.acknowledged(1)
    assert link.numbers == [1], "an acknowledgement opens the window, not the fence"
    answer(link, leg)
    assert link.sent == [("express", 1, SMALL), ("bulk", 2, bytes(BIG)), ("bulk", 3, SMALL)]
    assert leg.sender.in_flight == 2


@pytest.mark.usefixtures("clock")
def test_bulk_lost_what_was_on_it_is_sent_again_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    link = Link()
    leg = reliable(link)
    leg.message(0, LARGE)
    answer(link, leg)
    for n in range(4):
        leg.message(0, bytes([n]))
    leg.acknowledged(2)
    link.log.clear()
    leg.lane_lost()
    assert link.log == [
        ("bulk", "discard", 7),  # or the peer would see those that wait before those that were torn: a gap
        ("bulk", "message", 7, 3),
        ("bulk", "message", 7, 4),
        ("bulk", "message", 7, 5),
    ]
    leg.acknowledged(5)
    leg.lane_lost()
    assert link.numbers == [1, 2, 3, 4, 5, 3, 4, 5]
    assert leg.sender.idle


@pytest.mark.usefixtures("clock")
def test_bulk_lost_while_a_fence_is_on_the_express_lane_nothing_is_sent_twice() -> None:
    link = Link()
    leg = reliable(link)
    leg.message(0, SMALL)
    leg.message(0, LARGE)
    leg.lane_lost()
    assert link.numbers == [1]
    answer(link, leg)
    assert link.numbers == [1, 2]


def test_bulk_lost_on_the_way_back_all_goes_by_the_express_lane(clock: Clock) -> None:
    link = Link()
    leg = reliable(link)
    leg.message(0, LARGE)
    answer(link, leg)
    clock.advance(mesh_limits.EXPRESS_AGAIN_AFTER)
    for _ in range(ROW):
        leg.message(0, SMALL)
    assert list(link.fences) == [("bulk", 2)]
    leg.acknowledged(100)
    link.log.clear()
    leg.lane_lost()
    assert link.log == [("bulk", "discard", 7)] + [
        ("express", "message", 7, number) for number in range(101, ROW + 2)
    ]


@pytest.mark.usefixtures("clock")
def test_an_old_acknowledgement_does_no_harm() -> None:
    link = Link()
    leg = reliable(link, large=True)
    answer(link, leg)
    for _ in range(5):
        leg.message(0, SMALL)
    leg.acknowledged(4)
    leg.acknowledged(2)
    leg.lane_lost()
    assert link.numbers == [1, 2, 3, 4, 5, 5]


@pytest.mark.usefixtures("clock")
def test_an_acknowledgement_of_what_was_never_sent_is_the_peers_error() -> None:
    link = Link()
    leg = reliable(link)
    leg.message(0, SMALL)
    with pytest.raises(RemoteProtocolError):
        leg.acknowledged(2)


@pytest.mark.usefixtures("clock")
@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_over_a_new_link_it_goes_on_behind_what_the_peer_has(after: int) -> None:
    old, new = Link(), Link()
    leg = reliable(old)
    for n in range(3):
        leg.message(0, bytes([n]))
    leg.suspend()
    leg.message(0, bytes([3]))
    leg.message(0, LARGE)
    assert len(old.sent) == 3
    leg.acknowledged(2)  # what still came over the old link, behind the end
    leg.resume(new, 9, after)
    assert new.numbers == list(range(after + 1, 5))
    assert set(new.routes) <= {9}
    assert list(new.fences) == [("express", 1)], "the large one"
    answer(new, leg)
    assert new.sent[-1] == ("bulk", 5, LARGE)
    assert new.numbers == list(range(after + 1, 6))
    assert 9 in new.express.terms
    assert 9 in new.bulk.terms


@pytest.mark.usefixtures("clock")
def test_over_a_new_link_a_topic_of_large_messages_changes_its_lane_first() -> None:
    old, new = Link(), Link()
    leg = reliable(old, large=True)
    answer(old, leg)
    leg.message(0, LARGE)
    leg.suspend()
    leg.lane_lost()
    leg.fenced(1)
    leg.resume(new, 8, 0)
    assert new.log == [("express", "fence", 8, 2)]
    leg.fenced(1)
    assert not new.sent
    answer(new, leg)
    assert new.sent == [("bulk", 1, LARGE)]


@pytest.mark.usefixtures("clock")
def test_what_was_acknowledged_since_a_peer_said_where_it_is_counts() -> None:
    """Of two links that come up at once, the word of the one that is given up comes last."""
    old, new = Link(), Link()
    leg = reliable(old)
    for _ in range(3):
        leg.message(0, SMALL)
    leg.acknowledged(2)
    leg.suspend()
    leg.resume(new, 8, 1)
    assert new.numbers == [3]


@pytest.mark.usefixtures("clock")
def test_a_peer_cannot_go_on_where_it_never_was() -> None:
    old, new = Link(), Link()
    leg = reliable(old)
    leg.message(0, SMALL)
    leg.suspend()
    with pytest.raises(RemoteProtocolError):
        leg.resume(new, 8, 2)
    assert not new.log
    leg.resume(new, 9, 1)
    leg.message(0, SMALL)
    assert new.numbers == [2]


def test_a_throttled_one_keeps_the_newest_over_the_loss_of_its_link(clock: Clock) -> None:
    old, new = Link(), Link()
    leg = reliable(old, Contract(reliability=Reliability.RELIABLE, max_rate=10.0))
    for n in range(3):
        leg.message(n, bytes([n]))
    leg.suspend()
    clock.advance(0.5)
    leg.resume(new, 8, 1)
    assert [payload for _, _, payload in new.sent] == [bytes([2])]
    assert leg.skipped == 1


class FallingLink(RuleBasedStateMachine):
    """Each lane brings what it likes when it likes; bulk falls, links fall; the peer leaves out what it has."""

    def __init__(self) -> None:
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(mesh_limits, "RELIABLE_WINDOW_MESSAGES", 4)
        self.patch.setattr(mesh_limits, "EXPRESS_AGAIN_MESSAGES", 3)
        self.running = running(Clock())
        self.clock = self.running.__enter__()
        self.link = Link()
        self.leg = reliable(self.link)
        self.published = 0
        self.came = 0
        self.ways: dict[str, deque[tuple[str, int]]] = {"express": deque(), "bulk": deque()}
        self.marks: deque[tuple[str, int]] = deque()

    def collect(self) -> None:
        """What the leg gave to the lanes is under way."""
        for lane, kind, *rest in self.link.log:
            if kind == "discard":
                self.ways[str(lane)].clear()
            else:
                assert isinstance(rest[-1], int)
                self.ways[str(lane)].append((str(kind), rest[-1]))
        self.link.log.clear()

    @rule(payload=st.sampled_from([SMALL, LARGE]), count=st.integers(1, 5))
    def publish(self, payload: bytes, count: int) -> None:
        for _ in range(count):
            self.leg.message(0, payload)
        self.published += count
        self.collect()

    @rule(seconds=st.sampled_from([0.01, mesh_limits.EXPRESS_AGAIN_AFTER]))
    def wait(self, seconds: float) -> None:
        self.clock.advance(seconds)

    @rule(lane=st.sampled_from(["express", "bulk"]), count=st.sampled_from([1, 2, 1000]))
    def carry(self, lane: str, count: int) -> None:
        for _ in range(min(count, len(self.ways[lane]))):
            kind, number = self.ways[lane].popleft()
            if kind == "fence":
                self.marks.append(("fenced", number))
                continue
            assert number <= self.came + 1, "something is missing before it"
            self.came = max(self.came, number)
            self.marks.append(("ack", self.came))

    @precondition(lambda self: self.marks)
    @rule(count=st.sampled_from([1, 1000]))
    def mark(self, count: int) -> None:
        for _ in range(min(count, len(self.marks))):
            kind, number = self.marks.popleft()
            (self.leg.fenced if kind == "fenced" else self.leg.acknowledged)(number)
        self.collect()

    @rule(gone=st.integers(0, 3))
    def lose_bulk(self, gone: int) -> None:
        """What the connection had is lost; what waited for it in the lane's queue is not."""
        for _ in range(min(gone, len(self.ways["bulk"]))):
            self.ways["bulk"].popleft()
        self.leg.lane_lost()
        self.collect()

    @rule(meanwhile=st.integers(0, 3), payload=st.sampled_from([SMALL, LARGE]))
    def lose_link(self, meanwhile: int, payload: bytes) -> None:
        self.leg.suspend()
        self.link = Link()
        for way in self.ways.values():
            way.clear()
        self.marks.clear()
        for _ in range(meanwhile):
            self.leg.message(0, payload)
        self.published += meanwhile
        self.leg.resume(self.link, 7, self.came)
        self.collect()

    def teardown(self) -> None:
        """Everything that was published arrives."""
        try:
            for _ in range(self.published + 5):
                self.carry("express", 1000)
                self.carry("bulk", 1000)
                self.mark(1000)
            assert self.came == self.published
            assert self.leg.sender.idle
            assert self.leg.dropped == 0
            assert not any(self.ways.values())
        finally:
            self.running.__exit__(None, None, None)
            self.patch.undo()
            super().teardown()


TestFallingLink = FallingLink.TestCase
TestFallingLink.settings = settings(max_examples=200, stateful_step_count=40, deadline=None)
