"""Cool-downs: profiles that failed or were violated are excluded for a while, each time for longer."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

COOL_DOWN_GROWTH: Final = 2.0
"""Factor from one cool-down of a profile to its next one, up to ``cool_down_max``."""


@dataclass(slots=True)
class CoolDown:
    """The exclusion of one profile.

    Args:
        until: Its end, monotonic seconds.
        cool_down: Its length in seconds; the next one is longer.
        why: The failure or violation, for people.
    """

    until: float
    cool_down: float
    why: str


class CoolDowns:
    """The cool-downs of one resource's profiles.

    Args:
        first: Seconds of a profile's first cool-down.
        longest: Seconds of its longest.
    """

    def __init__(self, first: float, longest: float) -> None:
        self._first = first
        self._longest = longest
        self._known: dict[str, CoolDown] = {}
        """By profile; one that is over has an infinite ``until`` and is kept for its length."""

    def restore(self, before: Mapping[str, CoolDown], now: float) -> None:
        """Continue the cool-downs of before a restart, bounded by the present settings."""
        for name, one in before.items():
            cool_down = min(one.cool_down, self._longest)
            self._known[name] = CoolDown(min(one.until, now + cool_down), cool_down, one.why)

    def begin(self, profile: str, why: str, now: float) -> None:
        """Exclude a profile."""
        before = self._known.get(profile)
        cool_down = self._first if before is None else min(before.cool_down * COOL_DOWN_GROWTH, self._longest)
        self._known[profile] = CoolDown(now + cool_down, cool_down, why)

    def reset(self, profile: str) -> None:
        """End a profile's cool-down; its next one is the first again."""
        self._known.pop(profile, None)

    def active(self, now: float) -> dict[str, CoolDown]:
        """The profiles that are excluded at present."""
        return {name: replace(one) for name, one in self._known.items() if now < one.until < math.inf}

    def next_timer(self) -> float:
        """When the next cool-down is over, monotonic seconds; infinite: none runs."""
        return min((one.until for one in self._known.values()), default=math.inf)

    def handle_timer(self, now: float) -> None:
        """End the cool-downs that are over."""
        for one in self._known.values():
            if one.until <= now:
                one.until = math.inf
