"""What of a peer is beyond this module's ``[limits]``: how much, and how it is told to that peer.

Nothing that is beyond a limit vanishes: it is counted, it takes the place of what leaves, and both agents say so.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from rmpa.core.sizes import UINT32_MAX

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

_KINDS = ("nodes", "topics", "services")
_Thing = TypeVar("_Thing")


@dataclass(frozen=True, slots=True)
class Beyond:
    """What is hidden by one limit.

    Args:
        kind: The limit: ``nodes``, ``topics`` or ``services``.
        limit: Its value.
        hidden: How many of these are beyond it.
        topics: Of hidden nodes: the topics that are hidden with them.
        services: Of hidden nodes: the services.
    """

    kind: str
    limit: int
    hidden: int
    topics: int = 0
    services: int = 0

    @property
    def what(self) -> str:
        """``744 nodes with 3720 topics and 744 services``."""
        own = f"{self.hidden} {self.kind if self.hidden > 1 else self.kind[:-1]}"
        counts = (("topics", self.topics), ("services", self.services))
        further = [f"{count} {kind}" for kind, count in counts if count]
        return f"{own} with {' and '.join(further)}" if further else own


def to_json(found: tuple[Beyond, ...]) -> dict[str, Any]:
    """As the news that a peer gets: ``{"nodes": [limit, hidden, topics, services]}``."""
    return {one.kind: [one.limit, one.hidden, one.topics, one.services] for one in found}


def from_json(args: Mapping[str, Any]) -> tuple[Beyond, ...]:
    """Read such news; what is no list of whole numbers is passed over."""
    found = []
    for kind in _KINDS:
        counts = args.get(kind)
        if isinstance(counts, list) and len(counts) == 4 and all(_is_count(one) for one in counts) and counts[1]:
            found.append(Beyond(kind, *counts))
    return tuple(found)


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= UINT32_MAX


class NodePlaces(Generic[_Thing]):
    """Which nodes of one peer stand in the local graph, and what waits for a place there.

    A node has a place as long as one thing of it (a topic, a service) is shown. Under a lower limit the nodes in
    surplus leave thing by thing; as many nodes as the limit allows are never in surplus, so when one of these leaves,
    the first one in surplus keeps its place, and what of it waits already comes back.

    Args:
        limit: How many places there are.
    """

    __slots__ = ("_shown", "_surplus", "_waiting", "limit")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._shown: Counter[str] = Counter()
        self._surplus: OrderedDict[str, None] = OrderedDict()
        # Ordered: to take the first of a plain dict passes over all that were taken before it.
        self._waiting: OrderedDict[str, dict[_Thing, None]] = OrderedDict()

    @property
    def waiting(self) -> Mapping[str, Mapping[_Thing, None]]:
        """Nodes without a place, and their things."""
        return self._waiting

    def bound(self, limit: int) -> None:
        """Another limit holds; the nodes that came last are in surplus if it is a lower one."""
        self.limit = limit
        self._surplus = OrderedDict.fromkeys(islice(self._shown, limit, None))

    def free(self, node: str) -> bool:
        """Whether a node has a place, or there is one for it."""
        if node in self._shown:
            return node not in self._surplus
        return len(self._shown) < self.limit

    def wait(self, node: str, thing: _Thing) -> None:
        """A thing is hidden because its node has no place."""
        self._waiting.setdefault(node, {})[thing] = None

    def leave(self, node: str, thing: _Thing) -> None:
        """A thing is shown, hidden for another reason, or gone: it waits no longer."""
        things = self._waiting.get(node)
        if things is not None:
            things.pop(thing, None)
            if not things:
                del self._waiting[node]

    def show(self, node: str) -> None:
        """One more thing of a node is shown."""
        self._shown[node] += 1

    def hide(self, node: str) -> None:
        """One thing of a node is shown no more."""
        self._shown[node] -= 1
        if self._shown[node]:
            return
        del self._shown[node]
        if node in self._surplus:
            del self._surplus[node]
        elif self._surplus:
            stays, _ = self._surplus.popitem(last=False)
            if stays in self._waiting:
                self._waiting.move_to_end(stays, last=False)

    def next_in(self) -> Iterator[tuple[_Thing, ...]]:
        """Behind each ``hide``, while there is a place: the things of the node that is next, which wait no longer.

        That is the one that waits for longest; before it, one that was in surplus and keeps its place.
        """
        while self._waiting and self.free(next(iter(self._waiting))):
            yield tuple(self._waiting.popitem(last=False)[1])

    def give_up(self) -> None:
        """Nothing waits any more: the peer is away."""
        self._waiting.clear()


class Surplus(Generic[_Thing]):
    """Things of one peer beyond the number that is taken of it: they wait for a place, first come, first served.

    Args:
        limit: How many are remembered; further ones are only counted, and come with the next link.
    """

    __slots__ = ("_forgotten", "_known", "limit")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._known: OrderedDict[Any, _Thing] = OrderedDict()
        self._forgotten = 0

    def __len__(self) -> int:
        return len(self._known) + self._forgotten

    def __contains__(self, key: object) -> bool:
        return key in self._known

    def __iter__(self) -> Iterator[_Thing]:
        return iter(self._known.values())

    def add(self, key: object, thing: _Thing) -> None:
        """One more is beyond."""
        if key in self._known or len(self._known) < self.limit:
            self._known[key] = thing
        else:
            self._forgotten += 1

    def discard(self, key: object) -> None:
        """One is not there any more."""
        if self._known.pop(key, None) is None and self._forgotten:
            self._forgotten -= 1

    def pop(self) -> _Thing | None:
        """The one that waits for longest."""
        return self._known.popitem(last=False)[1] if self._known else None

    def clear(self) -> None:
        """The peer begins to tell all anew."""
        self._known.clear()
        self._forgotten = 0


def setting_name(kind: str) -> str:
    """What a limit is called in ``rmpa.toml``."""
    return f"limits.{kind}"


def warning(peer: str, kind: str, limit: int) -> str:
    """The line of the log when the first thing is beyond a limit."""
    return (
        f"{peer} has more than {setting_name(kind)} = {limit} of this module; the rest stays hidden until there is "
        f"room: raise it in rmpa.toml and `rmpa reload`, or deny some; `rmpa peer info {peer}` counts them"
    )
