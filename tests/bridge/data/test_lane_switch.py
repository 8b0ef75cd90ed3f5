"""The lane switch alone, by its table, and with two lanes that have no common order: no message overtakes another."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.bridge.data.route import BULK, EXPRESS, LaneSwitch
from rmpa.core.contract import Contract, Priority
from rmpa.mesh import limits
from rmpa.mesh.frames import Lane

SMALL = limits.EXPRESS_MESSAGE_MAX
LARGE = SMALL + 1
ROW = limits.EXPRESS_AGAIN_MESSAGES
REST = limits.EXPRESS_AGAIN_AFTER


@pytest.mark.parametrize(
    ("priority", "large", "target"),
    [
        (Priority.HIGH, False, EXPRESS), (Priority.HIGH, True, EXPRESS), (Priority.NORMAL, False, EXPRESS),
        (Priority.NORMAL, True, BULK), (Priority.LOW, False, BULK), (Priority.LOW, True, BULK),
    ],
)  # fmt: skip
def test_a_route_begins_behind_the_word_that_opens_it(priority: Priority, large: bool, target: Lane) -> None:
    switch = LaneSwitch(Contract(priority=priority), large=large)
    assert (switch.lane, switch.target, switch.fencing) == (EXPRESS, target, False)
    assert switch.judge(0, 0.0) is (target is BULK)


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
