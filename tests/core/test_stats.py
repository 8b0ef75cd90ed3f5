"""Figures."""

from __future__ import annotations

import math
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.counters import ArrivalStats, SampleRing, SampleSummary, percentile

SAMPLES = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50)


@given(SAMPLES)
def test_summary_agrees_with_the_standard_library(samples: list[float]) -> None:
    s = SampleSummary.of(samples)
    assert s.mean == pytest.approx(statistics.fmean(samples), abs=1e-6)
    assert s.sd == pytest.approx(statistics.pstdev(samples), abs=1e-3)
    assert (s.count, s.minimum, s.maximum) == (len(samples), min(samples), max(samples))
    assert s.minimum <= s.p50 <= s.p95 <= s.p99 <= s.maximum


def test_nothing_gives_nan() -> None:
    s = SampleSummary.of([])
    assert s.count == 0
    assert all(math.isnan(x) for x in (s.mean, s.sd, s.minimum, s.maximum, s.p50, s.p95, s.p99, percentile([], 5)))


def test_percentiles_are_linear_between_neighbours() -> None:
    assert [percentile([0.0, 10.0], p) for p in (0, 25, 50, 100)] == [0, 2.5, 5, 10]


@given(st.integers(1, 10), st.lists(st.floats(allow_nan=False), max_size=40))
def test_a_ring_keeps_the_last_in_order(size: int, samples: list[float]) -> None:
    ring = SampleRing(size)
    for sample in samples:
        ring.add(sample)
    assert list(ring) == samples[-size:]
    assert (len(ring), ring.total) == (min(size, len(samples)), len(samples))
    ring.clear()
    assert list(ring) == []


def test_a_ring_holds_something() -> None:
    with pytest.raises(ValueError):
        SampleRing(0)


def test_a_flow() -> None:
    flow = ArrivalStats(window=3)
    assert ArrivalStats().last is None
    assert math.isnan(flow.rate())
    for number in range(11):
        flow.arrived(number * 0.5, 100)
    assert (flow.messages, flow.bytes, flow.last) == (11, 1100, 5.0)
    assert flow.rate() == pytest.approx(2)
    assert flow.bandwidth() == pytest.approx(200)
    assert flow.periods().count == 3


def test_a_flow_at_one_moment_has_no_rate() -> None:
    flow = ArrivalStats()
    flow.arrived(1.0, 1)
    flow.arrived(1.0, 1)
    assert math.isnan(flow.rate())
    assert math.isnan(flow.bandwidth())
