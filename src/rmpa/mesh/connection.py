"""The protocol machine of one connection: handshake, frames, keepalive, bye.

Sans-I/O: bytes and ``now`` go in, events and bytes come out. A link with a peer has one connection for each of its
lanes; each connection runs this machine, and ``mesh.io.link`` joins them.

::

    HANDSHAKING ──welcome sent or received──► UP ──bye sent──► CLOSING ──TCP end, 1 s──► CLOSED
         ├─ refuse or bye sent: CLOSING         └─ bye received, lease over, protocol error: CLOSED
         └─ refused, time out, error: CLOSED

The driver passes received bytes to ``receive``, sends the bytes that ``take_output`` returns, calls ``handle_timer``
when ``next_timer`` is due, and closes the socket at ``ConnectionClosed``. Events and data are reported in the order
of the received bytes, from within ``receive``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from enum import Enum, auto
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.counters import Counters
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.core.outbox import FIRST, LAST
from rmpa.mesh import frames, limits
from rmpa.mesh.frames import Frame, FrameKind, HandshakeError, Hello, Lane, Refuse, judge_welcome
from rmpa.mesh.keepalive import (
    ConnectionClosed,
    ConnectionEvent,
    ControlReceived,
    HandshakeDone,
    HelloReceived,
    Keepalive,
    MarkReceived,
    PongReceived,
    Refused,
    RemoteClock,
    RestPace,
)
from rmpa.runtime import limits as runtime_limits
from rmpa.trust.permissions import TrustReason

if TYPE_CHECKING:
    from rmpa.core.identity import Guid, Identity

_log = logging.getLogger(__name__)

_HEADER: Final = limits.FRAME_HEADER_BYTES
_DATA: Final = int(FrameKind.DATA)
_WHOLE: Final = frames.WHOLE
_FIRST_PART: Final = 4
_TLS_HANDSHAKE: Final = 0x16
"""The first byte of a TLS connection; a frame begins with 0, as it is shorter than 16 MiB."""
"""Bytes that the first part of a message must have, because they contain the message's length."""


class ConnectionRole(Enum):
    """Which side of the TCP connection this is."""

    DIALLER = auto()
    ACCEPTOR = auto()


class ConnectionState(Enum):
    """The state of a connection, from handshake to end."""

    HANDSHAKING = auto()
    UP = auto()
    CLOSING = auto()
    CLOSED = auto()


class _Step(Enum):
    WELCOMED = auto()
    REFUSING = auto()
    LEAVING = auto()
    ENDED = auto()


_NEXT: Final[Mapping[tuple[ConnectionState, _Step], ConnectionState]] = MappingProxyType(
    {
        (ConnectionState.HANDSHAKING, _Step.WELCOMED): ConnectionState.UP,
        (ConnectionState.HANDSHAKING, _Step.REFUSING): ConnectionState.CLOSING,
        (ConnectionState.HANDSHAKING, _Step.LEAVING): ConnectionState.CLOSING,
        (ConnectionState.HANDSHAKING, _Step.ENDED): ConnectionState.CLOSED,
        (ConnectionState.UP, _Step.LEAVING): ConnectionState.CLOSING,
        (ConnectionState.UP, _Step.ENDED): ConnectionState.CLOSED,
        (ConnectionState.CLOSING, _Step.ENDED): ConnectionState.CLOSED,
    }
)

_WHEN_UP: Final[frozenset[int]] = frozenset(
    {
        FrameKind.PING,
        FrameKind.PONG,
        FrameKind.CONTROL,
        FrameKind.DATA,
        FrameKind.BYE,
        FrameKind.ACK,
        FrameKind.FENCE,
        FrameKind.FENCED,
        FrameKind.PACE,
        FrameKind.LANE,
    }
)
_ALLOWED: Final[Mapping[tuple[ConnectionRole, ConnectionState], frozenset[int]]] = MappingProxyType(
    {
        (ConnectionRole.DIALLER, ConnectionState.HANDSHAKING): frozenset(
            {int(FrameKind.WELCOME), int(FrameKind.REFUSE)}
        ),
        (ConnectionRole.ACCEPTOR, ConnectionState.HANDSHAKING): frozenset({int(FrameKind.HELLO)}),
        (ConnectionRole.DIALLER, ConnectionState.UP): _WHEN_UP,
        (ConnectionRole.ACCEPTOR, ConnectionState.UP): _WHEN_UP,
    }
)


