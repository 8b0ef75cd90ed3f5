"""The control loop of a Smart Resource: derives a profile from requirements and measurements (paper, section 3.1).

The loop follows MAPE-K and does no I/O: *monitor* takes each window of measured quality, *analyse* compares it with
the merged requirements (``violations``), *plan* is ``decision.Decider``, *execute* is done by the driver, which
reports the outcome. The states::

    NONE ──decided──► APPLYING ──applied──► ACTIVE ──another profile is better──► APPLYING
                       │  ▲                    │
                       │  └─ next best ◄───────┘ violated
                       └─ failed: excluded for a cool-down; the next best profile is applied

A profile that hangs (``hung``) is excluded for its cool-down too, and the driver ends the resource.

A disturbance is a violation in ``k`` of the last ``n`` windows. If another profile meets the requirements, that is an
*adaptation event* (WARN): the violated profile is excluded for its cool-down and the other one is applied. If none
does, it is a *non-adaptable event* (ERROR): the best-effort profile runs if one is declared, else the profile stays.
Without a disturbance the profile changes only for an improvement of more than ``improvement``, and not before
``dwell`` seconds, so that two nearly equal profiles do not alternate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import LocalProtocolError, PeerRefused
from rmpa.resource.decide.decision import (
    Action,
    Alarm,
    AlarmKind,
    Apply,
    Clear,
    Raise,
    Reacted,
    Shortfall,
    ViolationDetector,
)
from rmpa.resource.declare.parameters import AdaptationSettings
from rmpa.resource.declare.requirements import MergedRequirements, Requirement, merge

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.decide.decision import Decider, ProfileDecision, ProfileScore
    from rmpa.resource.declare.attributes import Attribute, Value


# Cool-downs: a profile that failed or was violated is excluded for a while, and for longer each time.


COOL_DOWN_GROWTH: Final = 2.0
"""Factor by which each cool-down of a profile is longer than the one before, up to ``cool_down_max``."""


@dataclass(slots=True)
class CoolDown:
    """The exclusion of one profile.

    Args:
        until: End of the cool-down, in monotonic seconds.
        cool_down: Length of the cool-down in seconds; the next one is longer, up to the maximum.
        why: The failure or violation, as a text for people.
    """

    until: float
    cool_down: float
    why: str


class CoolDowns:
    """The cool-downs of one resource's profiles.

    Args:
        first: Seconds of a profile's first cool-down.
        longest: Seconds of a profile's longest cool-down.
    """

    def __init__(self, first: float, longest: float) -> None:
        self._first = first
        self._longest = longest
        self._known: dict[str, CoolDown] = {}
        """The last cool-down by profile. One that is over has an infinite ``until`` and is kept for its length, from
        which the length of the next one is computed."""

    def restore(self, before: Mapping[str, CoolDown], now: float) -> None:
        """Continue the cool-downs that were saved before a restart, bounded by the present settings."""
        for name, one in before.items():
            cool_down = min(one.cool_down, self._longest)
            self._known[name] = CoolDown(min(one.until, now + cool_down), cool_down, one.why)

    def begin(self, profile: str, why: str, now: float) -> None:
        """Begin a cool-down, for which the profile is excluded."""
        before = self._known.get(profile)
        cool_down = self._first if before is None else min(before.cool_down * COOL_DOWN_GROWTH, self._longest)
        self._known[profile] = CoolDown(now + cool_down, cool_down, why)

    def reset(self, profile: str) -> None:
        """End a profile's cool-down; its next one has the length of the first again."""
        self._known.pop(profile, None)

    def active(self, now: float) -> dict[str, CoolDown]:
        """The cool-downs that are not over, by profile."""
        return {name: replace(one) for name, one in self._known.items() if now < one.until < math.inf}

    def next_timer(self) -> float:
        """When the next cool-down ends, in monotonic seconds; infinite: none is under way."""
        return min((one.until for one in self._known.values()), default=math.inf)

    def handle_timer(self, now: float) -> None:
        """End the cool-downs that are over."""
        for one in self._known.values():
            if one.until <= now:
                one.until = math.inf


class ProfileState(Enum):
    """State of the control loop."""

    NONE = auto()
    """No profile runs or is being applied: nothing was decided yet, or every profile is excluded."""
    APPLYING = auto()
    ACTIVE = auto()


