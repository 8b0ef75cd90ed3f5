"""Quality attributes: the unit and the scale of a quality, and which direction is better.

The literature sorts requirements into four classes (paper, section 3.1: "temporal and spatial requirements,
information reliability and operation performance"). The class is shown in reports and does not influence decisions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from rmpa.core.errors import ConfigError
from rmpa.resource.declare.units import quantity


class Direction(StrEnum):
    """Which values of an attribute are better."""

    MAX = "max"
    """More is better: a request is a lower bound (rate, resolution)."""
    MIN = "min"
    """Less is better: a request is an upper bound (latency, energy)."""
    TARGET = "target"
    """Nearer to a requested value or interval is better (zoom, speed)."""
    EXACT = "exact"
    """Only a requested value will do (frame id, encoding)."""


class Scale(StrEnum):
    """How the distance between two values is measured."""

    LINEAR = "linear"
    LOG = "log"
    """By the ratio: 10 Hz is as far from 20 Hz as 20 Hz from 40 Hz. For rates, latencies and bandwidths."""
    ORDINAL = "ordinal"
    """Ordered words; the distance is the difference of their positions."""
    NOMINAL = "nominal"
    """Words without an order: equal or not."""


class Category(StrEnum):
    """The four classes of requirements."""

    TEMPORAL = "temporal"
    SPATIAL = "spatial"
    RELIABILITY = "reliability"
    """Reliability of information: accuracy, confidence, loss."""
    PERFORMANCE = "performance"
    """Performance of the operation: energy, CPU, cost."""


_LOG_FLOOR: Final = 1e-12
Value = float | str
"""The value of a quality: a number in the attribute's unit, or one of its words."""


@dataclass(frozen=True, slots=True)
class Attribute:
    """One quality attribute, as a resource declares it.

    Args:
        name: ``rate``, ``latency``, ``accuracy`` …
        direction: Which values are better.
        unit: Unit of the values (``resource.declare.units``); empty: a ratio.
        scale: How distances are measured.
        category: The class of requirement, for reports.
        tolerance: A shortfall of this size counts as 1: in the unit (linear), as a ratio above 1 (log), in
            positions (ordinal). ``None``: the range over all profiles.
        words: The values of ordinal and nominal scales; ordinal ones from worst to best, or in order for ``target``.

    Raises:
        ConfigError: The declaration contradicts itself.
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
        if self.has_words and not self.words:
            remedy = 'for example words = ("low", "high")'
            raise ConfigError(where, f"a scale that is {self.scale} needs its words", remedy)
        if len(set(self.words)) != len(self.words):
            raise ConfigError(where, "it has a word twice")
        if self.words and not self.has_words:
            raise ConfigError(where, f"a scale that is {self.scale} has no words", "make it ordinal or nominal")
        if self.scale is Scale.NOMINAL and self.direction is not Direction.EXACT:
            raise ConfigError(where, f"words without an order have no {self.direction}", "make its direction exact")
        lowest = 1.0 if self.scale is Scale.LOG else 0.0
        if self.tolerance is not None and not lowest < self.tolerance < math.inf:
            kind = "a ratio above 1" if self.scale is Scale.LOG else "above 0"
            raise ConfigError(where, f"a tolerance of {self.tolerance:g}", f"it is {kind}")

    @property
    def has_words(self) -> bool:
        """Whether the attribute's values are words."""
        return self.scale in (Scale.ORDINAL, Scale.NOMINAL)

    def check(self, value: Value, where: str) -> Value:
        """Return the value, a number as ``float``, if it is valid for this attribute.

        Raises:
            ConfigError: The value is not valid; ``where`` begins the error's text.
        """
        if self.has_words:
            if value not in self.words:
                remedy = f"it is one of {', '.join(self.words)}"
                raise ConfigError(where, f"{value!r} is no value of {self.name}", remedy)
            return value
        if isinstance(value, str | bool) or not hasattr(value, "__float__") or not math.isfinite(value):
            raise ConfigError(where, f"{value!r} is no number", f"{self.name} is in {self.unit or 'parts of 1'}")
        if self.scale is Scale.LOG and value < 0:
            raise ConfigError(where, f"{value:g} is below 0", f"{self.name} has a logarithmic scale")
        return float(value)

    def parse(self, value: Value, where: str) -> Value:
        """Read a value as a user writes it: a number, ``"20 Hz"`` in any unit of the dimension, or a word.

        Raises:
            ConfigError: The value is not valid for this attribute; ``where`` begins the error's text.
        """
        return self.check(value if self.has_words else quantity(value, self.unit, where), where)

    def position(self, value: Value) -> float:
        """Position of a value on the attribute's scale: the number, its logarithm, or the index of the word.

        On a logarithmic scale 0 counts as ``_LOG_FLOOR``, so that every distance is finite.
        """
        if isinstance(value, str):
            return float(self.words.index(value))
        if self.scale is Scale.LOG:
            return math.log(max(value, _LOG_FLOOR))
        return value

    def value_at(self, position: float) -> Value:
        """The value at a position; the inverse of ``position``."""
        if self.has_words:
            return self.words[round(position)]
        return math.exp(position) if self.scale is Scale.LOG else position

    @property
    def tolerated_distance(self) -> float | None:
        """The tolerance as a distance between two positions; ``None``: none is declared."""
        if self.tolerance is None:
            return None
        return math.log(self.tolerance) if self.scale is Scale.LOG else self.tolerance

    def format(self, value: Value) -> str:
        """A value with its unit, as a text for people."""
        return value if isinstance(value, str) else f"{value:.6g} {self.unit}".rstrip()


RATE: Final = Attribute("rate", Direction.MAX, "Hz", Scale.LOG, Category.TEMPORAL)
PERIOD_SD: Final = Attribute("period_sd", Direction.MIN, "s", Scale.LOG, Category.TEMPORAL)
LATENCY: Final = Attribute("latency", Direction.MIN, "s", Scale.LOG, Category.TEMPORAL)
AGE: Final = Attribute("age", Direction.MIN, "s", Scale.LOG, Category.TEMPORAL)
LOSS: Final = Attribute("loss", Direction.MIN, "", Scale.LINEAR, Category.RELIABILITY)
DEADLINE_MISSES: Final = Attribute("deadline_misses", Direction.MIN, "", Scale.LINEAR, Category.TEMPORAL)
BANDWIDTH: Final = Attribute("bandwidth", Direction.MIN, "B/s", Scale.LOG, Category.PERFORMANCE)

MEASURED: Final = {a.name: a for a in (RATE, PERIOD_SD, LATENCY, AGE, LOSS, DEADLINE_MISSES, BANDWIDTH)}
"""The attributes that are measured of every output and input without being declared, by name. ``loss`` and
``deadline_misses`` are shares of 1."""
