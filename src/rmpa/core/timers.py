"""Time in protocol machines: many timers in a heap, periods, back-off, rates, and yielding to pending data.

Machines get ``now`` and never read a clock: seconds (float) of a monotonic clock with an arbitrary zero. Stamps on
the wire are nanoseconds (int) of the sender's wall clock.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from heapq import heapify, heappop, heappush
from typing import TYPE_CHECKING, Final, Generic, Protocol, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterable

_K = TypeVar("_K")
_T = TypeVar("_T")

# The heap, which also holds moved and cancelled entries, is rebuilt above this plus twice the live entries.
_SPARE: Final = 64
_ROUNDING: Final = 1e-9


class TimerQueue(Generic[_K]):
    """When each of many keys is due: a machine with hundreds of peers must not scan all of them for one event.

    ``set`` and ``pop`` cost O(log n) on average, ``next`` O(1). Times are seconds on the machine's clock. Keys are
    ordered: of those that are due at the same time the lower one comes first.
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


class Backoff:
    """Exponential back-off: delays that double from ``first`` to ``cap`` seconds.

    Each is spread over 50 % to 100 % of its value: retries go on for ever, and not in step with those of others.

    Args:
        first: The first delay.
        cap: The longest delay before the spread.
        rng: Uniform numbers in [0, 1); seeded by simulations.
    """

    __slots__ = ("_first", "_next", "_rng", "cap")

    def __init__(self, first: float, cap: float, rng: Callable[[], float]) -> None:
        self._first = first
        self.cap = cap
        self._rng = rng
        self._next = first

    def delay(self) -> float:
        """The next delay in seconds."""
        base = min(self._next, self.cap)
        self._next = min(self.cap, base * 2)
        return base * (0.5 + 0.5 * self._rng())

    def reset(self) -> None:
        """Start again at ``first``, after a successful attempt."""
        self._next = self._first


def earliest(*timers: float | None) -> float | None:
    """The first of several timers; ``None`` means never."""
    return min((timer for timer in timers if timer is not None), default=None)


class TokenBucket:
    """Allows an action ``rate`` times a second, and ``burst`` times at once after a rest.

    An action may be of several tokens. One of more than ``burst`` is allowed when the bucket is full, and is paid off
    afterwards.

    Args:
        rate: Tokens a second.
        burst: The capacity in tokens, at least 1.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = burst
        self._level = burst
        self._at = float("-inf")

    def has(self, now: float, amount: float = 1) -> bool:
        """Whether there are enough tokens at ``now`` (monotonic seconds) for an action of ``amount``."""
        self._fill(now)
        return self._level >= min(amount, self._burst) * (1 - _ROUNDING)

    def spend(self, amount: float = 1) -> None:
        """Take tokens that ``has`` has told of."""
        self._level -= amount

    def take(self, now: float) -> bool:
        """Take a token at ``now`` (monotonic seconds); return whether there was one."""
        if not self.has(now):
            return False
        self.spend()
        return True

    def put_back(self) -> None:
        """Return a token that was taken but not used."""
        self._level = min(self._burst, self._level + 1)

    def next(self, now: float, amount: float = 1) -> float:
        """When there are enough tokens for an action of ``amount``, not before ``now``."""
        self._fill(now)
        return now + max(0.0, min(amount, self._burst) - self._level) / self._rate

    def _fill(self, now: float) -> None:
        if now > self._at:
            self._level = min(self._burst, self._level + (now - self._at) * self._rate)
            self._at = now


class AddressLimit:
    """Allows each address so many packets in a while, and forgets the address that was silent for longest.

    Args:
        count: Packets of one address.
        addresses: How many are remembered.
        interval: The while, in seconds.
    """

    def __init__(self, count: int, addresses: int, interval: float = 1.0) -> None:
        self._most = count
        self._addresses = addresses
        self._interval = interval
        self._counts: OrderedDict[Hashable, tuple[float, int]] = OrderedDict()

    def take(self, address: Hashable, now: float) -> bool:
        """Count a packet; return whether it is allowed."""
        since, count = self._counts.get(address, (now, 0))
        if now - since >= self._interval:
            since, count = now, 0
        self._counts[address] = (since, count + 1)
        self._counts.move_to_end(address)
        if len(self._counts) > self._addresses:
            self._counts.popitem(last=False)
        return count < self._most


class Yielder(Protocol):
    """Iterates over items; between two of them data may be handled (``runtime.loop.yielding_to_data``).

    ``iter`` is a yielder that handles nothing. The items must not change meanwhile: pass a copy, or a collection that
    nothing else changes. The caller's own data must be consistent during the iteration.
    """

    def __call__(self, items: Iterable[_T], /) -> Iterable[_T]:
        """The same items."""
        ...


def positive(value: float, what: str) -> float:
    """The value, if it is above 0 and finite; else ValueError."""
    if not 0 < value < math.inf:
        raise ValueError(f"{what} is above 0 and finite, not {value:g}")
    return value


class Schedule:
    """The due times of a periodic task: start, start + period, start + 2 periods and so on.

    The times are absolute, so that lateness does not add up. A due time that is a whole period past is skipped.

    Args:
        period: The period in seconds, above 0.
        start: The first due time, in monotonic seconds.
    """

    def __init__(self, period: float, start: float) -> None:
        self.period = period
        self._start = start
        self._tick = -1

    def next_due(self, now: float) -> tuple[float, int]:
        """Advance to the next due time; returns it in monotonic seconds like ``now``, and how many were skipped."""
        self._tick += 1
        late = max(0, math.floor((now - self._start) / self.period + _ROUNDING) - self._tick)
        self._tick += late
        return self._start + self._tick * self.period, late
