"""How often beacons are sent, and when an announcement is answered: both by the number of members.

With a thousand members, a heartbeat of each every five seconds would be 200 packets a second at every agent, and a
thousand answers to each of a thousand announcements would be a million. Up to ``limits.MANY_MEMBERS`` nothing here
changes what the paper's protocol sends.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core import limits as core_limits
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Callable


class BeaconPace:
    """The interval of this agent's heartbeats and the lease that they promise.

    Args:
        lease: Seconds of silence after which peers may count this agent as gone, at the usual interval.
    """

    def __init__(self, lease: float = core_limits.PEER_LEASE) -> None:
        self._lease = lease
        self.demand = False
        """Whether links stand only on demand: then the interval grows with the number of members."""
        self.interval = limits.HEARTBEAT_INTERVAL
        """Seconds until the next heartbeat, without jitter."""

    @property
    def lease(self) -> float:
        """Seconds that this agent promises with its next beacon."""
        if self.interval <= limits.HEARTBEAT_INTERVAL:
            return self._lease
        return max(self._lease, min(limits.LEASE_MAX, 3 * self.interval + 1.0))

    def advance(self, members: int) -> None:
        """Set the interval that follows the heartbeat which is about to be sent.

        It becomes longer in small steps: peers that miss this beacon still count by the lease of the one before.

        Args:
            members: Peers that are there, without this agent.
        """
        wanted = limits.HEARTBEAT_INTERVAL
        if self.demand:
            wanted = max(wanted, (members + 1) / limits.HEARTBEATS_PER_SECOND)
        wanted = min(wanted, limits.HEARTBEAT_INTERVAL_MAX)
        self.interval = min(wanted, self.interval * limits.HEARTBEAT_GROWTH)

    def dissemination_interval(self, members: int) -> float:
        """The shortest time between two early heartbeats about newly found peers, in seconds."""
        return max(limits.DISSEMINATION_INTERVAL, members / limits.DISSEMINATIONS_PER_SECOND * is_many(members))


class LateAnswers:
    """Answers of a member of a large mesh to multicasts, which it delays: together they would be a storm.

    The answers to one newcomer spread over a time that grows with the number of members; those to many newcomers
    become one multicast.

    Args:
        rng: Uniform numbers in [0, 1).
    """

    def __init__(self, rng: Callable[[], float]) -> None:
        self._rng = rng
        self._places: dict[int, None] = {}
        self.at: float | None = None
        """When ``take`` has something to return; ``None``: there is nothing."""

    def add(self, place: int, members: int, now: float) -> None:
        """Plan an answer to the peer at a place (``Guid.place``), among so many members."""
        self._places[place] = None
        if self.at is None:
            self.at = now + self._rng() * members / limits.ANSWERS_PER_SECOND

    def discard(self, place: int) -> None:
        """The peer at a place has a link: it needs no answer."""
        self._places.pop(place, None)

    def take(self, now: float) -> list[int]:
        """The places whose peers get an answer now, oldest first."""
        if self.at is None or self.at > now:
            return []
        places = list(self._places)
        self.clear()
        return places

    def clear(self) -> None:
        """Forget all: a multicast is about to answer everyone."""
        self._places.clear()
        self.at = None


def is_many(members: int) -> bool:
    """Whether so many members need what protects large meshes from storms."""
    return members > limits.MANY_MEMBERS
