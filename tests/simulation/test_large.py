"""A mesh above the size of a full one: the real machines of every agent, on a simulated network.

``python -m tests.simulation --kind thousand --seed N --peers M`` plays one of any size; ``make bench ARGS=thousand``
one of a thousand.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.simulation.large_scenario import Figures, LargeScenario

MODULES = 70


def play(seed: int, count: int = MODULES) -> Figures:
    figures = LargeScenario(seed, count, settle=30.0).play()
    return replace(figures, cpu=0.0, start_cpu=0.0, rest_cpu_percent=0.0, rss_mb=0.0)


@pytest.mark.timeout(600)
def test_a_large_mesh_agrees_soon_and_costs_little_at_rest() -> None:
    figures = play(1)
    assert figures.graphs_after is not None
    assert figures.graphs_after < 10, "each knows every other one's topics"
    assert figures.links_made <= MODULES * (MODULES - 1) // 2 + MODULES
    assert figures.links_at_rest <= 4 * MODULES, "links that nothing uses are parked"
    assert figures.rest_bytes < 5000
    assert figures.suspected_at_rest == figures.lost_falsely == 0
    assert figures.changed_after is not None
    assert figures.changed_after < 10
    assert all(seconds is not None and seconds < 10 for seconds in figures.one_killed), figures.one_killed
    assert figures.killed_all is not None
    assert figures.killed_all < 30


@pytest.mark.timeout(600)
def test_restarts_and_a_partition_take_no_living_module_away() -> None:
    figures = LargeScenario(1, MODULES, settle=30.0, parts=("churn", "partition")).play()
    assert figures.lost_falsely == 0
    assert figures.churn_after is not None
    assert figures.churn_after < 16, "10 s of restarts, and what the last one takes"
    assert figures.parted_lost is not None
    assert figures.parted_lost < 12, "a link at rest of a suspected member is checked; leases are 16 s and more"
    assert figures.healed_after is not None
    assert figures.healed_after < 10


@pytest.mark.timeout(600)
def test_one_seed_gives_one_run() -> None:
    assert play(3, 12) == play(3, 12) != play(4, 12)
