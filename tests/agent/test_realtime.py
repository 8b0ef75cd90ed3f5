"""The collector in whole agents, and what they show of ``--realtime``."""

from __future__ import annotations

import asyncio
import gc
import os
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.agent.agent import Agent
from rmpa.config.settings import Settings
from rmpa.config.values import Multicast
from rmpa.observe.control_client import ControlClient
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.node import Node
from rmpa.runtime import limits as runtime_limits

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator
    from pathlib import Path

    from rmpa.observe.snapshot import Snapshot

DEADLINE: Final = 20.0
MESSAGES: Final = 20_000
PER_TURN: Final = 50


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(DEADLINE):
        while not condition():
            await asyncio.sleep(0.005)


@pytest.fixture
def settings(tmp_path: Path) -> Callable[[str], Settings]:
    port = 20000 + os.getpid() % 20000

    def make(name: str) -> Settings:
        return Settings(
            name=name, core_port=0, interfaces=("lo",), multicast=Multicast(port=port), runtime_dir=str(tmp_path)
        )

    return make


@pytest.fixture
async def pair(settings: Callable[[str], Settings]) -> AsyncIterator[tuple[Agent, Agent]]:
    a, b = Agent(settings("a")), Agent(settings("b"))
    await a.start()
    await b.start()
    await until(lambda: len(list(a.bridge.sessions.linked())) == len(list(b.bridge.sessions.linked())) == 1)
    yield a, b
    await b.close()
    await a.close()


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
    pair: tuple[Agent, Agent], collections: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "rmpa.ros.node.node.NODE_MASTER_CHECK", DEADLINE
    )  # two XML-RPC calls a second of our own nodes
    a, b = pair
    async with Node("talker", master_uri=a.core.uri) as talker, Node("hearer", master_uri=b.core.uri) as hearer:
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
        gc.collect(0)
        collections.clear()
        await send(MESSAGES)
        assert collections == []
        assert gc.collect() < 200  # keepalives and timers; the messages left nothing


async def test_garbage_of_control_work_is_collected_while_the_agent_runs(
    pair: tuple[Agent, Agent], collections: list[int]
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
    settings: Callable[[str], Settings],
) -> None:
    before = gc.get_threshold()
    agent = Agent(settings("a"))
    await agent.start()
    assert gc.get_threshold() == runtime_limits.COLLECT_THRESHOLDS
    assert gc.get_freeze_count()
    await agent.close()
    assert gc.isenabled()
    assert gc.get_threshold() == before
    assert gc.get_freeze_count() == 0


def ask(runtime_dir: Path) -> Snapshot:
    with ControlClient(runtime_dir / "a.sock") as client:
        return client.snapshot()
