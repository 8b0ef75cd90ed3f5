"""One link's machine: handshake, keepalive, lease, bye. Bytes and ``now`` in; events and bytes out.

::

    HANDSHAKING ──welcome sent or received──► UP ──bye sent──► CLOSING ──drained, 1 s──► CLOSED
         ├─ refuse or bye sent: CLOSING         └─ bye received, lease over, protocol error: CLOSED
         └─ refused, time out, error: CLOSED

The driver feeds ``receive``, sends what ``take_output`` gives, calls ``handle_timer`` when ``next_timer`` is due
and closes the socket at ``LinkClosed``. Events and data come in the order of the bytes, from within ``receive``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, auto
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from rmpa.core import limits as core_limits
from rmpa.core.clock import earliest
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.core.outbox import FIRST, LAST
from rmpa.mesh import frames, limits
from rmpa.mesh.frames import Frame, FrameKind
from rmpa.mesh.handshake import HandshakeError, Hello, Lane, Refuse, judge_welcome
from rmpa.mesh.timing import LinkClock
from rmpa.runtime import limits as runtime_limits

if TYPE_CHECKING:
    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity

_log = logging.getLogger(__name__)

_HEADER: Final = limits.FRAME_HEADER_BYTES
_DATA: Final = int(FrameKind.DATA)
_WHOLE: Final = frames.WHOLE
_FIRST_PART: Final = 4
"""Bytes of a message without which its first part says nothing: its length."""


class LinkRole(Enum):
    """Who connected."""

    DIALLER = auto()
    ACCEPTOR = auto()


class LinkState(Enum):
    """Where a link is in its life."""

    HANDSHAKING = auto()
    UP = auto()
    CLOSING = auto()
    CLOSED = auto()


class _Act(Enum):
    WELCOMED = auto()
    REFUSING = auto()
    LEAVING = auto()
    ENDED = auto()


_NEXT: Final[Mapping[tuple[LinkState, _Act], LinkState]] = MappingProxyType(
    {
        (LinkState.HANDSHAKING, _Act.WELCOMED): LinkState.UP,
        (LinkState.HANDSHAKING, _Act.REFUSING): LinkState.CLOSING,
        (LinkState.HANDSHAKING, _Act.LEAVING): LinkState.CLOSING,
        (LinkState.HANDSHAKING, _Act.ENDED): LinkState.CLOSED,
        (LinkState.UP, _Act.LEAVING): LinkState.CLOSING,
        (LinkState.UP, _Act.ENDED): LinkState.CLOSED,
        (LinkState.CLOSING, _Act.ENDED): LinkState.CLOSED,
    }
)

_TALK: Final[frozenset[int]] = frozenset(
    {
        FrameKind.PING,
        FrameKind.PONG,
        FrameKind.CONTROL,
        FrameKind.DATA,
        FrameKind.BYE,
        FrameKind.ACK,
        FrameKind.FENCE,
        FrameKind.FENCED,
    }
)
_ALLOWED: Final[Mapping[tuple[LinkRole, LinkState], frozenset[int]]] = MappingProxyType(
    {
        (LinkRole.DIALLER, LinkState.HANDSHAKING): frozenset({int(FrameKind.WELCOME), int(FrameKind.REFUSE)}),
        (LinkRole.ACCEPTOR, LinkState.HANDSHAKING): frozenset({int(FrameKind.HELLO)}),
        (LinkRole.DIALLER, LinkState.UP): _TALK,
        (LinkRole.ACCEPTOR, LinkState.UP): _TALK,
    }
)


@dataclass(frozen=True, slots=True)
class HelloReceived:
    """Acceptor: somebody wants a link; answer with ``accept`` or ``refuse``."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class Up:
    """The handshake is over, both want the link."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class ControlReceived:
    """A control frame came.

    Args:
        payload: Its bytes, a copy.
    """

    payload: bytes


@dataclass(frozen=True, slots=True)
class Ponged:
    """A ping was answered.

    Args:
        stamp: The ping's.
        rtt: Seconds on the wire, without the other side's own time.
    """

    stamp: int
    rtt: float


@dataclass(frozen=True, slots=True)
class Refused:
    """No link: one of the two said no. ``LinkClosed`` follows.

    Args:
        refuse: Why.
        by_us: Whether it was us.
    """

    refuse: Refuse
    by_us: bool


@dataclass(frozen=True, slots=True)
class LinkClosed:
    """The link is over: send what is left, close the socket.

    Args:
        reason: Why, for people.
        orderly: Whether one of the sides said so (bye, refuse), rather than an error or silence.
    """

    reason: str
    orderly: bool


@dataclass(frozen=True, slots=True)
class Marked:
    """An acknowledgement, a fence or its answer came.

    Args:
        kind: ``ACK``, ``FENCE`` or ``FENCED``.
        route: Which route.
        sequence: Up to which message; the fence's number.
    """

    kind: FrameKind
    route: int
    sequence: int


Event = HelloReceived | Up | ControlReceived | Ponged | Marked | Refused | LinkClosed
OnEvent = Callable[[Event], None]
OnData = Callable[[int, int, int, memoryview], None]
OnPart = Callable[[int, int, int, int, memoryview], None]


class LinkProtocol:
    """One side of one link.

    Args:
        role: Whether we connected.
        ours: Who we are.
        now: Monotonic seconds at which the connection stood.
        wall_ns: The wall clock; only asked where a stamp is needed.
        on_event: Called from within the methods below; it may call any of them but ``receive``.
        on_data: Called with ``(route, sequence, stamp_ns, payload)`` for each data frame; the payload is a view
            into the bytes given to ``receive`` and only valid during the call. An attribute that may be changed.
        on_part: Called with ``(route, sequence, stamp_ns, flags, part)`` for each part of a message that comes in
            parts; parts of one message come in order, those of other routes in between. Likewise.
        expected: Dialler: whom we believe we dialled, ``None`` if only the address is known.
        lease: What we promise: seconds after which our silence means that we are dead.
        label: For log lines, until the other side's name is known.
    """

    def __init__(
        self,
        role: LinkRole,
        ours: Identity,
        now: float,
        *,
        wall_ns: Callable[[], int],
        on_event: OnEvent,
        on_data: OnData,
        on_part: OnPart | None = None,
        expected: Guid | None = None,
        lane: Lane = Lane.EXPRESS,
        lease: float = limits.LINK_LEASE,
        label: str = "?",
    ) -> None:
        self.role = role
        self.clock = LinkClock()
        self.remote: Hello | None = None
        self._ours = ours
        self._wall_ns = wall_ns
        self.on_event = on_event
        self.on_data = on_data
        self.on_part = on_part if on_part is not None else _no_parts
        self._left = 0
        self._rest = (0, 0, 0, 0)
        self._expected = expected
        self._label = label
        self._state = LinkState.HANDSHAKING
        self._promise(lease)
        self._deadline = now + limits.HANDSHAKE_TIMEOUT
        self._reason = ""
        self._heard = now
        self._excused = self._excused_behind = 0.0
        self._welcomed = now
        self._sent = now
        self._pinged = now
        self._output = bytearray()
        if role is LinkRole.DIALLER:
            hello = Hello.of(ours, lease=lease, expected=expected, lane=lane)
            self._send(Frame(FrameKind.HELLO, hello.serialize()))

    @property
    def state(self) -> LinkState:
        """Where the link is in its life."""
        return self._state

    @property
    def heard_at(self) -> float:
        """Monotonic seconds at which bytes last came."""
        return self._heard

    @property
    def has_output(self) -> bool:
        """Whether ``take_output`` has something."""
        return bool(self._output)

    def take_output(self) -> bytes:
        """Bytes to send, before all data that is sent later."""
        output = bytes(self._output)
        self._output.clear()
        return output

    def heard(self, now: float) -> None:
        """Bytes came at ``now``, though not yet a whole frame: a large message renews the lease as it arrives."""
        self._heard = max(self._heard, now)

    def receive(self, view: memoryview, now: float) -> tuple[int, int]:
        """Take whole frames from the start of ``view``.

        Returns:
            How many bytes were taken, and how many bytes there must be behind those for the next frame (0: a
            header, or nothing more).

        Raises:
            RemoteProtocolError: The other side broke the protocol; the link is ``CLOSED``.
        """
        self._heard = now
        size = len(view)
        offset = 0
        try:
            if self._left:
                offset = self._take_rest(view)
            while size - offset >= _HEADER:
                length, kind, flags, _, route, sequence, stamp_ns = frames.unpack_header(view, offset)
                if (kind != _DATA or self._state is not LinkState.UP) and not self._admit(kind):
                    return size, 0
                # One comparison each on the data path; what is wrong is said by check_header.
                if kind != _DATA or length > limits.DATA_PAYLOAD_MAX or flags != _WHOLE:
                    frames.check_header(length, kind, flags)
                start = offset + _HEADER
                end = start + length
                if end > size:
                    if kind != _DATA or length <= core_limits.CUT_THROUGH_BYTES or size - start < _FIRST_PART:
                        return offset, end - offset
                    # Handed on as it comes: nobody waits for the end of a large frame, and none is moved about.
                    self._left = end - size
                    self._rest = (route, sequence, stamp_ns, flags & LAST)
                    self.on_part(route, sequence, stamp_ns, flags & FIRST, view[start:])
                    return size, 0
                offset = end
                if kind != _DATA:
                    self._handle(FrameKind(kind), view[start:end], route, sequence, stamp_ns, now)
                elif flags == _WHOLE:
                    self.on_data(route, sequence, stamp_ns, view[start:end])
                else:
                    self.on_part(route, sequence, stamp_ns, flags, view[start:end])
        except RemoteProtocolError as error:
            self._end(f"{self._name} broke the protocol: {error}")
            raise
        return (size if self._state is LinkState.CLOSED else offset), 0

    def accept(self, now: float) -> None:
        """Acceptor, after ``HelloReceived``: welcome the other side; the link is up.

        Raises:
            LocalProtocolError: There was no hello, or it was answered.
        """
        hello = self._unanswered()
        if hello.lane == Lane.BULK:
            self._promise(limits.BULK_LEASE)
        welcome = Hello.of(self._ours, lease=self._lease, expected=hello.guid, lane=hello.lane)
        self._send(Frame(FrameKind.WELCOME, welcome.serialize()))
        self._raise_up(hello, now)

    def refuse(self, refuse: Refuse, now: float) -> None:
        """Acceptor, after ``HelloReceived``: say no, and leave.

        Raises:
            LocalProtocolError: There was no hello, or it was answered.
        """
        self._unanswered()
        self._refuse(refuse, now)

    def control(self, payload: bytes) -> bytes:
        """The bytes of a control frame, for the driver to send.

        Raises:
            LocalProtocolError: It is too long.
        """
        return Frame(FrameKind.CONTROL, payload, stamp_ns=self._wall_ns()).serialize()

    def close(self, reason: str, now: float) -> None:
        """Say bye and leave; ``LinkClosed`` comes from ``drained`` or the timer. Without effect once leaving."""
        if self._state in (LinkState.CLOSING, LinkState.CLOSED):
            return
        if self._state is LinkState.UP:
            self._send(Frame(FrameKind.BYE, frames.text_payload(reason), stamp_ns=self._wall_ns()))
        self._leave(_Act.LEAVING, reason, now)

    def drained(self) -> None:
        """The driver has sent all that was to be sent; the end of ``CLOSING``."""
        if self._state is LinkState.CLOSING:
            self._end(self._reason, orderly=True)

    def lost(self, reason: str) -> None:
        """The connection is gone; without effect once closed."""
        if self._state is not LinkState.CLOSED:
            self._end(self._reason or reason, orderly=self._state is LinkState.CLOSING)

    def ping(self, now: float) -> int:
        """Measure a round trip on demand; ``Ponged`` with the stamp that this returns is the answer.

        Raises:
            LocalProtocolError: The link is not up.
        """
        if self._state is not LinkState.UP:
            raise LocalProtocolError(f"no ping on a link that is {self._state.name}")
        return self._ping(now)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, in monotonic seconds."""
        if self._state is LinkState.CLOSED:
            return None
        if self._state is LinkState.UP:
            ping = min(self._sent + self._keepalive, self._pinged + limits.CLOCK_INTERVAL)
            return earliest(self._lease_over, ping)
        return self._deadline

    def handle_timer(self, now: float) -> None:
        """Do what is due: keepalive, end of the lease, end of the handshake's or the drain's time."""
        due = self.next_timer()
        if due is None or now < due:
            return
        if now - due > limits.PAUSE_NOTICED:
            self._excuse(min(now - due, now - self._heard))
        if self._state is LinkState.CLOSING:
            self._end(self._reason, orderly=True)
        elif self._state is LinkState.HANDSHAKING:
            self._end(f"{self._name} did not finish the handshake within {limits.HANDSHAKE_TIMEOUT:g} s")
        elif now >= self._lease_over:
            excused = self._excused_now
            ours = f", our own pauses of {excused:.2g} s not counted" if excused else ""
            self._end(f"{self._name} was silent for its lease of {self._awaited_lease:g} s{ours}")
        else:
            self._ping(now)

    # --- inside ---------------------------------------------------------------------------------------------

    @property
    def _name(self) -> str:
        return self.remote.name if self.remote is not None else self._label

    @property
    def _remote_lease(self) -> float:
        return self.remote.lease if self.remote is not None else limits.LINK_LEASE

    @property
    def _lease_over(self) -> float:
        """When the other side's silence ends the link.

        Behind our welcome a whole round trip goes by before the dialler's first word, which is still a part of the
        handshake's time: with the lease alone, no link with a round trip above it would ever come up for good.
        """
        return self._heard + self._awaited_lease + self._excused_now

    @property
    def _awaited_lease(self) -> float:
        """How long the other side may be silent now, in seconds that we looked."""
        awaited = self.role is LinkRole.ACCEPTOR and self._heard <= self._welcomed
        return max(self._remote_lease, limits.HANDSHAKE_TIMEOUT) if awaited else self._remote_lease

    @property
    def _excused_now(self) -> float:
        """Seconds of this silence in which we did not look."""
        return self._excused if self._excused_behind == self._heard else 0.0

    def _excuse(self, late: float) -> None:
        """Let the other side's silence last longer by the time for which we did not look.

        Whose timers come late was away itself: stopped, or without a processor. That is no peer's death.
        """
        self._excused, self._excused_behind = self._excused_now + late, self._heard

    def _admit(self, kind: int) -> bool:
        """Whether a frame of this kind is read now; ``False`` when we are leaving and read nothing more."""
        if self._state in (LinkState.CLOSING, LinkState.CLOSED):
            return False
        if kind not in _ALLOWED[self.role, self._state] or (
            self.remote is not None and self._state is not LinkState.UP
        ):
            what = FrameKind(kind).name.lower() if kind in frames.PAYLOAD_MAX else f"kind {kind}"
            raise RemoteProtocolError(f"{what} frame while {self._state.name.lower()}")
        return True

    def _promise(self, lease: float) -> None:
        self._lease = lease
        self._keepalive = lease * limits.KEEPALIVE_INTERVAL / limits.LINK_LEASE
        if self.role is LinkRole.ACCEPTOR:
            # A little later than the dialler's, so that its pongs are all that an idle link needs of it.
            self._keepalive *= limits.KEEPALIVE_ANSWERED

    def _take_rest(self, view: memoryview) -> int:
        """Hand on what has come of a data frame that was begun; return how many bytes that were."""
        count = min(self._left, len(view))
        self._left -= count
        if self._state is LinkState.UP:
            route, sequence, stamp_ns, last = self._rest
            self.on_part(route, sequence, stamp_ns, 0 if self._left else last, view[:count])
        return count

    def _handle(
        self, kind: FrameKind, payload: memoryview, route: int, sequence: int, stamp_ns: int, now: float
    ) -> None:
        if _log.isEnabledFor(logging.DEBUG):
            _log.debug("< %s: %s, %d bytes", self._name, kind.name, len(payload))
        if kind is FrameKind.PING:
            came = self._wall_ns()
            self._send(frames.pong(stamp_ns, came, self._wall_ns()))
            self._sent = now
        elif kind is FrameKind.PONG:
            t1, t2 = frames.parse_pong(payload)
            sample = self.clock.ponged(t1, t2, stamp_ns, self._wall_ns(), now)
            if sample is not None:
                self.on_event(Ponged(t1, sample.rtt))
        elif kind is FrameKind.CONTROL:
            self.on_event(ControlReceived(bytes(payload)))
        elif kind in {FrameKind.ACK, FrameKind.FENCE, FrameKind.FENCED}:
            self.on_event(Marked(kind, route, sequence))
        elif kind is FrameKind.BYE:
            self._end(f"{self._name} left: {frames.parse_text(payload)}", orderly=True)
        elif kind is FrameKind.REFUSE:
            refuse = Refuse.parse(payload)
            self.on_event(Refused(refuse, by_us=False))
            self._end(f"{self._label} refused: {refuse}", orderly=True)
        else:
            self._handshake(payload, now)

    def _handshake(self, payload: memoryview, now: float) -> None:
        try:
            hello = Hello.parse(payload)
        except HandshakeError as error:
            self._refuse(error.refuse, now)
            return
        if self.role is LinkRole.ACCEPTOR:
            self.remote = hello
            self.on_event(HelloReceived(hello))
        elif refuse := judge_welcome(hello, self._ours, self._expected):
            self._refuse(refuse, now)
        else:
            self._raise_up(hello, now)

    def _unanswered(self) -> Hello:
        if self.role is not LinkRole.ACCEPTOR or self.remote is None or self._state is not LinkState.HANDSHAKING:
            raise LocalProtocolError(f"no hello waits for an answer (state {self._state.name})")
        return self.remote

    def _raise_up(self, hello: Hello, now: float) -> None:
        self._state = _NEXT[self._state, _Act.WELCOMED]
        self.remote = hello
        self._heard = self._welcomed = now
        _log.debug("= %s: up", self._name)
        self._ping(now)
        self.on_event(Up(hello))

    def _refuse(self, refuse: Refuse, now: float) -> None:
        self._send(
            Frame(FrameKind.REFUSE, refuse.serialize()) if self.role is LinkRole.ACCEPTOR else _bye(refuse.text)
        )
        self._leave(_Act.REFUSING, f"refused: {refuse}", now)
        self.on_event(Refused(refuse, by_us=True))

    def _leave(self, act: _Act, reason: str, now: float) -> None:
        self._state = _NEXT[self._state, act]
        self._reason = reason
        self._deadline = now + runtime_limits.DRAIN_TIMEOUT
        _log.debug("= %s: closing: %s", self._name, reason)

    def _end(self, reason: str, *, orderly: bool = False) -> None:
        if self._state is LinkState.CLOSED:
            return
        self._state = _NEXT[self._state, _Act.ENDED]
        self._reason = reason
        _log.debug("= %s: closed: %s", self._name, reason)
        self.on_event(LinkClosed(reason, orderly))

    def _ping(self, now: float) -> int:
        stamp = self._wall_ns()
        self.clock.pinged(stamp, now)
        self._send(Frame(FrameKind.PING, stamp_ns=stamp))
        self._sent = self._pinged = now
        return stamp

    def _send(self, frame: Frame) -> None:
        if _log.isEnabledFor(logging.DEBUG):
            _log.debug("> %s: %s", self._name, frame)
        self._output += frame.serialize()


def _no_parts(_route: int, _sequence: int, _stamp_ns: int, _flags: int, _part: memoryview) -> None:
    """Parts of messages on a link whose owner takes none."""


def _bye(text: str) -> Frame:
    return Frame(FrameKind.BYE, frames.text_payload(text))
