"""A large mesh: the real machines of every agent, on a simulated network.

``python -m tests.simulation --kind large --seed N --peers 256`` plays one of the largest.
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from rmpa.mesh import limits
from tests.simulation.large_scenario import Figures, LargeScenario

MODULES = 40
ALL_LINKS = MODULES * (MODULES - 1) // 2


def play(seed: int, count: int = MODULES) -> Figures:
    figures = LargeScenario(seed, count).play()
    return replace(figures, cpu=0.0, start_cpu=0.0, rest_cpu_percent=0.0, rss_mb=0.0)


@pytest.mark.timeout(600)
def test_a_large_mesh_agrees_soon_and_costs_little_at_rest() -> None:
    figures = play(1)
    assert figures.graphs_after is not None
    assert figures.graphs_after < 10, "each knows every other one's topics"
    assert figures.links_made == figures.links_at_rest == ALL_LINKS
    assert figures.rest_bytes < 2000
    assert figures.lost_falsely == 0
    assert figures.changed_after is not None
    assert figures.changed_after < 1
    assert all(seconds is not None and seconds < 18 for seconds in figures.one_killed), figures.one_killed
    assert figures.killed_all is not None
    assert figures.killed_all < 18, "a lease of beacons, and what the check of a link takes"


@pytest.mark.timeout(600)
def test_restarts_and_a_partition_take_no_living_module_away() -> None:
    figures = LargeScenario(1, MODULES, parts=("churn", "partition")).play()
    assert figures.lost_falsely == 0
    assert figures.churn_after is not None
    assert figures.churn_after < 16, "10 s of restarts, and what the last one takes"
    assert figures.parted_lost is not None
    assert figures.parted_lost < 25
    assert figures.healed_after is not None
    assert figures.healed_after < 10


def test_a_full_mesh_refuses_one_more_undisturbed_until_a_place_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MODULES_MAX", 12)
    figures = LargeScenario(1, 12, parts=("surplus",)).play()
    assert (figures.surplus_links, figures.surplus_others) == (0, 12 * 11 // 2)
    assert figures.links_made == 12 * 11 // 2
    assert figures.surplus_joined is not None
    assert figures.surplus_joined < 45, (
        "a lease of the killed one's link, one of its beacons, and a pause of the dial"
    )


@pytest.mark.timeout(600)
def test_one_seed_gives_one_run() -> None:
    assert play(3, 12) == play(3, 12) != play(4, 12)
