"""What all pages of the monitor share: the state of the mesh and the log.

The server's side of the monitor: what all pages share.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import time
from collections import deque
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RmpaError
from rmpa.runtime.tasks import end_tasks, keep_task
from rmpa.web import limits as web_limits
from rmpa.web.monitor import limits
from rmpa.web.monitor.messages import LOG_TOPIC
from rmpa.web.monitor.questions import Answers
from rmpa.web.monitor.rates import RatesFeed
from rmpa.web.monitor.resources import MessageValues, ResourceWatch
from rmpa.web.monitor.state import StateBuilder, details
from rmpa.web.monitor.sticks import Sticks

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.hub.hub import Hub
    from rmpa.web.hub.topics import ClientSubscription, ReceivedMessage
    from rmpa.web.monitor.messages import Tree
    from rmpa.web.server.agent_watch import AgentWatch, Reading


_log = logging.getLogger(__name__)


class MeshFeed:
    """Builds one state of each snapshot, and gives it to all pages.

    Args:
        watch: Asks the agent.
        resources: Knows the Smart Resources.
        parameters: Says how often the parameters of this module's core have changed.
        clock: Seconds since the epoch.
        rates: Knows the rates of topics.
    """

    def __init__(
        self,
        watch: AgentWatch,
        resources: ResourceWatch,
        parameters: Callable[[], int] = lambda: 0,
        clock: Callable[[], float] = time.time,
        rates: RatesFeed | None = None,
    ) -> None:
        self._parameters = parameters
        self._rates = rates
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
        if self._state is not None:
            show(self._state)
        self._wake.set()

    def unfollow(self, page: object) -> None:
        """End a ``follow``."""
        self._pages.pop(page, None)
        if not self._pages:
            self._resources.show_all(wanted=False)

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
            return self._rates.look(self._snapshot) if self._rates is not None else {}
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
            standing = self._resources.alarms()
            self._state = self._builder.build(reading.snapshot, facts, standing, self._parameters())
        for show in [*self._pages.values()]:
            show(self._state)


_TYPE: Final = "rosgraph_msgs/Log"
_LEVELS: Final = {1: "DEBUG", 2: "INFO", 4: "WARN", 8: "ERROR", 16: "FATAL"}
# Seconds in which lines are gathered into one message to a page.
_GATHER: Final = 0.1


class LogFeed:
    """Follows the log while it is open.

    Args:
        hub: Subscribes to it.
        values: Decodes its messages.
    """

    def __init__(self, hub: Hub, values: MessageValues) -> None:
        self._hub = hub
        self._values = values
        self._lines: deque[dict[str, Any]] = deque(maxlen=limits.LOG_LINES)
        self._fresh: list[dict[str, Any]] = []
        self._followers: dict[object, Callable[[list[dict[str, Any]]], None]] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._count = 0
        self._subscription: ClientSubscription | None = None
        # Why there is no log to show.
        self.refused: RmpaError | None = None

    def start(self) -> None:
        """Begin to keep lines."""
        try:
            self._subscription = self._hub.topics.subscribe(LOG_TOPIC, _TYPE, self._take, self._refused)
        except RmpaError as error:
            self._refused(error)

    def close(self) -> None:
        """Keep no more."""
        if self._timer is not None:
            self._timer.cancel()
        if self._subscription is not None:
            self._subscription.close()

    def follow(self, page: object, show: Callable[[list[dict[str, Any]]], None]) -> list[dict[str, Any]]:
        """Give a page each further line, by ``show``; returns those that are kept, oldest first."""
        known, self._followers[page] = page in self._followers, show
        return [] if known else list(self._lines)

    def unfollow(self, page: object) -> None:
        """End a ``follow``."""
        self._followers.pop(page, None)

    def _take(self, message: ReceivedMessage) -> None:
        try:
            values = self._values.of(message)
        except RmpaError:
            return  # not a message of the log; there is nothing to show
        stamp = values["header"]["stamp"]
        at = stamp["secs"] + stamp["nsecs"] * 1e-9
        self._count += 1
        line = {
            "n": self._count,
            "at": at or message.stamp_ns * 1e-9 or time.time(),
            "level": _LEVELS.get(values["level"], "INFO"),
            "node": values["name"][: limits.LOG_CHARACTERS],
            "text": values["msg"][: limits.LOG_CHARACTERS],
        }
        self._lines.append(line)
        if not self._followers:
            return
        self._fresh.append(line)
        if self._timer is None:
            self._timer = asyncio.get_running_loop().call_later(_GATHER, self._show)

    def _show(self) -> None:
        self._timer = None
        lines, self._fresh = self._fresh[-limits.LOG_LINES :], []
        for show in [*self._followers.values()]:
            show(lines)

    def _refused(self, error: RmpaError) -> None:
        self.refused = error


class Monitor:
    """Follows the mesh for all pages. The log is kept from ``start`` on.

    Args:
        hub: Subscribes, and calls services.
        watch: Asks the agent.
        environ: Says where the agents' sockets are; the process's environment unless it is given.
        agent: The agent's name; ``None``: the one that answers.
    """

    def __init__(
        self,
        hub: Hub,
        watch: AgentWatch,
        environ: Mapping[str, str] | None = None,
        agent: str | None = None,
    ) -> None:
        self._hub = hub
        self.values = MessageValues(hub)
        self.resources = ResourceWatch(hub, self.values)
        self.log = LogFeed(hub, self.values)
        self.answers = Answers(
            hub,
            self.resources,
            os.environ if environ is None else environ,
            lambda: agent or self.mesh.agent,
        )
        self.rates = RatesFeed(self.answers.rates)
        self.mesh = MeshFeed(watch, self.resources, lambda: hub.params.changes, rates=self.rates)
        self.sticks = Sticks(hub, lambda: self.mesh.agent)

    def start(self) -> None:
        """Begin to keep lines of the log; the hub has an event loop by now."""
        self._hub.start()
        self.resources.start()
        self.log.start()
        self.mesh.start()

    async def close(self) -> None:
        """End, before the hub ends."""
        await self.mesh.close()
        await self.rates.close()
        self.answers.close()
        self.log.close()
        self.resources.close()
