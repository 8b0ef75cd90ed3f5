"""The protocol machine of one connection: handshake, frames, keepalive, bye.

Sans-I/O: bytes and ``now`` go in; bytes come out, and methods that a subclass overrides say what happened. A link
with a peer has one connection for each of its lanes; ``mesh.io.link`` drives them by sockets, and joins them.

::

    HANDSHAKING ──welcome sent or received──► UP ──bye sent──► CLOSING ──TCP end, 1 s──► CLOSED
         ├─ refuse or bye sent: CLOSING         └─ bye received, lease over, protocol error: CLOSED
         └─ refused, time out, error: CLOSED

The driver passes received bytes to ``receive``, sends the bytes that ``take_output`` returns, calls ``handle_timer``
when ``next_timer`` is due, and closes the socket at ``closed``.
"""

from __future__ import annotations

import logging
from enum import IntEnum
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.core import limits as core_limits
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.core.outbox import FIRST, LAST
from rmpa.core.statistics import Counters
from rmpa.mesh import frames, limits
from rmpa.mesh.frames import PACE_NEEDED, WHOLE, Frame, FrameKind, Hello, Lane, Refuse, judge_welcome
from rmpa.mesh.keepalive import Keepalive, Pace, RemoteClock
from rmpa.runtime import limits as runtime_limits
from rmpa.trust.permissions import TrustReason

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.core.identity import Guid, Identity

_log = logging.getLogger(__name__)

# A timer that fires later than this shows that the process did not run. That time does not count as a peer's silence.
_PAUSE_NOTICED: Final = 0.1

_HEADER: Final = limits.FRAME_HEADER_BYTES
_DATA: Final = int(FrameKind.DATA)
# Bytes that the first part of a message must have, because they contain the message's length.
_FIRST_PART: Final = 4
# The first byte of a TLS connection; a frame begins with 0, as it is shorter than 16 MiB.
_TLS_HANDSHAKE: Final = 0x16


class ConnectionState(IntEnum):
    """The state of a connection, from handshake to end; it only moves forward."""

    HANDSHAKING = 1
    UP = 2
    CLOSING = 3
    CLOSED = 4


