"""What profiles have really offered: the median and spread of the windows that were judged while each ran. Pure."""

from __future__ import annotations

import statistics
from collections import deque
from typing import TYPE_CHECKING

import msgspec

from rmpa.resource import limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.declare import Profile
    from rmpa.resource.quality import Value


class LearntOffer(msgspec.Struct, frozen=True):
    """What a profile has given of one attribute.

    Attributes:
        median: Of the last windows that were judged, at most ``limits.LEARNT_WINDOWS``.
        spread: From the first to the third quartile.
        n: The number of windows.
    """

    median: float
    spread: float
    n: int

    @property
    def enough(self) -> bool:
        """Whether there are enough windows to compare profiles by it."""
        return self.n >= limits.LEARNT_LEAST


class LearntOffers:
    """The learnt offers of one resource's profiles, of the attributes that a profile declares.

    Args:
        profiles: The declared profiles.
    """

    def __init__(self, profiles: Iterable[Profile]) -> None:
        self._windows: dict[str, dict[str, deque[float]]] = {
            one.name: {
                name: deque(maxlen=limits.LEARNT_WINDOWS)
                for name, value in one.offers.items()
                if not isinstance(value, str)
            }
            for one in profiles
        }
        # By profile and attribute; brought up to date every ``LEARNT_LEAST`` windows, so that it rarely changes.
        self.offers: dict[str, dict[str, LearntOffer]] = {}
        # The values to keep, by profile and attribute.
        self.saved: dict[str, dict[str, list[float]]] = {}
        self._since = 0

    def restore(self, saved: Mapping[str, Mapping[str, list[float]]]) -> None:
        """Take over the values that were kept before a restart; those of attributes not declared now are dropped."""
        for profile, found in self._windows.items():
            for name, values in found.items():
                values.extend(saved.get(profile, {}).get(name, ()))
        self.update()

    def window(self, profile: str, measured: Mapping[str, Value]) -> None:
        """Take the values of a window that was judged while the profile ran."""
        for name, values in self._windows[profile].items():
            value = measured.get(name)
            if value is not None and not isinstance(value, str):
                values.append(float(f"{value:.6g}"))
        self._since += 1
        if self._since % limits.LEARNT_LEAST == 0:
            self._summarize()
        if self._since % limits.LEARNT_WINDOWS == 0:
            self.update()

    def update(self) -> None:
        """Bring all up to date: another profile runs, or the resource ends."""
        self._summarize()
        self.saved = {
            profile: {name: list(values) for name, values in found.items() if values}
            for profile, found in self._windows.items()
            if any(found.values())
        }

    def _summarize(self) -> None:
        self.offers = {
            profile: {name: _summary(values) for name, values in found.items() if values}
            for profile, found in self._windows.items()
            if any(found.values())
        }


def _summary(values: deque[float]) -> LearntOffer:
    quartiles = statistics.quantiles(values, n=4, method="inclusive") if len(values) > 1 else [0.0, 0.0, 0.0]
    return LearntOffer(statistics.median(values), quartiles[2] - quartiles[0], len(values))
