"""The control loop of a Smart Resource: derives a profile from requirements and measurements (paper, section 3.1).

The loop follows MAPE-K and does no I/O: *monitor* takes each window of measured quality, *analyse* compares it with
the merged requirements (``find_shortfalls``), *plan* is ``Decider``, *execute* is done by the driver, which reports
the outcome. The states are told by ``profile`` and ``applying``::

    NONE ──decided──► APPLYING ──applied──► ACTIVE ──another profile is better──► APPLYING
                       │  ▲                    │
                       │  └─ next best ◄───────┘ violated
                       └─ failed: excluded for a cool-down; the next best profile is applied

A profile that hangs is excluded for its cool-down too, and the driver ends the resource.

A disturbance is a violation in ``k`` of the last ``n`` windows. If another profile meets the requirements, that is an
*adaptation event* (WARN): the violated profile is excluded for its cool-down and the other one is applied. If none
does, it is a *non-adaptable event* (ERROR): the best-effort profile runs if one is declared, else the profile stays.
Without a disturbance the profile changes only for an improvement of more than ``improvement``, and not before
``dwell`` seconds, so that two nearly equal profiles do not alternate.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from rmpa.core.errors import ConfigError
from rmpa.resource.decision import Alarm, AlarmKind, Decider, OfferSource, ProfileScore, Shortfall, find_shortfalls
from rmpa.resource.quality import Attribute, Bound, Requirement, Value, merge

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


# Factor by which each cool-down of a profile is longer than the one before, up to ``cool_down_max``.
COOL_DOWN_GROWTH: Final = 2.0


# The least value in seconds of each time of the control loop, and the greatest of all.
_LEAST: Final = {"window": 0.05, "dwell": 0.0, "settle": 0.0, "cool_down": 0.0, "apply_timeout": 0.01}
_DAY: Final = 86400


@dataclass(frozen=True, slots=True)
class AdaptationSettings:
    """Parameters of the control loop.

    Args:
        violations: ``k``: the number of violated windows among the last ``windows`` that is a disturbance.
        windows: ``n``: the number of last windows that are considered.
        improvement: ``h``: hysteresis; a change without a disturbance must reduce the distance by more than this.
        window: Length of a quality window, in seconds.
        dwell: Least number of seconds that a profile runs before a change without a disturbance.
        settle: Settling time: windows that begin within so many seconds of a change are not judged, because messages
            that were queued under the previous profile still arrive.
        cool_down: Seconds for which a profile is excluded after it failed or was violated.
        cool_down_max: The longest cool-down; it doubles with each further failure.
        apply_timeout: Seconds after which a profile that is being applied counts as hung.
        offers: Whether profiles are compared by what their author declared, or by what they have given (``learnt``).
    """

    violations: int = 2
    windows: int = 3
    improvement: float = 0.05
    window: float = 1.0
    dwell: float = 2.0
    settle: float = 1.0
    cool_down: float = 10.0
    cool_down_max: float = 160.0
    apply_timeout: float = 5.0
    offers: OfferSource = OfferSource.DECLARED

    def check(self, where: str) -> None:
        """Check the numbers of windows and the times.

        Raises:
            ConfigError: One is out of range, or ``violations`` is greater than ``windows``.
        """
        if not 1 <= self.violations <= self.windows <= 100:
            problem = f"{self.violations} of {self.windows} windows"
            raise ConfigError(where, problem, "1 <= violations <= windows <= 100")
        for name, least in _LEAST.items():
            seconds = getattr(self, name)
            if not least <= seconds <= _DAY:
                raise ConfigError(where, f"{name} is {seconds:g} s", f"at least {least:g} s, at most a day")


class CoolDown(NamedTuple):
    """The exclusion of one profile that failed or was violated.

    Attributes:
        until: End of the cool-down, in monotonic seconds.
        cool_down: Length of the cool-down in seconds; the next one is longer, up to the maximum.
        why: The failure or violation, as a text for people.
    """

    until: float
    cool_down: float
    why: str


class AdaptationOut(Protocol):
    """What the loop tells its driver; none of these calls the loop back in the same turn."""

    def apply(self, profile: str, why: str) -> None:
        """Apply a profile, then report ``applied`` or ``failed`` to the loop; ``why`` is a text for people."""

    def alarm(self, alarm: Alarm, *, cleared: bool) -> None:
        """Publish an alarm, or that it is over."""

    def reacted(self, profile: str, reaction: float) -> None:
        """A reconfiguration is complete, so many seconds after its cause: a request, or the first violated window."""


class Adaptation:
    """The control loop of one resource. Times are monotonic seconds.

    Args:
        attributes: The attributes that clients may request, by name.
        decider: Decides among the resource's profiles.
        settings: Parameters of the loop.
        out: The driver.
    """

    def __init__(
        self, attributes: Mapping[str, Attribute], decider: Decider, settings: AdaptationSettings, out: AdaptationOut
    ) -> None:
        self._attributes = attributes
        self._decider = decider
        self._settings = settings
        self._out = out
        # The requirement of each client, by client; ``require`` and ``release`` change it.
        self.requirements: dict[str, Requirement] = {}
        # The requirements of all clients, merged, by attribute.
        self.bounds: dict[str, Bound] = {}
        # Clients whose bounds are left out, with texts about it; see ``merge``.
        self.conflicts: list[tuple[str, str]] = []
        # The profile that runs, or that ran before the one that is being applied; empty: none.
        self.profile = ""
        # The profile that is being applied; empty: none.
        self.applying = ""
        # The profile that was chosen by hand; empty: the loop decides. May be set before the first choice.
        self.pinned = ""
        # The alarm that is raised at present.
        self.alarm: Alarm | None = None
        # Why a profile is blocked by its precondition or by the context, by profile.
        self._blocked: dict[str, str] = {}
        self._cooling: dict[str, CoolDown] = {}
        # The length of the last cool-down by profile, from which that of the next one is computed.
        self._cool_down_lengths: dict[str, float] = {}
        # The last windows under the profile and requirements: when each began, and its shortfalls.
        self._windows: deque[tuple[float, tuple[Shortfall, ...]]] = deque(maxlen=settings.windows)
        # The profile that ran before the restart; empty after the first decision.
        self._restored_profile = ""
        self._active_since = -math.inf
        self._window_end: float | None = None
        # When the cause of the present reconfiguration began; infinite: no reconfiguration is under way.
        self._cause = math.inf
        # Whether a change that skips the dwell time has occurred while a profile was being applied.
        self._replan_at_once = False

    def explain(self, now: float) -> tuple[ProfileScore, ...]:
        """The present score of each profile, with the reason if the profile is excluded."""
        return self._decider.explain(self.bounds, self._excluded(now))

    def cooling(self, now: float) -> dict[str, CoolDown]:
        """The cool-downs that are not over, by profile."""
        return {name: one for name, one in self._cooling.items() if now < one.until}

    def restore(
        self, requirements: Iterable[Requirement], profile: str, cool_downs: Mapping[str, CoolDown], now: float
    ) -> None:
        """Take over the state that was saved before a restart; must be called before the first choice.

        Args:
            requirements: The requirements that were in force.
            profile: The profile that ran; it is chosen again if it is about as good as the best one.
            cool_downs: The cool-downs that were not over, by profile; present settings bound them.
            now: The time of the call.
        """
        for name, one in cool_downs.items():
            length = self._cool_down_lengths[name] = min(one.cool_down, self._settings.cool_down_max)
            self._cooling[name] = CoolDown(min(one.until, now + length), length, one.why)
        self.requirements = {requirement.client: requirement for requirement in requirements}
        self.bounds, self.conflicts = merge(self.requirements.values())
        self._restored_profile = profile

    def require(self, requirement: Requirement, now: float) -> None:
        """Set a client's requirement, in place of its previous one."""
        self.requirements[requirement.client] = requirement
        self._requirements_changed(now, f"{requirement.client} asks for a quality")

    def release(self, client: str, now: float) -> None:
        """Drop a client's requirement, if it has one."""
        if self.requirements.pop(client, None) is not None:
            self._requirements_changed(now, f"{client} asks for nothing any more")

    def block(self, blocked: Mapping[str, str], now: float) -> None:
        """Set the profiles that preconditions or the context block, with the reasons; all others are allowed."""
        if blocked != self._blocked:
            self._blocked = dict(blocked)
            self._plan(now, "the preconditions of profiles have changed")

    def pin(self, profile: str, now: float, *, restored: bool = False, again: bool = False) -> None:
        """Run this profile whatever is requested; an empty name lets the loop decide again.

        Args:
            profile: Name of the profile, or empty.
            now: The time of the call.
            again: Whether to apply the decided profile even if it runs already.
            restored: Whether the choice was made before a restart; the profile's cool-down continues then. A new
                choice ends the cool-down, since its cause may have been removed.

        Raises:
            ConfigError: The resource has no profile of this name.
        """
        if profile:
            self._decider.profile(profile)
            if not restored:
                self._cooling.pop(profile, None)
                self._cool_down_lengths.pop(profile, None)
        self.pinned = profile
        why = f"{profile} was chosen by hand" if profile else "the choice by hand is over"
        self._plan(now, why, at_once=True, again=again)

    def reconsider(self, why: str, now: float) -> None:
        """Choose the best profile without hysteresis and dwell time: at the start, or in another context."""
        self._plan(now, why, at_once=True)

    def window(self, measured: Mapping[str, Value], now: float) -> bool:
        """Judge a window of measured quality that ends now.

        Returns:
            Whether it was: not unless it began at least ``settle`` seconds after the active profile was applied.
        """
        began = max(self._window_end, self._active_since) if self._window_end is not None else now
        self._window_end = now
        if self.applying or not self.profile or began < self._active_since + self._settings.settle:
            return False
        offers = self._decider.offers(self.profile)
        self._windows.append((began, find_shortfalls(self._attributes, measured, self.bounds, offers)))
        violated = self._violated()
        if len(violated) >= self._settings.violations and not self.pinned:
            self._disturbed(violated[0][0], violated[-1][1], now)
        elif not violated:
            self._plan(now, "a better profile can be taken")
            best = self._pinned_or_best(now)
            if best is not None and best.feasible:  # otherwise an attribute that was not measured may fall short
                self._set_alarm(None)
        return True

    def _violated(self) -> list[tuple[float, tuple[Shortfall, ...]]]:
        return [window for window in self._windows if window[1]]

    def _disturbed(self, since: float, short: tuple[Shortfall, ...], now: float) -> None:
        """React to a disturbance under the active profile: choose another profile, or raise an alarm."""
        why = f"{', '.join(s.attribute for s in short)} fell short"
        best = self._decider.decide(
            self.bounds, self._excluded(now) | {self.profile: "it does not give what is asked"}
        )
        if best is not None and best.feasible:
            self.begin_cool_down(self.profile, why, now)
            self._set_alarm(Alarm(AlarmKind.ADAPTATION, short, self.profile, best.profile))
            self._apply(best.profile, why, since)
            return
        # No other profile meets the requirements: this one stays, unless a best-effort profile is declared.
        effort = best if best is not None and self._decider.profile(best.profile).best_effort else None
        after = effort if effort is not None else self._decider.decide(self.bounds, self._excluded(now))
        if not self._non_adaptable:
            name = after.profile if after is not None else ""
            self._set_alarm(Alarm(AlarmKind.NON_ADAPTABLE, short, self.profile, name))
        if effort is not None:
            self.begin_cool_down(self.profile, why, now)
            self._apply(effort.profile, "none can serve: best effort", since)

    def applied(self, now: float) -> None:
        """Report that the profile that was being applied is in force."""
        self.profile, self.applying = self.applying, ""
        self._active_since = now
        self._windows.clear()
        reaction, self._cause = max(0.0, now - self._cause), math.inf
        self._out.reacted(self.profile, reaction)
        at_once, self._replan_at_once = self._replan_at_once, False
        self._plan(now, "what is asked has changed meanwhile", at_once=at_once)

    def failed(self, why: str, now: float) -> None:
        """Report that the profile could not be applied; the next best profile is applied instead."""
        profile, self.applying = self.applying, ""
        self.begin_cool_down(profile, why, now)
        # The failed profile may be partly in force, so even the profile that ran before is applied again.
        self._plan(now, f"{profile} failed: {why}", again=True)

    def broken(self, why: str, now: float) -> None:
        """Report that the running profile does not work any more; the next best profile is applied instead."""
        if not self.applying:
            self.begin_cool_down(self.profile, why, now)
            self._plan(now, f"{self.profile} does not work any more: {why}", at_once=True)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due; ``None``: no timer runs."""
        expiries = (r.expires for r in self.requirements.values() if r.expires is not None)
        return min((*expiries, *(one.until for one in self._cooling.values())), default=None)

    def handle_timer(self, now: float) -> None:
        """Handle what is due: requirements that expire, cool-downs that end."""
        over = [c for c, r in self.requirements.items() if r.expires is not None and r.expires <= now]
        for client in over:
            del self.requirements[client]
        self._cooling = self.cooling(now)
        if over:
            self._requirements_changed(now, f"what {', '.join(over)} asked for has expired")
        self._plan(now, "a profile's cool-down is over")

    def _requirements_changed(self, now: float, why: str) -> None:
        before = self.bounds
        self.bounds, self.conflicts = merge(self.requirements.values())
        # A repetition (`rostopic pub -r`) must neither hide a disturbance nor skip the dwell time.
        if self.bounds != before or not (self.profile or self.applying):
            self._windows.clear()
            self._plan(now, why, at_once=True)

    def _plan(self, now: float, why: str, *, at_once: bool = False, again: bool = False) -> None:
        """Apply another profile if the change is worth it.

        Args:
            now: The time of the call.
            why: The reason for planning, for people.
            at_once: Whether to skip hysteresis and dwell time: requirements, context or choice have changed.
            again: Whether to apply the decided profile even if it runs already.
        """
        if self.applying:
            self._replan_at_once |= at_once
            return  # ``applied`` or ``failed`` plans again
        best = self._prefer_restored(self._pinned_or_best(now), now)
        if best is None:
            self.profile = ""
            return
        self._update_alarm(best)
        if again or (best.profile != self.profile and (at_once or self._worth_it(best, now))):
            self._apply(best.profile, why, now)

    def _pinned_or_best(self, now: float) -> ProfileScore | None:
        cooling = {name: one.why for name, one in self.cooling(now).items()}
        if not self.pinned or self.pinned in cooling:
            # A pinned profile that failed is tried again after its cool-down.
            return self._decider.decide(self.bounds, cooling | self._blocked)
        others = {name: "another one was chosen by hand" for name in self._decider.profiles if name != self.pinned}
        return self._decider.decide(self.bounds, others)

    def _prefer_restored(self, best: ProfileScore | None, now: float) -> ProfileScore | None:
        """At the first decision after a restart, keep the profile that ran before unless a change is worth it."""
        before, self._restored_profile = self._restored_profile, ""
        if best is None or not before or self.pinned or before in self._excluded(now):
            return best
        score = self._score(before, now)
        keep = score.feasible == best.feasible and score.distance - best.distance <= self._settings.improvement
        return score if keep else best

    def _worth_it(self, best: ProfileScore, now: float) -> bool:
        """Whether a change is worth it while the requirements stay the same: applies hysteresis and dwell time."""
        if not self.profile or self.profile in self._excluded(now) or self.pinned:
            return True
        current = self._score(self.profile, now)
        if best.feasible and not current.feasible:
            return True
        if now - self._active_since < self._settings.dwell:
            return False
        return current.distance - best.distance > self._settings.improvement

    def _update_alarm(self, best: ProfileScore) -> None:
        """Raise the non-adaptable alarm if even the decided profile's offers fall short; else clear it."""
        if best.feasible:
            if self._non_adaptable and not self._violated():
                self._set_alarm(None)
        elif not self._non_adaptable and not self.pinned:
            short = tuple(
                Shortfall(term.attribute, self.bounds[term.attribute], term.offered)
                for term in best.terms
                if term.hard and term.delta
            )
            self._set_alarm(Alarm(AlarmKind.NON_ADAPTABLE, short, self.profile, best.profile))

    def _set_alarm(self, alarm: Alarm | None) -> None:
        before, self.alarm = self.alarm, alarm
        if before is not None:
            self._out.alarm(before, cleared=True)
        if alarm is not None:
            self._out.alarm(alarm, cleared=False)

    @property
    def _non_adaptable(self) -> bool:
        return self.alarm is not None and self.alarm.kind is AlarmKind.NON_ADAPTABLE

    def _apply(self, profile: str, why: str, cause: float) -> None:
        self.applying = profile
        self._cause = min(self._cause, cause)
        self._out.apply(profile, why + self._decider.learnt_text(self.bounds, self.profile, profile))

    def begin_cool_down(self, profile: str, why: str, now: float) -> None:
        """Exclude a profile; the driver calls it for one that hangs: the restarted resource tries another one."""
        before = self._cool_down_lengths.get(profile)
        first, longest = self._settings.cool_down, self._settings.cool_down_max
        length = first if before is None else min(before * COOL_DOWN_GROWTH, longest)
        self._cool_down_lengths[profile] = length
        self._cooling[profile] = CoolDown(now + length, length, why)

    def _score(self, profile: str, now: float) -> ProfileScore:
        return next(score for score in self.explain(now) if score.profile == profile)

    def _excluded(self, now: float) -> dict[str, str]:
        """All profiles that may not be chosen, with the reasons."""
        return {name: one.why for name, one in self.cooling(now).items()} | self._blocked
