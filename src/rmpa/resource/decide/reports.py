"""What a resource knows and tells: its clients, its life cycle, reports, and the state that it keeps.

The clients of a resource: their last messages, refusals and presence.

``resource.declare.requirements`` merges the requirements themselves. This module keeps for each client: the mark on
its request, by which the client recognises the answer; the stamp of its request, which identifies a latched message
that arrives again; the reason of a refusal; and how long the client has been absent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import ConfigError, LocalProtocolError
from rmpa.resource import limits
from rmpa.resource.decide.adaptation import CoolDown
from rmpa.resource.decide.decision import AlarmKind, describe_bound
from rmpa.resource.declare.requirements import parse_requirement
from rmpa.ros.types.definitions import DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

    from rmpa.resource.decide.adaptation import Adaptation
    from rmpa.resource.decide.decision import Alarm, ProfileScore
    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.requirements import Bound, Requirement
    from rmpa.resource.declare.resource import Resource


# The life cycle of a resource: the states of ROS 2's managed nodes (design.ros2.org/articles/node_lifecycle).
#
# ::
#
#     unconfigured ──configure──► inactive ──activate──► active
#                                     ▲                    │
#                                     └─────deactivate─────┘
#     any of them ──finalize──► finalized


class LifecycleState(StrEnum):
    """State of a resource in its life cycle."""

    UNCONFIGURED = "unconfigured"
    """The node is registered; the device is not open yet."""
    INACTIVE = "inactive"
    """Parameters can be set; no task runs and nothing is published."""
    ACTIVE = "active"
    """The tasks run, and outputs are published."""
    FINALIZED = "finalized"
    """The resource has ended; no transition leads out of this state."""


class Transition(StrEnum):
    """Transition between two states of the life cycle."""

    CONFIGURE = "configure"
    ACTIVATE = "activate"
    DEACTIVATE = "deactivate"
    FINALIZE = "finalize"


_S, _T = LifecycleState, Transition
TRANSITIONS: Final[Mapping[tuple[LifecycleState, Transition], LifecycleState]] = {
    (_S.UNCONFIGURED, _T.CONFIGURE): _S.INACTIVE,
    (_S.INACTIVE, _T.ACTIVATE): _S.ACTIVE,
    (_S.ACTIVE, _T.DEACTIVATE): _S.INACTIVE,
    (_S.UNCONFIGURED, _T.FINALIZE): _S.FINALIZED,
    (_S.INACTIVE, _T.FINALIZE): _S.FINALIZED,
    (_S.ACTIVE, _T.FINALIZE): _S.FINALIZED,
}
"""Target state of each valid transition."""


class LifeCycle:
    """State machine of one resource's life cycle; its driver calls the user's callbacks and reports their outcome."""

    def __init__(self) -> None:
        self._state = LifecycleState.UNCONFIGURED
        self._under_way: Transition | None = None

    @property
    def state(self) -> LifecycleState:
        """The present state; during a transition the state in which the transition began."""
        return self._state

    @property
    def under_way(self) -> Transition | None:
        """The transition whose callback runs; ``None``: no transition is under way."""
        return self._under_way

    def begin(self, transition: Transition) -> None:
        """Begin a transition; ``succeeded`` or ``failed`` ends it.

        Raises:
            LocalProtocolError: The transition is not valid in this state, or another one is under way.
        """
        if self._under_way is not None:
            raise LocalProtocolError(f"{transition} while {self._under_way} is under way")
        if (self._state, transition) not in TRANSITIONS:
            raise LocalProtocolError(f"{self._state} does not lead anywhere by {transition}")
        self._under_way = transition

    def succeeded(self) -> LifecycleState:
        """End the transition after its callback has returned, and return the new state.

        Raises:
            LocalProtocolError: No transition is under way.
        """
        if self._under_way is None:
            raise LocalProtocolError("no transition is under way")
        self._state = TRANSITIONS[self._state, self._under_way]
        self._under_way = None
        return self._state

    def failed(self) -> LifecycleState:
        """End the transition after its callback has raised, and return the resulting state.

        The state stays the same, except after ``finalize`` and ``deactivate``: an error must not prevent these.
        """
        if self._under_way in (Transition.FINALIZE, Transition.DEACTIVATE):
            return self.succeeded()
        self._under_way = None
        return self._state


# Texts and values of a resource's reports: alarms, health, responses, decision (``docs/smart-resources.md``).


ALARM_LEVELS: Final = {AlarmKind.ADAPTATION: DiagnosticLevel.WARN, AlarmKind.NON_ADAPTABLE: DiagnosticLevel.ERROR}


def describe_alarm(alarm: Alarm) -> str:
    """Describe an alarm in a sentence."""
    names = ", ".join(short.attribute for short in alarm.shortfalls) or "the quality"
    if alarm.kind is AlarmKind.ADAPTATION:
        return f"adaptation: {names} fell short under {alarm.before}; {alarm.after} takes over"
    return f"non-adaptable: no profile gives {names} as asked; {alarm.after} is the best there is"


def alarm_values(
    alarm: Alarm, attributes: Mapping[str, Attribute], *, cleared: bool, reaction: float | None
) -> dict[str, str]:
    """The values of an alarm's message, by key.

    Args:
        alarm: The alarm.
        attributes: The resource's attributes, by name.
        cleared: Whether the alarm is over.
        reaction: Seconds that the last reconfiguration took; ``None``: there was none.
    """
    values = {"before": alarm.before, "after": alarm.after, "cleared": str(cleared).lower()}
    if cleared and reaction is not None:
        values["reaction"] = f"{reaction:.6g} s"
    for short in alarm.shortfalls:
        values[short.attribute] = _compare(attributes[short.attribute], short.requested, short.offered, "nothing")
    return values


def _compare(attribute: Attribute, requested: Bound, offered: Value | None, absent: str) -> str:
    shown = attribute.format(offered) if offered is not None else absent
    return f"wanted {describe_bound(attribute, requested)}, given {shown}"


def health(loop: Adaptation, missing: Sequence[str], broken: Sequence[str]) -> tuple[DiagnosticLevel, str]:
    """Level and message of a resource's ``quality`` and ``/diagnostics``.

    Args:
        loop: The resource's control loop.
        missing: What the resource needs and lacks, as texts.
        broken: What does not work, as texts.
    """
    alarm = loop.alarm
    if alarm is not None and alarm.kind is AlarmKind.NON_ADAPTABLE:
        return DiagnosticLevel.ERROR, describe_alarm(alarm)
    if missing:
        return DiagnosticLevel.STALE, "; ".join((*missing, *broken))
    if not loop.profile:
        return DiagnosticLevel.ERROR, "; ".join(("no profile runs", *broken))
    if alarm is not None or broken:
        alarms = [describe_alarm(alarm)] if alarm is not None else []
        return DiagnosticLevel.WARN, "; ".join((*alarms, *broken))
    return DiagnosticLevel.OK, f"profile {loop.profile}"


def answer_to(
    requirement: Requirement, loop: Adaptation, attributes: Mapping[str, Attribute], offered: Mapping[str, Value]
) -> tuple[DiagnosticLevel, str, dict[str, str]]:
    """Level, message and values of the response to a client.

    Args:
        requirement: The client's requirement.
        loop: The resource's control loop.
        attributes: The resource's attributes, by name.
        offered: Measured values of the requested attributes; those not measured yet are left out.
    """
    values = {
        name: _compare(attributes[name], bound, offered.get(name), "not measured yet")
        for name, bound in requirement.bounds.items()
    }
    short = [
        name
        for name, bound in requirement.bounds.items()
        if name in offered and not bound.met_by(attributes[name], offered[name])
    ]
    conflicts = [str(conflict) for conflict in loop.merged.conflicts if conflict.client == requirement.client]
    level, message = _judge(loop, short, conflict=bool(conflicts))
    return level, "; ".join(conflicts) if conflicts else message, values


def _judge(loop: Adaptation, short: Sequence[str], *, conflict: bool) -> tuple[DiagnosticLevel, str]:
    alarm = loop.alarm
    if alarm is not None and alarm.kind is AlarmKind.NON_ADAPTABLE:
        return DiagnosticLevel.ERROR, describe_alarm(alarm)
    if not loop.profile:
        return DiagnosticLevel.WARN, "no profile runs yet"
    if short or conflict:
        return DiagnosticLevel.WARN, f"{', '.join(short)} {'fall' if len(short) > 1 else 'falls'} short"
    return DiagnosticLevel.OK, f"profile {loop.profile}"


def decision_report(loop: Adaptation, scores: Sequence[ProfileScore], reaction: float | None) -> dict[str, Any]:
    """The present decision with each profile's score and terms, as plain values for ``rmpa profile explain``."""
    return {
        "profile": loop.profile,
        "applying": loop.applying,
        "chosen": loop.pinned,
        "reaction": reaction,
        "alarm": loop.alarm.kind.value if loop.alarm is not None else "",
        "conflicts": [str(conflict) for conflict in loop.merged.conflicts],
        "clients": sorted(loop.requirements),
        "scores": [msgspec.to_builtins(score) | {"feasible": score.feasible} for score in scores],
    }


