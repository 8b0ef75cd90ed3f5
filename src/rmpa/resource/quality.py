"""Qualities: units, attributes, and what clients require of them.

The literature sorts requirements into four classes (paper, section 3.1: "temporal and spatial requirements,
information reliability and operation performance"). The class is shown in reports and does not influence decisions.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError
from rmpa.resource import limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.ros.types.definitions import DiagnosticLevel


# Units of quality attributes and their conversion. ``20 Hz``, ``50 ms``, ``2 MB/s``.


_DIMENSIONS: Final[dict[str, dict[str, float]]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0},
    "frequency": {"Hz": 1.0, "mHz": 1e-3, "kHz": 1e3, "MHz": 1e6},
    "data rate": {
        "B/s": 1.0,
        "kB/s": 1e3,
        "MB/s": 1e6,
        "GB/s": 1e9,
        "kbit/s": 125.0,
        "Mbit/s": 125e3,
        "Gbit/s": 125e6,
    },
    "data": {"B": 1.0, "kB": 1e3, "MB": 1e6, "GB": 1e9},
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "um": 1e-6, "µm": 1e-6},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
    "angular speed": {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30},
    "ratio": {"": 1.0, "%": 0.01},
    "energy": {"J": 1.0, "kJ": 1e3, "Wh": 3600.0, "kWh": 3.6e6},
    "power": {"W": 1.0, "mW": 1e-3, "kW": 1e3},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
    "temperature": {"°C": 1.0},
    "pixels": {"px": 1.0, "Mpx": 1e6},
}
_DIMENSION_OF: Final = {unit: name for name, units in _DIMENSIONS.items() for unit in units}
_QUANTITY: Final = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S*)\s*")


def quantity(text: str | float, to: str, where: str) -> float:
    """Read ``50 ms``, or a bare number in the unit ``to``, as a value in ``to``.

    Args:
        text: The number, with or without a unit. A unit that is not known here converts only to itself.
        to: The unit of the result.
        where: The purpose of the value, for errors.

    Raises:
        ConfigError: The text is no finite number with a unit, or its unit does not convert to ``to``.
    """
    match = None if isinstance(text, bool) else _QUANTITY.fullmatch(str(text))
    value = float(match[1]) if match else text
    if isinstance(value, str | bool) or not math.isfinite(value):
        shown = repr(value) if isinstance(value, str) else str(value)
        raise ConfigError(where, f"{shown} is not a number with a unit", f"for example 20 {to}".rstrip())
    unit = (match[2] if match else "") or to
    if unit == to:
        return value
    dimension, wanted = _DIMENSION_OF.get(unit), _DIMENSION_OF.get(to)
    if dimension is None:
        remedy = suggestion(
            unit, list(_DIMENSIONS[wanted] if wanted is not None else _DIMENSION_OF), f"say it in {to}"
        )
        raise ConfigError(where, f"{unit!r} is not a unit known here", remedy)
    if wanted != dimension:
        meant = f"a {wanted}" if wanted is not None else "of its own"
        raise ConfigError(where, f"{unit!r} is a unit of {dimension}", f"{where} is {meant}, in {to!r}")
    return value * _DIMENSIONS[dimension][unit] / _DIMENSIONS[dimension][to]


# Quality attributes. The unit and the scale of a quality, and which direction is better.


class Direction(StrEnum):
    """Which values of an attribute are better."""

    # More is better: a request is a lower bound (rate, resolution).
    MAX = "max"
    # Less is better: a request is an upper bound (latency, energy).
    MIN = "min"
    # Nearer to a requested value or interval is better (zoom, speed).
    TARGET = "target"
    # Only a requested value will do (frame id, encoding).
    EXACT = "exact"


class Scale(StrEnum):
    """How the distance between two values is measured."""

    LINEAR = "linear"
    # By the ratio: 10 Hz is as far from 20 Hz as 20 Hz from 40 Hz. For rates, latencies and bandwidths.
    LOG = "log"
    # Ordered words; the distance is the difference of their positions.
    ORDINAL = "ordinal"
    # Words without an order: equal or not.
    NOMINAL = "nominal"


class Category(StrEnum):
    """The four classes of requirements."""

    TEMPORAL = "temporal"
    SPATIAL = "spatial"
    # Reliability of information: accuracy, confidence, loss.
    RELIABILITY = "reliability"
    # Performance of the operation: energy, CPU, cost.
    PERFORMANCE = "performance"


_LOG_FLOOR: Final = 1e-12
# The value of a quality: a number in the attribute's unit, or one of its words.
Value = float | str


@dataclass(frozen=True, slots=True)
class Attribute:
    """One quality attribute, as a resource declares it.

    Args:
        name: ``rate``, ``latency``, ``accuracy`` …
        direction: Which values are better.
        unit: Unit of the values; empty: a ratio.
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
        lowest, kind = (1.0, "a ratio above 1") if self.scale is Scale.LOG else (0.0, "above 0")
        if self.tolerance is not None and not lowest < self.tolerance < math.inf:
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
        return math.log(max(value, _LOG_FLOOR)) if self.scale is Scale.LOG else value

    def value_at(self, position: float) -> Value:
        """The value at a position; the inverse of ``position``."""
        if self.has_words:
            return self.words[round(position)]
        return math.exp(position) if self.scale is Scale.LOG else position

    def format(self, value: Value) -> str:
        """A value with its unit, as a text for people."""
        return value if isinstance(value, str) else f"{value:.6g} {self.unit}".rstrip()


