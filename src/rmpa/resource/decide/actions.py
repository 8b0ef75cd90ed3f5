"""What the loop of a resource asks its driver for: apply a profile, raise an alarm, say that it is over."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.requirements import Bound


class AlarmKind(Enum):
    """What an alarm says; the level of REP 107 that it is shown with."""

    ADAPTATION = "adaptation"
    """A quality is not satisfied, and another profile takes over: WARN."""
    NON_ADAPTABLE = "non_adaptable"
    """No profile meets what is asked; the most similar one runs: ERROR."""


@dataclass(frozen=True, slots=True)
class Shortfall:
    """One attribute that is not as asked.

    Args:
        attribute: Its name.
        wanted: The bound.
        given: What was measured, or what the profile offers; ``None``: nothing.
    """

    attribute: str
    wanted: Bound
    given: Value | None


@dataclass(frozen=True, slots=True)
class Alarm:
    """What every client is told.

    Args:
        kind: Adaptation or non-adaptable.
        shortfalls: What was asked and is not given.
        before: The profile that ran, or empty.
        after: The one that takes over, or the same.
        at: When, monotonic seconds.
    """

    kind: AlarmKind
    shortfalls: tuple[Shortfall, ...]
    before: str
    after: str
    at: float


@dataclass(frozen=True, slots=True)
class Apply:
    """Apply this profile, and report ``applied`` or ``failed``; ``why`` is for people."""

    profile: str
    why: str


@dataclass(frozen=True, slots=True)
class Raise:
    """Tell every client, and the diagnostics."""

    alarm: Alarm


@dataclass(frozen=True, slots=True)
class Clear:
    """What an alarm said is over."""

    alarm: Alarm


@dataclass(frozen=True, slots=True)
class Reacted:
    """A reconfiguration is complete.

    Args:
        profile: The one that runs now.
        reaction: Seconds since the request that called for it, or since the first window that did so began.
    """

    profile: str
    reaction: float


Action = Apply | Raise | Clear | Reacted
