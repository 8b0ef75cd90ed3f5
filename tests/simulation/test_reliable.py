"""Reliable routes over links that break at every byte: in order, none doubled, none lost unseen.

``make test-long`` runs eight times as many (RMPA_SIMULATION_SEEDS);
``python -m tests.simulation --kind reliable --seed N`` one.
"""

from __future__ import annotations

import os

import pytest

from rmpa.core import limits as core_limits
from rmpa.mesh import limits as mesh_limits
from tests.simulation.reliable_ends import Bounds
from tests.simulation.reliable_scenario import ReliableScenario

FACTOR = int(os.environ.get("RMPA_SIMULATION_SEEDS", "1"))
BLOCK = 25


@pytest.mark.parametrize("block", range(4 * FACTOR))
def test_the_fate_of_every_message_is_known(block: int) -> None:
    for seed in range(block * BLOCK, (block + 1) * BLOCK):
        ReliableScenario(seed).play()


@pytest.mark.parametrize("block", range(2 * FACTOR))
def test_nothing_is_lost_while_it_fits(block: int) -> None:
    for seed in range(block * BLOCK, (block + 1) * BLOCK):
        scenario = ReliableScenario(seed, Bounds())
        scenario.play(("cut", "cut", "replace"))
        assert not scenario.broken


def short(seed: int) -> ReliableScenario:
    """A few messages of one to four fragments, in two portions, so that both are acknowledged."""
    scenario = ReliableScenario(seed, Bounds())
    scenario.world.run(scenario.world.now + 0.05)
    for _ in range(2):
        for size in (0, 50, 8):
            scenario.exporter.publish(size)
        scenario.world.run(scenario.world.now + 3 * mesh_limits.ACK_DELAY)
    return scenario


@pytest.mark.parametrize("trouble", ["cut", "replace", "exporter", "importer"])
@pytest.mark.parametrize("side", ["exporter", "importer"])
def test_failure_at_every_byte_of_message_and_acknowledgement(
    side: str, trouble: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    undisturbed = short(0)
    undisturbed.settle()
    length = undisturbed.read[side]
    assert length > 100
    happened = 0
    start = ReliableScenario.__init__
    points = range(0, length, max(1, 4 // FACTOR))
    for point in points:

        def begin(self: ReliableScenario, seed: int, bounds: Bounds, point: int = point) -> None:
            start(self, seed, bounds)
            self.budget[side] = point
            self.trouble = trouble

        monkeypatch.setattr(ReliableScenario, "__init__", begin)
        scenario = short(0)
        happened += side not in scenario.budget
        scenario.settle()
    assert happened == len(points)


def test_ten_thousand_messages_at_1_khz_across_five_cuts() -> None:
    scenario = ReliableScenario(1, Bounds(depth=1000, max_bytes=1 << 20))
    scenario.world.run(scenario.world.now + 0.1)
    for _ in range(5):
        scenario.flow(1700, 0.001)
        scenario.outage(0.3, rate=1000)
    scenario.settle()
    assert scenario.exporter.published == 10_000
    assert [got.number for got in scenario.importer.lives[0].received] == list(range(10_000))


def test_loss_in_a_long_outage_is_counted_exactly() -> None:
    scenario = ReliableScenario(2, Bounds(depth=100))
    scenario.world.run(scenario.world.now + 0.1)
    for _ in range(3):
        scenario.exporter.publish(64)
        scenario.world.run(scenario.world.now + 0.1)
        scenario.outage(0.3, rate=1000)
        scenario.world.run(scenario.world.now + 0.1)
    scenario.settle()
    life = scenario.importer.lives[0]
    lost = scenario.exporter.published - len(life.received)
    assert [got.gap for got in life.received if got.gap] == [200, 200, 200]
    assert life.gaps == lost == 600


@pytest.mark.parametrize("seconds", [core_limits.RESUME_WINDOW + 1, 600.0])
def test_outage_beyond_the_window_begins_a_new_numbering(seconds: float) -> None:
    scenario = ReliableScenario(3, Bounds())
    scenario.world.run(scenario.world.now + 0.1)
    scenario.exporter.publish(4)
    scenario.world.run(scenario.world.now + 0.1)
    scenario.outage(seconds)
    scenario.world.run(scenario.world.now + 0.1)
    scenario.exporter.publish(4)
    scenario.settle()
    life = scenario.importer.lives[0]
    assert (len(life.epochs), life.gaps) == (2, 0)
    assert [got.gap for got in life.received] == [0, 0]


@pytest.mark.parametrize("seed", range(5))
def test_one_seed_gives_one_run(seed: int) -> None:
    first, second = (ReliableScenario(seed).play() for _ in range(2))
    assert first == second
    assert first.trace_hash != ReliableScenario(seed + 10_000).play().trace_hash


def test_every_trouble_is_met() -> None:
    """The seeds would prove nothing if they led around what is to be proved."""
    scenarios = [ReliableScenario(seed) for seed in range(60)]
    for scenario in scenarios:
        scenario.play()
    lives = [life for scenario in scenarios for life in scenario.importer.lives]
    assert sum(life.gaps > 0 for life in lives) > 6
    assert sum(life.duplicates > 0 for life in lives) > 1
    assert sum(len(life.epochs) > 1 for life in lives) > 6
