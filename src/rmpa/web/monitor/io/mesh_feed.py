"""The state of the mesh for all pages, and the history of its links: snapshots of the agent are read all the time."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from typing import TYPE_CHECKING, Final

from rmpa.web.monitor import limits
from rmpa.web.monitor.io.left_out import LeftOut
from rmpa.web.monitor.view import StateBuilder, details

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.monitor.io.resource_watch import ResourceWatch
    from rmpa.web.monitor.patch import Tree
    from rmpa.web.server.agent_watch import AgentWatch, Reading

_log = logging.getLogger(__name__)
_LEVELS: Final = {"here": "OK", "up": "OK", "relayed": "OK", "parked": "OK", "refused": "ERROR"}
"""Levels of the history by the state of a link; all others are warnings."""
_PARKING: Final = frozenset({"up", "parked"})
"""States between which a module changes when its link is parked, or made again: the history leaves that out."""
WORDS: Final = {
    "up": "linked",
    "parked": "is parked",
    "linking": "no link",
    "away": "is away",
    "silent": "is silent",
    "refused": "is refused",
}
"""What the history says of a link's state."""


class MeshFeed:
    """Builds one state of each snapshot, and gives it to all pages.

    Args:
        watch: Asks the agent.
        resources: Knows the Smart Resources.
        watched: Called with whether pages are open.
        parameters: Says how often the parameters of this module's core have changed.
        clock: Seconds since the epoch.
    """

    def __init__(
        self,
        watch: AgentWatch,
        resources: ResourceWatch,
        watched: Callable[[bool], None],
        parameters: Callable[[], int] = lambda: 0,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._watched = watched
        self._parameters = parameters
        self._watch = watch
        self._resources = resources
        self._clock = clock
        self._builder: StateBuilder | None = None
        self._snapshot: Snapshot | None = None
        self._silent_since: float | None = None
        self._number = 0
        self._state: Tree | None = None
        self._pages: dict[object, Callable[[Tree], None]] = {}
        self._task: asyncio.Task[None] | None = None
        self._wake = asyncio.Event()
        self._links: dict[str, str] = {}
        self._doubted: dict[str, float] = {}
        """Since when a link seems lost, by module."""
        self._left_out = LeftOut(watch, self._show)

    @property
    def agent(self) -> str:
        """The name of the agent's module; empty until it has answered once."""
        return self._snapshot.agent.name if self._snapshot is not None else ""

    def start(self) -> None:
        """Begin to read snapshots."""
        self._task = asyncio.get_running_loop().create_task(self._run(), name="monitor's state")

    async def first(self) -> None:
        """Ask the agent once, so that its name is known."""
        self._take(await self._watch.reading())

    def follow(self, page: object, show: Callable[[Tree], None]) -> None:
        """Give a page each new state, beginning with the last one."""
        self._pages[page] = show
        self._watched(True)
        self._resources.show_all(wanted=True)
        if self._state is not None:
            show(self._state)
        self._wake.set()

    def unfollow(self, page: object) -> None:
        """End a ``follow``; after the last one snapshots are read for the history alone."""
        self._pages.pop(page, None)
        if not self._pages:
            self._watched(False)
            self._resources.show_all(wanted=False)

    async def close(self) -> None:
        """End."""
        self._pages.clear()
        await self._left_out.close()
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    def details(self, kind: str, name: str) -> Tree | None:
        """All that is known of one thing; ``None`` where there is no such thing."""
        if self._snapshot is None:
            return None
        if kind == "resource":
            self._resources.look(name)
        found = details(self._snapshot, self._resources.facts, kind, name)
        section = self._state.get(f"{kind}s") if kind in ("topic", "service") and self._state is not None else None
        if not isinstance(section, dict) or name in section:
            return found
        snapshot: Snapshot | None = self._snapshot
        if found is None:
            left = self._snapshot.topics_left if kind == "topic" else self._snapshot.services_left
            snapshot = self._left_out.look(kind, name[name.find("/") :]) if left else None
            found = details(snapshot, {}, kind, name) if snapshot is not None else None
        if found is not None and snapshot is not None and self._builder is not None:
            found["entry"] = self._builder.entry(snapshot, kind, name)
        return found

    async def _run(self) -> None:
        while True:
            began = time.monotonic()
            try:
                self._take(await self._watch.reading())
            except Exception:  # noqa: BLE001 - a task's top
                _log.exception("! the state of the mesh could not be built")
            # A snapshot of thousands of topics takes time at both ends: at most a fifth of it is spent here.
            took = time.monotonic() - began
            pause = max(limits.STATE_PERIOD - took, min(took * limits.STATE_SHARE, limits.STATE_PAUSE_MAX))
            if self._pages:
                await asyncio.sleep(pause)
                continue
            self._wake.clear()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(limits.HISTORY_PERIOD, min(took * 20, limits.HISTORY_PERIOD_MAX))):
                    await self._wake.wait()

    def _take(self, reading: Reading) -> None:
        if reading.number == self._number:
            return
        self._number = reading.number
        if reading.snapshot is None:
            self._doubted.clear()
            if self._silent_since is None:
                self._silent_since = self._clock()
            builder = self._builder or StateBuilder("")
            problem, _, remedy = reading.problem.partition("; ")
            self._state = builder.unreachable(self._silent_since, problem, remedy)
        else:
            self._silent_since = None
            self._snapshot = reading.snapshot
            if self._builder is None or self._builder.own != reading.snapshot.agent.name:
                self._builder = StateBuilder(reading.snapshot.agent.name)
            facts = tuple(self._resources.facts.values())
            standing, recorded = self._resources.alarms(), self._resources.recorded
            self._state = self._builder.build(reading.snapshot, facts, standing, recorded, self._parameters())
            # An agent that has just started finds its peers one by one: they are compared when it has had the time.
            if reading.snapshot.agent.uptime >= limits.AGENT_SETTLES:
                self._record_links(self._state)
        self._show()

    def _show(self) -> None:
        """Give all pages the state, with the details of what they look at."""
        if self._state is not None:
            for show in [*self._pages.values()]:
                show(self._state)

    def _record_links(self, state: Tree) -> None:
        """Note in the history which links were lost, and which are back.

        A loss counts once it has stood for a moment: an agent that ends tells for as long that it has no peers.
        """
        modules = state.get("modules")
        moment = self._clock()
        for name, module in modules.items() if isinstance(modules, dict) else ():
            if not isinstance(module, dict):
                continue
            now, before = str(module.get("state", "")), self._links.get(name)
            level = _LEVELS.get(now, "WARN")
            if before in (None, now) or level == "OK":
                since = moment
                self._doubted.pop(name, None)
            elif moment - (since := self._doubted.setdefault(name, moment)) < limits.LOSS_STANDS:
                continue
            self._links[name] = now
            if before not in (None, now) and not {before, now} <= _PARKING:
                error = str(module.get("error") or "")
                text = f"{name}: {WORDS.get(now, now)}" + (f": {error}" if error else "")
                self._resources.record(level, text, since, module=name)
        if isinstance(modules, dict):
            self._links = {name: state for name, state in self._links.items() if name in modules}
            self._doubted = {name: since for name, since in self._doubted.items() if name in modules}
