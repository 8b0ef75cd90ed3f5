"""How often agents without work wake up: linked ones run through minutes, of which only the wake-ups are lived."""

from __future__ import annotations

import asyncio
import time
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.runtime import loop as event_loop
from rmpa.runtime.loop import AgentLoop, DirectSelector
from tests.agent.test_agent import running

if TYPE_CHECKING:
    import selectors
    from collections.abc import Callable

    from rmpa.config.settings import Settings

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
