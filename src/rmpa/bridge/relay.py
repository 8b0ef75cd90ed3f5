"""Relaying: what a module with a cable in two networks passes on between them, as the paper's proxies do. Pure.

::

    network 0                                      network 1
    a ──── /cmd ───► r (relay) ──── /cmd, origin a, path r ───► b     shown there as /rmpa/a/…

The relay offers what stands for another module's nodes in its own graph, with the *origin* beside it; that lists
every relay on the way, so nothing goes round: it is not offered to its origin, nor to the relay it came from, and a
relay on its list does not show it. A module that reaches the origin itself, or by a better relay, keeps it hidden.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.messages import Origin

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.bridge.messages import Source
    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity

Place = tuple[str, str]
"""A topic and the proxy that publishes it, as they are in the local graph."""


class Relay:
    """The passing side: which proxies of the local graph are offered on, and with which origin.

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
        """Offer what a peer brings to others, if this module relays.

        Args:
            peer: The peer whose link it came by.
            relay: That peer.
            source: As that peer knows it.
            place: What it is here.
            origin: Its module and node; ``None``: that peer's own.
        """
        if self.enabled:
            own = Origin(relay.name, str(relay.guid), relay.instance.hex(), source.node)
            self.shown(peer, source, place, origin or own)

    def shown(self, peer: int, source: Source, place: Place, origin: Origin) -> None:
        """A peer's source is about to appear in the local graph.

        Args:
            peer: The peer whose link it came by.
            source: As that peer knows it.
            place: What it is here.
            origin: Its module and node; its path does not name this one.
        """
        self._places[peer, source] = place
        self._origins[place] = (peer, source, origin)

    def gone(self, peer: int, source: Source) -> None:
        """It leaves the local graph; another peer may have taken its place already."""
        place = self._places.pop((peer, source), None)
        if place is not None and self._origins[place][:2] == (peer, source):
            del self._origins[place]

    def peer_gone(self, peer: int) -> None:
        """All that came by a peer leaves."""
        for owner, source in [key for key in self._places if key[0] == peer]:
            self.gone(owner, source)

    def origin(self, place: Place) -> Origin | None:
        """What to offer of a proxy's topic, our own hop included; ``None`` where nothing is to be passed on."""
        if not self.enabled or place not in self._origins:
            return None
        origin = self._origins[place][2]
        if len(origin.path) >= limits.RELAY_HOPS_MAX:
            return None
        return msgspec.structs.replace(origin, path=(*origin.path, self.instance))


def may_have(instance: str, origin: Origin) -> bool:
    """Whether a relayed source may be offered to a peer: not back to where it came from."""
    return instance != origin.instance and instance not in origin.path


@dataclass(frozen=True, slots=True)
class LinkedPeer:
    """A peer with a link of its own.

    Args:
        name: Its name.
        instance: Its run, as 32 hexadecimal digits.
        guid: Its GUID.
    """

    name: str
    instance: str
    guid: Guid | None


@dataclass(slots=True)
class _Origin:
    """One module that relays offer.

    Args:
        origin: As it was last offered.
        ways: By relay: how many sources of it are offered that way, and how many hops away it is.
    """

    origin: Origin
    ways: dict[int, list[int]] = field(default_factory=dict)


class RelayPaths:
    """The receiving side: by which of its ways a module is reached. Its own link goes first, then the best relay.

    The best relay has the shortest path; of several the lowest GUID's. All sources of a module come the same way.
    """

    def __init__(self) -> None:
        self.instance = ""
        """Our own, as 32 hexadecimal digits."""
        self._linked: dict[int, LinkedPeer] = {}
        self._origins: dict[str, _Origin] = {}

    def __iter__(self) -> Iterator[tuple[Origin, str]]:
        """Each module that is reached by a relay, and that relay's name."""
        for instance, known in self._origins.items():
            best = self._best(instance)
            if best is not None and not self._direct(instance):
                yield known.origin, self._linked[best].name

    def __contains__(self, instance: str) -> bool:
        return instance in self._origins

    def linked(self, peer: int, who: LinkedPeer) -> set[str]:
        """A peer has a link; return the modules whose way may be another one now."""
        self._linked[peer] = who
        return {who.instance}

    def unlinked(self, peer: int) -> set[str]:
        """A peer is gone for good, and all ways through it; return the modules whose way may be another one now."""
        gone = self._linked.pop(peer, None)
        changed = {gone.instance} if gone is not None else set()
        for instance, known in list(self._origins.items()):
            if known.ways.pop(peer, None) is not None:
                changed.add(instance)
                if not known.ways:
                    del self._origins[instance]
        return changed

    def add(self, peer: int, origin: Origin) -> bool:
        """A peer offers one more source of a module; whether that is now reached another way."""
        if self._ours(origin) or peer not in self._linked:
            return False
        before = self._best(origin.instance)
        known = self._origins.setdefault(origin.instance, _Origin(origin))
        known.origin = origin
        count, _ = known.ways.get(peer, (0, 0))
        known.ways[peer] = [count + 1, len(origin.path)]
        return self._best(origin.instance) != before

    def remove(self, peer: int, origin: Origin) -> bool:
        """A peer offers one source of a module less; whether that is now reached another way."""
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
        """Why a source does not appear by this way, or empty."""
        if origin.instance == self.instance:
            return "it is ours, and came back by a relay"
        if self.instance in origin.path:
            return "we passed it on ourselves"
        if self._direct(origin.instance):
            return f"{origin.name} has a link of its own"
        best = self._best(origin.instance)
        if best is not None and best != peer:
            return f"{origin.name} is reached by way of {self._linked[best].name}"
        return ""

    def _ours(self, origin: Origin) -> bool:
        return origin.instance == self.instance or self.instance in origin.path

    def _direct(self, instance: str) -> bool:
        return any(one.instance == instance for one in self._linked.values())

    def _best(self, instance: str) -> int | None:
        known = self._origins.get(instance)
        return min(known.ways, key=lambda peer: self._rank(known, peer), default=None) if known is not None else None

    def _rank(self, known: _Origin, peer: int) -> tuple[int, int, int]:
        guid = self._linked[peer].guid
        return known.ways[peer][1], guid.value if guid is not None else 0, peer
