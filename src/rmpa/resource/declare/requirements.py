"""Requirements of clients: their text, their merge, and the answer to each client.

A resource's answer to the requirement of one client.
"""

from __future__ import annotations

import math
import re
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.declare.attributes import Attribute, Direction, quantity

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.declare.attributes import Value
    from rmpa.ros.types.definitions import DiagnosticLevel


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


# Requirements of clients on the quality of a resource, and their merge.
#
# The bounds on an attribute are intersected in the order of the clients' priorities. A bound that would make the
# intersection empty is left out and reported to its client, so it never weakens a bound of higher priority.


@dataclass(frozen=True, slots=True)
class Bound:
    """The values of one attribute that satisfy a request; ``bound`` makes it from a user's request.

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
        if self.words:
            return value in self.words
        return self.low <= attribute.position(value) <= self.high

    def excess(self, position: float) -> float:
        """The distance by which a position on the scale lies outside of the bound; 0 for words."""
        return 0.0 if self.words else max(self.low - position, position - self.high, 0.0)


def bound(
    attribute: Attribute,
    *,
    at_least: float | str | None = None,
    at_most: float | str | None = None,
    exactly: float | str | tuple[str, ...] | None = None,
    weight: float = 1.0,
    hard: bool = False,
) -> Bound:
    """Convert a request into a bound of an attribute.

    Args:
        attribute: The requested attribute.
        at_least: The least value that satisfies the request: a number, ``"20 Hz"``, or a word.
        at_most: The greatest value that satisfies the request.
        exactly: The only value that satisfies the request; of an attribute with words one or several.
        weight: Weight of a shortfall relative to other attributes, above 0.
        hard: Whether a shortfall makes a profile infeasible.

    Raises:
        ConfigError: The bounds are the wrong way round, the unit or word is unknown, nothing is requested, or the
            request contradicts the attribute's direction.
    """
    where = f"requirement of {attribute.name}"
    if not (math.isfinite(weight) and weight > 0):
        raise ConfigError(where, f"a weight of {weight:g}", "it is above 0; leave the attribute out instead")
    if exactly is not None and (at_least is not None or at_most is not None):
        raise ConfigError(where, "an exact value and bounds", "give one or the other")
    if exactly is None and at_least is None and at_most is None:
        raise ConfigError(where, "nothing is asked of it", "give at_least, at_most or exactly")
    if isinstance(exactly, tuple) or (attribute.has_words and attribute.direction is Direction.EXACT):
        return _words(attribute, exactly, where, weight=weight, hard=hard)
    if exactly is not None:
        at_least = at_most = exactly
    low = -math.inf if at_least is None else attribute.position(attribute.parse(at_least, where))
    high = math.inf if at_most is None else attribute.position(attribute.parse(at_most, where))
    if low > high:
        raise ConfigError(where, f"at least {at_least} and at most {at_most}", "the bounds are the wrong way round")
    if attribute.direction is Direction.MAX:
        _check_side(at_least, at_most, exactly, where, "more is better", "at_least (>=)")
        high = math.inf
    elif attribute.direction is Direction.MIN:
        _check_side(at_most, at_least, exactly, where, "less is better", "at_most (<=)")
        low = -math.inf
    return Bound(low, high, weight=weight, hard=hard)


def _check_side(asked: object, other: object, exactly: object, where: str, better: str, key: str) -> None:
    """Refuse a bound on the side that is better anyway; an exact value counts as a bound on the other side."""
    if asked is None or (other is not None and exactly is None):
        raise ConfigError(where, f"{better}, so a bound on the other side asks for nothing", f"give {key} alone")


def _words(attribute: Attribute, exactly: object, where: str, *, weight: float, hard: bool) -> Bound:
    words = exactly if isinstance(exactly, tuple) else (exactly,)
    if exactly is None or not words or not attribute.has_words:
        raise ConfigError(
            where, "it takes no such words" if not attribute.has_words else "give exactly, one word or more"
        )
    for word in words:
        attribute.check(word, where)
    return Bound(words=frozenset(map(str, words)), weight=weight, hard=hard)


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


@dataclass(frozen=True, slots=True)
class RequirementConflict:
    """A bound that is left out, because it contradicts bounds of higher or equal priority.

    Args:
        client: The client that requested the bound.
        attribute: Name of the attribute.
        against: The clients whose bounds are kept and contradict it together.
    """

    client: str
    attribute: str
    against: tuple[str, ...]

    def __str__(self) -> str:
        """The conflict as a sentence."""
        return f"{self.attribute}: what {self.client} asks contradicts {', '.join(self.against)} and is left out"


@dataclass(frozen=True, slots=True)
class MergedRequirements:
    """The requirements of all clients, merged.

    Args:
        bounds: The intersection by attribute. It has the greatest weight of its parts, and is hard if one of them is.
        conflicts: The bounds that were left out, in the order of their clients' priorities.
    """

    bounds: Mapping[str, Bound] = field(default_factory=dict, hash=False)
    conflicts: tuple[RequirementConflict, ...] = ()


def merge(requirements: Iterable[Requirement]) -> MergedRequirements:
    """Intersect the bounds of all clients by descending priority; equal priorities keep their given order."""
    bounds: dict[str, Bound] = {}
    kept: dict[str, list[str]] = {}
    conflicts = []
    for requirement in sorted(requirements, key=lambda each: -each.priority):
        for name, one in requirement.bounds.items():
            common = _intersect(bounds[name], one) if name in bounds else one
            if common is None:
                conflicts.append(RequirementConflict(requirement.client, name, tuple(kept[name])))
            else:
                bounds[name] = common
                kept.setdefault(name, []).append(requirement.client)
    return MergedRequirements(bounds, tuple(conflicts))


def _intersect(one: Bound, other: Bound) -> Bound | None:
    """The intersection of two bounds; ``None`` if it is empty."""
    low, high = max(one.low, other.low), min(one.high, other.high)
    words = one.words & other.words if one.words and other.words else one.words or other.words
    if low > high or ((one.words or other.words) and not words):
        return None
    return Bound(low, high, words, max(one.weight, other.weight), one.hard or other.hard)


def find_attribute(attributes: Mapping[str, Attribute], name: str, resource: str) -> Attribute:
    """Find an attribute by its name.

    Raises:
        ConfigError: The resource has no attribute of this name.
    """
    found = attributes.get(name)
    if found is None:
        near = did_you_mean(name, list(attributes))
        remedy = f"did you mean {near}?" if near else f"it has {', '.join(attributes) or 'none'}"
        raise ConfigError(f"requirement of {name}", f"{resource} has no such attribute", remedy)
    return found


# QoS requests in the form in which a user writes them: ``at_least("20 Hz", hard=True)``.


@dataclass(frozen=True, slots=True)
class QoSRequest:
    """The requested quality of one attribute, before the attributes of the resource are known."""

    at_least: float | str | None = None
    at_most: float | str | None = None
    exactly: float | str | tuple[str, ...] | None = None
    weight: float = 1.0
    hard: bool = False

    def __str__(self) -> str:
        """The text form that ``resource.declare.requirements`` reads: ``>= 20 Hz hard weight=2``."""
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
            ConfigError: The request is not valid for that attribute; see ``requirements.bound``.
        """
        return bound(attribute, **asdict(self))


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


