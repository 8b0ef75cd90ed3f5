"""Samples of a plot, thinned."""

from __future__ import annotations

import math

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rmpa.web.monitor.live import SampleBuffer

VALUE = st.none() | st.integers(-1000, 1000).map(float)


def test_few_samples_stay_as_they_are() -> None:
    buffer = SampleBuffer(2)
    buffer.add(1.0, [1.0, None])
    buffer.add(2.0, [math.nan, math.inf])
    assert buffer.take() == [[1.0, 2.0], [1.0, None], [None, None]]
    assert buffer.take() == []


@settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(st.lists(st.tuples(VALUE, VALUE), min_size=40, max_size=150))
def test_the_buffer_is_bounded_and_keeps_the_extremes(rows: list[tuple[float | None, float | None]]) -> None:
    buffer = SampleBuffer(2, most=16)
    for at, row in enumerate(rows):
        buffer.add(float(at), row)
        assert len(buffer) <= 33
    moments, *lines = buffer.take()
    assert len(moments) <= 16
    assert moments == sorted(moments, key=lambda moment: moment or 0.0)
    for number, line in enumerate(lines):
        given = [value for row in rows if (value := row[number]) is not None]
        assert _extremes([value for value in line if value is not None]) == _extremes(given)


def _extremes(values: list[float]) -> tuple[float, float] | None:
    return (min(values), max(values)) if values else None
