"""The names of proxies in the local graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.policy import OWN_NODE

if TYPE_CHECKING:
    from collections.abc import Collection

    from rmpa.core.identity import Identity


def proxy_prefix(peer: Identity, taken: Collection[str]) -> str:
    """The namespace of one peer's proxies: ``/rmpa/<name>``.

    Args:
        peer: The peer.
        taken: Prefixes of other modules. Two modules of one name must not share a prefix, or their proxies would
            replace each other in the graph.
    """
    prefix = f"{OWN_NODE}/{peer.name}"
    if prefix in taken:
        address, port = peer.guid.endpoint
        prefix = f"{prefix}_{address.replace('.', '_')}_{port}"
    return prefix


def proxy_name(prefix: str, node: str) -> str:
    """The name of a node's proxy: ``/rmpa/joystick`` and ``/joy_node`` give ``/rmpa/joystick/joy_node``."""
    return prefix + node


def proxied_node(name: str) -> tuple[str, str] | None:
    """The peer's name and the node that a proxy stands for; ``None`` for a node of this module."""
    if not name.startswith(OWN_NODE + "/"):
        return None
    peer, slash, node = name[len(OWN_NODE) + 1 :].partition("/")
    return (peer, slash + node) if node else None


def proxied_peer(name: str) -> str | None:
    """The peer whose node a proxy stands for; ``None`` for a node of this module."""
    proxy = proxied_node(name)
    return proxy[0] if proxy is not None else None