_MAX, _MIN, _LOG = Direction.MAX, Direction.MIN, Scale.LOG
# The attributes that are measured of every output and input without being declared, by name. ``loss`` and
# ``deadline_misses`` are shares of 1.
MEASURED: Final = {
    a.name: a
    for a in (
        Attribute("rate", _MAX, "Hz", _LOG, Category.TEMPORAL),
        Attribute("period_sd", _MIN, "s", _LOG, Category.TEMPORAL),
        Attribute("latency", _MIN, "s", _LOG, Category.TEMPORAL),
        Attribute("age", _MIN, "s", _LOG, Category.TEMPORAL),
        Attribute("loss", _MIN, category=Category.RELIABILITY),
        Attribute("deadline_misses", _MIN, category=Category.TEMPORAL),
        Attribute("bandwidth", _MIN, "B/s", _LOG),
    )
}


def find_attribute(attributes: Mapping[str, Attribute], name: str, resource: str) -> Attribute:
    """Find an attribute by its name.

    Raises:
        ConfigError: The resource has no attribute of this name.
    """
    found = attributes.get(name)
    if found is None:
        remedy = suggestion(name, list(attributes), f"it has {', '.join(attributes) or 'none'}")
        raise ConfigError(f"requirement of {name}", f"{resource} has no such attribute", remedy)
    return found


# Requests for one attribute. As a user writes them (``at_least("20 Hz", hard=True)``), and as bounds.


@dataclass(frozen=True, slots=True)
class Bound:
    """The values of one attribute that satisfy a request; ``QoSRequest.bound`` makes it.

    Args:
        low: The least position on the attribute's scale that satisfies the request; ``-inf``: no bound.
        high: The greatest position that satisfies the request; ``inf``: no bound.
        words: The words that satisfy the request, if it is one for words; else empty.
        weight: Weight of a shortfall relative to other attributes, above 0.
        hard: Whether a shortfall makes a profile infeasible.
    """

    low: float = -math.inf
    high: float = math.inf
    words: frozenset[str] = frozenset()
    weight: float = 1.0
    hard: bool = False

    def met_by(self, attribute: Attribute, value: Value) -> bool:
        """Whether a value satisfies the bound."""
        return value in self.words if self.words else self.low <= attribute.position(value) <= self.high

    def excess(self, position: float) -> float:
        """The distance by which a position on the scale lies outside of the bound; 0 for words."""
        return 0.0 if self.words else max(self.low - position, position - self.high, 0.0)

    def intersect(self, other: Bound) -> Bound | None:
        """The values that satisfy both bounds; ``None`` if there are none."""
        low, high = max(self.low, other.low), min(self.high, other.high)
        words = self.words & other.words if self.words and other.words else self.words or other.words
        if low > high or ((self.words or other.words) and not words):
            return None
        return Bound(low, high, words, max(self.weight, other.weight), self.hard or other.hard)

    def describe(self, attribute: Attribute) -> str:
        """The bound as a text for people, such as ``at least 20 Hz``."""
        if self.words:
            return " or ".join(word for word in attribute.words if word in self.words)
        low = attribute.format(attribute.value_at(self.low)) if self.low > -math.inf else ""
        high = attribute.format(attribute.value_at(self.high)) if self.high < math.inf else ""
        if low == high:
            return f"exactly {low}"
        if low and high:
            return f"{low} to {high}"
        return f"at least {low}" if low else f"at most {high}"


