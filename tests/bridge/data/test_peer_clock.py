"""The history of a peer's clock."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.data.quality import PeerClockHistory
from rmpa.mesh import limits as mesh_limits


def test_estimates_are_kept_in_order() -> None:
    clock = PeerClockHistory()
    for second in range(3):
        clock.add(1.0, 0.01, float(second))
    assert list(clock.estimates) == [(float(second), 1.0, 0.01) for second in range(3)]


def test_a_clock_that_was_set_makes_all_before_void() -> None:
    clock = PeerClockHistory()
    clock.add(1.0, 0.01, 0.0)
    clock.add(1.019, 0.01, 1.0)  # within both bounds
    assert clock.trusted_from < 0
    clock.add(1.5, 0.01, 2.0)
    assert list(clock.estimates) == [(2.0, 1.5, 0.01)]
    assert clock.trusted_from == 2.0


def test_drift_is_no_setting() -> None:
    clock = PeerClockHistory()
    clock.add(0.0, 0.0, 0.0)
    clock.add(3600 * mesh_limits.CLOCK_DRIFT, 0.0, 3600.0)
    assert len(clock.estimates) == 2


def test_better_of_two_near_estimates_is_kept() -> None:
    clock = PeerClockHistory()
    for now, error in ((0.0, 0.01), (0.1, 0.002), (0.2, 0.01), (0.3, 0.001), (1.5, 0.01)):
        clock.add(1.0, error, now)
    assert [now for now, _, _ in clock.estimates] == [0.0, 0.3, 1.5]


@given(st.lists(st.floats(0.001, 3.0), max_size=300))
def test_a_minute_is_remembered_however_often_it_is_told(steps: list[float]) -> None:
    clock, now = PeerClockHistory(), 0.0
    for step in steps:
        now += step
        clock.add(0.0, 0.001, now)
    times = [now for now, _, _ in clock.estimates]
    assert times == sorted(times)
    assert len(times) <= limits.QUALITY_CLOCKS
    if len(times) == limits.QUALITY_CLOCKS:
        assert now - times[0] > 0.9 * limits.QUALITY_SPAN