# State that survives a restart: parameters, choices by hand, the last profile, requirements and cool-downs.


_SECOND = 1_000_000_000


class SavedRequirement(msgspec.Struct, frozen=True, kw_only=True):
    """The requirement of one client, as it was received.

    Attributes:
        client: Name of the client's node.
        values: Attributes, ``priority`` and ``expires`` with their texts.
        mark: The message's mark, which responses repeat.
        stamp: The message's stamp, or empty; a latched message that arrives again has the same stamp.
        expires_ns: When it expires, in Unix nanoseconds of the wall clock, because the monotonic clock restarts with
            each boot; ``None``: never.
    """

    client: str
    values: tuple[tuple[str, str], ...]
    mark: str = ""
    stamp: str = ""
    expires_ns: int | None = None

    def requirement(
        self, attributes: Mapping[str, Attribute], resource: str, now: float, now_ns: int
    ) -> Requirement | None:
        """The parsed requirement; ``None`` if it has expired.

        Args:
            attributes: The resource's attributes, by name.
            resource: Name of the resource, for errors.
            now: Monotonic seconds.
            now_ns: The same moment by the wall clock, Unix nanoseconds.

        Raises:
            ConfigError: The texts are no valid requirement on the resource as it is declared now.
        """
        found = parse_requirement(self.client, list(self.values), attributes, resource, now)
        if self.expires_ns is None or found.expires is None:
            return replace(found, expires=None)
        if self.expires_ns <= now_ns:
            return None
        # If the wall clock was set back meanwhile, the requirement must not last longer than its whole duration.
        return replace(found, expires=min(found.expires, now + (self.expires_ns - now_ns) / _SECOND))


