"""How requests and replies cross a link: small ones by the express lane, larger ones by the bulk lane in fragments.

Nothing of a call may be dropped without a word: what waits for a slow link is bounded by ``Budget``, and a call
that would go beyond it fails with that reason.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.bridge import limits
from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.core.sizes import KIB, MIB
from rmpa.mesh import limits as mesh_limits
from rmpa.ros import limits as ros_limits
from rmpa.runtime.event_loop import yield_to_data

if TYPE_CHECKING:
    from rmpa.core.outbox import Outbox, QueuedMessage
    from rmpa.runtime.stream import Buffer

_LENGTH: Final = 4
_HEAD_MAX: Final = 1
"""In front of a response: whether it went well."""
_PORTION: Final = 256 * KIB
"""Of a large body at once, some 50 microseconds; then others have their turn."""
_AHEAD: Final = 4 * MIB
"""Of what is being sent, this much may wait for the link; the rest stays where it is."""
_WHOLE: Final = core_limits.FRAGMENT_BYTES - _LENGTH
"""Up to here a body goes in one frame."""
_PAUSE: Final = 0.005
"""Between two looks whether the link has taken some of that."""


class BodyLane(Protocol):
    """What is needed of one lane of a link (``mesh.io.lane.LaneSender``)."""

    outbox: Outbox
    ended: bool

    def send(self, route: int, sequence: int, stamp_ns: int, payload: Buffer) -> int:
        """Send one message."""
        ...

    def open(self, route: int, size: int, sequence: int, stamp_ns: int) -> QueuedMessage:
        """Begin one whose bytes follow."""
        ...

    def extend(self, parcel: QueuedMessage, data: Buffer) -> int:
        """Send further bytes of it."""
        ...

    def set_terms(self, route: int, depth: int, max_age: float | None, *, strict: bool) -> None:
        """Bound what may wait of a route."""
        ...


class BodyLink(Protocol):
    """What is needed of a link (``mesh.io.link.PeerLink``)."""

    @property
    def express(self) -> BodyLane:
        """For small ones."""
        ...

    @property
    def bulk(self) -> BodyLane:
        """For large ones."""
        ...

    def close_route(self, route: int) -> int:
        """Let go of what waits of a route."""
        ...


class Budget:
    """Bytes that one peer's calls may hold at once.

    Args:
        limit: How many.
    """

    def __init__(self, limit: int = limits.SERVICE_BYTES) -> None:
        self.limit = limit
        self.used = 0

    def take(self, size: int) -> bool:
        """Reserve some, if there is room; the first always has its room."""
        if self.used and self.used + size > self.limit:
            return False
        self.used += size
        return True

    def give(self, size: int) -> None:
        """Give some back."""
        self.used -= size


class BodySender:
    """Sends bodies on one route of a link, in order as far as they are of one size.

    Args:
        link: The peer's.
        route: The route's id, chosen by the receiver.
    """

    def __init__(self, link: BodyLink, route: int) -> None:
        self._link: BodyLink | None = link
        self._route = route
        self._large: deque[tuple[int, bytes, Buffer, Budget | None]] = deque()
        self._task: asyncio.Task[None] | None = None
        for lane in (link.express, link.bulk):
            lane.set_terms(route, mesh_limits.KEEP_ALL_MESSAGES, None, strict=False)

    def send(self, sequence: int, body: Buffer, head: bytes = b"", budget: Budget | None = None) -> bool:
        """Send one body behind ``head``; whether it takes the bulk lane.

        Args:
            sequence: Of the call.
            body: It must not change until it has left.
            head: In front of it.
            budget: Gets the body's bytes back when it has left.
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
        """Send no more, and let go of what waits."""
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

    def _send_whole(self, lane: BodyLane) -> None:
        sequence, head, body, _ = self._large[0]
        size = len(head) + len(body)
        framed = b"".join((size.to_bytes(_LENGTH, "little"), head, body))
        lane.send(self._route, sequence, time.time_ns(), framed)
        self._left()

    async def _drain(self) -> None:
        """Send large ones a portion at a time: to copy one of 64 MiB at once holds everything up for 30 ms."""
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
    """Takes the bodies that come on one route, as its ``bridge.data.io.receiver.DataHandler``; for subclasses.

    Args:
        budget: What the peer's bodies may hold while they are put together.
    """

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._sequence: int | None = None
        self._buffer: bytearray | None = None
        self._size = 0

    def body(self, sequence: int, body: bytes | bytearray) -> None:
        """A whole one came; it belongs to the taker, and nothing of it is held in the budget any more."""
        raise NotImplementedError

    def failed(self, sequence: int, reason: str) -> None:
        """One that had begun will not come."""
        raise NotImplementedError

    def message(self, sequence: int, _stamp_ns: int, framed: memoryview) -> None:
        """A whole message."""
        self.body(sequence, bytes(framed[_LENGTH:]))

    def part(self, sequence: int, _stamp_ns: int, flags: int, part: memoryview) -> None:
        """A part of a large one.

        Raises:
            LimitExceeded: It claims to be larger than a service's message may be.
            RemoteProtocolError: It has no length, or more bytes than that said.
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
            self._sequence = self._buffer = None
            if buffer is not None:
                self._budget.give(self._size)
                if len(buffer) != self._size:
                    raise RemoteProtocolError(f"a service's message of {self._size} bytes has only {len(buffer)}")
                self.body(sequence, buffer)

    def drop(self, reason: str) -> None:
        """What came of a body in parts is not followed by the rest."""
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
        if size > ros_limits.SERVICE_MESSAGE_MAX + _HEAD_MAX:
            raise LimitExceeded("service message", size, ros_limits.SERVICE_MESSAGE_MAX + _HEAD_MAX)
        self._sequence, self._size = sequence, size
        if self._budget.take(size):
            self._buffer = bytearray()
        else:
            self._buffer = None  # its parts pass unkept
            text = f"large calls hold {self._budget.used >> 20} MiB already: at most {self._budget.limit >> 20}"
            self.failed(sequence, text)
        return part[_LENGTH:]
