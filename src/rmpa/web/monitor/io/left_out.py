"""Asks the agent for topics and services that a page looks at and the usual snapshot of a large graph leaves out."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING

from rmpa.web import limits as web_limits
from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.server.agent_watch import AgentWatch

_log = logging.getLogger(__name__)


class LeftOut:
    """A snapshot of what pages look at. It is asked for again as long as they look.

    Args:
        watch: Asks the agent.
        changed: Called when there is another snapshot.
        clock: Monotonic seconds.
    """

    def __init__(
        self, watch: AgentWatch, changed: Callable[[], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._watch = watch
        self._changed = changed
        self._clock = clock
        self._wanted: set[tuple[str, str]] = set()
        self._asked: frozenset[tuple[str, str]] = frozenset()
        self._snapshot: Snapshot | None = None
        self._taken = 0.0
        self._task: asyncio.Task[None] | None = None

    def look(self, kind: str, name: str) -> Snapshot | None:
        """The last snapshot, if it was asked for this.

        Args:
            kind: ``topic`` or ``service``.
            name: Its name, without a module.
        """
        key = kind, name
        if len(self._wanted) < limits.LEFT_OUT_NAMES:
            self._wanted.add(key)
        due = key not in self._asked or self._clock() - self._taken >= web_limits.WEB_WHOLE_AGE
        if due and key in self._wanted and self._task is None:
            self._task = asyncio.get_running_loop().create_task(self._ask(), name="ask for what is left out")
        return self._snapshot if key in self._asked else None

    async def _ask(self) -> None:
        try:
            wanted = frozenset(self._wanted)
            self._wanted.clear()
            topics = sorted(name for kind, name in wanted if kind == "topic")
            services = sorted(name for kind, name in wanted if kind == "service")
            reading = await self._watch.named(topics, services)
            self._snapshot, self._asked, self._taken = reading.snapshot, wanted, self._clock()
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! the agent could not be asked for a topic or service")
            return
        finally:
            self._task = None
        self._changed()

    async def close(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])
