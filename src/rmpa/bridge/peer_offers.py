"""What each peer offers, and what of it is in the local graph. Pure; by level, as ``offers`` is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, OrderedDict
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, cast

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.offers import Effects, KeyT, OfferT, PeerRun, wire_of
from rmpa.core.facts import CROWDED, DENIED
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

    from rmpa.bridge.messages import Advertise, AdvertiseServices, Origin, SubscriptionChanges
    from rmpa.bridge.policy import PolicyDecision
    from rmpa.config.peer_rules import Access
    from rmpa.trust.permissions import PermissionDecision


@dataclass(slots=True, eq=False, kw_only=True)
class Remote(Generic[KeyT]):
    """A topic or service of one node of a peer, as the peer offers it.

    Args:
        peer: The peer's number.
        wire: Its key by wire names.
        name: Its topic or service here.
        node: Its node, in the peer's graph.
        type: Its message type; ``None`` for a service.
        origin: Its module and node, if the peer only relays it.
        shown: Whether it is in the local graph.
        cause: The kind of the reason why it is not, of ``core.facts``; empty: another one.
        problem: Why its route was not opened or was closed last, or empty.
    """

    peer: int
    wire: KeyT
    name: str
    node: str
    type: str | None = None
    origin: Origin | None = None
    shown: bool = False
    cause: str = ""
    problem: str = ""


EntryT = TypeVar("EntryT", bound=Remote[Any])


@dataclass(slots=True, kw_only=True)
class Heard(Generic[KeyT, EntryT, OfferT]):
    """What one run of a peer offers, over one or more links.

    A node of it takes a place in the local graph as long as one entry of the node is shown. A lower limit ends
    nothing that is shown: it holds for the nodes that come.

    Args:
        session: The peer.
        entries: What is taken of its offers, by name on the wire.
        refused: The offers beyond the limit, at most ``limits.REFUSED_MAX``; further ones come with its next link.
        doubtful: What was offered over the last link and is not confirmed over the present one.
        shown: How many entries of each node are in the local graph.
        crowded: The nodes without a place, and the entries of each that wait for one (ordered: taking the first item
            of a plain dict passes over all that were taken before it).
        complete: Whether it has told all that it offers.
        ready: Whether it is a way to other modules: it has a link, and is complete.
        routes: The routes that are asked for or open, by number.
        last_route: The number of the last one.
    """

    session: PeerRun
    entries: dict[KeyT, EntryT] = field(default_factory=dict)
    refused: OrderedDict[KeyT, OfferT] = field(default_factory=OrderedDict)
    doubtful: set[KeyT] = field(default_factory=set)
    shown: Counter[str] = field(default_factory=Counter)
    crowded: OrderedDict[str, dict[EntryT, None]] = field(default_factory=OrderedDict)
    complete: bool = False
    ready: bool = False
    routes: dict[int, EntryT] = field(default_factory=dict)
    last_route: int = 0

    def free(self, node: str, limit: int) -> bool:
        """Whether a node may show an entry: it has a place, or a place is free."""
        return node in self.shown or len(self.shown) < limit

    def wait(self, entry: EntryT, *, crowded: bool) -> None:
        """Note whether an entry waits for a place of its node."""
        if crowded:
            self.crowded.setdefault(entry.node, {})[entry] = None
        elif (waiting := self.crowded.get(entry.node)) is not None:
            waiting.pop(entry, None)
            if not waiting:
                del self.crowded[entry.node]

    def show(self, entry: EntryT) -> None:
        """Note that an entry is shown."""
        entry.shown, entry.cause = True, ""
        self.shown[entry.node] += 1

    def hide(self, entry: EntryT) -> None:
        """Note that an entry is shown no more; the last one of its node frees the node's place."""
        entry.shown = False
        self.shown[entry.node] -= 1
        if not self.shown[entry.node]:
            del self.shown[entry.node]

    def admitted(self, limit: int) -> Iterator[EntryT]:
        """Yield the entries that have a place now, those first whose node has waited longest.

        The caller shows an entry before it asks for the next one, or the place still counts as free.
        """
        while self.crowded and self.free(next(iter(self.crowded)), limit):
            yield from self.crowded.popitem(last=False)[1]

    def give_up(self) -> None:
        """Forget all that is refused or waits: the peer does not come back soon."""
        self.crowded.clear()
        self.refused.clear()