class DataHandler(Protocol):
    """Takes the data that arrives on one route."""

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """Take a whole message, its 4-byte length in front; ``framed`` is valid during the call only.

        Raises:
            RemoteProtocolError: It is no message; the connection is closed.
        """

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Take a part of a large message (``core.outbox`` FIRST, LAST, ABORT); valid during the call only.

        The parts of one message are in order, with parts of other routes in between.

        Raises:
            RemoteProtocolError: The parts are no message; the connection is closed.
        """


class ConnectionProtocol:
    """One side of one connection.

    A subclass overrides ``judge`` and the methods below it. They are called in the order of the received bytes, from
    within the other methods, and may call any of them except ``receive``.

    It has more than 12 fields: the terms of the handshake, what goes out, and the place in what comes in.

    Args:
        ours: The identity of this agent.
        now: Monotonic seconds at which the connection was established.
        dialled: Whether this side dialled.
        wall_ns: Returns the wall clock in nanoseconds; only called where a stamp is needed.
        expected: Dialler: the GUID that was dialled; ``None`` if only the address is known.
        lane: Dialler: what the connection is for.
        secured: Whether the connection is inside TLS.
        label: The remote side's name, until it is known.
        counters: Counts data frames of routes that are not open, as ``route.unknown``.
        pace: That of all links of this agent; ``None``: one of its own.

    Attributes:
        name: The name of the remote side, or its address while that is not known.
        remote: The remote side's hello or welcome; ``None`` before it is received.
        since: Monotonic seconds at which the handshake ended.
        malformed: Whether the remote side broke the protocol.
        routes: The handler of each open route. Assigned once the peer, and so the receiver of its data, is known.
        clock: Round-trip time and remote clock, as the pings of this connection show them.
        doubted: Whether this process was stopped for longer than the lease that it promised: unless the remote side
            was stopped too, it has ended the connection, and given up what it asked in it. True until a ping from
            after that is answered.
        moves: Once closed: whether the side that has left is back at once, at another address.
        output: The bytes that ``take_output`` returns.
    """

    def __init__(
        self,
        ours: Identity,
        now: float,
        *,
        dialled: bool,
        wall_ns: Callable[[], int],
        expected: Guid | None = None,
        lane: int = Lane.EXPRESS,
        secured: bool = False,
        label: str = "?",
        counters: Counters | None = None,
        pace: Pace | None = None,
    ) -> None:
        self.ours = ours
        self.dialled = dialled
        self.expected = expected
        self.lane = lane
        self.name = label
        self.remote: Hello | None = None
        self.since: float | None = None
        self.state = ConnectionState.HANDSHAKING
        self.malformed = False
        self.routes: Mapping[int, DataHandler] = {}
        self.clock = RemoteClock()
        lease = limits.BULK_LEASE if lane == Lane.BULK else limits.EXPRESS_LEASE
        self.keepalive = Keepalive(lease, now, pace or Pace.of(ours), acceptor=not dialled)
        self.doubted = self.moves = False
        self.output = bytearray()
        self._proof: int | None = None
        # Bytes that are still missing of a data frame whose first bytes were handed on.
        self._missing = 0
        # Route, sequence, stamp and LAST flag of that frame.
        self._begun = (0, 0, 0, 0)
        self._deadline = now + limits.HANDSHAKE_TIMEOUT
        self._reason = ""
        self._secured = secured
        self._wall_ns = wall_ns
        self._counters = counters if counters is not None else Counters()
        if dialled:
            hello = Hello.of(ours, lease=lease, expected=expected, lane=lane)
            self._send(Frame(FrameKind.HELLO, hello.serialize()))

    def judge(self, hello: Hello) -> Refuse | None:
        """Decide on the remote side's hello or welcome; ``None`` accepts the connection."""
        return judge_welcome(hello, self.ours, self.expected) if self.dialled else None

    def opened(self) -> None:
        """The handshake succeeded; frames may be sent."""

    def refused(self, refuse: Refuse, *, by_us: bool) -> None:
        """One of the two sides refused the connection; ``closed`` follows."""

    def control_received(self, payload: bytes) -> None:
        """A control frame came."""

    def mark_received(self, kind: FrameKind, route: int, sequence: int) -> None:
        """An acknowledgement, a fence, the answer to a fence, or the wish for the bulk lane came.

        Args:
            kind: ``ACK``, ``FENCE``, ``FENCED`` or ``LANE``.
            route: The id of the route.
            sequence: For ``ACK`` the last message that arrived; otherwise the fence's number.
        """

    def pong_received(self, stamp: int, rtt: float) -> None:
        """The answer to the ping with this stamp came; ``rtt`` is the round trip on the wire in seconds."""

    def proved(self) -> None:
        """The connection is doubted no more."""

    def closed(self, reason: str) -> None:
        """The connection is over: the driver sends the remaining output and closes the socket."""

    @property
    def up(self) -> bool:
        """Whether messages go through."""
        return self.state is ConnectionState.UP

    def take_output(self) -> bytes:
        """Return the bytes to send now, before any data that is sent later."""
        output = bytes(self.output)
        self.output.clear()
        return output

    def heard(self, now: float) -> None:
        """Renew the lease: bytes were received at ``now``, even if they do not complete a frame."""
        if now > self.keepalive.heard:
            self.keepalive.hear(now)

    def receive(self, view: memoryview, now: float) -> tuple[int, int]:
        """Take whole frames from the start of ``view``.

        Returns:
            How many bytes were taken, and how many further bytes the next frame needs (0: a header, or nothing more;
            -1: none, but ``limits.FRAMES_AT_ONCE`` frames were handled that are no data, and others have their turn).

        Raises:
            RemoteProtocolError: The remote side broke the protocol; the connection is ``CLOSED``.
        """
        keepalive = self.keepalive
        keepalive.heard, keepalive.excused = now, 0.0
        if now - keepalive.sent > keepalive.lease:
            self.doubted, self._proof = True, None
        size = len(view)
        offset = handled = 0
        try:
            if self._missing:
                offset = self._take_rest(view)
            while size - offset >= _HEADER and handled < limits.FRAMES_AT_ONCE:
                length, kind, flags, _, route, sequence, stamp_ns = frames.unpack_header(view, offset)
                if (kind != _DATA or self.state is not ConnectionState.UP) and not self._admit(kind):
                    return size, 0
                # One comparison for each frame of the data path; check_header finds what is wrong.
                if kind != _DATA or length > limits.DATA_PAYLOAD_MAX or flags != WHOLE:
                    frames.check_header(length, kind, flags)
                start = offset + _HEADER
                end = start + length
                if end > size:
                    if kind != _DATA or length <= core_limits.CUT_THROUGH_BYTES or size - start < _FIRST_PART:
                        return offset, end - offset
                    # Handed on as it arrives, so that a large frame is neither awaited nor moved within the buffer.
                    self._missing = end - size
                    self._begun = (route, sequence, stamp_ns, flags & LAST)
                    self._part(route, sequence, stamp_ns, flags & FIRST, view[start:])
                    return size, 0
                offset = end
                if kind != _DATA:
                    self._handle(FrameKind(kind), view[start:end], route, sequence, stamp_ns, now)
                    handled += 1
                elif flags == WHOLE and (handler := self.routes.get(route)) is not None:
                    handler.message(sequence, stamp_ns, view[start:end])
                else:
                    self._part(route, sequence, stamp_ns, flags, view[start:end])
        except RemoteProtocolError as error:
            if not self.dialled and self.remote is None and view[0] == _TLS_HANDSHAKE:
                text = f"{self.ours.name} is not secured, but the dialler is; {TrustReason.UNSECURED.remedy}"
                self.refuse(Refuse(TrustReason.UNSECURED, text), now)
                return size, 0
            self.malformed = True
            self._end(f"{self.name} broke the protocol: {error}")
            raise
        taken = size if self.state is ConnectionState.CLOSED else offset
        return taken, -1 if size - taken >= _HEADER else 0

    def refuse(self, refuse: Refuse, now: float) -> None:
        """Refuse the connection, in the handshake or because its peer was revoked, and close it."""
        if self.dialled and not self._secured:
            self._send(frames.bye(refuse.text))
        else:
            self._send(Frame(FrameKind.REFUSE, refuse.serialize()))
        self._close(f"refused: {refuse}", now)
        self.refused(refuse, by_us=True)

    def pack_control(self, payload: bytes) -> bytes:
        """The bytes of a control frame, for the driver to send.

        Raises:
            LocalProtocolError: It is too long.
        """
        return Frame(FrameKind.CONTROL, payload, stamp_ns=self._wall_ns()).serialize()

    def close(self, reason: str, now: float, *, moves: bool = False) -> None:
        """Send a bye; ``lost`` or the timer then leads to ``closed``. Without effect once closing.

        Args:
            reason: Why, for people.
            now: Monotonic seconds.
            moves: Whether this side is back at once, at another address.
        """
        if self.state < ConnectionState.CLOSING:
            if self.up:
                self._send(frames.bye(reason, stamp_ns=self._wall_ns(), moves=moves))
            self.moves = moves
            self._close(reason, now)

    def lost(self, reason: str) -> None:
        """Handle the end of the TCP connection (in ``CLOSING`` an orderly end); without effect once closed."""
        self._end(self._reason or reason)

    def ping(self, now: float) -> int:
        """Send a ping, and return its stamp, which ``pong_received`` gets with the answer.

        Raises:
            LocalProtocolError: The connection is not up.
        """
        if not self.up:
            raise LocalProtocolError(f"no ping on a link that is {self.state.name}")
        stamp = self._wall_ns()
        if self.doubted and self._proof is None:
            self._proof = stamp
        self.clock.pinged(stamp, now)
        self._send(Frame(FrameKind.PING, stamp_ns=stamp))
        self.keepalive.pinged(now)
        return stamp

    def need(self, now: float, *, needed: bool) -> None:
        """Say whether something depends on this connection; if neither side needs it, it rests.

        Without effect on a connection that is not up.
        """
        keepalive = self.keepalive
        if not self.up or keepalive.needed is needed:
            return
        keepalive.needed = needed
        if keepalive.settle() and needed:
            keepalive.wake(now, max(limits.WAKE_TIMEOUT, 3 * (self.clock.rtt or 0.0)))
        self._send_pace(now)

    @property
    def rests(self) -> bool:
        """Whether the connection is at rest: its keepalives are rare, and silence is noticed later."""
        return self.up and self.keepalive.rests

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds."""
        if self.state is ConnectionState.CLOSED:
            return None
        return self.keepalive.due if self.up else self._deadline

    def handle_timer(self, now: float) -> None:
        """Do what is due: send a keepalive, or end the connection by its lease or a time-out (handshake, closing)."""
        due = self.next_timer()
        if due is None or now < due:
            return
        keepalive = self.keepalive
        if now - due > _PAUSE_NOTICED:
            keepalive.excuse(now - due, now)
        if now - keepalive.sent > keepalive.lease:
            self.doubted, self._proof = True, None
        if self.state is ConnectionState.CLOSING:
            self._end(self._reason)
        elif self.state is ConnectionState.HANDSHAKING:
            self._end(f"{self.name} did not finish the handshake within {limits.HANDSHAKE_TIMEOUT:g} s")
        elif now >= keepalive.lease_end:
            excused = keepalive.excused
            ours = f", our own pauses of {excused:.2g} s not counted" if excused else ""
            self._end(f"{self.name} was silent for its lease of {keepalive.awaited_lease:g} s{ours}")
        elif keepalive.settle():
            self._send_pace(now)
        else:
            self.ping(now)

    def _admit(self, kind: int) -> bool:
        """Whether a frame of this kind is handled now; false while closing, when all frames are ignored.

        Raises:
            RemoteProtocolError: The remote side may not send such a frame in this state.
        """
        if self.state >= ConnectionState.CLOSING:
            return False
        if self.up:
            # A refusal is of a dialler that does not trust this acceptor, or because this module is revoked.
            allowed = kind > FrameKind.REFUSE or (kind == FrameKind.REFUSE and self._secured)
        else:
            allowed = kind in ((FrameKind.WELCOME, FrameKind.REFUSE) if self.dialled else (FrameKind.HELLO,))
        if not allowed:
            what = FrameKind(kind).name.lower() if kind in frames.PAYLOAD_MAX else f"kind {kind}"
            raise RemoteProtocolError(f"{what} frame while {self.state.name.lower()}")
        return True

    def _take_rest(self, view: memoryview) -> int:
        """Hand on the received bytes of a data frame that was begun; return their number."""
        count = min(self._missing, len(view))
        self._missing -= count
        if self.up:
            route, sequence, stamp_ns, last = self._begun
            self._part(route, sequence, stamp_ns, 0 if self._missing else last, view[:count])
        return count

    def _part(self, route: int, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        if (handler := self.routes.get(route)) is not None:
            handler.part(sequence, stamp_ns, flags, part)
        else:
            self._counters.add("route.unknown")

    def _handle(
        self, kind: FrameKind, payload: memoryview, route: int, sequence: int, stamp_ns: int, now: float
    ) -> None:
        if _log.isEnabledFor(logging.DEBUG):
            _log.debug("< %s: %s, %d bytes", self.name, kind.name, len(payload))
        match kind:
            case FrameKind.PING:
                came = self._wall_ns()
                self._send(frames.pong(stamp_ns, came, self._wall_ns()))
                self.keepalive.sent = now
            case FrameKind.PONG:
                t1, t2 = frames.parse_pong(payload)
                if t1 == self._proof:
                    self.doubted, self._proof = False, None
                    self.proved()
                rtt = self.clock.ponged(t1, t2, stamp_ns, self._wall_ns(), now)
                if rtt is not None:
                    self.pong_received(t1, rtt)
            case FrameKind.CONTROL:
                self.control_received(bytes(payload))
            case FrameKind.PACE:
                lease = min(max(sequence / 1000, limits.LINK_LEASE_MIN), limits.LINK_LEASE_MAX)
                self.keepalive.remote_pace(lease, now, needed=bool(route & PACE_NEEDED))
                if self.keepalive.settle():
                    self._send_pace(now)
            case FrameKind.BYE:
                self.moves = bool(route & frames.MOVES)
                self._end(f"{self.name} left: {frames.parse_text(payload)}")
            case FrameKind.REFUSE:
                refuse = Refuse.parse(payload)
                self.refused(refuse, by_us=False)
                self._end(f"{self.name} refused: {refuse}")
            case FrameKind.HELLO | FrameKind.WELCOME:
                self._greeted(Hello.parse(payload), now)
            case _:
                self.mark_received(kind, route, sequence)

    def _greeted(self, hello: Hello | Refuse, now: float) -> None:
        """Answer a hello, or take in the answer to one."""
        if isinstance(hello, Refuse):
            self.refuse(hello, now)
            return
        if not self.dialled:
            self.remote, self.name, self.lane = hello, hello.name, hello.lane
        if (refuse := self.judge(hello)) is not None:
            self.refuse(refuse, now)
            return
        if not self.dialled:
            if hello.lane == Lane.BULK:
                self.keepalive.usual = self.keepalive.lease = limits.BULK_LEASE
            welcome = Hello.of(self.ours, lease=self.keepalive.lease, expected=hello.guid, lane=hello.lane)
            self._send(Frame(FrameKind.WELCOME, welcome.serialize()))
        self.state, self.since = ConnectionState.UP, now
        self.remote, self.name = hello, hello.name
        self.keepalive.remote_lease = hello.lease
        self.keepalive.heard = self.keepalive.up_at = now
        _log.debug("= %s: up", self.name)
        self.ping(now)
        self.opened()

    def _close(self, reason: str, now: float) -> None:
        self.state, self._reason = ConnectionState.CLOSING, reason
        self._deadline = now + runtime_limits.DRAIN_TIMEOUT
        _log.debug("= %s: closing: %s", self.name, reason)

    def _end(self, reason: str) -> None:
        if self.state is not ConnectionState.CLOSED:
            self.state, self._reason = ConnectionState.CLOSED, reason
            _log.debug("= %s: closed: %s", self.name, reason)
            self.closed(reason)

    def _send_pace(self, now: float) -> None:
        """Promise the lease that holds from now on; the ping measures the path, and is the first sign of life."""
        needs = PACE_NEEDED if self.keepalive.needed else 0
        self._send(Frame(FrameKind.PACE, route=needs, sequence=round(self.keepalive.lease * 1000)))
        self.ping(now)

    def _send(self, frame: Frame) -> None:
        if _log.isEnabledFor(logging.DEBUG):
            _log.debug("> %s: %s", self.name, frame)
        self.output += frame.serialize()
