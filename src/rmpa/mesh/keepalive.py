"""Keepalive and the peer's clock of a connection, and the events that connections and peering report.

When one connection sends its next keepalive, and when the silence of the remote side ends it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final, Literal

from rmpa.mesh import limits
from rmpa.mesh.frames import PaceFlag, Refusal, Refuse
from rmpa.trust.permissions import TrustReason

if TYPE_CHECKING:
    from rmpa.core.identity import Guid, Identity
    from rmpa.mesh.frames import FrameKind, Hello


class RestPace:
    """How often an agent pings on its links at rest, and what it promises there: the more peers, the more rarely.

    So an agent that keeps its links to all peers of a mesh of 200, as a relay does, has no more keepalives a second
    than one with 50 peers.
    """

    __slots__ = ("interval",)

    def __init__(self) -> None:
        self.interval = limits.IDLE_KEEPALIVE_INTERVAL
        """Seconds between two pings of one link."""

    def count(self, peers: int) -> None:
        """Take the number of peers that are present."""
        interval = max(limits.IDLE_KEEPALIVE_INTERVAL, peers / limits.IDLE_KEEPALIVES_PER_SECOND)
        self.interval = min(interval, limits.IDLE_KEEPALIVE_INTERVAL_MAX)

    @property
    def lease(self) -> float:
        """Seconds of silence that it promises: two pings may be late, and the third a second."""
        return max(limits.IDLE_LEASE, 3 * self.interval + 1)


class Keepalive:
    """Keepalive and lease of one connection; pure, all times in monotonic seconds.

    Each side promises a *lease* in its handshake: a side that is silent for its lease counts as dead. A side pings
    four times in its lease, and less often if the pongs that it sends are sufficient signs of life.

    A link on which nothing depends may *rest*: both sides then promise a longer lease, and ping less often. Each side
    says in a pace frame whether it needs the short lease, and which one it promises from then on; a link rests when
    neither side needs it. TCP keeps the order, so a side has always promised what it does.

    Args:
        lease: Seconds that this side promises.
        now: When the connection was established.
        phase: When the keepalives of all resting links of this agent fall: at this time plus multiples of
            ``limits.IDLE_KEEPALIVE_INTERVAL`` (of ``limits.IDLE_KEEPALIVE_GRID`` where they come more rarely), so
            that the agent wakes once for all of them.
        acceptor: Whether the remote side dialled. The acceptor pings a little later than the dialler, so that on an
            idle connection it sends only pongs.
        rest: The pace of all resting links of this agent.
    """

    __slots__ = (
        "_acceptor",
        "_before",
        "_burst",
        "_excused",
        "_excused_at",
        "_interval",
        "_phase",
        "_pinged",
        "_remote_lease",
        "_rest",
        "_short",
        "_up_at",
        "_within",
        "_woken",
        "heard",
        "lease",
        "needed",
        "remote_needs",
        "sent",
    )

    def __init__(
        self, lease: float, now: float, *, acceptor: bool, phase: float = 0.0, rest: RestPace | None = None
    ) -> None:
        self._acceptor = acceptor
        self._rest = rest if rest is not None else RestPace()
        self._phase = phase
        self.promise(lease)
        self.needed = self.remote_needs = True
        """Whether this side, and the remote one, needs the short lease."""
        self.heard = now
        """When bytes were last received."""
        self.sent = now
        """When this side last sent a ping or a pong."""
        self._pinged = self._up_at = now
        self._remote_lease = limits.EXPRESS_LEASE
        self._excused = self._excused_at = 0.0
        self._burst = 0
        """Pings that still follow each other closely."""
        self._woken: float | None = None
        """When this side began to need a link at rest, while the remote side's promise has not come."""
        self._within = self._before = 0.0
        """Seconds that it has from then on, and those that were excused before."""

    def promise(self, lease: float) -> None:
        """Promise another lease, in seconds, as the one of a link in use; only before the end of the handshake."""
        self._short = lease
        self._hold(lease, lease * limits.KEEPALIVE_INTERVAL / limits.EXPRESS_LEASE)

    def begin(self, remote_lease: float, now: float) -> None:
        """Start after the handshake, in which the remote side promised ``remote_lease`` seconds."""
        self._remote_lease = remote_lease
        self.heard = self._up_at = now

    def agree(self) -> bool:
        """Promise the lease that fits what both sides need; return whether it is another one than before."""
        before = self.lease
        if self.needed or self.remote_needs:
            self._hold(self._short, self._short * limits.KEEPALIVE_INTERVAL / limits.EXPRESS_LEASE)
        else:
            self._hold(self._rest.lease, self._rest.interval)
        if self.lease < before:
            self._burst = limits.WAKE_PINGS  # the estimate of the remote clock is as old as the rest
        return self.lease != before

    def renew(self) -> bool:
        """At rest: promise the lease that fits the number of peers now, if it differs by a tenth; return whether."""
        if not self.rests or abs(self._rest.lease - self.lease) < self.lease / 10:
            return False
        self._hold(self._rest.lease, self._rest.interval)
        return True

    def wake(self, now: float, within: float) -> None:
        """Begin to need a link at rest: the remote side has to send its pace frame within ``within`` seconds."""
        self._woken, self._within, self._before = now, within, self.excused

    def remote_pace(self, lease: float, now: float, flags: int) -> None:
        """The remote side promises ``lease`` seconds from now on; ``flags`` are bits of ``PaceFlag``."""
        self._remote_lease = lease
        self.remote_needs = bool(flags & PaceFlag.NEEDED)
        self.heard = now
        self._woken = None

    @property
    def flags(self) -> PaceFlag:
        """What this side says in a pace frame."""
        return PaceFlag.NEEDED if self.needed else PaceFlag(0)

    @property
    def rests(self) -> bool:
        """Whether this side pings seldom, because nothing depends on the link."""
        return self.lease != self._short

    @property
    def remote_lease(self) -> float:
        """Seconds of silence that the remote side promised last."""
        return self._remote_lease

    @property
    def quiet_after(self) -> float:
        """Seconds without bytes, at the present pace, after which the remote side may be gone.

        Then its link does not prevent a link to a new run at its address.
        """
        if self._woken is not None:
            return limits.GHOST_QUIET
        return max(limits.GHOST_QUIET, self._remote_lease * limits.GHOST_QUIET / limits.EXPRESS_LEASE)

    def pinged(self, now: float) -> None:
        """Record that a ping was sent."""
        self.sent = self._pinged = now
        self._burst = max(0, self._burst - 1)

    @property
    def due(self) -> float:
        """When to check next: at the next ping, or at the end of the lease.

        While the connection is up and neither side changes the pace, this time may only move to a later one, because
        the driver does not arm its timer again after each receive. The same timer checks whether the peer is gone, so
        its interval stays below ``quiet_after``.
        """
        if self._burst:
            next_ping = self._pinged + limits.WAKE_PING_INTERVAL
        elif self.rests:
            next_ping = self._common_time(self.sent + self._interval)
        else:
            next_ping = min(self.sent + self._interval, self._pinged + limits.CLOCK_INTERVAL)
        return min(self.lease_end, next_ping)

    def _common_time(self, due: float) -> float:
        """The agent's common time next to ``due``: the last one before it, for the acceptor the first one after it.

        The acceptor's may be late, because it seldom pings: the pongs that it sends are signs of life too.
        """
        rare = self._rest.interval > limits.IDLE_KEEPALIVE_INTERVAL
        grid = limits.IDLE_KEEPALIVE_GRID if rare else limits.IDLE_KEEPALIVE_INTERVAL
        turns = (due - self._phase) / grid
        return self._phase + grid * (math.ceil(turns) if self._acceptor else math.floor(turns + 1e-9))

    @property
    def lease_end(self) -> float:
        """When the silence of the remote side ends the connection."""
        end = self.heard + max(self._remote_lease, self.awaited_lease) + self.excused
        if self._woken is not None:
            asked = max(self._woken, self.heard) + max(0.0, self.excused - self._before)
            end = min(end, asked + self._within)
        return end

    @property
    def awaited_lease(self) -> float:
        """Seconds that the remote side may be silent now, without the pauses of this process.

        After the acceptor's welcome a whole round trip passes before the dialler's first byte arrives, and this time
        still belongs to the handshake. With the lease alone, a path with a longer round trip could not carry a link.
        """
        if self._woken is not None:
            return min(self._within, self._remote_lease)
        if self._acceptor and self.heard <= self._up_at:
            return max(self._remote_lease, limits.HANDSHAKE_TIMEOUT)
        return self._remote_lease

    @property
    def excused(self) -> float:
        """Seconds of the present silence during which this process did not run."""
        return self._excused if self._excused_at == self.heard else 0.0

    def excuse(self, late: float, now: float) -> None:
        """Prolong the lease by ``late`` seconds, by which a timer fired too late.

        This process was stopped, or had no CPU, for that long, so the silence is not the remote side's.
        """
        self._excused, self._excused_at = self.excused + min(late, now - self.heard), self.heard

    def _hold(self, lease: float, interval: float) -> None:
        self.lease = lease
        self._interval = interval * (limits.ACCEPTOR_KEEPALIVE_FACTOR if self._acceptor else 1.0)


