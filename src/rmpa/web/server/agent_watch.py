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
from rmpa.observe.control import SnapshotDecoder
from rmpa.observe.control_client import ControlClient, choose_agent
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
        read_whole: Asks for a snapshot of which nothing is left out, where ``read`` may leave out what is not used.
    """

    def __init__(
        self,
        read: Callable[[], Snapshot],
        clock: Callable[[], float] = time.monotonic,
        read_whole: Callable[[], Snapshot] | None = None,
    ) -> None:
        self._read = read
        self._read_whole = read_whole
        self._whole: Reading | None = None
        self._pending_whole: asyncio.Task[Reading] | None = None
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

    async def whole(self) -> Reading:
        """As ``reading``, with all topics and services also where the usual reading leaves some out."""
        reading = await self.reading()
        snapshot = reading.snapshot
        read = self._read_whole
        if read is None or snapshot is None or not (snapshot.topics_left or snapshot.services_left):
            return reading
        whole = self._whole
        if whole is None or self._clock() - whole.taken >= limits.WEB_WHOLE_AGE:
            if self._pending_whole is None:
                self._pending_whole = asyncio.create_task(self._ask_whole(read), name="agent watch, whole")
            whole = await asyncio.shield(self._pending_whole)
        return whole

    async def _ask_whole(self, read: Callable[[], Snapshot]) -> Reading:
        try:
            snapshot, problem = await asyncio.get_running_loop().run_in_executor(
                self._thread, self._read_safely, read
            )
        finally:
            self._pending_whole = None
        self.reads += 1
        self._whole = Reading(self.reads, self._clock(), snapshot, problem)
        return self._whole

    async def _ask(self) -> Reading:
        began = self._clock()
        try:
            snapshot, problem = await asyncio.get_running_loop().run_in_executor(
                self._thread, self._read_safely, self._read
            )
        finally:
            self._pending = None
        now = self._clock()
        self.reads += 1
        self.seconds += now - began
        self._log_change(snapshot, problem)
        self._last = Reading(self.reads, now, snapshot, problem)
        return self._last

    @staticmethod
    def _read_safely(read: Callable[[], Snapshot]) -> tuple[Snapshot | None, str]:
        try:
            return read(), ""
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
        if pending := [task for task in (self._pending, self._pending_whole) if task is not None]:
            await asyncio.wait(pending)
        self._thread.shutdown()


class ControlReader:
    """Reads snapshots over one kept connection to the control socket; called by one thread.

    Args:
        environ: Says where the sockets are.
        name: The agent's; ``None``: the one that ``choose_agent`` finds. Once found, it stays the one.
        check: Called with each snapshot before it is used; raises ``RmpaError`` if the server is not for that agent.
    """

    def __init__(
        self, environ: Mapping[str, str], name: str | None, check: Callable[[Snapshot], None] = lambda _: None
    ) -> None:
        self._environ = environ
        self._name = name
        self._check = check
        self._client: ControlClient | None = None
        self._decoder = SnapshotDecoder()
        self._used = 0.0

    def __call__(self) -> Snapshot:
        """Ask for a snapshot, with ``limits.WEB_TOPICS`` topics and services if most of them are not used.

        Raises:
            RmpaError: No agent answers, or several run and none is named.
        """
        return self._read(most=limits.WEB_TOPICS)

    def read_whole(self) -> Snapshot:
        """Ask for a snapshot of which nothing is left out; raises as a call."""
        with ControlClient(choose_agent(self._environ, self._name).path, limits.WEB_WHOLE_TIMEOUT) as client:
            return self._checked(client.snapshot())

    def _read(self, **args: object) -> Snapshot:
        began = time.monotonic()
        if self._client is not None and began - self._used < observe_limits.CONTROL_IDLE_TIMEOUT / 2:
            try:
                return self._ask(self._client, args)
            except UnreachableError:
                if time.monotonic() - began >= limits.WEB_AGENT_TIMEOUT:
                    raise  # the agent hangs; another connection would wait as long
                # It hung up, as it was started anew: look for its new socket.
        self.close()
        agent = choose_agent(self._environ, self._name)
        self._name = agent.name
        self._client = ControlClient(agent.path, limits.WEB_AGENT_TIMEOUT)
        return self._ask(self._client, args)

    def _ask(self, client: ControlClient, args: dict[str, object]) -> Snapshot:
        try:
            snapshot = client.snapshot(self._decoder, **args)
        except RmpaError:
            self.close()
            raise
        self._used = time.monotonic()
        return self._checked(snapshot)

    def _checked(self, snapshot: Snapshot) -> Snapshot:
        self._check(snapshot)
        return snapshot

    def close(self) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None
