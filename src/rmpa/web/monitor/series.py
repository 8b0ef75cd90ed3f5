"""Samples of a plot between two messages to the browser: bounded, and without losing a peak."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

from rmpa.web.monitor import limits

if TYPE_CHECKING:
    from collections.abc import Sequence

Sample: TypeAlias = tuple[float, list[float | None]]
"""A moment in seconds since the epoch, and a value for each line; ``None`` where there is none."""


class SampleBuffer:
    """Keeps samples until they are taken.

    Of more than ``most`` samples, each pair of neighbours becomes one or two: for each line the least and the
    greatest value stay, at the moments of the pair. So a peak of one message is still seen.

    Args:
        lines: The number of values of a sample.
        most: Samples that are kept; even.
    """

    def __init__(self, lines: int, most: int = limits.POINTS_MAX) -> None:
        self._lines = lines
        self._most = most
        self._samples: list[Sample] = []

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, moment: float, values: Sequence[float | None]) -> None:
        """Add a sample; NaN and infinities count as no value."""
        clean = [value if value is not None and math.isfinite(value) else None for value in values[: self._lines]]
        self._samples.append((moment, clean))
        if len(self._samples) > 2 * self._most:
            self._samples = self._thinned()

    def take(self) -> list[list[float | None]]:
        """Columns: the moments, then the values of each line; the buffer is empty then."""
        while len(self._samples) > self._most:
            self._samples = self._thinned()
        samples, self._samples = self._samples, []
        if not samples:
            return []
        moments: list[float | None] = [round(moment, 4) for moment, _ in samples]
        return [moments, *([values[line] for _, values in samples] for line in range(self._lines))]

    def _thinned(self) -> list[Sample]:
        """Half as many samples: of each four neighbours the extremes of each line, at the first and last moment."""
        made: list[Sample] = []
        for start in range(0, len(self._samples), 4):
            part = self._samples[start : start + 4]
            if len(part) < 3:
                made += part
                continue
            first: list[float | None] = []
            last: list[float | None] = []
            for line in range(self._lines):
                known = [(values[line], at) for at, (_, values) in enumerate(part) if values[line] is not None]
                least = min(known, default=(None, 0), key=lambda pair: pair[0] or 0.0)
                most = max(known, default=(None, 0), key=lambda pair: pair[0] or 0.0)
                early, late = (least, most) if least[1] <= most[1] else (most, least)
                first.append(early[0])
                last.append(late[0])
            made += [(part[0][0], first), (part[-1][0], last)]
        return made
