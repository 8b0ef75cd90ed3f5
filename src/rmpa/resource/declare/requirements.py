"""What clients ask of a resource's quality, and what all of them ask together.

Intervals are intersected in the order of the clients' priorities. A bound that would leave nothing is left out, and
who asked for it is told: the more important client is not made to pay for the less important one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from operator import attrgetter, itemgetter
from typing import TYPE_CHECKING

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.resource.declare.attributes import Attribute, Direction
from rmpa.resource.declare.units import quantity

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.declare.attributes import Value


@dataclass(frozen=True, slots=True)
class Bound:
    """What one client asks of one attribute; ``bound`` makes one from what a user wrote.

    Args:
        low: The least that satisfies, as a place on the attribute's scale; ``-inf``: no bound.
        high: The most.
        words: Of a nominal attribute: those that satisfy; else empty.
        weight: How much a shortfall counts beside other attributes, above 0.
        hard: Whether a profile that falls short cannot serve at all.
    """

    low: float = -math.inf
    high: float = math.inf
    words: frozenset[str] = frozenset()
    weight: float = 1.0
    hard: bool = False

    def met_by(self, attribute: Attribute, value: Value) -> bool:
        """Whether a value satisfies it."""
        if self.words:
            return value in self.words
        return self.low <= attribute.place(value) <= self.high


def bound(
    attribute: Attribute,
    *,
    at_least: float | str | None = None,
    at_most: float | str | None = None,
    exactly: float | str | tuple[str, ...] | None = None,
    weight: float = 1.0,
    hard: bool = False,
) -> Bound:
    """Read what a client asks of an attribute.

    Args:
        attribute: Which.
        at_least: The least value that satisfies: a number, ``"20 Hz"``, or a word.
        at_most: The greatest.
        exactly: The one that does; of a nominal attribute one or several words.
        weight: How much a shortfall counts.
        hard: Whether a shortfall excludes.

    Raises:
        ConfigError: The bounds are the wrong way round, the unit or word is unknown, nothing is asked, or what is
            asked makes no sense for the attribute's direction.
    """
    where = f"requirement of {attribute.name}"
    if not (math.isfinite(weight) and weight > 0):
        raise ConfigError(where, f"a weight of {weight:g}", "it is above 0; leave the attribute out instead")
    if exactly is not None and (at_least is not None or at_most is not None):
        raise ConfigError(where, "an exact value and bounds", "give one or the other")
    if exactly is None and at_least is None and at_most is None:
        raise ConfigError(where, "nothing is asked of it", "give at_least, at_most or exactly")
    if isinstance(exactly, tuple) or (attribute.of_words and attribute.direction is Direction.EXACT):
        return _words(attribute, exactly, where, weight=weight, hard=hard)
    if exactly is not None:
        at_least = at_most = exactly
    low = -math.inf if at_least is None else _place(attribute, at_least, where)
    high = math.inf if at_most is None else _place(attribute, at_most, where)
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
    """Check the side that asks for nothing: an exact value is a bound on the side that counts."""
    if asked is None or (other is not None and exactly is None):
        raise ConfigError(where, f"{better}, so a bound on the other side asks for nothing", f"give {key} alone")


def _words(attribute: Attribute, exactly: object, where: str, *, weight: float, hard: bool) -> Bound:
    words = exactly if isinstance(exactly, tuple) else (exactly,)
    if exactly is None or not words or not attribute.of_words:
        raise ConfigError(
            where, "it takes no such words" if not attribute.of_words else "give exactly, one word or more"
        )
    for word in words:
        attribute.check(word, where)
    return Bound(words=frozenset(map(str, words)), weight=weight, hard=hard)


def _place(attribute: Attribute, value: float | str, where: str) -> float:
    if attribute.of_words:
        return attribute.place(attribute.check(value, where))
    return attribute.place(attribute.check(quantity(value, attribute.unit, where), where))


@dataclass(frozen=True, slots=True)
class Requirement:
    """What one client asks of a resource.

    Args:
        client: Who: a node's name, unique among the clients.
        bounds: By attribute.
        priority: The higher one wins a conflict.
        expires: Monotonic seconds after which it is forgotten; ``None``: never.
    """

    client: str
    bounds: Mapping[str, Bound] = field(hash=False)
    priority: int = 0
    expires: float | None = None


@dataclass(frozen=True, slots=True)
class RequirementConflict:
    """A bound that could not be kept beside those of more important clients.

    Args:
        client: Whose.
        attribute: Of which attribute.
        against: The clients that it contradicts.
    """

    client: str
    attribute: str
    against: tuple[str, ...]

    def __str__(self) -> str:
        """Say who gave way to whom."""
        return f"{self.attribute}: what {self.client} asks contradicts {', '.join(self.against)} and is left out"


@dataclass(frozen=True, slots=True)
class Merged:
    """What all clients ask together.

    Args:
        bounds: By attribute: the intersection; the greatest weight; hard if any of those that count is.
        conflicts: What was left out.
    """

    bounds: Mapping[str, Bound] = field(default_factory=dict, hash=False)
    conflicts: tuple[RequirementConflict, ...] = ()


def merge(requirements: Iterable[Requirement]) -> Merged:
    """Intersect the clients' intervals, the more important first; of equal ones the earlier."""
    clients = sorted(requirements, key=_importance)
    asked: dict[str, list[Bound]] = {}
    for requirement in clients:
        for name, ours in requirement.bounds.items():
            before = asked.get(name)
            if before is None:
                asked[name] = [ours]
            else:
                before.append(ours)
    bounds: dict[str, Bound] = {}
    conflicts: list[tuple[int, RequirementConflict]] = []
    for name, several in asked.items():
        both = _all(several)
        bounds[name] = both if both is not None else _in_order(name, clients, conflicts)
    conflicts.sort(key=itemgetter(0))
    return Merged(bounds, tuple(conflict for _, conflict in conflicts))


