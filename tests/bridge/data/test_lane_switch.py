"""The lane switch alone, by its table, and with two lanes that have no common order: no message overtakes another."""

from __future__ import annotations

from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rmpa.bridge.data.route import BULK, EXPRESS, LaneSwitch
from rmpa.core.contract import Contract, Priority
from rmpa.mesh import limits
from rmpa.mesh.frames import Lane

SMALL = limits.EXPRESS_MESSAGE_MAX
LARGE = SMALL + 1
ROW = limits.EXPRESS_AGAIN_MESSAGES
REST = limits.EXPRESS_AGAIN_AFTER


def on_bulk() -> LaneSwitch:
    """A switch that a large message at 0 s has brought to the bulk lane."""
    switch = LaneSwitch(Contract())
    assert switch.judge(LARGE, 0.0)
    assert switch.fenced(switch.fence())
    return switch


@pytest.mark.parametrize(
    ("priority", "large", "target"),
    [
        (Priority.HIGH, False, EXPRESS),
        (Priority.HIGH, True, EXPRESS),
        (Priority.NORMAL, False, EXPRESS),
        (Priority.NORMAL, True, BULK),
        (Priority.LOW, False, BULK),
        (Priority.LOW, True, BULK),
    ],
)
def test_a_route_begins_behind_the_word_that_opens_it(priority: Priority, large: bool, target: Lane) -> None:
    switch = LaneSwitch(Contract(priority=priority), large=large)
    assert (switch.lane, switch.target, switch.fencing) == (EXPRESS, target, False)
    assert switch.judge(0, 0.0) is (target is BULK)


@pytest.mark.parametrize("priority", [Priority.HIGH, Priority.LOW])
def test_priority_outweighs_message_size(priority: Priority) -> None:
    switch = LaneSwitch(Contract(priority=priority))
    if priority is Priority.LOW:
        assert switch.fenced(switch.fence())
    for now in range(10 * ROW):
        assert not switch.judge(LARGE if now == 3 else 0, float(now))
    assert switch.lane is (EXPRESS if priority is Priority.HIGH else BULK)


def test_first_large_message_waits_for_the_fence() -> None:
    switch = LaneSwitch(Contract())
    assert not switch.judge(SMALL, 0.0)
    assert switch.judge(LARGE, 1.0)
    assert (switch.lane, switch.target, switch.fencing) == (EXPRESS, BULK, False)
    number = switch.fence()
    assert (switch.lane, switch.fencing) == (EXPRESS, True)
    assert switch.fenced(number)
    assert (switch.lane, switch.target, switch.fencing) == (BULK, BULK, False)
    assert not switch.judge(LARGE, 2.0)
    assert not switch.judge(SMALL, 2.0)


def test_return_needs_many_small_messages_for_long() -> None:
    many_at_once = on_bulk()
    assert not any(many_at_once.judge(SMALL, REST - 0.001) for _ in range(5 * ROW))
    assert many_at_once.judge(SMALL, REST)
    few_for_long = on_bulk()
    assert not any(few_for_long.judge(SMALL, REST + n) for n in range(ROW - 1))
    assert few_for_long.judge(SMALL, REST + ROW)
    assert (few_for_long.lane, few_for_long.target) == (BULK, EXPRESS)
    assert few_for_long.fenced(few_for_long.fence())
    assert few_for_long.lane is EXPRESS


def test_one_large_message_in_the_row_begins_it_anew() -> None:
    switch = on_bulk()
    assert not any(switch.judge(SMALL, REST) for _ in range(ROW - 1))
    assert not switch.judge(LARGE, REST)
    assert not any(switch.judge(SMALL, 2 * REST) for _ in range(ROW - 1))
    assert switch.judge(SMALL, 2 * REST)


def test_only_the_answer_to_the_present_fence_counts() -> None:
    switch = LaneSwitch(Contract(), large=True)
    assert not switch.fenced(0)
    assert not switch.fenced(1)
    first = switch.fence()
    switch.restart()
    assert not switch.fenced(first), "it was sent over the link before"
    second = switch.fence()
    assert second != first
    assert not switch.fenced(first)
    assert not switch.fenced(second + 1)
    assert switch.fenced(second)
    assert not switch.fenced(second), "answered twice"
    assert switch.lane is BULK