def _is_same(entry: Remote[Any], offer: Any) -> bool:
    """Whether an offer is what an entry was made of, perhaps by another path."""
    one, other = entry.origin, offer.origin
    if one is not None and other is not None:
        one = msgspec.structs.replace(one, guid=other.guid, path=other.path)
    return entry.node == offer.node and one == other and entry.type == getattr(offer, "type", None)


class ImportEffects(Effects):
    """What a part does for what peers offer, likewise."""

    @abstractmethod
    def arm_timer(self) -> None:
        """Look at ``ImportBook.next_timer`` again."""

    @abstractmethod
    def path_changed(self, entry: Remote[Any]) -> None:
        """Offer what is relayed with the path that it has now."""


class RelayPaths:
    """Selects the path to each module, its own link first, else the best relay; see ``policy.Relay``.

    The best relay has the shortest path; among equal ones, the lowest GUID. A peer counts while it has a link and has
    told all that it offers.

    Args:
        peers: What each peer offers, by its number.
        may_relay: Whether a peer, by its name, may be a relay at all.

    Attributes:
        instance: Our own, as 32 hexadecimal digits.
        reached_here: Instances that this module reaches by itself, outside the mesh: a gateway's sites.
        lost: The relay that brought a module last, by the names of both, of each that no relay brings any more.
        _ways: By instance and relay: the origin as the relay offered it last, and the number of its sources there.
    """

    def __init__(
        self, peers: Mapping[int, Heard[Any, Any, Any]], may_relay: Callable[[str], bool] = lambda _: True
    ) -> None:
        self._peers, self._may_relay = peers, may_relay
        self.instance = ""
        self.reached_here: set[str] = set()
        self.lost: OrderedDict[str, str] = OrderedDict()
        self._ways: dict[str, dict[int, tuple[Origin, int]]] = {}

    def __iter__(self) -> Iterator[tuple[Origin, str]]:
        """Each module that is reached by a relay, and that relay's name."""
        for instance, ways in self._ways.items():
            best = self._best(instance)
            if best is not None and not self._direct(ways[best][0]):
                yield ways[best][0], self._peers[best].session.name

    def __contains__(self, instance: str) -> bool:
        return instance in self._ways

    def through(self, peer: int) -> set[str]:
        """The instances whose path may be another one when a peer becomes a way, or is none any more."""
        return {self._peers[peer].session.instance} | {one for one, ways in self._ways.items() if peer in ways}

    def gone(self, peer: int, relay: PeerRun) -> set[str]:
        """Forget all paths through a peer that is gone; return the instances whose path may have changed."""
        changed = {relay.instance}
        for instance, ways in list(self._ways.items()):
            if (way := ways.pop(peer, None)) is not None:
                changed.add(instance)
                if not ways:
                    self._lose(way[0], relay.name)
        return changed

    def _lose(self, origin: Origin, relay: str) -> None:
        """Note that no relay brings a module any more."""
        del self._ways[origin.instance]
        self.lost[origin.name] = relay
        if len(self.lost) > mesh_limits.MODULES_MAX:
            self.lost.popitem(last=False)

    def count(self, peer: int, origin: Origin, more: int) -> bool:
        """Count a source of a module that a peer offers (1) or offers no longer (-1).

        Returns:
            Whether the best relay to the module has changed.
        """
        if self.instance in (origin.instance, *origin.path):
            return False
        before, ways = self._best(origin.instance), self._ways.setdefault(origin.instance, {})
        known, count = ways.pop(peer, (origin, 0))
        if count + more > 0:
            ways[peer] = origin if more > 0 else known, count + more
            self.lost.pop(origin.name, None)
        if not ways:
            self._lose(origin, self._peers[peer].session.name)
        return self._best(origin.instance) != before

    def objection(self, origin: Origin) -> str:
        """Why no relay's source of a module is shown, or empty."""
        if origin.instance == self.instance:
            return "it is ours, and came back by a relay"
        if self.instance in origin.path:
            return "we passed it on ourselves"
        if origin.instance in self.reached_here:
            return f"{origin.name} is reached from here"
        if self._direct(origin):
            return f"{origin.name} has a link of its own"
        return ""

    def why_not(self, peer: int, origin: Origin) -> str:
        """Why a relayed source of a peer is hidden, or empty."""
        if why := self.objection(origin):
            return why
        best = self._best(origin.instance)
        if best is not None and best != peer:
            return f"{origin.name} is reached by way of {self._peers[best].session.name}"
        return ""

    def rank(self, peer: int, origin: Origin | None) -> tuple[bool, int, int, int]:
        """Sorts the ways to a source: those that work, then links, then relays by their paths, then by GUID."""
        known = self._peers[peer]
        return not known.ready, len(origin.path) if origin is not None else 0, known.session.rank, peer

    def _direct(self, origin: Origin) -> bool:
        # Every member of a mesh hears the instances of the others, and may claim one; see Identity.is_same_run.
        runs = (known.session for known in self._peers.values() if known.ready)
        return any((run.name, run.instance) == (origin.name, origin.instance) for run in runs)

    def _best(self, instance: str) -> int | None:
        ways = self._ways.get(instance, {})
        relays = (peer for peer in ways if self._may_relay(self._peers[peer].session.name))
        return min(relays, key=lambda peer: self.rank(peer, ways[peer][0]), default=None)


