"""The link to a peer: its two lanes, what is sent on each, and the dialling of the bulk lane.

The bulk lanes of all links: each is dialled when a message first wants it, and ends with its link.

Only the side that dialled the link dials its bulk lane; the other side asks for it by a lane frame.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.counters import Backoff
from rmpa.core.identity import SERIAL_MASK
from rmpa.core.outbox import FIRST, LAST, Outbox, QueuedMessage
from rmpa.mesh import limits
from rmpa.mesh.frames import Frame, FrameKind, pack_data_header, pack_fragment_header

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from rmpa.core.counters import Counters
    from rmpa.mesh.connection import DataHandler
    from rmpa.mesh.io.connection import Connection
    from rmpa.runtime.loop import SystemClock
    from rmpa.runtime.stream import Stream
    from rmpa.runtime.tls import Buffer


# The sending end of one lane of a link, whether the lane has its connection or not.
#
# Messages that are sent while there is no connection wait within the lane's bounds, and go first over the next one.


class LaneSender:
    """Sends data frames by one lane of a link.

    Args:
        name: ``express`` or ``bulk``, for people.
        on_wanted: Called when something is queued while the lane has no connection.
    """

    def __init__(self, name: str, on_wanted: Callable[[], None] | None = None) -> None:
        self.name = name
        self._on_wanted = on_wanted if on_wanted is not None else _nothing
        self.outbox = Outbox(core_limits.ROUTE_QUEUE_MESSAGES, limits.LANE_QUEUE_BYTES, frame=pack_fragment_header)
        self.ended = False
        """Whether the link is closing: nothing is sent or queued any more."""
        self._stream: Stream | None = None
        self._open: dict[int, QueuedMessage] = {}
        """The messages that ``open`` has begun, by route."""
        self._loop = asyncio.get_running_loop()

    @property
    def connected(self) -> bool:
        """Whether the lane has its connection."""
        return self._stream is not None

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
        frame = Frame(FrameKind.FENCE, route=route, sequence=number, flags=FIRST | LAST).serialize()
        if self._stream is not None:
            self._stream.send_mark(frame, route)
        elif not self.ended:
            self.outbox.push(frame, route, self._loop.time(), pinned=True)
            self._on_wanted()

    def set_terms(self, route: int, depth: int, max_age: float | None, *, strict: bool) -> None:
        """Bound the waiting messages of one route; see ``core.outbox``.

        Without ``max_age`` the route is a reliable one: its sender's window bounds it, and the bound on the bytes of
        all routes drops none of its messages.
        """
        self.outbox.set_terms(route, depth, max_age, strict=strict, spared=max_age is None)

    def discard(self, route: int) -> None:
        """Drop the waiting messages of a route, and its bounds; the route stays open."""
        self.outbox.discard(route)
        self._open.pop(route, None)
        if self._stream is not None:
            self._stream.pump()

    def close_route(self, route: int) -> int:
        """Discard the waiting messages of a closed route, and its counts; return the number of messages."""
        count = self.outbox.discard(route)
        self._open.pop(route, None)
        self.outbox.dropped.pop(route, None)
        self.outbox.expired.pop(route, None)
        if self._stream is not None:
            self._stream.pump()
        return count


def _nothing() -> None:
    """The ``on_wanted`` of a lane that always has a connection, or that has ended."""


# The link to one peer: two lanes, each with a connection, and the handlers of the received messages.


OnLinkMark = Callable[["PeerLink", FrameKind, int, int], None]


@dataclass(frozen=True, slots=True)
class LinkHandlers:
    """The handlers of the marks and events of a link that is used with its peer.

    Args:
        mark: ``(link, kind, route, sequence)``: an acknowledgement, or the answer to a fence.
        clock: ``(link)``: the estimate of the peer's clock is new or more exact.
        lane_lost: ``(link)``: the bulk lane lost its connection, with the messages in flight; the link is still up.
    """

    mark: OnLinkMark
    clock: Callable[[PeerLink], None]
    lane_lost: Callable[[PeerLink], None]


class PeerLink:
    """The link to one peer, as the rooms above see it; it lives as long as the connection of its express lane.

    The connection of the bulk lane may be missing, fall or be replaced meanwhile; messages for that lane wait.

    Args:
        connection: That of the express lane; its handshake is done.
        clock: The time.
        on_bulk_wanted: Called with this link when something waits for the bulk lane, which has no connection.
    """

    def __init__(
        self, connection: Connection, clock: SystemClock, on_bulk_wanted: Callable[[PeerLink], None]
    ) -> None:
        self.id: Final = connection.id
        self.identity: Final = connection.identity
        self.guid: Final = connection.identity.guid
        self.name: Final = connection.identity.name
        self.remote_endpoint: Final = connection.remote_endpoint
        self.local_address: Final = connection.local_address
        self.dialled: Final = connection.dialled
        self.since: Final = connection.since
        """Monotonic seconds at which it came up."""
        self.connection: Final = connection
        """The connection of the express lane."""
        self.bulk_connection: Connection | None = None
        """The connection of the bulk lane, while there is one."""
        self.express: Final = LaneSender("express")
        self.bulk: Final = LaneSender("bulk", lambda: on_bulk_wanted(self))
        self.routes: dict[int, DataHandler] = {}
        """The handlers of the data that arrives, by route; both lanes look here while the link is used."""
        self.bulk_wanted = False
        """Whether a message of either side has wanted the bulk lane."""
        self.silent = False
        """Once the link is down: whether it ended without a bye, so that the peer may soon be linked again."""
        self.crashed = False
        """Once the link is down: whether the peer's agent died, or a better link took over; its nodes go on."""
        self.mark: Final = connection.send_mark
        """``(kind, route, sequence)``: acknowledges messages of a route, before all waiting data."""
        self.touched_at = clock.now()
        """Monotonic seconds of the last control frame in either direction."""
        self._clock = clock
        self._needed = True
        self._handlers: LinkHandlers | None = None
        self._bulk_bytes_in = self._bulk_bytes_out = 0  # of the bulk lane's earlier connections
        self.express.connect(connection.stream)

    @property
    def used(self) -> bool:
        """Whether this link carries the peer's data; of two links with one peer, only one is used."""
        return self._handlers is not None

    @property
    def up(self) -> bool:
        """Whether messages go through."""
        return self.connection.up

    @property
    def rtt(self) -> float | None:
        """The last round trip in seconds; ``None`` before the first."""
        return self.connection.clock.rtt

    @property
    def clock_offset(self) -> float | None:
        """Seconds that the peer's wall clock is ahead of ours; ``None`` if unknown."""
        estimate = self.connection.clock.estimate(self._clock.now())
        return None if estimate is None else estimate[0]

    @property
    def clock_error(self) -> float | None:
        """The offset is true within ± this many seconds; ``None`` if unknown."""
        estimate = self.connection.clock.estimate(self._clock.now())
        return None if estimate is None else estimate[1]

    @property
    def abandoned(self) -> bool:
        """Whether the peer has given up what it asked over this link; see ``ConnectionProtocol.abandoned``."""
        bulk = self.bulk_connection
        return self.connection.abandoned or (bulk is not None and bulk.abandoned)

    @property
    def resumed_at(self) -> float:
        """Monotonic seconds of the express lane's last poll without bytes before its last silence ended."""
        return self.connection.stream.resumed_at

    @property
    def bytes_in(self) -> int:
        """Bytes received, headers included, by both lanes."""
        bulk = self.bulk_connection.stream.bytes_in if self.bulk_connection else 0
        return self.connection.stream.bytes_in + self._bulk_bytes_in + bulk

    @property
    def bytes_out(self) -> int:
        """Bytes that the kernel took, headers included, on both lanes."""
        bulk = self.bulk_connection.stream.bytes_out if self.bulk_connection else 0
        return self.connection.stream.bytes_out + self._bulk_bytes_out + bulk

    @property
    def queue_bytes(self) -> int:
        """Bytes that the kernel has not taken yet, on both lanes."""
        return self.connection.stream.pending_bytes + self.bulk.outbox.pending_bytes

    @property
    def busy(self) -> bool:
        """Whether the express lane has a backlog, so that a further advertisement would delay later commands."""
        stream = self.connection.stream
        return stream.pending_bytes > 0 or stream.unacknowledged > limits.TELL_BACKLOG

    @property
    def dropped(self) -> int:
        """Messages dropped so far because the peer took them too slowly."""
        return self.express.outbox.dropped.total() + self.bulk.outbox.dropped.total()

    @property
    def expired(self) -> int:
        """Messages dropped so far because they had become too old before the peer took them."""
        return self.express.outbox.expired.total() + self.bulk.outbox.expired.total()

    @property
    def heard_at(self) -> float:
        """Monotonic seconds at which bytes were last received on the express lane."""
        return self.connection.heard_at

    def send_control(self, payload: bytes) -> None:
        """Send one control frame, before all data that waits; never dropped; see ``Connection``."""
        self.touch()
        self.connection.send_control(payload)

    @property
    def rests(self) -> bool:
        """Whether the link is at rest: keepalives are rare, and silence is noticed within ``lease``."""
        return self.connection.rests

    @property
    def lease(self) -> float:
        """Seconds of silence after which the link counts as lost."""
        return self.connection.remote_lease

    def need(self, *, needed: bool) -> None:
        """Say whether something of this module depends on the link; it rests when neither side needs it.

        A control frame in either direction makes the link needed; only its user can say that it is not.
        """
        self._needed = needed
        self.connection.need(needed=needed)
        if self.bulk_connection is not None:
            self.bulk_connection.need(needed=needed)

    def touch(self) -> None:
        """A control frame was sent or received: something begins."""
        self.touched_at = self._clock.now()
        if not self._needed:
            self.need(needed=True)

    async def ping(self) -> float | None:
        """Measure one round trip now, in seconds; ``None`` if no answer came within ``limits.PING_TIMEOUT``."""
        return await self.connection.ping()

    def close_route(self, route: int) -> int:
        """Discard the waiting messages of a closed route, and its drop counts; return the number of messages."""
        return self.express.close_route(route) + self.bulk.close_route(route)

    def close(self, reason: str) -> None:
        """Send a bye, wait at most ``limits.DRAIN_TIMEOUT`` for the last bytes to be sent, and close."""
        self.connection.close(reason)

    def abort(self, reason: str) -> None:
        """Close at once, without a bye."""
        self.connection.abort(reason)

    # --- for the mesh -----------------------------------------------------------------------------------------

    def use(self, handlers: LinkHandlers | None) -> None:
        """Pass what arrives on both lanes to ``routes`` and these handlers; ``None``: the link is not used."""
        self._handlers = handlers
        for connection in (self.connection, self.bulk_connection):
            if connection is not None:
                self._receive_from(connection)

    def clock_known(self) -> None:
        """Report a new estimate of the peer's clock to the handlers."""
        if self._handlers is not None:
            self._handlers.clock(self)

    def attach(self, bulk: Connection) -> None:
        """Use this connection for the bulk lane from now on; an older one is closed without a bye."""
        if self.bulk_connection is not None:
            old = self.bulk_connection
            self.detach(old)
            old.sever("replaced by a newer bulk lane")
        self.bulk_connection = bulk
        self.bulk_wanted = True
        bulk.need(needed=self._needed)
        self._receive_from(bulk)
        self.bulk.connect(bulk.stream)

    def detach(self, bulk: Connection) -> None:
        """Take the connection from the bulk lane; messages on the way may be lost."""
        self.bulk_connection = None
        self._bulk_bytes_in += bulk.stream.bytes_in
        self._bulk_bytes_out += bulk.stream.bytes_out
        bulk.deliver_to({}, None)
        self.bulk.disconnect()
        if self._handlers is not None:
            self._handlers.lane_lost(self)

    def end_lanes(self, reason: str) -> None:
        """Stop sending and close the bulk lane's connection, because the express lane's connection is closing."""
        self.express.end()
        self.bulk.end()
        if self.bulk_connection is not None:
            bulk, self.bulk_connection = self.bulk_connection, None
            bulk.deliver_to({}, None)
            bulk.close(reason)

    def discard(self) -> int:
        """Drop all waiting messages after the end of the link, because they may be large; return their number."""
        self.use(None)
        discarded = self.express.outbox.waiting_entries + self.bulk.outbox.waiting_entries
        self.express.clear()
        self.bulk.clear()
        return discarded

    def _receive_from(self, connection: Connection) -> None:
        handlers = self._handlers
        if handlers is None:
            connection.deliver_to({}, None)
        else:
            connection.deliver_to(self.routes, self._marked)

    def _marked(self, kind: FrameKind, route: int, sequence: int) -> None:
        """Answer a fence on the express lane, whichever lane it arrived on; pass other marks to the handlers."""
        if kind is FrameKind.FENCE:
            self.mark(FrameKind.FENCED, route, sequence)
        elif self._handlers is not None:
            self._handlers.mark(self, kind, route, sequence)


