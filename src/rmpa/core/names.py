"""ROS graph names (wiki.ros.org/Names, REP 144) and the globs that rules are written in."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Final

_LEGAL: Final = re.compile(r"[~/A-Za-z][\w/]*", re.ASCII)
NEVER_CROSSING: Final = {
    "/rosout": "log messages stay home: a bridged /rosout would loop",
    "/rosout_agg": "log messages stay home: a bridged /rosout would loop",
    "/clock": "time stays home: two clocks in one graph make it jump",
    "/rmpa/**": "the agent's own topics stay home",
}
"""Topics that stay in their module under every policy, and why."""
_TYPE: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*")


def is_legal_name(name: str) -> bool:
    """Whether a graph resource may have this name, before it is resolved (empty is legal: the namespace)."""
    return name == "" or (_LEGAL.fullmatch(name) is not None and "//" not in name)


def is_global_name(name: str) -> bool:
    """Whether this is a resolved name, ``/like/this``."""
    return name.startswith("/") and is_legal_name(name) and (name == "/" or not name.endswith("/"))


def is_type_name(name: str) -> bool:
    """Whether this is a message or service type, ``package/Name``."""
    return _TYPE.fullmatch(name) is not None


def join_names(namespace: str, name: str) -> str:
    """``/ns`` and ``name`` to ``/ns/name``; a global ``name`` stays as it is."""
    if name.startswith("/"):
        return name
    return f"{namespace.rstrip('/')}/{name}" if namespace else name


def resolve_name(name: str, namespace: str = "/", node: str = "") -> str:
    """Resolve a graph name as a client library does.

    Args:
        name: As written: ``/global``, ``relative``, ``~private`` or empty (the namespace itself).
        namespace: The namespace to resolve relative names in.
        node: The node's own global name, for private names.

    Returns:
        A global name without a trailing slash.

    Raises:
        ValueError: ``name`` is not a legal name.
    """
    if not is_legal_name(name):
        raise ValueError(f"{name!r} is not a ROS name; allowed are letters, digits, _ and /, after a letter, / or ~")
    if name.startswith("~"):
        resolved = join_names(node or namespace, name[1:].lstrip("/"))
    else:
        resolved = join_names(namespace, name)
    return "/" + "/".join(part for part in resolved.split("/") if part)


@lru_cache(maxsize=4096)
def _compile_glob(pattern: str) -> re.Pattern[str]:
    # "/**/" also fits a single slash: any number of parts in between, or none. "/**" at the end fits no part, too.
    wild = {"/**/": "/(?:.*/)?", "**": ".*", "*": "[^/]*", "?": "[^/]"}
    pattern = re.sub(r"(?:/\*\*)+(?=/|$)", "/**", pattern)
    begin, end = (pattern[:-3], "(?:/.*)?") if pattern.endswith("/**") and pattern != "/**" else (pattern, "")
    pieces = re.split(r"(/\*\*/|\*\*|\*|\?)", begin)
    return re.compile("".join(wild.get(piece) or re.escape(piece) for piece in pieces) + end)


def matches(pattern: str, name: str) -> bool:
    """Whether a name fits a glob: ``*`` and ``?`` stay within one part of the name, ``**`` crosses slashes.

    ``/camera/**`` also fits ``/camera`` itself, as people expect of a namespace; likewise ``/**/cmd_vel`` fits
    ``/cmd_vel``, and ``/a/**/b`` fits ``/a/b``.
    """
    return _compile_glob(pattern).fullmatch(name) is not None
