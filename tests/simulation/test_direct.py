"""Direct transport through lost links, crashes, restarts, collisions and reloads: each subscriber has the right path.

``make test-long`` runs sixteen times as many (RMPA_SIMULATION_SEEDS);
``python -m tests.simulation --kind direct --seed N`` one.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.paths import Want
from rmpa.bridge.messages import Source
from tests.simulation.direct_modules import SubscriberModule
from tests.simulation.direct_scenario import DirectScenario
from tests.simulation.scenario import FACTOR

BLOCK = 9
CHATTER = Source("/chatter", "/talker")
WANT = Want("/chatter", "/talker", "/viewer")


def after_a_direct_subscriber(story: Callable[[DirectScenario, SubscriberModule], Awaitable[None]]) -> None:
    """Play a story that begins with /viewer of one module connected directly, and ends well."""
    scenario = DirectScenario(1)

    async def played() -> None:
        module = scenario.modules[0]
        module.subscribe("/viewer", leaves=False)
        await asyncio.sleep(3.0)
        scenario.check()
        assert isinstance(module.paths(CHATTER, "/viewer")[0], int)
        await story(scenario, module)

    scenario.play(played)


@pytest.mark.parametrize("block", range(2 * FACTOR))
def test_each_subscriber_settles_on_the_path_that_the_conditions_ask_for(block: int) -> None:
    for seed in range(18 + block * BLOCK, 18 + (block + 1) * BLOCK):
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


def test_one_that_has_waited_for_too_long_is_relayed_and_moved_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "DIRECT_HOLD", 0.0001)

    async def story(_scenario: DirectScenario, module: SubscriberModule) -> None:
        assert module.importer.get(module.here, WANT) is not None

    after_a_direct_subscriber(story)


def test_only_so_many_ask_a_peer_at_a_time() -> None:
    async def story(scenario: DirectScenario, module: SubscriberModule) -> None:
        handlers = scenario.there.rpc.handlers
        answer, asking, most = handlers["direct.topic"], 0, 0

        async def counted(session: Any, args: dict[str, Any]) -> Any:
            nonlocal asking, most
            asking += 1
            most = max(most, asking)
            try:
                return await answer(session, args)
            finally:
                asking -= 1

        handlers["direct.topic"] = counted
        for number in range(60):
            module.subscribe(f"/n{number}", leaves=False)
        await asyncio.sleep(5.0)
        scenario.check()
        assert 1 < most <= limits.DIRECT_ASKS

    after_a_direct_subscriber(story)


@pytest.mark.parametrize("crashed", [False, True])
def test_an_interruption_is_told_and_a_source_is_kept_while_its_agent_alone_is_dead(*, crashed: bool) -> None:
    async def story(scenario: DirectScenario, module: SubscriberModule) -> None:
        scenario.link_down(module, crashed=crashed, gone=False)
        assert module.shown[CHATTER].direct is crashed
        if not crashed:
            count, _, ended = module.importer.interruptions["a", WANT]
            assert (count, ended) == (1, None)
        scenario.link_up(module)
        assert not module.shown[CHATTER].direct
        await asyncio.sleep(5.0)
        scenario.check()
        told = module.importer.interruptions.get(("a", WANT))
        assert told is None if crashed else told is not None and told[2] is not None

    after_a_direct_subscriber(story)


def test_a_connection_to_an_earlier_address_of_the_peer_ends() -> None:
    async def story(_scenario: DirectScenario, module: SubscriberModule) -> None:
        module.peers[module.here].address = "10.1.0.1"  # its next link came by another network
        module.advertised(CHATTER, shown=False)
        await asyncio.sleep(5.0)
        assert module.paths(CHATTER, "/viewer") == []

    after_a_direct_subscriber(story)
