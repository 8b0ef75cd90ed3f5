"""A link between two bridges: the real lanes, over wires that carry as many bytes as they are told to."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any, cast

from rmpa.core import limits as core_limits
from rmpa.core.outbox import FIRST, LAST, URGENT, Framer, Outbox, QueuedMessage
from rmpa.mesh.frames import Frame, FrameKind
from rmpa.mesh.io.lane import LaneSender
from rmpa.mesh.io.link import CONNECTION_URGENT_BYTES, PeerLink
from rmpa.runtime import limits as runtime_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.mesh.connection import DataHandler
    from tests.bridge.io.two_bridges import Side


class Wire:
    """One direction of one connection: the lane's stream, the kernel's buffers and the other end's parser."""

    def __init__(self, deliver: Callable[[Frame], None]) -> None:
        self.outbox = Outbox(1, CONNECTION_URGENT_BYTES)
        self.lost = False
        self._deliver = deliver
        self._flying = bytearray()
        self._loop = asyncio.get_running_loop()

    # As core.aio.stream.Stream, over a socket that never takes anything at once.

    def adopt(self, outbox: Outbox, _frame: Framer | None) -> None:
        """Send from this one from now on."""
        self.outbox = outbox

    def send(self, parts: Sequence[bytes | bytearray | memoryview], key: int) -> int:
        """Send a message."""
        data = b"".join(parts)
        if key == URGENT:
            self.outbox.push_urgent(data)
            return 0
        return self.outbox.push(data, key, self._loop.time())

    def send_mark(self, data: bytes, key: int) -> None:
        """Send a mark."""
        self.outbox.push(data, key, self._loop.time(), pinned=True)

    def extend(self, parcel: QueuedMessage, data: bytes | bytearray | memoryview) -> int:
        """Send a part."""
        return self.outbox.extend(parcel, bytes(data))

    def abandon(self, parcel: QueuedMessage) -> bool:
        """No more of it."""
        return self.outbox.abandon(parcel)

    def pump(self) -> None:
        """Send what was put into the outbox."""

    def carry(self, count: int, *, arrive: bool = True) -> int:
        """Let up to ``count`` bytes leave, and everything that is under way arrive; return how many left."""
        if self.lost:
            return 0
        left = 0
        while left < count and (parts := self.outbox.head(64, self._loop.time())):
            data = b"".join(parts)[: count - left]
            self.outbox.consumed(len(data))
            self._flying += data
            left += len(data)
        if arrive:
            self.arrive()
        return left

    def arrive(self) -> None:
        """What is under way arrives."""
        while not self.lost and (parsed := Frame.parse(self._flying)) is not None:
            frame, size = parsed
            del self._flying[:size]
            self._deliver(frame)


class LinkEnd:
    """What one bridge has of a link.

    Args:
        side: Its own.
        other: The one that it leads to.
    """

    remote_endpoint = ("10.0.0.9", 1)
    local_address = "10.0.0.8"

    def __init__(self, side: Side, other: Side) -> None:
        self.side = side
        self.identity = other.identity
        self.guid = other.identity.guid
        self.name = other.name
        self.silent = False
        self.crashed = False
        self.clock_offset: float | None = None
        self.clock_error: float | None = None
        self.gone = False
        self.busy = False
        self.expects_the_worst = False
        self.aborted = ""
        self.resumed_at = -math.inf
        self.touched_at = -math.inf
        self.needed = True
        self._loop = asyncio.get_running_loop()
        self._heard = self._loop.time()
        self.far: LinkEnd | None = None
        self.express, self.bulk = LaneSender("express"), LaneSender("bulk")
        for lane in (self.express, self.bulk):
            lane.outbox._fragment = core_limits.FRAGMENT_BYTES
        self.wires: dict[str, Wire] = {}
        self.routes: dict[int, DataHandler] = {}

    def __repr__(self) -> str:
        return f"{self.side.name}→{self.name}"

    def attach(self, lane: str) -> None:
        """A connection of a lane stands."""
        assert self.far is not None
        wire = self.wires[lane] = Wire(self.far.receive)
        (self.express if lane == "express" else self.bulk).connect(cast("Any", wire))

    # As mesh.io.link.PeerLink.

    def send_control(self, payload: bytes) -> None:
        """Send a control message."""
        assert not self.gone
        self.wires["express"].send((Frame(FrameKind.CONTROL, payload).serialize(),), URGENT)

    def when_proven(self, act: Callable[[], None]) -> None:
        """No process was stopped."""
        act()

    def need(self, *, needed: bool, parks: bool = False) -> None:
        """What the bridge says of this link."""
        self.needed = needed

    def mark(self, kind: FrameKind, route: int, sequence: int) -> None:
        """Send a mark."""
        if not self.gone:
            self.wires["express"].send((Frame(kind, route=route, sequence=sequence).serialize(),), URGENT)

    def close_route(self, route: int) -> int:
        """A route is closed."""
        return self.express.close_route(route) + self.bulk.close_route(route)

    def abort(self, text: str) -> None:
        """The other end has broken the protocol."""
        assert self.expects_the_worst, text
        self.aborted = text

    def receive(self, frame: Frame) -> None:
        """A frame came from the other end."""
        if self.gone:
            return
        now = self._loop.time()
        if now - self._heard > runtime_limits.STALE_AGE:
            self.resumed_at = now
        self._heard = now
        bridge, link = self.side.bridge, cast("PeerLink", self)
        if frame.kind is FrameKind.CONTROL:
            bridge.control(link, frame.payload)
        elif frame.kind is FrameKind.FENCE:
            self.mark(FrameKind.FENCED, frame.route, frame.sequence)
        elif frame.kind is not FrameKind.DATA:
            bridge.mark(link, frame.kind, frame.route, frame.sequence)
        elif (handler := self.routes.get(frame.route)) is None:
            bridge.counters.add("route.unknown")
        elif frame.flags == FIRST | LAST:
            handler.message(frame.sequence, frame.stamp_ns, memoryview(frame.payload))
        else:
            handler.part(frame.sequence, frame.stamp_ns, frame.flags, memoryview(frame.payload))

    def end(self, *, silent: bool) -> None:
        """This end notices that the link is gone."""
        if not self.gone:
            self.gone, self.silent = True, silent
            self.express.end()
            self.bulk.end()
            self.side.bridge.sessions.link_down(cast("PeerLink", self))
