"""Throughput is what arrived; what did not is told by the numbers of the messages."""

from __future__ import annotations

import pytest

from lab.bench.throughput import Count, ThroughputScore, Window, lost_between, rate_of


def window(received: float) -> Window:
    return Window(received, 2 * received, 0.5, {}, 0.0)


def test_the_rate_is_of_what_arrived_and_not_of_what_was_sent() -> None:
    first, last = Count(1_000_000_000, 100, 900), Count(3_000_000_000, 300, 9_000)
    assert rate_of(first, last) == 100.0


@pytest.mark.parametrize(("messages", "share"), [(1_000, 0.0), (250, 0.75), (0, 1.0), (1_001, 0.0)])
def test_losses_are_the_numbers_that_never_came(messages: int, share: float) -> None:
    assert lost_between(Count(0, 0, 0), Count(1, messages, 1_000)) == share


def test_the_figures_are_those_of_the_median_round() -> None:
    score = ThroughputScore([window(30.0), window(10.0), window(20.0)])
    assert score.received == 20.0
    assert score.middle.received == 20.0
