"""Recognises packets that are sent again, by their numbers (RFC 4303, section 3.4.3)."""

from __future__ import annotations

from collections import OrderedDict
from enum import Enum, auto
from typing import Final

from rmpa.trust import limits

_WINDOW: Final = limits.REPLAY_WINDOW
_MASK: Final = (1 << _WINDOW) - 1


class Freshness(Enum):
    """What a number says of its packet."""

    NEW = auto()
    """It was not seen before."""
    REPEATED = auto()
    """It was seen: the packet came by a second interface, or was sent again."""
    STALE = auto()
    """It is too far behind the highest one to say."""
    LEAP = auto()
    """It is further ahead of the highest one than the run can have come."""


class ReplayWindow:
    """The numbers that were seen of each run. Only numbers of packets with a valid tag may come here.

    Each group key has numbers of its own here: a revoked module, which has the key before, can claim any run and
    number with it, and must not touch what is remembered of the present key's packets.

    Args:
        runs: Runs that are remembered; the one that was silent for longest is forgotten first.
    """

    def __init__(self, runs: int = limits.RUNS_MAX) -> None:
        self._runs = runs
        self._seen: OrderedDict[tuple[int, bytes], tuple[int, int, float]] = OrderedDict()
        # The highest number, a bit for each of the last ones, the lowest for the highest number, and when it came.

    def __len__(self) -> int:
        return len(self._seen)

    def take(self, run: tuple[int, bytes], number: int, now: float) -> Freshness:
        """Judge a number of a run, and remember it unless it is a leap.

        Args:
            run: The number of the group key, and the instance id of the sender.
            number: From 1; 64 bits, never wraps.
            now: Monotonic seconds.
        """
        highest, bits, heard = self._seen.get(run, (0, 0, now))
        ahead = number - highest
        if ahead > 0:
            if highest and ahead > limits.REPLAY_LEAP + (now - heard) * limits.REPLAY_LEAP_RATE:
                return Freshness.LEAP
            bits = (bits << ahead & _MASK if ahead < _WINDOW else 0) | 1
            self._seen[run] = (number, bits, now)
            self._seen.move_to_end(run)
            if len(self._seen) > self._runs:
                self._seen.popitem(last=False)
            return Freshness.NEW
        if -ahead >= _WINDOW or number <= 0:
            return Freshness.STALE
        bit = 1 << -ahead
        if bits & bit:
            return Freshness.REPEATED
        self._seen[run] = (highest, bits | bit, heard)
        return Freshness.NEW
