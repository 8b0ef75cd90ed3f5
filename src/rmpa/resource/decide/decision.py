"""Finds the most similar profile: the one that serves the merged requirements best (paper, section 3.1).

For each requested attribute, a profile's *shortfall* is the distance by which its value lies outside of the bound,
divided by ``s``: the attribute's tolerance, or else its range over all profiles. Where that is 0, the shortfall is 0
or 1. A value within the bound has no shortfall. A profile's *distance* ``D`` is the weighted root mean square of its
shortfalls, plus a part of its cost::

    delta = max(0, shortfall) / s        D = sqrt(sum(w * delta^2) / sum(w)) + EPSILON * cost

The result is the profile with the least ``D`` among those that meet every hard requirement. If none does, it is the
declared best-effort profile, or else the profile with the least (largest weighted hard shortfall, ``D``, cost). In a
tie the profile that was declared first is chosen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.resource.declare.profiles import check_profiles

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.profiles import Profile
    from rmpa.resource.declare.requirements import Bound

EPSILON: Final = 1e-3
"""What one unit of cost adds to the distance: cost decides among profiles of nearly equal shortfall."""
_FEW: Final = 3
"""If fewer than one in so many profiles is feasible, distances are computed one by one, else all at once."""
_MISSING: Final = 1.0
"""Shortfall of a profile that does not offer the attribute, or that offers another word: the whole range."""


@dataclass(frozen=True, slots=True)
class Term:
    """One attribute's part in a profile's distance.

    Args:
        attribute: Name of the attribute.
        wanted: The requested bound, as a text for people.
        offered: The profile's value; ``None`` if it offers none.
        delta: The relative shortfall; 0 if the request is met.
        weight: Weight of the attribute, above 0.
        hard: Whether a shortfall makes the profile infeasible.
    """

    attribute: str
    wanted: str
    offered: Value | None
    delta: float
    weight: float
    hard: bool

    @property
    def met(self) -> bool:
        """Whether the profile satisfies the request."""
        return self.delta == 0.0


@dataclass(frozen=True, slots=True)
class ProfileScore:
    """How well one profile serves the requirements.

    Args:
        profile: Name of the profile.
        distance: The profile's ``D`` (see the module).
        hard_shortfall: The largest weighted shortfall of a hard requirement; 0: all are met.
        excluded: Why the profile is excluded (a precondition, a cool-down); empty: it is not.
        terms: The parts of the distance, in the order of the requested attributes.
    """

    profile: str
    distance: float
    hard_shortfall: float
    excluded: str = ""
    terms: tuple[Term, ...] = ()

    @property
    def feasible(self) -> bool:
        """Whether the profile meets every hard requirement and is not excluded."""
        return self.hard_shortfall == 0.0 and not self.excluded


@dataclass(frozen=True, slots=True)
class ProfileDecision:
    """The profile that serves best.

    Args:
        profile: Name of the profile; empty if all are excluded.
        distance: The profile's ``D`` (see the module); infinite if all are excluded.
        feasible: Whether the profile meets every hard requirement; if not, this is a non-adaptable event.
        best_effort: Whether it was chosen because it is the declared best-effort profile.
    """

    profile: str
    distance: float
    feasible: bool
    best_effort: bool = False


class _Column:
    """The shortfalls of all profiles in one attribute.

    Args:
        bound: The requested bound.
        deltas: The shortfall of each profile, in order of declaration.
    """

    __slots__ = ("_squares", "bound", "deltas")

    def __init__(self, bound: Bound, deltas: list[float]) -> None:
        self.bound = bound
        self.deltas = deltas
        self._squares: list[float] | None = None

    @property
    def weighted(self) -> list[float]:
        """Each shortfall times the bound's weight."""
        weight = self.bound.weight
        return self.deltas if weight == 1 else [weight * delta for delta in self.deltas]

    @property
    def squares(self) -> list[float]:
        """Each squared shortfall times the bound's weight; computed when first needed, because few decisions do."""
        if self._squares is None:
            weight = self.bound.weight
            if weight == 1:
                self._squares = [delta * delta for delta in self.deltas]
            else:
                self._squares = [weight * delta * delta for delta in self.deltas]
        return self._squares


