"""What all pages of the monitor share: the state of the mesh.

The server's side of the monitor: what all pages share.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from typing import TYPE_CHECKING

from rmpa.runtime.tasks import end_tasks, keep_task
from rmpa.web import limits as web_limits
from rmpa.web.monitor import limits
from rmpa.web.monitor.descriptions import Descriptions
from rmpa.web.monitor.diagnostics import DiagnosticsFeed
from rmpa.web.monitor.questions import Answers
from rmpa.web.monitor.rates import RatesFeed
from rmpa.web.monitor.resources import MessageValues, ResourceWatch
from rmpa.web.monitor.state import StateBuilder, details
from rmpa.web.monitor.sticks import Sticks

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.hub.hub import Hub
    from rmpa.web.monitor.messages import Tree
    from rmpa.web.server.agent_watch import AgentWatch, Reading


class MeshFeed:
    """Builds one state of each snapshot, and gives it to all pages.

    Args:
        hub: Has ``/diagnostics``, and counts the changes of parameters of this module's core.
        watch: Asks the agent.
        resources: Knows the Smart Resources.
        rates: Knows the rates of topics.
    """

    def __init__(self, hub: Hub, watch: AgentWatch, resources: ResourceWatch, rates: RatesFeed) -> None:
        self.diagnostics = DiagnosticsFeed(hub, resources.values, self.show)
        self._params = hub.params
        self._rates = rates
        self._watch = watch
        self._resources = resources
        self._builder: StateBuilder | None = None
        self._snapshot: Snapshot | None = None
        self._silent_since: float | None = None
        self._number = 0
        self._state: Tree | None = None
        self._pages: dict[object, Callable[[Tree], None]] = {}
        self._task: asyncio.Task[None] | None = None
        self._wake = asyncio.Event()

    @property
    def agent(self) -> str:
        """The name of the agent's module; empty until it has answered once."""
        return self._snapshot.agent.name if self._snapshot is not None else ""

    def start(self) -> None:
        """Begin to read snapshots."""
        self._task = keep_task(self._run, "the state of the mesh for the pages")

    async def first(self) -> None:
        """Ask the agent once, for ``web_limits.SETTLE`` at most, so that a page is told its name."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(web_limits.SETTLE):
                self._take(await self._watch.reading())

    def follow(self, page: object, show: Callable[[Tree], None]) -> None:
        """Give a page each new state, beginning with the last one."""
        self._pages[page] = show
        self._resources.show_all(wanted=True)
        self.diagnostics.follow(wanted=True)
        if self._state is not None:
            show(self._whole(self._state))
        self._wake.set()

    def unfollow(self, page: object) -> None:
        """End a ``follow``."""
        self._pages.pop(page, None)
        if not self._pages:
            self._resources.show_all(wanted=False)
            self.diagnostics.follow(wanted=False)

    def show(self) -> None:
        """Show all pages the state once more: the diagnostics have changed."""
        if self._state is not None:
            state = self._whole(self._state)
            for show in [*self._pages.values()]:
                show(state)

    def _whole(self, state: Tree) -> Tree:
        return state | {"diagnostics": self.diagnostics.summary}

    async def close(self) -> None:
        """End."""
        self._pages.clear()
        await end_tasks(self._task)

    def details(self, kind: str, name: str) -> Tree | None:
        """All that is known of one thing; ``None`` where there is no such thing."""
        if self._snapshot is None:
            return None
        if kind == "resource":
            self._resources.look(name)
        if kind == "rates":
            return self._rates.look(self._snapshot)
        if kind.startswith("diagnostic"):
            return self.diagnostics.all() if kind == "diagnostics" else self.diagnostics.one(name)
        return details(self._snapshot, self._resources.facts, kind, name)

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
            if self._silent_since is None:
                self._silent_since = time.time()
            builder = self._builder or StateBuilder("")
            problem, _, remedy = reading.problem.partition("; ")
            self._state = builder.unreachable(self._silent_since, problem, remedy)
        else:
            self._silent_since = None
            self._snapshot = reading.snapshot
            if self._builder is None or self._builder.own != reading.snapshot.agent.name:
                self._builder = StateBuilder(reading.snapshot.agent.name)
            facts = tuple(self._resources.facts.values())
            standing = self._resources.alarms()
            self._state = self._builder.build(reading.snapshot, facts, standing, self._params.changes)
        self.show()


class Monitor:
    """Follows the mesh for all pages.

    Args:
        hub: Subscribes, and calls services.
        watch: Asks the agent.
        environ: Says where the agents' sockets are; the process's environment unless it is given.
        agent: The agent's name; ``None``: the one that answers.
        folder: Where the files that describe this module's resources are; empty for none.
    """

    def __init__(
        self,
        hub: Hub,
        watch: AgentWatch,
        environ: Mapping[str, str] | None = None,
        agent: str | None = None,
        folder: str = "",
    ) -> None:
        self._hub = hub
        self.values = MessageValues(hub)
        self.resources = ResourceWatch(hub, self.values)
        self.rates = RatesFeed(lambda: self.answers.ask_agent("rates"))
        self.mesh = MeshFeed(hub, watch, self.resources, self.rates)
        self.answers = Answers(
            hub,
            self.resources,
            os.environ if environ is None else environ,
            lambda: agent or self.mesh.agent,
            self.mesh.diagnostics.past,
            Descriptions(folder),
        )
        self.sticks = Sticks(hub, lambda: self.mesh.agent)

    def start(self) -> None:
        """Begin; the hub has an event loop by now."""
        self._hub.start()
        self.resources.start()
        self.mesh.start()

    async def close(self) -> None:
        """End, before the hub ends."""
        await self.mesh.close()
        await self.rates.close()
        self.answers.close()
        self.mesh.diagnostics.close()
        self.resources.close()
