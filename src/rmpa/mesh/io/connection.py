"""One TCP connection with a peer: drives the connection's machine by one stream and one timer."""

from __future__ import annotations

import asyncio
import errno
import logging
import ssl
from functools import partial
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import SERIAL_MASK
from rmpa.core.outbox import URGENT, Outbox
from rmpa.mesh import limits
from rmpa.mesh.connection import ConnectionProtocol, ConnectionRole, ConnectionState
from rmpa.mesh.frames import Frame, FrameKind, Lane
from rmpa.mesh.io.securing import tls_failure
from rmpa.mesh.keepalive import (
    ConnectionClosed,
    ConnectionEvent,
    ControlReceived,
    HandshakeDone,
    HelloReceived,
    MarkReceived,
    PongReceived,
    Refused,
)
from rmpa.runtime.loop import MachineTimer
from rmpa.runtime.stream import Stream

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Mapping

    from rmpa.core.counters import Counters
    from rmpa.core.identity import Guid, Identity
    from rmpa.mesh.connection import DataHandler
    from rmpa.mesh.frames import Hello, Refuse
    from rmpa.mesh.io.securing import SecuredSocket
    from rmpa.mesh.keepalive import RemoteClock, RestPace
    from rmpa.runtime.loop import SystemClock

    OnMark = Callable[[FrameKind, int, int], None]

_log = logging.getLogger(__name__)

_SILENCE: Final = frozenset(
    {errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.ENETDOWN, errno.ECONNRESET, errno.EPIPE}
)
"""Errors of a connection that the remote side gave up after a silence, or whose process died with bytes unread."""
_ENDED_THERE: Final = frozenset({errno.ECONNRESET, errno.EPIPE})
"""Errors of a connection that the remote kernel ended: by a reset, EPIPE after the end of the stream had come."""


class ConnectionOwner(Protocol):
    """The events that a connection reports to the mesh; all methods are called from the event loop."""

    counters: Counters

    def connection_judge(self, connection: Connection, hello: Hello) -> Refuse | None:
        """Decide on the hello of a dialler: ``None`` accepts the connection."""
        ...

    def connection_prove(self, connection: Connection, hello: Hello) -> Refuse | None:
        """Compare the hello or welcome of a secured connection with its certificate; ``None`` accepts it."""
        ...

    def connection_opened(self, connection: Connection) -> None:
        """The handshake succeeded."""
        ...

    def connection_refused(self, connection: Connection, refuse: Refuse, *, by_us: bool) -> None:
        """The handshake was refused; ``connection_ended`` follows."""
        ...

    def connection_control(self, connection: Connection, payload: bytes) -> None:
        """A control frame came."""
        ...

    def connection_lane(self, connection: Connection) -> None:
        """A lane frame came: the remote side wants the bulk lane."""
        ...

    def connection_ponged(self, connection: Connection) -> None:
        """A ping was answered: the remote clock is known better."""
        ...

    def connection_quiet(self, connection: Connection) -> None:
        """No bytes were received for ``quiet_after``; called again from time to time during the silence."""
        ...

    def connection_tick(self, connection: Connection) -> None:
        """The connection is up and its timer fired, about once in a keepalive interval."""
        ...

    def connection_closing(self, connection: Connection, reason: str) -> None:
        """The connection sends no more data; ``connection_ended`` follows. May be called more than once."""
        ...

    def connection_ended(self, connection: Connection, reason: str) -> None:
        """The socket is closed; called once."""
        ...


