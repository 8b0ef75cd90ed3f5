"""Which profile fits: the most similar one, with its reasons; shortfalls and alarms (paper, section 3.1). Pure.

For each requested attribute, a profile's *shortfall* is how far its value lies outside of the bound; a value within
the bound has none. ``delta`` is the shortfall divided by ``s``: the attribute's tolerance, or else its range over all
profiles; where that is 0, ``delta`` is 0 or 1. A profile's *distance* ``D`` is the weighted root mean square of its
deltas, plus a part of its cost::

    delta = max(0, shortfall) / s        D = sqrt(sum(w * delta^2) / sum(w)) + EPSILON * cost

The result is the profile with the least ``D`` among those that meet every hard requirement. If none does, it is the
declared best-effort profile, or else the profile with the least (largest weighted hard shortfall, ``D``, cost). In a
tie the profile that was declared first is chosen.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass, field
from enum import Enum, StrEnum
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.config.values import suggestion
from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.quality import Attribute, Bound, Scale, Value

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence

    from rmpa.resource.expression import Expression

# What one unit of cost adds to the distance: cost decides among profiles of nearly equal shortfall.
EPSILON: Final = 1e-3
# Shortfall of a profile that does not offer the attribute, or that offers another word: the whole range.
_MISSING: Final = 1.0
# Factor by which a soft bound may be missed further than the profile declares, before it counts as violated.
EXPECTED: Final = 1.25
# A learnt value that differs from the declared one by more than this part of it is told in reasons.
_NOTABLE: Final = 0.05


class OfferSource(StrEnum):
    """By which offers profiles are compared."""

    DECLARED = "declared"
    LEARNT = "learnt"


@dataclass(frozen=True, slots=True)
class Profile:
    """One System Profile: a configuration of the resource, with the quality that it offers (paper, section 3.1).

    Args:
        name: Unique within the resource.
        offers: The offered value of each attribute, in the attribute's unit. An attribute that only other profiles
            offer falls short of every request.
        cost: At least 0, in any unit that all profiles share; decides among profiles of nearly equal distance.
        best_effort: Whether the profile runs when none meets the requirements; a resource has at most one such.
        description: A text for people.
        apply: The function that applies it.
        needs: The precondition: true or ``None`` while the profile may be used, else false or the reason as a text.
        sets: The values of parameters that it sets, by name, before ``apply``.
        nodes: The declared nodes that must run in it, besides those that always run.
        rule: The rule that must not be false while the profile is used; ``None``: any.
    """

    name: str
    offers: Mapping[str, Value] = field(hash=False)
    cost: float = 0.0
    best_effort: bool = False
    description: str = ""
    apply: Callable[[], Awaitable[None] | None] = lambda: None
    needs: Callable[[], str | bool | None] | None = None
    sets: Mapping[str, bool | int | float | str] = field(default_factory=dict, hash=False)
    nodes: tuple[str, ...] = ()
    rule: Expression | None = None


class LearntOffer(msgspec.Struct, frozen=True):
    """What a profile has given of one attribute.

    Attributes:
        median: Of the last windows that were judged, at most ``limits.LEARNT_WINDOWS``.
        spread: From the first to the third quartile.
        n: The number of windows.
    """

    median: float
    spread: float
    n: int

    @property
    def enough(self) -> bool:
        """Whether there are enough windows to compare profiles by it."""
        return self.n >= limits.LEARNT_LEAST


class LearntOffers:
    """The learnt offers of one resource's profiles, of the attributes that a profile declares.

    Args:
        profiles: The declared profiles.
    """

    def __init__(self, profiles: Iterable[Profile]) -> None:
        self._windows: dict[str, dict[str, deque[float]]] = {
            one.name: {
                name: deque(maxlen=limits.LEARNT_WINDOWS)
                for name, value in one.offers.items()
                if not isinstance(value, str)
            }
            for one in profiles
        }
        # By profile and attribute; brought up to date every ``LEARNT_LEAST`` windows, so that it rarely changes.
        self.offers: dict[str, dict[str, LearntOffer]] = {}
        # The values to keep, by profile and attribute.
        self.saved: dict[str, dict[str, list[float]]] = {}
        self._since = 0

    def restore(self, saved: Mapping[str, Mapping[str, list[float]]]) -> None:
        """Take over the values that were kept before a restart; those of attributes not declared now are dropped."""
        for profile, found in self._windows.items():
            for name, values in found.items():
                values.extend(saved.get(profile, {}).get(name, ()))
        self.update()

    def window(self, profile: str, measured: Mapping[str, Value]) -> None:
        """Take the values of a window that was judged while the profile ran."""
        for name, values in self._windows[profile].items():
            value = measured.get(name)
            if value is not None and not isinstance(value, str):
                values.append(float(f"{value:.6g}"))
        self._since += 1
        if self._since % limits.LEARNT_LEAST == 0:
            self._summarize()
        if self._since % limits.LEARNT_WINDOWS == 0:
            self.update()

    def update(self) -> None:
        """Bring all up to date: another profile runs, or the resource ends."""
        self._summarize()
        self.saved = {
            profile: {name: list(values) for name, values in found.items() if values}
            for profile, found in self._windows.items()
            if any(found.values())
        }

    def _summarize(self) -> None:
        self.offers = {
            profile: {name: _summary(values) for name, values in found.items() if values}
            for profile, found in self._windows.items()
            if any(found.values())
        }


def _summary(values: deque[float]) -> LearntOffer:
    quartiles = statistics.quantiles(values, n=4, method="inclusive") if len(values) > 1 else [0.0, 0.0, 0.0]
    return LearntOffer(statistics.median(values), quartiles[2] - quartiles[0], len(values))


@dataclass(frozen=True, slots=True)
class Term:
    """One attribute's part in a profile's distance.

    Args:
        attribute: Name of the attribute.
        wanted: The requested bound, as a text for people.
        offered: The profile's value by which it is compared; ``None`` if it offers none.
        delta: The relative shortfall; 0 if the request is met.
        weight: Weight of the attribute, above 0.
        hard: Whether a shortfall makes the profile infeasible.
        learnt: What the profile has given of it; ``None``: it has not run yet.
    """

    attribute: str
    wanted: str
    offered: Value | None
    delta: float
    weight: float
    hard: bool
    learnt: LearntOffer | None = None


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


class Decider:
    """Decides among one resource's profiles.

    Args:
        resource: Name of the resource, for errors.
        attributes: The attributes that clients may request, by name.
        profiles: The declared profiles, in order of declaration.
        learnt: What profiles have given.
        by_learnt: Whether profiles are compared by that, where there are enough windows.
    """

    def __init__(
        self,
        resource: str,
        attributes: Mapping[str, Attribute],
        profiles: Sequence[Profile],
        learnt: LearntOffers | None = None,
        *,
        by_learnt: bool = False,
    ) -> None:
        self._resource = resource
        self._learnt = learnt if learnt is not None else LearntOffers(profiles)
        self._by_learnt = by_learnt
        self._attributes = attributes
        self.profiles = {profile.name: profile for profile in profiles}
        # What a shortfall of 1 is on the scale of each attribute that a profile offers.
        self._spans: dict[str, float] = {}
        for name in {name for profile in profiles for name in profile.offers}:
            attribute = attributes[name]
            places = [attribute.position(profile.offers[name]) for profile in profiles if name in profile.offers]
            span = attribute.tolerance
            if span is None:
                self._spans[name] = max(places) - min(places)
            else:
                self._spans[name] = math.log(span) if attribute.scale is Scale.LOG else span

    def profile(self, name: str) -> Profile:
        """The profile of this name.

        Raises:
            ConfigError: The resource has no profile of this name.
        """
        found = self.profiles.get(name)
        if found is None:
            remedy = suggestion(name, self.profiles, f"it has {', '.join(self.profiles)}")
            raise ConfigError(f"profile {name}", f"{self._resource} has no such profile", remedy)
        return found

    def offers(self, name: str) -> Mapping[str, Value]:
        """The offers by which a profile is compared: those declared, or learnt."""
        offers = self.profiles[name].offers
        if not self._by_learnt or not (learnt := self._learnt.offers.get(name)):
            return offers
        return {**offers, **{key: one.median for key, one in learnt.items() if one.enough}}

    def learnt_text(self, bounds: Mapping[str, Bound], *profiles: str) -> str:
        """What was learnt of profiles, and differs from their declarations, as an addition to a reason; or empty."""
        found = []
        for name in profiles if self._by_learnt else ():
            offers = self.offers(name) if name else {}
            for key in bounds.keys() & offers.keys():
                declared, value = self.profiles[name].offers[key], offers[key]
                if not isinstance(value, str) and abs(value - float(declared)) > _NOTABLE * abs(float(declared)):
                    show = self._attributes[key].format
                    found.append(f"{name} has given {key} {show(value)}, declared {show(declared)}")
        return f" (learnt: {'; '.join(sorted(found))})" if found else ""

    def decide(self, bounds: Mapping[str, Bound], excluded: Mapping[str, str] | None = None) -> ProfileScore | None:
        """The profile that serves the requirements best; ``None`` if all are excluded.

        Args:
            bounds: The merged requirements by attribute; an undeclared attribute raises ``KeyError``.
            excluded: Profiles that may not be chosen, with the reasons.
        """
        scores = [score for score in self.explain(bounds, excluded) if not score.excluded]
        if feasible := [score for score in scores if score.feasible]:
            return min(feasible, key=lambda score: score.distance)
        if effort := next((score for score in scores if self.profiles[score.profile].best_effort), None):
            return effort
        costs = {name: profile.cost for name, profile in self.profiles.items()}
        return min(scores, key=lambda one: (one.hard_shortfall, one.distance, costs[one.profile]), default=None)

    def explain(
        self, bounds: Mapping[str, Bound], excluded: Mapping[str, str] | None = None
    ) -> tuple[ProfileScore, ...]:
        """The score of every profile with all its terms, in order of declaration; arguments as for ``decide``."""
        reasons = excluded or {}
        texts = {name: bound.describe(self._attributes[name]) for name, bound in bounds.items()}
        scale = sum(bound.weight for bound in bounds.values())
        found = []
        for name, profile in self.profiles.items():
            offers, learnt = self.offers(name), self._learnt.offers.get(name, {})
            terms = tuple(
                Term(
                    key, texts[key], offer, self._delta(key, bound, offer), bound.weight, bound.hard, learnt.get(key)
                )
                for key, bound in bounds.items()
                for offer in (offers.get(key),)
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
        beyond, span = bound.excess(self._attributes[name].position(offered)), self._spans[name]
        if not beyond:
            return 0.0
        return beyond / span if span > 0 else _MISSING


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


def find_shortfalls(
    attributes: Mapping[str, Attribute],
    measured: Mapping[str, Value],
    bounds: Mapping[str, Bound],
    offers: Mapping[str, Value],
) -> tuple[Shortfall, ...]:
    """The attributes that violate the requirements in one window; those that were not measured are left out.

    A profile may have been chosen although it is declared to miss a soft bound. Then only a measurement that misses
    it by ``EXPECTED`` times as much violates it.

    Args:
        attributes: The resource's attributes, by name.
        measured: Measured values by attribute.
        bounds: The merged requirements by attribute.
        offers: The declared quality of the profile that runs, by attribute.
    """

    def violates(name: str, bound: Bound) -> bool:
        attribute, value, offer = attributes[name], measured[name], offers.get(name)
        if bound.met_by(attribute, value):
            return False
        if bound.hard or offer is None or bound.met_by(attribute, offer):
            return True
        beyond, declared = bound.excess(attribute.position(value)), bound.excess(attribute.position(offer))
        return beyond > EXPECTED * declared

    return tuple(
        Shortfall(name, bound, measured[name])
        for name, bound in bounds.items()
        if name in measured and violates(name, bound)
    )


class AlarmKind(Enum):
    """The kind of an alarm, which determines its diagnostic level (REP 107)."""

    # A quality is violated, and another profile takes over: WARN.
    ADAPTATION = "adaptation"
    # No profile meets the requirements; the most similar one runs: ERROR.
    NON_ADAPTABLE = "non_adaptable"


@dataclass(frozen=True, slots=True)
class Alarm:
    """An alarm, which is published to all clients.

    Args:
        kind: Adaptation or non-adaptable.
        shortfalls: The violated attributes.
        before: The profile that ran; empty: none.
        after: The profile that takes over; equal to ``before`` if that stays.
    """

    kind: AlarmKind
    shortfalls: tuple[Shortfall, ...]
    before: str
    after: str

    def __str__(self) -> str:
        """The alarm as a sentence."""
        names = ", ".join(short.attribute for short in self.shortfalls) or "the quality"
        if self.kind is AlarmKind.ADAPTATION:
            return f"adaptation: {names} fell short under {self.before}; {self.after} takes over"
        return f"non-adaptable: no profile gives {names} as asked; {self.after} is the best there is"
