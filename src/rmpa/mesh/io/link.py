"""The link to a peer: its two lanes, what is sent on each, and the TCP connections that carry them."""

from __future__ import annotations

import asyncio
import errno
import ssl
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, cast

from rmpa.core.facts import LinkInfo
from rmpa.core.identity import SERIAL_MASK, Guid, Identity
from rmpa.core.limits import KIB, MIB
from rmpa.core.outbox import URGENT, Outbox
from rmpa.core.timers import Backoff
from rmpa.mesh import limits
from rmpa.mesh.connection import ConnectionProtocol, ConnectionState, DataHandler
from rmpa.mesh.frames import Frame, FrameKind, Hello, Lane, Link, Refuse
from rmpa.mesh.io.lane import LaneSender, bound_queue
from rmpa.mesh.peering import REPLACED, RESTARTED, SocketAddress
from rmpa.runtime.loop import MachineTimer
from rmpa.runtime.stream import Stream

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

    from rmpa.mesh.io.mesh import Mesh
    from rmpa.runtime.tls import SecureSocket
    from rmpa.trust.certificates import ModuleCertificate

# Bytes of control frames that may wait for one link: two of the longest. They are never dropped, so beyond this the
# link is closed.
CONNECTION_URGENT_BYTES: Final = 32 * MIB

# Time-out of a ping on request (``rmpa peer ping``).
_PING_TIMEOUT: Final = 2.0
# Bytes in flight to a peer above which the next portion of the catalogue waits. A portion has some 6 KB, so data
# waits for at most 12 ms on 10 Mbit/s. Sending all of 10,000 topics at once delayed data by 0.8 s.
_TELL_BACKLOG: Final = 8 * KIB


# Errors of a connection that the remote side gave up after a silence, or whose process died with bytes unread.
_SILENCE: Final = frozenset(
    {errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENETDOWN, errno.ECONNRESET, errno.EPIPE}
)
# Errors of a connection that the remote kernel ended: by a reset, EPIPE after the end of the stream had come.
_ENDED_THERE: Final = frozenset({errno.ECONNRESET, errno.EPIPE})


@dataclass(frozen=True, slots=True)
class LinkHandlers:
    """What a mesh calls when something happens to a link that is used with its peer, from the event loop.

    Each ``up`` is followed by exactly one ``down`` of the same link; the link's data is delivered in between, to the
    handlers in its ``routes``. All of these may call any method of the mesh.

    Args:
        up: ``(link)``: a peer is linked.
        down: ``(link, reason)``: a peer's link is no longer used; the reason is ``peering.REPLACED``, ``RESTARTED``,
            or how its connection ended.
        control: ``(link, payload)``: a control frame came.
        mark: ``(link, kind, route, sequence)``: an acknowledgement, or the answer to a fence.
        clock: ``(link)``: the estimate of the peer's clock is new or more exact.
        lane_lost: ``(link)``: the bulk lane lost its connection, with the messages in flight; the link is still up.
    """

    up: Callable[[PeerLink], None]
    down: Callable[[PeerLink, str], None]
    control: Callable[[PeerLink, bytes], None]
    mark: Callable[[PeerLink, FrameKind, int, int], None]
    clock: Callable[[PeerLink], None]
    lane_lost: Callable[[PeerLink], None]


