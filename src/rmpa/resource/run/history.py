"""Reads the history of a resource from its store: events, quality windows, and the profiles that ran."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.resource.run.descriptor import Descriptor
from rmpa.resource.run.store import open_read_only
from rmpa.ros.types.diagnostic_array import DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


@dataclass(frozen=True, slots=True)
class HistoryEvent:
    """An alarm, or an action of the control loop.

    Args:
        at: Time of the event, Unix seconds.
        event: ``apply``, ``reacted``, ``alarm`` or ``over``; see ``docs/smart-resources.md``.
        level: ``OK``, ``WARN``, ``ERROR`` or ``STALE``.
        message: A text for people.
        details: Further values by name, such as the profile.
    """

    at: float
    event: str
    level: str
    message: str
    details: dict[str, Any]


@dataclass(frozen=True, slots=True)
class ProfileRun:
    """A span of time under one profile.

    Args:
        profile: Name of the profile.
        at: When the profile was chosen, Unix seconds.
        until: When the next profile was chosen, Unix seconds; ``None`` for the last one.
        why: Why the profile was chosen.
        reaction: Seconds from the cause to the completion; ``None``: the profile was not applied, or not yet.
    """

    profile: str
    at: float
    until: float | None
    why: str
    reaction: float | None


@dataclass(frozen=True, slots=True)
class QualityWindow:
    """One quality window.

    Args:
        at: End of the window, Unix seconds.
        profile: The profile that ran.
        level: The resource's health, with the same values as in ``HistoryEvent``.
        message: A text for people.
        quality: Measured values by attribute, in the attributes' units.
    """

    at: float
    profile: str
    level: str
    message: str
    quality: dict[str, float | str]


def read_events(path: Path) -> list[HistoryEvent]:
    """All events, oldest first.

    Raises:
        OSError: The store cannot be read.
    """
    rows = _read(path, "SELECT at_ns, event, level, message, details FROM events ORDER BY id")
    return [
        HistoryEvent(at_ns / 1e9, str(event), _level(level), str(message), _decode(details))
        for at_ns, event, level, message, details in rows
    ]


def read_windows(path: Path) -> list[QualityWindow]:
    """All quality windows, oldest first.

    Raises:
        OSError: The store cannot be read.
    """
    rows = _read(path, "SELECT at_ns, profile, level, message, quality FROM windows ORDER BY id")
    return [
        QualityWindow(at_ns / 1e9, str(profile), _level(level), str(message), _decode(quality))
        for at_ns, profile, level, message, quality in rows
    ]


def read_units(path: Path) -> dict[str, str]:
    """The unit of each attribute, from the last descriptor in the store; empty without a readable descriptor.

    Raises:
        OSError: The store cannot be read.
    """
    rows = _read(path, "SELECT text FROM descriptors ORDER BY last_ns DESC LIMIT 1")
    try:
        return {each.name: each.unit for (text,) in rows for each in Descriptor.parse(str(text)).attributes}
    except RmpaError:
        return {}


def profile_runs(events: Sequence[HistoryEvent]) -> list[ProfileRun]:
    """The profiles that were chosen, oldest first."""
    chosen = [event for event in events if event.event == "apply"]
    runs = []
    for event, following in zip(chosen, [*chosen[1:], None], strict=True):
        profile, until = str(event.details.get("profile", "")), following.at if following is not None else None
        reactions = (
            each.details.get("reaction")
            for each in events
            if each.event == "reacted"
            and each.details.get("profile") == profile
            and event.at <= each.at
            and (until is None or each.at <= until)
        )
        runs.append(ProfileRun(profile, event.at, until, event.message, next(reactions, None)))
    return runs


def _read(path: Path, query: str) -> list[tuple[Any, ...]]:
    with open_read_only(path) as connection:
        return connection.execute(query).fetchall()


def _level(value: int) -> str:
    return DiagnosticLevel(int(value) & 3).name


def _decode(text: str) -> dict[str, Any]:
    """A JSON object; empty if the row is damaged."""
    try:
        return msgspec.json.decode(text, type=dict[str, Any])
    except msgspec.DecodeError:
        return {}
