"""Actions that the control loop returns to its driver: apply a profile, raise or clear an alarm, report a change."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rmpa.resource.declare.attributes import Value
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