class Connection(ConnectionProtocol):
    """One TCP connection: its machine, driven by one stream and one timer.

    Args:
        mesh: The mesh, which decides on its handshake.
        sock: Connected, non-blocking; owned by the connection from here on.
        endpoint: Address and port of the remote side.
        expected: The GUID that was dialled; ``None`` on an accepted connection.
        lane: What this side dials for; on an accepted connection the remote side's hello says it.
        secured: What encrypts ``sock``, and the remote side's certificate; ``None`` in a mesh without trust.

    Attributes:
        certificate: The remote side's certificate, as ``SSLObject.getpeercert`` returns it; ``None`` without trust.
        link: The link that has this connection for one of its lanes.
        crashed: Once ended: whether the remote kernel ended it without a bye, so that only the agent's process has
            died.
        silent: Once ended: whether it ended by silence (lease expired, no route, reset) rather than by a bye.
        over: Done when the socket is closed.
    """

    def __init__(
        self,
        mesh: Mesh,
        sock: socket.socket,
        endpoint: SocketAddress,
        *,
        expected: Guid | None = None,
        lane: Lane = Lane.EXPRESS,
        secured: tuple[SecureSocket, ModuleCertificate] | None = None,
    ) -> None:
        self.mesh = mesh
        self.sock = sock
        self.remote_endpoint = endpoint
        self.certificate: Final = None if secured is None else secured[1]
        self.link: PeerLink | None = None
        self.crashed = False
        self.silent = False
        self._pings: dict[int, asyncio.Future[float]] = {}
        self.over: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.stream = Stream(
            sock,
            on_bytes=self._receive,
            on_close=self._lost,
            # For control frames only: ``LaneSender.connect`` replaces it by the lane's outbox.
            outbox=Outbox(1, CONNECTION_URGENT_BYTES),
            secure=None if secured is None else secured[0],
        )
        super().__init__(
            mesh.identity,
            mesh.clock.now(),
            dialled=expected is not None,
            wall_ns=mesh.clock.wall_ns,
            expected=expected,
            lane=lane,
            secured=secured is not None,
            label=f"{endpoint[0]}:{endpoint[1]}",
            counters=mesh.counters,
            pace=mesh.pace,
        )
        self._timer = MachineTimer(self.next_timer, self._due)
        self.flush()

    @property
    def identity(self) -> Identity:
        """The remote side; only once it has said hello."""
        return cast("Hello", self.remote).identity

    def send_mark(self, kind: FrameKind, route: int, sequence: int) -> None:
        """Acknowledge messages of a route, or answer a fence, before all waiting data."""
        if self.up:
            self.stream.send((Frame(kind, route=route, sequence=sequence & SERIAL_MASK).serialize(),), URGENT)

    def send_control(self, payload: bytes) -> None:
        """Send one control frame, before all data that waits; never dropped.

        If more than ``CONNECTION_URGENT_BYTES`` wait, the remote side does not read, and the connection is
        closed.
        """
        if self.up and self.link is not None:
            self.link.touch()
            self.stream.send((self.pack_control(payload),), URGENT)
            self._check_urgent()

    async def measure(self) -> float | None:
        """Measure one round trip now, in seconds; ``None`` if no answer came within ``_PING_TIMEOUT``."""
        if not self.up:
            return None
        stamp = self.ping(self.mesh.clock.now())
        answer: asyncio.Future[float] = asyncio.get_running_loop().create_future()
        self._pings[stamp] = answer
        self.flush()
        try:
            return await asyncio.wait_for(answer, _PING_TIMEOUT)
        except TimeoutError:
            return None
        finally:
            self._pings.pop(stamp, None)

    def end(self, reason: str, *, moves: bool = False) -> None:
        """Send a bye, wait at most ``limits.DRAIN_TIMEOUT`` for the last bytes, and close; see ``close``."""
        self.close(reason, self.mesh.clock.now(), moves=moves)
        self.flush()

    def judge(self, hello: Hello) -> Refuse | None:
        """Decide on the remote side's hello or welcome."""
        return self.mesh.judge(self, hello) or super().judge(hello)

    def opened(self) -> None:
        """The handshake succeeded; the welcome must be sent before anything that the mesh sends now."""
        self.flush()
        self.mesh.opened(self)

    def refused(self, refuse: Refuse, *, by_us: bool) -> None:
        """One of the two sides refused the connection."""
        self.mesh.refused(self, refuse, by_us=by_us)

    def control_received(self, payload: bytes) -> None:
        """A control frame came."""
        if (link := self._express_of()) is not None:
            link.touch()
            self.mesh.handlers.control(link, payload)

    def mark_received(self, kind: FrameKind, route: int, sequence: int) -> None:
        """Take the wish for the bulk lane, answer a fence, or pass on an acknowledgement or a fence's answer.

        A fence on a link that is not used has no answer, because the messages before it were dropped.
        """
        link = self.link
        if link is None:
            return
        if kind is FrameKind.LANE:
            link.want_bulk()
        elif link.used and kind is FrameKind.FENCE:
            link.mark(FrameKind.FENCED, route, sequence)
        elif link.used:
            self.mesh.handlers.mark(link, kind, route, sequence)

    def pong_received(self, stamp: int, rtt: float) -> None:
        """A ping was answered: the remote clock is known better."""
        if (answer := self._pings.get(stamp)) is not None and not answer.done():
            answer.set_result(rtt)
        if (link := self._express_of()) is not None:
            self.mesh.handlers.clock(link)

    def proved(self) -> None:
        """What came over the link stands."""
        if self.link is not None:
            self.link.proved()

    def closed(self, reason: str) -> None:
        """The connection is over."""
        self._end_lanes(reason)
        self._timer.close()
        # Later, not from here: this may be ``receive``, or a ``send`` within a loop over the links.
        asyncio.get_running_loop().call_soon(self._report_end, reason)

    def _express_of(self) -> PeerLink | None:
        """The link whose express lane this connection is, if it is the one that is used with its peer."""
        link = self.link
        return link if link is not None and link.used and link.connection is self else None

    def _receive(self, view: memoryview) -> tuple[int, int]:
        taken = self.receive(view, self.mesh.clock.now())
        if self.output:
            self.flush()
        return taken

    def flush(self) -> None:
        """Send the machine's output; a closing connection then waits for the remote end to close, or its time-out."""
        if self.output:
            self.stream.send((self.take_output(),), URGENT)
            self._check_urgent()
        if self.state is ConnectionState.CLOSING:
            # After a close at once, further bytes of the remote side would cause a reset, which overtakes the bye.
            self._end_lanes(f"{self.name}: its express lane ends")
            self.stream.finish()
        self._timer.arm()

    def _end_lanes(self, reason: str) -> None:
        if self.link is not None and self.link.connection is self:
            self.link.end_lanes(reason)

    def _check_urgent(self) -> None:
        waiting = self.stream.outbox.urgent_bytes
        if waiting > CONNECTION_URGENT_BYTES:
            self.lost(f"{self.name} does not read: {waiting} bytes of control frames wait for it")

    def _lost(self, error: Exception | None) -> None:
        number = error.errno if isinstance(error, OSError) else None
        self.silent = number in _SILENCE
        self.crashed = self.up and (error is None or number in _ENDED_THERE)
        if isinstance(error, ssl.SSLError) and self.state is ConnectionState.HANDSHAKING:
            # In TLS 1.3 the acceptor judges the dialler's certificate when the dialler is already done.
            self.mesh.tls_failed(self, error)
        self.lost(
            f"{self.name} closed the connection" if error is None else f"connection to {self.name} lost: {error}"
        )

    def _report_end(self, reason: str) -> None:
        self.stream.close()
        self.routes = {}
        self.mesh.ended(self, reason)
        self.over.set_result(None)
        self.link = None  # which holds this connection, with its perhaps large buffers

    def _due(self, now: float) -> None:
        self.heard(self.stream.last_in)
        was_up = self.up
        if was_up and self.lane == Lane.BULK:
            bound_queue(self.sock)
        self.handle_timer(now)
        self.silent = was_up and self.state is ConnectionState.CLOSED
        link = self._express_of()
        if self.up and link is not None and self.dialled and not link.alive:
            self.mesh.link_silent(link)
        self.flush()


