"""Which sources of the peers appear in the local graph, and which routes are open for them.

Sans-I/O: the driver passes in the peers' advertisements and whether local nodes listen. Each call returns the
actions to carry out. The states of a source's route are in ``topics.remote_topic``.

The cost of a method depends on its arguments, not on the number of peers and sources. Only a long advertisement takes
long, so it is split (``portions``).

Sources are keyed by their wire names. ``RemoteTopic.topic`` is the name of the topic in the local graph
(``bridge.proxies``); all arguments about the local graph use that one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import chain, islice
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge import offers as peer_limits
from rmpa.bridge.actions import Action, Detach, Publish, Retract, Send, Warn
from rmpa.bridge.messages import (
    Advertise,
    Mismatch,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
    is_crossing_name,
)
from rmpa.bridge.offers import NodePlaces, PeerOffers
from rmpa.bridge.policy import OPEN_GATE, PermissionGate, RelayPaths
from rmpa.bridge.proxies import Names, PeerNames
from rmpa.bridge.topics.routes import ImportRoutes, RemoteTopic, RouteState
from rmpa.config.peer_rules import Access
from rmpa.config.rules import CLOCK
from rmpa.config.settings import LimitSettings
from rmpa.core.contract import Contracts

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping

    from rmpa.bridge.messages import Origin
    from rmpa.bridge.offers import Change
    from rmpa.bridge.policy import Policy


def _nothing(_peer: int, _source: Source) -> None:
    """Returns ``None``: no route outlives its link."""


_NO_NAMES: Final = Names()
_DEFAULT_LIMITS: Final = LimitSettings()


@dataclass(slots=True, kw_only=True)
class _ImportPeer(PeerOffers[Source, RemoteTopic, TopicOffer]):
    """The sources that one run of a peer offers, over one or more links.

    Args:
        names: Translates the peer's names to local ones.
        topics: The offered sources by their local topic (dicts, for their order).
        places: The sources shown in the local graph, by local topic and the peer's node.
        silent: Whether its last link ended by silence.
        relayed: The sources that it only relays, by the instance of their own module (dicts, for their order).
    """

    names: PeerNames
    topics: dict[str, dict[Source, None]] = field(default_factory=dict)
    places: dict[tuple[str, str], Source] = field(default_factory=dict)
    silent: bool = False
    relayed: dict[str, dict[Source, None]] = field(default_factory=dict)


class Imports:
    """The inbound half of the bridge.

    Args:
        policy: Decides which sources may cross; both ends judge.
        rng: Uniform numbers in [0, 1) for the back-off's jitter.
        contracts: The contracts that this module asks for.
        position: ``(peer, source)``: epoch and last message of a reliable route that outlived its link, or ``None``.
        names: Translates the peers' names to local ones.
        limit_settings: Bounds the topics and nodes that are taken from one peer.
        gate: Decides which topics each module may publish here.
    """

    def __init__(
        self,
        policy: Policy,
        rng: Callable[[], float],
        contracts: Contracts | None = None,
        position: Callable[[int, Source], tuple[int, int] | None] = _nothing,
        names: Names = _NO_NAMES,
        limit_settings: LimitSettings = _DEFAULT_LIMITS,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        self._gate = gate
        self._policy = policy
        self.limit_settings = limit_settings
        self._names = names
        self._contracts = contracts if contracts is not None else Contracts()
        self._routes = ImportRoutes(self.get, self._contracts, position, rng)
        self._peers: dict[int, _ImportPeer] = {}
        self.ways = RelayPaths(gate.may_relay)
        """Selects the path to each module that relays offer."""
        self._local_types: dict[str, str] = {}
        self._strings: dict[str, str] = {}
        """Names of nodes and types that many sources share, so that each is kept once."""

    def __iter__(self) -> Iterator[tuple[int, Source, RemoteTopic]]:
        """Every known source with its peer; changes during the iteration may be missed."""
        for peer, known in list(self._peers.items()):
            for source, entry in list(known.entries.items()):
                yield peer, source, entry

    def get(self, peer: int, source: Source) -> RemoteTopic | None:
        """One known source."""
        return known.entries.get(source) if (known := self._peers.get(peer)) is not None else None

    def knows(self, source: Source) -> bool:
        """Whether any peer offers a source."""
        return any(source in known.entries for known in self._peers.values())

    def at(self, topic: str) -> Iterator[tuple[int, Source]]:
        """The sources that peers offer for a local topic, each with its peer."""
        return ((peer, source) for peer, known in self._peers.items() for source in known.topics.get(topic, ()))

    def offered_by(self, peer: int) -> Mapping[str, Collection[Source]]:
        """The topics that a peer offers, by their local names, each with its sources."""
        return known.topics if (known := self._peers.get(peer)) is not None else {}

    def relayed_topics(self, instance: str) -> set[str]:
        """The shown topics of a module that is reached by relays, by their local names."""
        return {
            known.entries[source].topic
            for known in self._peers.values()
            for source in known.relayed.get(instance, ())
            if known.entries[source].shown
        }

    def local_type(self, topic: str, type_name: str | None) -> list[Action]:
        """Set the type with which local nodes publish a topic; ``None`` if none publishes it.

        Remote sources of another type are hidden, and the conflict is reported.
        """
        if self._local_types.get(topic) == type_name:
            return []
        if type_name is None:
            del self._local_types[topic]
        else:
            self._local_types[topic] = type_name
        actions: list[Action] = []
        for peer, known in self._peers.items():
            for source in known.topics.get(topic, ()):
                entry = known.entries[source]
                shown, conflict = entry.shown, entry.conflict
                actions += self._show_or_hide(peer, source, entry)
                if shown and not entry.shown:
                    actions += self._report_conflict(peer, source, entry)
                elif conflict and not entry.conflict:
                    actions.append(Send(peer, Mismatch(source.topic, source.node, "", "")))
        return actions

    def refused(self, peer: int) -> int:
        """How many topics a peer offers beyond ``limits.topics``."""
        return len(known.refused) if (known := self._peers.get(peer)) is not None else 0

    def refused_nodes(self, peer: int) -> Mapping[str, Collection[Source]]:
        """The nodes of a peer that are hidden because of ``limits.nodes``, with their sources."""
        return known.nodes.refused if (known := self._peers.get(peer)) is not None else {}

    def apply_rules(
        self,
        policy: Policy,
        contracts: Contracts,
        names: Names,
        now: float,
        limit_settings: LimitSettings = _DEFAULT_LIMITS,
    ) -> Iterator[list[Action]]:
        """Takes new rules; sources and routes that they do not change go on untouched.

        Returns:
            The actions, source by source; each source is judged when its item is taken.
        """
        self._policy, self._contracts, self._names, self.limit_settings = policy, contracts, names, limit_settings
        self._routes.contracts = contracts
        for known in self._peers.values():
            known.names = names.of(known.name)
            known.nodes.limit = limit_settings.nodes
        # Shown ones first: what another relay brings from now on has the same proxies.
        sources = sorted(self, key=lambda one: not one[2].shown) if self._gate.on else self
        return chain(
            (self._rejudge(peer, source, now) for peer, source, _ in sources),
            (actions for peer in list(self._peers) for actions in self._admit(peer, now)),
        )

    def _admit(self, peer: int, now: float) -> Iterator[list[Action]]:
        """Adds the refused offers beyond ``limits.topics``, one at a time, while there is room."""
        while (known := self._peers.get(peer)) and (offer := known.admitted(self.limit_settings.topics)):
            yield self._add(peer, offer, now)

    def _rejudge(self, peer: int, source: Source, now: float) -> list[Action]:
        entry = self.get(peer, source)
        if entry is None:
            return []
        known = self._peers[peer]
        actions: list[Action] = []
        topic = self._names_of(known, entry.origin).local_name(source.topic)
        if topic != entry.topic:
            actions += self._hide(peer, source, entry) if entry.shown else []
            self._unlist(known, source, entry)
            entry.topic = topic
            known.topics.setdefault(topic, {})[source] = None
        actions += self._show_or_hide(peer, source, entry)
        contract = self._contracts.of(entry.topic, entry.type)
        if entry.route and not (entry.asked is not None and entry.asked.same_route(contract)):
            actions += self._routes.close(peer, source, entry, missed=entry.wanted)
            actions += self._routes.open(peer, source, entry, now) if entry.wanted else []
        return actions

    def link_up(self, peer: int, name: str = "", instance: str = "", rank: int = 0) -> list[Action]:
        """Registers a link, of a new peer or of one that was away; its first message begins a full advertisement.

        Args:
            peer: The peer's number.
            name: The peer's name, which selects the rules for it.
            instance: Its run: sources of it that relays offer are hidden while it has a link of its own.
            rank: Its GUID, as a number, which ranks it among relays.
        """
        new = _ImportPeer(name=name, nodes=NodePlaces(self.limit_settings.nodes), names=self._names.of(name))
        known = self._peers.setdefault(peer, new)
        known.away = known.silent = False
        self._routes.link_up(peer)
        return self._ways_changed(self.ways.linked(peer, name, instance, rank)) if instance else []

    def link_away(self, peer: int, *, briefly: bool = False) -> tuple[list[Action], bool]:
        """Suspends the routes of a peer that may come back; sources that do not outlive the link are dropped.

        Args:
            peer: The peer's number.
            briefly: Drop nothing yet: the link fell silent, and most silent peers are back soon. The method is
                called again without it if the peer is not.

        Returns:
            The actions, and whether a source waits for the peer; if none does, call ``link_down`` next.
        """
        actions: list[Action] = []
        known = self._peers[peer]
        known.away = True
        known.silent = known.silent or briefly
        self._routes.link_down(peer)
        if not briefly:
            known.give_up()
        for source, entry in list(known.entries.items()):
            keep = briefly or entry.outlives(silent=known.silent)
            if entry.route:
                # A lingering route has no listener, so it is not continued.
                goes_on = keep and entry.state is not RouteState.LINGERING
                missed = entry.wanted and entry.state is not RouteState.LINGERING
                actions.append(Detach(peer, source, entry.route, keep=goes_on, missed=missed and not goes_on))
            entry.route = 0
            if keep:
                self._routes.suspend(entry)
            else:
                actions += self._drop(peer, source, entry)
        return actions, bool(known.entries)

    def waits_for(self, peer: int) -> bool:
        """Whether a source outlives the peer's link: one with a local listener that is reliable or latched."""
        known = self._peers[peer]
        return any(entry.outlives(silent=known.silent) for entry in known.entries.values())

    def outages(self, peer: int) -> set[float]:
        """The outages, in seconds, of the sources that are kept for a peer."""
        return {entry.outage for entry in self._peers[peer].entries.values()}

    def outlasted(self, peer: int, seconds: float) -> list[Action]:
        """Drops the sources whose outage is over: their peer has been away for ``seconds``."""
        gone = [one for one in self._peers[peer].entries.items() if one[1].outage <= seconds]
        return [action for source, entry in gone for action in self._drop(peer, source, entry)]

    def detached(self, peer: int) -> list[Action]:
        """Detaches the open routes of a peer for which nothing waits; ``link_down`` is called next."""
        gone = [(source, entry) for source in self._routes.link_down(peer) if (entry := self.get(peer, source))]
        return [Detach(peer, source, entry.route, missed=entry.wanted) for source, entry in gone if entry.route]

    def link_down(self, peer: int) -> Iterator[Action]:
        """Forgets a peer for good; the actions remove its sources from the local graph.

        The peer is unknown as soon as this returns. Its entries are freed as the actions are taken, because freeing
        thousands at once takes long.
        """
        self._routes.link_down(peer)
        known = self._peers.pop(peer, None)
        return _gone(peer, known.entries) if known is not None else iter(())

    def unlinked(self, peer: int) -> list[Action]:
        """Call after ``link_down``: other relays may now bring the peer's sources, and those that it relayed."""
        return self._ways_changed(self.ways.unlinked(peer))

    def reached_here(self, instance: str, *, reached: bool) -> list[Action]:
        """Set whether this module reaches another one outside the mesh; what relays bring of that one is hidden."""
        if reached:
            self.ways.reached_here.add(instance)
        else:
            self.ways.reached_here.discard(instance)
        return self._ways_changed((instance,))

    def _ways_changed(self, instances: Collection[str]) -> list[Action]:
        """Judges sources of modules whose path may have changed; shown ones first, so that their names get free."""
        touched = [
            (not entry.shown, peer, source)
            for instance in instances
            for peer, known in self._peers.items()
            for source in known.relayed.get(instance, ())
            if (entry := known.entries.get(source)) is not None
        ]
        return [
            action
            for _, peer, source in sorted(touched)
            if (entry := self.get(peer, source)) is not None
            for action in self._show_or_hide(peer, source, entry)
        ]

    def _names_of(self, known: _ImportPeer, origin: Origin | None) -> PeerNames:
        """The naming rules of a source: those for its own module, not those for the relay."""
        return known.names if origin is None else self._names.of(origin.name)

    def portions(self, peer: int, message: Advertise) -> Iterator[Change[TopicOffer, Source]]:
        """Split an advertisement into portions, each small enough for one call of ``take_in``."""
        known, full, more = self._peers[peer], message.full, message.more
        return known.changes(message.added, message.removed, lambda offer: offer.source, full=full, more=more)

    def take_in(self, peer: int, change: Change[TopicOffer, Source], now: float) -> list[Action]:
        """Applies a portion of an advertisement: sources that the peer has added or removed."""
        known = self._peers[peer]
        actions: list[Action] = []
        for source in change.removed:
            known.refused.pop(source, None)
            actions += self._forget(peer, source)
        for offer in change.added:
            actions += self._add(peer, offer, now)
        admitted = islice(self._admit(peer, now), limits.APPLIED_AT_ONCE)
        return actions + [action for one in admitted for action in one]

    def advertised(self, peer: int, message: Advertise, now: float = 0.0) -> list[Action]:
        """Applies a whole advertisement at once."""
        return [action for change in self.portions(peer, message) for action in self.take_in(peer, change, now)]

    # --- routes ------------------------------------------------------------------------------------------------

    def opened(self, peer: int, message: RouteOpened, now: float) -> list[Action]:
        """Takes the peer's answer that a route is open; ignored if the route was closed here meanwhile."""
        return self._routes.opened(peer, message, now)

    def closed(self, peer: int, message: RouteClosed, now: float) -> list[Action]:
        """Handles a route that the peer has refused or closed."""
        return self._routes.closed(peer, message, now)

    def demand(self, peer: int, source: Source, now: float, *, wanted: bool) -> list[Action]:
        """Reports the first local listener of a source, or that the last one has gone."""
        entry = self.get(peer, source)
        return self._routes.demand(peer, source, entry, now, wanted=wanted) if entry is not None else []

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is due, monotonic seconds; ``None`` if no timer runs."""
        return self._routes.next_timer()

    def handle_timer(self, now: float) -> list[Action]:
        """Handle due timers, a bounded number of them; if some remain, ``next_timer`` is in the past."""
        return self._routes.handle_timer(now)

    def mismatched(self, peer: int, source: Source, subscriber: str, text: str) -> list[Action]:
        """Reports, here and to the peer, a local subscriber that was refused because its definition differs."""
        return [
            Warn("mismatch.md5", str(source), text),
            Send(peer, Mismatch(source.topic, source.node, subscriber, text)),
        ]

    def _add(self, peer: int, offer: TopicOffer, now: float) -> list[Action]:
        known = self._peers[peer].entries
        source = Source(offer.topic, self._shared(offer.node))
        actions: list[Action] = []
        if source in known:
            entry = known[source]
            if (entry.type, entry.origin) == (offer.type, offer.origin):
                # It was offered over an earlier link: open the route again that ended with that link.
                waits = entry.state is RouteState.WAITING and entry.timer is None
                if waits or entry.state is RouteState.IDLE:
                    entry.problem = ""  # the peer was away, and is back
                return self._routes.open(peer, source, entry, now) if waits else []
            actions += self._forget(peer, source)
        elif len(known) >= self.limit_settings.topics:
            name = self._peers[peer].name
            self._peers[peer].refuse(source, offer)
            return [Warn("topics.too_many", name, peer_limits.warning(name, "topics", self.limit_settings.topics))]
        topic = self._names_of(self._peers[peer], offer.origin).local_name(source.topic)
        entry = known[source] = RemoteTopic(self._shared(offer.type), topic, origin=offer.origin)
        self._peers[peer].topics.setdefault(topic, {})[source] = None
        if offer.origin is not None:
            self._peers[peer].relayed.setdefault(offer.origin.instance, {})[source] = None
            if self.ways.count(peer, offer.origin, 1):
                actions += self._ways_changed({offer.origin.instance})
        actions += self._show_or_hide(peer, source, entry)
        if entry.crowded:
            name = self._peers[peer].name
            actions.append(
                Warn("nodes.too_many", name, peer_limits.warning(name, "nodes", self.limit_settings.nodes))
            )
        return actions + self._report_conflict(peer, source, entry)

    def _shared(self, text: str) -> str:
        if len(self._strings) >= limits.SHARED_STRINGS:
            self._strings.clear()  # the strings live on where they are used
        return self._strings.setdefault(text, text)

    def _show_or_hide(self, peer: int, source: Source, entry: RemoteTopic) -> list[Action]:
        nodes = self._peers[peer].nodes
        entry.hidden, entry.conflict = self._why_hidden(peer, source, entry)
        self._judge_permission(peer, entry)
        entry.crowded = not entry.hidden and not nodes.free(source.node)
        if entry.crowded:
            entry.hidden = f"{self._peers[peer].name} has more nodes than limits.nodes = {nodes.limit} of this module"
            nodes.refuse(source.node, source)
        else:
            nodes.leave(source.node, source)
        if entry.shown is not bool(entry.hidden):
            return []
        if entry.hidden:
            return self._hide(peer, source, entry)
        entry.shown = True
        nodes.show(source.node)
        self._peers[peer].places[entry.topic, source.node] = source
        topic = entry.topic if entry.topic != source.topic else ""
        return [Publish(peer, source, entry.type, topic, entry.origin)]

    def _judge_permission(self, peer: int, entry: RemoteTopic) -> None:
        """Hides a source that its module may not publish here, and reports it if it was not so before."""
        known, origin = self._peers[peer], entry.origin
        module, relay = (known.name, "") if origin is None else (origin.name, known.name)
        before, entry.denied = entry.denied, False
        if entry.hidden and not entry.conflict:
            return  # by a rule that does not depend on permissions
        decision = self._gate.judge(Access.PUBLISH, module, entry.topic, relay=relay)
        if decision.allowed:
            return
        entry.denied, entry.conflict, entry.hidden = True, False, decision.rule
        if not before:
            self._gate.refused(Access.PUBLISH, module, entry.topic, decision, relay=relay)

    def _hide(self, peer: int, source: Source, entry: RemoteTopic) -> list[Action]:
        entry.shown = False
        entry.wanted = False
        return [
            *self._routes.close(peer, source, entry),
            Retract(peer, source),
            *self._yield_place(peer, source, entry),
        ]

    def _yield_place(self, peer: int, source: Source, entry: RemoteTopic) -> list[Action]:
        """Frees the place of a source that has left the local graph, and shows sources that were refused."""
        known = self._peers[peer]
        del known.places[entry.topic, source.node]
        known.nodes.hide(source.node)
        actions = self._behind(peer, source, entry)
        for sources in known.nodes.admitted():
            actions += [a for s in sources for a in self._show_or_hide(peer, s, known.entries[s])]
        return actions

    def _behind(self, peer: int, source: Source, entry: RemoteTopic) -> list[Action]:
        """Judges again the sources that could not be shown beside this one."""
        known = self._peers[peer]
        if entry.topic == CLOCK:
            entry.shown = False
            waiting = [(p, s) for p, k in self._peers.items() for s in k.topics.get(CLOCK, ()) if s != source]
            return [a for p, s in waiting for a in self._show_or_hide(p, s, self._peers[p].entries[s])]
        if self._names_of(known, entry.origin).plain:
            return []
        behind = [s for s in known.topics.get(entry.topic, ()) if s.node == source.node and s != source]
        return [action for s in behind for action in self._show_or_hide(peer, s, known.entries[s])]

    @staticmethod
    def _unlist(known: _ImportPeer, source: Source, entry: RemoteTopic) -> None:
        del known.topics[entry.topic][source]
        if not known.topics[entry.topic]:
            del known.topics[entry.topic]

    def _report_conflict(self, peer: int, source: Source, entry: RemoteTopic) -> list[Action]:
        """Reports a conflict, if there is one, in the log and to the peer: see ``RemoteTopic.conflict``."""
        if not entry.conflict:
            return []
        return [
            Warn("mismatch.type", str(source), f"{source}: {entry.hidden}"),
            Send(peer, Mismatch(source.topic, source.node, "", entry.hidden)),
        ]

    def _why_hidden(self, peer: int, source: Source, entry: RemoteTopic) -> tuple[str, bool]:
        known, topic, type_name = self._peers[peer], entry.topic, entry.type
        origin = entry.origin
        if origin is not None and (why := self.ways.why_not(peer, origin)):
            return why, False
        if topic == CLOCK:
            return self._why_no_time(peer, source, entry)
        decision = self._policy.judge(topic, type_name, source.node if origin is None else origin.node)
        for name in (known.name,) if origin is None else (known.name, origin.name):
            if decision.allowed:
                decision = self._policy.judge_for(name, topic, type_name, source.topic)
        if not decision.allowed:
            return decision.rule, False
        if not is_crossing_name(topic):
            return f"its name here would be {topic}, which is too long", False
        if (holder := known.places.get((topic, source.node), source)) != source:
            return f"it would be {topic} here, as {holder.topic} of this node is already; rename one", False
        local = self._local_types.get(topic, type_name)
        if local == type_name:
            return "", False
        why = f"its type is {type_name}, but a local node publishes {topic} as {local}; "
        return why + "rename one of the topics or use one type", True

    def _why_no_time(self, peer: int, source: Source, entry: RemoteTopic) -> tuple[str, bool]:
        """Why a peer's ``/clock`` is hidden, or empty, and whether that is a conflict.

        Time has one source: one node of the followed peer, or one of this module.
        """
        if entry.origin is not None:
            return "time does not come by a relay", False
        decision = self._policy.judge_clock(self._peers[peer].name)
        if not decision.allowed:
            return decision.rule, False
        if CLOCK in self._local_types:
            return "a node of this module publishes /clock, and time has one source: end that one", True
        for other, known in self._peers.items():
            for one in known.topics.get(CLOCK, ()):
                if known.entries[one].shown and (other, one) != (peer, source):
                    return f"time comes from {one.node} of {known.name} already, and has one source", True
        return "", False

    def _forget(self, peer: int, source: Source) -> list[Action]:
        entry = self._peers[peer].entries.get(source)
        if entry is None:
            return []
        return self._routes.close(peer, source, entry) + self._drop(peer, source, entry)

    def _drop(self, peer: int, source: Source, entry: RemoteTopic) -> list[Action]:
        known = self._peers[peer]
        actions: list[Action] = []
        known.nodes.leave(source.node, source)
        if entry.shown:
            actions += [Retract(peer, source), *self._yield_place(peer, source, entry)]
        del known.entries[source]
        known.doubtful.discard(source)
        self._unlist(known, source, entry)
        if entry.origin is not None:
            instance = entry.origin.instance
            del known.relayed[instance][source]
            if not known.relayed[instance]:
                del known.relayed[instance]
            if self.ways.count(peer, entry.origin, -1):
                actions += self._ways_changed({instance})
        return actions


def _gone(peer: int, sources: dict[Source, RemoteTopic]) -> Iterator[Action]:
    while sources:
        source, entry = sources.popitem()
        if entry.route:
            yield Detach(peer, source, entry.route)
        if entry.shown:
            yield Retract(peer, source)