_log = logging.getLogger(__name__)


class BulkLanes:
    """Dials the bulk lanes, again for as long as their links stand.

    Args:
        connect: Connects to the peer of a link, and begins the handshake; raises ``OSError``.
        start: Runs a coroutine as a task.
        rng: Uniform numbers in [0, 1), for jitter.
        counters: Where failures are counted.
    """

    def __init__(
        self,
        connect: Callable[[PeerLink], Coroutine[object, object, None]],
        start: Callable[[Coroutine[object, object, None], str], asyncio.Task[None]],
        *,
        rng: Callable[[], float],
        counters: Counters,
    ) -> None:
        self._connect = connect
        self._start = start
        self._rng = rng
        self._counters = counters
        self._dials: dict[int, asyncio.Task[None]] = {}
        self._backoffs: dict[int, Backoff] = {}
        self._closed = False

    def close(self) -> list[asyncio.Task[None]]:
        """Dial no more; return the cancelled tasks, to be awaited."""
        self._closed = True
        tasks = list(self._dials.values())
        for task in tasks:
            task.cancel()
        return tasks

    def link_up(self, link: PeerLink) -> None:
        """A link is used with its peer, which may have asked for the lane before."""
        if link.dialled and link.bulk_wanted:
            self._dial(link)

    def link_ended(self, link_id: int) -> None:
        """A link is gone."""
        self._backoffs.pop(link_id, None)

    def want(self, link: PeerLink) -> None:
        """A message waits for the bulk lane of a link, here or at the peer that asks for it."""
        if link.bulk_wanted:
            return
        link.bulk_wanted = True
        if link.dialled:
            self._dial(link)
        else:
            link.mark(FrameKind.LANE, 0, 0)

    def opened(self, link: PeerLink, bulk: Connection) -> None:
        """A handshake of the lane succeeded."""
        self._backoffs.pop(link.id, None)
        link.attach(bulk)
        _log.debug("= %s: bulk lane (%s)", bulk.name, "dialled" if bulk.dialled else "accepted")

    def ended(self, link: PeerLink, bulk: Connection, reason: str, *, expected: bool) -> None:
        """A connection ended; ``expected`` says that it was dialled for this link, and its handshake was not done."""
        if link.bulk_connection is bulk:
            link.detach(bulk)
        elif not (link.used and expected):
            return
        if link.used:
            self._counters.add("link.bulk_lost")
            _log.info("= %s: the bulk lane is gone (%s); small messages go on", link.name, reason)
            if link.dialled:
                self._dial(link, self._backoff(link).delay())

    def _dial(self, link: PeerLink, delay: float = 0.0) -> None:
        if not self._closed and link.used and link.bulk_connection is None and link.id not in self._dials:
            self._dials[link.id] = task = self._start(self._connected(link, delay), f"bulk {link.name}")
            task.add_done_callback(lambda _: self._dials.pop(link.id, None))

    async def _connected(self, link: PeerLink, delay: float) -> None:
        backoff = self._backoff(link)
        await asyncio.sleep(delay)
        while link.used:
            try:
                await self._connect(link)
            except OSError as error:
                self._counters.add("link.bulk_failed")
                _log.debug("! %s: no bulk lane: %s", link.name, error)
                await asyncio.sleep(backoff.delay())
            else:
                return

    def _backoff(self, link: PeerLink) -> Backoff:
        return self._backoffs.setdefault(link.id, Backoff(limits.BACKOFF_FIRST, limits.BACKOFF_MAX, self._rng))
