"""Many timers of one protocol machine in a heap."""

from __future__ import annotations

from heapq import heapify, heappop, heappush
from typing import Final, Generic, Protocol, Self, TypeVar

_SPARE: Final = 64
"""The heap, which also holds moved and cancelled entries, is rebuilt above this plus twice the live entries."""


class _Key(Protocol):
    """Hashable and ordered: of keys that are due at the same time the lower one comes first."""

    def __hash__(self) -> int: ...

    def __lt__(self, other: Self, /) -> bool: ...


_K = TypeVar("_K", bound=_Key)


class TimerQueue(Generic[_K]):
    """When each of many keys is due: a machine with hundreds of peers must not scan all of them for one event.

    ``set`` and ``pop`` cost O(log n) on average, ``next`` O(1). Times are seconds on the machine's clock.
    """

    def __init__(self) -> None:
        self._at: dict[_K, float] = {}
        # Entries that were moved or cancelled stay in it until they reach the top, or until it is rebuilt.
        self._heap: list[tuple[float, _K]] = []

    def __len__(self) -> int:
        return len(self._at)

    def set(self, key: _K, at: float | None) -> None:
        """Set the due time of ``key`` to ``at``, in place of any former time; ``None``: never."""
        if at is None:
            self._at.pop(key, None)
        elif self._at.get(key) != at:
            self._at[key] = at
            heappush(self._heap, (at, key))
        if len(self._heap) > 2 * len(self._at) + _SPARE:
            self._heap = [(at, key) for key, at in self._at.items()]
            heapify(self._heap)

    def next(self) -> float | None:
        """When the first key is due; ``None``: no key is."""
        heap = self._heap
        while heap and self._at.get(heap[0][1]) != heap[0][0]:
            heappop(heap)
        return heap[0][0] if heap else None

    def pop(self, now: float) -> _K | None:
        """Remove and return the first key that is due at ``now``; ``None`` if none is."""
        at = self.next()
        if at is None or at > now:
            return None
        _, key = heappop(self._heap)
        del self._at[key]
        return key

    def take(self, now: float) -> list[_K]:
        """Remove and return all keys that are due at ``now``, earliest first."""
        due = []
        while (key := self.pop(now)) is not None:
            due.append(key)
        return due