@dataclass(frozen=True, slots=True)
class QoSRequest:
    """The requested quality of one attribute, before the attributes of the resource are known."""

    at_least: float | str | None = None
    at_most: float | str | None = None
    exactly: float | str | tuple[str, ...] | None = None
    weight: float = 1.0
    hard: bool = False

    def __str__(self) -> str:
        """The text form that ``parse_request`` reads: ``>= 20 Hz hard weight=2``."""
        if self.exactly is not None:
            values = self.exactly if isinstance(self.exactly, tuple) else (self.exactly,)
            text = "= " + " | ".join(map(str, values))
        elif self.at_least is not None and self.at_most is not None:
            text = f"{self.at_least} .. {self.at_most}"
        else:
            text = f">= {self.at_least}" if self.at_least is not None else f"<= {self.at_most}"
        hard = " hard" if self.hard else ""
        return text + hard + (f" weight={self.weight:g}" if self.weight != 1 else "")

    def bound(self, attribute: Attribute) -> Bound:
        """The request as a bound of an attribute.

        Raises:
            ConfigError: The bounds are the wrong way round, the unit or word is unknown, nothing is requested, or the
                request contradicts the attribute's direction.
        """
        where, low, high = f"requirement of {attribute.name}", self.at_least, self.at_most
        if not (math.isfinite(self.weight) and self.weight > 0):
            raise ConfigError(where, f"a weight of {self.weight:g}", "it is above 0; leave the attribute out instead")
        if self.exactly is not None and (low is not None or high is not None):
            raise ConfigError(where, "an exact value and bounds", "give one or the other")
        if self.exactly is None and low is None and high is None:
            raise ConfigError(where, "nothing is asked of it", "give at_least, at_most or exactly")
        if isinstance(self.exactly, tuple) or (attribute.has_words and attribute.direction is Direction.EXACT):
            return self._words(attribute, where)
        if self.exactly is not None:
            low = high = self.exactly
        least = -math.inf if low is None else attribute.position(attribute.parse(low, where))
        most = math.inf if high is None else attribute.position(attribute.parse(high, where))
        if least > most:
            raise ConfigError(where, f"at least {low} and at most {high}", "the bounds are the wrong way round")
        # Where one side is better, a request bounds the other side only; an exact value is such a bound.
        if attribute.direction is Direction.MAX:
            wrong, most, better, key = low is None or self.at_most is not None, math.inf, "more", "at_least (>=)"
        elif attribute.direction is Direction.MIN:
            wrong, least, better, key = high is None or self.at_least is not None, -math.inf, "less", "at_most (<=)"
        else:
            wrong, better, key = False, "", ""
        if wrong:
            problem = f"{better} is better, so a bound on the other side asks for nothing"
            raise ConfigError(where, problem, f"give {key} alone")
        return Bound(least, most, weight=self.weight, hard=self.hard)

    def _words(self, attribute: Attribute, where: str) -> Bound:
        words = self.exactly if isinstance(self.exactly, tuple) else (self.exactly,)
        if self.exactly is None or not words or not attribute.has_words:
            problem = "give exactly, one word or more" if attribute.has_words else "it takes no such words"
            raise ConfigError(where, problem)
        found = frozenset(str(attribute.check(word, where)) for word in words if word is not None)
        return Bound(words=found, weight=self.weight, hard=self.hard)


