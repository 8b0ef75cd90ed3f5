"""Down-sampling: the rate is kept over every window, and the period is steady."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rmpa.bridge.data.route import Downsampler
from rmpa.core import limits as core_limits

RATES = st.sampled_from([core_limits.CONTRACT_RATE_MIN, 0.5, 1.0, 10.0, 30.0, 1000.0, core_limits.CONTRACT_RATE_MAX])
SLACK = 0.6
"""Intervals by which the messages of a window may be nearer together: one that was half an interval late and is
followed on the beat, and the tenth by which one may be early."""


def admitted(throttle: Downsampler, times: list[float]) -> list[float]:
    """Those of some times at which a message goes, none of which waits."""
    return [now for now in times if throttle.admit(now)]


@settings(deadline=None)
@given(RATES, st.lists(st.floats(0, 3), min_size=1, max_size=120))
@example(10.0, [0.4] + [0.49, 0.51] * 20)
@example(30.0, [0.9] * 50)
def test_no_window_has_more_than_its_rate(rate: float, gaps: list[float]) -> None:
    """Each gap in intervals; every window between two admitted messages is looked at."""
    now, times = 5.0, []
    for gap in gaps:
        now += gap / rate
        times.append(now)
    went = admitted(Downsampler(rate), times)
    for first in range(len(went)):
        for last in range(first + 1, len(went)):
            assert last - first <= (went[last] - went[first]) * rate + SLACK + 1e-3


@settings(deadline=None)
@given(RATES, st.lists(st.floats(0.001, 0.2), min_size=200, max_size=200))
def test_fast_source_is_sent_at_the_full_rate(rate: float, gaps: list[float]) -> None:
    now, times = 5.0, []
    for gap in gaps:
        now += gap / rate
        times.append(now)
    went = admitted(Downsampler(rate), times)
    spent = (times[-1] - times[0]) * rate
    assert len(went) >= int(spent), "the beat is kept, not begun anew at each message that is a little late"
    for one, other in pairwise(went):
        assert 0.69 <= (other - one) * rate <= 1.31


@pytest.mark.parametrize("rate", [0.1, 30.0, 100.0, 1000.0])
@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.04])
def test_a_source_at_the_same_rate_loses_nothing(rate: float, jitter: float) -> None:
    """Early and late by turns: two clocks of one rate must not lose every other message."""
    times = [(n + (jitter if n % 2 else -jitter)) / rate for n in range(1, 1000)]
    assert len(admitted(Downsampler(rate), times)) == len(times)


def test_period_begins_anew_after_a_pause() -> None:
    throttle = Downsampler(10.0)
    assert throttle.admit(0.0)
    assert throttle.due == pytest.approx(0.1)
    assert throttle.admit(100.0)
    assert throttle.due == pytest.approx(100.1)
    assert admitted(throttle, [100.0 + n / 100 for n in range(31)]) == pytest.approx([100.09, 100.19, 100.29])


def test_message_is_admitted_when_due() -> None:
    throttle = Downsampler(3.0)
    assert throttle.admit(0.123)
    for _ in range(10_000):
        assert not throttle.admit(throttle.due - 0.2 / 3.0)
        assert throttle.admit(throttle.due)
