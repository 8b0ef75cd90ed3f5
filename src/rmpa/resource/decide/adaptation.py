"""The loop of a Smart Resource: what is asked, what is measured, and which profile to apply (paper, section 3.1).

MAPE-K, sans-I/O: *monitor* takes each window of measured quality, *analyse* compares it with what the clients ask,
*plan* is ``decision.Decider``, *execute* is the driver's work, which reports back. The profile's state::

    none ──decided──► applying ──applied──► active ──another is better──► applying
                       │  ▲                    │
                       │  └─ next best ◄───────┘ violated
                       └─ failed, hung: left out for a cool-down, and the next best is applied

A quality that is violated in ``k`` of the last ``n`` windows is a disturbance. If another profile can serve, that is
an *adaptation event* (WARN): the violating one is left out for its cool-down and the other one applied. If none can,
it is a *non-adaptable event* (ERROR): the best-effort profile runs. Without a disturbance a profile is changed only
where that brings more than ``improvement``, and not before ``dwell`` is over: two nearly alike do not alternate.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import LocalProtocolError, PeerRefused
from rmpa.resource.decide.actions import Action, Alarm, AlarmKind, Apply, Clear, Raise, Reacted, Shortfall
from rmpa.resource.declare.requirements import Merged, Requirement, merge

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.resource.decide.decision import Decider, ProfileDecision, ProfileScore
    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.requirements import Bound

__all__ = [
    "COOL_DOWN_GROWTH",
    "EXPECTED",
    "Action",
    "Adaptation",
    "AdaptationSettings",
    "Alarm",
    "AlarmKind",
    "Apply",
    "Clear",
    "CoolDown",
    "ProfileState",
    "Raise",
    "Reacted",
    "Shortfall",
]
COOL_DOWN_GROWTH: Final = 2.0
"""Each time that a profile disappoints again its cool-down is so many times as long, up to ``cool_down_max``."""

EXPECTED: Final = 1.25
"""A soft bound that the profile is declared to fall short of may be missed by so many times that; more is a
disturbance."""


@dataclass(frozen=True, slots=True)
class AdaptationSettings:
    """How patient a resource is.

    Args:
        violations: ``k``: so many violated windows …
        windows: ``n``: … of the last so many are a disturbance.
        improvement: ``h``: a change without a disturbance must lessen the distance by more than this.
        dwell: Seconds that a profile runs at least before such a change.
        settle: Seconds behind a change for which windows that begin in them are not judged: what the profile before
            left in queues is still on its way.
        cool_down: Seconds that a profile is left out after it failed or disappointed.
        cool_down_max: The same at most, when it does so again and again.
        apply_timeout: Seconds after which a profile that is being applied counts as hung.
    """

    violations: int = 2
    windows: int = 3
    improvement: float = 0.05
    dwell: float = 2.0
    settle: float = 1.0
    cool_down: float = 10.0
    cool_down_max: float = 160.0
    apply_timeout: float = 5.0


class ProfileState(Enum):
    """Where the loop stands."""

    NONE = auto()
    """Nothing was decided yet, or no profile can be taken."""
    APPLYING = auto()
    ACTIVE = auto()


@dataclass(slots=True)
class CoolDown:
    """A profile that failed or disappointed is left out.

    Args:
        until: When that is over, monotonic seconds.
        cool_down: How long it was to last; the next one is longer.
        why: What was wrong.
    """

    until: float
    cool_down: float
    why: str


@dataclass(slots=True)
class _Knowledge:
    """What the loop knows."""

    requirements: dict[str, Requirement] = field(default_factory=dict)
    merged: Merged = field(default_factory=Merged)
    barred: dict[str, str] = field(default_factory=dict)
    """Profiles whose preconditions do not hold, and why."""
    troubles: dict[str, CoolDown] = field(default_factory=dict)
    hanging: set[str] = field(default_factory=set)
    """Profiles that were given up while their functions ran, and still run."""
    windows: deque[tuple[float, tuple[Shortfall, ...]]] = field(default_factory=deque)
    """When each of the last windows began, and what fell short in it; since the profile became active."""


class Adaptation:
    """The loop of one resource.

    Args:
        attributes: Declared ones, by name.
        decider: Of its profiles.
        settings: How patient it is.
    """

    def __init__(
        self, attributes: Mapping[str, Attribute], decider: Decider, settings: AdaptationSettings | None = None
    ) -> None:
        self._attributes = attributes
        self._decider = decider
        self._settings = settings if settings is not None else AdaptationSettings()
        self._knows = _Knowledge()
        self._state = ProfileState.NONE
        self._profile = ""
        self._target = ""
        self._pinned = ""
        self._before = ""
        self._since = -math.inf
        self._window: float | None = None
        self._deadline = math.inf
        self._caused = math.inf
        self._alarm: Alarm | None = None
        self._asked_meanwhile = False
        self._spoilt = ""

    @property
    def state(self) -> ProfileState:
        """Where the loop stands."""
        return self._state

    @property
    def profile(self) -> str:
        """The profile that runs, or ran until the one that is being applied; empty before the first."""
        return self._profile

    @property
    def applying(self) -> str:
        """The profile that is being applied, or empty."""
        return self._target

    @property
    def pinned(self) -> str:
        """The profile that was chosen by hand, or empty."""
        return self._pinned

    @property
    def alarm(self) -> Alarm | None:
        """What is wrong at present."""
        return self._alarm

    @property
    def asked(self) -> Merged:
        """What all clients ask together."""
        return self._knows.merged

    @property
    def requirements(self) -> Mapping[str, Requirement]:
        """By client."""
        return self._knows.requirements

    def explain(self, now: float) -> tuple[ProfileScore, ...]:
        """How each profile does at this moment, and which are left out."""
        return self._decider.explain(self._knows.merged.bounds, self._left_out(now))

    # --- what is asked ------------------------------------------------------------------------------------------

    def remember(
        self,
        requirements: Iterable[Requirement],
        profile: str,
        cooling: Mapping[str, CoolDown] | None = None,
        now: float = 0.0,
    ) -> None:
        """Begin with what there was before a restart; to be called at first.

        Args:
            requirements: What was asked.
            profile: That ran; it is taken if it is about as good as the best.
            cooling: The profiles that were left out, and until when.
            now: The time.
        """
        for name, one in (cooling or {}).items():
            cool_down = min(one.cool_down, self._settings.cool_down_max)
            self._knows.troubles[name] = CoolDown(min(one.until, now + cool_down), cool_down, one.why)
        self._knows.requirements = {requirement.client: requirement for requirement in requirements}
        self._knows.merged = merge(self._knows.requirements.values())
        self._before = profile

    def cooling(self, now: float) -> dict[str, CoolDown]:
        """The profiles that failed or disappointed and are left out at present."""
        return {name: replace(one) for name, one in self._knows.troubles.items() if now < one.until < math.inf}

    def start(self, now: float) -> list[Action]:
        """Take the first profile."""
        return self._plan(now, "the resource starts")

    def require(self, requirement: Requirement, now: float) -> list[Action]:
        """A client asks for a quality, in place of what it asked for before."""
        self._knows.requirements[requirement.client] = requirement
        return self._asked_anew(now, f"{requirement.client} asks for a quality")

    def release(self, client: str, now: float) -> list[Action]:
        """A client asks for nothing any more, or is gone.

        Raises:
            PeerRefused: It had asked for nothing.
        """
        if self._knows.requirements.pop(client, None) is None:
            raise PeerRefused("the resource", f"{client} has asked for nothing here")
        return self._asked_anew(now, f"{client} asks for nothing any more")

    def bar(self, barred: Mapping[str, str], now: float) -> list[Action]:
        """Say which profiles cannot be taken now (their preconditions, the context), and why; all others can."""
        if barred == self._knows.barred:
            return []
        self._knows.barred = dict(barred)
        return self._plan(now, "the preconditions of profiles have changed")

    def pin(self, profile: str, now: float, *, anew: bool = True) -> list[Action]:
        """Run this profile whatever is asked; an empty name lets the loop decide again.

        Args:
            profile: Which one.
            now: The time.
            anew: Whether somebody chose it just now; else it was chosen before a restart.

        Raises:
            ConfigError: There is no such profile.
        """
        if profile:
            self._decider.profile(profile)
            if anew:
                self._knows.troubles.pop(profile, None)  # who chooses it may know that what was wrong is mended
        self._pinned = profile
        why = f"{profile} was chosen by hand" if profile else "the choice by hand is over"
        return self._plan(now, why, at_once=True)

    def reconsider(self, why: str, now: float) -> list[Action]:
        """Take what is best now, however little better it is: the question is another one."""
        return self._plan(now, why, at_once=True)

    # --- what is measured ---------------------------------------------------------------------------------------

    def window(self, measured: Mapping[str, Value], now: float) -> list[Action]:
        """A window of quality has ended under the active profile; what was not measured is not judged."""
        began = max(self._window, self._since) if self._window is not None else now
        self._window = now
        if self._state is not ProfileState.ACTIVE or began < self._since + self._settings.settle:
            return []
        short = self._shortfalls(measured)
        windows = self._knows.windows
        windows.append((began, short))
        while len(windows) > self._settings.windows:
            windows.popleft()
        violated = [(at, short) for at, short in windows if short]
        if len(violated) >= self._settings.violations and not self._pinned:
            return self._disturbed(violated[0][0], violated[-1][1], now)
        if not short and not violated:
            planned = self._plan(now, "a better profile can be taken")
            if not self._pinned_or_best(now).feasible:
                return planned  # what was not measured may fall short as it was declared to
            return [*planned, *self._recovered()]
        return []

    def _shortfalls(self, measured: Mapping[str, Value]) -> tuple[Shortfall, ...]:
        short = []
        for name, bound in self._knows.merged.bounds.items():
            value = measured.get(name)
            if value is not None and not bound.met_by(self._attributes[name], value) and not self._known(name, value):
                short.append(Shortfall(name, bound, value))
        return tuple(short)

    def _known(self, name: str, value: Value) -> bool:
        """Whether the profile was taken although it falls short of a soft bound so far: that is no disturbance."""
        bound, attribute = self._knows.merged.bounds[name], self._attributes[name]
        offer = self._decider.profile(self._profile).offers.get(name)
        if bound.hard or offer is None or bound.met_by(attribute, offer):
            return False
        return _beyond(bound, attribute.place(value)) <= EXPECTED * _beyond(bound, attribute.place(offer))

    def _disturbed(self, since: float, short: tuple[Shortfall, ...], now: float) -> list[Action]:
        """The active profile does not give what it was taken for."""
        others = self._left_out(now) | {self._profile: "it does not give what is asked"}
        decision = self._decider.decide(self._knows.merged.bounds, others)
        if decision.feasible:
            self._disappoint(self._profile, f"{_named(short)} fell short", now)
            alarm = Alarm(AlarmKind.ADAPTATION, short, self._profile, decision.profile, now)
            return [*self._raise(alarm), *self._apply(decision.profile, f"{_named(short)} fell short", now, since)]
        # Where nothing better can be had the profile stays, unless a best effort was declared for just this.
        best = self._decider.decide(self._knows.merged.bounds, self._left_out(now))
        after = decision if decision.best_effort else best
        known = self._alarm is not None and self._alarm.kind is AlarmKind.NON_ADAPTABLE
        actions: list[Action] = []
        if not known:
            actions += self._raise(Alarm(AlarmKind.NON_ADAPTABLE, short, self._profile, after.profile, now))
        if decision.best_effort and decision.profile != self._profile:
            self._disappoint(self._profile, f"{_named(short)} fell short", now)
            actions += self._apply(decision.profile, "none can serve: best effort", now, since)
        return actions

    # --- what the driver reports --------------------------------------------------------------------------------

    def applied(self, profile: str, now: float) -> list[Action]:
        """The profile that was asked for runs; a report about another one is late, and ignored."""
        if self._state is not ProfileState.APPLYING or profile != self._target:
            return []
        self._state = ProfileState.ACTIVE
        self._profile, self._target = profile, ""
        self._since, self._deadline = now, math.inf
        self._knows.windows.clear()
        reaction = max(0.0, now - self._caused)
        # What was asked, or failed, meanwhile may want another one at once.
        at_once, self._asked_meanwhile = self._asked_meanwhile, False
        why = "what is asked has changed meanwhile"
        if spoilt := self._spoilt:
            planned = self._plan(now, why, at_once=at_once)
            return planned if self._target or not self._profile else [*planned, *self._again(spoilt, now)]
        self._caused = math.inf
        return [Reacted(profile, reaction), *self._plan(now, why, at_once=at_once)]

    def failed(self, profile: str, why: str, now: float) -> list[Action]:
        """The profile that was asked for could not be applied: the next best is."""
        if self._state is not ProfileState.APPLYING or profile != self._target:
            return []
        self._disappoint(profile, why, now)
        self._state = ProfileState.ACTIVE if self._profile else ProfileState.NONE
        self._target, self._deadline = "", math.inf
        # Half of the profile that failed may be in force: the one that ran before is to be applied again too.
        return self._plan(now, f"{profile} failed: {why}", again=True)

    def overdue(self, now: float) -> bool:
        """Whether the profile that is being applied hangs; ``handle_timer`` gives it up."""
        return self._deadline <= now

    def ended_late(self, profile: str, now: float, *, touched: bool) -> list[Action]:
        """The function of a profile that was given up has ended after all; the profile may be taken again.

        Args:
            profile: Which one; until this is called it is left out, for two calls of one function would mix.
            now: The time.
            touched: Whether it may have touched the device since the function of the present profile began: that
                one is applied once more then, behind what is being applied. Where none runs there is nothing to do.
        """
        self._knows.hanging.discard(profile)
        why = f"the function of {profile} has ended late"
        if touched and self._state is ProfileState.APPLYING:
            self._spoilt = why
        elif touched and self._state is ProfileState.ACTIVE:
            return self._again(why, now)
        return self._plan(now, why)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, monotonic seconds."""
        due = [self._deadline, *(trouble.until for trouble in self._knows.troubles.values())]
        due += [r.expires for r in self._knows.requirements.values() if r.expires is not None]
        first = min(due)
        return None if first == math.inf else first

    def handle_timer(self, now: float) -> list[Action]:
        """A requirement expires, a cool-down is over, or a profile hangs."""
        if self._deadline <= now:
            self._knows.hanging.add(self._target)
            return self.failed(self._target, self._hangs, now)
        over = [c for c, r in self._knows.requirements.items() if r.expires is not None and r.expires <= now]
        for client in over:
            del self._knows.requirements[client]
        for trouble in self._knows.troubles.values():
            if trouble.until <= now:
                trouble.until = math.inf  # it may be taken again; how long it was out is remembered
        if over and (actions := self._asked_anew(now, f"what {', '.join(over)} asked for has expired")):
            return actions
        return self._plan(now, "a profile's cool-down is over")

    # --- planning -----------------------------------------------------------------------------------------------

    def _asked_anew(self, now: float, why: str) -> list[Action]:
        before, self._knows.merged = self._knows.merged.bounds, merge(self._knows.requirements.values())
        if self._knows.merged.bounds == before and self._state is not ProfileState.NONE:
            return []  # said again, as `rostopic pub -r` does: it must neither hide a disturbance nor skip the dwell
        for name in self._knows.merged.bounds:
            if name not in self._attributes:
                raise LocalProtocolError(f"a bound of {name}, which is no attribute; check it before it comes here")
        self._knows.windows.clear()
        return self._plan(now, why, at_once=True)

    def _plan(self, now: float, why: str, *, at_once: bool = False, again: bool = False) -> list[Action]:
        """Take another profile if that is worth it.

        Args:
            now: The time.
            why: What may have changed.
            at_once: A change need not wait for the dwell time, for it is another question that is asked.
            again: Apply what is decided even if it is the profile that runs.
        """
        if self._state is ProfileState.APPLYING:
            self._asked_meanwhile |= at_once
            return []  # ``applied`` or ``failed`` looks again
        decision = self._as_before(self._pinned_or_best(now), now)
        if not decision.profile:
            self._state, self._profile = ProfileState.NONE, ""
            return []
        actions = self._judge(decision, now)
        if decision.profile == self._profile and not again:
            return actions
        if not again and not at_once and not self._worth_it(decision, now):
            return actions
        return [*actions, *self._apply(decision.profile, why, now, now)]

    def _pinned_or_best(self, now: float) -> ProfileDecision:
        bounds = self._knows.merged.bounds
        if not self._pinned or self._cooling(now).get(self._pinned):
            # One chosen by hand that cannot be applied is tried again when its cool-down is over, not at once.
            return self._decider.decide(bounds, self._left_out(now))
        others = {name: "another one was chosen by hand" for name in self._decider.profiles if name != self._pinned}
        return self._decider.decide(bounds, others)

    def _as_before(self, decision: ProfileDecision, now: float) -> ProfileDecision:
        """The first decision after a restart: the profile that ran before, unless another is worth a change."""
        before, self._before = self._before, ""
        if not before or self._pinned or before == decision.profile or before in self._left_out(now):
            return decision
        score, best = self._score(before, now), self._score(decision.profile, now)
        if score.feasible != best.feasible or score.distance - best.distance > self._settings.improvement:
            return decision
        return replace(decision, profile=before)

    def _worth_it(self, decision: ProfileDecision, now: float) -> bool:
        """Whether a change without a new question pays."""
        if not self._profile or self._profile in self._left_out(now) or self._pinned:
            return True
        current = self._score(self._profile, now)
        if decision.feasible and not current.feasible:
            return True
        if now - self._since < self._settings.dwell:
            return False
        return current.distance - decision.distance > self._settings.improvement

    def _judge(self, decision: ProfileDecision, now: float) -> list[Action]:
        """Raise the alarm if not even the best profile is declared to meet what is asked; clear it if one does."""
        known = self._alarm is not None and self._alarm.kind is AlarmKind.NON_ADAPTABLE
        if decision.feasible:
            disturbed = any(short for _, short in self._knows.windows)
            return self._recovered() if known and not disturbed else []
        if known or self._pinned:
            return []
        offers = self._decider.profile(decision.profile).offers
        score = self._score(decision.profile, now)
        short = tuple(
            Shortfall(term.attribute, self._knows.merged.bounds[term.attribute], offers.get(term.attribute))
            for term in score.terms
            if term.hard and not term.met
        )
        return self._raise(Alarm(AlarmKind.NON_ADAPTABLE, short, self._profile, decision.profile, now))

    def _apply(self, profile: str, why: str, now: float, since: float) -> list[Action]:
        self._state = ProfileState.APPLYING
        self._target = profile
        self._deadline = now + self._settings.apply_timeout
        self._caused = min(self._caused, since)
        self._spoilt = ""
        return [Apply(profile, why)]

    def _again(self, why: str, now: float) -> list[Action]:
        """Apply the profile that runs once more."""
        return self._apply(self._profile, why, now, now)

    def _score(self, profile: str, now: float) -> ProfileScore:
        return next(score for score in self.explain(now) if score.profile == profile)

    def _left_out(self, now: float) -> dict[str, str]:
        return self._cooling(now) | self._knows.barred

    def _cooling(self, now: float) -> dict[str, str]:
        cooling = {name: one.why for name, one in self.cooling(now).items()}
        return cooling | dict.fromkeys(self._knows.hanging, f"{self._hangs}, and its function still runs")

    @property
    def _hangs(self) -> str:
        return f"not applied within {self._settings.apply_timeout:g} s"

    def _disappoint(self, profile: str, why: str, now: float) -> None:
        before = self._knows.troubles.get(profile)
        cool_down = self._settings.cool_down
        if before is not None:
            cool_down = min(before.cool_down * COOL_DOWN_GROWTH, self._settings.cool_down_max)
        self._knows.troubles[profile] = CoolDown(now + cool_down, cool_down, why)

    def _raise(self, alarm: Alarm) -> list[Action]:
        before, self._alarm = self._alarm, alarm
        return [Raise(alarm)] if before is None else [Clear(before), Raise(alarm)]

    def _recovered(self) -> list[Action]:
        if self._alarm is None:
            return []
        alarm, self._alarm = self._alarm, None
        # Under it the quality is as asked again: the next disturbance starts with a short cool-down.
        self._knows.troubles.pop(self._profile, None)
        return [Clear(alarm)]


def _beyond(bound: Bound, place: float) -> float:
    """How far a place lies outside a bound; words have no distance."""
    return 0.0 if bound.words else max(bound.low - place, place - bound.high, 0.0)


def _named(short: tuple[Shortfall, ...]) -> str:
    return ", ".join(s.attribute for s in short)
