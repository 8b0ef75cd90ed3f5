"""One snapshot for all clients."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

from rmpa.core.errors import UnreachableError
from rmpa.web import limits
from rmpa.web.server.agent_watch import AgentWatch
from tests.web.snapshots import FULL

if TYPE_CHECKING:
    from rmpa.observe.snapshot import Snapshot


class Agent:
    """An agent that a test can stop; counts the questions to it."""

    def __init__(self) -> None:
        self.now = 0.0
        self.up = True
        self.asked = 0
        self.may_answer = threading.Event()
        self.may_answer.set()

    def read(self) -> Snapshot:
        self.asked += 1
        assert self.may_answer.wait(30)
        if not self.up:
            raise UnreachableError("agent", "here", "start it")
        return FULL

    def watch(self) -> AgentWatch:
        return AgentWatch(self.read, lambda: self.now)


async def test_many_clients_cost_the_agent_one_question() -> None:
    agent = Agent()
    watch = agent.watch()
    agent.may_answer.clear()
    asking = [asyncio.create_task(watch.reading()) for _ in range(100)]
    await asyncio.sleep(0)
    agent.may_answer.set()
    assert all(reading.snapshot is FULL for reading in await asyncio.gather(*asking))
    agent.now += limits.WEB_SNAPSHOT_AGE * 0.9
    await watch.reading()
    assert agent.asked == 1
    agent.now += limits.WEB_SNAPSHOT_AGE
    await watch.reading()
    assert agent.asked == watch.reads == 2
    await watch.close()


async def test_a_client_that_leaves_takes_nothing_from_the_others() -> None:
    agent = Agent()
    watch = agent.watch()
    agent.may_answer.clear()
    leaving, staying = (asyncio.create_task(watch.reading()) for _ in range(2))
    await asyncio.sleep(0)
    leaving.cancel()
    await asyncio.sleep(0)
    agent.may_answer.set()
    assert (await staying).snapshot is FULL
    assert agent.asked == 1
    await watch.close()


async def test_an_agent_that_is_away_is_asked_no_more_often_and_found_again() -> None:
    agent = Agent()
    watch = agent.watch()
    agent.up = False
    for _ in range(10):
        reading = await watch.reading()
        assert reading.snapshot is None
        assert "start it" in reading.problem
    assert agent.asked == 1
    agent.up = True
    agent.now += limits.WEB_SNAPSHOT_AGE
    assert (await watch.reading()).snapshot is FULL
    await watch.close()
