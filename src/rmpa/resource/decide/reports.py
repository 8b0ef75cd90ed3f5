"""Texts and values of a resource's reports: alarms, health, responses, decision (``docs/smart-resources.md``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.resource.decide.actions import AlarmKind
from rmpa.resource.decide.decision import describe_bound
from rmpa.ros.types.definitions import DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.decide.actions import Alarm
    from rmpa.resource.decide.adaptation import Adaptation
    from rmpa.resource.decide.decision import ProfileScore
    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.requirements import Bound, Requirement

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
