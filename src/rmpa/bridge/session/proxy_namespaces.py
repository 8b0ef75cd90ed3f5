"""Names the proxies: one namespace for each module that has nodes in the local graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.proxy_names import proxy_name, proxy_prefix
from rmpa.core.identity import Guid, Identity

if TYPE_CHECKING:
    from collections.abc import Collection

    from rmpa.bridge.messages import Origin


class ProxyNamespaces:
    """The namespaces of peers and of relayed modules; no two modules share one."""

    def __init__(self) -> None:
        self._linked: dict[int, tuple[str, str]] = {}
        """The module's instance and its namespace, by the session's number."""
        self._relayed: dict[str, str] = {}
        """The namespace of each relayed module, by its instance."""
        self._reserved: set[str] = set()
        """The instances whose namespaces are kept while they have no proxy."""

    def add(self, peer: int, identity: Identity) -> str:
        """Return the namespace of a peer, which is reserved until ``remove``."""
        instance = identity.instance.hex()
        prefix = proxy_prefix(identity, self._taken(instance))
        self._linked[peer] = (instance, prefix)
        return prefix

    def remove(self, peer: int) -> None:
        """Release the namespace of a peer that is gone for good."""
        self._linked.pop(peer, None)

    def relayed_name(self, origin: Origin, *, reserve: bool = False) -> str:
        """The name of a relayed node's proxy, made by the same rules as for linked modules.

        Args:
            origin: Its module and node.
            reserve: Whether the namespace is kept for good.
        """
        if reserve:
            self._reserved.add(origin.instance)
        prefix = self._relayed.get(origin.instance)
        if prefix is None:
            module = Identity(Guid.parse(origin.guid), bytes.fromhex(origin.instance), origin.name)
            prefix = self._relayed[origin.instance] = proxy_prefix(module, self._taken(origin.instance))
        return proxy_name(prefix, origin.node)

    def forget_unused(self, names: Collection[str]) -> None:
        """Forget the relayed modules that have no proxy among ``names``."""
        self._relayed = {
            instance: prefix
            for instance, prefix in self._relayed.items()
            if instance in self._reserved or any(name.startswith(f"{prefix}/") for name in names)
        }

    def _taken(self, instance: str) -> set[str]:
        """The namespaces that other modules have."""
        linked = {prefix for other, prefix in self._linked.values() if other != instance}
        return linked | {prefix for other, prefix in self._relayed.items() if other != instance}
