"""What all pages of the monitor share: the state of the mesh, made of each snapshot once, and what pages ask."""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from typing import TYPE_CHECKING, Any

import msgspec

from rmpa.bridge.topics.rates import TopicRate
from rmpa.core.errors import RmpaError
from rmpa.runtime.tasks import OwnedTasks, end_tasks, keep_task
from rmpa.web import limits as web_limits
from rmpa.web.monitor import limits
from rmpa.web.monitor.diagnostics import DiagnosticsFeed
from rmpa.web.monitor.driving import Sticks
from rmpa.web.monitor.questions import Answers
from rmpa.web.monitor.resources import ResourceWatch
from rmpa.web.monitor.state import StateBuilder, details, steady_entry

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.hub.hub import Hub
    from rmpa.web.monitor.messages import Tree
    from rmpa.web.server.agent_watch import AgentWatch, Reading


class Monitor:
    """Follows the mesh for all pages.

    Args:
        hub: Subscribes, and calls services.
        watch: Asks the agent.
        environ: Says where the agents' sockets are; the process's environment unless it is given.
        agent: The agent's name; ``None``: the one that answers.
        folder: Where the files that describe this module's resources are; empty for none.
    """

    # More than 12 fields: the parts, each once, and the last state.
    def __init__(
        self,
        hub: Hub,
        watch: AgentWatch,
        environ: Mapping[str, str] | None = None,
        agent: str | None = None,
        folder: str = "",
    ) -> None:
        self._hub = hub
        self._watch = watch
        self._named = agent or ""
        self._builder = StateBuilder("")
        self._snapshot: Snapshot | None = None
        self._silent_since: float | None = None
        self._number = 0
        self._state: Tree | None = None
        self._pages: dict[object, Callable[[Tree], None]] = {}
        self._task: asyncio.Task[None] | None = None
        self._wake = asyncio.Event()
        self.resources = ResourceWatch(hub)
        self.diagnostics = DiagnosticsFeed(hub, self.show)
        environ = os.environ if environ is None else environ
        self.answers = Answers(hub, self.resources, self.diagnostics, lambda: self.agent, environ, folder)
        self.sticks = Sticks(hub, lambda: self.module)
        self._rates = RatesFeed(lambda: self.answers.ask_agent("rates"))

    @property
    def module(self) -> str:
        """The name of the agent's module; empty until it has answered once."""
        return self._builder.own

    @property
    def agent(self) -> str:
        """Which agent is asked; empty: the only one."""
        return self._named or self.module

    def start(self) -> None:
        """Begin; the hub has an event loop by now."""
        self._hub.start()
        self.resources.start()
        self._task = keep_task(self._run, "the state of the mesh for the pages")

    async def close(self) -> None:
        """End, before the hub ends."""
        self._pages.clear()
        await end_tasks(self._task)
        await self._rates.close()
        self.answers.close()
        self.diagnostics.close()
        self.resources.close()

    async def first(self) -> None:
        """Ask the agent once, for ``web_limits.SETTLE`` at most, so that a page is told its name."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(web_limits.SETTLE):
                self._take(await self._watch.reading())

    def follow(self, page: object, show: Callable[[Tree], None]) -> None:
        """Give a page each new state, beginning with the last one."""
        self._pages[page] = show
        self.resources.show_all(wanted=True)
        self.diagnostics.follow()
        if self._state is not None:
            show(self._whole(self._state))
        self._wake.set()

    def unfollow(self, page: object) -> None:
        """End a ``follow``."""
        self._pages.pop(page, None)
        if not self._pages:
            self.resources.show_all(wanted=False)
            self.diagnostics.close()

    def show(self) -> None:
        """Show all pages the state once more: the diagnostics have changed."""
        if self._state is not None:
            state = self._whole(self._state)
            for show in [*self._pages.values()]:
                show(state)

    def _whole(self, state: Tree) -> Tree:
        return state | {"diagnostics": self.diagnostics.summary}

    def details(self, kind: str, name: str) -> Tree | None:
        """All that is known of one thing; ``None`` where there is no such thing."""
        if self._snapshot is None:
            return None
        if kind == "resource":
            self.resources.look(name)
        if kind == "rates":
            return self._rates.look(self._snapshot)
        if kind.startswith("diagnostic"):
            return self.diagnostics.all() if kind == "diagnostics" else self.diagnostics.one(name)
        return details(self._snapshot, self.resources.facts, kind, name)

    async def _run(self) -> None:
        while True:
            if not self._pages:
                self._wake.clear()
                await self._wake.wait()
            began = time.monotonic()
            self._take(await self._watch.reading())
            # A snapshot of thousands of topics takes time at both ends: at most a fifth of it is spent here.
            took = time.monotonic() - began
            await asyncio.sleep(
                max(limits.STATE_PERIOD - took, min(took * limits.STATE_SHARE, limits.STATE_PAUSE_MAX))
            )

    def _take(self, reading: Reading) -> None:
        if reading.number == self._number:
            return
        self._number = reading.number
        if reading.snapshot is None:
            self._silent_since = self._silent_since or time.time()
            problem, _, remedy = reading.problem.partition("; ")
            self._state = self._builder.unreachable(self._silent_since, problem, remedy)
        else:
            self._silent_since = None
            self._snapshot = reading.snapshot
            if self._builder.own != reading.snapshot.agent.name:
                self._builder = StateBuilder(reading.snapshot.agent.name)
            facts, standing = tuple(self.resources.facts.values()), self.resources.alarms()
            self._state = self._builder.build(reading.snapshot, facts, standing, self._hub.params.changes)
        self.show()


class RatesFeed:
    """The rate of each topic, measured where it is published: asked of all agents while a page shows the topics.

    It asks every ``limits.RATES_PERIOD``, and not at all ``limits.LOOK_KEPT`` after the last look.

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
            told = msgspec.convert(await self._ask(), dict[str, tuple[TopicRate, ...] | str])
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
