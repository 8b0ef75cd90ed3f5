"""The bodies of calls and of large requests on a link, and the pool of connections to a local server.

How requests and replies cross a link: small ones by the express lane, larger ones by the bulk lane in fragments.

No part of a call may be dropped silently. ``Budget`` bounds what waits for a slow link, and a call that would exceed
it fails with that reason.
"""

from __future__ import annotations

import asyncio
import logging
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.policy import Local
from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError, RmpaError
from rmpa.core.identity import OWN_NODE
from rmpa.core.limits import KIB, MIB
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh import limits as mesh_limits
from rmpa.ros import limits as ros_limits
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.runtime.loop import yield_to_data
from rmpa.runtime.tasks import OwnedTasks, start_task

if TYPE_CHECKING:
    from rmpa.bridge.messages import Origin
    from rmpa.mesh.io.lane import LaneSender
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.wire.tcpros import ServiceDescription
    from rmpa.runtime.tls import Buffer

_log = logging.getLogger(__name__)

_LENGTH: Final = 4
# Bytes of a large body that are copied at once, in some 50 microseconds; then other tasks run.
_PORTION: Final = 256 * KIB
# Bytes waiting on the bulk lane above which no further portion is copied to it.
_AHEAD: Final = 4 * MIB
# Bytes of a body, head included, up to which it is sent in one frame.
_WHOLE: Final = core_limits.FRAGMENT_BYTES - _LENGTH


class Budget:
    """Counts the bytes that the calls of one peer hold, and limits them.

    Args:
        limit: How many bytes may be held at once.
    """

    def __init__(self, limit: int = limits.SERVICE_BYTES) -> None:
        self.limit = limit
        self.used = 0

    def take(self, size: int) -> bool:
        """Reserve ``size`` bytes and return ``True``, if there is room; an empty budget has room for any size."""
        if self.used and self.used + size > self.limit:
            return False
        self.used += size
        return True

    def give(self, size: int) -> None:
        """Return ``size`` reserved bytes."""
        self.used -= size


class BodySender:
    """Sends bodies on one route of a link.

    Small bodies stay in order, and so do large ones; a small body may overtake a large one.

    Args:
        link: The link to the peer.
        route: The route's number, chosen by the receiver.
    """

    def __init__(self, link: PeerLink, route: int) -> None:
        self._link: PeerLink | None = link
        self._route = route
        self._large: deque[tuple[int, bytes, Buffer, Budget | None]] = deque()
        self._task: asyncio.Task[None] | None = None
        for lane in (link.express, link.bulk):
            lane.set_terms(route, mesh_limits.KEEP_ALL_MESSAGES, spared=True)

    def send(self, sequence: int, body: Buffer, head: bytes = b"", budget: Budget | None = None) -> bool:
        """Send one body; return whether it takes the bulk lane. After ``close`` it is dropped.

        Args:
            sequence: The number of the call.
            body: The bytes; they must not change until they were sent.
            head: Bytes in front of the body.
            budget: Gets the body's bytes back when they were handed to the link, or dropped.
        """
        if self._link is not None and len(head) + len(body) > mesh_limits.EXPRESS_MESSAGE_MAX:
            self._large.append((sequence, head, body, budget))
            self._send_large()
            return True
        if self._link is not None:
            self._link.express.send(self._route, sequence, time.time_ns(), _framed(head, body))
        if budget is not None:
            budget.give(len(body))
        return False

    @property
    def closed(self) -> bool:
        """Whether nothing is sent any more."""
        return self._link is None

    def close(self) -> None:
        """Send nothing more, and drop what waits."""
        link, self._link = self._link, None
        while self._large:
            self._left()
        if self._task is not None:
            self._task.cancel()
            self._task = None
        if link is not None:
            link.close_route(self._route)

    def _left(self) -> None:
        _, _, body, budget = self._large.popleft()
        if budget is not None:
            budget.give(len(body))

    def _send_large(self) -> None:
        """Send the bodies of one frame that are next; a task sends the one behind them, then what comes next."""
        while self._large and self._task is None and self._link is not None:
            sequence, head, body, _ = self._large[0]
            if len(head) + len(body) > _WHOLE:
                work = self._send_portions(self._link.bulk, sequence, head, body)
                self._task = start_task(work, f"bodies {self._route}")
                return
            self._link.bulk.send(self._route, sequence, time.time_ns(), _framed(head, body))
            self._left()

    async def _send_portions(self, lane: LaneSender, sequence: int, head: bytes, body: Buffer) -> None:
        """Send a body a portion at a time: copying 64 MiB at once would block the event loop for 30 ms."""
        parcel = lane.open(self._route, _LENGTH + len(head) + len(body), sequence, time.time_ns())
        view = memoryview(body)
        lane.extend(parcel, _framed(head, view[:_PORTION], len(head) + len(body)))
        for start in range(_PORTION, len(view), _PORTION):
            yield_to_data()
            await asyncio.sleep(0)
            while lane.outbox.pending_bytes > _AHEAD and not (lane.ended or parcel.dropped):  # noqa: ASYNC110
                await asyncio.sleep(0.005)
            lane.extend(parcel, view[start : start + _PORTION])
        self._left()
        self._task = None
        self._send_large()


