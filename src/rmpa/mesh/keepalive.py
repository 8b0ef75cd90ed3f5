"""When one connection sends its next keepalive, when the silence of the remote side ends it, and the remote clock."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from rmpa.mesh import limits

if TYPE_CHECKING:
    from rmpa.core.identity import Identity

# Pings that follow each other when a link's rest ends: the best of them gives the latency of the first messages an
# exact clock.
WAKE_PINGS: Final = 5
# The acceptor's keepalive interval, as a multiple of the dialler's: on an idle link only the dialler pings, and each
# ping and pong is a sign of life.
ACCEPTOR_KEEPALIVE_FACTOR: Final = 1.2

# Interval of the pings that follow each other when a link's rest ends.
_WAKE_PING_INTERVAL: Final = 0.02
# Exchanges of ping and pong kept for a peer's clock, 4 to 16 s of keepalives; older ones have a large error
# (CLOCK_DRIFT).
_CLOCK_SAMPLES: Final = 16
# Seconds by which the local wall clock must deviate from the monotonic one to count as set. A smaller step shows as a
# contradiction between two exchanges.
_CLOCK_STEP: Final = 0.05


def rest_lease(peers: int) -> float:
    """Seconds of silence that an agent with so many peers promises on its links at rest: the more, the longer.

    Two pings may be late, and the third a second. So an agent with links to all peers of a mesh of 200 has no more
    keepalives a second than one with 150 peers.
    """
    interval = min(peers / limits.IDLE_KEEPALIVES_PER_SECOND, limits.IDLE_KEEPALIVE_INTERVAL_MAX)
    return max(limits.IDLE_LEASE, 3 * interval + 1)


@dataclass(slots=True)
class Pace:
    """What the keepalives of all links of an agent have in common.

    Args:
        phase: When they fall on resting links: at this time plus multiples of ``limits.IDLE_KEEPALIVE_INTERVAL`` (of
            ``limits.IDLE_KEEPALIVE_GRID`` where they come more rarely), so that the agent wakes once for all of them.
        rest_lease: What the agent promises on links at rest; see the function ``rest_lease``.
    """

    phase: float
    rest_lease: float = limits.IDLE_LEASE

    @classmethod
    def of(cls, identity: Identity) -> Self:
        """That of an agent: agents have different phases."""
        return cls(int.from_bytes(identity.instance[:2], "big") / 65536 * limits.IDLE_KEEPALIVE_INTERVAL)


class Keepalive:
    """Keepalive and lease of one connection; pure, all times in monotonic seconds.

    Each side promises a *lease* in its handshake: a side that is silent for its lease counts as dead. A side pings
    four times in its lease, and less often if the pongs that it sends are sufficient signs of life.

    A link on which nothing depends may *rest*: both sides then promise a longer lease, and ping less often. Each side
    says in a pace frame whether it needs the short lease, and which one it promises from then on; a link rests when
    neither side needs it. TCP keeps the order, so a side has always promised what it does.

    It has more than 12 fields, because each side has its needs, its promise and its last sign of life.

    Args:
        lease: Seconds that this side promises while the link is in use.
        now: When the connection was established.
        pace: That of this agent's links.
        acceptor: Whether the remote side dialled. The acceptor pings a little later than the dialler, so that on an
            idle connection it sends only pongs.

    Attributes:
        usual: The promise of this side while the link is in use, and the one that holds now.
        remote_lease: Seconds of silence that the remote side promised last.
        needed: Whether this side, and the remote one, needs the short lease.
        heard: When bytes were last received, and when the handshake ended.
        sent: When this side last sent a ping or a pong, and a ping.
        excused: Seconds of the present silence during which this process did not run.
    """

    def __init__(self, lease: float, now: float, pace: Pace, *, acceptor: bool) -> None:
        self._acceptor = acceptor
        self.pace = pace
        self.usual = self.lease = lease
        self.remote_lease = limits.EXPRESS_LEASE
        self.needed = self.remote_needs = True
        self.heard = self.up_at = now
        self.sent = self._pinged = now
        self.excused = 0.0
        # Pings that still follow each other closely.
        self._burst = 0
        # When this side began to need a link at rest, while the remote side's promise has not come.
        self._woken: float | None = None
        # Seconds that the remote side has for it.
        self._within = 0.0

    def hear(self, now: float) -> None:
        """Renew the remote side's lease: bytes were received."""
        self.heard, self.excused = now, 0.0

    def settle(self) -> bool:
        """Promise the lease that fits the needs of both sides and the number of peers; return whether it is another.

        At rest a lease that differs by less than a tenth stays.
        """
        before = self.lease
        if self.needed or self.remote_needs:
            self.lease = self.usual
            if before > self.usual:
                self._burst = WAKE_PINGS  # the estimate of the remote clock is as old as the rest
        elif not self.rests or abs(self.pace.rest_lease - before) >= before / 10:
            self.lease = self.pace.rest_lease
        return self.lease != before

    def wake(self, now: float, within: float) -> None:
        """Begin to need a link at rest: the remote side has to send its pace frame within ``within`` seconds."""
        self._woken, self._within = now, within

    def remote_pace(self, lease: float, now: float, *, needed: bool) -> None:
        """The remote side promises ``lease`` seconds from now on, and says whether it needs the short one."""
        self.remote_lease, self.remote_needs = lease, needed
        self.hear(now)
        self._woken = None

    @property
    def rests(self) -> bool:
        """Whether this side pings seldom, because nothing depends on the link."""
        return self.lease != self.usual

    @property
    def quiet_after(self) -> float:
        """Seconds without bytes, at the present pace, after which the remote side may be gone.

        Then its link does not prevent a link to a new run at its address.
        """
        if self._woken is not None:
            return limits.GHOST_QUIET
        return max(limits.GHOST_QUIET, self.remote_lease * limits.GHOST_QUIET / limits.EXPRESS_LEASE)

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
        factor = ACCEPTOR_KEEPALIVE_FACTOR if self._acceptor else 1.0
        if self._burst:
            next_ping = self._pinged + _WAKE_PING_INTERVAL
        elif self.rests:
            next_ping = self._common_time(self.sent + factor * (self.lease - 1) / 3)
        else:
            interval = self.usual * limits.KEEPALIVE_INTERVAL / limits.EXPRESS_LEASE
            next_ping = min(self.sent + factor * interval, self._pinged + limits.CLOCK_INTERVAL)
        return min(self.lease_end, next_ping)

    def _common_time(self, due: float) -> float:
        """The agent's common time next to ``due``: the last one before it, for the acceptor the first one after it.

        The acceptor's may be late, because it seldom pings: the pongs that it sends are signs of life too.
        """
        rare = self.lease > limits.IDLE_LEASE
        grid = limits.IDLE_KEEPALIVE_GRID if rare else limits.IDLE_KEEPALIVE_INTERVAL
        turns = (due - self.pace.phase) / grid
        return self.pace.phase + grid * (math.ceil(turns) if self._acceptor else math.floor(turns + 1e-9))

    @property
    def lease_end(self) -> float:
        """When the silence of the remote side ends the connection."""
        heard = self.heard + self.excused
        if self._woken is None:
            return heard + self.awaited_lease
        return min(heard + self.remote_lease, max(self._woken, heard) + self._within)

    @property
    def awaited_lease(self) -> float:
        """Seconds that the remote side may be silent now, without the pauses of this process.

        After the acceptor's welcome a whole round trip passes before the dialler's first byte arrives, and this time
        still belongs to the handshake. With the lease alone, a path with a longer round trip could not carry a link.
        """
        if self._woken is not None:
            return min(self._within, self.remote_lease)
        if self._acceptor and self.heard <= self.up_at:
            return max(self.remote_lease, limits.HANDSHAKE_TIMEOUT)
        return self.remote_lease

    def excuse(self, late: float, now: float) -> None:
        """Prolong the lease by ``late`` seconds, by which a timer fired too late.

        This process was stopped, or had no CPU, for that long, so the silence is not the remote side's.
        """
        self.excused += min(late, now - self.heard)
        if self._woken is not None:
            self._woken += min(late, now - self._woken)


