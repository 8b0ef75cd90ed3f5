"""Quality attributes with their units, and the rules of contexts.

Quality attributes: the unit and the scale of a quality, and which direction is better.

The literature sorts requirements into four classes (paper, section 3.1: "temporal and spatial requirements,
information reliability and operation performance"). The class is shown in reports and does not influence decisions.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.resource import limits

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator


# Units of quality attributes and their conversion: ``20 Hz``, ``50 ms``, ``2 MB/s``.


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


def convert(value: float, unit: str, to: str, where: str) -> float:
    """Convert a value to another unit of the same dimension.

    Args:
        value: The value, in ``unit``.
        unit: The unit of the value. A unit that is not known here converts only to itself.
        to: The unit of the result.
        where: The purpose of the value, for errors.

    Raises:
        ConfigError: A unit is unknown, or the two units have different dimensions.
    """
    if unit == to:
        return value
    dimension, wanted = _DIMENSION_OF.get(unit), _DIMENSION_OF.get(to)
    if dimension is None:
        near = did_you_mean(unit, list(_DIMENSIONS[wanted] if wanted is not None else _DIMENSION_OF))
        remedy = f"did you mean {near}?" if near else f"say it in {to}"
        raise ConfigError(where, f"{unit!r} is not a unit known here", remedy)
    if wanted != dimension:
        meant = f"a {wanted}" if wanted is not None else "of its own"
        raise ConfigError(where, f"{unit!r} is a unit of {dimension}", f"{where} is {meant}, in {to!r}")
    return value * _DIMENSIONS[dimension][unit] / _DIMENSIONS[dimension][to]


def quantity(text: str | float, to: str, where: str) -> float:
    """Read ``50 ms``, or a bare number in the unit ``to``, as a value in ``to``.

    Raises:
        ConfigError: The text is no finite number with a unit, or its unit does not convert to ``to``.
    """
    if isinstance(text, bool):
        raise ConfigError(where, f"{text} is not a number with a unit", f"for example 20 {to}".rstrip())
    if isinstance(text, int | float):
        value, unit = float(text), to
    else:
        match = _QUANTITY.fullmatch(text)
        if match is None:
            raise ConfigError(where, f"{text!r} is not a number with a unit", f"for example 20 {to}".rstrip())
        value, unit = float(match[1]), match[2] or to
    if not math.isfinite(value):
        raise ConfigError(where, f"{value} is not a number with a unit", f"for example 20 {to}".rstrip())
    return convert(value, unit, to, where)


# Rules that select a context by fields of topics and by the resource's parameters.
#
# ::
#
#     rule       = conjunction { "or" conjunction }
#     conjunction= negation { "and" negation }
#     negation   = "not" negation | "(" rule ")" | value [ ("==" | "!=" | "<" | "<=" | ">" | ">=") value ]
#     value      = number | 'text' | "text" | true | false | ~parameter | /topic | /topic/field | /topic.field.field
#
# Example: ``/battery/charging == true and ~gain > 3``. In ``/battery/charging`` the longest part that is a
# published
# topic is the topic, as for rostopic; ``/battery.charging`` is explicit. A topic alone means the message's only
# field
# (``std_msgs/Bool``). A value that is unknown (no message yet, no publisher) makes a comparison neither true nor
# false.
# A rule holds only if it is true whatever the unknown values are (Kleene's logic).
#
# Pure: a rule is parsed once, into a function of the values; nothing is evaluated as Python.


Scalar = bool | int | float | str
"""A value that rules can compare."""
_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.]))"
    r"|(?P<text>'[^']*'|\"[^\"]*\")"
    r"|(?P<topic>/[A-Za-z]\w*(?:/\w+)*(?:\.\w+)*)"
    r"|(?P<parameter>~[A-Za-z]\w*)"
    r"|(?P<word>[A-Za-z_]\w*)"
    r"|(?P<sign>==|!=|<=|>=|<|>|\(|\)))"
)
_SIGNS: Final[Mapping[str, Callable[[Any, Any], bool]]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_KEYWORDS: Final = ("and", "or", "not", "true", "false")
_EXAMPLE: Final = "for example /battery/charging == true and ~gain > 3"


@dataclass(frozen=True, slots=True)
class Reference:
    """A variable of a rule: ``/topic.field`` or ``~parameter``, as written in the rule."""

    text: str

    @property
    def parameter(self) -> str:
        """The parameter's name; empty for a topic's field."""
        return self.text[1:] if self.text.startswith("~") else ""

    def candidates(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Possible splits into a topic and its fields, longest topic first; no field: the message's only one."""
        topic, dot, fields = self.text.partition(".")
        if dot:
            yield topic, tuple(fields.split("."))
            return
        parts = topic.strip("/").split("/")
        for count in range(len(parts), 0, -1):
            yield "/" + "/".join(parts[:count]), tuple(parts[count:])


_Values = Mapping[str, Scalar]
_Holds = Callable[[_Values], bool | None]
"""Whether a part of a rule is true; ``None`` if that depends on unknown values."""
_Value = Callable[[_Values], Scalar | None]


@dataclass(frozen=True, slots=True)
class ContextRule:
    """A parsed rule; ``references`` has each variable of the rule once."""

    text: str
    holds: _Holds
    """Whether the rule is true by the known values, which are by reference, as written in the rule."""
    references: tuple[Reference, ...]


