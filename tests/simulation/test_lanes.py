"""Messages over simulated meshes: whole and in order whatever breaks, and all of them once it is whole again.

The legs, lanes, links and flows are the agent's own; ``make test-long`` runs eight times as many;
``python -m tests.simulation --kind lanes --seed N --peers M`` one.
"""

from __future__ import annotations

import pytest

from rmpa.core.contract import Priority, Reliability
from tests.simulation.lanes_scenario import LanesScenario
from tests.simulation.point_scenario import TROUBLES, Course, PointScenario
from tests.simulation.scenario import FACTOR

BLOCK = 6
BLOCKS = [(count, block) for count, blocks in ((2, 3), (3, 1)) for block in range(blocks * FACTOR)]


@pytest.mark.parametrize(("count", "block"), BLOCKS)
def test_healed_network_delivers_all_in_order(count: int, block: int) -> None:
    breaks = 0
    for seed in range(block * BLOCK, (block + 1) * BLOCK):
        scenario = LanesScenario(seed, count)
        scenario.play()
        breaks += scenario.breaks
    assert breaks <= 1, "links seldom cross so that a peer has to begin anew"


@pytest.mark.parametrize("count", [2, 3])
def test_where_nothing_breaks_every_message_arrives(count: int) -> None:
    for seed in range(15 * FACTOR // count):
        LanesScenario(seed, count, calm=True).play()


COURSES = [
    Course(reliability, priority, in_parts)
    for in_parts in (True, False)
    for reliability in Reliability
    for priority in (Priority.LOW, Priority.HIGH)
]
LENGTH = 5 * 24 + 312
"""Bytes on the wire of the message in fragments."""


@pytest.mark.parametrize("course", COURSES)
def test_undisturbed_it_arrives_in_as_many_bytes(course: Course) -> None:
    scenario = PointScenario(course, "", 1 << 30)
    scenario.run()
    assert scenario.carried >= LENGTH


@pytest.mark.parametrize("trouble", TROUBLES)
def test_failure_at_every_byte_leaves_no_half_message(trouble: str) -> None:
    """Every fourth byte meets one of the courses; with more seeds each byte does, and more of them."""
    for point in range(TROUBLES.index(trouble), LENGTH, len(TROUBLES) * max(1, 4 // FACTOR)):
        for turn in range(min(max(1, FACTOR // 4), len(COURSES))):
            PointScenario(COURSES[(point // len(TROUBLES) + turn) % len(COURSES)], trouble, point).run()
