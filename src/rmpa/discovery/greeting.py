"""Unicast with measure: whom to answer and how often, and whom to greet of those known only by hearsay."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core import limits
from rmpa.core.backoff import Backoff
from rmpa.core.clock import earliest

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.discovery.events import Address


class AnswerLimit:
    """At most one answer to an address in ``ANSWER_INTERVAL``, and ``ANSWERS_PER_SECOND`` over all."""

    def __init__(self) -> None:
        self._last: OrderedDict[Address, float] = OrderedDict()
        self._second = float("-inf")
        self._count = 0

    def allows(self, address: Address, now: float) -> bool:
        """Whether an answer may go there now; if so it counts as sent."""
        if now - self._last.get(address, float("-inf")) < limits.ANSWER_INTERVAL:
            return False
        if now - self._second >= 1.0:
            self._second = now
            self._count = 0
        if self._count >= limits.ANSWERS_PER_SECOND:
            return False
        self._count += 1
        self._last[address] = now
        self._last.move_to_end(address)
        if len(self._last) > limits.ANSWER_ADDRESSES_MAX:
            self._last.popitem(last=False)
        return True


@dataclass(slots=True)
class _Greeting:
    backoff: Backoff
    at: float
    told_at: float


class Greetings:
    """Addresses that others told us of: each greeted with back-off for as long as somebody speaks of it.

    It ends by itself: nobody passes on a peer that has not spoken to it, so the dead are soon spoken of no more.

    Args:
        rng: Uniform numbers in [0, 1).
    """

    def __init__(self, rng: Callable[[], float]) -> None:
        self._rng = rng
        self._all: dict[Address, _Greeting] = {}

    def __contains__(self, address: Address) -> bool:
        return address in self._all

    def __len__(self) -> int:
        return len(self._all)

    def learn(self, address: Address, now: float) -> bool:
        """Somebody spoke of ``address``: greet it for a while; ``False`` if there is no room for it."""
        greeting = self._all.get(address)
        if greeting is not None:
            greeting.told_at = now
            return True
        if len(self._all) >= limits.GREETINGS_MAX:
            return False
        self._all[address] = _Greeting(Backoff(limits.GREETING_FIRST, limits.GREETING_MAX, self._rng), now, now)
        return True

    def heard(self, address: Address) -> bool:
        """Whoever is there spoke: no more greetings. Return whether it had been greeted."""
        return self._all.pop(address, None) is not None

    def due(self, now: float) -> list[Address]:
        """The addresses to greet now, in order."""
        greeted = []
        for address in sorted(a for a, g in self._all.items() if g.at <= now):
            greeting = self._all[address]
            if now - greeting.told_at >= limits.GREETING_FORGET:
                del self._all[address]
                continue
            greeted.append(address)
            greeting.at = now + greeting.backoff.delay()
        return greeted

    def next_timer(self) -> float | None:
        """When ``due`` has something to say or to forget."""
        return earliest(*(greeting.at for greeting in self._all.values()))
