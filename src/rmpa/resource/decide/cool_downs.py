"""Cool-downs: a profile that failed or was violated is excluded for a while, and for longer each time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

COOL_DOWN_GROWTH: Final = 2.0
"""Factor by which each cool-down of a profile is longer than the one before, up to ``cool_down_max``."""


@dataclass(slots=True)
class CoolDown:
    """The exclusion of one profile.

    Args:
        until: End of the cool-down, in monotonic seconds.
        cool_down: Length of the cool-down in seconds; the next one is longer, up to the maximum.
        why: The failure or violation, as a text for people.
    """

    until: float
    cool_down: float
    why: str


class CoolDowns:
    """The cool-downs of one resource's profiles.

    Args:
        first: Seconds of a profile's first cool-down.
        longest: Seconds of a profile's longest cool-down.
    """

    def __init__(self, first: float, longest: float) -> None:
        self._first = first
        self._longest = longest
        self._known: dict[str, CoolDown] = {}
        """The last cool-down by profile. One that is over has an infinite ``until`` and is kept for its length, from
        which the length of the next one is computed."""

    def restore(self, before: Mapping[str, CoolDown], now: float) -> None:
        """Continue the cool-downs that were saved before a restart, bounded by the present settings."""
        for name, one in before.items():
            cool_down = min(one.cool_down, self._longest)
            self._known[name] = CoolDown(min(one.until, now + cool_down), cool_down, one.why)

    def begin(self, profile: str, why: str, now: float) -> None:
        """Begin a cool-down, for which the profile is excluded."""
        before = self._known.get(profile)
        cool_down = self._first if before is None else min(before.cool_down * COOL_DOWN_GROWTH, self._longest)
        self._known[profile] = CoolDown(now + cool_down, cool_down, why)

    def reset(self, profile: str) -> None:
        """End a profile's cool-down; its next one has the length of the first again."""
        self._known.pop(profile, None)

    def active(self, now: float) -> dict[str, CoolDown]:
        """The cool-downs that are not over, by profile."""
        return {name: replace(one) for name, one in self._known.items() if now < one.until < math.inf}

    def next_timer(self) -> float:
        """When the next cool-down ends, in monotonic seconds; infinite: none is under way."""
        return min((one.until for one in self._known.values()), default=math.inf)

    def handle_timer(self, now: float) -> None:
        """End the cool-downs that are over."""
        for one in self._known.values():
            if one.until <= now:
                one.until = math.inf
