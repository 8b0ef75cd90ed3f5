"""An agent that sleeps, and one without pauses for garbage."""

from __future__ import annotations

import asyncio
import gc
import time
from functools import partial
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.ros.http.rpc import call_api
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime import loop as event_loop
from rmpa.runtime.loop import AgentLoop, DirectSelector
from tests.agent.test_agent import DEADLINE, node, running, until

if TYPE_CHECKING:
    import selectors
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


_SETTLED: Final = 60.0
"""Seconds after the links are up: they rest, and the burst of beacons is over."""
_SPAN: Final = 60.0
_WAKEUPS_MAX: Final = 3.0
"""A second, of each agent; it measures 2.2. In one process they share some wake-ups, so an agent alone may have 5."""
_MOMENT: Final = 0.002
"""Seconds in which what another agent has written arrives, and the result of a thread."""


class LeapingSelector(DirectSelector):
    """Leaps over the time in which it would wait for a timer, and counts these waits."""

    ahead = 0.0
    leaps = False
    wakeups = 0

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if not self.leaps or timeout is None or timeout <= 0:
            return super().select(timeout)
        LeapingSelector.wakeups += 1
        begun = time.monotonic()
        ready = super().select(min(timeout, _MOMENT))
        if not ready and timeout > _MOMENT and not self._called:
            LeapingSelector.ahead += max(0.0, timeout - (time.monotonic() - begun))
        return ready

    _called = False

    def _call(self, events: list[tuple[int, int]]) -> list[tuple[int, int]]:
        self._called = bool(events)
        return super()._call(events)


async def leap(seconds: float) -> float:
    """Let so much time go by; return the wake-ups in each second of it."""
    LeapingSelector.wakeups, LeapingSelector.leaps = 0, True
    begun = time.monotonic()
    try:
        await asyncio.sleep(seconds)
    finally:
        LeapingSelector.leaps = False
    return LeapingSelector.wakeups / (time.monotonic() - begun)


@pytest.fixture
def _leaping(monkeypatch: pytest.MonkeyPatch) -> None:
    monotonic = time.monotonic
    monkeypatch.setattr(LeapingSelector, "ahead", 0.0)
    monkeypatch.setattr(time, "monotonic", lambda: monotonic() + LeapingSelector.ahead)
    monkeypatch.setattr(event_loop, "DirectSelector", LeapingSelector)


@pytest.mark.usefixtures("_leaping")
def test_agents_without_work_sleep(settings: Callable[..., Settings]) -> None:
    async def main() -> tuple[float, int]:
        names = ("a", "b", "c", "d")
        async with running(*(settings(name) for name in names)) as agents:
            await leap(_SETTLED)
            woken = await leap(_SPAN)
            return woken / len(agents), sum(len(list(agent.bridge.sessions.linked())) for agent in agents)

    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        woken, links = runner.run(main())
    assert links == 12, "they are still linked"
    assert woken <= _WAKEUPS_MAX