class PeerLink(Link):
    """The link to one peer, as the rooms above see it; it lives as long as the connection of its express lane.

    The connection of the bulk lane may be missing, fall or be replaced meanwhile; messages for that lane wait. It has
    more than 12 fields: what names the peer, the two lanes, and how the link ended.

    Args:
        connection: That of the express lane; its handshake is done.
        mesh: The mesh.

    Attributes:
        since: Monotonic seconds at which it came up.
        bulk_connection: The connection of the bulk lane, while there is one.
        bulk_wanted: Whether a message of either side has wanted the bulk lane.
        backoff: The pauses between dials of the bulk lane.
        bulk_dial: The task that dials the bulk lane.
        used: Whether this link carries the peer's data; of two links with one peer, only one is used.
        over: Why it is no longer used; see ``LinkHandlers.down``.
        routes: The handlers of the data that arrives, by route; both lanes look here while the link is used.
        send_control: ``(payload)``: sends one control frame, before all data that waits; never dropped.
        mark: ``(kind, route, sequence)``: acknowledges messages of a route, before all waiting data.
        abort: ``(reason)``: closes at once, without a bye.
        close: ``(reason)``: sends a bye, waits shortly for the last bytes to be sent, and closes.
        ping: Measures one round trip now.
        touched_at: Monotonic seconds of the last control frame in either direction.
    """

    def __init__(self, connection: Connection, mesh: Mesh) -> None:
        super().__init__(connection.identity, connection.remote_endpoint, dialled=connection.dialled)
        self.guid: Final = connection.identity.guid
        self.name: Final = connection.identity.name
        self.local_address: Final[str] = connection.sock.getsockname()[0]
        self.since: Final = connection.since
        self.connection: Final = connection
        self.bulk_connection: Connection | None = None
        self.express: Final = LaneSender("express")
        self.bulk: Final = LaneSender("bulk", self.want_bulk)
        self.bulk_wanted = False
        self.backoff = Backoff(limits.BACKOFF_FIRST, limits.BACKOFF_MAX, mesh.rng)
        self.bulk_dial: asyncio.Task[None] | None = None
        self.used = False
        self.routes: dict[int, DataHandler] = {}
        self.over = ""
        self.send_control: Final = connection.send_control
        self.mark: Final = connection.send_mark
        self.abort: Final = connection.lost
        self.close: Final = connection.end
        self.ping: Final = connection.measure
        self.touched_at = mesh.clock.now()
        self._mesh = mesh
        self._needed = True
        self._unproven: deque[Callable[[], None]] = deque()
        self._bulk_in = self._bulk_out = 0  # bytes of the bulk lane's earlier connections
        connection.link = self
        self.express.connect(connection.stream)

    @property
    def silent(self) -> bool:
        """Once the link is down: whether the peer may be back soon: it ended without a bye, or the peer moves."""
        return self.over == REPLACED or self.connection.silent or self.connection.moves

    @property
    def crashed(self) -> bool:
        """Once the link is down: whether the peer's agent died, or a better link took over; its nodes go on."""
        return self.over in (REPLACED, RESTARTED) or self.connection.crashed

    def want_bulk(self) -> None:
        """A message waits for the bulk lane, here or at the peer that asks for it; the side that dialled dials it."""
        if not self.bulk_wanted:
            self.bulk_wanted = True
            if self.dialled:
                self._mesh.dial_bulk(self)
            else:
                self.mark(FrameKind.LANE, 0, 0)

    @property
    def alive(self) -> bool:
        """Whether bytes were received lately, at the pace of the link."""
        return self._mesh.clock.now() - self.heard_at < self.connection.keepalive.quiet_after

    @property
    def stuck(self) -> bool:
        """Whether it is silent, and the peer has not acknowledged what was sent."""
        return not self.alive and self.connection.stream.unacknowledged > 0

    @property
    def clock_offset(self) -> float | None:
        """Seconds that the peer's wall clock is ahead of ours; ``None`` if unknown."""
        return (self.connection.clock.estimate(self._mesh.clock.now()) or (None, None))[0]

    @property
    def clock_error(self) -> float | None:
        """The offset is true within ± this many seconds; ``None`` if unknown."""
        return (self.connection.clock.estimate(self._mesh.clock.now()) or (None, None))[1]

    def when_proven(self, act: Callable[[], None]) -> None:
        """Act on what the peer has asked: at once, or once no connection is doubted any more.

        Until then the peer may have given it up. Where the link ends first nothing is done.
        """
        self._unproven.append(act)
        self.proved()

    def proved(self) -> None:
        """Do what waits, unless a connection is doubted."""
        while self._unproven and not any(connection.doubted for connection in self._connections()):
            self._unproven.popleft()()

    @property
    def resumed_at(self) -> float:
        """Monotonic seconds of the express lane's last poll without bytes before its last silence ended."""
        return self.connection.stream.resumed_at

    @property
    def busy(self) -> bool:
        """Whether the express lane has a backlog, so that a further advertisement would delay later commands."""
        stream = self.connection.stream
        return stream.pending_bytes > 0 or stream.unacknowledged > _TELL_BACKLOG

    @property
    def heard_at(self) -> float:
        """Monotonic seconds at which bytes were last received on the express lane."""
        return max(self.connection.keepalive.heard, self.connection.stream.last_in)

    @property
    def rests(self) -> bool:
        """Whether the link is at rest: keepalives are rare, and silence is noticed late."""
        return self.connection.rests

    def info(self) -> LinkInfo:
        """Its piece of the snapshot."""
        now, (host, port) = self._mesh.clock.now(), self.remote_endpoint
        lanes = self.express.info(), self.bulk.info(unneeded=not self.bulk_wanted)
        return LinkInfo(
            remote=f"{host}:{port}",
            dialled=self.dialled,
            up_ago=now - (self.since or now),
            rtt=self.connection.clock.rtt,
            clock_offset=self.clock_offset,
            clock_error=self.clock_error,
            bytes_in=self._bulk_in + sum(lane.bytes_in for lane in lanes),
            bytes_out=self._bulk_out + sum(lane.bytes_out for lane in lanes),
            queued=sum(lane.queued for lane in lanes),
            dropped=sum(lane.dropped for lane in lanes),
            heard_ago=now - self.heard_at,
            rests=self.rests,
            lease=self.connection.keepalive.remote_lease,
            lanes=lanes,
        )

    def need(self, *, needed: bool) -> None:
        """Say whether something of this module depends on the link; it rests when neither side needs it.

        A control frame in either direction makes the link needed; only its user can say that it is not.
        """
        self._needed = needed
        for connection in self._connections():
            connection.need(self._mesh.clock.now(), needed=needed)
            connection.flush()

    def touch(self) -> None:
        """A control frame was sent or received: something begins."""
        self.touched_at = self._mesh.clock.now()
        if not self._needed:
            self.need(needed=True)

    def close_route(self, route: int) -> int:
        """Discard the waiting messages of a closed route, and its drop counts; return the number of messages."""
        return self.express.close_route(route) + self.bulk.close_route(route)

    def use(self, *, used: bool) -> None:
        """Begin to use this link, or stop: then data and marks that arrive are dropped."""
        self.used = used
        for connection in self._connections():
            connection.routes = self.routes if used else {}

    def attach(self, bulk: Connection) -> None:
        """Use this connection for the bulk lane from now on; an older one is closed without a bye."""
        if (old := self.bulk_connection) is not None:
            self.detach(old)
            old.stream.close()  # without another byte: its outbox now belongs to the new connection
            old.lost("replaced by a newer bulk lane")
        self.bulk_connection, bulk.link = bulk, self
        self.bulk_wanted = True
        self.backoff.reset()
        self.need(needed=self._needed)
        self.use(used=self.used)
        self.bulk.connect(bulk.stream)

    def detach(self, bulk: Connection) -> None:
        """Take the connection from the bulk lane; messages on the way may be lost."""
        self.bulk_connection = None
        self._bulk_in += bulk.stream.bytes_in
        self._bulk_out += bulk.stream.bytes_out
        bulk.routes, bulk.link = {}, None
        self.bulk.disconnect()
        if self.used:
            self._mesh.handlers.lane_lost(self)
            self.proved()

    def end_lanes(self, reason: str) -> None:
        """Stop sending and close the bulk lane's connection, because the express lane's connection is closing."""
        self.express.end()
        self.bulk.end()
        if (bulk := self.bulk_connection) is not None:
            self.bulk_connection = None
            bulk.routes, bulk.link = {}, None
            bulk.end(reason)

    def discard(self) -> int:
        """Drop all waiting messages after the end of the link, because they may be large; return their number."""
        self.use(used=False)
        self._unproven.clear()
        discarded = self.express.outbox.waiting_entries + self.bulk.outbox.waiting_entries
        self.express.clear()
        self.bulk.clear()
        return discarded

    def _connections(self) -> list[Connection]:
        return [c for c in (self.connection, self.bulk_connection) if c is not None]
