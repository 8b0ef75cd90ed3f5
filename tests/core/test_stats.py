"""Figures."""

from __future__ import annotations

import math
import statistics

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.counters import SampleSummary, percentile

SAMPLES = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50)


@given(SAMPLES)
def test_summary_agrees_with_the_standard_library(samples: list[float]) -> None:
    s = SampleSummary.of(samples)
    assert s.mean == pytest.approx(statistics.fmean(samples), abs=1e-6)
    assert s.sd == pytest.approx(statistics.pstdev(samples), abs=1e-3)
    assert (s.count, s.minimum, s.maximum) == (len(samples), min(samples), max(samples))
    assert s.minimum <= s.p50 <= s.p99 <= s.maximum


def test_nothing_gives_nan() -> None:
    s = SampleSummary.of([])
    assert s.count == 0
    assert all(math.isnan(x) for x in (s.mean, s.sd, s.minimum, s.maximum, s.p50, s.p99, percentile([], 5)))


def test_percentiles_are_linear_between_neighbours() -> None:
    assert [percentile([0.0, 10.0], p) for p in (0, 25, 50, 100)] == [0, 2.5, 5, 10]
