"""How requests and replies cross a link: small ones by the express lane, larger ones by the bulk lane in fragments.

No part of a call may be dropped silently. ``Budget`` bounds what waits for a slow link, and a call that would exceed
it fails with that reason.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.limits import KIB, MIB
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh import limits as mesh_limits
from rmpa.ros import limits as ros_limits
from rmpa.runtime.loop import yield_to_data

if TYPE_CHECKING:
    from rmpa.mesh.io.link import LaneSender, PeerLink
    from rmpa.runtime.tls import Buffer

_LENGTH: Final = 4
_HEAD_MAX: Final = 1
"""Bytes in front of a reply that state whether the call succeeded."""
_PORTION: Final = 256 * KIB
"""Bytes of a large body that are copied at once, in some 50 microseconds; then other tasks run."""
_AHEAD: Final = 4 * MIB
"""Bytes waiting on the bulk lane above which no further portion is copied to it."""
_WHOLE: Final = core_limits.FRAGMENT_BYTES - _LENGTH
"""Bytes of a body, head included, up to which it is sent in one frame."""
_PAUSE: Final = 0.005
"""Seconds between two checks of how much waits on the bulk lane."""


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
            lane.set_terms(route, mesh_limits.KEEP_ALL_MESSAGES, None, strict=False)

    def send(self, sequence: int, body: Buffer, head: bytes = b"", budget: Budget | None = None) -> bool:
        """Send one body; return whether it takes the bulk lane. After ``close`` it is dropped.

        Args:
            sequence: The number of the call.
            body: The bytes; they must not change until they were sent.
            head: Bytes in front of the body.
            budget: Gets the body's bytes back when they were handed to the link, or dropped.
        """
        link = self._link
        size = len(head) + len(body)
        if link is None or size <= mesh_limits.EXPRESS_MESSAGE_MAX:
            if link is not None:
                framed = b"".join((size.to_bytes(_LENGTH, "little"), head, body))
                link.express.send(self._route, sequence, time.time_ns(), framed)
            if budget is not None:
                budget.give(len(body))
            return False
        self._large.append((sequence, head, body, budget))
        if self._task is None:
            if size <= _WHOLE:
                self._send_whole(link.bulk)
            else:
                self._task = asyncio.get_running_loop().create_task(self._drain(), name=f"bodies {self._route}")
        return True

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

    def _send_whole(self, lane: LaneSender) -> None:
        sequence, head, body, _ = self._large[0]
        size = len(head) + len(body)
        framed = b"".join((size.to_bytes(_LENGTH, "little"), head, body))
        lane.send(self._route, sequence, time.time_ns(), framed)
        self._left()

    async def _drain(self) -> None:
        """Send large bodies a portion at a time: copying 64 MiB at once would block the event loop for 30 ms."""
        while self._large and self._link is not None:
            lane = self._link.bulk
            sequence, head, body, _ = self._large[0]
            size = len(head) + len(body)
            if size <= _WHOLE:
                self._send_whole(lane)
                continue
            parcel = lane.open(self._route, _LENGTH + size, sequence, time.time_ns())
            view = memoryview(body)
            lane.extend(parcel, b"".join((size.to_bytes(_LENGTH, "little"), head, view[:_PORTION])))
            for start in range(_PORTION, len(view), _PORTION):
                yield_to_data()
                await asyncio.sleep(0)
                while lane.outbox.pending_bytes > _AHEAD and not (lane.ended or parcel.dropped):  # noqa: ASYNC110
                    await asyncio.sleep(_PAUSE)
                lane.extend(parcel, view[start : start + _PORTION])
            self._left()
        self._task = None


class BodyReceiver:
    """Reassembles the bodies that arrive on one route; a ``bridge.data.io.receiver.DataHandler``, for subclasses.

    Args:
        budget: Bounds the bytes of the peer's bodies while they are reassembled.
        most: Bytes that a body may have.
    """

    def __init__(self, budget: Budget, most: int = ros_limits.SERVICE_MESSAGE_MAX + _HEAD_MAX) -> None:
        self._budget = budget
        self._most = most
        self._sequence: int | None = None
        self._buffer: bytearray | None = None
        self._size = 0
        self._stamp_ns = 0
        """When the present body was sent, by the peer's clock."""

    def body(self, sequence: int, body: bytes | bytearray) -> None:
        """Handle a complete body, which belongs to the callee; it no longer counts in the budget."""
        raise NotImplementedError

    def failed(self, sequence: int, reason: str) -> None:
        """Handle the loss of a body whose first part had arrived."""
        raise NotImplementedError

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """Handle a body that arrived in one frame."""
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
        buffer = self._buffer
        if flags & ABORT:
            self.drop("its sender gave it up")
            return
        if buffer is not None:
            if len(buffer) + len(part) > self._size:
                raise RemoteProtocolError(f"a service's message of {self._size} bytes has more than that")
            buffer += part
        if flags & LAST:
            self._stamp_ns = stamp_ns
            self._sequence = self._buffer = None
            if buffer is not None:
                self._budget.give(self._size)
                if len(buffer) != self._size:
                    raise RemoteProtocolError(f"a service's message of {self._size} bytes has only {len(buffer)}")
                self.body(sequence, buffer)

    def drop(self, reason: str) -> None:
        """Give up a body of which only parts have arrived, if there is one; ``failed`` gets the reason."""
        sequence, self._sequence = self._sequence, None
        buffer, self._buffer = self._buffer, None
        if buffer is not None and sequence is not None:
            self._budget.give(self._size)
            self.failed(sequence, reason)

    def _begin(self, sequence: int, part: memoryview) -> memoryview:
        if len(part) < _LENGTH:
            raise RemoteProtocolError(f"a first part of {len(part)} bytes has no length")
        self.drop("another one began before its end")
        size = int.from_bytes(part[:_LENGTH], "little")
        if size > self._most:
            raise LimitExceeded("service message", size, self._most)
        self._sequence, self._size = sequence, size
        if self._budget.take(size):
            self._buffer = bytearray()
        else:
            self._buffer = None  # its parts are not kept
            text = f"large calls hold {self._budget.used >> 20} MiB already: at most {self._budget.limit >> 20}"
            self.failed(sequence, text)
        return part[_LENGTH:]