class SavedCoolDown(msgspec.Struct, frozen=True, kw_only=True):
    """The cool-down of a profile.

    Attributes:
        until_ns: End of the cool-down, in Unix nanoseconds of the wall clock.
        cool_down: Length of the cool-down in seconds.
        why: The reason, as a text for people.
    """

    until_ns: int
    cool_down: float
    why: str = ""

    def left(self, now: float, now_ns: int) -> CoolDown | None:
        """The rest of the cool-down, by the monotonic clock; ``None`` if it is over.

        If the wall clock was set back meanwhile, the whole cool-down is left; if it was set forward, it ends early.
        """
        left = min((self.until_ns - now_ns) / _SECOND, self.cool_down)
        return CoolDown(now + left, self.cool_down, self.why) if left > 0 else None


class SavedState(msgspec.Struct, frozen=True, kw_only=True):
    """The state of a resource, as its file has it (JSON).

    Attributes:
        parameters: The values of parameters that differ from their defaults, by name.
        chosen: The profile chosen by hand, or empty.
        last: The profile that ran last, or empty.
        context: The context chosen by hand, or empty.
        requirements: Requirements of clients, which may come back.
        cool_downs: Cool-downs by profile.
    """

    parameters: dict[str, bool | int | float | str] = {}
    chosen: str = ""
    last: str = ""
    context: str = ""
    requirements: tuple[SavedRequirement, ...] = ()
    cool_downs: dict[str, SavedCoolDown] = {}

    def checked(self, resource: Resource, now_ns: int) -> tuple[SavedState, list[str]]:
        """What still fits the declaration of the resource, and a text about each part that does not.

        Args:
            resource: The resource, completely declared.
            now_ns: Unix nanoseconds of the wall clock.
        """
        lost: list[str] = []
        parameters, requirements = {}, []
        for name, value in self.parameters.items():
            try:
                if _declared("parameter", name, resource.parameters, lost):
                    parameters[name] = resource.parameters[name].check(value)
            except ConfigError as error:
                lost.append(str(error))
        for one in self.requirements:
            try:
                if one.requirement(resource.attributes, resource.name, 0.0, now_ns) is not None:
                    requirements.append(one)
            except ConfigError as error:
                lost.append(f"requirement of {one.client}: {error}")
        found = SavedState(
            parameters=parameters,
            chosen=_declared("profile", self.chosen, resource.profiles, lost),
            last=_declared("profile", self.last, resource.profiles, lost),
            context=_declared("context", self.context, resource.contexts, lost),
            requirements=tuple(requirements),
            cool_downs={n: c for n, c in self.cool_downs.items() if _declared("profile", n, resource.profiles, lost)},
        )
        return found, lost


def _declared(kind: str, name: str, known: Mapping[str, object], lost: list[str]) -> str:
    """The name, or an empty one if it is declared no longer."""
    if not name or name in known:
        return name
    lost.append(f"{kind} {name}: it is declared no longer")
    return ""


_ABSENT: Final = 2
"""Number of consecutive checks without a connection after which a client is gone. One check is not enough: after a
short interruption of its link, the connections of a proxy are made again."""


@dataclass(slots=True)
class _Client:
    """A client that has sent a message.

    Args:
        mark: The mark of its last message.
        stamp: The stamp of its last message, or empty.
        values: The last valid requirement, as texts by attribute; ``None``: there was none.
        refusal: Why its last message was refused; empty: it was accepted.
        absent: Number of consecutive checks without a connection.
        grace: For a client restored after a restart: how long it may stay unconnected, in monotonic seconds.
    """

    mark: str = ""
    stamp: str = ""
    values: tuple[tuple[str, str], ...] | None = None
    refusal: str = ""
    absent: int = 0
    grace: float = -math.inf


