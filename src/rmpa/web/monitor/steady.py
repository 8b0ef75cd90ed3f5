"""Figures that change only when there is something to see."""

from __future__ import annotations

import math

from rmpa.web.monitor import limits


def rounded(value: float, digits: int = 3) -> float:
    """``value`` with so many significant digits."""
    if value == 0 or not math.isfinite(value):
        return 0.0
    return float(f"{value:.{digits}g}")


def steady_figure(
    before: float | None, value: float | None, share: float = limits.STEADY, least: float = 0.0
) -> float | None:
    """The figure to show in place of ``before``, which is shown now.

    Args:
        before: What is shown; ``None`` for nothing.
        value: The new value; ``None`` where it is not known.
        share: Of the figure that is shown; a smaller change is not shown.
        least: A smaller change than this is not shown either.
    """
    if value is None or not math.isfinite(value):
        return None
    if before is not None and before != 0:
        change = abs(value - before)
        if change <= abs(before) * share or change <= least:
            return before
    return rounded(value)


class Steady:
    """Keeps the figures that are shown, by key, and gives a new one only for a change that can be seen."""

    def __init__(self) -> None:
        self._shown: dict[str, float] = {}
        self._used: set[str] = set()

    def figure(self, key: str, value: float | None, share: float = limits.STEADY, least: float = 0.0) -> float | None:
        """The figure to show under this key; the other arguments are those of ``steady_figure``."""
        shown = steady_figure(self._shown.get(key), value, share, least)
        if shown is None:
            self._shown.pop(key, None)
        else:
            self._used.add(key)
            self._shown[key] = shown
        return shown

    def moment(self, key: str, value: float | None) -> float | None:
        """A moment in seconds since the epoch, which is computed from a moving age; kept within half a second."""
        if value is None:
            return None
        self._used.add(key)
        before = self._shown.get(key)
        if before is not None and abs(value - before) < 0.5:
            return before
        self._shown[key] = shown = round(value, 1)
        return shown

    def sweep(self) -> None:
        """Forget what was not shown since the last call."""
        self._shown = {key: value for key, value in self._shown.items() if key in self._used}
        self._used.clear()
