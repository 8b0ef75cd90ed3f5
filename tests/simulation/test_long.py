"""A mesh at rest with lost packets; ``make soak-swim`` plays 24 hours of it.

``python -m tests.simulation --kind long --hours H --peers N --seed S`` plays one.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.simulation.long_scenario import LongFigures, LongScenario

pytestmark = pytest.mark.timeout(600)


def play(seed: int, *, loss: float = 0.01, hours: float = 0.6) -> LongFigures:
    return replace(LongScenario(seed, 5, loss=loss, hours=hours).play(), cpu=0.0, rss_mb=0.0)


def test_lost_packets_cost_no_module_its_membership_and_a_killed_one_is_noticed() -> None:
    figures = play(1)
    assert figures.lost_falsely == 0, figures.falsely
    assert (figures.killed, figures.missed) == (1, 0)
    assert 0 < figures.noticed_worst < 10
    assert 0 < figures.bytes < 5000


def test_a_network_that_loses_nearly_all_shows_in_the_figures() -> None:
    figures = play(1, loss=0.9, hours=0.05)
    assert figures.lost_falsely > 0
    assert figures.falsely


def test_one_seed_gives_one_run() -> None:
    assert play(2) == play(2) != play(3)