class Adaptation:
    """The control loop of one resource. Times are monotonic seconds.

    Args:
        attributes: The attributes that clients may request, by name.
        decider: Decides among the resource's profiles.
        settings: Parameters of the loop; ``None``: the defaults.
    """

    def __init__(
        self, attributes: Mapping[str, Attribute], decider: Decider, settings: AdaptationSettings | None = None
    ) -> None:
        self._attributes = attributes
        self._decider = decider
        self._settings = settings = settings if settings is not None else AdaptationSettings()
        self._requirements: dict[str, Requirement] = {}
        self._merged = MergedRequirements()
        self._blocked: dict[str, str] = {}
        """Why a profile is blocked by its precondition or by the context, by profile."""
        self._cool_downs = CoolDowns(settings.cool_down, settings.cool_down_max)
        self._detector = ViolationDetector(attributes, settings.violations, settings.windows)
        self._state = ProfileState.NONE
        self._profile = ""
        self._target = ""
        self._pinned = ""
        self._restored_profile = ""
        """The profile that ran before the restart; empty after the first decision."""
        self._active_since = -math.inf
        self._window_end: float | None = None
        self._cause = math.inf
        """When the cause of the present reconfiguration began; infinite: no reconfiguration is under way."""
        self._alarm: Alarm | None = None
        self._replan_at_once = False
        """Whether a change that skips the dwell time has occurred while a profile was being applied."""

    @property
    def state(self) -> ProfileState:
        """The present state of the loop."""
        return self._state

    @property
    def profile(self) -> str:
        """The profile that runs, or that ran before the one that is being applied; empty: none."""
        return self._profile

    @property
    def applying(self) -> str:
        """The profile that is being applied; empty: none."""
        return self._target

    @property
    def pinned(self) -> str:
        """The profile that was chosen by hand; empty: the loop decides."""
        return self._pinned

    @property
    def alarm(self) -> Alarm | None:
        """The alarm that is raised at present; ``None``: none is."""
        return self._alarm

    @property
    def merged(self) -> MergedRequirements:
        """The requirements of all clients, merged."""
        return self._merged

    @property
    def requirements(self) -> Mapping[str, Requirement]:
        """The requirement of each client, by client."""
        return self._requirements

    def explain(self, now: float) -> tuple[ProfileScore, ...]:
        """The present score of each profile, with the reason if the profile is excluded."""
        return self._decider.explain(self._merged.bounds, self._excluded(now))

    # --- requirements -------------------------------------------------------------------------------------------

    def restore(
        self, requirements: Iterable[Requirement], profile: str, cool_downs: Mapping[str, CoolDown], now: float
    ) -> None:
        """Take over the state that was saved before a restart; must be called before ``start``.

        Args:
            requirements: The requirements that were in force.
            profile: The profile that ran; it is chosen again if it is about as good as the best one.
            cool_downs: The cool-downs that were not over, by profile.
            now: The time of the call.
        """
        self._cool_downs.restore(cool_downs, now)
        self._requirements = {requirement.client: requirement for requirement in requirements}
        self._merged = merge(self._requirements.values())
        self._restored_profile = profile

    def cooling(self, now: float) -> dict[str, CoolDown]:
        """The cool-downs of profiles that are excluded because they failed or were violated, by profile."""
        return self._cool_downs.active(now)

    def start(self, now: float) -> list[Action]:
        """Choose the first profile."""
        return self._plan(now, "the resource starts")

    def require(self, requirement: Requirement, now: float) -> list[Action]:
        """Set a client's requirement, in place of its previous one."""
        self._requirements[requirement.client] = requirement
        return self._requirements_changed(now, f"{requirement.client} asks for a quality")

    def release(self, client: str, now: float) -> list[Action]:
        """Drop a client's requirement.

        Raises:
            PeerRefused: The client has no requirement.
        """
        if self._requirements.pop(client, None) is None:
            raise PeerRefused("the resource", f"{client} has asked for nothing here")
        return self._requirements_changed(now, f"{client} asks for nothing any more")

    def block(self, blocked: Mapping[str, str], now: float) -> list[Action]:
        """Set the profiles that preconditions or the context block, with the reasons; all others are allowed."""
        if blocked == self._blocked:
            return []
        self._blocked = dict(blocked)
        return self._plan(now, "the preconditions of profiles have changed")

    def pin(self, profile: str, now: float, *, restored: bool = False) -> list[Action]:
        """Run this profile whatever is requested; an empty name lets the loop decide again.

        Args:
            profile: Name of the profile, or empty.
            now: The time of the call.
            restored: Whether the choice was made before a restart; the profile's cool-down continues then. A new
                choice ends the cool-down, since its cause may have been removed.

        Raises:
            ConfigError: The resource has no profile of this name.
        """
        if profile:
            self._decider.profile(profile)
            if not restored:
                self._cool_downs.reset(profile)
        self._pinned = profile
        why = f"{profile} was chosen by hand" if profile else "the choice by hand is over"
        return self._plan(now, why, at_once=True)

    def reconsider(self, why: str, now: float) -> list[Action]:
        """Choose the best profile without hysteresis and dwell time, because the context has changed."""
        return self._plan(now, why, at_once=True)

    # --- measurements -------------------------------------------------------------------------------------------

    def window(self, measured: Mapping[str, Value], now: float) -> list[Action]:
        """Judge a window of measured quality that ends now.

        The window is ignored unless it began at least ``settle`` seconds after the active profile was applied.
        """
        began = max(self._window_end, self._active_since) if self._window_end is not None else now
        self._window_end = now
        if self._state is not ProfileState.ACTIVE or began < self._active_since + self._settings.settle:
            return []
        detector = self._detector
        detector.add(began, measured, self._merged.bounds, self._decider.profile(self._profile).offers)
        if detector.disturbed and not self._pinned:
            return self._disturbed(detector.violated[0][0], detector.violated[-1][1], now)
        if not detector.violated:
            actions = self._plan(now, "a better profile can be taken")
            if self._pinned_or_best(now).feasible:  # otherwise an attribute that was not measured may fall short
                actions += self._clear_alarm()
            return actions
        return []

    def _disturbed(self, since: float, short: tuple[Shortfall, ...], now: float) -> list[Action]:
        """React to a disturbance under the active profile: choose another profile, or raise an alarm."""
        why = f"{', '.join(s.attribute for s in short)} fell short"
        others = self._excluded(now) | {self._profile: "it does not give what is asked"}
        decision = self._decider.decide(self._merged.bounds, others)
        if decision.feasible:
            self._cool_downs.begin(self._profile, why, now)
            alarm = Alarm(AlarmKind.ADAPTATION, short, self._profile, decision.profile, now)
            return [*self._raise_alarm(alarm), *self._apply(decision.profile, why, since)]
        # No other profile meets the requirements: this one stays, unless a best-effort profile is declared.
        after = decision if decision.best_effort else self._decider.decide(self._merged.bounds, self._excluded(now))
        actions: list[Action] = []
        if not self._non_adaptable:
            alarm = Alarm(AlarmKind.NON_ADAPTABLE, short, self._profile, after.profile, now)
            actions += self._raise_alarm(alarm)
        if decision.best_effort and decision.profile != self._profile:
            self._cool_downs.begin(self._profile, why, now)
            actions += self._apply(decision.profile, "none can serve: best effort", since)
        return actions

    # --- reports of the driver ----------------------------------------------------------------------------------

    def applied(self, profile: str, now: float) -> list[Action]:
        """Report that the profile has been applied; ignored unless it is the one that is being applied."""
        if self._state is not ProfileState.APPLYING or profile != self._target:
            return []
        self._state = ProfileState.ACTIVE
        self._profile, self._target = profile, ""
        self._active_since = now
        self._detector.clear()
        reaction = max(0.0, now - self._cause)
        at_once, self._replan_at_once = self._replan_at_once, False
        self._cause = math.inf
        planned = self._plan(now, "what is asked has changed meanwhile", at_once=at_once)
        return [Reacted(profile, reaction), *planned]

    def failed(self, profile: str, why: str, now: float) -> list[Action]:
        """Report that the profile could not be applied; the next best profile is applied instead.

        The report is ignored unless the profile is the one that is being applied.
        """
        if self._state is not ProfileState.APPLYING or profile != self._target:
            return []
        self._cool_downs.begin(profile, why, now)
        self._state = ProfileState.ACTIVE if self._profile else ProfileState.NONE
        self._target = ""
        # The failed profile may be partly in force, so even the profile that ran before is applied again.
        return self._plan(now, f"{profile} failed: {why}", again=True)

    def hung(self, profile: str, why: str, now: float) -> None:
        """Begin the cool-down of a profile whose function hangs, so that the restarted resource tries another one."""
        self._cool_downs.begin(profile, why, now)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due; ``None``: no timer runs."""
        expiries = (r.expires for r in self._requirements.values() if r.expires is not None)
        first = min(self._cool_downs.next_timer(), min(expiries, default=math.inf))
        return None if first == math.inf else first

    def handle_timer(self, now: float) -> list[Action]:
        """Handle what is due: requirements that expire, cool-downs that end."""
        over = [c for c, r in self._requirements.items() if r.expires is not None and r.expires <= now]
        for client in over:
            del self._requirements[client]
        self._cool_downs.handle_timer(now)
        why = f"what {', '.join(over)} asked for has expired"
        if over and (actions := self._requirements_changed(now, why)):
            return actions
        return self._plan(now, "a profile's cool-down is over")

    # --- planning -----------------------------------------------------------------------------------------------

    def _requirements_changed(self, now: float, why: str) -> list[Action]:
        before, self._merged = self._merged.bounds, merge(self._requirements.values())
        if self._merged.bounds == before and self._state is not ProfileState.NONE:
            return []  # a repetition (`rostopic pub -r`) must neither hide a disturbance nor skip the dwell time
        for name in self._merged.bounds:
            if name not in self._attributes:
                raise LocalProtocolError(f"a bound of {name}, which is no attribute; check it before it comes here")
        self._detector.clear()
        return self._plan(now, why, at_once=True)

    def _plan(self, now: float, why: str, *, at_once: bool = False, again: bool = False) -> list[Action]:
        """Apply another profile if the change is worth it.

        Args:
            now: The time of the call.
            why: The reason for planning, for people.
            at_once: Whether to skip hysteresis and dwell time: requirements, context or choice have changed.
            again: Whether to apply the decided profile even if it runs already.
        """
        if self._state is ProfileState.APPLYING:
            self._replan_at_once |= at_once
            return []  # ``applied`` or ``failed`` plans again
        decision = self._prefer_restored(self._pinned_or_best(now), now)
        if not decision.profile:
            self._state, self._profile = ProfileState.NONE, ""
            return []
        actions = self._update_alarm(decision, now)
        if decision.profile == self._profile and not again:
            return actions
        if not again and not at_once and not self._worth_it(decision, now):
            return actions
        return [*actions, *self._apply(decision.profile, why, now)]

    def _pinned_or_best(self, now: float) -> ProfileDecision:
        excluded = self._excluded_by_failure(now)
        if not self._pinned or self._pinned in excluded:
            # A pinned profile that failed is tried again after its cool-down.
            return self._decider.decide(self._merged.bounds, excluded | self._blocked)
        others = {name: "another one was chosen by hand" for name in self._decider.profiles if name != self._pinned}
        return self._decider.decide(self._merged.bounds, others)

    def _prefer_restored(self, decision: ProfileDecision, now: float) -> ProfileDecision:
        """At the first decision after a restart, keep the profile that ran before unless a change is worth it."""
        before, self._restored_profile = self._restored_profile, ""
        if not before or self._pinned or before == decision.profile or before in self._excluded(now):
            return decision
        score, best = self._score(before, now), self._score(decision.profile, now)
        if score.feasible != best.feasible or score.distance - best.distance > self._settings.improvement:
            return decision
        return replace(decision, profile=before)

    def _worth_it(self, decision: ProfileDecision, now: float) -> bool:
        """Whether a change is worth it while the requirements stay the same: applies hysteresis and dwell time."""
        if not self._profile or self._profile in self._excluded(now) or self._pinned:
            return True
        current = self._score(self._profile, now)
        if decision.feasible and not current.feasible:
            return True
        if now - self._active_since < self._settings.dwell:
            return False
        return current.distance - decision.distance > self._settings.improvement

    def _update_alarm(self, decision: ProfileDecision, now: float) -> list[Action]:
        """Raise the non-adaptable alarm if even the decided profile's offers fall short; else clear it."""
        if decision.feasible:
            return self._clear_alarm() if self._non_adaptable and not self._detector.violated else []
        if self._non_adaptable or self._pinned:
            return []
        offers = self._decider.profile(decision.profile).offers
        short = tuple(
            Shortfall(term.attribute, self._merged.bounds[term.attribute], offers.get(term.attribute))
            for term in self._score(decision.profile, now).terms
            if term.hard and not term.met
        )
        return self._raise_alarm(Alarm(AlarmKind.NON_ADAPTABLE, short, self._profile, decision.profile, now))

    def _apply(self, profile: str, why: str, cause: float) -> list[Action]:
        self._state = ProfileState.APPLYING
        self._target = profile
        self._cause = min(self._cause, cause)
        return [Apply(profile, why)]

    def _score(self, profile: str, now: float) -> ProfileScore:
        return next(score for score in self.explain(now) if score.profile == profile)

    def _excluded(self, now: float) -> dict[str, str]:
        """All profiles that may not be chosen, with the reasons."""
        return self._excluded_by_failure(now) | self._blocked

    def _excluded_by_failure(self, now: float) -> dict[str, str]:
        return {name: one.why for name, one in self.cooling(now).items()}

    @property
    def _non_adaptable(self) -> bool:
        return self._alarm is not None and self._alarm.kind is AlarmKind.NON_ADAPTABLE

    def _raise_alarm(self, alarm: Alarm) -> list[Action]:
        before, self._alarm = self._alarm, alarm
        return [Raise(alarm)] if before is None else [Clear(before), Raise(alarm)]

    def _clear_alarm(self) -> list[Action]:
        if self._alarm is None:
            return []
        alarm, self._alarm = self._alarm, None
        self._cool_downs.reset(self._profile)  # its quality is good again, so its next cool-down is the shortest
        return [Clear(alarm)]