def _framed(head: bytes, body: Buffer, size: int | None = None) -> bytes:
    """A body with its length in front; ``size``: that of the whole, if this is its first portion."""
    length = len(head) + len(body) if size is None else size
    return b"".join((length.to_bytes(_LENGTH, "little"), head, body))


class BodyReceiver(ABC):
    """Reassembles the bodies that arrive on one route; for subclasses.

    Args:
        budget: Bounds the bytes of the peer's bodies while they are reassembled.
        most: Bytes that a body may have; a reply's first byte states whether the call succeeded.

    Attributes:
        _stamp_ns: When the present body was sent, by the peer's clock.
    """

    def __init__(self, budget: Budget, most: int = ros_limits.SERVICE_MESSAGE_MAX + 1) -> None:
        self._budget = budget
        self._most = most
        self._sequence: int | None = None
        self._buffer = bytearray()
        self._size = 0
        self._stamp_ns = 0

    @abstractmethod
    def body(self, sequence: int, body: bytes | bytearray) -> None:
        """Handle a complete body, which belongs to the callee; it no longer counts in the budget."""

    @abstractmethod
    def failed(self, sequence: int, reason: str) -> None:
        """Handle the loss of a body whose first part had arrived."""

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """Handle a body that arrived in one frame.

        Raises:
            RemoteProtocolError: The frame does not hold exactly one body.
        """
        if int.from_bytes(framed[:_LENGTH], "little") != len(framed) - _LENGTH:
            raise RemoteProtocolError(f"a data frame of {len(framed)} bytes does not hold one message")
        self._stamp_ns = stamp_ns
        self.body(sequence, bytes(framed[_LENGTH:]))

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Handle a part of a large body.

        Raises:
            LimitExceeded: The body's stated size is above that of a service's message.
            RemoteProtocolError: The size is missing, or the parts have more or fewer bytes than it states.
        """
        if flags & FIRST:
            part = self._begin(sequence, part)
        if sequence != self._sequence:
            return
        if flags & ABORT:
            self.drop("its sender gave it up")
            return
        buffer, size = self._buffer, self._size
        buffer += part
        if len(buffer) > size:
            raise RemoteProtocolError(f"a service's message of {size} bytes has more than that")
        if flags & LAST:
            self._stamp_ns = stamp_ns
            self.discard()
            if len(buffer) != size:
                raise RemoteProtocolError(f"a service's message of {size} bytes has only {len(buffer)}")
            self.body(sequence, buffer)

    def drop(self, reason: str) -> None:
        """Give up a body of which only parts have arrived, if there is one; ``failed`` gets the reason."""
        if (sequence := self.discard()) is not None:
            self.failed(sequence, reason)

    def discard(self) -> int | None:
        """Forget a body of which only parts have arrived; return its number, or ``None`` if there is none."""
        sequence, self._sequence, self._buffer = self._sequence, None, bytearray()
        if sequence is not None:
            self._budget.give(self._size)
        return sequence

    def _begin(self, sequence: int, part: memoryview) -> memoryview:
        if len(part) < _LENGTH:
            raise RemoteProtocolError(f"a first part of {len(part)} bytes has no length")
        self.drop("another one began before its end")
        size = int.from_bytes(part[:_LENGTH], "little")
        if size > self._most:
            raise LimitExceeded("service message", size, self._most)
        if self._budget.take(size):
            self._sequence, self._size = sequence, size
        else:  # its other parts are not those of a body that is known
            text = f"large calls hold {self._budget.used >> 20} MiB already: at most {self._budget.limit >> 20}"
            self.failed(sequence, text)
        return part[_LENGTH:]


@dataclass(frozen=True, slots=True)
class LocalService(Local):
    """A service's server in the local graph: its node, its ``rosrpc://`` address, and its origin if relayed."""

    node: str
    uri: str
    origin: Origin | None = None
    type = None


