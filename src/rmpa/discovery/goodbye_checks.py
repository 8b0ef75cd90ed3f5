"""Asks the peers that said goodbye whether they did: a beacon of an open mesh can be forged. Sans-I/O."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core.timer_queue import TimerQueue
from rmpa.core.token_bucket import TokenBucket
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.discovery.beacon import Address


class GoodbyeChecks:
    """The addresses that get one announcement, shortly after a goodbye came in their name.

    A peer that has left does not answer. One that is there answers at once, which refutes the goodbye.

    Args:
        rng: Uniform numbers in [0, 1).
    """

    def __init__(self, rng: Callable[[], float]) -> None:
        self._rng = rng
        self._due: TimerQueue[Address] = TimerQueue()
        self._allowed = TokenBucket(limits.GOODBYE_CHECKS_PER_SECOND, limits.GOODBYE_CHECKS_BURST)

    def add(self, addresses: tuple[Address, ...], members: int, now: float) -> None:
        """A peer at these addresses was lost by a goodbye; ``members`` are left, of which some ask it."""
        chosen = members <= limits.GOODBYE_CHECKS or self._rng() * members < limits.GOODBYE_CHECKS
        if chosen and len(self._due) < limits.GOODBYE_CHECKS_BURST and self._allowed.take(now):
            for address in addresses:
                self._due.set(address, now + limits.GOODBYE_CHECK)

    def take(self, now: float) -> list[Address]:
        """The addresses that get an announcement now."""
        return self._due.take(now)

    @property
    def at(self) -> float | None:
        """When the next announcement is due; ``None``: never."""
        return self._due.next()
