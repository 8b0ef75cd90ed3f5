from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.timers import Schedule


def test_times_are_absolute_whatever_the_work_takes() -> None:
    schedule = Schedule(0.1, 5.0)
    dues = [schedule.next_due(now) for now in (5.0, 5.03, 5.19, 5.2)]
    assert [due for due, _ in dues] == pytest.approx([5.0, 5.1, 5.2, 5.3])
    assert not any(missed for _, missed in dues)


@given(st.floats(1e-4, 10), st.lists(st.floats(0, 100), max_size=30))
def test_each_due_time_is_met_or_missed(period: float, works: list[float]) -> None:
    schedule = Schedule(period, 0.0)
    now, dues, missed = 0.0, [], 0
    for work in works:
        due, late = schedule.next_due(now)
        dues.append(due)
        missed += late
        assert due > now - period * 1.000001
        now = max(now, due) + work
    ticks = [round(due / period) for due in dues]
    assert ticks == sorted(set(ticks))
    assert not ticks or missed == ticks[-1] + 1 - len(ticks)
