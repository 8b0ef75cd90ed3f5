"""Which sources of the peers appear in the local graph, and which routes are open for them.

The state of a source's route follows from its facts (``RemoteTopic.state``); ``Imports.follow`` does what they ask
for::

    idle ──wanted──► opening ──opened──► open ──unwanted──► lingering ──time──► idle
      ▲                 │ closed            │ closed             │ wanted ──► open
      │ unwanted        ▼                   ▼
      └────────────── waiting ◄─────────────┘    time ──► opening

Several peers may offer a source: its module itself, and relays. One of them *carries* it: it is shown, and has the
subscribers. A better way opens its route behind the last message that came, and carries the source from then on.

The cost of a method depends on its arguments, not on the number of peers and sources. Sources are keyed by their wire
names; all arguments about the local graph use the names there (``bridge.proxies``).
"""

from __future__ import annotations

import asyncio
import math
import sys
from typing import TYPE_CHECKING, TypeVar

from msgspec import UnsetType

from rmpa.bridge import limits
from rmpa.bridge.messages import (
    CloseRoute,
    Mismatch,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
    is_crossing_name,
)
from rmpa.bridge.peer_offers import ImportBook
from rmpa.bridge.policy import is_outside
from rmpa.bridge.topics.import_route import ImportRoute, RemoteTopic, StreamKey
from rmpa.config.peer_rules import Access
from rmpa.config.rules import CLOCK
from rmpa.core.facts import CONFLICT, CROWDED, DENIED
from rmpa.core.timers import Backoff
from rmpa.mesh import limits as mesh_limits

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from rmpa.bridge.data.reception import ImportFlow
    from rmpa.bridge.topics.part import Topics

_Key = TypeVar("_Key", bound="str | StreamKey")


def _take_out(groups: dict[_Key, dict[RemoteTopic, None]], key: _Key, entry: RemoteTopic) -> None:
    del groups[key][entry]
    if not groups[key]:
        del groups[key]


