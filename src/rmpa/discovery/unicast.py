"""The rate of answers to beacons."""

from __future__ import annotations

from collections import OrderedDict
from typing import TYPE_CHECKING

from rmpa.discovery import limits

if TYPE_CHECKING:
    from rmpa.discovery.beacon import Address


class AnswerLimit:
    """At most one answer to an address in ``ANSWER_INTERVAL``, and ``ANSWERS_PER_SECOND`` over all addresses."""

    def __init__(self) -> None:
        self._last: OrderedDict[Address, float] = OrderedDict()
        self._second = float("-inf")
        self._count = 0

    def allows(self, address: Address, now: float) -> bool:
        """Whether an answer may be sent to an address now; if so, it is counted as sent."""
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
