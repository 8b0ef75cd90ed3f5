"""The connections to one local server, for the calls of all peers: a few that stay, one call at a time over each."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.policy import OWN_NODE
from rmpa.core.errors import LocalProtocolError, RmpaError
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed

if TYPE_CHECKING:
    from rmpa.bridge.services.exports import LocalService
    from rmpa.ros.wire.services import ServiceDescription
    from rmpa.runtime.stream import Buffer

_log = logging.getLogger(__name__)

Done = Callable[[bool, "Buffer"], None]
"""``(ok, response or text of the error)``."""


@dataclass(slots=True)
class _Waiting:
    """A call that has no connection yet."""

    body: Buffer
    until: float
    done: Done


class ServicePool:
    """Calls one server.

    Args:
        service: The service's name in this graph.
        server: Where it is.
        on_lost: Called when the server hung up, or does not answer at its address: it may be dead.
    """

    def __init__(self, service: str, server: LocalService, on_lost: Callable[[], None]) -> None:
        self.service = service
        self.server = server
        self._on_lost = on_lost
        self._loop = asyncio.get_running_loop()
        self._idle: list[tuple[ServiceConnection, float]] = []
        self._busy: set[ServiceConnection] = set()
        self._opening: set[asyncio.Task[None]] = set()
        self._queue: deque[_Waiting] = deque()
        self._closed = False

    @property
    def size(self) -> int:
        """Connections, those that are being made included."""
        return len(self._idle) + len(self._busy) + len(self._opening)

    @property
    def unused(self) -> bool:
        """Whether nothing is open and no call waits."""
        return not self.size and not self._queue

    async def describe(self) -> ServiceDescription:
        """What the server says of its service; the connection stays for the first call.

        Raises:
            RmpaError: It does not answer, or says no.
        """
        try:
            connection = await self._connect()
        except RmpaError:
            self._on_lost()
            raise
        if self._closed:
            connection.close()
        else:
            self._free(connection)
        return connection.description

    def call(self, body: Buffer, timeout: float, done: Done) -> None:
        """Make a call; ``done`` is called once, perhaps at once.

        Args:
            body: The request; it must not change until the answer is there.
            timeout: Seconds until the caller has given up.
            done: Gets the answer.
        """
        if len(self._queue) >= limits.SERVICE_QUEUE:
            text = f"service [{self.service}]: {len(self._queue)} calls wait for its server already"
            done(False, text.encode())
            return
        self._take(_Waiting(body, self._loop.time() + timeout, done))

    def close_idle(self, before: float) -> None:
        """Close the connections that were not used since ``before`` (``loop.time()``)."""
        kept = []
        for connection, since in self._idle:
            if since < before or connection.closed:
                connection.close()
            else:
                kept.append((connection, since))
        self._idle = kept

    def close(self, reason: str) -> None:
        """Close all; calls under way and those that wait get an error."""
        self._closed = True
        text = f"service [{self.service}]: {reason}".encode()
        for task in self._opening:
            task.cancel()
        for connection in [*(connection for connection, _ in self._idle), *self._busy]:
            connection.close()
        self._idle.clear()
        while self._queue:
            self._queue.popleft().done(False, text)

    async def closed(self) -> None:
        """Behind ``close``: wait until nothing is left."""
        await asyncio.gather(*self._opening, return_exceptions=True)

    # --- inside ---------------------------------------------------------------------------------------------

    def _take(self, call: _Waiting) -> None:
        while self._idle:
            connection, _ = self._idle.pop()
            if self._request(connection, call):
                return
        self._queue.append(call)
        self._open_more()

    def _open_more(self) -> None:
        """One connection for each call that waits, as far as there may be more."""
        while len(self._opening) < len(self._queue) and self.size < limits.SERVICE_POOL:
            task = self._loop.create_task(self._open(), name=f"connect to {self.service}")
            self._opening.add(task)
            task.add_done_callback(self._opening.discard)

    async def _open(self) -> None:
        try:
            connection = await self._connect()
        except RmpaError as error:
            # What waits would fail as this attempt did; the next call makes a new one.
            self._on_lost()
            while self._queue and not self._busy:
                self._queue.popleft().done(False, str(error).encode(errors="replace"))
            return
        self._free(connection)

    async def _connect(self) -> ServiceConnection:
        return await ServiceConnection.open(self.server.uri, self.service, OWN_NODE, on_closed=self._on_lost)

    def _request(self, connection: ServiceConnection, call: _Waiting) -> bool:
        """Send a call's request; ``False`` if the connection turns out to be closed, and nothing was sent."""
        rest = call.until - self._loop.time()
        try:
            connection.request(call.body, partial(self._answered, connection, call.done), rest)
        except (ServiceFailed, LocalProtocolError) as error:
            if isinstance(error, ServiceFailed) and not connection.closed:
                self._free(connection)
                call.done(False, str(error).encode(errors="replace"))
                return True
            connection.close()
            return False
        self._busy.add(connection)
        return True

    def _answered(
        self, connection: ServiceConnection, done: Done, result: tuple[bool, bytes | bytearray] | ServiceFailed
    ) -> None:
        self._busy.discard(connection)
        if isinstance(result, ServiceFailed):
            connection.close()
            done(False, str(result).encode(errors="replace"))
            if not self._closed:
                self._on_lost()
                self._open_more()
            return
        done(*result)
        if self._closed:
            connection.close()
        else:
            self._free(connection)

    def _free(self, connection: ServiceConnection) -> None:
        """A connection has nothing to do: the next call that waits has it."""
        while self._queue:
            call = self._queue.popleft()
            if call.until <= self._loop.time():
                call.done(False, f"service [{self.service}]: its server had no time for this call".encode())
                continue
            if not self._request(connection, call):
                self._queue.appendleft(call)
                self._open_more()
            return
        if not connection.closed:
            self._idle.append((connection, self._loop.time()))