class Imports(ImportBook[Source, RemoteTopic, TopicOffer]):
    """The inbound half of topics.

    Attributes:
        _topics: The sources of each peer by their local topic (dicts, for their order).
        _ways: What the peers offer of each source (dicts, for their order).
    """

    kind, access = "topics", Access.PUBLISH
    _out: Topics

    def __init__(self, out: Topics) -> None:
        super().__init__(out)
        self._topics: dict[int, dict[str, dict[RemoteTopic, None]]] = {}
        self._ways: dict[StreamKey, dict[RemoteTopic, None]] = {}
        self._local_types: dict[str, str] = {}

    def __iter__(self) -> Iterator[RemoteTopic]:
        """Every source as a peer offers it; changes during the iteration may be missed."""
        return iter([entry for known in self._peers.values() for entry in known.entries.values()])

    def get(self, peer: int, source: Source) -> RemoteTopic | None:
        """One known source."""
        return known.entries.get(source) if (known := self._peers.get(peer)) is not None else None

    def carrier(self, entry: RemoteTopic) -> RemoteTopic | None:
        """The way by which a source comes; ``None`` if it is not in the local graph."""
        return next((one for one in self._ways.get(entry.key, ()) if one.shown), None)

    def knows(self, source: Source) -> bool:
        """Whether any peer offers a source."""
        return any(source in known.entries for known in self._peers.values())

    def at(self, topic: str) -> list[RemoteTopic]:
        """The sources that peers offer for a local topic."""
        return [entry for topics in self._topics.values() for entry in topics.get(topic, ())]

    def offered_by(self, peer: int) -> Mapping[str, Collection[RemoteTopic]]:
        """The topics that a peer offers, by their local names, each with its sources."""
        return self._topics.get(peer, {})

    def flows(self, peer: int) -> list[ImportFlow]:
        """The flows of a peer's open routes."""
        known = self._peers.get(peer)
        entries = known.routes.values() if known is not None else ()
        return [entry.flow for entry in entries if entry.open and entry.flow is not None]

    @property
    def flowing(self) -> bool:
        """Whether any route is open."""
        return any(entry.open for known in self._peers.values() for entry in known.routes.values())

    def link_away(self, peer: int, *, briefly: bool = False) -> None:
        """Suspend the routes of a peer that may come back, and drop what does not outlive the link.

        Args:
            peer: The peer's number.
            briefly: Drop nothing yet: the link fell silent, and most silent peers are back soon. The method is
                called again without it if the peer is not.
        """
        known = self._peers[peer]
        known.routes = {}
        if not briefly:
            known.give_up()
        self._ready(peer)
        for entry in list(known.entries.values()):
            keep = briefly or entry.outlives(silent=known.session.silent)
            if not keep:
                self._hand_over(entry)
            if entry.number:
                # A lingering route has no listener, so it is not continued.
                self._detach(entry, keep=keep and entry.wanted, missed=entry.wanted and not keep)
            entry.number, entry.open, entry.until, entry.problem = 0, False, None, "its peer is away"
            if not keep:
                self._outlived(entry)

    def waits_for(self, peer: int) -> bool:
        """Whether a source outlives the peer's link: one with a local listener that is reliable or latched."""
        known = self._peers[peer]
        return any(entry.outlives(silent=known.session.silent) for entry in known.entries.values())

    def outlasted(self, peer: int, seconds: float) -> set[float]:
        """Drop the sources whose outage a peer has been away for; return the outages of the others, in seconds."""
        entries = self._peers[peer].entries
        for entry in [one for one in entries.values() if one.outage <= seconds]:
            self._outlived(entry)
        return {entry.outage for entry in entries.values()}

    def _outlived(self, entry: RemoteTopic) -> None:
        self._hand_over(entry)
        entry.wanted = False  # its flow ends with its publication
        self._drop(entry, "")

    def detached(self, peer: int) -> None:
        """Detach the open routes of a peer for which nothing waits; ``link_down`` is called next."""
        known = self._peers[peer]
        self._hand_all_over(peer)
        for entry in known.routes.values():
            self._detach(entry, missed=entry.wanted)
        known.routes = {}

    def forget(self, peer: int) -> dict[Source, RemoteTopic]:
        """Forget a peer for good; other relays may now bring its sources, and those that it relayed.

        The peer is unknown when this returns; the caller takes the returned sources out of the local graph.
        """
        self._hand_all_over(peer)
        known = self._peers.pop(peer, None)
        self._topics.pop(peer, None)
        if known is None:
            return {}
        for entry in known.entries.values():
            _take_out(self._ways, entry.key, entry)
        self._ways_changed(self.ways.gone(peer, known.session))
        for other in self.at(CLOCK):
            self._judge(other)
        return known.entries

    def _entry(self, peer: int, offer: TopicOffer) -> RemoteTopic:
        # Many sources share the names of nodes and types, and each is kept once.
        source, kind = Source(offer.topic, sys.intern(offer.node)), sys.intern(offer.type)
        name, origin, known = self.name_here(peer, source.topic, offer.origin), offer.origin, self._peers[peer]
        module = (known.session.instance, known.session.name) if origin is None else (origin.instance, origin.name)
        entry = RemoteTopic(
            peer=peer, wire=source, name=name, node=source.node, origin=origin, type=kind, module=module
        )
        self._list(entry)
        return entry

    def _came_again(self, entry: RemoteTopic, now: float) -> None:
        if not entry.number and entry.until is None:
            entry.problem = ""  # the peer was away, and is back
        self.follow(entry, now)

    def _went(self, entry: RemoteTopic, reason: str) -> None:  # noqa: ARG002 - as of ImportBook
        self._hand_over(entry)
        self._close(entry, missed=entry.wanted)
        self._unlist(entry)
        if entry.shown:
            self._retract(entry)

    def _list(self, entry: RemoteTopic) -> None:
        self._topics.setdefault(entry.peer, {}).setdefault(entry.name, {})[entry] = None
        self._ways.setdefault(entry.key, {})[entry] = None

    def _unlist(self, entry: RemoteTopic) -> None:
        _take_out(self._ways, entry.key, entry)
        _take_out(self._topics[entry.peer], entry.name, entry)

    def local_type(self, topic: str, type_name: str | None) -> None:
        """Set the type with which local nodes publish a topic; ``None`` if none publishes it.

        Remote sources of another type are hidden, and the conflict is reported.
        """
        if self._local_types.get(topic) == type_name:
            return
        if type_name is None:
            del self._local_types[topic]
        else:
            self._local_types[topic] = type_name
        for entry in self.at(topic):
            self._judge(entry)

    def _rejudge_all(self, now: float) -> Iterator[None]:
        # Shown ones first: what another relay brings from now on has the same proxies.
        for entry in sorted(self, key=lambda one: not one.shown):
            if self.get(entry.peer, entry.wire) is entry:
                self._rejudge(entry, now)
            yield

    def _rejudge(self, entry: RemoteTopic, now: float) -> None:
        name = self.name_here(entry.peer, entry.wire.topic, entry.origin)
        if name != entry.name:
            if entry.shown:
                self._hide(entry)
            self._unlist(entry)
            entry.name = name
            self._list(entry)
        self._judge(entry)
        contract = self._out.context.contracts.of(entry.name, entry.type)
        if entry.number and not (entry.asked is not None and entry.asked.same_route(contract)):
            self._close(entry, missed=entry.wanted)
            self.follow(entry, now)

    def _judge(self, entry: RemoteTopic) -> None:
        known, before = self._peers[entry.peer], entry.cause
        entry.objection, entry.cause = self.why_hidden(entry)
        known.wait(entry, crowded=entry.cause == CROWDED)
        self._choose(entry)
        if entry.cause != before and CONFLICT in {entry.cause, before}:
            text = entry.objection if entry.cause == CONFLICT else ""
            if text:
                counter = "clock.second" if entry.name == CLOCK else "mismatch.type"
                self._out.warn(counter, str(entry.wire), f"{entry.wire}: {text}")
            self._out.send(entry.peer, Mismatch(entry.wire.topic, entry.node, "", text))
        if entry.cause == DENIED != before:
            self.permission(entry, report=True)
        if entry.cause == CROWDED != before:
            self._warn_limit(known.session.name, "nodes", self._out.context.settings.limits.nodes)

    def why_hidden(self, entry: RemoteTopic) -> tuple[str, str]:
        """Why a source may not be in the local graph, and the cause (see ``Remote``); empty if it may."""
        origin, topic = entry.origin, entry.name
        if origin is not None and (why := self.ways.objection(origin)):
            return why, ""
        why, cause = self._why_no_time(entry) if topic == CLOCK else self._why_left_out(entry)
        if why and not cause:
            return why, ""
        problem, reason = self._no_place(entry)
        return (why, cause) if cause and reason != DENIED else (problem, reason)

    def _why_left_out(self, entry: RemoteTopic) -> tuple[str, str]:
        """Why rules, another source of its node or a local type keep a source out, and the cause; or empty."""
        topic, decision = entry.name, self._out.context.policy.judge(entry.name, entry.type, entry.past.node)
        if why := self._kept_out(entry, decision, entry.wire.topic):
            return why, ""
        if not is_crossing_name(topic):
            return f"its name here would be {topic}, which is too long", ""
        for other in self._topics[entry.peer][topic]:
            if other.node == entry.node and other is not entry and other.shown:
                return f"it would be {topic} here, as {other.wire.topic} of this node is already; rename one", ""
        if (local := self._local_types.get(topic, entry.type)) != entry.type:
            why = f"its type is {entry.type}, but a local node publishes {topic} as {local}; "
            return why + "rename one of the topics or use one type", CONFLICT
        return "", ""

    def _why_no_time(self, entry: RemoteTopic) -> tuple[str, str]:
        """Why a peer's ``/clock`` is hidden, and the cause; or empty.

        Time has one source: one node of the followed peer, or one of this module.
        """
        if entry.origin is not None and not is_outside(entry.origin):  # the gateway itself brings what is outside
            return "time does not come by a relay", ""
        decision = self._out.context.policy.judge_clock(self.peer_name(entry.peer))
        if not decision.allowed:
            return decision.rule, ""
        if CLOCK in self._local_types:
            return "a node of this module publishes /clock, and time has one source: end that one", CONFLICT
        for other in self.at(CLOCK):
            if other.shown and other is not entry:
                name = self.peer_name(other.peer)
                return f"time comes from {other.node} of {name} already, and has one source", CONFLICT
        return "", ""

    def _choose(self, entry: RemoteTopic) -> None:
        """Let the best way carry a source, by the facts of now; call it whenever one has changed."""
        ways, carrier = self._ways[entry.key], self.carrier(entry)
        best = self._best(ways)
        outranked = self._outranked(best) if best is not None else ""
        for way in ways:
            way.hidden = way.objection or ("" if way is best else outranked)
            if way is not best and way is not carrier and way.wanted:
                self._close(way)
                way.wanted = False
        if carrier is None and best is not None:
            self._peers[best.peer].show(best)
            self._publish(best)
        elif carrier is not None and best is None:
            self._hide(carrier)
        elif carrier is not best and carrier is not None and best is not None:
            if not carrier.wanted or carrier.cause == DENIED:
                self._move(carrier, best)
            elif not best.wanted:
                best.wanted = True
                self._wait(best, -math.inf)  # its route is opened in the next turn of the loop

    def _best(self, ways: Iterable[RemoteTopic]) -> RemoteTopic | None:
        free = (way for way in ways if not way.objection)
        return min(free, key=lambda way: self.ways.rank(way.peer, way.origin), default=None)

    def _outranked(self, best: RemoteTopic) -> str:
        module, name = best.module[1], self.peer_name(best.peer)
        return f"{module} has a link of its own" if best.origin is None else f"{module} is reached by way of {name}"

    def _publish(self, entry: RemoteTopic) -> None:
        """Publish a peer's source at its proxy, in a later turn of the loop."""
        if (session := self._out.bridge.sessions.get(entry.peer)) is not None:
            self._out.pass_on(entry)
            entry.route = ImportRoute(self._out, session, entry)
            self._out.direct_imports.shown(entry)

    def _unpublish(self, entry: RemoteTopic) -> None:
        """Remove a peer's source from the local graph: its data stops at once, its registration in a later turn."""
        self._out.bridge.relay.gone(entry.peer, entry.wire)
        self._out.direct_imports.hidden(entry)
        route, entry.route = entry.route, None
        if route is not None:
            route.end(missed=True)
            route.release()

    def _carry(self, old: RemoteTopic, new: RemoteTopic) -> None:
        """Let another way carry a source, whose proxy and subscribers stay."""
        session, route = self._out.bridge.sessions.get(new.peer), old.route
        if session is not None and route is not None:
            route.session, route.entry = session, new
            old.route, new.route = None, route
            self._out.pass_on(new)
            self._out.bridge.relay.gone(old.peer, old.wire)
            self._out.direct_imports.hidden(old)
            self._out.direct_imports.shown(new)
            self._out.look((new.name,))

    def _detach(
        self, entry: RemoteTopic, *, keep: bool = False, missed: bool = False, last: int | None = None
    ) -> None:
        """End a route's data; unless ``keep``, the latched message is forgotten (a new route brings it again).

        Args:
            entry: The source and its route.
            keep: The link is gone, and the next one will continue after the last message that came.
            missed: Local nodes still listen, so they miss what is published before a route is open again.
            last: If the publisher has gone: the sequence of its last message.
        """
        if entry.number and (session := self._out.bridge.sessions.get(entry.peer)) is not None:
            session.link.routes.pop(entry.number, None)
        if not keep and entry.route is not None:
            entry.route.detach(missed=missed, last=last)

    def _position(self, entry: RemoteTopic) -> tuple[int, int] | None:
        """Epoch and last message of a source, behind which a route goes on, by this way or another; or ``None``."""
        carrier = self.carrier(entry)
        route = carrier.route if carrier is not None else None
        if route is None or route.node is None:
            return None
        if route.flow is not None:
            return route.flow.position
        return self._out.exports.position(Source(route.topic, route.node.name))  # a relay has what its peer has

    def _move(self, old: RemoteTopic, new: RemoteTopic) -> None:
        """Let another way carry a source: the subscribers, the position and what is kept for late ones stay."""
        self._peers[old.peer].hide(old)
        self._peers[new.peer].show(new)
        wanted, old.wanted = old.wanted, False
        self._carry(old, new)
        self._close(old)
        if wanted and not new.open and not new.wanted:
            self._wait(new, -math.inf)
        new.wanted = wanted
        self._show_behind(old)

    def _hand_over(self, entry: RemoteTopic) -> None:
        """Let another way carry a source at once, if there is one: this one ends."""
        others = [way for way in self._ways[entry.key] if way is not entry] if entry.shown else ()
        if (other := self._best(others)) is not None:
            self._move(entry, other)

    def _hand_all_over(self, peer: int) -> None:
        if (known := self._peers.get(peer)) is not None:
            self._ready(peer)
            for entry in list(known.entries.values()):
                self._hand_over(entry)

    def _hide(self, entry: RemoteTopic) -> None:
        self._close(entry)
        entry.wanted = False
        self._retract(entry)

    def _retract(self, entry: RemoteTopic) -> None:
        """Take a source out of the local graph, and show those that could not stand beside it."""
        self._peers[entry.peer].hide(entry)
        self._unpublish(entry)
        self._show_behind(entry)

    def _show_behind(self, entry: RemoteTopic) -> None:
        """Show what could not stand beside an entry that is shown no more."""
        known = self._peers[entry.peer]
        if entry.name == CLOCK:
            behind = self.at(CLOCK)
        else:
            behind = [s for s in self._topics.get(entry.peer, {}).get(entry.name, ()) if s.node == entry.node]
        for other in behind:
            if other is not entry and self.get(other.peer, other.wire) is other:
                self._judge(other)
        for waiting in known.admitted(self._out.context.settings.limits.nodes):
            self._judge(waiting)

    def follow(self, entry: RemoteTopic, now: float) -> None:
        """Open, keep or close a source's route, by the facts of now; call it again whenever one has changed."""
        known, due = self._peers[entry.peer], entry.until is not None and entry.until <= now
        match entry.state:
            case "opening" if not entry.wanted:
                self._close(entry)
            case "lingering" if due:
                self._close(entry)
            case "lingering" if entry.until is None:
                self._wait(entry, now + limits.ROUTE_LINGER)
            case "waiting" if known.session.linked and (due or entry.until is None):
                known.last_route += 1
                entry.number, known.routes[known.last_route] = known.last_route, entry
                entry.until = None  # the peer answers once its publisher has, and that may take long
                entry.asked = self._out.context.contracts.of(entry.name, entry.type)
                epoch, after = self._position(entry) or (0, 0)
                asked = OpenRoute(entry.number, entry.wire.topic, entry.node, entry.asked, epoch, after)
                self._out.send(entry.peer, asked)
            case "open" | "idle":
                entry.until = None

    def demand(self, entry: RemoteTopic, now: float, *, wanted: bool) -> None:
        """Note the first local listener of a source, or that the last one has gone."""
        if self.get(entry.peer, entry.wire) is not entry:
            return
        if not wanted and entry.state == "waiting":
            self._close(entry)
        entry.wanted = wanted
        self.follow(entry, now)
        self._choose(entry)

    def opened(self, peer: int, message: RouteOpened, now: float) -> None:
        """Take the peer's answer that a route is open; ignored if the route was closed here meanwhile.

        A description of another type than the offered one closes the route.
        """
        entry = self._peers[peer].routes.get(message.route)
        if entry is None or entry.open:
            return
        if message.description.type != entry.type:
            why = f"it is offered as {entry.type}, but its publisher sends {message.description.type}"
            self._out.send(peer, CloseRoute(message.route))
            self._out.warn("mismatch.type", str(entry.wire), f"{entry.wire}: {why}")
            self._fail(entry, why, now)
            return
        entry.open, entry.until, entry.problem, entry.backoff = True, None, "", None
        entry.description, entry.contract = message.description, message.contract
        if (carrier := self.carrier(entry)) is not None and carrier is not entry:
            self._move(carrier, entry)
        if entry.route is not None:
            entry.route.open(message)

    def closed(self, peer: int, message: RouteClosed, now: float) -> None:
        """Handle a route that the peer has refused or closed; ignored if it was closed here meanwhile."""
        if (entry := self._peers[peer].routes.get(message.route)) is not None:
            self._fail(entry, message.reason, now, None if isinstance(message.last, UnsetType) else message.last)

    def next_route(self, peer: int) -> int:
        """A new number for a route of a peer's link."""
        self._peers[peer].last_route += 1
        return self._peers[peer].last_route

    def _wait(self, entry: RemoteTopic, until: float) -> None:
        """Follow a source again at a time, in a later turn of the loop, unless it waits for another time by then."""
        entry.until, loop = until, asyncio.get_running_loop()
        loop.call_at(max(until, loop.time()), self._waited, entry, until)

    def _waited(self, entry: RemoteTopic, until: float) -> None:
        if entry.until == until and entry.peer in self._peers:
            self.follow(entry, max(until, self._out.now()))

    def _close(self, entry: RemoteTopic, *, missed: bool = False) -> None:
        """End a source's route in any state; ``missed``: local nodes still listen, and miss messages from now on."""
        if entry.number:
            self._peers[entry.peer].routes.pop(entry.number, None)
            self._out.send(entry.peer, CloseRoute(entry.number))
            self._detach(entry, missed=missed)
        elif entry.wanted and entry.until is None:
            self._detach(entry, missed=missed)  # it waited for a new link
        entry.number, entry.open, entry.until, entry.backoff = 0, False, None, None

    def _fail(self, entry: RemoteTopic, reason: str, now: float, last: int | None = None) -> None:
        """A route is refused or lost: it is opened again after the back-off if a node still listens."""
        self._peers[entry.peer].routes.pop(entry.number, None)
        if last is None:
            self._hand_over(entry)
        # Where its publisher may be there still, the next route goes on behind what has come.
        keep = last is None and entry.wanted and entry.reliable
        self._detach(entry, keep=keep, missed=entry.wanted, last=last)
        entry.number, entry.open, entry.until, entry.problem = 0, False, None, reason
        self._choose(entry)
        if entry.wanted:
            if entry.backoff is None:
                entry.backoff = Backoff(mesh_limits.BACKOFF_FIRST, mesh_limits.BACKOFF_MAX, self._out.rng)
            self._wait(entry, now + entry.backoff.delay())
