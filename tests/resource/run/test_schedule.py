from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.resource.run.descriptor import Schedule, TaskFigures, TaskReport, restart_delay, stuck_after, too_slow


def test_times_are_absolute_whatever_the_work_takes() -> None:
    schedule = Schedule(0.1, 5.0)
    assert [schedule.next_due(now) for now in (5.0, 5.03, 5.19, 5.2)] == pytest.approx([5.0, 5.1, 5.2, 5.3])
    assert schedule.missed == 0


def test_a_time_that_is_a_whole_period_past_is_left_out() -> None:
    schedule = Schedule(0.1, 0.0)
    schedule.next_due(0.0)
    assert schedule.next_due(0.35) == pytest.approx(0.3)
    assert schedule.missed == 2


@given(st.floats(1e-4, 10), st.lists(st.floats(0, 100), max_size=30))
def test_each_due_time_is_met_or_missed(period: float, works: list[float]) -> None:
    schedule = Schedule(period, 0.0)
    now, dues = 0.0, []
    for work in works:
        due = schedule.next_due(now)
        dues.append(due)
        assert due > now - period * 1.000001
        now = max(now, due) + work
    ticks = [round(due / period) for due in dues]
    assert ticks == sorted(set(ticks))
    assert not ticks or schedule.missed == ticks[-1] + 1 - len(ticks)


def test_what_is_measured_of_a_task() -> None:
    figures = TaskFigures(0.1)
    for began, ended in ((0.01, 0.05), (0.12, 0.24), (0.24, 0.25)):
        figures.running_since = began
        figures.ended(ended)
    figures.missed += 2
    figures.dropped += 1
    assert figures.window() == TaskReport(runs=3, overruns=1, missed=2, dropped=1)
    assert figures.window() == TaskReport()


@pytest.mark.parametrize(
    ("report", "period", "text"),
    [
        (TaskReport(runs=10, overruns=1), 0.1, ""),  # once is the machine's business
        (
            TaskReport(runs=10, overruns=2, missed=3),
            0.1,
            "2 of 10 runs took longer than its period of 0.1 s, 3 times left out",
        ),
        (TaskReport(runs=1, overruns=1), 2.0, "1 of 1 runs took longer than its period of 2 s"),
        (TaskReport(runs=5, missed=5), 0.1, ""),  # it was held, it did not overrun
        (TaskReport(runs=4, dropped=7), None, "7 messages of its input gave way to newer ones, 4 were taken"),
        (TaskReport(runs=4), None, ""),
    ],
)
def test_a_task_is_too_slow_if_it_overruns_often(report: TaskReport, period: float | None, text: str) -> None:
    assert too_slow(report, period) == text


def test_failures_are_counted_in_a_row() -> None:
    figures = TaskFigures(None)
    for _ in range(2):
        figures.ended(0.0, failed=True)
    assert figures.in_a_row == 2
    figures.ended(0.0)
    assert figures.in_a_row == 0


def test_who_fails_again_and_again_waits_longer() -> None:
    assert [restart_delay(n) for n in (0, 1, 2, 3, 99)] == [0.1, 0.1, 0.2, 0.4, 5.0]


def test_when_a_run_is_stuck() -> None:
    assert stuck_after(0.1, None) == 5.0
    assert stuck_after(2.0, None) == 20.0
    assert stuck_after(None, None) == 5.0
    assert stuck_after(2.0, 0.5) == 0.5
