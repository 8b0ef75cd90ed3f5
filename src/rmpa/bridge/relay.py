"""Relaying between two networks by a module that is in both, as the paper's proxies do. Pure.

::

    network 0                                      network 1
    a ──── /cmd ───► r (relay) ──── /cmd, origin a, path r ───► b     shown there as /rmpa/a/…

The relay offers the proxies in its own graph, each with its *origin*. The origin lists every relay on the path, which
prevents loops: a source is not offered to its own module nor to a relay on its path, and a relay on its path does not
show it. A module that is linked to the origin, or reaches it by a better relay, hides the source.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import Origin

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.bridge.messages import Source
    from rmpa.core.identity import Guid, Identity

Place = tuple[str, str]
"""A topic and the proxy that publishes it, by their local names."""


OUTSIDE_GUID: Final = "0.0.0.0:0#1"
"""The GUID of all origins outside the mesh: it is well-formed, but no module can have this address."""


def is_outside(origin: Origin) -> bool:
    """Whether an origin is not a module of this mesh, but what a gateway of it reaches."""
    return origin.guid == OUTSIDE_GUID


def service_place(service: str, node: str) -> Place:
    """The place of a service, which differs from that of a topic of the same name."""
    return f"service {service}", node


class Relay:
    """The relaying side: which proxies of the local graph are offered to other peers, with which origin.

    Args:
        enabled: Whether this module relays at all.
    """

    def __init__(self, *, enabled: bool = False) -> None:
        self.enabled = enabled
        self.instance = ""
        """Our own, as 32 hexadecimal digits."""
        self._origins: dict[Place, tuple[int, Source, Origin]] = {}
        self._places: dict[tuple[int, Source], Place] = {}

    def pass_on(self, peer: int, relay: Identity, source: Source, place: Place, origin: Origin | None) -> None:
        """Offer a peer's source to other peers, if this module relays.

        Args:
            peer: The number of the peer that offers it.
            relay: The identity of that peer.
            source: The source, by its wire name.
            place: Its topic and proxy here.
            origin: Its module and node; ``None``: the peer's own.
        """
        if self.enabled:
            own = Origin(relay.name, str(relay.guid), relay.instance.hex(), source.node)
            self.shown(peer, source, place, origin or own)

    def shown(self, peer: int, source: Source, place: Place, origin: Origin) -> None:
        """Register a peer's source that is about to appear in the local graph.

        Args:
            peer: The number of the peer that offers it.
            source: The source, by its wire name.
            place: Its topic and proxy here.
            origin: Its module and node; the path does not include this module.
        """
        self._places[peer, source] = place
        self._origins[place] = (peer, source, origin)

    def gone(self, peer: int, source: Source) -> None:
        """Forget a source that leaves the local graph; another peer's source may have its place already."""
        place = self._places.pop((peer, source), None)
        if place is not None and self._origins[place][:2] == (peer, source):
            del self._origins[place]

    def peer_gone(self, peer: int) -> None:
        """Forget all sources that a peer offered."""
        for owner, source in [key for key in self._places if key[0] == peer]:
            self.gone(owner, source)

    def source(self, place: Place) -> tuple[int, Source] | None:
        """The peer that offers what is at a place, and its source, by the wire name; ``None`` if it is no proxy's."""
        shown = self._origins.get(place)
        return shown[:2] if shown is not None else None

    def origin(self, place: Place) -> Origin | None:
        """The origin to offer a proxy's topic with, this relay in its path; ``None`` if it is not relayed."""
        if not self.enabled or place not in self._origins:
            return None
        origin = self._origins[place][2]
        if len(origin.path) >= limits.RELAY_HOPS_MAX:
            return None
        return msgspec.structs.replace(origin, path=(*origin.path, self.instance))


def may_have(instance: str, origin: Origin) -> bool:
    """Whether a relayed source may be offered to the peer of this instance: not to one that it came from."""
    return instance != origin.instance and instance not in origin.path


@dataclass(frozen=True, slots=True)
class LinkedPeer:
    """A peer with a link of its own.

    Args:
        name: Its name.
        instance: Its run, as 32 hexadecimal digits.
        guid: Its GUID, which ranks it among relays.
    """

    name: str
    instance: str
    guid: Guid | None