# Requirements as texts, which any ROS tool can publish: ``rate: ">= 20 Hz hard"``, ``latency: "<= 50 ms
# weight=2"``.
#
# ::
#
#     request = bound { " hard" | " weight=" number }
#     bound   = ">=" value | "<=" value | "=" value { "|" value } | value ".." value


_WEIGHT: Final = re.compile(r"weight\s*=\s*(\S+)")
_EXAMPLE: Final = 'write ">= 20 Hz", "<= 50 ms hard", "1 .. 3 m", "= word" or "= this | that weight=2"'
PRIORITY: Final = "priority"
EXPIRES: Final = "expires"


def parse_request(text: str, name: str) -> QoSRequest:
    """Read the request for one attribute.

    Args:
        text: A ``request`` of the module's grammar.
        name: The attribute's name, for errors.

    Raises:
        ConfigError: The text has a syntax error or is too long.
    """
    where = f"requirement of {name}"
    if len(text) > limits.REQUIREMENT_TEXT_MAX:
        raise ConfigError(where, f"{len(text)} characters", f"at most {limits.REQUIREMENT_TEXT_MAX}")
    rest, hard, weight = text.strip(), False, 1.0
    while True:
        if match := re.search(r"(?:^|\s)(hard|weight\s*=\s*\S+)$", rest):
            word, rest = match[1], rest[: match.start()].rstrip()
            if word == "hard":
                hard = True
            else:
                weight = _weight(word, where)
        else:
            break
    if rest.startswith(">="):
        return QoSRequest(at_least=_value(rest[2:], text, where), hard=hard, weight=weight)
    if rest.startswith("<="):
        return QoSRequest(at_most=_value(rest[2:], text, where), hard=hard, weight=weight)
    if rest.startswith("="):
        values = tuple(_value(part, text, where) for part in rest.lstrip("=").split("|"))
        return QoSRequest(exactly=values if len(values) > 1 else values[0], hard=hard, weight=weight)
    low, dots, high = rest.partition("..")
    if dots:
        return QoSRequest(
            at_least=_value(low, text, where), at_most=_value(high, text, where), hard=hard, weight=weight
        )
    raise ConfigError(where, f"{text!r} is no bound", _EXAMPLE)


def _weight(word: str, where: str) -> float:
    match = _WEIGHT.fullmatch(word)
    try:
        return float(match[1]) if match else 1.0
    except ValueError:
        raise ConfigError(where, f"{word!r} is no weight", "for example weight=2") from None


def _value(text: str, whole: str, where: str) -> str:
    if not text.strip():
        raise ConfigError(where, f"{whole!r} lacks a value", _EXAMPLE)
    return text.strip()


def parse_bound(text: str, name: str, attributes: Mapping[str, Attribute], resource: str) -> Bound:
    """Read the request for one attribute of a resource.

    Raises:
        ConfigError: The text has a syntax error, the attribute is unknown, or the request is not valid for it.
    """
    attribute = find_attribute(attributes, name, resource)
    request = parse_request(text, name)
    if request.at_least is not None and request.at_most is not None and not attribute.has_words:
        request = _share_unit(request)
    return request.bound(attribute)


def _share_unit(request: QoSRequest) -> QoSRequest:
    """Apply the unit of the upper bound to a lower bound without a unit: ``1 .. 3 m`` means ``1 m .. 3 m``."""
    low, high = str(request.at_least), str(request.at_most)
    unit = re.search(r"[^\d.eE+\-\s]\S*$", high)
    if unit and re.fullmatch(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?", low):
        low = f"{low} {unit[0]}"
    return QoSRequest(at_least=low, at_most=high, weight=request.weight, hard=request.hard)


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
            priority = _priority(text)
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


def _priority(text: str) -> int:
    if not re.fullmatch(r"\s*[-+]?\d{1,9}\s*", text):
        raise ConfigError(PRIORITY, f"{text!r} is no whole number", "for example 1; the higher one wins a conflict")
    return int(text)
