"""Rosters with links: after the network healed every pair has exactly one live link, agreed by both ends.

``RMPA_SIMULATION_SEEDS=20`` runs twenty times as many;
``python -m tests.simulation --kind mesh --seed N --peers M`` one.
"""

from __future__ import annotations

import os

import pytest

from tests.simulation.mesh_scenario import MeshScenario

FACTOR = int(os.environ.get("RMPA_SIMULATION_SEEDS", "1"))
BLOCK = 25


@pytest.mark.parametrize("count", [2, 3, 4, 5])
@pytest.mark.parametrize("block", range(4 * FACTOR))
def test_small_networks_are_linked_after_healing(count: int, block: int) -> None:
    for seed in range(block * BLOCK, (block + 1) * BLOCK):
        MeshScenario(seed, count).play()


@pytest.mark.parametrize("seed", range(4 * FACTOR))
def test_networks_of_ten_are_linked_after_healing(seed: int) -> None:
    MeshScenario(seed, 10).play()


@pytest.mark.parametrize("seed", range(FACTOR))
def test_a_network_of_fifty_is_linked_after_healing(seed: int) -> None:
    MeshScenario(seed, 50).play()


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("seed", range(10))
def test_where_both_can_dial_the_lower_guid_did(seed: int, count: int) -> None:
    MeshScenario(seed, count, calm=True).play()


@pytest.mark.parametrize("seed", range(5))
def test_one_seed_gives_one_run(seed: int) -> None:
    first, second = (MeshScenario(seed, 4).play() for _ in range(2))
    assert first == second
