"""When one connection sends its next keepalive, and when the silence of the remote side ends it."""

from __future__ import annotations

from rmpa.mesh import limits


class Keepalive:
    """Keepalive and lease of one connection; pure, all times in monotonic seconds.

    Each side promises a *lease* in its handshake: a side that is silent for its lease counts as dead. A side pings
    four times in its lease, and less often if the pongs that it sends are sufficient signs of life.

    Args:
        lease: Seconds that this side promises.
        now: When the connection was established.
        acceptor: Whether the remote side dialled. The acceptor pings a little later than the dialler, so that on an
            idle connection it sends only pongs.
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
        """When bytes were last received."""
        self.sent = now
        """When this side last sent a ping or a pong."""
        self._pinged = self._up_at = now
        self._remote_lease = limits.EXPRESS_LEASE
        self._excused = self._excused_at = 0.0

    def promise(self, lease: float) -> None:
        """Promise another lease, in seconds; only before the end of the handshake."""
        self.lease = lease
        self._interval = lease * limits.KEEPALIVE_INTERVAL / limits.EXPRESS_LEASE
        if self._acceptor:
            self._interval *= limits.ACCEPTOR_KEEPALIVE_FACTOR

    def begin(self, remote_lease: float, now: float) -> None:
        """Start after the handshake, in which the remote side promised ``remote_lease`` seconds."""
        self._remote_lease = remote_lease
        self.heard = self._up_at = now

    def pinged(self, now: float) -> None:
        """Record that a ping was sent."""
        self.sent = self._pinged = now

    @property
    def due(self) -> float:
        """When to check next: at the next ping, or at the end of the lease.

        While the connection is up, this time may only move to a later one, because the driver does not arm its timer
        again after each receive. The same timer checks the path MTU and whether the peer is gone, so its interval
        stays below ``limits.GHOST_QUIET``.
        """
        return min(self.lease_end, self.sent + self._interval, self._pinged + limits.CLOCK_INTERVAL)

    @property
    def lease_end(self) -> float:
        """When the silence of the remote side ends the connection."""
        return self.heard + self.awaited_lease + self.excused

    @property
    def awaited_lease(self) -> float:
        """Seconds that the remote side may be silent now, without the pauses of this process.

        After the acceptor's welcome a whole round trip passes before the dialler's first byte arrives, and this time
        still belongs to the handshake. With the lease alone, a path with a longer round trip could not carry a link.
        """
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