def test_bulk_loss_answers_only_a_bulk_fence() -> None:
    there = LaneSwitch(Contract(), large=True)
    assert not there.lane_lost()
    number = there.fence()
    assert not there.lane_lost(), "what is on the express lane still comes"
    assert there.fencing
    assert there.fenced(number)
    assert not there.lane_lost(), "nothing was waited for"
    back = on_bulk()
    assert [back.judge(SMALL, REST) for _ in range(ROW)][-1]
    number = back.fence()
    assert back.lane_lost()
    assert (back.lane, back.fencing) == (EXPRESS, False)
    assert not back.fenced(number), "an answer that came too late"


def test_new_link_begins_on_the_express_lane() -> None:
    switch = on_bulk()
    switch.restart()
    assert (switch.lane, switch.target, switch.fencing) == (EXPRESS, BULK, False)
    switch.fence()
    switch.restart()
    assert (switch.lane, switch.target, switch.fencing) == (EXPRESS, BULK, False)


class TwoLanes(RuleBasedStateMachine):
    """A sender that follows ``judge``, over two queues that are independently slow."""

    def __init__(self) -> None:
        super().__init__()
        self.switch = LaneSwitch(Contract())
        self.now = 0.0
        self.sent = 0
        self.held: list[int] = []
        self.lanes: dict[Lane, deque[tuple[str, int]]] = {EXPRESS: deque(), BULK: deque()}
        self.answers: deque[int] = deque()
        self.came: list[int] = []

    @rule(
        size=st.sampled_from([0, SMALL, LARGE]),
        count=st.sampled_from([1, 3, ROW + 1]),
        wait=st.sampled_from([0, REST]),
    )
    def publish(self, size: int, count: int, wait: float) -> None:
        self.now += wait
        for _ in range(count):
            self.sent += 1
            if self.switch.fencing:
                self.held.append(self.sent)
            elif self.switch.judge(size, self.now):
                self.held.append(self.sent)
                self.lanes[self.switch.lane].append(("fence", self.switch.fence()))
            else:
                self.lanes[self.switch.lane].append(("message", self.sent))

    @rule(lane=st.sampled_from(Lane), count=st.sampled_from([1, 2, 500]))
    def carry(self, lane: Lane, count: int) -> None:
        for _ in range(min(count, len(self.lanes[lane]))):
            kind, number = self.lanes[lane].popleft()
            if kind == "message":
                self.came.append(number)
            else:
                self.answers.append(number)

    @precondition(lambda self: self.answers)
    @rule()
    def answer(self) -> None:
        if self.switch.fenced(self.answers.popleft()):
            self.go_on()

    @rule()
    def lose_bulk(self) -> None:
        self.lanes[BULK].clear()
        if self.switch.lane_lost():
            self.go_on()

    def go_on(self) -> None:
        self.lanes[self.switch.lane].extend(("message", number) for number in self.held)
        self.held.clear()

    @invariant()
    def nothing_was_overtaken(self) -> None:
        assert self.came == sorted(set(self.came))

    @invariant()
    def nothing_is_held_without_a_fence(self) -> None:
        assert self.switch.fencing or not self.held
        assert (
            not self.switch.fencing
            or self.answers
            or any(kind == "fence" for lane in self.lanes.values() for kind, _ in lane)
        )

    def teardown(self) -> None:
        """Everything comes to rest: nothing is held for ever."""
        for _ in range(3):
            for lane in Lane:
                self.carry(lane, 1 << 30)
            while self.answers:
                self.answer()
        assert not self.switch.fencing
        self.nothing_was_overtaken()
        super().teardown()


TestTwoLanes = TwoLanes.TestCase
TestTwoLanes.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)


@settings(deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.floats(0, 1)), min_size=1, max_size=300))
def test_bulk_lane_is_used_while_large_messages_are_recent(run: list[tuple[bool, float]]) -> None:
    """The target against the words of its docstring, counted by hand."""
    switch = LaneSwitch(Contract())
    now, large_at, row, wanted = 100.0, None, 0, EXPRESS
    for large, gap in run:
        now += gap
        switch.judge(LARGE if large else SMALL, now)
        if large:
            large_at, row, wanted = now, 0, BULK
        elif large_at is not None:
            row += 1
            if row >= ROW and now - large_at >= REST:
                wanted = EXPRESS
        assert switch.target is wanted
