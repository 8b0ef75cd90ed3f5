"""The collector in whole agents, and what they show of ``--realtime``."""

from __future__ import annotations

import asyncio
import gc
from functools import partial
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.ros.http.rpc import call_api
from rmpa.runtime import limits as runtime_limits
from tests.agent.test_agent import DEADLINE, node, running, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings

MESSAGES: Final = 10_000
PER_TURN: Final = 50


@pytest.fixture
async def pair(settings: Callable[..., Settings]) -> AsyncIterator[list[Agent]]:
    async with running(settings("a"), settings("b")) as agents:
        yield agents


@pytest.fixture
def collections() -> Iterator[list[int]]:
    """The generation of each collection from now on."""
    seen: list[int] = []

    def note(phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            seen.append(info["generation"])

    gc.callbacks.append(note)
    yield seen
    gc.callbacks.remove(note)


async def test_no_collection_runs_while_messages_flow(
    pair: list[Agent], collections: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "rmpa.ros.node.node.NODE_MASTER_CHECK", DEADLINE
    )  # two XML-RPC calls a second of our own nodes
    a, b = pair
    async with node("talker", a) as talker, node("hearer", b) as hearer:
        heard = sent = 0

        def hear(_: object) -> None:
            nonlocal heard
            heard += 1

        publisher = await talker.advertise("/chatter", "std_msgs/String")
        subscriber = await hearer.subscribe("/chatter", "std_msgs/String", hear)
        await until(lambda: publisher.subscribers and subscriber.publishers)
        message = publisher.make({"data": "x" * 64})

        async def at_most_waiting(count: int) -> None:
            await until(lambda: heard >= sent - count)

        async def send(count: int) -> None:
            nonlocal sent
            for _ in range(count // PER_TURN):
                for _ in range(PER_TURN):
                    publisher.publish(message)
                sent += PER_TURN
                await at_most_waiting(0)
            await at_most_waiting(0)

        await send(1000)  # what is made at the first message has come to stay
        await asyncio.sleep(0.5)
        gc.collect()
        collections.clear()
        await send(MESSAGES)
        assert collections == []
        assert gc.collect() < 200  # keepalives and timers; the messages left nothing


async def test_garbage_of_control_work_is_collected_while_the_agent_runs(
    pair: list[Agent], collections: list[int]
) -> None:
    a, _ = pair
    gc.collect()
    collections.clear()
    objects = len(gc.get_objects())
    for _ in range(1000):
        await call_api(a.core.uri, "getPid", "/somebody")  # a connection each: a cycle of asyncio's own
    assert len(gc.get_objects()) < objects + 3 * runtime_limits.COLLECT_THRESHOLDS[0]
    assert len(collections) >= 2
    assert 2 not in collections


async def test_the_collector_is_the_interpreters_again_when_the_agent_ends(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    before, done = gc.get_threshold(), list[str]()
    for name in ("freeze", "unfreeze"):
        monkeypatch.setattr(gc, name, partial(done.append, name))
    async with running(settings("a")):
        assert (gc.get_threshold(), done) == (runtime_limits.COLLECT_THRESHOLDS, ["freeze"])
    assert (gc.isenabled(), gc.get_threshold(), done) == (True, before, ["freeze", "unfreeze"])
