"""The agent's snapshot, shared by all clients: the agent is asked at most once in ``limits.WEB_SNAPSHOT_AGE``."""

from __future__ import annotations

import asyncio
import logging
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core.errors import RmpaError, UnreachableError
from rmpa.observe import limits as observe_limits
from rmpa.observe.io.control_client import ControlClient, choose_agent
from rmpa.observe.snapshot_decoder import SnapshotDecoder
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.observe.snapshot import Snapshot

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Reading:
    """What one question to the agent gave.

    Attributes:
        number: Counts the questions, from 1.
        taken: When it ended, in monotonic seconds.
        snapshot: ``None`` if the agent did not answer.
        problem: Why it did not, and what to do.
    """

    number: int
    taken: float
    snapshot: Snapshot | None
    problem: str = ""


class AgentWatch:
    """Asks the agent in a thread of its own; requests that come meanwhile wait for the same answer.

    Args:
        read: Asks the agent; may block, and raises ``RmpaError`` where it does not answer.
        clock: Monotonic seconds.
    """

    def __init__(self, read: Callable[[], Snapshot], clock: Callable[[], float] = time.monotonic) -> None:
        self._read = read
        self._clock = clock
        self._thread = ThreadPoolExecutor(1, "rmpa-agent-watch")
        self._last: Reading | None = None
        self._pending: asyncio.Task[Reading] | None = None
        self.reads = 0
        """Questions to the agent so far."""
        self.seconds = 0.0
        """Seconds that they took in total."""

    async def reading(self) -> Reading:
        """The newest reading, at most ``limits.WEB_SNAPSHOT_AGE`` old when this was called."""
        if self._pending is None:
            last = self._last
            if last is not None and self._clock() - last.taken < limits.WEB_SNAPSHOT_AGE:
                return last
            self._pending = asyncio.create_task(self._ask(), name="agent watch")
        return await asyncio.shield(self._pending)  # a client that leaves must not end it for the others

    async def _ask(self) -> Reading:
        began = self._clock()
        try:
            snapshot, problem = await asyncio.get_running_loop().run_in_executor(self._thread, self._read_safely)
        finally:
            self._pending = None
        now = self._clock()
        self.reads += 1
        self.seconds += now - began
        self._log_change(snapshot, problem)
        self._last = Reading(self.reads, now, snapshot, problem)
        return self._last

    def _read_safely(self) -> tuple[Snapshot | None, str]:
        try:
            return self._read(), ""
        except RmpaError as error:
            return None, str(error)

    def _log_change(self, snapshot: Snapshot | None, problem: str) -> None:
        was_up = self._last is not None and self._last.snapshot is not None
        if snapshot is not None and not was_up:
            _log.info("= the agent %s answers", snapshot.agent.name)
        elif snapshot is None and (self._last is None or was_up):
            _log.warning("! the agent does not answer: %s", problem)

    async def close(self) -> None:
        """Wait for a question under way, at most ``limits.WEB_AGENT_TIMEOUT``, and end the thread."""
        if self._pending is not None:
            await asyncio.wait([self._pending])
        self._thread.shutdown()


class ControlReader:
    """Reads snapshots over one kept connection to the control socket; called by one thread.

    Args:
        environ: Says where the sockets are.
        name: The agent's; ``None``: the one that ``choose_agent`` finds. Once found, it stays the one.
    """

    def __init__(self, environ: Mapping[str, str], name: str | None) -> None:
        self._environ = environ
        self._name = name
        self._client: ControlClient | None = None
        self._decoder = SnapshotDecoder()
        self._used = 0.0
        self.figures = False
        """Whether the agent is to ask nodes for the figures of their direct connections."""

    def __call__(self) -> Snapshot:
        """Ask for a snapshot.

        Raises:
            RmpaError: No agent answers, or several run and none is named.
        """
        began = time.monotonic()
        if self._client is not None and began - self._used < observe_limits.CONTROL_IDLE_TIMEOUT / 2:
            try:
                return self._ask(self._client)
            except UnreachableError:
                if time.monotonic() - began >= limits.WEB_AGENT_TIMEOUT:
                    raise  # the agent hangs; another connection would wait as long
                # It hung up, as it was started anew: look for its new socket.
        self.close()
        agent = choose_agent(self._environ, self._name)
        self._name = agent.name
        self._client = ControlClient(agent.path, limits.WEB_AGENT_TIMEOUT)
        return self._ask(self._client)

    def _ask(self, client: ControlClient) -> Snapshot:
        try:
            snapshot = client.snapshot(self._decoder, **({"figures": "newest"} if self.figures else {}))
        except RmpaError:
            self.close()
            raise
        self._used = time.monotonic()
        return snapshot

    def close(self) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None
