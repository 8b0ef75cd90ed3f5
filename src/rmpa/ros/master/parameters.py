"""The parameter server, the resolution of names, and the effects of changes on nodes.

Calls to slave APIs that follow from a change in the master's tables, and reports of changes.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

if TYPE_CHECKING:
    from rmpa.core.timers import Yielder
    from rmpa.ros.wire.xmlrpc import XmlRpcValue


# A call of a slave that follows from a change: its slave API, the method, and what the call tells.
#
# * ``publisherUpdate``: a topic, and its publishers in order of registration;
# * ``paramUpdate``: a key that ends in ``/``, and its value; ``{}`` if deleted;
# * ``shutdown``: a node whose name another node has taken, and the topics that it published: the header of one shows
#   whether that node is still at the address.
SlaveCall: TypeAlias = "tuple[str, str, str, XmlRpcValue]"


class RegistrationKind(enum.Enum):
    """The kinds of registration at a master."""

    PUBLISHER = "publisher"
    SUBSCRIBER = "subscriber"
    SERVICE = "service"
    PARAM = "param"


@dataclass(frozen=True, slots=True)
class GraphChange:
    """One registration that was added or removed, or changed its type.

    Args:
        kind: Its kind; subscriptions to parameters are not reported.
        added: Whether it was added (or changed its type) or removed.
        name: The topic or service.
        node: The node that registered it.
        api: The node's XML-RPC URI.
        type: The topic's type as far as known: ``pkg/Name``, ``*`` or empty; empty for services.
    """

    kind: RegistrationKind
    added: bool
    name: str
    node: str
    api: str
    type: str = ""

    def __str__(self) -> str:
        """``+ publisher /chatter of /talker``."""
        return f"{'+' if self.added else '-'} {self.kind.value} {self.name} of {self.node}"


@dataclass(frozen=True, slots=True)
class GraphState:
    """All registrations at one moment; never changed afterwards.

    Args:
        publishers: By topic, in order of registration: node to XML-RPC URI.
        subscribers: By topic: node to XML-RPC URI.
        services: By service: node to ``rosrpc://`` URI.
        types: By topic, also of topics without registrations.
        nodes: Node to XML-RPC URI.
    """

    publishers: dict[str, dict[str, str]]
    subscribers: dict[str, dict[str, str]]
    services: dict[str, dict[str, str]]
    types: dict[str, str]
    nodes: dict[str, str]


# Names as rosmaster resolves them. Any characters, relative to the caller.
#
# Stricter rules (``core.identity``) hold for names that RMPA makes; a master accepts what rosmaster accepts.


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


# The parameter tree, and the notifications for its subscribers. The tree is never changed in place: a change copies
# the dicts along its path, so values that callers hold stay as they are. Keys are resolved names; a value that is a
# dict is a namespace.


Tree: TypeAlias = "dict[str, XmlRpcValue]"
_V = TypeVar("_V")


def _parts(key: str) -> list[str]:
    return [part for part in key.split("/") if part]


def _changed(tree: Tree, parts: list[str], change: Callable[[Tree, str], object]) -> Tree:
    """A copy of the tree in which ``change`` was made to the namespace at the end of a path, and to its last part."""
    first, *rest = parts
    copy = dict(tree)
    if rest:
        below = tree.get(first)
        copy[first] = _changed(below if isinstance(below, dict) else {}, rest, change)
    else:
        change(copy, first)
    return copy


def leaves(key: str, value: _V) -> Iterator[tuple[str, _V]]:
    """Yield the parameters that a value at a key consists of: itself, or each member of a namespace, at any depth."""
    waiting: list[tuple[str, Any]] = [(key, value)]
    while waiting:
        at, part = waiting.pop()
        if isinstance(part, Mapping):
            waiting.extend((f"{at.rstrip('/')}/{name}", part[name]) for name in reversed(list(part)))
        else:
            yield at, part


def holds_nil(value: XmlRpcValue, yielder: Yielder = iter) -> bool:
    """Whether a value is or contains nil, at any depth; ROS has no nil, and no response with one can be written."""
    waiting = [value]

    def parts() -> Iterator[XmlRpcValue]:
        while waiting:
            yield (part := waiting.pop())
            if isinstance(part, dict | list | tuple):
                waiting.extend(part.values() if isinstance(part, dict) else part)

    return any(part is None for part in yielder(parts()))


class Parameters:
    """The tree of one parameter server.

    Attributes:
        tree: The whole tree, not to be changed; it and each of its parts stay the same object until a value changes.
    """

    def __init__(self) -> None:
        self.tree: Tree = {}

    def get(self, key: str) -> XmlRpcValue:
        """The value or the namespace at ``key``; ``/`` is the whole tree. The caller must not change it.

        Raises:
            KeyError: ``key`` does not exist.
        """
        value: XmlRpcValue = self.tree
        for part in _parts(key):
            if not isinstance(value, dict):
                raise KeyError(key)
            value = value[part]
        return value

    def has(self, key: str) -> bool:
        """Whether there is a value or a namespace, also an empty one, at ``key``."""
        try:
            self.get(key)
        except KeyError:
            return False
        return True

    def set(self, key: str, value: XmlRpcValue) -> None:
        """Put a value or a namespace at ``key``, in place of the former one.

        Where a parent of ``key`` is a plain value, a namespace replaces it.

        Args:
            key: The resolved name.
            value: Stored without a copy; must not be changed afterwards.

        Raises:
            ValueError: ``key`` is the root, and ``value`` is no dict.
        """
        if parts := _parts(key):
            self.tree = _changed(self.tree, parts, lambda namespace, name: namespace.update({name: value}))
        elif isinstance(value, dict):
            self.tree = value
        else:
            raise ValueError("the root of the parameter tree can only be set to a dictionary")

    def delete(self, key: str) -> None:
        """Delete ``key``.

        Raises:
            KeyError: ``key`` does not exist, or is the root.
        """
        parts = _parts(key)
        if not parts:
            raise KeyError(key)
        self.tree = _changed(self.tree, parts, dict.pop)

    def names(self) -> Iterator[str]:
        """The full names of all values, from the tree at the time of the call; an empty namespace has none."""
        return _names("/", self.tree)

    def search(self, namespace: str, key: str) -> str | None:
        """Find ``key`` in ``namespace`` or the nearest one above it.

        Only the first part of ``key`` has to exist, as in rosmaster: a search for ``robot/arm`` stops at the
        nearest ``robot``, whether it has an ``arm`` or not.

        Raises:
            ValueError: ``key`` is private or empty, or ``namespace`` is not global.
        """
        if not key or key.startswith("~"):
            raise ValueError(f"{key!r} cannot be searched for: write a relative or a global name")
        if not namespace.startswith("/"):
            raise ValueError(f"{namespace!r} is not a global name to search from")
        if key.startswith("/"):
            return key if self.has(key) else None
        first, above = _parts(key)[0], _parts(namespace)
        while not self.has(join(namespace, first)):
            if not above:
                return None
            above.pop()
            namespace = "/" + "/".join(above)
        return join(namespace, key)


def _names(namespace: str, tree: Tree) -> Iterator[str]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _names(join(namespace, name), value)
        else:
            yield join(namespace, name)


def _below(key: str, value: XmlRpcValue) -> Iterator[tuple[str, XmlRpcValue]]:
    """Yield every key below ``key`` with its value, each namespace before its content.

    A member whose name holds a slash is left out: no key leads to it, and joined it may be another parameter's key.
    """
    if isinstance(value, dict):
        for name, part in value.items():
            if "/" in name:
                continue
            full = join(key, name) + "/"
            yield full, part
            yield from _below(full, part)


def updates(
    subscribers: Mapping[str, Mapping[str, str]],
    key: str,
    value: XmlRpcValue,
    setter: str | None = None,
    yielder: Yielder = iter,
) -> list[SlaveCall]:
    """The notifications after a parameter was set or deleted.

    Args:
        subscribers: Subscribed keys, each ending in ``/``, with nodes and their slave APIs.
        key: The key that changed.
        value: Its new value; ``{}`` if it was deleted.
        setter: The node that set it, which is not notified for subscriptions of the key or of a namespace above it.
        yielder: Iterates, and serves pending data in between, for large values.

    Returns:
        In rosmaster's order: first for subscriptions of the key, of a namespace above it, or of a key below it that
        no longer exists; then for subscriptions of keys below it that exist.
    """
    if not subscribers:
        return []
    key = with_slash(key)
    # Walks through the value only if there is a subscription below it: few values have one, and some are large.
    within = any(subscribed != key and subscribed.startswith(key) for subscribed in subscribers)
    below = dict(yielder(_below(key, value))) if within else {}
    found: list[SlaveCall] = []
    for subscribed, nodes in subscribers.items():
        if key.startswith(subscribed):
            found += [(api, "paramUpdate", key, value) for node, api in nodes.items() if node != setter]
        elif isinstance(value, dict) and subscribed.startswith(key) and subscribed not in below:
            found += [(api, "paramUpdate", subscribed, {}) for api in nodes.values()]
    for full, part in below.items():
        found += [(api, "paramUpdate", full, part) for api in subscribers.get(full, {}).values()]
    return found