# The round-trip time of a connection and the remote clock, from four time stamps (RFC 5905, section 8).


class RemoteClock:
    """The remote clock, by the exchange with the least error among the last ``_CLOCK_SAMPLES``.

    Queues only make round trips longer, so the shortest has the least error; the error grows with age, because the
    two clocks drift apart (PHI of RFC 5905).

    Attributes:
        rtt: The last round trip, in seconds; ``None`` before the first.
    """

    def __init__(self) -> None:
        self._pings: dict[int, float] = {}
        # Of each exchange: its round trip on the wire, the offset of the remote wall clock, ± half of that, and when
        # it was: all in seconds.
        self._samples: deque[tuple[float, float, float]] = deque(maxlen=_CLOCK_SAMPLES)
        self.rtt: float | None = None

    def pinged(self, t1: int, now: float) -> None:
        """A ping with stamp ``t1`` (ns) is sent."""
        self._pings[t1] = now
        while len(self._pings) > _CLOCK_SAMPLES:
            del self._pings[next(iter(self._pings))]

    def ponged(self, t1: int, t2: int, t3: int, t4: int, now: float) -> float | None:
        """A pong came at wall time ``t4``; all stamps in ns. Returns the round trip; ``None`` if it tells nothing.

        ``t1`` and ``t4`` are of the local clock, ``t2`` (ping received) and ``t3`` (pong sent) of the remote one. A
        pong tells nothing if it answers no known ping, or if a clock was set in between.
        """
        sent = self._pings.pop(t1, None)
        if sent is None:
            return None
        rtt, offset = ((t4 - t1) - (t3 - t2)) / 1e9, ((t2 - t1) + (t3 - t4)) / 2e9
        if abs((t4 - t1) / 1e9 - (now - sent)) > _CLOCK_STEP or rtt < 0:
            self._samples.clear()
            return None
        estimate = self.estimate(now)
        if estimate is not None and abs(offset - estimate[0]) > estimate[1] + rtt / 2 + 1e-6:
            self._samples.clear()  # both cannot be true: a clock was set
        self._samples.append((rtt, offset, now))
        self.rtt = rtt
        return rtt

    def estimate(self, now: float) -> tuple[float, float] | None:
        """Offset and its error bound, in seconds: the true offset lies within ±error; ``None`` if unknown."""
        errors = ((rtt / 2 + limits.CLOCK_DRIFT * max(0.0, now - at), offset) for rtt, offset, at in self._samples)
        best = min(errors, key=lambda error: error[0], default=None)
        return None if best is None else (best[1], best[0])