class Connection:
    """One TCP connection: frames, handshake, keepalive.

    The link that receives its frames decides what they are for; see ``mesh.io.link.PeerLink``.

    Args:
        connection_id: The mesh's number for it.
        sock: Connected, non-blocking; owned by the connection from here on.
        role: Whether this side dialled.
        ours: The identity of this agent.
        owner: Receives the events.
        clock: The time.
        endpoint: Address and port of the remote side.
        expected: The GUID that was dialled; ``None`` on an accepted connection.
        lane: What this side dials for; on an accepted connection the remote side's hello says it.
        secured: What encrypts ``sock``, and the remote side's certificate; ``None`` in a mesh without trust.
        rest: The pace of all resting links of this agent.
    """

    def __init__(
        self,
        connection_id: int,
        sock: socket.socket,
        role: ConnectionRole,
        ours: Identity,
        *,
        owner: ConnectionOwner,
        clock: SystemClock,
        endpoint: tuple[str, int],
        expected: Guid | None = None,
        lane: Lane = Lane.EXPRESS,
        secured: SecuredSocket | None = None,
        rest: RestPace | None = None,
    ) -> None:
        self.id = connection_id
        self.sock = sock
        self.remote_endpoint = endpoint
        self.local_address: str = sock.getsockname()[0]
        """The address of this side."""
        self.certificate: Final = None if secured is None else secured.certificate
        """The remote side's certificate, as ``SSLObject.getpeercert`` returns it; ``None`` without trust."""
        self.crashed = False
        """Once ended: whether the remote kernel ended it without a bye, so that only the agent's process has died."""
        self.since: float | None = None
        """Monotonic seconds at which the handshake ended."""
        self.malformed = False
        """Whether the remote side broke the protocol."""
        self.silent = False
        """Once ended: whether it ended by silence (lease expired, no route, reset) rather than by a bye."""
        self._owner = owner
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._requested_lane = lane
        self._pings: dict[int, asyncio.Future[float]] = {}
        self._end: asyncio.Future[None] = self._loop.create_future()
        self._ended = False
        self._finishing = False
        self._on_mark: OnMark = _ignore_mark
        self.stream = Stream(
            sock,
            on_bytes=self._receive,
            on_close=self._lost,
            # For control frames only: ``LaneSender.connect`` replaces it by the lane's outbox.
            outbox=Outbox(1, limits.CONNECTION_URGENT_BYTES),
            secure=None if secured is None else secured.socket,
        )
        self._machine = ConnectionProtocol(
            role,
            ours,
            clock.now(),
            wall_ns=clock.wall_ns,
            on_event=self._event,
            counters=owner.counters,
            expected=expected,
            lane=lane,
            lease=limits.BULK_LEASE if lane is Lane.BULK else limits.EXPRESS_LEASE,
            label=f"{endpoint[0]}:{endpoint[1]}",
            prove=None if secured is None else partial(owner.connection_prove, self),
            rest=rest,
        )
        self._timer = MachineTimer(self._machine.next_timer, self._due, now=clock.now)
        self._send_output()
        self._timer.arm()

    @property
    def remote(self) -> Hello | None:
        """The remote side's hello or welcome; ``None`` before it is received."""
        return self._machine.remote

    @property
    def identity(self) -> Identity:
        """The remote side; only once the connection is up.

        Raises:
            AttributeError: The remote side has not said hello.
        """
        if self._machine.remote is None:
            raise AttributeError("the other side of this link has not said who it is")
        return self._machine.remote.identity

    @property
    def name(self) -> str:
        """The name of the remote side, or its address while that is not known."""
        remote = self._machine.remote
        return remote.name if remote is not None else f"{self.remote_endpoint[0]}:{self.remote_endpoint[1]}"

    @property
    def dialled(self) -> bool:
        """Whether this side dialled."""
        return self._machine.role is ConnectionRole.DIALLER

    @property
    def up(self) -> bool:
        """Whether messages go through."""
        return self._machine.state is ConnectionState.UP and not self._ended

    @property
    def abandoned(self) -> bool:
        """Whether the remote side has ended the connection while this process was stopped."""
        return self._machine.abandoned

    @property
    def lane(self) -> int:
        """The lane (``handshake.Lane``); for an accepted connection it is known after the remote side's hello."""
        remote = self._machine.remote
        return self._requested_lane if self.dialled or remote is None else remote.lane

    @property
    def clock(self) -> RemoteClock:
        """Round-trip time and remote clock, as the pings of this connection show them."""
        return self._machine.clock

    @property
    def heard_at(self) -> float:
        """Monotonic seconds at which bytes were last received."""
        return max(self._machine.heard_at, self.stream.last_in)

    def deliver_to(self, routes: Mapping[int, DataHandler], mark: OnMark | None) -> None:
        """Pass data to the handlers of these routes, and marks to ``mark``, from now on; ``None`` drops them."""
        self._machine.routes = routes
        self._on_mark = _ignore_mark if mark is None else mark

    def send_mark(self, kind: FrameKind, route: int, sequence: int) -> None:
        """Acknowledge messages of a route, or answer a fence, before all waiting data."""
        if self._machine.state is ConnectionState.UP:
            frame = Frame(kind, route=route, sequence=sequence & SERIAL_MASK).serialize()
            self.stream.send((frame,), URGENT)

    def send_control(self, payload: bytes) -> None:
        """Send one control frame, before all data that waits; never dropped.

        If more than ``limits.CONNECTION_URGENT_BYTES`` wait, the remote side does not read, and the connection is
        closed.
        """
        if self._machine.state is not ConnectionState.UP:
            return
        self.stream.send((self._machine.control(payload),), URGENT)
        self._check_urgent()

    def need(self, *, needed: bool) -> None:
        """Say whether something depends on this connection; see ``ConnectionProtocol.need``."""
        self._machine.need(self._clock.now(), needed=needed)
        if self._machine.has_output:
            self._send_output()
            self._timer.arm()

    @property
    def rests(self) -> bool:
        """Whether the connection is at rest: its keepalives are rare, and silence is noticed later."""
        return self._machine.rests

    @property
    def remote_lease(self) -> float:
        """Seconds after which the silence of the remote side ends the connection."""
        return self._machine.remote_lease

    @property
    def quiet_after(self) -> float:
        """Seconds without bytes after which the remote side is worth a check."""
        return self._machine.quiet_after

    async def ping(self) -> float | None:
        """Measure one round trip now, in seconds; ``None`` if no answer came within ``limits.PING_TIMEOUT``."""
        if not self.up:
            return None
        answer: asyncio.Future[float] = self._loop.create_future()
        stamp = self._machine.ping(self._clock.now())
        self._pings[stamp] = answer
        self._send_output()
        try:
            async with asyncio.timeout(limits.PING_TIMEOUT):
                return await answer
        except TimeoutError:
            return None
        finally:
            self._pings.pop(stamp, None)

    def expel(self, refuse: Refuse) -> None:
        """Close a connection that is up because its peer was revoked, and say so; as ``close`` otherwise."""
        self._machine.expel(refuse, self._clock.now())
        self._send_output()

    def close(self, reason: str) -> None:
        """Send a bye, wait at most ``limits.DRAIN_TIMEOUT`` for the last bytes to be sent, and close."""
        self._machine.close(reason, self._clock.now())
        self._send_output()

    def abort(self, reason: str) -> None:
        """Close at once, without a bye."""
        self._machine.lost(reason)

    def sever(self, reason: str) -> None:
        """Close at once without sending another byte, because the outbox now belongs to another connection."""
        self.stream.close()
        self._machine.lost(reason)

    async def ended(self) -> None:
        """Wait until the socket is closed and the owner is notified."""
        await asyncio.shield(self._end)

    # --- inside ---------------------------------------------------------------------------------------------

    def _receive(self, view: memoryview) -> tuple[int, int]:
        try:
            taken = self._machine.receive(view, self._clock.now())
        except RemoteProtocolError:
            self.malformed = True
            raise
        if self._machine.has_output:
            self._send_output()
            self._timer.arm()  # the remote side may have changed the pace
        return taken

    def _event(self, event: ConnectionEvent) -> None:
        if isinstance(event, ControlReceived):
            self._owner.connection_control(self, event.payload)
        elif isinstance(event, MarkReceived):
            self._marked(event)
        elif isinstance(event, PongReceived):
            self._ponged(event)
        elif isinstance(event, HelloReceived):
            verdict = self._owner.connection_judge(self, event.hello)
            if verdict is None:
                self._machine.accept(self._clock.now())
            else:
                self._machine.refuse(verdict, self._clock.now())
        elif isinstance(event, HandshakeDone):
            self.since = self._clock.now()
            # The welcome must be sent before anything that the owner sends now.
            self._send_output()
            self._timer.arm()
            self._owner.connection_opened(self)
        elif isinstance(event, Refused):
            self._owner.connection_refused(self, event.refuse, by_us=event.by_us)
        elif isinstance(event, ConnectionClosed):
            self._finish(event.reason)

    def _marked(self, event: MarkReceived) -> None:
        if event.kind is FrameKind.LANE:
            self._owner.connection_lane(self)
        else:
            self._on_mark(event.kind, event.route, event.sequence)

    def _ponged(self, event: PongReceived) -> None:
        if (answer := self._pings.get(event.stamp)) is not None and not answer.done():
            answer.set_result(event.rtt)
        self._owner.connection_ponged(self)

    def _send_output(self) -> None:
        """Send the machine's output; a closing connection then waits for the remote end to close, or its time-out."""
        if self._machine.has_output:
            self.stream.send((self._machine.take_output(),), URGENT)
            self._check_urgent()
        if self._machine.state is ConnectionState.CLOSING and not self._finishing:
            # After a close at once, further bytes of the remote side would cause a reset, which overtakes the bye.
            self._finishing = True
            self._owner.connection_closing(self, f"{self.name}: its express lane ends")
            self.stream.finish()
            self._timer.arm()

    def _check_urgent(self) -> None:
        waiting = self.stream.outbox.urgent_bytes
        if waiting > limits.CONNECTION_URGENT_BYTES:
            self.abort(f"{self.name} does not read: {waiting} bytes of control frames wait for it")

    def _lost(self, error: Exception | None) -> None:
        self.silent = isinstance(error, OSError) and error.errno in _SILENCE
        ended = error is None or (isinstance(error, OSError) and error.errno in _ENDED_THERE)
        self.crashed = self._machine.state is ConnectionState.UP and ended
        if isinstance(error, ssl.SSLError) and self._machine.state is ConnectionState.HANDSHAKING:
            # In TLS 1.3 the acceptor judges the dialler's certificate when the dialler is already done.
            failure = tls_failure(error)
            self._owner.connection_refused(self, failure.refuse, by_us=failure.by_us)
        reason = f"{self.name} closed the connection" if error is None else f"connection to {self.name} lost: {error}"
        self._machine.lost(reason)

    def _finish(self, reason: str) -> None:
        if self._ended:
            return
        self._ended = True
        self._owner.connection_closing(self, reason)
        self._timer.close()
        # Later, not from here: this may be ``receive``, or a ``send`` within the owner's loop over its links.
        self._loop.call_soon(self._report_end, reason)

    def _report_end(self, reason: str) -> None:
        self.stream.close()
        self.deliver_to({}, None)
        # The machine would keep this object, with its perhaps large buffers, in a reference cycle until a collection.
        self._machine.on_event = _ignore_event
        self._machine.prove = None
        self._end.set_result(None)
        self._owner.connection_ended(self, reason)

    def _due(self, now: float) -> None:
        # A large message renews the lease while it is being received, long before the machine gets a whole frame.
        self._machine.heard(self.stream.last_in)
        was_up = self._machine.state is ConnectionState.UP
        if was_up:
            self._owner.connection_tick(self)
        self._machine.handle_timer(now)
        self.silent = was_up and self._machine.state is ConnectionState.CLOSED
        if was_up and not self.silent and now - self.heard_at > self.quiet_after:
            self._owner.connection_quiet(self)
        self._send_output()


def _ignore_mark(_kind: FrameKind, _route: int, _sequence: int) -> None:
    """Leaves a fence without an answer, because the messages before it were dropped."""


def _ignore_event(_event: ConnectionEvent) -> None:
    """Drops the events that the machine of an ended connection still reports."""
