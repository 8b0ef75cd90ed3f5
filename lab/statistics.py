"""What the experiments ask of their samples: periods, outages, straight lines, ratios over rounds.

Pure functions of numbers; percentiles are in ``samples``. Times are in ns where they are moments of a
clock (``came_ns``), in seconds where they are spans. A flow is rows of ``(sequence, came_ns)``, as a sink noted it.
"""

from __future__ import annotations

import itertools
import random
import statistics
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lab.samples import percentile

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

# Draws of a bootstrap: its bounds are then stable to about a hundredth of their distance.
_RESAMPLED: Final = 2000
# Rounds below which nothing is said of the spread between them.
_ROUNDS_NEEDED: Final = 3
# Points of a distribution function that a picture can show.
_DRAWN: Final = 2000


# --- straight lines -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Fit:
    """A straight line by least squares.

    Args:
        slope: In units of y for one of x.
        intercept: y at 0.
        r2: How much of the variance of y it explains, 0 to 1.
    """

    slope: float
    intercept: float
    r2: float

    def at(self, x: float) -> float:
        """The line's y."""
        return self.intercept + self.slope * x


def linear_fit(xs: Sequence[float], ys: Sequence[float]) -> Fit:
    """Lay a straight line through points (least squares of y).

    Raises:
        ValueError: They are fewer than two, not as many x as y, or all x are the same.
    """
    if len(xs) != len(ys):
        raise ValueError(f"{len(xs)} x for {len(ys)} y")
    if len(set(xs)) < 2:
        raise ValueError("a line needs two different x")
    slope, intercept = statistics.linear_regression(xs, ys)
    level = len(set(ys)) == 1  # a line through all points, though nothing varies that it could explain
    return Fit(slope, intercept, 1.0 if level else statistics.correlation(xs, ys) ** 2)


