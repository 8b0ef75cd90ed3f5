"""What a page gets of Smart Resources: only what they say by topics to which its client may subscribe.

The server follows these topics once for all pages, so the rights of each page are judged here; no I/O.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rmpa.config.permission_rules import Access
from rmpa.resource.run.descriptor import TOPIC as DESCRIPTOR

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.web.hub.rights import Rights
    from rmpa.web.monitor.patch import Tree, Value

_QUALITY: Final = "quality"
_ALARMS: Final = "alarms"
_SOURCES: Final = {
    "state": "state",
    "profile": "profile",
    "context": "context",
    "level": _QUALITY,
    "message": _QUALITY,
    "health": _QUALITY,
    "clients": "responses",
    "decision": "decision",
    "parameters": "parameter_updates",
}
"""The topic below a resource of which a member of ``resource_entry`` and ``resource_detail`` is made; that of all
others is the descriptor."""


def visible_state(state: Tree, rights: Rights) -> Tree:
    """A state without what the client may not see of resources; the same state where the client has no rules."""
    if rights.look is None:
        return state
    shown = dict(state)
    resources, alarms = state.get("resources"), state.get("alarms")
    if isinstance(resources, dict):
        seen = {key: visible_resource(one, rights) for key, one in resources.items() if isinstance(one, dict)}
        shown["resources"] = {key: one for key, one in seen.items() if one is not None}
    if isinstance(alarms, dict):
        shown["alarms"] = {
            key: alarm
            for key, alarm in alarms.items()
            if not isinstance(alarm, dict) or _may(rights, _path(alarm.get("resource")), _QUALITY)
        }
    return shown


def visible_resource(resource: Tree, rights: Rights) -> Tree | None:
    """A ``resource_entry`` or ``resource_detail`` without what the client may not see; ``None``: all of it.

    What is hidden is as of a resource that has not said it yet.
    """
    if rights.look is None:
        return resource
    name = str(resource.get("name", ""))
    if not _may(rights, name, DESCRIPTOR):
        return None
    hidden = {topic for topic in set(_SOURCES.values()) if not _may(rights, name, topic)}
    shown: Tree = {}
    for key, value in resource.items():
        if _SOURCES.get(key) not in hidden:
            shown[key] = value
        elif key != "health":
            shown[key] = _unsaid(value)
    return shown


def visible_history(history: Iterable[dict[str, Any]], rights: Rights) -> list[dict[str, Any]]:
    """The entries of ``ResourceWatch.history`` that the client may see: links, and alarms of resources."""
    return [
        each
        for each in history
        if rights.look is None or "resource" not in each or _may(rights, _path(each["resource"]), _ALARMS)
    ]


def _may(rights: Rights, name: str, topic: str) -> bool:
    return rights.look is None or rights.look.allows(Access.SUBSCRIBE, f"{name}/{topic}")


def _path(key: Value) -> str:
    """The name of a resource by ``ResourceFacts.key``: a module's name has no slash."""
    return f"/{str(key or '').partition('/')[2]}"


def _unsaid(value: Value) -> Value:
    return type(value)() if value is not None else None
