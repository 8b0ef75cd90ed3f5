"""Quality attributes: what a quality is measured in, and which way is better.

The literature sorts requirements into four classes (paper, section 3.1: "temporal and spatial requirements,
information reliability and operation performance"); the class is for people and reports, and decides nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from rmpa.core.errors import ConfigError


class Direction(StrEnum):
    """Which values satisfy whoever asked."""

    MAX = "max"
    """More is better: a request is a lower bound (rate, resolution)."""
    MIN = "min"
    """Less is better: a request is an upper bound (latency, energy)."""
    TARGET = "target"
    """As near as can be to an interval or a value (zoom, speed)."""
    EXACT = "exact"
    """This or nothing (frame id, encoding)."""


class Scale(StrEnum):
    """How far apart two values are."""

    LINEAR = "linear"
    LOG = "log"
    """By their ratio: 10 to 20 Hz is as far as 20 to 40. Rates, latencies and bandwidths are so."""
    ORDINAL = "ordinal"
    """Words in an order, as far apart as their places."""
    NOMINAL = "nominal"
    """Words without an order: the same, or not."""


class Category(StrEnum):
    """The four classes of requirement."""

    TEMPORAL = "temporal"
    SPATIAL = "spatial"
    RELIABILITY = "reliability"
    """Of the information: accuracy, confidence, loss."""
    PERFORMANCE = "performance"
    """Of the operation: energy, CPU, cost."""


_NEARLY_NOTHING: Final = 1e-12
Value = float | str
"""A quality's value: a number in the attribute's unit, or one of its words."""


@dataclass(frozen=True, slots=True)
class Attribute:
    """One quality, as a resource declares it.

    Args:
        name: ``rate``, ``latency``, ``accuracy`` …
        direction: Which way is better.
        unit: Of its values (``resource.declare.units``); empty: a ratio.
        scale: How far apart two values are.
        category: The class of requirement, for reports.
        tolerance: A shortfall of this size counts 1: in the unit (linear), as a ratio above 1 (log), in places
            (ordinal). ``None``: the range over all profiles.
        words: Of ordinal and nominal scales; ordinal ones from worst to best, or in their order for ``target``.

    Raises:
        ConfigError: What was declared contradicts itself.
    """

    name: str
    direction: Direction
    unit: str = ""
    scale: Scale = Scale.LINEAR
    category: Category = Category.PERFORMANCE
    tolerance: float | None = None
    words: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        where = f"attribute {self.name}"
        if self.of_words and not self.words:
            remedy = 'for example words = ("low", "high")'
            raise ConfigError(where, f"a scale that is {self.scale} needs its words", remedy)
        if len(set(self.words)) != len(self.words):
            raise ConfigError(where, "it has a word twice")
        if self.words and not self.of_words:
            raise ConfigError(where, f"a scale that is {self.scale} has no words", "make it ordinal or nominal")
        if self.scale is Scale.NOMINAL and self.direction is not Direction.EXACT:
            raise ConfigError(where, f"words without an order have no {self.direction}", "make its direction exact")
        lowest = 1.0 if self.scale is Scale.LOG else 0.0
        if self.tolerance is not None and not lowest < self.tolerance < math.inf:
            kind = "a ratio above 1" if self.scale is Scale.LOG else "above 0"
            raise ConfigError(where, f"a tolerance of {self.tolerance:g}", f"it is {kind}")

    @property
    def of_words(self) -> bool:
        """Whether its values are words."""
        return self.scale in (Scale.ORDINAL, Scale.NOMINAL)

    def check(self, value: Value, where: str) -> Value:
        """A value of this attribute, as it is.

        Raises:
            ConfigError: It cannot be one.
        """
        if self.of_words:
            if value not in self.words:
                remedy = f"it is one of {', '.join(self.words)}"
                raise ConfigError(where, f"{value!r} is no value of {self.name}", remedy)
            return value
        if isinstance(value, str | bool) or not hasattr(value, "__float__") or not math.isfinite(value):
            raise ConfigError(where, f"{value!r} is no number", f"{self.name} is in {self.unit or 'parts of 1'}")
        if self.scale is Scale.LOG and value < 0:
            raise ConfigError(where, f"{value:g} is below 0", f"{self.name} has a logarithmic scale")
        return float(value)

    def place(self, value: Value) -> float:
        """Where a value lies on a line on which equal distances count alike; words by their places.

        On a logarithmic scale 0 lies where ``_NEARLY_NOTHING`` does, so that every distance is finite.
        """
        if isinstance(value, str):
            return float(self.words.index(value))
        if self.scale is Scale.LOG:
            return math.log(max(value, _NEARLY_NOTHING))
        return value

    def value(self, place: float) -> Value:
        """What lies at a place; the inverse of ``place``."""
        if self.of_words:
            return self.words[round(place)]
        return math.exp(place) if self.scale is Scale.LOG else place

    @property
    def tolerated(self) -> float | None:
        """The tolerance as a distance between places, or ``None``."""
        if self.tolerance is None:
            return None
        return math.log(self.tolerance) if self.scale is Scale.LOG else self.tolerance

    def show(self, value: Value) -> str:
        """A value with its unit, for people."""
        return value if isinstance(value, str) else f"{value:.6g} {self.unit}".rstrip()


RATE: Final = Attribute("rate", Direction.MAX, "Hz", Scale.LOG, Category.TEMPORAL)
PERIOD_SD: Final = Attribute("period_sd", Direction.MIN, "s", Scale.LOG, Category.TEMPORAL)
LATENCY: Final = Attribute("latency", Direction.MIN, "s", Scale.LOG, Category.TEMPORAL)
AGE: Final = Attribute("age", Direction.MIN, "s", Scale.LOG, Category.TEMPORAL)
LOSS: Final = Attribute("loss", Direction.MIN, "", Scale.LINEAR, Category.RELIABILITY)
DEADLINE_MISSES: Final = Attribute("deadline_misses", Direction.MIN, "", Scale.LINEAR, Category.TEMPORAL)
BANDWIDTH: Final = Attribute("bandwidth", Direction.MIN, "B/s", Scale.LOG, Category.PERFORMANCE)

MEASURED: Final = {a.name: a for a in (RATE, PERIOD_SD, LATENCY, AGE, LOSS, DEADLINE_MISSES, BANDWIDTH)}
"""The attributes that are measured for every output and input, declared or not; losses and misses are shares."""
