"""Which nodes of one peer have a place in the local graph, within ``limits.nodes`` of this module."""

from __future__ import annotations

from collections import Counter, OrderedDict
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterator

_Thing = TypeVar("_Thing")


class NodePlaces(Generic[_Thing]):
    """The nodes of one peer that are in the local graph, and what is refused because its node is not.

    A node takes a place as long as one thing of it (a topic, a service) is shown. A lower limit ends nothing that is
    shown: it holds for the nodes that come.

    Args:
        limit: How many places there are.
    """

    __slots__ = ("_shown", "limit", "refused")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._shown: Counter[str] = Counter()
        # Ordered: taking the first item of a plain dict passes over all that were taken before it.
        self.refused: OrderedDict[str, dict[_Thing, None]] = OrderedDict()
        """The nodes without a place, and the things of each."""

    def free(self, node: str) -> bool:
        """Whether a node may show a thing: it has a place, or a place is free."""
        return node in self._shown or len(self._shown) < self.limit

    def refuse(self, node: str, thing: _Thing) -> None:
        """Note that a thing is hidden because its node has no place."""
        self.refused.setdefault(node, {})[thing] = None

    def leave(self, node: str, thing: _Thing) -> None:
        """Note that a thing is shown, hidden for another reason, or gone."""
        things = self.refused.get(node)
        if things is not None:
            things.pop(thing, None)
            if not things:
                del self.refused[node]

    def show(self, node: str) -> None:
        """Count one more thing of a node that is shown."""
        self._shown[node] += 1

    def hide(self, node: str) -> None:
        """Count one thing less of a node that is shown; the last one frees the node's place."""
        self._shown[node] -= 1
        if not self._shown[node]:
            del self._shown[node]

    def admitted(self) -> Iterator[tuple[_Thing, ...]]:
        """Yield the things that may be shown now, one node's at a time, the first refused one first.

        The caller shows the things before it asks for the next node, or the place still counts as free.
        """
        while self.refused and self.free(next(iter(self.refused))):
            yield tuple(self.refused.popitem(last=False)[1])

    def give_up(self) -> None:
        """Forget what is refused: the peer is away."""
        self.refused.clear()


def warning(peer: str, kind: str, limit: int) -> str:
    """The text of the log when a peer first exceeds a limit."""
    return (
        f"{peer} has more than limits.{kind} = {limit} of this module; the rest is refused until there is room: "
        f"raise it in rmpa.toml and `rmpa reload`, or deny some; `rmpa peer info {peer}` counts them"
    )
