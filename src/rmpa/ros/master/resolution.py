"""Names as rosmaster resolves them: any characters, relative to the caller.

Stricter rules (``core.names``) hold for names that RMPA makes; a master accepts what rosmaster accepts.
"""

from __future__ import annotations


def canonical(name: str) -> str:
    """Return a name without doubled or trailing slashes; ``/`` and the empty name stay."""
    joined = "/".join(part for part in name.split("/") if part)
    return f"/{joined}" if name.startswith("/") else joined


def namespace_of(caller_id: str) -> str:
    """The caller's namespace with its trailing slash; ``/`` for callers without one."""
    name = caller_id.removesuffix("/")
    return name[: name.rfind("/") + 1] or "/"


def resolve(name: str, caller_id: str) -> str:
    """Resolve ``/global``, ``relative`` and ``~private`` names for a caller; the empty name is its namespace."""
    if not name:
        return namespace_of(caller_id)
    name = canonical(name)
    if name.startswith("~"):
        return canonical(f"{caller_id}/{name[1:]}")
    if name.startswith("/"):
        return name
    return namespace_of(caller_id) + name


def join(namespace: str, name: str) -> str:
    """``namespace/name``; a global or private name stays as it is."""
    if name.startswith(("/", "~")) or not namespace:
        return name
    return namespace + name if namespace.endswith("/") else f"{namespace}/{name}"


def with_slash(key: str) -> str:
    """A parameter's key as subscriptions and updates carry it: with one trailing slash."""
    return key if key == "/" else canonical(key) + "/"
