"""When an announcement is answered, by the number of members.

With 256 members that start together, an answer of each to each announcement would be 65,000 packets. Up to
``limits.MANY_MEMBERS`` nothing here changes what the paper's protocol sends.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Callable


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


def dissemination_interval(members: int) -> float:
    """The shortest time between two early heartbeats about newly found peers, in seconds."""
    return max(limits.DISSEMINATION_INTERVAL, members / limits.DISSEMINATIONS_PER_SECOND * is_many(members))
