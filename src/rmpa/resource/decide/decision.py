"""Which profile fits: the decision with its reasons, violations, and the actions that carry it out.

Actions that the control loop returns to its driver: apply a profile, raise or clear an alarm, report a change.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError
from rmpa.resource.declare.parameters import check_profiles

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.parameters import Profile
    from rmpa.resource.declare.requirements import Bound


class AlarmKind(Enum):
    """The kind of an alarm, which determines its diagnostic level (REP 107)."""

    ADAPTATION = "adaptation"
    """A quality is violated, and another profile takes over: WARN."""
    NON_ADAPTABLE = "non_adaptable"
    """No profile meets the requirements; the most similar one runs: ERROR."""


@dataclass(frozen=True, slots=True)
class Shortfall:
    """One attribute that violates the requirements.

    Args:
        attribute: Name of the attribute.
        requested: The bound that is violated.
        offered: The measured value, or else the one that the profile declares; ``None``: there is neither.
    """

    attribute: str
    requested: Bound
    offered: Value | None


@dataclass(frozen=True, slots=True)
class Alarm:
    """An alarm, which is published to all clients.

    Args:
        kind: Adaptation or non-adaptable.
        shortfalls: The violated attributes.
        before: The profile that ran; empty: none.
        after: The profile that takes over; equal to ``before`` if that stays.
        at: When the alarm was raised, in monotonic seconds.
    """

    kind: AlarmKind
    shortfalls: tuple[Shortfall, ...]
    before: str
    after: str
    at: float


@dataclass(frozen=True, slots=True)
class Apply:
    """Apply this profile, then report ``applied`` or ``failed`` to the loop; ``why`` is a text for people."""

    profile: str
    why: str


@dataclass(frozen=True, slots=True)
class Raise:
    """Publish an alarm."""

    alarm: Alarm


@dataclass(frozen=True, slots=True)
class Clear:
    """Publish that an alarm is over."""

    alarm: Alarm


@dataclass(frozen=True, slots=True)
class Reacted:
    """A reconfiguration is complete.

    Args:
        profile: The profile that runs now.
        reaction: Seconds since the cause: a request, or the beginning of the first violated window.
    """

    profile: str
    reaction: float


Action = Apply | Raise | Clear | Reacted


# Finds the most similar profile: the one that serves the merged requirements best (paper, section 3.1).
#
# For each requested attribute, a profile's *shortfall* is the distance by which its value lies outside of the
# bound,
# divided by ``s``: the attribute's tolerance, or else its range over all profiles. Where that is 0, the shortfall
# is 0
# or 1. A value within the bound has no shortfall. A profile's *distance* ``D`` is the weighted root mean square of
# its
# shortfalls, plus a part of its cost::
#
#     delta = max(0, shortfall) / s        D = sqrt(sum(w * delta^2) / sum(w)) + EPSILON * cost
#
# The result is the profile with the least ``D`` among those that meet every hard requirement. If none does, it is
# the
# declared best-effort profile, or else the profile with the least (largest weighted hard shortfall, ``D``, cost).
# In a
# tie the profile that was declared first is chosen.


EPSILON: Final = 1e-3
"""What one unit of cost adds to the distance: cost decides among profiles of nearly equal shortfall."""
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


class Decider:
    """Decides among one resource's profiles.

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
        self._spans: dict[str, float] = {}
        """What a shortfall of 1 is on the scale of each attribute that a profile offers."""
        for name in {name for profile in profiles for name in profile.offers}:
            attribute = attributes[name]
            places = [attribute.position(profile.offers[name]) for profile in profiles if name in profile.offers]
            span = attribute.tolerated_distance
            self._spans[name] = span if span is not None else max(places) - min(places)

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
        scores = {score.profile: score for score in self.explain(bounds, excluded) if not score.excluded}
        if not scores:
            return ProfileDecision("", math.inf, feasible=False)
        if feasible := [score for score in scores.values() if score.feasible]:
            best = min(feasible, key=lambda score: score.distance)
            return ProfileDecision(best.profile, best.distance, feasible=True)
        if effort := next((score for name, score in scores.items() if self._profiles[name].best_effort), None):
            return ProfileDecision(effort.profile, effort.distance, feasible=False, best_effort=True)
        costs = {name: self._profiles[name].cost for name in scores}
        best = min(scores.values(), key=lambda one: (one.hard_shortfall, one.distance, costs[one.profile]))
        return ProfileDecision(best.profile, best.distance, feasible=False)

    def explain(
        self, bounds: Mapping[str, Bound], excluded: Mapping[str, str] | None = None
    ) -> tuple[ProfileScore, ...]:
        """The score of every profile with all its terms, in order of declaration; arguments as for ``decide``."""
        reasons = excluded or {}
        texts = {name: describe_bound(self._attributes[name], bound) for name, bound in bounds.items()}
        scale = sum(bound.weight for bound in bounds.values())
        found = []
        for name, profile in self._profiles.items():
            terms = tuple(
                Term(key, texts[key], offer, self._delta(key, bound, offer), bound.weight, bound.hard)
                for key, bound in bounds.items()
                for offer in (profile.offers.get(key),)
            )
            total = sum(term.weight * term.delta * term.delta for term in terms)
            distance = (math.sqrt(total / scale) if terms else 0.0) + EPSILON * profile.cost
            hard = max((term.weight * term.delta for term in terms if term.hard), default=0.0)
            found.append(ProfileScore(name, distance, hard, reasons.get(name, ""), terms))
        return tuple(found)

    def _delta(self, name: str, bound: Bound, offered: Value | None) -> float:
        """The shortfall of a profile in one attribute."""
        if name not in self._spans:
            return 0.0  # no profile offers the attribute, so only measurements are judged
        if offered is None:
            return _MISSING
        if bound.words:
            return 0.0 if offered in bound.words else _MISSING
        place, span = self._attributes[name].position(offered), self._spans[name]
        beyond = max(bound.low - place, place - bound.high)
        if beyond <= 0:
            return 0.0
        return beyond / span if span > 0 else _MISSING


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