class Clients:
    """All clients of one resource.

    Args:
        resource: Name of the resource, for errors.
        attributes: The attributes that clients may request, by name.
    """

    def __init__(self, resource: str, attributes: Mapping[str, Attribute]) -> None:
        self._resource = resource
        self._attributes = attributes
        self._known: dict[str, _Client] = {}
        self.expiries: dict[tuple[str, str], float] = {}
        """Expiry in monotonic seconds, by client and stamp: a latched request that arrives again keeps its expiry."""

    def received(self, name: str, mark: str, stamp: str) -> None:
        """Record that a client has sent a message; called before ``read``, which uses the stamp.

        Args:
            name: Name of the client's node.
            mark: The mark on the message; it is cut to a maximum length, because each response repeats it.
            stamp: The message's stamp as ``seconds.nanoseconds``, or empty.
        """
        client = self._client(name)
        client.mark, client.stamp = mark[: limits.REQUIREMENT_TEXT_MAX], stamp
        client.grace = -math.inf

    def read(self, name: str, values: Sequence[tuple[str, str]], now: float) -> Requirement | None:
        """Read a client's requirement from the values of its message.

        Args:
            name: Name of the client's node.
            values: Attributes with the texts of the requests.
            now: Monotonic seconds.

        Returns:
            The requirement; ``None`` for a latched request that arrives again after it has expired.

        Raises:
            ConfigError: The request is invalid.
        """
        requirement = parse_requirement(name, list(values), self._attributes, self._resource, now)
        client = self._client(name)
        if requirement.expires is not None and client.stamp:
            due = self.expiries.setdefault((name, client.stamp), requirement.expires)
            while len(self.expiries) > limits.RESOURCE_STAMPS_MAX:
                del self.expiries[next(iter(self.expiries))]
            if due <= now:
                return None
            requirement = replace(requirement, expires=due)
        client.refusal, client.values = "", tuple(values)
        return requirement

    def refuse(self, name: str, why: str) -> None:
        """Record why a client's last message was refused."""
        self._client(name).refusal = why

    def refusal(self, name: str) -> str:
        """Why a client's last message was refused; empty: it was accepted."""
        client = self._known.get(name)
        return client.refusal if client is not None else ""

    def mark(self, name: str) -> str:
        """The mark of a client's last message, which the response repeats; empty: there is none."""
        client = self._known.get(name)
        return client.mark if client is not None else ""

    @property
    def refused(self) -> list[str]:
        """The clients whose last message was refused."""
        return [name for name, client in self._known.items() if client.refusal]

    def remove_absent(self, connected: Collection[str], now: float) -> list[str]:
        """Remove clients that have been unconnected for several calls; must be called periodically.

        Args:
            connected: The names of the nodes that are connected.
            now: Monotonic seconds.

        Returns:
            The names of the removed clients.
        """
        removed = []
        for name, client in list(self._known.items()):
            if name in connected:
                client.absent, client.grace = 0, -math.inf
            elif client.grace <= now:
                client.absent += 1
                if client.absent >= _ABSENT:
                    del self._known[name]
                    removed.append(name)
        return removed

    # --- over a restart -----------------------------------------------------------------------------------------

    def save(self, requirements: Mapping[str, Requirement], now: float, now_ns: int) -> list[SavedRequirement]:
        """The requirements of all clients in the form in which they are stored.

        Args:
            requirements: The requirements in force, by client.
            now: Monotonic seconds.
            now_ns: The same moment by the wall clock, Unix nanoseconds.
        """
        found = []
        for name, requirement in requirements.items():
            client = self._known.get(name)
            if client is None or client.values is None:
                continue
            expires = None
            if requirement.expires is not None:
                expires = now_ns + round((requirement.expires - now) * 1e9)
            found.append(
                SavedRequirement(
                    client=name, values=client.values, mark=client.mark, stamp=client.stamp, expires_ns=expires
                )
            )
        return found

    def restore(self, saved: Iterable[SavedRequirement], now: float, now_ns: int) -> list[Requirement]:
        """Return the stored requirements that have not expired, and keep their clients for a grace period."""
        found = []
        for one in saved:
            requirement = one.requirement(self._attributes, self._resource, now, now_ns)
            if requirement is None:
                continue
            found.append(requirement)
            grace = now + limits.RESOURCE_CLIENT_GRACE
            self._known[one.client] = _Client(one.mark, one.stamp, one.values, grace=grace)
            if one.stamp and requirement.expires is not None:
                self.expiries[one.client, one.stamp] = requirement.expires
        return found

    def _client(self, name: str) -> _Client:
        return self._known.setdefault(name, _Client())
