"""Rosters with links: after the network healed every pair has exactly one link with both lanes, agreed by both ends.

``make test-long`` runs sixteen times as many (RMPA_SIMULATION_SEEDS);
``python -m tests.simulation --kind mesh --seed N --peers M`` one.
"""

from __future__ import annotations

import pytest

from rmpa.mesh import limits
from tests.simulation.mesh_peer import MeshPeer
from tests.simulation.mesh_scenario import MeshScenario, RestsScenario
from tests.simulation.network import Weather
from tests.simulation.scenario import FACTOR

pytestmark = pytest.mark.timeout(300)  # seconds of computing, beside parts of the suite that compute too

BLOCK = 4
BLOCKS = [(count, block) for count, blocks in ((2, 2), (3, 1), (4, 1), (5, 1)) for block in range(blocks * FACTOR)]


@pytest.mark.parametrize(("count", "block"), BLOCKS)
def test_small_networks_are_linked_after_healing(count: int, block: int) -> None:
    for seed in range(block * BLOCK, (block + 1) * BLOCK):
        MeshScenario(seed, count).play()


@pytest.mark.parametrize("count", [2, 3])
def test_links_that_rest_and_wake_are_whole_after_healing(count: int) -> None:
    for seed in range(2 * FACTOR):
        RestsScenario(seed, count).play()


@pytest.mark.parametrize("count", [10, pytest.param(20, marks=pytest.mark.long)])
@pytest.mark.parametrize("seed", range(0, FACTOR, 2))
def test_large_networks_are_linked_after_healing(seed: int, count: int) -> None:
    MeshScenario(seed, count).play()


@pytest.mark.parametrize("count", [2, 3, 5])
@pytest.mark.parametrize("seed", range(2 * FACTOR))
def test_where_both_can_dial_one_side_dialled_both_lanes(seed: int, count: int) -> None:
    MeshScenario(seed, count, calm=True).play()


@pytest.mark.parametrize("seed", range(2 * FACTOR))
def test_crossing_dials_leave_one_link(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.mesh.peering.DIAL_FALLBACK", 0.0)  # the higher GUID does not wait: calls cross
    scenario = MeshScenario(seed, 3, keep=True, calm=True)
    scenario.network.weather = Weather(delay=(0.1, 0.3))
    scenario.network.slowness = (1.0,)
    with scenario.simulated():
        for peer in scenario.peers:
            scenario.world.after(0, peer.start)
        scenario.world.run(scenario.world.now + 25)
        crossed = [line for line in scenario.world.lines if "> dials" in line]
        assert len(crossed) > 3, "no calls crossed"
        scenario.check()
    # The bye on one connection may overtake the welcome on the other; nothing else makes a link fall here.
    fell = [line for line in scenario.world.lines if " down " in line]
    assert all("replaced" in line or "linked already" in line for line in fell), fell


def living(scenario: MeshScenario) -> list[MeshPeer]:
    return [peer for peer in scenario.peers if peer.alive]


def links(scenario: MeshScenario) -> list[int]:
    return [len(peer.mesh.links()) for peer in living(scenario)]


def test_a_mesh_of_twenty_loses_only_the_module_that_was_switched_off() -> None:
    scenario = MeshScenario(1, 20, keep=True, calm=True)
    scenario.network.segments = {peer.host: 1 for peer in scenario.peers}
    scenario.network.weather = Weather(loss=0.01)
    world, (off, *others) = scenario.world, scenario.peers
    with scenario.simulated():
        for peer in scenario.peers:
            peer.seeds, peer.multicast = (), True
            peer.start()
        world.run(world.now + 30)
        before = scenario.network.datagrams
        world.run(world.now + 20)
        assert scenario.network.datagrams - before < 20 * 20 * 20 / 4, "a heartbeat in five seconds"
        assert links(scenario) == [19] * 20
        scenario.network.sides = {off.host: 1}
        world.run(world.now + 22)
        assert links(scenario) == [0] + [18] * 19, "a lease of beacons, and what the check of a link takes"
        assert not any(off.identity in peer.view() for peer in others)
        lost = [line.split() for line in world.lines if "= lost" in line]
        assert {who for _, who, *_ in lost} == {peer.name for peer in scenario.peers}
        assert all((who == off.name) is (what[2] != off.name) for _, who, *what in lost), lost


def test_a_full_mesh_refuses_one_more_undisturbed_until_a_place_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MODULES_MAX", 6)
    scenario = MeshScenario(1, 7, calm=True)
    scenario.network.segments = {peer.host: 1 for peer in scenario.peers}
    world, (*members, extra) = scenario.world, scenario.peers
    with scenario.simulated():
        for peer in scenario.peers:
            peer.seeds, peer.multicast = (), True
        for peer in members:
            peer.start()
        world.run(world.now + 10)
        extra.start()
        world.run(world.now + 30)
        assert links(scenario) == [5] * 6 + [0]
        members[0].kill()
        world.run(world.now + 45)
        assert links(scenario) == [5] * 6, "a lease of the killed one, one of its beacons, and a pause of the dial"