# Detects disturbances: a quality that is violated in ``k`` of the last ``n`` windows.


EXPECTED: Final = 1.25
"""Factor by which a soft bound may be missed further than the profile declares, before it counts as violated."""


class ViolationDetector:
    """Judges windows of measured quality against the merged requirements, under one profile.

    Args:
        attributes: The resource's attributes, by name.
        violations: ``k``, the number of violated windows that are a disturbance.
        windows: ``n``, the number of last windows that are kept.
    """

    def __init__(self, attributes: Mapping[str, Attribute], violations: int, windows: int) -> None:
        self._attributes = attributes
        self._needed = violations
        self._windows: deque[tuple[float, tuple[Shortfall, ...]]] = deque(maxlen=windows)

    def clear(self) -> None:
        """Forget all windows, because the profile or the requirements have changed."""
        self._windows.clear()

    def add(
        self, began: float, measured: Mapping[str, Value], bounds: Mapping[str, Bound], offers: Mapping[str, Value]
    ) -> None:
        """Judge a window; attributes that were not measured are left out.

        Args:
            began: When the window began, in monotonic seconds.
            measured: Measured values by attribute.
            bounds: The merged requirements by attribute.
            offers: The declared quality of the profile that runs, by attribute.
        """
        self._windows.append(
            (
                began,
                tuple(
                    Shortfall(name, bound, measured[name])
                    for name, bound in bounds.items()
                    if name in measured and self._violates(name, bound, measured[name], offers.get(name))
                ),
            )
        )

    @property
    def violated(self) -> list[tuple[float, tuple[Shortfall, ...]]]:
        """The violated windows among the last ``n``, oldest first: when each began, and its shortfalls."""
        return [(began, short) for began, short in self._windows if short]

    @property
    def disturbed(self) -> bool:
        """Whether at least ``k`` of the last ``n`` windows are violated."""
        return len(self.violated) >= self._needed

    def _violates(self, name: str, bound: Bound, value: Value, offer: Value | None) -> bool:
        attribute = self._attributes[name]
        if bound.met_by(attribute, value):
            return False
        if bound.hard or offer is None or bound.met_by(attribute, offer):
            return True
        # The profile was chosen although it is declared to miss this soft bound; judge by how far it misses it.
        beyond, declared = bound.excess(attribute.position(value)), bound.excess(attribute.position(offer))
        return beyond > EXPECTED * declared
