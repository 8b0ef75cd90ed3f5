"""The lane switch alone, by its table, and with two lanes that have no common order: no message overtakes another."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.bridge.data.route import BULK, EXPRESS, LaneSwitch
from rmpa.core.contract import Contract, Priority
from rmpa.mesh import limits

if TYPE_CHECKING:
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
