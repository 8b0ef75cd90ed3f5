"""Whether a comparison of all names with the local graph would find anything."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge import limits

if TYPE_CHECKING:
    from rmpa.ros.master.parameters import GraphState


class UnchangedGraph:
    """Remembers the graph of the last comparison; pure.

    A graph of 1,000 modules has tens of thousands of names, and comparing them takes half a second of processor time.
    A core returns the same object until something is registered, so an idle agent compares seldom.
    """

    __slots__ = ("_seen", "_skipped")

    def __init__(self) -> None:
        self._seen: GraphState | None = None
        self._skipped = 0

    def is_due(self, state: GraphState, *, steady: bool) -> bool:
        """Whether to compare now: the graph is another one, or the last comparison is long ago.

        Args:
            state: The local graph.
            steady: Whether nothing outside the graph, as a node's reachability, decides what a comparison finds.
        """
        if steady and state is self._seen and self._skipped < limits.RECONCILE_SKIPS:
            self._skipped += 1
            return False
        self._seen, self._skipped = state, 0
        return True