OnEvent = Callable[[ConnectionEvent], None]


class DataHandler:
    """Takes the data that arrives on one route; for subclasses."""

    __slots__ = ()

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """Take a whole message, its 4-byte length in front; ``framed`` is valid during the call only.

        Raises:
            RemoteProtocolError: It is no message; the connection is closed.
        """
        raise NotImplementedError

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Take a part of a large message (``core.outbox`` FIRST, LAST, ABORT); valid during the call only.

        The parts of one message are in order, with parts of other routes in between.

        Raises:
            RemoteProtocolError: The parts are no message; the connection is closed.
        """
        raise NotImplementedError


class ConnectionProtocol:
    """One side of one connection.

    Args:
        role: Which side.
        ours: The identity of this agent.
        now: Monotonic seconds at which the connection was established.
        wall_ns: Returns the wall clock in nanoseconds; only called where a stamp is needed.
        on_event: Called from within the methods below; it may call any of them except ``receive``.
        counters: Counts data frames of routes that are not open, as ``route.unknown``.
        expected: Dialler: the GUID that was dialled; ``None`` if only the address is known.
        lane: Dialler: what the connection is for.
        lease: Seconds after which the silence of this side means that it is dead.
        rest: The pace of all resting links of this agent.
        label: For log lines, until the remote side's name is known.
        prove: Judges whether the remote side is the module that its hello or welcome says; ``None`` accepts it.
    """

    def __init__(
        self,
        role: ConnectionRole,
        ours: Identity,
        now: float,
        *,
        wall_ns: Callable[[], int],
        on_event: OnEvent,
        counters: Counters | None = None,
        expected: Guid | None = None,
        lane: Lane = Lane.EXPRESS,
        lease: float = limits.EXPRESS_LEASE,
        rest: RestPace | None = None,
        label: str = "?",
        prove: Callable[[Hello], Refuse | None] | None = None,
    ) -> None:
        self.role = role
        self.clock = RemoteClock()
        self.remote: Hello | None = None
        """The remote side's hello or welcome; ``None`` before it is received."""
        self.on_event = on_event
        self.prove = prove
        self.routes: Mapping[int, DataHandler] = {}
        """The handler of each open route. Assigned once the peer, and so the receiver of its data, is known."""
        self._counters = counters if counters is not None else Counters()
        self._ours = ours
        self._wall_ns = wall_ns
        self._missing = 0
        """Bytes that are still missing of a data frame whose first bytes were handed on."""
        self._begun = (0, 0, 0, 0)
        """Route, sequence, stamp and LAST flag of that frame."""
        self.abandoned = False
        """Whether this process was stopped for longer than the lease that it promised: the remote side has ended the
        connection then, and given up what it asked in it. True until a ping from after that is answered."""
        self._proof: int | None = None
        self._expected = expected
        self._label = label
        self._state = ConnectionState.HANDSHAKING
        phase = int.from_bytes(ours.instance[:2], "big") / 65536 * limits.IDLE_KEEPALIVE_INTERVAL
        self._keepalive = Keepalive(lease, now, acceptor=role is ConnectionRole.ACCEPTOR, phase=phase, rest=rest)
        self._deadline = now + limits.HANDSHAKE_TIMEOUT
        self._reason = ""
        self._output = bytearray()
        if role is ConnectionRole.DIALLER:
            hello = Hello.of(ours, lease=lease, expected=expected, lane=lane)
            self._send(Frame(FrameKind.HELLO, hello.serialize()))

    @property
    def state(self) -> ConnectionState:
        """The present state."""
        return self._state

    @property
    def heard_at(self) -> float:
        """Monotonic seconds at which bytes were last received."""
        return self._keepalive.heard

    @property
    def has_output(self) -> bool:
        """Whether there are bytes for ``take_output``."""
        return bool(self._output)

    def take_output(self) -> bytes:
        """Return the bytes to send now, before any data that is sent later."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def heard(self, now: float) -> None:
        """Renew the lease: bytes were received at ``now``, even if they do not complete a frame."""
        self._keepalive.heard = max(self._keepalive.heard, now)

    def receive(self, view: memoryview, now: float) -> tuple[int, int]:
        """Take whole frames from the start of ``view``.

        Returns:
            How many bytes were taken, and how many further bytes the next frame needs (0: a header, or nothing more).

        Raises:
            RemoteProtocolError: The remote side broke the protocol; the connection is ``CLOSED``.
        """
        keepalive = self._keepalive
        keepalive.heard = now
        if now - keepalive.sent > keepalive.lease:
            self.abandoned, self._proof = True, None
        size = len(view)
        offset = 0
        try:
            if self._missing:
                offset = self._take_rest(view)
            while size - offset >= _HEADER:
                length, kind, flags, _, route, sequence, stamp_ns = frames.unpack_header(view, offset)
                if (kind != _DATA or self._state is not ConnectionState.UP) and not self._admit(kind):
                    return size, 0
                # One comparison for each frame of the data path; check_header finds what is wrong.
                if kind != _DATA or length > limits.DATA_PAYLOAD_MAX or flags != _WHOLE:
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
                elif flags == _WHOLE and (handler := self.routes.get(route)) is not None:
                    handler.message(sequence, stamp_ns, view[start:end])
                else:
                    self._part(route, sequence, stamp_ns, flags, view[start:end])
        except RemoteProtocolError as error:
            if self.role is ConnectionRole.ACCEPTOR and self.remote is None and view[0] == _TLS_HANDSHAKE:
                text = f"{self._ours.name} is not secured, but the dialler is; {TrustReason.UNSECURED.remedy}"
                self._refuse(Refuse(TrustReason.UNSECURED, text), now)
                return size, 0
            self._end(f"{self._name} broke the protocol: {error}")
            raise
        return (size if self._state is ConnectionState.CLOSED else offset), 0

    def accept(self, now: float) -> None:
        """Acceptor, after ``HelloReceived``: send the welcome; the connection is up.

        Raises:
            LocalProtocolError: No hello was received, or it was answered already.
        """
        hello = self._unanswered()
        if hello.lane == Lane.BULK:
            self._keepalive.promise(limits.BULK_LEASE)
        lease = self._keepalive.lease
        welcome = Hello.of(self._ours, lease=lease, expected=hello.guid, lane=hello.lane)
        self._send(Frame(FrameKind.WELCOME, welcome.serialize()))
        self._open(hello, now)

    def refuse(self, refuse: Refuse, now: float) -> None:
        """Acceptor, after ``HelloReceived``: refuse the connection, and close it.

        Raises:
            LocalProtocolError: No hello was received, or it was answered already.
        """
        self._unanswered()
        self._refuse(refuse, now)

    def expel(self, refuse: Refuse, now: float) -> None:
        """Secured mesh: refuse a connection that is up, and close it, because its peer was revoked.

        Raises:
            LocalProtocolError: The connection is not up.
        """
        if self._state is not ConnectionState.UP:
            raise LocalProtocolError(f"no revocation on a link that is {self._state.name}")
        self._refuse(refuse, now)

    def control(self, payload: bytes) -> bytes:
        """The bytes of a control frame, for the driver to send.

        Raises:
            LocalProtocolError: It is too long.
        """
        return Frame(FrameKind.CONTROL, payload, stamp_ns=self._wall_ns()).serialize()

    def close(self, reason: str, now: float) -> None:
        """Send a bye; ``lost`` or the timer then reports ``ConnectionClosed``. Without effect once closing."""
        if self._state in (ConnectionState.CLOSING, ConnectionState.CLOSED):
            return
        if self._state is ConnectionState.UP:
            self._send(frames.bye(reason, stamp_ns=self._wall_ns()))
        self._close(_Step.LEAVING, reason, now)

    def lost(self, reason: str) -> None:
        """Handle the end of the TCP connection (in ``CLOSING`` an orderly end); without effect once closed."""
        if self._state is not ConnectionState.CLOSED:
            self._end(self._reason or reason)

    def ping(self, now: float) -> int:
        """Send a ping, and return its stamp; the answer is reported as a ``PongReceived`` with this stamp.

        Raises:
            LocalProtocolError: The connection is not up.
        """
        if self._state is not ConnectionState.UP:
            raise LocalProtocolError(f"no ping on a link that is {self._state.name}")
        return self._ping(now)

    def need(self, now: float, *, needed: bool) -> None:
        """Say whether something depends on this connection; if neither side needs it, it rests.

        Without effect on a connection that is not up.
        """
        keepalive = self._keepalive
        if self._state is not ConnectionState.UP or keepalive.needed is needed:
            return
        keepalive.needed = needed
        if keepalive.agree() and needed:
            keepalive.wake(now, max(limits.WAKE_TIMEOUT, 3 * (self.clock.rtt or 0.0)))
        self._send_pace(now)

    @property
    def rests(self) -> bool:
        """Whether the connection is at rest: its keepalives are rare."""
        return self._state is ConnectionState.UP and self._keepalive.rests

    @property
    def remote_lease(self) -> float:
        """Seconds after which the silence of the remote side ends the connection."""
        return self._keepalive.remote_lease

    @property
    def quiet_after(self) -> float:
        """Seconds without bytes after which the remote side is worth a check."""
        return self._keepalive.quiet_after

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds."""
        if self._state is ConnectionState.CLOSED:
            return None
        return self._keepalive.due if self._state is ConnectionState.UP else self._deadline

    def handle_timer(self, now: float) -> None:
        """Do what is due: send a keepalive, or end the connection by its lease or a time-out (handshake, closing)."""
        due = self.next_timer()
        if due is None or now < due:
            return
        keepalive = self._keepalive
        if now - due > limits.PAUSE_NOTICED:
            keepalive.excuse(now - due, now)
        if now - keepalive.sent > keepalive.lease:
            self.abandoned, self._proof = True, None
        if self._state is ConnectionState.CLOSING:
            self._end(self._reason)
        elif self._state is ConnectionState.HANDSHAKING:
            self._end(f"{self._name} did not finish the handshake within {limits.HANDSHAKE_TIMEOUT:g} s")
        elif now >= keepalive.lease_end:
            excused = keepalive.excused
            ours = f", our own pauses of {excused:.2g} s not counted" if excused else ""
            self._end(f"{self._name} was silent for its lease of {keepalive.awaited_lease:g} s{ours}")
        elif keepalive.renew():
            self._send_pace(now)
        else:
            self._ping(now)

    # --- inside ---------------------------------------------------------------------------------------------

    @property
    def _name(self) -> str:
        return self.remote.name if self.remote is not None else self._label

    def _admit(self, kind: int) -> bool:
        """Whether a frame of this kind is handled now; false while closing, when all frames are ignored.

        Raises:
            RemoteProtocolError: The remote side may not send such a frame in this state.
        """
        if self._state in (ConnectionState.CLOSING, ConnectionState.CLOSED):
            return False
        if kind == FrameKind.REFUSE and self._state is ConnectionState.UP and self.prove is not None:
            return True  # of a dialler that does not trust this acceptor, and once this module is revoked
        if kind not in _ALLOWED[self.role, self._state] or (
            self.remote is not None and self._state is not ConnectionState.UP
        ):
            what = FrameKind(kind).name.lower() if kind in frames.PAYLOAD_MAX else f"kind {kind}"
            raise RemoteProtocolError(f"{what} frame while {self._state.name.lower()}")
        return True

    def _take_rest(self, view: memoryview) -> int:
        """Hand on the received bytes of a data frame that was begun; return their number."""
        count = min(self._missing, len(view))
        self._missing -= count
        if self._state is ConnectionState.UP:
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
            _log.debug("< %s: %s, %d bytes", self._name, kind.name, len(payload))
        if kind is FrameKind.PING:
            came = self._wall_ns()
            self._send(frames.pong(stamp_ns, came, self._wall_ns()))
            self._keepalive.sent = now
        elif kind is FrameKind.PONG:
            t1, t2 = frames.parse_pong(payload)
            if t1 == self._proof:
                self.abandoned, self._proof = False, None
            sample = self.clock.ponged(t1, t2, stamp_ns, self._wall_ns(), now)
            if sample is not None:
                self.on_event(PongReceived(t1, sample.rtt))
        elif kind is FrameKind.CONTROL:
            self.on_event(ControlReceived(bytes(payload)))
        elif kind is FrameKind.PACE:
            lease = min(max(sequence / 1000, limits.LINK_LEASE_MIN), limits.LINK_LEASE_MAX)
            self._paced(lease, route, now)
        elif kind in {FrameKind.ACK, FrameKind.FENCE, FrameKind.FENCED, FrameKind.LANE}:
            self.on_event(MarkReceived(kind, route, sequence))
        elif kind is FrameKind.BYE:
            self._end(f"{self._name} left: {frames.parse_text(payload)}")
        elif kind is FrameKind.REFUSE:
            refuse = Refuse.parse(payload)
            self.on_event(Refused(refuse, by_us=False))
            self._end(f"{self._label} refused: {refuse}")
        else:
            self._handshake(payload, now)

    def _handshake(self, payload: memoryview, now: float) -> None:
        try:
            hello = Hello.parse(payload)
        except HandshakeError as error:
            self._refuse(error.refuse, now)
            return
        refuse = self.prove(hello) if self.prove is not None else None
        if self.role is ConnectionRole.ACCEPTOR:
            self.remote = hello
        if refuse is not None:
            self._refuse(refuse, now)
        elif self.role is ConnectionRole.ACCEPTOR:
            self.on_event(HelloReceived(hello))
        elif refuse := judge_welcome(hello, self._ours, self._expected):
            self._refuse(refuse, now)
        else:
            self._open(hello, now)

    def _unanswered(self) -> Hello:
        if (
            self.role is not ConnectionRole.ACCEPTOR
            or self.remote is None
            or self._state is not ConnectionState.HANDSHAKING
        ):
            raise LocalProtocolError(f"no hello waits for an answer (state {self._state.name})")
        return self.remote

    def _open(self, hello: Hello, now: float) -> None:
        self._state = _NEXT[self._state, _Step.WELCOMED]
        self.remote = hello
        self._keepalive.begin(hello.lease, now)
        _log.debug("= %s: up", self._name)
        self._ping(now)
        self.on_event(HandshakeDone(hello))

    def _refuse(self, refuse: Refuse, now: float) -> None:
        up = self._state is ConnectionState.UP
        self._send(
            Frame(FrameKind.REFUSE, refuse.serialize())
            if self.role is ConnectionRole.ACCEPTOR or self.prove is not None
            else frames.bye(refuse.text)
        )
        self._close(_Step.LEAVING if up else _Step.REFUSING, f"refused: {refuse}", now)
        self.on_event(Refused(refuse, by_us=True))

    def _close(self, step: _Step, reason: str, now: float) -> None:
        self._state = _NEXT[self._state, step]
        self._reason = reason
        self._deadline = now + runtime_limits.DRAIN_TIMEOUT
        _log.debug("= %s: closing: %s", self._name, reason)

    def _end(self, reason: str) -> None:
        if self._state is ConnectionState.CLOSED:
            return
        self._state = _NEXT[self._state, _Step.ENDED]
        self._reason = reason
        _log.debug("= %s: closed: %s", self._name, reason)
        self.on_event(ConnectionClosed(reason))

    def _ping(self, now: float) -> int:
        stamp = self._wall_ns()
        if self.abandoned and self._proof is None:
            self._proof = stamp
        self.clock.pinged(stamp, now)
        self._send(Frame(FrameKind.PING, stamp_ns=stamp))
        self._keepalive.pinged(now)
        return stamp

    def _paced(self, lease: float, flags: int, now: float) -> None:
        self._keepalive.remote_pace(lease, now, flags)
        if self._keepalive.agree():
            self._send_pace(now)

    def _send_pace(self, now: float) -> None:
        """Promise the lease that holds from now on; the ping measures the path, and is the first sign of life."""
        keepalive = self._keepalive
        self._send(Frame(FrameKind.PACE, route=int(keepalive.flags), sequence=round(keepalive.lease * 1000)))
        self._ping(now)

    def _send(self, frame: Frame) -> None:
        if _log.isEnabledFor(logging.DEBUG):
            _log.debug("> %s: %s", self._name, frame)
        self._output += frame.serialize()