# --- periods --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean and standard deviation, in the unit of the samples.

    Args:
        count: Samples.
        mean: ``None`` without samples.
        sd: Of a sample (n - 1); ``None`` with fewer than two.
    """

    count: int
    mean: float | None
    sd: float | None


def spread(values: Sequence[float]) -> Spread:
    """Mean and standard deviation."""
    return Spread(
        len(values),
        statistics.fmean(values) if values else None,
        statistics.stdev(values) if len(values) > 1 else None,
    )


def periods(rows: Iterable[tuple[int, int]]) -> list[float]:
    """Seconds between arrivals that are neighbours in the sequence, in its order.

    Where a message is lost there is no period, rather than a double one; of one that came twice the first counts.
    """
    pairs = itertools.pairwise(sorted(_first(rows).items()))
    return [(b - a) / 1e9 for (i, a), (j, b) in pairs if j == i + 1]


def delays(earlier: Iterable[tuple[int, int]], later: Iterable[tuple[int, int]]) -> list[tuple[int, float]]:
    """Seconds from a message of one flow to the one with the same number of another: ``(sequence, seconds)``.

    With CMD and VEL as the pc receives them, this is the paper's control computation delay.
    """
    begun, ended = _first(earlier), _first(later)
    return [(number, (ended[number] - begun[number]) / 1e9) for number in sorted(begun.keys() & ended.keys())]


# --- outages ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Outage:
    """A time in which a flow stood still.

    Args:
        began_ns: When its last message before came, or when the measurement began.
        ended_ns: When its first message after came, or when the measurement ended.
        lost: Messages that were never seen because of it.
        back: Whether the flow came back.
    """

    began_ns: int
    ended_ns: int
    lost: int
    back: bool

    @property
    def seconds(self) -> float:
        """How long."""
        return (self.ended_ns - self.began_ns) / 1e9


def outages(rows: Iterable[tuple[int, int]], longest: float, span: tuple[int, int] | None = None) -> list[Outage]:
    """Find where a flow stood still.

    Args:
        rows: ``(sequence, came_ns)``.
        longest: Seconds between two messages that are still no outage.
        span: When the measurement began and ended, ns; without it, an outage at either end is not seen.

    Returns:
        In order. ``lost`` counts numbers left out between the message before and the one after; where the numbering
        begins again (its source was restarted), the numbers before the first one of the new numbering. Before the
        first and after the last message it is 0: what was sent there is not known.
    """
    arrivals = sorted((came, number) for number, came in rows)
    found: list[Outage] = []
    if span and arrivals and (arrivals[0][0] - span[0]) / 1e9 > longest:
        found.append(Outage(span[0], arrivals[0][0], 0, back=True))
    for (came, number), (after, following) in itertools.pairwise(arrivals):
        if (after - came) / 1e9 > longest:
            lost = following - number - 1 if following > number else following
            found.append(Outage(came, after, lost, back=True))
    last = arrivals[-1][0] if arrivals else span[0] if span else 0
    if span and (span[1] - last) / 1e9 > longest:
        found.append(Outage(last, span[1], 0, back=False))
    return found


def flowing(rows: Iterable[tuple[int, int]], longest: float) -> list[tuple[int, int]]:
    """When a flow ran, as the bars of a timeline: (from, to) in ns, apart by more than ``longest`` seconds."""
    arrivals = sorted(came for _, came in rows)
    bars: list[tuple[int, int]] = []
    for came in arrivals:
        if bars and (came - bars[-1][1]) / 1e9 <= longest:
            bars[-1] = (bars[-1][0], came)
        else:
            bars.append((came, came))
    return bars


def _first(rows: Iterable[tuple[int, int]]) -> dict[int, int]:
    """When each number came first."""
    first: dict[int, int] = {}
    for number, came in rows:
        first[number] = min(came, first.get(number, came))
    return first


# --- rounds ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Ratio:
    """How many times as large a figure is as another, over rounds that took turns.

    Args:
        value: The median of the one by the median of the other.
        low: Lower bound of its 95 % interval, by a bootstrap over rounds; ``None`` with fewer than three rounds.
        high: Upper bound.
        rounds: How many.
    """

    value: float
    low: float | None
    high: float | None
    rounds: int

    def __str__(self) -> str:
        if self.low is None or self.high is None:
            return f"{self.value:.3g}"
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


def ratio(values: Sequence[float | None], base: Sequence[float | None], seed: int = 1) -> Ratio | None:
    """Compare two contenders by one figure a round (a median, a standard deviation), neighbours in time at one place.

    Args:
        values: Of the one, by round; ``None`` where the round failed: it is left out for both.
        base: Of the other; what is beyond the shorter of the two is left out.
        seed: Of the draws; the same samples give the same bounds.

    Returns:
        ``None`` where no round has both, or the base's median is 0.
    """
    both = [(a, b) for a, b in zip(values, base, strict=False) if a is not None and b is not None]
    value = _by_medians(both)
    if value is None:
        return None
    if len(both) < _ROUNDS_NEEDED:
        return Ratio(value, None, None, len(both))
    chance = random.Random(seed)
    drawn = (_by_medians(chance.choices(both, k=len(both))) for _ in range(_RESAMPLED))
    ordered = sorted(one for one in drawn if one is not None)
    return Ratio(value, percentile(ordered, 2.5), percentile(ordered, 97.5), len(both))


def _by_medians(pairs: Sequence[tuple[float, float]]) -> float | None:
    if not pairs:
        return None
    base = statistics.median(b for _, b in pairs)
    return statistics.median(a for a, _ in pairs) / base if base else None


def median(values: Iterable[float | None]) -> float | None:
    """The median of what there is; ``None`` if there is nothing."""
    kept = [value for value in values if value is not None]
    return statistics.median(kept) if kept else None


# --- distributions --------------------------------------------------------------------------------------------------


def distribution(samples: Sequence[float], *, tail: bool = False) -> tuple[list[float], list[float]]:
    """The distribution function: (values, shares of the samples that are at most so large), thinned for a picture.

    Args:
        samples: In any order.
        tail: Give the share that is larger, for a logarithmic axis; the largest sample has none and is left out.
    """
    ordered = sorted(samples)
    count = len(ordered)
    kept = _ranks(count, tail=tail)
    if tail:
        return [ordered[i] for i in kept], [(count - 1 - i) / count for i in kept]
    return [ordered[i] for i in kept], [(i + 1) / count for i in kept]


def _ranks(count: int, *, tail: bool) -> list[int]:
    """Which of the ordered samples a picture shows: all, or evenly chosen ones, and each of the largest."""
    last = count - 1 if tail else count
    if last <= _DRAWN:
        return list(range(last))
    ends = _DRAWN // 4
    step = (last - ends) / (_DRAWN - ends)
    return [int(i * step) for i in range(_DRAWN - ends)] + list(range(last - ends, last))
