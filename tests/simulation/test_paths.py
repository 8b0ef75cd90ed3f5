"""Triangles and squares of modules and relays, with cables plugged and pulled at random.

``make test-long`` plays sixteen times as many runs, and ten minutes of each.
"""

from __future__ import annotations

import pytest

from tests.simulation.paths_scenario import play
from tests.simulation.scenario import FACTOR

BLOCK = 8


@pytest.mark.parametrize("relays", [1, 2])
@pytest.mark.parametrize("block", range(FACTOR))
def test_what_is_lost_is_told_and_nothing_comes_twice(block: int, relays: int) -> None:
    for seed in range(2 + block * BLOCK, 2 + (block + 1) * BLOCK):
        play(seed, relays=relays)


@pytest.mark.parametrize("seed", range(0, FACTOR, 2))
def test_ten_minutes_of_three_relays(seed: int) -> None:
    play(1000 + seed, relays=3, seconds=600.0)
