"""Connections to one local server for the calls of all peers: a few are kept open, each with one call at a time."""

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
    from rmpa.bridge.services.actions import LocalService
    from rmpa.ros.wire.tcpros import ServiceDescription
    from rmpa.runtime.tls import Buffer

_log = logging.getLogger(__name__)

Done = Callable[[bool, "Buffer"], None]
"""Called with ``(ok, body)``: the response, or the text of the error."""


@dataclass(slots=True)
class _Waiting:
    """A call that waits for a free connection."""

    body: Buffer
    until: float
    done: Done


class ServicePool:
    """Calls one local server over up to ``limits.SERVICE_POOL`` connections.

    Args:
        service: The service's name in the local graph.
        server: Its server.
        on_lost: Called when the server closed a connection, or does not answer at its address: it may be dead.
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
        """The number of connections, including those that are being opened."""
        return len(self._idle) + len(self._busy) + len(self._opening)

    @property
    def unused(self) -> bool:
        """Whether there is no connection and no call waits."""
        return not self.size and not self._queue

    async def describe(self) -> ServiceDescription:
        """Ask the server for its service's types and MD5 sum; the connection is kept for the first call.

        Raises:
            RmpaError: The server does not answer, or refuses.
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
        """Make a call; ``done`` is called once, perhaps before this method returns.

        Args:
            body: The request; it must not change until the call is done.
            timeout: Seconds until the caller gives up.
            done: Called with the response or the error.
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
        """Close all connections; the calls under way and those that wait fail with the reason."""
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
        """Wait until attempts to connect have ended; call after ``close``."""
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
        """Open a connection for each call that waits, up to ``limits.SERVICE_POOL`` in all."""
        while len(self._opening) < len(self._queue) and self.size < limits.SERVICE_POOL:
            task = self._loop.create_task(self._open(), name=f"connect to {self.service}")
            self._opening.add(task)
            task.add_done_callback(self._opening.discard)

    async def _open(self) -> None:
        try:
            connection = await self._connect()
        except RmpaError as error:
            # The waiting calls would fail as this attempt did; the next call makes a new attempt.
            self._on_lost()
            while self._queue and not self._busy:
                self._queue.popleft().done(False, str(error).encode(errors="replace"))
            return
        self._free(connection)

    async def _connect(self) -> ServiceConnection:
        return await ServiceConnection.open(self.server.uri, self.service, OWN_NODE, on_closed=self._on_lost)

    def _request(self, connection: ServiceConnection, call: _Waiting) -> bool:
        """Send a call's request; ``False`` if the connection was closed already, and nothing was sent."""
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
        """Give a connection that has become free to the next waiting call, or keep it."""
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
