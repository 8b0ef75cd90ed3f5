"""The rate of each topic, measured where it is published: asked of all agents while a page shows the topics."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import msgspec

from rmpa.bridge.topics.rates import TopicRate
from rmpa.core.errors import RmpaError
from rmpa.runtime.tasks import OwnedTasks
from rmpa.web.monitor import limits
from rmpa.web.monitor.state import steady_entry

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.monitor.messages import Tree

_TOLD = dict[str, tuple[TopicRate, ...] | str]


class RatesFeed:
    """Asks every ``limits.RATES_PERIOD``, and not at all ``limits.LOOK_KEPT`` after the last look.

    Args:
        ask: The agent's operation ``rates``.
        clock: Monotonic seconds.
    """

    def __init__(self, ask: Callable[[], Awaitable[Any]], clock: Callable[[], float] = time.monotonic) -> None:
        self._ask = ask
        self._clock = clock
        self._asked = -1e9
        self._tasks = OwnedTasks()
        # By module, the rates of its topics by their names there; or why they are not known.
        self._rates: dict[str, dict[str, TopicRate] | str] = {}
        self._entries: dict[str, Tree] = {}

    async def close(self) -> None:
        """End."""
        await self._tasks.close()

    def look(self, snapshot: Snapshot) -> Tree:
        """By topic its ``rate`` and ``bandwidth``, and ``how`` they were measured, or why they were not."""
        now = self._clock()
        if now - self._asked > limits.LOOK_KEPT:
            self._rates, self._entries = {}, {}
        if now - self._asked >= limits.RATES_PERIOD and not self._tasks:
            self._asked = now
            self._tasks.start(self._read(), "read the rates of topics")
        own = snapshot.agent.name
        entries = {}
        for topic in snapshot.topics[: limits.TOPICS_SHOWN]:
            sources = {(own, topic.name)} if topic.publishers else set()
            sources |= {(each.peer, each.wire or topic.name) for each in topic.routes if each.direction == "in"}
            if found := [one for module, name in sources if (one := self._of(module, name)) is not None]:
                entries[topic.name] = steady_entry(self._entries.get(topic.name), _entry(found))
        self._entries = entries
        return {**entries}

    def _of(self, module: str, name: str) -> TopicRate | None:
        told = self._rates.get(module)
        return TopicRate(name, None, None, told) if isinstance(told, str) else (told or {}).get(name)

    async def _read(self) -> None:
        try:
            told = msgspec.convert(await self._ask(), _TOLD)
        except (RmpaError, msgspec.ValidationError) as error:
            told = dict.fromkeys(self._rates, str(error))
        self._rates = {
            module: rates if isinstance(rates, str) else {one.topic: one for one in rates}
            for module, rates in told.items()
        }


def _entry(found: list[TopicRate]) -> Tree:
    """Of one topic's sources in all modules; those that are measured count."""
    measured = [one for one in found if one.rate is not None]
    entry: Tree = {"how": (measured or found)[0].how}
    for name in ("rate", "bandwidth") if measured else ():
        entry[name] = sum(getattr(one, name) or 0.0 for one in measured)
    return entry