# The round-trip time of a connection and the remote clock, from four time stamps (RFC 5905, section 8).


@dataclass(frozen=True, slots=True)
class ClockSample:
    """One exchange of ping and pong.

    Args:
        rtt: Seconds on the wire: the round trip without the time that the remote side took to answer.
        offset: Seconds that the remote wall clock is ahead of the local one, ±rtt/2.
        taken: When, in monotonic seconds.
    """

    rtt: float
    offset: float
    taken: float


class RemoteClock:
    """The remote clock, by the exchange with the least error among the last ``limits.CLOCK_SAMPLES``.

    Queues only make round trips longer, so the shortest has the least error; the error grows with age, because the
    two clocks drift apart (PHI of RFC 5905).
    """

    def __init__(self) -> None:
        self._pings: dict[int, float] = {}
        self._samples: deque[ClockSample] = deque(maxlen=limits.CLOCK_SAMPLES)
        self.rtt: float | None = None
        """The last round trip, in seconds; ``None`` before the first."""

    def pinged(self, t1: int, now: float) -> None:
        """A ping with stamp ``t1`` (ns) is sent."""
        self._pings[t1] = now
        while len(self._pings) > limits.CLOCK_SAMPLES:
            del self._pings[next(iter(self._pings))]

    def ponged(self, t1: int, t2: int, t3: int, t4: int, now: float) -> ClockSample | None:
        """A pong came at wall time ``t4``; all stamps in ns. Returns ``None`` if it answers no known ping.

        ``t1`` and ``t4`` are of the local clock, ``t2`` (ping received) and ``t3`` (pong sent) of the remote one.
        """
        sent = self._pings.pop(t1, None)
        if sent is None:
            return None
        rtt = ((t4 - t1) - (t3 - t2)) / 1e9
        if abs((t4 - t1) / 1e9 - (now - sent)) > limits.CLOCK_STEP or rtt < 0:
            # A wall clock was set in between: earlier samples are void.
            self._samples.clear()
            return None
        sample = ClockSample(rtt, ((t2 - t1) + (t3 - t4)) / 2e9, now)
        if self._samples and self._contradicts(sample):
            self._samples.clear()
        self._samples.append(sample)
        self.rtt = sample.rtt
        return sample

    def estimate(self, now: float) -> tuple[float, float] | None:
        """Offset and its error bound, in seconds: the true offset lies within ±error; ``None`` if unknown."""
        best = min(self._samples, key=lambda s: self._error(s, now), default=None)
        return None if best is None else (best.offset, self._error(best, now))

    def _contradicts(self, sample: ClockSample) -> bool:
        """Whether a sample and the present estimate cannot both be true: a clock was set."""
        offset, error = self.estimate(sample.taken) or (sample.offset, 0.0)
        return abs(sample.offset - offset) > error + sample.rtt / 2 + 1e-6

    @staticmethod
    def _error(sample: ClockSample, now: float) -> float:
        return sample.rtt / 2 + limits.CLOCK_DRIFT * max(0.0, now - sample.taken)


