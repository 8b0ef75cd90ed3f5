"""Direct transport through lost links, crashes, restarts, collisions and reloads: each subscriber has the right path.

``make test-long`` runs eight times as many (RMPA_SIMULATION_SEEDS);
``python -m tests.simulation --kind direct --seed N`` one.
"""

from __future__ import annotations

import asyncio

import pytest

from tests.simulation.direct_scenario import DirectScenario
from tests.simulation.scenario import FACTOR

BLOCK = 12


@pytest.mark.parametrize("block", range(3 * FACTOR))
def test_each_subscriber_settles_on_the_path_that_the_conditions_ask_for(block: int) -> None:
    for seed in range(block * BLOCK, (block + 1) * BLOCK):
        DirectScenario(seed).play()


def test_a_source_that_is_shown_again_at_once_is_not_left_by_the_list_of_its_end() -> None:
    DirectScenario(1154).play()


def test_a_release_that_was_lost_with_its_link_is_made_again() -> None:
    DirectScenario(416).play()


def test_without_troubles_every_subscriber_of_a_free_name_is_direct() -> None:
    scenario = DirectScenario(1)

    async def story() -> None:
        b, c = scenario.modules
        b.subscribe("/viewer", leaves=True)
        c.subscribe("/logger", leaves=False)
        await asyncio.sleep(1.0)
        scenario.check()
        assert len(list(scenario.there.exporter)) == 4
        # A second node of that name in the other module is relayed, until the first one ends.
        c.subscribe("/viewer", leaves=True)
        await asyncio.sleep(1.0)
        scenario.check()
        assert len(list(scenario.there.exporter)) == 4
        b.unsubscribe("/viewer")
        await asyncio.sleep(3.0)
        scenario.check()
        assert len(list(scenario.there.exporter)) == 3, (
            "the latched source stays relayed until it is subscribed again"
        )

    scenario.play(story)
