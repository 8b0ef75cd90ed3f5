"""Failure detectors in simulated meshes; ``make swim`` measures more of them, at 1,000 members and over 24 hours.

``RMPA_SIMULATION_SEEDS=20`` runs twenty times as many random ones;
``python -m tests.simulation --kind swim --seed N --peers M`` replays one.
"""

from __future__ import annotations

import os

import pytest

from tests.simulation.swim_figures import Deaths, Rest, false_alarms, until_agreed
from tests.simulation.swim_scenario import SwimScenario

FACTOR = int(os.environ.get("RMPA_SIMULATION_SEEDS", "1"))


def settled(count: int, *, seed: int = 1, loss: float = 0.0) -> SwimScenario:
    scenario = SwimScenario(seed, count, loss=loss, delay=(0.0002, 0.003))
    scenario.start()
    scenario.run(3)
    return scenario


@pytest.mark.parametrize("block", range(4 * FACTOR))
def test_small_meshes_agree_after_healing(block: int) -> None:
    for seed in range(block * 5, block * 5 + 5):
        SwimScenario(seed, 8).play()


@pytest.mark.parametrize("seed", range(100, 100 + FACTOR))
def test_a_mesh_of_thirty_agrees_after_healing(seed: int) -> None:
    SwimScenario(seed, 30).play()


def test_one_seed_gives_one_run() -> None:
    first, second = (SwimScenario(7, 6).play() for _ in range(2))
    assert first == second
    assert first.trace_hash != SwimScenario(8, 6).play().trace_hash


def test_a_killed_member_is_known_to_a_hundred_within_five_seconds() -> None:
    scenario = settled(100, loss=0.01)
    for _ in range(4):
        death = Deaths(scenario, [scenario.world.rng.choice(scenario.living())], 6)
        assert death.missed == 0
        assert death.known[0] <= 5.0
    assert scenario.figures.false_failures == 0


def test_a_third_killed_at_once_is_known_to_the_others_and_no_other_is_accused() -> None:
    scenario = settled(90)
    death = Deaths(scenario, scenario.world.rng.sample(scenario.living(), 30), 8)
    assert death.missed == 0
    assert scenario.figures.false_failures == 0
    assert scenario.disagreements() == []


@pytest.mark.parametrize("count", [70, 140])
def test_the_traffic_at_rest_does_not_grow_with_the_mesh(count: int) -> None:
    rest = Rest(settled(count), 5)
    assert rest.packets <= 2.2
    assert rest.bytes <= 250, "with a secured mesh's trailer a third more; 5 KB/s are allowed for everything"


def test_lost_packets_let_no_member_fail() -> None:
    scenario = SwimScenario(3, 16, loss=0.01, delay=(0.0002, 0.02), beacons=0.0)
    scenario.start()
    assert false_alarms(scenario, 600)[1] == 0, scenario.figures.falsely_failed


def test_processes_that_were_stopped_accuse_no_other_and_come_back() -> None:
    scenario = settled(70, loss=0.01)
    rng = scenario.world.rng
    for shortest, longest in ((0.5, 1.2), (2.0, 5.0)):
        stopped = rng.sample(scenario.members, 8)
        for member in stopped:
            member.stop(rng.uniform(shortest, longest))
        scenario.figures.lost_at.clear()
        scenario.run(8)
        lost = scenario.figures.lost_at.keys()
        assert lost <= {member.identity.instance for member in stopped}, "a stopped process accused another one"
        if longest < 1.5:
            assert not lost, "so short a pause is refuted in time"
        assert until_agreed(scenario, 60) < 60


def test_processes_without_cpu_accuse_no_other() -> None:
    scenario = settled(70)
    slow = scenario.world.rng.sample(scenario.members, 5)
    for member in slow:
        member.slow = 2.0
    scenario.run(20)
    assert scenario.figures.lost_at.keys() <= {member.identity.instance for member in slow}
    for member in slow:
        member.slow = 0.0
    assert until_agreed(scenario, 90) < 90


def test_asymmetric_cuts_are_bridged_by_indirect_probes() -> None:
    scenario = settled(70)
    rng = scenario.world.rng
    for member in scenario.members:
        scenario.cut.update((member.number, other.number) for other in rng.sample(scenario.members, 3))
    scenario.run(20)
    assert scenario.figures.lost_at == {}


def test_halves_that_were_parted_agree_again() -> None:
    scenario = settled(70)
    scenario.sides = {member.number: member.number % 2 for member in scenario.members}
    scenario.run(25)
    assert {len(member.members) + 1 for member in scenario.members} == {35}
    scenario.sides = {}
    assert until_agreed(scenario, 90) < 90
