"""Keeps the state and the history of a resource in its store, and restores the state at the start."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, TypeVar

import msgspec

from rmpa.resource.decide.actions import Action, Apply, Clear, Raise, Reacted
from rmpa.resource.decide.reports import ALARM_LEVELS, describe_alarm
from rmpa.resource.decide.saved_state import (
    CHOSEN,
    CONTEXT,
    COOL_DOWN,
    LAST,
    PARAMETER,
    REQUIREMENT,
    SavedCoolDown,
    SavedRequirement,
    SavedState,
    read_saved_state,
)
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.diagnostic_array import DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.decide.actions import Alarm
    from rmpa.resource.decide.saved_state import Key
    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.parameters import Parameter
    from rmpa.resource.run.adapter import Adapter
    from rmpa.resource.run.contexts import Contexts
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.store import ResourceStore

_log = logging.getLogger(__name__)
_SECOND = 1_000_000_000
_Row = TypeVar("_Row", SavedRequirement, SavedCoolDown)


class Persistence(RuntimePart):
    """The part of a resource that writes its state and history to its store.

    Args:
        runtime: The runtime of the resource.
        adapter: Provides the requirements, the cool-downs and the profiles to store.
        contexts: Provides the context chosen by hand.
        store: The resource's store, not yet open; closed with the resource.
    """

    def __init__(self, runtime: Runtime, adapter: Adapter, contexts: Contexts, store: ResourceStore) -> None:
        self._runtime = runtime
        self._adapter = adapter
        self._contexts = contexts
        self._store = store
        self._stored: dict[Key, str] = {}

    @property
    def problem(self) -> str:
        """Why nothing can be stored at present; empty if storing works."""
        return f"nothing is kept: {self._store.problem}" if self._store.problem else ""

    async def restore(self) -> SavedState:
        """Open the store, restore the parameters and return the saved state; called before the parts start."""
        rows = await self._store.open()
        resource = self._runtime.resource
        found = read_saved_state(rows, resource, time.time_ns())
        for lost in found.lost:
            _log.warning("! %s: not remembered: %s", self._runtime.node.name, lost)
        for name, value in found.parameters.items():
            parameter = resource.parameters[name]
            if not parameter.given:
                parameter.value = value
        self._stored = dict(rows)
        if found.parameters or found.chosen or found.requirements:
            chosen = f", profile {found.chosen} chosen by hand" if found.chosen else ""
            _log.info(
                "= %s: remembered: %d parameters, %d clients%s",
                self._runtime.node.name,
                len(found.parameters),
                len(found.requirements),
                chosen,
            )
        return found

    async def start(self) -> None:
        """Store the descriptor and the present state."""
        descriptor = self._runtime.descriptor
        self._store.descriptor(descriptor.node, descriptor.serialize(), time.time_ns())
        for name, parameter in self._runtime.resource.parameters.items():
            if parameter.value != parameter.default:
                self._put((PARAMETER, name), _json(parameter.value))
        self.requirements_changed()

    async def close(self) -> None:
        """Write all pending changes and close the store."""
        await self._store.close()

    def parameter_changed(self, parameter: Parameter) -> None:
        """Store the parameter's value."""
        self._put((PARAMETER, parameter.name), _json(parameter.value))

    # --- inside -------------------------------------------------------------------------------------------------

    def _put(self, key: Key, value: str | None) -> None:
        if value is None:
            if self._stored.pop(key, None) is not None:
                self._store.put(key, None)
        elif self._stored.get(key) != value:
            self._stored[key] = value
            self._store.put(key, value)

    def requirements_changed(self) -> None:
        """Store the requirements, cool-downs and choices by hand that have changed."""
        now_ns = time.time_ns()
        requirements = {one.client: one for one in self._adapter.saved_requirements(now_ns)}
        for client, one in requirements.items():
            key = (REQUIREMENT, client)
            before = self._stored.get(key)
            if before is None or not _same_requirement(before, one):
                self._put(key, one.serialize())
        for kind, name in [key for key in self._stored if key[0] == REQUIREMENT and key[1] not in requirements]:
            self._put((kind, name), None)
        self._store_cool_downs(now_ns)
        loop = self._adapter.loop
        self._put(CHOSEN, _json(loop.pinned))
        self._put(CONTEXT, _json(self._contexts.chosen))
        if loop.profile:
            self._put(LAST, _json(loop.profile))

    def context_changed(self) -> None:
        """Store the context that was chosen by hand."""
        self.requirements_changed()

    def _store_cool_downs(self, now_ns: int) -> None:
        cool_downs = self._adapter.saved_cool_downs(now_ns)
        for name, one in cool_downs.items():
            key = (COOL_DOWN, name)
            known = _decoded(self._stored.get(key), SavedCoolDown)
            if known is None or not _same_cool_down(known, one):
                self._put(key, one.serialize())
        for key in [key for key in self._stored if key[0] == COOL_DOWN and key[1] not in cool_downs]:
            self._put(key, None)

    def window_ended(self, level: DiagnosticLevel, message: str, measured: Mapping[str, Value]) -> None:
        """Add the window to the history."""
        text = _json({key: round(v, 9) if isinstance(v, float) else v for key, v in measured.items()})
        self._store.window(time.time_ns(), self._adapter.loop.profile, int(level), message, text)

    def acted(self, action: Action) -> None:
        """Add the action to the history."""
        match action:
            case Apply():
                self._event("apply", DiagnosticLevel.OK, action.why, {"profile": action.profile})
            case Raise():
                level, text = ALARM_LEVELS[action.alarm.kind], describe_alarm(action.alarm)
                self._event("alarm", level, text, _details(action.alarm))
            case Clear():
                self._event("over", DiagnosticLevel.OK, describe_alarm(action.alarm), _details(action.alarm))
            case Reacted():
                details = {"profile": action.profile, "reaction": round(action.reaction, 6)}
                self._event("reacted", DiagnosticLevel.OK, f"{action.profile} runs", details)

    def missing_changed(self, text: str, *, missing: bool) -> None:
        """Add to the history that something the resource needs is missing, or is back."""
        event, level = ("alarm", DiagnosticLevel.STALE) if missing else ("over", DiagnosticLevel.OK)
        self._event(event, level, text, {"kind": "missing"})

    def _event(self, event: str, level: DiagnosticLevel, message: str, details: object) -> None:
        self._store.event(time.time_ns(), event, int(level), message, _json(details))


