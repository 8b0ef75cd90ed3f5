"""When one connection sends its next keepalive, and when the silence of the remote side ends it."""

from __future__ import annotations

import math

from rmpa.mesh import limits
from rmpa.mesh.frames import PaceFlag


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