def parse_rule(text: str, parameters: Collection[str], where: str = "rule") -> ContextRule:
    """Parse a rule.

    Args:
        text: A ``rule`` of the module's grammar.
        parameters: Names of the resource's parameters.
        where: Description of the rule, for errors.

    Raises:
        ConfigError: The rule has a syntax error or an unknown parameter, or is too long or nested too deeply.
    """
    if len(text) > limits.CONTEXT_RULE_MAX:
        raise ConfigError(where, f"{len(text)} characters", f"at most {limits.CONTEXT_RULE_MAX}")
    parser = _Parser(text, where)
    holds = parser.rule(0)
    parser.end()
    references = tuple(dict.fromkeys(parser.references))
    for reference in references:
        name = reference.parameter
        if name and name not in parameters:
            near = did_you_mean(name, parameters)
            remedy = f"did you mean ~{near}?" if near else "declare it before the context"
            raise ConfigError(where, f"there is no parameter {name}", remedy)
    return ContextRule(text, holds, references)


class _Parser:
    """A recursive-descent parser of one rule."""

    def __init__(self, text: str, where: str) -> None:
        self._text = text
        self._where = where
        self._at = 0
        self._kind = ""
        self._lexeme = ""
        self.references: list[Reference] = []
        self._next()

    def rule(self, depth: int) -> _Holds:
        return self._chain("or", lambda: self._chain("and", lambda: self._negation(depth)))

    def end(self) -> None:
        if self._kind:
            raise self._error(f"{self._lexeme!r} stands where the rule must end, or go on with and/or")

    def _chain(self, word: str, part: Callable[[], _Holds]) -> _Holds:
        parts = [part()]
        while self._lexeme == word:
            self._next()
            parts.append(part())
        decisive = word == "or"  # one true decides an "or", one false an "and"

        def holds(values: _Values) -> bool | None:
            found = [each(values) for each in parts]
            if decisive in found:
                return decisive
            return None if None in found else not decisive

        return parts[0] if len(parts) == 1 else holds

    def _negation(self, depth: int) -> _Holds:
        if depth > limits.CONTEXT_RULE_DEPTH:
            raise self._error(f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets")
        if self._lexeme == "not":
            self._next()
            inner = self._negation(depth + 1)
            return lambda values: None if (found := inner(values)) is None else not found
        if self._lexeme == "(":
            self._next()
            inner = self.rule(depth + 1)
            if self._lexeme != ")":
                raise self._error("a bracket is not closed")
            self._next()
            return inner
        left, right, compare = self._value(), _constant(True), operator.eq
        if self._lexeme in _SIGNS:
            compare = _SIGNS[self._lexeme]
            self._next()
            right = self._value()
        return lambda values: _compare(compare, left(values), right(values))

    def _value(self) -> _Value:
        kind, piece = self._kind, self._lexeme
        if kind == "word" and piece not in ("true", "false"):
            near = did_you_mean(piece, _KEYWORDS) if piece not in _KEYWORDS else None
            raise self._error(f"{piece!r} is no value", f"did you mean {near}?" if near else "texts have quotes")
        if not kind or kind == "sign":
            raise self._error(f"a value is missing in front of {piece!r}" if piece else "a value is missing")
        self._next()
        if kind == "word":
            return _constant(piece == "true")
        if kind == "text":
            return _constant(piece[1:-1])
        if kind == "number":
            return _constant(float(piece))
        self.references.append(Reference(piece))
        return lambda values: values.get(piece)

    def _next(self) -> None:
        if not self._text[self._at :].strip():
            self._kind = self._lexeme = ""
            return
        match = _TOKEN.match(self._text, self._at)
        if match is None:
            raise self._error(f"{self._text[self._at :].strip()[:20]!r} cannot be read")
        self._at = match.end()
        self._kind = match.lastgroup or ""
        self._lexeme = match[self._kind]

    def _error(self, problem: str, remedy: str = _EXAMPLE) -> ConfigError:
        return ConfigError(self._where, f"{self._text!r}: {problem}", remedy)


def _constant(value: Scalar) -> _Value:
    return lambda _values: value


def _compare(compare: Callable[[Any, Any], bool], left: Scalar | None, right: Scalar | None) -> bool | None:
    """Compare two values; numbers and booleans as Python does, since a ROS ``bool`` may be 0 or 1."""
    if left is None or right is None or left != left or right != right:  # noqa: PLR0124 - NaN
        return None
    if isinstance(left, str) != isinstance(right, str):
        return compare is operator.ne  # a text equals only texts
    if isinstance(left, str) and compare not in (operator.eq, operator.ne):
        return False  # texts have no order
    return compare(left, right)


@dataclass(slots=True)
class ContextSelector:
    """Selects the context: the one chosen by hand, or else the first whose rule holds.

    Args:
        rules: Rules by context, in order of declaration; contexts without a rule are chosen by hand only.
        dwell: Least number of seconds between two changes of context by rules.
    """

    rules: Mapping[str, ContextRule]
    dwell: float = limits.CONTEXT_DWELL
    chosen: str = ""
    """The context chosen by hand; empty: the rules decide."""
    since: float = field(default=-math.inf)
    """When the present context began, monotonic seconds."""

    def select(self, current: str, values: Mapping[str, Scalar], now: float) -> str:
        """Select the context to be in; empty: none.

        Args:
            current: The present context; empty: none.
            values: Known values, as for ``ContextRule.holds``.
            now: Monotonic seconds.
        """
        if self.chosen:
            return self.chosen
        wanted = next((name for name, rule in self.rules.items() if rule.holds(values)), "")
        return wanted if wanted == current or now - self.since >= self.dwell else current


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
        unit: Unit of the values (``resource.declare.attributes``); empty: a ratio.
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
