"""What a resource remembers: takes it from its store at the start, and tells the store what changes."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING, TypeVar

import msgspec

from rmpa.resource.decide.adaptation import Action, AlarmKind, Apply, Clear, Raise, Reacted
from rmpa.resource.decide.reports import told
from rmpa.resource.decide.saved_state import (
    CHOSEN,
    CONTEXT,
    COOL_DOWN,
    LAST,
    PARAMETER,
    REQUIREMENT,
    SavedCoolDown,
    SavedRequirement,
    recall,
)
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.diagnostic_array import DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.decide.adaptation import Alarm
    from rmpa.resource.decide.saved_state import Key
    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.resource import Parameter
    from rmpa.resource.run.adapter import Adapter
    from rmpa.resource.run.contexts import Contexts
    from rmpa.resource.run.runtime import Runtime
    from rmpa.resource.run.store import ResourceStore

_log = logging.getLogger(__name__)
_SECOND = 1_000_000_000
_Row = TypeVar("_Row", SavedRequirement, SavedCoolDown)


class Persistence(RuntimePart):
    """The memory of one resource.

    Args:
        runtime: Of the resource.
        adapter: Takes what clients asked before, and tells what changes.
        contexts: Take the one that was chosen by hand.
        store: Not yet open; closed with the resource.
    """

    def __init__(self, runtime: Runtime, adapter: Adapter, contexts: Contexts, store: ResourceStore) -> None:
        self._runtime = runtime
        self._adapter = adapter
        self._contexts = contexts
        self._store = store
        self._said: dict[Key, str] = {}

    @property
    def problem(self) -> str:
        """Why nothing is kept at present, or empty."""
        return f"nothing is kept: {self._store.problem}" if self._store.problem else ""

    async def recall(self) -> None:
        """Take what was before, to be called before the node is registered and any other part starts."""
        rows = await self._store.open()
        resource = self._runtime.resource
        found = recall(rows, resource, time.time_ns())
        for lost in found.lost:
            _log.warning("! %s: not remembered: %s", self._runtime.node.name, lost)
        for name, value in found.parameters.items():
            parameter = resource.parameters[name]
            if not parameter.given:
                parameter.value = value
        self._adapter.recalled = found
        self._adapter.chosen = found.chosen
        self._contexts.chosen = found.context
        self._said = dict(rows)
        if found.parameters or found.chosen or found.asked:
            chosen = f", profile {found.chosen} chosen by hand" if found.chosen else ""
            _log.info(
                "= %s: remembered: %d parameters, %d clients%s",
                self._runtime.node.name,
                len(found.parameters),
                len(found.asked),
                chosen,
            )

        self._adapter.listeners.append(self._acted)
        self._adapter.on_window.append(self._window)
        self._adapter.on_asked.append(self._asked)
        self._adapter.on_missing.append(self._missing)
        self._adapter.on_late.append(lambda text: self._event("late", DiagnosticLevel.WARN, text, {}))
        self._contexts.listeners.append(self._asked)

    async def start(self) -> None:
        """Remember what there is now."""
        descriptor = self._runtime.descriptor
        self._store.descriptor(descriptor.node, descriptor.serialize(), time.time_ns())
        for name, parameter in self._runtime.resource.parameters.items():
            if parameter.value != parameter.default:
                self._put((PARAMETER, name), _json(parameter.value))
        self._asked()

    async def close(self) -> None:
        """Write what is not written yet."""
        await self._store.close()

    def parameter_changed(self, parameter: Parameter) -> None:
        """Remember it."""
        self._put((PARAMETER, parameter.name), _json(parameter.value))

    # --- inside -------------------------------------------------------------------------------------------------

    def _put(self, key: Key, value: str | None) -> None:
        if value is None:
            if self._said.pop(key, None) is not None:
                self._store.put(key, None)
        elif self._said.get(key) != value:
            self._said[key] = value
            self._store.put(key, value)

    def _asked(self) -> None:
        """Something that was asked, or chosen by hand, may be another."""
        now_ns = time.time_ns()
        asked = {one.client: one for one in self._adapter.asked(now_ns)}
        for client, one in asked.items():
            key = (REQUIREMENT, client)
            before = self._said.get(key)
            if before is None or not _same(before, one):
                self._put(key, one.serialize())
        for kind, name in [key for key in self._said if key[0] == REQUIREMENT and key[1] not in asked]:
            self._put((kind, name), None)
        self._cooling(now_ns)
        loop = self._adapter.loop
        self._put(CHOSEN, _json(loop.pinned))
        self._put(CONTEXT, _json(self._contexts.chosen))
        if loop.profile:
            self._put(LAST, _json(loop.profile))

    def _cooling(self, now_ns: int) -> None:
        """Profiles may be left out, or no longer."""
        cooling = self._adapter.cooling(now_ns)
        for name, one in cooling.items():
            key = (COOL_DOWN, name)
            known = _decoded(self._said.get(key), SavedCoolDown)
            if known is None or not _alike(known, one):
                self._put(key, one.serialize())
        for key in [key for key in self._said if key[0] == COOL_DOWN and key[1] not in cooling]:
            self._put(key, None)

    def _window(self, level: DiagnosticLevel, message: str, measured: Mapping[str, Value]) -> None:
        text = _json({key: round(v, 9) if isinstance(v, float) else v for key, v in measured.items()})
        self._store.window(time.time_ns(), self._adapter.loop.profile, int(level), message, text)

    def _acted(self, action: Action) -> None:
        match action:
            case Apply():
                self._event("apply", DiagnosticLevel.OK, action.why, {"profile": action.profile})
            case Raise():
                level = (
                    DiagnosticLevel.ERROR if action.alarm.kind is AlarmKind.NON_ADAPTABLE else DiagnosticLevel.WARN
                )
                self._event("alarm", level, told(action.alarm), _details(action.alarm))
            case Clear():
                self._event("over", DiagnosticLevel.OK, told(action.alarm), _details(action.alarm))
            case Reacted():
                details = {"profile": action.profile, "reaction": round(action.reaction, 6)}
                self._event("reacted", DiagnosticLevel.OK, f"{action.profile} runs", details)

    def _missing(self, text: str, gone: bool) -> None:
        self._event(
            "alarm" if gone else "over",
            DiagnosticLevel.STALE if gone else DiagnosticLevel.OK,
            text,
            {"kind": "missing"},
        )

    def _event(self, event: str, level: DiagnosticLevel, message: str, details: object) -> None:
        self._store.event(time.time_ns(), event, int(level), message, _json(details))


def _json(value: object) -> str:
    return msgspec.json.encode(value).decode()


def _decoded(text: str | None, kind: type[_Row]) -> _Row | None:
    """What a row says, if there is one and it can be read."""
    try:
        return msgspec.json.decode(text, type=kind) if text is not None else None
    except msgspec.DecodeError:
        return None


def _same(before: str, one: SavedRequirement) -> bool:
    """Whether a row says the same; its expiry by the wall clock is never the same to the nanosecond."""
    known = _decoded(before, SavedRequirement)
    if known is None:
        return False
    if (known.values, known.mark, known.stamp) != (one.values, one.mark, one.stamp):
        return False
    if known.expires_ns is None or one.expires_ns is None:
        return known.expires_ns == one.expires_ns
    return abs(known.expires_ns - one.expires_ns) < _SECOND


def _alike(known: SavedCoolDown, one: SavedCoolDown) -> bool:
    """Whether a row says the same of a profile that is left out; it does not when the wall clock was set."""
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
