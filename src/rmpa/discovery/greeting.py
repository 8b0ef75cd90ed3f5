"""Unicast with measure: whom to answer and how often, and whom to greet of those known only by hearsay."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core.backoff import Backoff
from rmpa.core.timer_queue import TimerQueue
from rmpa.core.token_bucket import TokenBucket
from rmpa.discovery import limits

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
        self._due: TimerQueue[Address] = TimerQueue()
        self._allowed = TokenBucket(limits.GREETINGS_PER_SECOND, limits.GREETINGS_MAX)
        self._resume = float("-inf")

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
        self._all[address] = _Greeting(Backoff(limits.GREETING_FIRST, limits.GREETING_MAX, self._rng), now)
        self._due.set(address, now)
        return True

    def heard(self, address: Address) -> bool:
        """Whoever is there spoke: no more greetings. Return whether it had been greeted."""
        self._due.set(address, None)
        return self._all.pop(address, None) is not None

    def due(self, now: float) -> list[Address]:
        """The addresses to greet now, the ones that waited longest first; beyond the limit they go on waiting."""
        greeted: list[Address] = []
        while now >= self._resume and (address := self._due.pop(now)) is not None:
            greeting = self._all[address]
            if now - greeting.told_at >= limits.GREETING_FORGET:
                del self._all[address]
            elif self._allowed.take(now):
                greeted.append(address)
                self._due.set(address, now + greeting.backoff.delay())
            else:
                self._due.set(address, now)
                self._resume = self._allowed.next(now)
        return greeted

    def next_timer(self) -> float | None:
        """When ``due`` has something to say or to forget."""
        due = self._due.next()
        return None if due is None else max(due, self._resume)