# The events that the protocol machine of a connection reports; see ``mesh.connection``.


@dataclass(frozen=True, slots=True)
class HelloReceived:
    """Acceptor: a hello was received; the driver answers it with ``accept`` or ``refuse``."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class HandshakeDone:
    """Both sides accepted the connection; frames may be sent."""

    hello: Hello


@dataclass(frozen=True, slots=True)
class ControlReceived:
    """A control frame was received.

    Args:
        payload: A copy of its bytes.
    """

    payload: bytes


@dataclass(frozen=True, slots=True)
class PongReceived:
    """The answer to a ping was received.

    Args:
        stamp: The time stamp of the ping, which identifies it.
        rtt: Round trip on the wire in seconds, without the time that the remote side took to answer.
    """

    stamp: int
    rtt: float


@dataclass(frozen=True, slots=True)
class Refused:
    """One of the two sides refused the connection. ``ConnectionClosed`` follows.

    Args:
        refuse: Why.
        by_us: Whether this side refused.
    """

    refuse: Refuse
    by_us: bool


@dataclass(frozen=True, slots=True)
class ConnectionClosed:
    """The connection is over: the driver sends the remaining output and closes the socket.

    Args:
        reason: Why, for people.
    """

    reason: str


@dataclass(frozen=True, slots=True)
class MarkReceived:
    """An acknowledgement, a fence, the answer to a fence, or the wish for the bulk lane was received.

    Args:
        kind: ``ACK``, ``FENCE``, ``FENCED`` or ``LANE``.
        route: The id of the route.
        sequence: For ``ACK`` the last message that arrived; otherwise the fence's number.
    """

    kind: FrameKind
    route: int
    sequence: int


ConnectionEvent = (
    HelloReceived | HandshakeDone | ControlReceived | PongReceived | MarkReceived | Refused | ConnectionClosed
)


# The orders and events of the peering machine, and the status of a peer; see ``mesh.peering``.


SocketAddress = tuple[str, int]

SELDOM_MENDED: Final = frozenset(
    {
        Refusal.VERSION,
        Refusal.DOMAIN,
        Refusal.DUPLICATE,
        Refusal.MALFORMED,
        Refusal.LANE,
        Refusal.FULL,
        TrustReason.PLAIN,
        TrustReason.FOREIGN,
        TrustReason.EXPIRED,
        TrustReason.REVOKED,
        TrustReason.NAME,
        TrustReason.DOWNGRADE,
    }
)
"""Refusals for reasons that seldom pass by themselves."""
UNPROVEN: Final = frozenset({TrustReason.UNSECURED, TrustReason.CLOCK})
"""Refusals without proof of the sender, or that pass once a clock is set: they are shown, and change no pause."""
OTHER_PEER: Final = frozenset({Refusal.MYSELF, Refusal.WRONG_PEER})
"""Refusals that concern one endpoint only, because another agent, or this agent itself, answered there."""


@dataclass(frozen=True, slots=True)
class Dial:
    """Connect to this peer, at the endpoint that answers first.

    Args:
        guid: The peer.
        endpoints: Its endpoints, best first; a peer with several addresses may be reachable at some of them only.
        briefly: Whether to give up after one short attempt at each, because the next ``Dial`` follows soon.
    """

    guid: Guid
    endpoints: tuple[SocketAddress, ...]
    briefly: bool = False


@dataclass(frozen=True, slots=True)
class CloseLink:
    """Send a bye on this link and close it."""

    link_id: int
    reason: str


@dataclass(frozen=True, slots=True)
class LinkUp:
    """This link is the one that is used with its peer."""

    link_id: int
    identity: Identity


class LinkDownCause(Enum):
    """Why a link is no longer used; the value is the text for users."""

    REPLACED = "replaced by a newer link"
    """The same run of the peer has another link from the same moment on."""
    RESTARTED = "the peer restarted"
    """Another run of the peer has taken its place."""
    ENDED = "the connection ended"
    """The connection of its express lane ended; ``LinkDown.reason`` says how."""


@dataclass(frozen=True, slots=True)
class LinkDown:
    """The link that was used with this peer is no longer used.

    Args:
        link_id: Its number.
        identity: The peer.
        cause: The kind of its end.
        reason: Why, for people.
    """

    link_id: int
    identity: Identity
    cause: LinkDownCause
    reason: str


@dataclass(frozen=True, slots=True)
class LinkRefused:
    """A peer refuses links for a reason that was not reported before; ``refuse`` says what to do."""

    identity: Identity
    refuse: Refuse


PeeringOutput = Dial | CloseLink | LinkUp | LinkDown | LinkRefused


@dataclass(frozen=True, slots=True)
class PeerStatus:
    """The state of one peer, for the snapshot.

    Args:
        identity: The peer.
        state: ``refused``: waiting after a refusal for a reason that seldom passes by itself.
        link_id: Its link, if linked.
        lower: Whether this agent has the lower GUID of the two, and dials first.
        since: When the link came up, or the last link fell, monotonic seconds; ``None`` before the first link.
        attempts: Dials since the last link.
        last_error: Why there is no link, as far as is known; for a linked peer, why its previous link ended.
        next_attempt: When it is dialled next, monotonic seconds.
        endpoint: The endpoint that is dialled, or was dialled last.
        foreign: Why it is not of this mesh, if its last refusal says so.
    """

    identity: Identity
    state: Literal["linked", "dialling", "waiting", "refused"]
    link_id: int | None
    lower: bool
    since: float | None
    attempts: int
    last_error: str
    next_attempt: float | None
    endpoint: SocketAddress | None
    foreign: TrustReason | None = None
