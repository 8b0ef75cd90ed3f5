"""When one connection sends its next keepalive, and when the silence of the remote side ends it."""

from __future__ import annotations

from rmpa.mesh import limits


class Keepalive:
    """Keepalive and lease of one connection; pure, all times in monotonic seconds.

    Each side promises a *lease* in its handshake: a side from which nothing came for its lease is dead. It pings four
    times in that time, and less often where the pongs that it sends are signs of life enough.

    Args:
        lease: Seconds that this side promises.
        now: When the connection was established.
        acceptor: Whether the remote side dialled. The acceptor pings a little later than the dialler, so that on an
            idle connection its pongs are all that it sends.
    """

    __slots__ = (
        "_acceptor",
        "_excused",
        "_excused_at",
        "_interval",
        "_pinged",
        "_remote_lease",
        "_up_at",
        "heard",
        "lease",
        "sent",
    )

    def __init__(self, lease: float, now: float, *, acceptor: bool) -> None:
        self._acceptor = acceptor
        self.promise(lease)
        self.heard = now
        """When bytes last came."""
        self.sent = now
        """When this side last sent a ping or a pong."""
        self._pinged = self._up_at = now
        self._remote_lease = limits.EXPRESS_LEASE
        self._excused = self._excused_at = 0.0

    def promise(self, lease: float) -> None:
        """Promise another lease, in seconds; before the handshake ends."""
        self.lease = lease
        self._interval = lease * limits.KEEPALIVE_INTERVAL / limits.EXPRESS_LEASE
        if self._acceptor:
            self._interval *= limits.ACCEPTOR_KEEPALIVE_FACTOR

    def begin(self, remote_lease: float, now: float) -> None:
        """The handshake is done; the remote side promised ``remote_lease`` seconds."""
        self._remote_lease = remote_lease
        self.heard = self._up_at = now

    def pinged(self, now: float) -> None:
        """A ping was sent."""
        self.sent = self._pinged = now

    @property
    def due(self) -> float:
        """When to look next: the next ping, or the end of the lease.

        While the connection is up it may only move to a later time: the driver does not arm its timer anew after
        each receive. The same timer looks at the path MTU and for a peer that is gone, so it stays below
        ``limits.GHOST_QUIET``.
        """
        return min(self.lease_end, self.sent + self._interval, self._pinged + limits.CLOCK_INTERVAL)

    @property
    def lease_end(self) -> float:
        """When the silence of the remote side ends the connection."""
        return self.heard + self.awaited_lease + self.excused

    @property
    def awaited_lease(self) -> float:
        """Seconds that the remote side may be silent now, pauses of this process not counted.

        Behind the acceptor's welcome a whole round trip goes by before the dialler's first byte, which is still a
        part of the handshake's time. With the lease alone a path whose round trip is longer would never carry a link.
        """
        if self._acceptor and self.heard <= self._up_at:
            return max(self._remote_lease, limits.HANDSHAKE_TIMEOUT)
        return self._remote_lease

    @property
    def excused(self) -> float:
        """Seconds of the present silence in which this process did not run."""
        return self._excused if self._excused_at == self.heard else 0.0

    def excuse(self, late: float, now: float) -> None:
        """Prolong the lease: a timer came ``late`` seconds too late.

        Then this process was stopped, or without a processor, for that long: the silence was not the remote side's.
        """
        self._excused, self._excused_at = self.excused + min(late, now - self.heard), self.heard
