"""Waits for what arrives at endpoints, and for a change of ROS 2's graph."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

from .branches import make_wait_set
from .taker import loaded

if TYPE_CHECKING:
    from collections.abc import Iterable

# The words of wait sets for the kinds of endpoints that are waited for, in the order in which they are handled.
_WORDS = {"MS": "subscription", "SC": "client", "SS": "service"}


class GraphGuard:
    """The guard condition of ROS 2's graph, which rclpy does not have: of rcl, by ctypes."""

    def __init__(self, node: Any) -> None:
        self.pointer = 0
        try:
            rcl = ctypes.CDLL(loaded("librcl.so"))
            of_node, self._add = rcl.rcl_node_get_graph_guard_condition, rcl.rcl_wait_set_add_guard_condition
            of_node.argtypes, of_node.restype = [ctypes.c_void_p], ctypes.c_void_p
            self._add.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
            self.pointer = of_node(node.handle.pointer) or 0
        except (OSError, AttributeError):
            pass  # the graph is polled

    def add(self, wait_set: Any) -> None:
        """Have a wait set wait for it too."""
        if self.pointer and hasattr(wait_set, "pointer") and self._add(wait_set.pointer, self.pointer, None):
            self.pointer = 0


class Waits:
    """A wait set for the endpoints that there are now.

    Args:
        native: rclpy's implementation.
        context: Of the endpoints.
        endpoints: They; publishers among them are left out.
        wake: A guard condition that ends the waiting.
        graph: That of the graph, or one that does not work.
    """

    def __init__(self, native: Any, context: Any, endpoints: Iterable[Any], wake: Any, graph: GraphGuard) -> None:
        by_kind: dict[str, list[Any]] = {kind: [] for kind in _WORDS}
        for endpoint in endpoints:
            by_kind.get(endpoint.kind, []).append(endpoint)
        counts = len(by_kind["MS"]), 2, 0, len(by_kind["SC"]), len(by_kind["SS"]), 0
        self._set = make_wait_set(native, counts, context)
        self._kinds = [
            (word, getattr(self._set, "add_" + word), [endpoint.handle for endpoint in by_kind[kind]])
            for kind, word in _WORDS.items()
            if by_kind[kind]
        ]
        self._by_pointer = {each.handle.pointer: each for endpoints in by_kind.values() for each in endpoints}
        self._wake = wake
        self._graph = graph
        self.graph_changed = False

    def wait(self, timeout: float) -> list[Any]:
        """Wait for so many seconds at the most; return the endpoints that have something."""
        wait_set = self._set
        wait_set.clear_entities()
        for _, add, handles in self._kinds:
            for handle in handles:
                add(handle)
        wait_set.add_guard_condition(self._wake)
        self._graph.add(wait_set)
        wait_set.wait(max(0, int(timeout * 1e9)))
        self.graph_changed = self._graph.pointer in wait_set.get_ready_entities("guard_condition")
        by_pointer, ready = self._by_pointer, wait_set.get_ready_entities
        return [by_pointer[pointer] for word, _, _ in self._kinds for pointer in ready(word)]