def _importance(requirement: Requirement) -> int:
    return -requirement.priority


_low, _high, _weight, _hard, _words_of = (attrgetter(name) for name in ("low", "high", "weight", "hard", "words"))


def _all(bounds: list[Bound]) -> Bound | None:
    """The intersection of bounds without words; ``None`` where it is empty, or words are asked for."""
    if len(bounds) == 1:
        return bounds[0]
    if any(map(_words_of, bounds)):
        return None
    low, high = max(map(_low, bounds)), min(map(_high, bounds))
    if low > high:
        return None
    return Bound(low, high, weight=max(map(_weight, bounds)), hard=any(map(_hard, bounds)))


def _in_order(name: str, clients: list[Requirement], conflicts: list[tuple[int, RequirementConflict]]) -> Bound:
    """The intersection for one attribute, one client after the other; who is left out goes to ``conflicts``."""
    found: Bound | None = None
    kept: list[str] = []
    for place, requirement in enumerate(clients):
        ours = requirement.bounds.get(name)
        if ours is None:
            continue
        both = _both(found, ours) if found is not None else ours
        if both is None:
            conflicts.append((place, RequirementConflict(requirement.client, name, tuple(kept))))
        else:
            found = both
            kept.append(requirement.client)
    return found if found is not None else Bound()


def _both(one: Bound, other: Bound) -> Bound | None:
    """The intersection, or ``None`` where it is empty."""
    low = one.low if one.low >= other.low else other.low  # noqa: FURB136 - max() takes twice as long
    high = one.high if one.high <= other.high else other.high  # noqa: FURB136
    words = one.words
    if other.words is not words:
        words = one.words & other.words if one.words and other.words else one.words or other.words
        if not words:
            return None
    if low > high:
        return None
    weight = one.weight if one.weight >= other.weight else other.weight  # noqa: FURB136
    hard = one.hard or other.hard
    if low == one.low and high == one.high and words is one.words and weight == one.weight and hard == one.hard:
        return one
    return Bound(low, high, words, weight, hard)


def find_attribute(attributes: Mapping[str, Attribute], name: str, resource: str) -> Attribute:
    """An attribute by its name.

    Raises:
        ConfigError: The resource has none of that name.
    """
    found = attributes.get(name)
    if found is None:
        near = did_you_mean(name, list(attributes))
        remedy = f"did you mean {near}?" if near else f"it has {', '.join(attributes) or 'none'}"
        raise ConfigError(f"requirement of {name}", f"{resource} has no such attribute", remedy)
    return found
