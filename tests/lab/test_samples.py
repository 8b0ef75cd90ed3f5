"""The measurements claim no percentile that their samples do not carry."""

from __future__ import annotations

import pytest

from lab.machine import histogram
from lab.samples import percentile, summary
from lab.usage import Usage, add


def test_nearest_rank() -> None:
    ordered = [float(n) for n in range(1, 101)]
    assert [percentile(ordered, p) for p in (0, 1, 50, 99, 99.9, 100)] == [1, 1, 50, 99, 100, 100]


@pytest.mark.parametrize(("count", "p99", "p999"), [(999, False, False), (1000, True, False), (10_000, True, True)])
def test_percentiles_need_samples_beyond_them(count: int, p99: bool, p999: bool) -> None:
    made = summary([1.0] * count)
    assert (made.p99 is not None, made.p999 is not None) == (p99, p999)


def test_loss_is_counted_and_nothing_is_made_of_no_samples() -> None:
    made = summary([], lost=7)
    assert (made.count, made.lost, made.p50, made.largest) == (0, 7, None, None)


def test_histogram_counts_each_sample_once() -> None:
    classes = histogram([1.0, 20.0, 20.1, 9_999.0, 1e9])
    assert sum(classes.values()) == 5
    assert (classes["≤20"], classes["≤50"], classes[">10000"]) == (2, 1, 1)


def test_spans_of_one_process_add_up() -> None:
    joined = add({"a": Usage(1.0, 2.0, 10)}, {"a": Usage(1.0, 2.0, 30)})
    assert joined["a"] == Usage(2.0, 4.0, 30)
    assert joined["a"].percent == 50.0
