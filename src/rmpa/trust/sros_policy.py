"""Reads access control policies of SROS 2 (``policy.xml``, design.ros2.org/articles/ros2_access_control_policies).

An enclave says what its nodes may do, by ROS names:

=====================================  ==================
element and attribute                  key of the rule
=====================================  ==================
``topics publish``, ``subscribe``      the same
``services request``, ``reply``        ``call``, ``serve``
``actions call``, ``execute``          ``action``, ``action_serve``
=====================================  ==================

A name is relative to the namespace of its profile; one with ``~`` is below the node's own.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

from rmpa.config.permission_rules import ACTION_CLIENT, ACTION_SERVER, NAME_KEYS, Access, Effect, PermissionRule
from rmpa.config.values import BadValue, read_topic_glob
from rmpa.core.identity import peer_name_from
from rmpa.core.names import NEVER_CROSSING, join_names, matches

if TYPE_CHECKING:
    from collections.abc import Iterator
    from xml.etree.ElementTree import Element

_KEYS: Final = {
    ("topics", "publish"): Access.PUBLISH.value,
    ("topics", "subscribe"): Access.SUBSCRIBE.value,
    ("services", "request"): Access.CALL.value,
    ("services", "reply"): Access.SERVE.value,
    ("actions", "call"): ACTION_CLIENT,
    ("actions", "execute"): ACTION_SERVER,
}
_EFFECTS: Final = {"ALLOW": Effect.ALLOW, "DENY": Effect.DENY}
_INCLUDE: Final = "{http://www.w3.org/2001/XInclude}include"


def policy_rules(root: Element, notes: dict[str, None]) -> Iterator[PermissionRule]:
    """The rules of a policy.

    Args:
        root: The element ``policy``.
        notes: Gets what was left out, for the user.
    """
    for enclave in root.iterfind("enclaves/enclave"):
        path = enclave.get("path", "")
        last = path.strip().rstrip("/").rpartition("/")[2]
        if not last:
            notes[f"enclave {path[:100]!r} has no name for its module, and is left out"] = None
            continue
        found: dict[Effect, dict[str, dict[str, None]]] = {Effect.ALLOW: {}, Effect.DENY: {}}
        for profile in enclave.iterfind("profiles/profile"):
            if profile.find(_INCLUDE) is not None:
                notes["files that a profile includes (xi:include) are not read"] = None
            for effect, key, name in _profile(profile, notes):
                found[effect].setdefault(key, {})[name] = None
        for effect, keys in found.items():
            names = {key: tuple(keys[key]) for key in NAME_KEYS if key in keys}
            if names:
                yield PermissionRule((peer_name_from(last),), (), effect, names)


def _profile(profile: Element, notes: dict[str, None]) -> Iterator[tuple[Effect, str, str]]:
    """What the profile of one node allows and denies: effect, key and name of each."""
    namespace = f"/{profile.get('ns', '/').strip('/ ')}".rstrip("/")
    node = f"{namespace}/{profile.get('node', '').strip('/ ')}"
    for (tag, attribute), key in _KEYS.items():
        for group in profile.iterfind(tag):
            effect = _EFFECTS.get(group.get(attribute, "").strip().upper())
            if effect is None:
                continue
            for one in group.iterfind(tag.removesuffix("s")):
                name = _name((one.text or "").strip(), namespace, node, notes)
                if name:
                    yield effect, key, name


def _name(written: str, namespace: str, node: str, notes: dict[str, None]) -> str:
    """The global name, or glob, of what a user has written; empty, with a note, if it does not fit."""
    if written.startswith("~"):
        name = join_names(node, written[1:].lstrip("/"))
    else:
        name = join_names(namespace or "/", written)
    name = re.sub(r"\*+", "**", name)
    try:
        read_topic_glob(name)
    except BadValue as error:
        notes[f"{written[:200]!r} is left out: {error.problem}"] = None
        return ""
    if why := next((why for pattern, why in NEVER_CROSSING.items() if matches(pattern, name)), ""):
        notes[f"{written[:200]!r} is left out: {why}"] = None
        return ""
    return name
