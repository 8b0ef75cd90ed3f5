"""Rosters alone, in thousands of small networks and some large ones.

``make test-long`` runs sixteen times as many; ``python -m tests.simulation --seed N --peers M`` one.
"""

from __future__ import annotations

import pytest

from tests.simulation.scenario import FACTOR, Scenario

BLOCK = 12


@pytest.mark.parametrize("count", [2, 3, 4, 5])
@pytest.mark.parametrize("block", range(FACTOR))
def test_small_networks_agree_after_healing(count: int, block: int) -> None:
    for seed in range(block * BLOCK, (block + 1) * BLOCK):
        Scenario(seed, count).play()


@pytest.mark.parametrize("block", range(2 * FACTOR))
def test_networks_of_ten_agree_after_healing(block: int) -> None:
    for seed in range(block * 3, (block + 1) * 3):
        Scenario(seed, 10).play()


@pytest.mark.parametrize("seed", range(2, 2 + FACTOR, 2))
def test_networks_of_thirty_agree_after_healing(seed: int) -> None:
    Scenario(seed, 30).play()


@pytest.mark.parametrize("seed", range(2))
def test_one_seed_gives_one_run(seed: int) -> None:
    first, second = (Scenario(seed, 4).play() for _ in range(2))
    assert first == second
    assert first.trace_hash != Scenario(seed + 1000, 4).play().trace_hash