# Called with ``(ok, body)``: the response, or the text of the error.
Done = Callable[[bool, "Buffer"], None]


class ServicePool:
    """Calls one local server over up to ``limits.SERVICE_POOL`` connections.

    Args:
        service: The service's name in the local graph.
        server: Its server.
        on_lost: Called when the server closed a connection, or does not answer at its address: it may be dead.

    Attributes:
        _queue: The calls that wait: request, until when, and the callback.
    """

    def __init__(self, service: str, server: LocalService, on_lost: Callable[[], None]) -> None:
        self.service = service
        self.server = server
        self._on_lost = on_lost
        self._loop = asyncio.get_running_loop()
        self._idle: list[tuple[ServiceConnection, float]] = []
        self._busy: set[ServiceConnection] = set()
        self._opening = OwnedTasks()
        self._queue: deque[tuple[Buffer, float, Done]] = deque()
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
        return (await self._connect()).description

    def call(self, body: Buffer, timeout: float, done: Done) -> None:
        """Make a call; ``done`` is called once, perhaps before this method returns.

        Args:
            body: The request; it must not change until the call is done.
            timeout: Seconds until the caller gives up.
            done: Called with the response or the error.
        """
        if len(self._queue) >= limits.SERVICE_QUEUE:
            done(False, self._text(f"{len(self._queue)} calls wait for its server already"))
            return
        self._queue.append((body, self._loop.time() + timeout, done))
        self._serve()

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
        self._opening.cancel()
        for connection in [*(connection for connection, _ in self._idle), *self._busy]:
            connection.close()
        self._idle.clear()
        while self._queue:
            self._queue.popleft()[2](False, self._text(reason))

    async def closed(self) -> None:
        """Wait until attempts to connect have ended; call after ``close``."""
        await self._opening.close()

    def _text(self, reason: str) -> bytes:
        return f"service [{self.service}]: {reason}".encode(errors="replace")

    def _serve(self) -> None:
        """Give the calls that wait to free connections, and open more for the rest, ``SERVICE_POOL`` in all."""
        while self._queue and self._idle:
            connection, since = self._idle.pop()
            body, until, done = self._queue.popleft()
            rest = until - self._loop.time()
            problem = self._text("its server had no time for this call") if rest <= 0 else b""
            try:
                if not problem:
                    connection.request(body, partial(self._answered, connection, done), rest)
                    self._busy.add(connection)
                    continue
            except (ServiceFailed, LocalProtocolError) as error:  # nothing was sent
                if isinstance(error, LocalProtocolError) or connection.closed:
                    connection.close()
                    self._queue.appendleft((body, until, done))
                    continue
                problem = str(error).encode(errors="replace")
            self._idle.append((connection, since))
            done(False, problem)
        while len(self._opening) < len(self._queue) and self.size < limits.SERVICE_POOL:
            self._opening.start(self._open(), f"connect to {self.service}")

    async def _open(self) -> None:
        try:
            await self._connect()
        except RmpaError as error:
            # The waiting calls would fail as this attempt did; the next call makes a new attempt.
            while self._queue and not self._busy:
                self._queue.popleft()[2](False, str(error).encode(errors="replace"))

    async def _connect(self) -> ServiceConnection:
        try:
            connection = await ServiceConnection.open(
                self.server.uri, self.service, OWN_NODE, on_closed=self._on_lost
            )
        except RmpaError:
            self._on_lost()
            raise
        self._free(connection)
        return connection

    def _answered(
        self, connection: ServiceConnection, done: Done, result: tuple[bool, bytes | bytearray] | ServiceFailed
    ) -> None:
        self._busy.discard(connection)
        if not isinstance(result, ServiceFailed):
            done(*result)
            self._free(connection)
            return
        connection.close()
        done(False, str(result).encode(errors="replace"))
        if not self._closed:
            self._on_lost()
            self._serve()

    def _free(self, connection: ServiceConnection) -> None:
        if self._closed:
            connection.close()
        elif not connection.closed:
            self._idle.append((connection, self._loop.time()))
        self._serve()
