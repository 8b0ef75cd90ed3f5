"""Actions of the control loop for its driver: apply a profile, raise or clear an alarm."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.requirements import Bound


class AlarmKind(Enum):
    """The kind of an alarm, and the level of REP 107 that it is shown with."""

    ADAPTATION = "adaptation"
    """A quality is not satisfied, and another profile takes over: WARN."""
    NON_ADAPTABLE = "non_adaptable"
    """No profile meets the requirements; the most similar one runs: ERROR."""


@dataclass(frozen=True, slots=True)
class Shortfall:
    """One attribute that violates the requirements.

    Args:
        attribute: Its name.
        requested: The bound.
        offered: The measured value, or the one that the profile declares; ``None``: neither.
    """

    attribute: str
    requested: Bound
    offered: Value | None


@dataclass(frozen=True, slots=True)
class Alarm:
    """An alarm for all clients.

    Args:
        kind: Adaptation or non-adaptable.
        shortfalls: The violated attributes.
        before: The profile that ran, or empty.
        after: The one that takes over, or the same.
        at: Monotonic seconds.
    """

    kind: AlarmKind
    shortfalls: tuple[Shortfall, ...]
    before: str
    after: str
    at: float


@dataclass(frozen=True, slots=True)
class Apply:
    """Apply this profile and report ``applied`` or ``failed``; ``why`` is for people."""

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
        profile: The one that runs now.
        reaction: Reaction time in seconds, since its cause: a request, or the beginning of the first violated window.
    """

    profile: str
    reaction: float


Action = Apply | Raise | Clear | Reacted
