"""What a peer offers beyond this module's ``[limits]``: the counts, and their form as a notification to that peer.

Nothing vanishes because of a limit: it is counted, it is shown when there is room, and both agents report it.
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
    """What one limit hides.

    Args:
        kind: The limit: ``nodes``, ``topics`` or ``services``.
        limit: Its value.
        hidden: How many nodes, topics or services are beyond it.
        topics: With ``nodes``: how many topics are hidden because of their nodes.
        services: With ``nodes``: how many services are hidden because of their nodes.
    """

    kind: str
    limit: int
    hidden: int
    topics: int = 0
    services: int = 0

    @property
    def what(self) -> str:
        """The counts as text: ``744 nodes with 3720 topics and 744 services``."""
        own = f"{self.hidden} {self.kind if self.hidden > 1 else self.kind[:-1]}"
        counts = (("topics", self.topics), ("services", self.services))
        further = [f"{count} {kind}" for kind, count in counts if count]
        return f"{own} with {' and '.join(further)}" if further else own


def to_json(found: tuple[Beyond, ...]) -> dict[str, Any]:
    """The arguments of the notification to a peer: ``{"nodes": [limit, hidden, topics, services]}``."""
    return {one.kind: [one.limit, one.hidden, one.topics, one.services] for one in found}


def from_json(args: Mapping[str, Any]) -> tuple[Beyond, ...]:
    """Read the arguments of such a notification.

    A kind without four whole numbers, or with none hidden, is left out.
    """
    found = []
    for kind in _KINDS:
        counts = args.get(kind)
        if isinstance(counts, list) and len(counts) == 4 and all(_is_count(one) for one in counts) and counts[1]:
            found.append(Beyond(kind, *counts))
    return tuple(found)


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= UINT32_MAX


class NodePlaces(Generic[_Thing]):
    """Which nodes of one peer are in the local graph, and what waits because its node is not.

    A node takes a place as long as one thing of it (a topic, a service) is shown. After the limit was lowered, the
    nodes that were shown last are in surplus: they keep what is shown, get nothing new, and their things are hidden
    as they are judged again. When a node that is not in surplus leaves, the first node in surplus takes over its
    place, and what waits of that node is the next to be shown.

    Args:
        limit: How many places there are.
    """

    __slots__ = ("_shown", "_surplus", "_waiting", "limit")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self._shown: Counter[str] = Counter()
        self._surplus: OrderedDict[str, None] = OrderedDict()
        # Ordered: taking the first item of a plain dict passes over all that were taken before it.
        self._waiting: OrderedDict[str, dict[_Thing, None]] = OrderedDict()

    @property
    def waiting(self) -> Mapping[str, Mapping[_Thing, None]]:
        """The nodes without a place, and the things of each that wait."""
        return self._waiting

    def bound(self, limit: int) -> None:
        """Set another limit; if it is lower, the nodes that were shown last are in surplus."""
        self.limit = limit
        self._surplus = OrderedDict.fromkeys(islice(self._shown, limit, None))

    def free(self, node: str) -> bool:
        """Whether a node may show a thing: it has a place and is not in surplus, or a place is free."""
        if node in self._shown:
            return node not in self._surplus
        return len(self._shown) < self.limit

    def wait(self, node: str, thing: _Thing) -> None:
        """Note that a thing is hidden because its node has no place."""
        self._waiting.setdefault(node, {})[thing] = None

    def leave(self, node: str, thing: _Thing) -> None:
        """Note that a thing no longer waits: it is shown, hidden for another reason, or gone."""
        things = self._waiting.get(node)
        if things is not None:
            things.pop(thing, None)
            if not things:
                del self._waiting[node]

    def show(self, node: str) -> None:
        """Count one more thing of a node that is shown."""
        self._shown[node] += 1

    def hide(self, node: str) -> None:
        """Count one thing less of a node that is shown; the last one frees the node's place.

        The first node in surplus, if any, takes over a place that a node outside the surplus frees.
        """
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
        """Yield the things that may be shown now, one node's at a time; they wait no longer. Call after ``hide``.

        The node that has waited longest is the next; before it comes a node in surplus that took over a place. The
        caller shows the things before it asks for the next node, or the place still counts as free.
        """
        while self._waiting and self.free(next(iter(self._waiting))):
            yield tuple(self._waiting.popitem(last=False)[1])

    def give_up(self) -> None:
        """Drop all that waits: the peer is away."""
        self._waiting.clear()


class Surplus(Generic[_Thing]):
    """Offers of one peer beyond the number that is taken of it; they wait for room, first come, first served.

    Args:
        limit: How many are remembered. Further ones are only counted, and can be shown after the peer's next link-up.
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
        """Remember one more offer, or only count it beyond ``limit``; a known key gets the new value."""
        if key in self._known or len(self._known) < self.limit:
            self._known[key] = thing
        else:
            self._forgotten += 1

    def discard(self, key: object) -> None:
        """Drop an offer that the peer has removed; an unknown key lowers the count of those not remembered."""
        if self._known.pop(key, None) is None and self._forgotten:
            self._forgotten -= 1

    def pop(self) -> _Thing | None:
        """Take the offer that has waited longest; ``None`` if none is remembered."""
        return self._known.popitem(last=False)[1] if self._known else None

    def clear(self) -> None:
        """Drop all: the peer advertises its catalogue anew, or is away."""
        self._known.clear()
        self._forgotten = 0


def setting_name(kind: str) -> str:
    """The name of a limit in ``rmpa.toml``."""
    return f"limits.{kind}"


def warning(peer: str, kind: str, limit: int) -> str:
    """The text of the log when a peer first exceeds a limit."""
    return (
        f"{peer} has more than {setting_name(kind)} = {limit} of this module; the rest stays hidden until there is "
        f"room: raise it in rmpa.toml and `rmpa reload`, or deny some; `rmpa peer info {peer}` counts them"
    )
