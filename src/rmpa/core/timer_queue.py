"""Many timers of one machine, of which the next one is known at once."""

from __future__ import annotations

from heapq import heapify, heappop, heappush
from typing import Final, Generic, Protocol, Self, TypeVar

_SPARE: Final = 64
"""Entries that were moved or taken out and may stay in the heap beside twice the live ones."""


class _Key(Protocol):
    """Can be looked up, and put in order: of those that are due at one moment the lower one comes first."""

    def __hash__(self) -> int: ...

    def __lt__(self, other: Self, /) -> bool: ...


_K = TypeVar("_K", bound=_Key)


class TimerQueue(Generic[_K]):
    """When each of many keys is due; a machine with hundreds of peers must not look at all of them for one event.

    Setting one and taking out one that is due cost O(log n) on average, looking at the first one nothing. Times are
    seconds on the machine's clock.
    """

    def __init__(self) -> None:
        self._at: dict[_K, float] = {}
        # What was set anew or cancelled stays in it until it comes to the top, or there is too much of that.
        self._heap: list[tuple[float, _K]] = []

    def __len__(self) -> int:
        return len(self._at)

    def set(self, key: _K, at: float | None) -> None:
        """Let ``key`` be due at ``at``, and no longer when it was before; ``None``: never."""
        if at is None:
            self._at.pop(key, None)
        elif self._at.get(key) != at:
            self._at[key] = at
            heappush(self._heap, (at, key))
        if len(self._heap) > 2 * len(self._at) + _SPARE:
            self._heap = [(at, key) for key, at in self._at.items()]
            heapify(self._heap)

    def next(self) -> float | None:
        """When the first of all is due."""
        heap = self._heap
        while heap and self._at.get(heap[0][1]) != heap[0][0]:
            heappop(heap)
        return heap[0][0] if heap else None

    def pop(self, now: float) -> _K | None:
        """The first of those that are due at ``now``, taken out; ``None`` if none is."""
        at = self.next()
        if at is None or at > now:
            return None
        _, key = heappop(self._heap)
        del self._at[key]
        return key

    def take(self, now: float) -> list[_K]:
        """Those that are due at ``now``, earliest first; taken out."""
        due = []
        while (key := self.pop(now)) is not None:
            due.append(key)
        return due