def _json(value: object) -> str:
    return msgspec.json.encode(value).decode()


def _decoded(text: str | None, kind: type[_Row]) -> _Row | None:
    """The content of a row, or ``None`` if there is none or it is damaged."""
    try:
        return msgspec.json.decode(text, type=kind) if text is not None else None
    except msgspec.DecodeError:
        return None


def _same_requirement(before: str, one: SavedRequirement) -> bool:
    """Whether a stored row equals a requirement; expiries may differ by up to a second, since clocks vary."""
    known = _decoded(before, SavedRequirement)
    if known is None:
        return False
    if (known.values, known.mark, known.stamp) != (one.values, one.mark, one.stamp):
        return False
    if known.expires_ns is None or one.expires_ns is None:
        return known.expires_ns == one.expires_ns
    return abs(known.expires_ns - one.expires_ns) < _SECOND


def _same_cool_down(known: SavedCoolDown, one: SavedCoolDown) -> bool:
    """Whether a stored row equals a cool-down; not if the wall clock was set by a second or more."""
    if (known.cool_down, known.why) != (one.cool_down, one.why):
        return False
    return abs(known.until_ns - one.until_ns) < _SECOND


def _details(alarm: Alarm) -> dict[str, object]:
    return {
        "kind": alarm.kind.value,
        "before": alarm.before,
        "after": alarm.after,
        "attributes": [short.attribute for short in alarm.shortfalls],
    }