def at_least(value: float | str, *, hard: bool = False, weight: float = 1.0) -> QoSRequest:
    """Request this value or more: ``at_least("20 Hz")``."""
    return QoSRequest(at_least=value, hard=hard, weight=weight)


def at_most(value: float | str, *, hard: bool = False, weight: float = 1.0) -> QoSRequest:
    """Request this value or less: ``at_most("50 ms")``."""
    return QoSRequest(at_most=value, hard=hard, weight=weight)


def exactly(*values: float | str, hard: bool = False, weight: float = 1.0) -> QoSRequest:
    """Request this value, or one of several words: ``exactly("mono8", "rgb8")``."""
    one: Any = values[0] if len(values) == 1 else tuple(map(str, values))
    return QoSRequest(exactly=one, hard=hard, weight=weight)


def between(low: float | str, high: float | str, *, hard: bool = False, weight: float = 1.0) -> QoSRequest:
    """Request a value within an interval: ``between("1 m", "3 m")``."""
    return QoSRequest(at_least=low, at_most=high, hard=hard, weight=weight)


# Requests as texts, which any ROS tool can publish. ``rate: ">= 20 Hz hard"``, ``latency: "<= 50 ms weight=2"``.
#
# ::
#
#     request = bound { " hard" | " weight=" number }
#     bound   = ">=" value | "<=" value | "=" value { "|" value } | value ".." value


_REQUEST: Final = re.compile(
    r"\s*(?P<sign>>=|<=|=+)?(?P<values>.*?)(?P<options>(?:(?:^|\s+)(?:hard|weight\s*=\s*\S+))*)\s*", re.DOTALL
)
_OPTION: Final = re.compile(r"hard|weight\s*=\s*(\S+)")
_EXAMPLE: Final = 'write ">= 20 Hz", "<= 50 ms hard", "1 .. 3 m", "= word" or "= this | that weight=2"'
PRIORITY: Final = "priority"
EXPIRES: Final = "expires"


def parse_request(text: str, name: str) -> QoSRequest:
    """Read the request for one attribute.

    Args:
        text: A ``request`` of the grammar above.
        name: The attribute's name, for errors.

    Raises:
        ConfigError: The text has a syntax error or is too long.
    """
    where = f"requirement of {name}"
    if len(text) > limits.REQUIREMENT_TEXT_MAX:
        raise ConfigError(where, f"{len(text)} characters", f"at most {limits.REQUIREMENT_TEXT_MAX}")
    match = _REQUEST.fullmatch(text)
    sign, values = (match["sign"] or "", match["values"]) if match else ("", "")
    parts = [part.strip() for part in (values.split("|") if sign.startswith("=") else values.split("..", 1))]
    if sign in (">=", "<="):
        parts = [values.strip()]
    elif not sign and len(parts) == 1:
        raise ConfigError(where, f"{text!r} is no bound", _EXAMPLE)
    if not all(parts):
        raise ConfigError(where, f"{text!r} lacks a value", _EXAMPLE)
    hard, weight = False, 1.0
    for option in reversed(list(_OPTION.finditer(match["options"] if match else ""))):
        if option[1] is None:
            hard = True
            continue
        try:
            weight = float(option[1])
        except ValueError:
            raise ConfigError(where, f"{option[0]!r} is no weight", "for example weight=2") from None
    if sign.startswith("="):
        return exactly(*parts, hard=hard, weight=weight)
    if not sign:
        return between(*parts, hard=hard, weight=weight)
    return (at_least if sign == ">=" else at_most)(parts[0], hard=hard, weight=weight)