@dataclass(slots=True)
class _Origin:
    """One module that relays offer.

    Args:
        origin: Its origin in the last offer of a peer that may relay; in the first offer if there is none.
        ways: By relay: the number of its sources that the relay offers, and the length of the path in relays.
    """

    origin: Origin
    ways: dict[int, list[int]] = field(default_factory=dict)


class RelayPaths:
    """The receiving side: selects the path to each module, its own link first, else the best relay.

    The best relay has the shortest path; among equal ones, the lowest GUID. All sources of a module use one path.

    Args:
        may_relay: Whether a peer, by its name, may be a relay at all.
    """

    def __init__(self, may_relay: Callable[[str], bool] = lambda _: True) -> None:
        self._may_relay = may_relay
        self.instance = ""
        """Our own, as 32 hexadecimal digits."""
        self.reached_here: set[str] = set()
        """Instances that this module reaches by itself, outside the mesh: a gateway's sites."""
        self._linked: dict[int, LinkedPeer] = {}
        self._origins: dict[str, _Origin] = {}

    def __iter__(self) -> Iterator[tuple[Origin, str]]:
        """Each module that is reached by a relay, and that relay's name."""
        for instance, known in self._origins.items():
            best = self._best(instance)
            if best is not None and not self._direct(known.origin):
                yield known.origin, self._linked[best].name

    def __contains__(self, instance: str) -> bool:
        return instance in self._origins

    def linked(self, peer: int, who: LinkedPeer) -> set[str]:
        """Register a linked peer; return the instances whose path may have changed."""
        self._linked[peer] = who
        return {who.instance}

    def unlinked(self, peer: int) -> set[str]:
        """Forget a peer and all paths through it; return the instances whose path may have changed."""
        gone = self._linked.pop(peer, None)
        changed = {gone.instance} if gone is not None else set()
        for instance, known in list(self._origins.items()):
            if known.ways.pop(peer, None) is not None:
                changed.add(instance)
                if not known.ways:
                    del self._origins[instance]
        return changed

    def add(self, peer: int, origin: Origin) -> bool:
        """Count a source of a module that a peer offers; return whether the best relay has changed."""
        if self._ours(origin) or peer not in self._linked:
            return False
        before = self._best(origin.instance)
        known = self._origins.setdefault(origin.instance, _Origin(origin))
        if self._may_relay(self._linked[peer].name):
            known.origin = origin
        count, _ = known.ways.get(peer, (0, 0))
        known.ways[peer] = [count + 1, len(origin.path)]
        return self._best(origin.instance) != before

    def remove(self, peer: int, origin: Origin) -> bool:
        """Count off a source that a peer offers no longer; return whether the best relay has changed."""
        known = self._origins.get(origin.instance)
        if known is None or self._ours(origin) or peer not in known.ways:
            return False
        before = self._best(origin.instance)
        known.ways[peer][0] -= 1
        if not known.ways[peer][0]:
            del known.ways[peer]
        if not known.ways:
            del self._origins[origin.instance]
        return self._best(origin.instance) != before

    def why_not(self, peer: int, origin: Origin) -> str:
        """Why a relayed source of a peer is hidden, or empty."""
        if origin.instance == self.instance:
            return "it is ours, and came back by a relay"
        if self.instance in origin.path:
            return "we passed it on ourselves"
        if origin.instance in self.reached_here:
            return f"{origin.name} is reached from here"
        if self._direct(origin):
            return f"{origin.name} has a link of its own"
        best = self._best(origin.instance)
        if best is not None and best != peer:
            return f"{origin.name} is reached by way of {self._linked[best].name}"
        return ""

    def _ours(self, origin: Origin) -> bool:
        return origin.instance == self.instance or self.instance in origin.path

    def _direct(self, origin: Origin) -> bool:
        # Every member of a mesh hears the instances of the others, and may claim one; see Identity.is_same_run.
        return any((one.instance, one.name) == (origin.instance, origin.name) for one in self._linked.values())

    def _best(self, instance: str) -> int | None:
        known = self._origins.get(instance)
        if known is None:
            return None
        ways = (peer for peer in known.ways if self._may_relay(self._linked[peer].name))
        return min(ways, key=lambda peer: self._rank(known, peer), default=None)

    def _rank(self, known: _Origin, peer: int) -> tuple[int, int, int]:
        guid = self._linked[peer].guid
        return known.ways[peer][1], guid.value if guid is not None else 0, peer