class Decider:
    """Decides among one resource's profiles; values that all decisions share are computed once.

    Args:
        resource: Name of the resource, for errors.
        attributes: The attributes that clients may request, by name.
        profiles: The declared profiles, in order of declaration.

    Raises:
        ConfigError: The profiles are invalid; see ``check_profiles``.
    """

    def __init__(self, resource: str, attributes: Mapping[str, Attribute], profiles: Sequence[Profile]) -> None:
        check_profiles(profiles, attributes, resource)
        self._resource = resource
        self._attributes = attributes
        self._profiles = {profile.name: profile for profile in profiles}
        self._costs = [EPSILON * profile.cost for profile in profiles]
        self._places: dict[str, list[float | None]] = {}
        self._spans: dict[str, float] = {}
        self._known: dict[str, list[float]] = {}
        """The profiles' positions on the scale of each attribute that all profiles offer, by attribute."""
        self._columns: dict[str, _Column] = {}
        for name, attribute in attributes.items():
            places = [attribute.position(p.offers[name]) if name in p.offers else None for p in profiles]
            known = [place for place in places if place is not None]
            self._places[name] = places
            if len(known) == len(places):
                self._known[name] = known
            span = attribute.tolerated_distance
            self._spans[name] = span if span is not None else (max(known) - min(known) if known else 0.0)
        self._offered = {name for profile in profiles for name in profile.offers}
        self._best_effort = next((profile.name for profile in profiles if profile.best_effort), "")

    @property
    def profiles(self) -> Sequence[str]:
        """The profiles' names, in order of declaration."""
        return tuple(self._profiles)

    def profile(self, name: str) -> Profile:
        """The profile of this name.

        Raises:
            ConfigError: The resource has no profile of this name.
        """
        found = self._profiles.get(name)
        if found is None:
            near = did_you_mean(name, self._profiles)
            remedy = f"did you mean {near}?" if near else f"it has {', '.join(self._profiles)}"
            raise ConfigError(f"profile {name}", f"{self._resource} has no such profile", remedy)
        return found

    def decide(self, bounds: Mapping[str, Bound], excluded: Mapping[str, str] | None = None) -> ProfileDecision:
        """The profile that serves the requirements best.

        Args:
            bounds: The merged requirements by attribute; an undeclared attribute raises ``KeyError``.
            excluded: Profiles that may not be chosen, with the reasons.
        """
        columns = [self._column(name, bound) for name, bound in bounds.items()]
        reasons = excluded or {}
        allowed = [index for index, name in enumerate(self._profiles) if name not in reasons]
        names = self.profiles
        hard_deltas = [column.deltas for column in columns if column.bound.hard]
        fails = [*map(any, zip(*hard_deltas, strict=True))]  # a shortfall is above 0
        feasible = [index for index in allowed if not fails[index]] if fails else allowed
        if len(feasible) == 1 or (feasible and len(feasible) * _FEW < len(names)):
            near = {index: self._distance(index, columns) for index in feasible}
            best = min(feasible, key=near.__getitem__)
            return ProfileDecision(names[best], near[best], feasible=True)
        if feasible:
            distances = self._distances(columns)
            best = min(feasible, key=distances.__getitem__)
            return ProfileDecision(names[best], distances[best], feasible=True)
        if self._best_effort and self._best_effort not in reasons:
            best = names.index(self._best_effort)
            return ProfileDecision(names[best], self._distance(best, columns), feasible=False, best_effort=True)
        if not allowed:
            return ProfileDecision("", math.inf, feasible=False)
        distances, hard = self._judge(bounds)
        best = min(allowed, key=lambda index: (hard[index], distances[index], self._costs[index]))
        return ProfileDecision(names[best], distances[best], feasible=False)

    def explain(
        self, bounds: Mapping[str, Bound], excluded: Mapping[str, str] | None = None
    ) -> tuple[ProfileScore, ...]:
        """The score of every profile with all its terms, in order of declaration; arguments as for ``decide``."""
        distances, hard = self._judge(bounds)
        reasons = excluded or {}
        texts = {name: describe_bound(self._attributes[name], bound) for name, bound in bounds.items()}
        return tuple(
            ProfileScore(
                name,
                distances[index],
                hard[index],
                reasons.get(name, ""),
                self._terms(index, profile, texts, bounds),
            )
            for index, (name, profile) in enumerate(self._profiles.items())
        )

    def distance(self, name: str, bounds: Mapping[str, Bound]) -> float:
        """The distance ``D`` of one profile."""
        columns = [self._column(asked, bound) for asked, bound in bounds.items()]
        return self._distance(self.profiles.index(name), columns)

    def _judge(self, bounds: Mapping[str, Bound]) -> tuple[list[float], list[float]]:
        """The distance and the largest weighted hard shortfall of every profile, as two lists."""
        columns = [self._column(name, bound) for name, bound in bounds.items()]
        distances = self._distances(columns)
        hard = [column.weighted for column in columns if column.bound.hard]
        if not hard:
            return distances, [0.0] * len(self._profiles)
        return distances, [*map(max, zip(*hard, strict=True))] if len(hard) > 1 else hard[0]

    def _distances(self, columns: Sequence[_Column]) -> list[float]:
        """The distance ``D`` of every profile."""
        if not columns:
            return list(self._costs)
        scale = sum(column.bound.weight for column in columns)
        sums = map(sum, zip(*(column.squares for column in columns), strict=True))
        return [math.sqrt(total / scale) + cost for total, cost in zip(sums, self._costs, strict=True)]

    def _distance(self, index: int, columns: Sequence[_Column]) -> float:
        """The distance ``D`` of one profile, bit for bit equal to its value in ``_distances``."""
        if not columns:
            return self._costs[index]
        scale = sum(column.bound.weight for column in columns)
        total = sum(column.bound.weight * column.deltas[index] * column.deltas[index] for column in columns)
        return math.sqrt(total / scale) + self._costs[index]

    def _column(self, name: str, bound: Bound) -> _Column:
        """The column of an attribute; cached, because most bounds stay the same from one decision to the next."""
        known = self._columns.get(name)
        if known is not None and known.bound == bound:
            return known
        made = self._columns[name] = _Column(bound, self._deltas(name, bound))
        return made

    def _deltas(self, name: str, bound: Bound) -> list[float]:
        places, span = self._places[name], self._spans[name]
        if name not in self._offered:
            return [0.0] * len(places)  # no profile offers the attribute, so only measurements are judged
        if bound.words:
            words = self._attributes[name].words
            wanted = {float(words.index(word)) for word in bound.words}
            return [0.0 if place in wanted else _MISSING for place in places]
        low, high = bound.low, bound.high
        if span > 0:
            if (known := self._known.get(name)) is not None:  # a fast path for the usual case: half of the time
                if high == math.inf:
                    return [(low - place) / span if place < low else 0.0 for place in known]
                if low == -math.inf:
                    return [(place - high) / span if place > high else 0.0 for place in known]
            return [
                _MISSING
                if place is None
                else (low - place) / span
                if place < low
                else (place - high) / span
                if place > high
                else 0.0
                for place in places
            ]
        return [_MISSING if place is None or not low <= place <= high else 0.0 for place in places]

    def _terms(
        self, index: int, profile: Profile, texts: Mapping[str, str], bounds: Mapping[str, Bound]
    ) -> tuple[Term, ...]:
        return tuple(
            Term(
                name,
                texts[name],
                profile.offers.get(name),
                self._column(name, bound).deltas[index],
                bound.weight,
                bound.hard,
            )
            for name, bound in bounds.items()
        )


def describe_bound(attribute: Attribute, bound: Bound) -> str:
    """A bound as a text for people, such as ``at least 20 Hz``."""
    if bound.words:
        return " or ".join(word for word in attribute.words if word in bound.words)
    low = attribute.format(attribute.value_at(bound.low)) if bound.low > -math.inf else ""
    high = attribute.format(attribute.value_at(bound.high)) if bound.high < math.inf else ""
    if low == high:
        return f"exactly {low}"
    if low and high:
        return f"{low} to {high}"
    return f"at least {low}" if low else f"at most {high}"
