"""The sending end of one lane of a link, whether the lane has its connection or not.

Messages that are sent while there is no connection wait within the lane's bounds, and go first over the next one.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.core import limits as core_limits
from rmpa.core.facts import LaneInfo
from rmpa.core.identity import SERIAL_MASK
from rmpa.core.outbox import Outbox, QueuedMessage
from rmpa.mesh import limits
from rmpa.mesh.frames import Frame, FrameKind, pack_data_header, pack_fragment_header

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.runtime.stream import Stream
    from rmpa.runtime.tls import Buffer


def _nothing() -> None:
    """The ``on_wanted`` of a lane that always has a connection, or that has ended."""


class LaneSender:
    """Sends data frames by one lane of a link.

    Args:
        name: ``express`` or ``bulk``, for people.
        on_wanted: Called when something is queued while the lane has no connection.

    Attributes:
        ended: Whether the link is closing: nothing is sent or queued any more.
    """

    def __init__(self, name: str, on_wanted: Callable[[], None] = _nothing) -> None:
        self.name = name
        self._on_wanted = on_wanted
        self.outbox = Outbox(core_limits.ROUTE_QUEUE_MESSAGES, limits.LANE_QUEUE_BYTES, frame=pack_fragment_header)
        self.ended = False
        self._stream: Stream | None = None
        # The messages that ``open`` has begun, by route.
        self._open: dict[int, QueuedMessage] = {}
        self._loop = asyncio.get_running_loop()

    def info(self, *, unneeded: bool = False) -> LaneInfo:
        """Its piece of the snapshot; ``unneeded``: no message has wanted it yet."""
        it, dropped = self._stream, self.outbox.dropped.total()
        counts = (0, 0, self.outbox.pending_bytes) if it is None else (it.bytes_in, it.bytes_out, it.pending_bytes)
        return LaneInfo(self.name, it is not None, unneeded, *counts, dropped)

    def connect(self, stream: Stream) -> None:
        """Use a connection from now on; waiting messages are sent first."""
        self._stream = stream
        stream.adopt(self.outbox, pack_fragment_header)

    def disconnect(self) -> int:
        """Handle the end of the connection; return how many messages were cut off, without those in the kernel."""
        self._stream = None
        for parcel in self._open.values():
            if 0 < parcel.sent < parcel.size:
                parcel.dropped = True  # its first bytes were lost with the connection
        self._open.clear()
        return self.outbox.reset()

    def end(self) -> None:
        """Take no more messages, because the link closes; waiting ones are sent within the drain time."""
        self.ended = True
        self._on_wanted = _nothing  # its link holds this lane
        self._stream = None

    def clear(self) -> None:
        """Drop the waiting messages, because the link is gone."""
        self.outbox.clear()
        self._open.clear()

    def send(self, route: int, sequence: int, stamp_ns: int, payload: Buffer) -> int:
        """Send one message; bytes that the socket does not take are copied into a keep-last queue.

        Args:
            route: The route's id, 32 bits.
            sequence: The message's number on its route; its low 32 bits are sent.
            stamp_ns: When it was published, wall clock.
            payload: Its bytes, not kept after the call.

        Returns:
            How many older messages were dropped to make room. Without effect (0) once the link is closing.
        """
        size = len(payload)
        if size > core_limits.FRAGMENT_BYTES:
            return self.extend(self._parcel(route, size, sequence, stamp_ns), payload)
        header = pack_data_header(size, route, sequence, stamp_ns)
        if self._stream is not None:
            return self._stream.send((header, payload), route)
        if self.ended:
            return 0
        dropped = self.outbox.push(b"".join((header, payload)), route, self._loop.time())
        self._on_wanted()
        return dropped

    def open(self, route: int, size: int, sequence: int, stamp_ns: int) -> QueuedMessage:
        """Begin a message of ``size`` bytes that follow by ``extend``, before the next one of its route."""
        parcel = self._open[route] = self._parcel(route, size, sequence, stamp_ns)
        return parcel

    def _parcel(self, route: int, size: int, sequence: int, stamp_ns: int) -> QueuedMessage:
        return QueuedMessage(route, size, sequence & SERIAL_MASK, stamp_ns, self._loop.time())

    def extend(self, parcel: QueuedMessage, data: Buffer) -> int:
        """Send further bytes of an opened message; return how many older messages were dropped to make room."""
        if self._stream is not None:
            return self._stream.extend(parcel, data)
        if self.ended:
            return 0
        dropped = self.outbox.extend(parcel, bytes(data))
        self._on_wanted()
        return dropped

    def abandon(self, parcel: QueuedMessage) -> None:
        """Give up a message whose rest will never come."""
        if self._stream is not None:
            self._stream.abandon(parcel)
        elif not self.ended:
            self.outbox.abandon(parcel)

    def fence(self, route: int, number: int) -> None:
        """Send a fence after the messages of a route; the peer answers it when all of them have arrived."""
        frame = Frame(FrameKind.FENCE, route=route, sequence=number).serialize()
        if self._stream is not None:
            self._stream.send_mark(frame, route)
        elif not self.ended:
            self.outbox.push(frame, route, self._loop.time(), pinned=True)
            self._on_wanted()

    def set_terms(
        self, route: int, depth: int, max_age: float | None = None, *, above: int = 0, spared: bool = False
    ) -> None:
        """Bound the waiting messages of one route; see ``core.outbox``.

        ``above`` as there; 0: also the newest message is dropped beyond ``max_age``, which is a lifespan.
        """
        self.outbox.set_terms(route, depth, max_age, strict=not above, above=above, spared=spared)

    def discard(self, route: int) -> int:
        """Drop the waiting messages of a route, and its bounds; the route stays open. Returns their number."""
        count = self.outbox.discard(route)
        self._open.pop(route, None)
        if self._stream is not None:
            self._stream.pump()
        return count

    def close_route(self, route: int) -> int:
        """Discard the waiting messages of a closed route, and its counts; return the number of messages."""
        count = self.discard(route)
        self.outbox.dropped.pop(route, None)
        self.outbox.expired.pop(route, None)
        return count