class ImportBook(ABC, Generic[KeyT, EntryT, OfferT]):
    """What peers offer, and what of it is in the local graph.

    Args:
        out: The part, which has the rules, and does what is decided here: at once, without calling back.

    Attributes:
        kind: The setting that limits the entries of one peer: ``topics`` or ``services``.
        access: What the module of an entry does here.
        ways: Selects the path to each module that relays offer.
    """

    kind: ClassVar[str]
    access: ClassVar[Access]

    def __init__(self, out: ImportEffects) -> None:
        self._out = out
        self._peers: dict[int, Heard[KeyT, EntryT, OfferT]] = {}
        self.ways = RelayPaths(self._peers, out.context.gate.may_relay)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, monotonic seconds; ``None`` if no timer runs."""
        return None

    def handle_timer(self, now: float) -> None:
        """Handle due timers."""

    def reload(self, now: float) -> Iterator[None]:
        """Judge by new rules, an entry with each item; what they do not change goes on untouched."""
        yield from self._rejudge_all(now)
        for peer, known in list(self._peers.items()):
            while self._peers.get(peer) is known and self._admit(peer, known, now):
                yield

    @abstractmethod
    def _rejudge_all(self, now: float) -> Iterator[None]:
        """Judge what is known by new rules, an entry with each item."""

    @abstractmethod
    def _entry(self, peer: int, offer: OfferT) -> EntryT:
        """The entry of an offer, listed under its name here."""

    @abstractmethod
    def _judge(self, entry: EntryT) -> None:
        """Show an entry or hide it, by the facts of now; call it again whenever one has changed."""

    def _came_again(self, entry: EntryT, now: float) -> None:
        """Take an offer that was taken before, over this link or an earlier one."""

    @abstractmethod
    def _went(self, entry: EntryT, reason: str) -> None:
        """End what uses an entry and take it out of the local graph; it is in no list of its peer any more."""

    @property
    def limit(self) -> int:
        """How many entries of one peer are taken."""
        return self._out.context.limit(self.kind)

    def refused(self, peer: int) -> int:
        """How much a peer offers beyond the limit."""
        return len(known.refused) if (known := self._peers.get(peer)) is not None else 0

    def refused_nodes(self, peer: int) -> Mapping[str, Collection[EntryT]]:
        """The nodes of a peer that are hidden because of ``limits.nodes``, with their entries."""
        return known.crowded if (known := self._peers.get(peer)) is not None else {}

    def peer_name(self, peer: int) -> str:
        """The name of a peer, for texts."""
        return known.session.name if (known := self._peers.get(peer)) is not None else "a peer that is gone"

    def link_up(self, session: PeerRun) -> None:
        """Register a link, of a new peer or of one that was away; its first message begins a full advertisement.

        What relays offer of the peer is hidden while it has a link.
        """
        peer = session.peer
        known = self._peers.setdefault(peer, Heard(session=session))
        known.routes, known.last_route = {}, 0
        self._ways_changed((session.instance,))
        self._ready(peer)

    def link_down(self, peer: int) -> None:
        """The peer is no way to other modules until it is back; what it offers stays in the graph until ``gone``."""
        if peer in self._peers:
            self._ready(peer)

    def gone(self, peer: int, keep: Collection[str] = ()) -> Iterator[None]:
        """Forget what a peer offers that does not come back, or not soon, an entry with each item.

        Args:
            peer: The peer's number.
            keep: The names here of shown entries that stay, as they are used directly.
        """
        if (known := self._peers.get(peer)) is None:
            return
        self.link_down(peer)
        known.give_up()
        for entry in list(known.entries.values()):
            if not entry.shown or entry.name not in keep:
                self._drop(entry, f"{known.session.name} is gone")
                yield
        if not known.entries:
            del self._peers[peer]
            self._ways_changed(self.ways.gone(peer, known.session))

    def changes(
        self, peer: int, message: Advertise | AdvertiseServices | SubscriptionChanges
    ) -> Iterator[tuple[KeyT, OfferT | None]]:
        """The changes of an advertisement, each with its name on the wire; removals, ``None``, go first.

        Entries that a complete catalogue does not contain are removed at its end.
        """
        known, added, removed = self._peers.get(peer), cast("Any", message.added), cast("Any", message.removed)
        if known is None:
            return
        if message.full:
            known.doubtful = set(known.entries)
            known.refused.clear()
        known.doubtful.difference_update(map(wire_of, added))
        if known.doubtful and not message.more:
            removed += tuple(sorted(known.doubtful))  # type: ignore[type-var] # names are in order
            known.doubtful = set()
        yield from ((name, None) for name in removed)
        yield from ((wire_of(offer), offer) for offer in added)
        if not message.more and self._peers.get(peer) is known:
            known.complete = True
            self._ready(peer)

    def _ready(self, peer: int) -> None:
        """Judge again what other peers bring, if a peer has become a way or is none any more."""
        known = self._peers[peer]
        ready = known.complete and known.session.linked
        if ready is not known.ready:
            known.ready = ready
            self._ways_changed(self.ways.through(peer))

    def take_in(self, peer: int, wire: KeyT, offer: OfferT | None, now: float) -> None:
        """Apply one change of an advertisement: an offer, or ``None`` for what is offered no more."""
        known = self._peers.get(peer)
        if known is None:
            return
        entry = known.entries.get(wire)
        if offer is None:
            known.refused.pop(wire, None)
            if entry is not None:
                self._drop(entry, f"its server at {known.session.name} has gone")
            self._admit(peer, known, now)
            return
        if entry is not None and _is_same(entry, offer):
            self._by_path(entry, cast("Any", offer).origin)
            self._came_again(entry, now)
            return
        if entry is not None:
            self._drop(entry, f"another node of {known.session.name} provides it now")
        elif len(known.entries) >= self.limit:
            if wire in known.refused or len(known.refused) < limits.REFUSED_MAX:
                known.refused[wire] = offer
            self._warn_limit(known.session.name, self.kind, self.limit)
            return
        entry = known.entries[wire] = self._entry(peer, offer)
        if entry.origin is not None and self.ways.count(peer, entry.origin, 1):
            self._ways_changed({entry.origin.instance})
        self._judge(entry)

    def _admit(self, peer: int, known: Heard[KeyT, EntryT, OfferT], now: float) -> bool:
        """Take the first offer beyond the limit, if there is room now; return whether there was one."""
        if not known.refused or len(known.entries) >= self.limit:
            return False
        self.take_in(peer, *known.refused.popitem(last=False), now)
        return True

    def _by_path(self, entry: EntryT, origin: Origin | None) -> None:
        """Note by which relays an entry comes now."""
        if origin is None or origin == entry.origin:
            return
        if entry.origin is not None:
            self.ways.count(entry.peer, entry.origin, -1)
        entry.origin = origin
        self.ways.count(entry.peer, origin, 1)
        self._ways_changed({origin.instance})
        self._out.path_changed(entry)

    def _warn_limit(self, peer: str, kind: str, limit: int) -> None:
        text = f"{peer} has more than limits.{kind} = {limit} of this module; the rest is refused until there is "
        text += f"room: raise it in rmpa.toml and `rmpa reload`, or deny some; `rmpa peer info {peer}` counts them"
        self._out.warn(f"{kind}.too_many", peer, text)

    def _drop(self, entry: EntryT, reason: str) -> None:
        """Forget an entry that is not offered any more, or does not outlive its peer's link."""
        known = self._peers[entry.peer]
        del known.entries[entry.wire]
        known.doubtful.discard(entry.wire)
        known.wait(entry, crowded=False)
        another_way = entry.origin is not None and self.ways.count(entry.peer, entry.origin, -1)
        self._went(entry, reason)
        if entry.origin is not None and another_way:
            self._ways_changed({entry.origin.instance})

    def _no_place(self, entry: EntryT) -> tuple[str, str]:
        """Why an entry has no permission, or its node no place (see ``Heard``), and the cause; or empty."""
        if not (permission := self.permission(entry)).allowed:
            return permission.rule, DENIED
        known, most = self._peers[entry.peer], self._out.context.settings.limits.nodes
        if known.free(entry.node, most):
            return "", ""
        return f"{known.session.name} has more nodes than limits.nodes = {most} of this module", CROWDED

    def name_here(self, peer: int, wire: str, origin: Origin | None) -> str:
        """The name here of a topic or service, by the rules for its own module, not by those for the relay."""
        module = self._peers[peer].session.name if origin is None else origin.name
        return self._out.context.names.of(module).local_name(wire)

    def _speaker(self, entry: EntryT) -> tuple[str, str]:
        """The module that permissions are asked for, and the peer that relays its entry, or empty."""
        name = self._peers[entry.peer].session.name
        return (name, "") if entry.origin is None else (entry.origin.name, name)

    def permission(self, entry: EntryT, *, report: bool = False) -> PermissionDecision:
        """Whether its module, and a peer that relays it, may have an entry here; ``report`` counts a refusal."""
        module, relay = self._speaker(entry)
        gate = self._out.context.gate
        decision = gate.judge(self.access, module, entry.name, relay=relay)
        if report and not decision.allowed:
            gate.refused(self.access, module, entry.name, decision, relay=relay)
        return decision

    def _kept_out(self, entry: EntryT, decision: PolicyDecision, wire: str) -> str:
        """Why rules keep an entry out, or empty: ``decision`` by those for all, or those for its peer or module."""
        for name in dict.fromkeys((self.peer_name(entry.peer), self._speaker(entry)[0])):
            if decision.allowed:
                decision = self._out.context.policy.judge_for(name, entry.name, entry.type, wire)
        return "" if decision.allowed else decision.rule

    def _ways_changed(self, instances: Collection[str]) -> None:
        """Judge what relays bring of modules whose best path may be another one."""
        wanted = {instance for instance in instances if instance in self.ways}
        entries = (entry for known in self._peers.values() for entry in known.entries.values()) if wanted else ()
        relayed = [entry for entry in entries if entry.origin is not None and entry.origin.instance in wanted]
        for entry in sorted(relayed, key=lambda one: not one.shown):  # shown ones first: their names get free
            self._judge(entry)

    def reached_here(self, instance: str, *, reached: bool) -> None:
        """Set whether this module reaches another one outside the mesh; what relays bring of that one is hidden."""
        (self.ways.reached_here.add if reached else self.ways.reached_here.discard)(instance)
        self._ways_changed((instance,))
