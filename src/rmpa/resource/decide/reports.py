"""What a resource says of itself, and to its clients: levels, words and figures (``docs/smart-resources.md``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rmpa.resource.decide.adaptation import AlarmKind
from rmpa.resource.decide.decision import wanted
from rmpa.ros.types.diagnostic_array import DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.resource.decide.adaptation import Adaptation, Alarm
    from rmpa.resource.decide.decision import ProfileScore
    from rmpa.resource.declare.attributes import Attribute, Value
    from rmpa.resource.declare.requirements import Requirement

ALARM_LEVELS: Final = {AlarmKind.ADAPTATION: DiagnosticLevel.WARN, AlarmKind.NON_ADAPTABLE: DiagnosticLevel.ERROR}


def told(alarm: Alarm) -> str:
    """An alarm in words."""
    names = ", ".join(short.attribute for short in alarm.shortfalls) or "the quality"
    if alarm.kind is AlarmKind.ADAPTATION:
        return f"adaptation: {names} fell short under {alarm.before}; {alarm.after} takes over"
    return f"non-adaptable: no profile gives {names} as asked; {alarm.after} is the best there is"


def alarm_values(
    alarm: Alarm, attributes: Mapping[str, Attribute], *, cleared: bool, reaction: float | None
) -> dict[str, str]:
    """What stands in an alarm beside its words; ``reaction`` in seconds, of the last reconfiguration."""
    values = {"before": alarm.before, "after": alarm.after, "cleared": str(cleared).lower()}
    if cleared and reaction is not None:
        values["reaction"] = f"{reaction:.6g} s"
    for short in alarm.shortfalls:
        attribute = attributes[short.attribute]
        given = attribute.show(short.given) if short.given is not None else "nothing"
        values[short.attribute] = f"wanted {wanted(attribute, short.wanted)}, given {given}"
    return values


def health(loop: Adaptation, missing: Sequence[str], broken: Sequence[str]) -> tuple[DiagnosticLevel, str]:
    """How a resource is.

    Args:
        loop: Its loop.
        missing: What is needed and not there, each ready to read.
        broken: What does not work, likewise.
    """
    alarm = loop.alarm
    if alarm is not None and alarm.kind is AlarmKind.NON_ADAPTABLE:
        return DiagnosticLevel.ERROR, told(alarm)
    if missing:
        return DiagnosticLevel.STALE, "; ".join((*missing, *broken))
    if not loop.profile:
        return DiagnosticLevel.ERROR, "; ".join(("no profile runs", *broken))
    if alarm is not None or broken:
        words = [told(alarm)] if alarm is not None else []
        return DiagnosticLevel.WARN, "; ".join((*words, *broken))
    return DiagnosticLevel.OK, f"profile {loop.profile}"


def answer_to(
    requirement: Requirement, loop: Adaptation, attributes: Mapping[str, Attribute], given: Mapping[str, Value]
) -> tuple[DiagnosticLevel, str, dict[str, str]]:
    """What a client is told: how it is served, in words, and by attribute what it wanted and is given.

    Args:
        requirement: What it asks.
        loop: The resource's.
        attributes: By name.
        given: What was measured of those that it asks for, as far as it was.
    """
    values, short = {}, []
    for name, bound in requirement.bounds.items():
        attribute, value = attributes[name], given.get(name)
        shown = attribute.show(value) if value is not None else "not measured yet"
        values[name] = f"wanted {wanted(attribute, bound)}, given {shown}"
        if value is not None and not bound.met_by(attribute, value):
            short.append(name)
    lost = [str(conflict) for conflict in loop.asked.conflicts if conflict.client == requirement.client]
    level, message = _judged(loop, short, lost=bool(lost))
    return level, "; ".join(lost) if lost else message, values


def _judged(loop: Adaptation, short: Sequence[str], *, lost: bool) -> tuple[DiagnosticLevel, str]:
    alarm = loop.alarm
    if alarm is not None and alarm.kind is AlarmKind.NON_ADAPTABLE:
        return DiagnosticLevel.ERROR, told(alarm)
    if not loop.profile:
        return DiagnosticLevel.WARN, "no profile runs yet"
    if short or lost:
        return DiagnosticLevel.WARN, f"{', '.join(short)} {'fall' if len(short) > 1 else 'falls'} short"
    return DiagnosticLevel.OK, f"profile {loop.profile}"


def decision_of(loop: Adaptation, scores: Sequence[ProfileScore], reaction: float | None) -> dict[str, Any]:
    """How each profile does at this moment, with each term of it, for ``rmpa profile explain``; plain values."""
    return {
        "profile": loop.profile,
        "applying": loop.applying,
        "chosen": loop.pinned,
        "reaction": reaction,
        "alarm": loop.alarm.kind.value if loop.alarm is not None else "",
        "conflicts": [str(conflict) for conflict in loop.asked.conflicts],
        "clients": sorted(loop.requirements),
        "scores": [
            {
                "profile": score.profile,
                "distance": score.distance,
                "hard_shortfall": score.hard_shortfall,
                "feasible": score.feasible,
                "excluded": score.excluded,
                "terms": [
                    {
                        "attribute": term.attribute,
                        "wanted": term.wanted,
                        "offered": term.offered,
                        "delta": term.delta,
                        "weight": term.weight,
                        "hard": term.hard,
                    }
                    for term in score.terms
                ],
            }
            for score in scores
        ],
    }