def parse_bound(text: str, name: str, attributes: Mapping[str, Attribute], resource: str) -> Bound:
    """Read the request for one attribute of a resource.

    A lower bound without a unit has that of the upper bound: ``1 .. 3 m`` means ``1 m .. 3 m``.

    Raises:
        ConfigError: The text has a syntax error, the attribute is unknown, or the request is not valid for it.
    """
    attribute = find_attribute(attributes, name, resource)
    request = parse_request(text, name)
    low, high = str(request.at_least), str(request.at_most)
    unit = re.search(r"[^\d.eE+\-\s]\S*$", high)
    if request.at_most is not None and unit and re.fullmatch(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?", low):
        request = replace(request, at_least=f"{low} {unit[0]}")
    return request.bound(attribute)


# Requirements of clients. The requests of each, and their merge.


@dataclass(frozen=True, slots=True)
class RequirementAnswer:
    """How a resource serves one client.

    Args:
        level: OK; WARN: a quality falls short, or no profile runs yet; ERROR: no profile meets the requirements, or
            the request is invalid.
        message: A short explanation for people.
        values: By attribute a text with the requested and the measured quality.
    """

    level: DiagnosticLevel
    message: str
    values: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Requirement:
    """The QoS requests of one client.

    Args:
        client: The client's node name, unique among the clients.
        bounds: The requested bound of each attribute, by name.
        priority: In a conflict between clients the higher priority wins.
        expires: When the requirement is dropped, in monotonic seconds; ``None``: never.
    """

    client: str
    bounds: Mapping[str, Bound] = field(hash=False)
    priority: int = 0
    expires: float | None = None


def merge(requirements: Iterable[Requirement]) -> tuple[dict[str, Bound], list[tuple[str, str]]]:
    """Intersect the bounds of all clients by descending priority; equal priorities keep their given order.

    A bound that would make the intersection empty is left out and reported to its client, so it never weakens a bound
    of higher priority.

    Returns:
        The intersection by attribute; it has the greatest weight of its parts, and is hard if one of them is. And the
        conflicts: the client whose bound is left out, and a text about it, in the order of priorities.
    """
    bounds: dict[str, Bound] = {}
    kept: dict[str, list[str]] = {}
    conflicts = []
    for requirement in sorted(requirements, key=lambda each: -each.priority):
        for name, one in requirement.bounds.items():
            common = bounds[name].intersect(one) if name in bounds else one
            if common is None:
                others = f"contradicts {', '.join(kept[name])} and is left out"
                conflicts.append((requirement.client, f"{name}: what {requirement.client} asks {others}"))
            else:
                bounds[name] = common
                kept.setdefault(name, []).append(requirement.client)
    return bounds, conflicts


def parse_requirement(
    client: str, values: Iterable[tuple[str, str]], attributes: Mapping[str, Attribute], resource: str, now: float
) -> Requirement:
    """Read the whole requirement of one client.

    Args:
        client: Name of the client's node.
        values: Attributes with their texts; optionally ``priority`` (a whole number) and ``expires`` (a duration).
        attributes: The attributes of the resource, by name.
        resource: Name of the resource, for errors.
        now: Monotonic seconds, from which ``expires`` counts.

    Raises:
        ConfigError: A text is invalid; the error is the first one, and the whole requirement is invalid.
    """
    bounds: dict[str, Bound] = {}
    priority, expires = 0, None
    for number, (key, text) in enumerate(values):
        if number >= limits.REQUIREMENT_BOUNDS_MAX:
            raise ConfigError(f"requirement of {client}", f"more than {limits.REQUIREMENT_BOUNDS_MAX} bounds")
        if key == PRIORITY:
            if not re.fullmatch(r"\s*[-+]?\d{1,9}\s*", text):
                raise ConfigError(
                    PRIORITY, f"{text!r} is no whole number", "for example 1; the higher one wins a conflict"
                )
            priority = int(text)
        elif key == EXPIRES:
            seconds = quantity(text, "s", EXPIRES)
            if seconds <= 0:
                raise ConfigError(EXPIRES, f"{text!r} is over already", 'for example "30 s"')
            expires = now + seconds
        elif key in bounds:
            raise ConfigError(f"requirement of {key}", "it is asked twice", "say both in one: 1 .. 3 m")
        else:
            bounds[key] = parse_bound(text, key, attributes, resource)
    return Requirement(client, bounds, priority, expires)
