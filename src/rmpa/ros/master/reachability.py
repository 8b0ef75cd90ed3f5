"""Registered nodes to which connecting fails: an address without a route, a host name that does not resolve.

Such a node may live: its network may be down for a moment. It stays registered, as at roscore, but after
``limits.NODE_UNREACHABLE_AFTER`` it is *withdrawn*: its topics and services are no longer offered to peers. Pure: the
time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True, slots=True)
class Unreachable:
    """A node to which connecting fails.

    Args:
        api: The slave API's URI that it registered with.
        problem: Why the last attempt failed, for people.
        since: When the first attempt failed, in seconds of the monotonic clock.
        withdrawn: Whether its topics and services are no longer offered to peers.
    """

    api: str
    problem: str
    since: float
    withdrawn: bool = False


class Reachability:
    """The nodes that could not be reached when they were last tried."""

    def __init__(self) -> None:
        self._nodes: dict[str, Unreachable] = {}

    @property
    def unreachable(self) -> Mapping[str, Unreachable]:
        """The nodes that could not be reached, by name; not to be changed."""
        return self._nodes

    def failed(self, node: str, api: str, problem: str, now: float) -> bool:
        """Note an attempt to connect that failed without being refused; return whether this withdraws the node.

        Args:
            node: The node's name.
            api: Its slave API.
            problem: Why the attempt failed, for people.
            now: Monotonic seconds.
        """
        known = self._nodes.get(node)
        if known is None or known.api != api:
            known = Unreachable(api, problem, now)
        withdrawn = now - known.since >= limits.NODE_UNREACHABLE_AFTER
        self._nodes[node] = replace(known, problem=problem, withdrawn=withdrawn)
        return withdrawn and not known.withdrawn

    def reached(self, node: str) -> bool:
        """Note that a node can be connected to; return whether it was withdrawn before."""
        known = self._nodes.pop(node, None)
        return known is not None and known.withdrawn

    def keep(self, nodes: Mapping[str, str]) -> None:
        """Drop all but these nodes at these slave APIs."""
        if self._nodes:
            self._nodes = {node: known for node, known in self._nodes.items() if nodes.get(node) == known.api}
