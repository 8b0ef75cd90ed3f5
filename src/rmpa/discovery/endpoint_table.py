"""All seats of a roster, and what is asked of all of them often: nothing here looks at each for one packet."""

from __future__ import annotations

from bisect import bisect_left, insort
from typing import TYPE_CHECKING

from rmpa.core.timer_queue import TimerQueue

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.discovery.endpoint import Endpoint, PeerInstance


class EndpointTable:
    """The seats by place, with their timers. Whoever changes a seat says so: ``heard`` or ``changed``."""

    def __init__(self) -> None:
        self._all: dict[int, Endpoint] = {}
        self._order: list[int] = []
        self._timers: TimerQueue[int] = TimerQueue()
        self._present: list[PeerInstance] | None = None
        self._by_name: dict[str, list[Endpoint]] | None = None

    def __len__(self) -> int:
        return len(self._all)

    def __contains__(self, place: int) -> bool:
        return place in self._all

    def __iter__(self) -> Iterator[Endpoint]:
        """In the order of their places, which is that of GUIDs."""
        return iter([self._all[place] for place in self._order])

    def get(self, place: int) -> Endpoint | None:
        """The seat of a place."""
        return self._all.get(place)

    def add(self, place: int, seat: Endpoint) -> Endpoint:
        """Set up a seat at a place that has none."""
        self._all[place] = seat
        insort(self._order, place)
        self.changed(place)
        return seat

    def drop(self, place: int) -> None:
        """Take a seat away."""
        del self._all[place]
        del self._order[bisect_left(self._order, place)]
        self._timers.set(place, None)
        self._forget()

    def heard(self, place: int) -> None:
        """The one who has a seat spoke, and nothing else has changed."""
        seat = self._all.get(place)
        if seat is not None:
            self._timers.set(place, seat.next_timer())

    def changed(self, place: int) -> None:
        """Anything of a seat has changed: who has it, what it is called, whether it is present."""
        self.heard(place)
        self._forget()

    def _forget(self) -> None:
        self._present = self._by_name = None

    def next_timer(self) -> float | None:
        """When ``due`` has something."""
        return self._timers.next()

    def due(self, now: float) -> list[int]:
        """The places at which somebody's lease is over, in order; each is to be dealt with, and ``changed``."""
        return sorted(self._timers.take(now))

    def present(self) -> list[PeerInstance]:
        """Those that are in the roster, in the order of their GUIDs; not to be changed."""
        if self._present is None:
            self._present = [seat.current for seat in self if seat.present and seat.current is not None]
        return self._present

    def named(self, name: str) -> list[Endpoint]:
        """The seats of those who have this name, in order, conflicts and ourselves included."""
        if self._by_name is None:
            self._by_name = {}
            for seat in self:
                if seat.current is not None:
                    self._by_name.setdefault(seat.current.identity.name, []).append(seat)
        return list(self._by_name.get(name, ()))

    def oldest_unlinked(self) -> tuple[float, int] | None:
        """Of the seats without a linked peer the one that was heard the longest ago: when, and its place."""
        never = float("-inf")
        return min(
            (
                (seat.current.heard if seat.current is not None else never, place)
                for place, seat in self._all.items()
                if seat.current is None or not seat.current.linked
            ),
            default=None,
        )
