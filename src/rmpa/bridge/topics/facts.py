"""The topics' piece of the snapshot: the local graph, the routes across the mesh, their figures and transports."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Any, cast

from rmpa.bridge.data.quality import QosEventKind, QosWatch, shown_seconds
from rmpa.bridge.data.route_sender import ReliableRouteSender
from rmpa.bridge.direct.paths import AGENTS, Condition, Want, unmet_by_contract
from rmpa.bridge.messages import Source
from rmpa.bridge.policy import PolicyDecision
from rmpa.config.rules import CLOCK
from rmpa.core.contract import DEFAULT_CONTRACT, KEYS, Contract, Transport
from rmpa.core.facts import (
    CONFLICT,
    CROWDED,
    Arrival,
    ContractTerm,
    EventInfo,
    PublisherReport,
    RouteInfo,
    SubscriberTransport,
    TopicInfo,
)
from rmpa.core.identity import is_own, proxied_node
from rmpa.ros.wire.tcpros import LENGTH, printable
from rmpa.runtime.loop import SystemClock, sorted_yielding, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.data.export import ExportRoute
    from rmpa.bridge.offers import PeerRun
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.exports import LocalSource
    from rmpa.bridge.topics.import_route import RemoteTopic


class TopicFacts:
    """Reads what core and bridge know of topics; changes nothing.

    It yields to data every 250 µs. What it iterates over is a copy, because data may change the routes.

    Args:
        bridge: The bridge, with the local core.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._core = bridge.core
        self._bridge = bridge
        self._clock = SystemClock()

    def follow_clocks(self) -> None:
        """Record each link's estimate of its peer's clock, once a second."""
        for session in self._bridge.sessions.linked():
            offset, error = session.link.clock_offset, session.link.clock_error
            if offset is not None and error is not None:
                session.clocks.add(offset, error, self._clock.now())

    def contract(self, topic: str, type_name: str) -> dict[str, ContractTerm]:
        """The terms of a topic's contract by the settings, by key; ``type_name`` may be empty."""
        return {
            key: ContractTerm(value=cast("str | float | None", value), rule=rule)
            for key, (value, rule) in self._bridge.context.contracts.explain(topic, type_name).items()
        }

    def infos(self, wanted: Collection[str] | None = None) -> tuple[TopicInfo, ...]:
        """All topics of the local graph and of the peers, by name; or those that are wanted."""
        if wanted is not None and not wanted:
            return ()
        state = self._core.state()
        routes: dict[str, list[RouteInfo]] = {}
        mismatches: dict[str, list[str]] = {}
        self.follow_clocks()
        for topic, info, texts in chain(self._incoming(wanted), self._outgoing(wanted)):
            if info is not None:
                routes.setdefault(topic, []).append(info)
            mismatches.setdefault(topic, []).extend(texts)
        tables = (state.publishers, state.subscribers, routes)
        names: Iterable[str] = chain(*tables) if wanted is None else wanted
        known = {name for name in yielding_to_data(names) if any(name in table for table in tables)}
        unreachable = {info.node: str(info) for info in self._core.unreachable_infos()}
        found = []
        for name in yielding_to_data(sorted_yielding(known)):
            nodes, type_name = tuple(state.publishers.get(name, ())), state.types.get(name, "")
            own, crossing = tuple(node for node in nodes if not is_own(node)), tuple(routes.get(name, ()))
            decision = self._decision(name, type_name, own[0] if own else "/")
            topic_info = TopicInfo(
                name=name,
                type=type_name or next((route.type for route in crossing), ""),
                md5=next((route.md5 for route in crossing if route.md5), ""),
                publishers=own,
                subscribers=tuple(node for node in state.subscribers.get(name, ()) if not is_own(node)),
                remote_subscribers=tuple(
                    ":".join(whose) for node in state.subscribers.get(name, ()) if (whose := proxied_node(node))
                ),
                routes=crossing,
                crosses=decision.allowed,
                policy=decision.rule,
                mismatches=tuple(mismatches.get(name, ())),
                unreachable=tuple(unreachable[node] for node in nodes if node in unreachable),
            )
            found.append(topic_info)
        return tuple(found)

    def used(self, most: int) -> tuple[Collection[str] | None, int]:
        """The topics to show where at most so many can be shown, and the number of the others.

        First those with a node of this module or an open route, all of them, then those with a problem, then others.

        Returns:
            The topics, ``None`` for all, and how many are left out.
        """
        state, topics = self._core.state(), self._bridge.topics
        idle: set[str] = set()
        first, problems = set[str](), set[str]()
        for name, nodes in yielding_to_data(list(state.subscribers.items())):
            (idle if all(map(is_own, nodes)) else first).add(name)
        for entry in yielding_to_data(list(topics.imports)):
            if entry.state != "idle" or entry.direct:
                first.add(entry.name)
            elif not entry.shown or entry.problem or topics.mismatches.texts(entry.wire):
                problems.add(entry.name)
            else:
                idle.add(entry.name)
        first.update(source.topic for source in yielding_to_data(topics.exports.offered))
        others = idle | problems
        first.update(name for name in yielding_to_data(state.publishers) if name not in others)
        return first_names(most, first, {}, (problems - first, idle - problems - first))

    def _decision(self, name: str, type_name: str, node: str) -> PolicyDecision:
        """Whether a topic of this module may cross."""
        decision = self._bridge.context.policy.judge(name, type_name, node)
        follow = self._bridge.context.settings.time.follow
        if name == CLOCK and follow and not decision.allowed:
            text = f'time.follow = "{follow}": that module\'s comes here; one of this module does not cross'
            return PolicyDecision(True, text)
        return decision

    def _incoming(self, wanted: Collection[str] | None) -> Iterator[tuple[str, RouteInfo, list[str]]]:
        """The topic of each source of a peer with its route, and its mismatches."""
        sessions = {session.peer: session for session in self._bridge.sessions}
        for entry in yielding_to_data(list(self._bridge.topics.imports)):
            if wanted is not None and entry.name not in wanted:
                continue
            session = sessions[entry.peer]
            texts = [f"{session.name}: {entry.hidden}"] if entry.cause == CONFLICT else []
            texts += self._bridge.topics.mismatches.texts(entry.wire)
            yield entry.name, self._incoming_route(session, entry), texts

    def _incoming_route(self, session: PeerSession, entry: RemoteTopic) -> RouteInfo:
        """The route of a peer's source."""
        contracts, flow, publication = self._bridge.context.contracts, entry.flow, entry.publication
        source, about, now = entry.wire, entry.description, self._clock.now()
        latched = about.latching if about is not None else False
        proxies, node = self._bridge.sessions.proxies(session, source.node, entry.origin)
        problem = proxies.problems.get(node, "")
        if not problem and entry.state != "open":
            problem = entry.problem
        figures = {}
        if flow is not None:
            figures = {
                "oversized": flow.oversized,
                "oversized_bytes": flow.oversized_bytes,
                "late": flow.counts["late"] + flow.counts["stale"],
                "expired": flow.counts["expired"],
                "lane": flow.lane,
                **flow.quality.summary(session.clocks, now, latching=latched)._asdict(),
            }
        return RouteInfo(
            peer=session.link.name,
            node=source.node,
            direction="in",
            wire=source.topic if source.topic != entry.name else "",
            state="hidden" if not entry.shown else entry.state,
            type=entry.type,
            md5=about.md5 if about is not None else "",
            dropped=publication.dropped if publication is not None else 0,
            latched=latched,
            contract=_terms(entry.contract or contracts.of(source.topic, entry.type)),
            problem=entry.hidden or problem,
            limit="nodes" if entry.cause == CROWDED else "",
            **_events(self._bridge.topics.watch(entry), now),
            **self._transport(session, entry, contracts.of(entry.name, entry.type), now),
            **figures,
        )

    def _transport(self, session: PeerSession, entry: RemoteTopic, contract: Contract, now: float) -> dict[str, Any]:
        """The fields of a peer's route that say which subscribers are direct, and why others are relayed.

        Args:
            session: The peer.
            entry: The source.
            contract: This module's for the topic.
            now: Monotonic seconds.
        """
        paths = self._bridge.topics.direct_imports
        subscribers = []
        for path in paths.of(session.peer, entry.wire.topic, entry.node):
            endpoint, unmet = path.endpoint, path.unmet
            one = SubscriberTransport(
                node=path.want.user,
                transport="direct" if endpoint is not None else "relay" if path.place == AGENTS else "",
                state=path.state,
                since_ago=now - (path.placed_at if endpoint is not None else path.since),
                wanted=path.contract.transport.value,
                endpoint=f"{endpoint[0]}:{endpoint[1]}" if endpoint is not None else "",
                condition=unmet.condition.value if unmet is not None else "",
                text=unmet.text if unmet is not None else "",
                **_interruptions(paths.interruptions.get((session.link.name, path.want)), now),
            )
            subscribers.append(one)
        # RMPA's own tools count only if no other subscriber is relayed.
        relayed = [one for one in subscribers if one.state == "relayed"]
        reason = min(relayed, key=lambda one: one.condition == Condition.MEASURES, default=None)
        condition, text = (reason.condition, reason.text) if reason is not None else ("", "")
        publication = entry.publication
        carried = publication is not None and publication.subscribers > 0
        if (
            carried
            and not condition
            and contract.transport is Transport.RELAY
            and (unmet_here := unmet_by_contract(contract, "this module")) is not None
        ):
            condition, text = unmet_here.condition.value, unmet_here.text
        return {
            "transport": _transport_name(
                direct=any(one.transport == "direct" for one in subscribers), relayed=carried
            ),
            "condition": condition,
            "condition_text": text,
            "subscribers": tuple(subscribers),
        }

    def _outgoing(self, wanted: Collection[str] | None) -> Iterator[tuple[str, RouteInfo | None, list[str]]]:
        """The topic of each source of this module with its mismatches, then with its route to each peer that uses it.

        A route is ``open``, ``idle`` (the peer's subscribers are connected directly) or ``away``.
        """
        topics, sessions = self._bridge.topics, self._bridge.sessions
        for source, local in yielding_to_data(list(topics.exports.offered.items())):
            if wanted is not None and source.topic not in wanted:
                continue
            yield source.topic, None, list(topics.mismatches.texts(source))
            routes = list(topics.exports.routes(source).values())
            flowing = {route.peer for route in routes if route.flows}
            for route in routes:
                if route.flows:
                    yield source.topic, self._route_to(route.session, source, local, "open", route), []
            grants = topics.direct_exports.of(source.topic, source.node)
            for peer in dict.fromkeys(peer for peer, _, _ in grants):
                session = sessions.get(peer)
                if peer not in flowing and session is not None:
                    yield source.topic, self._route_to(session, source, local, "idle"), []
            for route in routes:
                if not route.number:
                    yield source.topic, self._route_to(route.session, source, local, "away", route), []

    def _route_to(
        self,
        session: PeerRun,
        source: Source,
        local: LocalSource,
        state: str,
        used: ExportRoute | None = None,
    ) -> RouteInfo:
        exports, peer, name = self._bridge.topics.exports, session.peer, session.name
        about, offer = exports.description(source), exports.offer(peer, source)
        flow, route = exports.flows.get(source), exports.routes(source).get(peer)
        sender, problem = route.sender if route is not None else None, ""
        kept = sender.sender if isinstance(sender, ReliableRouteSender) else None
        if state == "away" and used is not None:
            seconds = shown_seconds(self._clock.now() - session.away_since)
            problem = f"{name} is away for {seconds}; messages are kept for {shown_seconds(used.outage)}"
        subscribers = self._granted(peer, name, source) if state != "away" else ()
        figures = {}
        if flow is not None:
            figures = {name: getattr(flow, name) for name in ("messages", "dropped", "oversized", "oversized_bytes")}
            figures["bytes"] = flow.bytes - LENGTH.size * flow.messages
        return RouteInfo(
            peer=name,
            node=source.node,
            direction="out",
            state=state,
            type=local.type,
            md5=about.md5 if about is not None else "",
            lost=kept.lost if kept is not None else 0,
            kept=kept.pending if kept is not None else 0,
            latched=about.latching if about is not None else False,
            wire=offer.topic if offer is not None and offer.topic != source.topic else "",
            lane=sender.lane if sender is not None else "",
            contract=_terms(
                used.contract if used is not None else self._bridge.context.contracts.of(source.topic, local.type)
            ),
            problem=problem,
            transport=_transport_name(direct=bool(subscribers), relayed=state == "open"),
            subscribers=subscribers,
            **figures,
        )

    def _granted(self, peer: int, link: str, source: Source) -> tuple[SubscriberTransport, ...]:
        """A peer's subscribers that may connect to a local source directly, by name."""
        exports = self._bridge.topics.direct_exports
        return tuple(
            SubscriberTransport(
                node=name,
                transport="direct",
                state="granted",
                endpoint=str(grant.port),
                **_interruptions(
                    exports.interruptions.get((link, Want(source.topic, source.node, name))), self._clock.now()
                ),
            )
            for owner, name, grant in exports.of(source.topic, source.node)
            if owner == peer
        )

    def arrivals(self, session: PeerSession, instance: str, topic: str) -> Iterator[tuple[str, Arrival]]:
        """What is known here of the publishers that a module has of a topic, by node.

        Args:
            session: The peer that brings them.
            instance: The run of the module: the peer's own, or of one that the peer relays.
            topic: The topic's name here.
        """
        topics, publishers = self._bridge.topics, self._core.publishers(topic)
        self.follow_clocks()
        for entry in topics.imports.at(topic):
            if entry.peer != session.peer or session.instance_of(entry.origin) != instance:
                continue
            node, publication = entry.node, entry.publication
            proxies, owner = self._bridge.sessions.proxies(session, node, entry.origin)
            name, proxy = proxies.name(owner), proxies.get(owner)
            links = publication.connections() if publication is not None else ()
            arrival = Arrival(
                route=self._incoming_route(session, entry),
                proxy=name,
                registered=proxy is not None and publishers.get(name) == proxy.uri,
                cause=entry.cause,
                permission=topics.imports.permission(entry).rule if self._bridge.gate.on else "",
                readers={at.number: (printable(at.other), at.waiting, at.dropped) for at in links},
                mismatches=topics.mismatches.texts(entry.wire),
            )
            yield node, arrival

    def reports(self, session: PeerSession, topic: str, instance: object) -> Iterator[PublisherReport]:
        """What a peer is told of the publishers of a topic: its own ones, or those that it relays.

        Args:
            session: The peer.
            topic: The topic.
            instance: The run of the module that is relayed; empty: this module.
        """
        for source in (Source(topic, node) for node in self._core.publishers(topic)):
            local = self._bridge.topics.exports.offered.get(source)
            relayed = local is not None and local.origin is not None and local.origin.instance == instance
            if relayed if instance else not is_own(source.node):
                yield self._report(session, source)

    def _report(self, session: PeerSession, source: Source) -> PublisherReport:
        exports = self._bridge.topics.exports
        local, flow = exports.seen.get(source), exports.flows.get(source)
        kind = local.type if local is not None else self._core.type_of(source.topic, source.node)
        decision = exports.decision(session.peer, source)
        if decision is None:  # it has just come, or cannot be reached
            decision = self._bridge.context.policy.judge(source.topic, kind, source.node)
        route = exports.routes(source).get(session.peer)
        reliable = route is not None and route.number > 0 and route.reliable
        lost = self._core.unreachable().get(source.node) if flow is None or not flow.messages else None
        figures = {} if flow is None else {n: getattr(flow, n) for n in ("messages", "oversized", "oversized_bytes")}
        return PublisherReport(
            node=source.node,
            topic=source.topic,
            type=kind,
            crosses=decision.allowed,
            rule=decision.rule,
            offered=exports.offer(session.peer, source) is not None,
            route="" if route is None or not route.number else "open" if route.flows else "opening",
            dropped=flow.dropped if flow is not None and not reliable else 0,
            lost=route.sender.lost if route is not None and route.sender is not None else 0,
            beyond=exports.limit if source in exports.beyond else 0,
            unreachable=f"{lost.api}: {lost.problem}" if lost is not None else "",
            **figures,
        )


def first_names(
    most: int, first: set[str], counts: Mapping[str, int], groups: Iterable[Collection[str]]
) -> tuple[Collection[str] | None, int]:
    """The names to show where at most so many entries can be shown.

    Args:
        most: How many entries.
        first: The names that are all shown; added to.
        counts: How many entries a name stands for; one where it is not there.
        groups: Further names, the more important ones first.

    Returns:
        The names, ``None`` for all, and how many entries are left out.
    """
    room, left = most - sum(counts.get(name) or 1 for name in first), 0
    for name in chain(*map(sorted_yielding, groups)):
        count = counts.get(name, 1)
        if room >= count and not left:
            first.add(name)
            room -= count
        else:
            left += count
    return (first, left) if left else (None, 0)


def _interruptions(found: tuple[int, float, float | None] | None, now: float) -> dict[str, Any]:
    """The fields of a subscriber that say when it was without its path."""
    if found is None:
        return {}
    count, began, ended = found
    over = {} if ended is None else {"interrupted_ago": now - ended}
    return {"interruptions": count, "interrupted": (now if ended is None else ended) - began, **over}


def _transport_name(*, direct: bool, relayed: bool) -> str:
    if direct:
        return "both" if relayed else "direct"
    return "relay" if relayed else ""


def _events(watch: QosWatch | None, now: float) -> dict[str, Any]:
    """The fields of a route that its contract's events give."""
    if watch is None:
        return {}
    recent = tuple(
        EventInfo(kind=event.kind.value, count=event.count, text=event.text, ago=now - event.now)
        for event in watch.recent
    )
    events = {kind.value: count for kind, count in watch.counts.items()}
    return {"events": events, "recent": recent, "lost": watch.counts[QosEventKind.MESSAGES_LOST]}


def _terms(contract: Contract) -> dict[str, str | float | None]:
    """The terms of a contract that differ from the default."""
    return {key: getattr(contract, key) for key in KEYS if getattr(contract, key) != getattr(DEFAULT_CONTRACT, key)}
