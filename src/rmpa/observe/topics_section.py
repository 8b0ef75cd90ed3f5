"""The topics in the snapshot: routes, contracts, quality, and which subscribers are direct.

Direct transport in the snapshot: which subscribers of a route are direct, and why others are relayed.
"""

from __future__ import annotations

import asyncio
import math
from itertools import chain, islice
from typing import TYPE_CHECKING, Any, cast

import msgspec

from rmpa.bridge.data.export import ReliableRouteSender
from rmpa.bridge.data.quality import PeerClockHistory, QosEventKind, shown_seconds
from rmpa.bridge.direct.conditions import Condition, Want, unmet_by_contract
from rmpa.bridge.direct.paths import AGENTS
from rmpa.bridge.messages import Source
from rmpa.bridge.peer_offers import CONFLICT, CROWDED
from rmpa.bridge.policy import PolicyDecision
from rmpa.config.rules import CLOCK
from rmpa.core import limits
from rmpa.core.contract import KEYS, Contract, Transport
from rmpa.core.identity import is_own
from rmpa.observe.peer_info import ContractTerm
from rmpa.observe.snapshot import (
    EventInfo,
    LatencyInfo,
    RouteInfo,
    SampleSpread,
    SubscriberTransport,
    TopicInfo,
    UnreachableInfo,
)
from rmpa.ros.wire.tcpros import LENGTH
from rmpa.runtime.loop import SystemClock, sorted_yielding, yield_to_data, yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.data.quality import QosWatch, QualitySummary
    from rmpa.bridge.direct.paths import Path
    from rmpa.bridge.sessions import PeerSession
    from rmpa.bridge.topics.exports import LocalSource
    from rmpa.bridge.topics.imports import RemoteTopic
    from rmpa.ros.core.external import Core


class DirectSection:
    """Reads what the bridge knows of direct transport; changes nothing.

    Args:
        bridge: The agent's bridge.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge

    def inbound(self, info: RouteInfo, peer: int, source: Source, contract: Contract, now: float) -> RouteInfo:
        """Add the transport to a route from a peer.

        Args:
            info: The route.
            peer: The number of the peer's session.
            source: The source, by its wire name.
            contract: This module's for the topic.
            now: Monotonic seconds.
        """
        topics = self._bridge.topics
        session = self._bridge.sessions.get(peer)
        publication = topics.of(session).publication(source) if session is not None else None
        relayed = publication is not None and publication.subscribers > 0
        known = topics.direct_imports.interruptions
        subscribers = tuple(
            _interrupted(
                _subscriber(path, now),
                known.get((session.link.name, path.want)) if session is not None else None,
                now,
            )
            for path in topics.direct_imports.of(peer, source.topic, source.node)
        )
        direct = any(one.transport == "direct" for one in subscribers)
        condition, text = _condition(subscribers)
        if relayed and not condition and contract.transport is Transport.RELAY:
            unmet = unmet_by_contract(contract, "this module")
            condition, text = (unmet.condition.value, unmet.text) if unmet is not None else ("", "")
        return msgspec.structs.replace(
            info,
            transport=_transport(direct=direct, relayed=relayed),
            condition=condition,
            condition_text=text,
            subscribers=subscribers,
        )

    def outbound(self, info: RouteInfo, peer: int, source: Source) -> RouteInfo:
        """Add the transport to a route to a peer that is relayed at present."""
        subscribers = self.granted_to(peer, source)
        transport = _transport(direct=bool(subscribers), relayed=info.state == "open")
        return msgspec.structs.replace(info, transport=transport, subscribers=subscribers)

    def granted(self, source: Source) -> list[int]:
        """The peers that have subscribers with a direct connection to a local source."""
        grants = self._bridge.topics.direct_exports.of(source.topic, source.node)
        return list(dict.fromkeys(peer for peer, _, _ in grants))

    def granted_to(self, peer: int, source: Source) -> tuple[SubscriberTransport, ...]:
        """A peer's subscribers that may connect to a local source directly, by name."""
        exports, session = self._bridge.topics.direct_exports, self._bridge.sessions.get(peer)
        wants = [
            (Want(source.topic, source.node, name), grant)
            for owner, name, grant in exports.of(source.topic, source.node)
            if owner == peer
        ]
        return tuple(
            _interrupted(
                SubscriberTransport(node=want.user, transport="direct", state="granted", endpoint=str(grant.port)),
                exports.interruptions.get((session.link.name, want)) if session is not None else None,
                asyncio.get_running_loop().time(),
            )
            for want, grant in wants
        )


def direct_counts(bridge: Bridge, peer: int) -> tuple[int, int]:
    """The number of direct connections to a peer's publishers, and of the grants that it has here."""
    there = sum(path.session.peer == peer and path.endpoint is not None for path in bridge.topics.direct_imports)
    return there, sum(owner == peer for owner, _, _ in bridge.topics.direct_exports)


def _interrupted(
    one: SubscriberTransport, found: tuple[int, float, float | None] | None, now: float
) -> SubscriberTransport:
    """A subscriber with when it was without its path."""
    if found is None:
        return one
    count, began, ended = found
    return msgspec.structs.replace(
        one,
        interruptions=count,
        interrupted=(now if ended is None else ended) - began,
        interrupted_ago=None if ended is None else now - ended,
    )


def _transport(*, direct: bool, relayed: bool) -> str:
    if direct:
        return "both" if relayed else "direct"
    return "relay" if relayed else ""


def _condition(subscribers: tuple[SubscriberTransport, ...]) -> tuple[str, str]:
    """The condition by which a route's subscribers are relayed; RMPA's own tools count only if there is no other."""
    relayed = [one for one in subscribers if one.state == "relayed"]
    relayed.sort(key=lambda one: one.condition == Condition.MEASURES)
    return (relayed[0].condition, relayed[0].text) if relayed else ("", "")


def _subscriber(path: Path[RemoteTopic], now: float) -> SubscriberTransport:
    endpoint = path.endpoint
    unmet = path.unmet
    return SubscriberTransport(
        node=path.want.user,
        transport="direct" if endpoint is not None else "relay" if path.place == AGENTS else "",
        state=path.state,
        since_ago=now - (path.placed_at if endpoint is not None else path.since),
        wanted=path.contract.transport.value,
        endpoint=f"{endpoint[0]}:{endpoint[1]}" if endpoint is not None else "",
        condition=unmet.condition.value if unmet is not None else "",
        text=unmet.text if unmet is not None else "",
    )


# The clocks of all peers over the last minute; those of peers that are away for a moment are kept.


class PeerClocks:
    """Records each link's estimate of its peer's clock; ``follow`` is called once a second.

    Args:
        bridge: Has the links.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._clocks: dict[int, PeerClockHistory] = {}

    def __getitem__(self, peer: int) -> PeerClockHistory:
        """The clock of a peer, by its session's number."""
        return self._clocks[peer]

    def follow(self, now: float) -> None:
        """Record the present estimates; forget peers that are gone. ``now`` is monotonic seconds."""
        before, self._clocks = self._clocks, {}
        for session in self._bridge.sessions:
            clock = self._clocks[session.peer] = before.get(session.peer) or PeerClockHistory()
            offset, error = session.link.clock_offset, session.link.clock_error
            if offset is not None and error is not None and session.linked:
                clock.add(offset, error, now)


# The topics in the snapshot: the local graph, the routes across the mesh, and their figures.


_DEFAULT = Contract()


def unreachable_infos(core: Core, now: float) -> tuple[UnreachableInfo, ...]:
    """The nodes of the local graph to which no connection can be made, by name.

    Args:
        core: The agent's.
        now: Seconds of the monotonic clock.
    """
    return tuple(
        UnreachableInfo(
            node=node, uri=found.api, problem=found.problem, ago=now - found.since, withdrawn=found.withdrawn
        )
        for node, found in sorted(core.unreachable().items())
    )


class TopicsSection:
    """Reads what core and bridge know of topics; changes nothing.

    It yields to data between two topics. What it iterates over is a copy, because data may change the routes.

    Args:
        core: Its ROS core.
        bridge: Its bridge.
        clocks: Those of its peers.
        direct: Reads what is known of direct transport.
    """

    def __init__(self, core: Core, bridge: Bridge, clocks: PeerClocks, direct: DirectSection) -> None:
        self._core = core
        self._clocks = clocks
        self._bridge = bridge
        self._direct = direct
        self._clock = SystemClock()

    def contract(self, topic: str, type_name: str) -> dict[str, ContractTerm]:
        """The terms of a topic's contract by the settings, by key."""
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
        for source, info, texts in (*self._inbound(wanted), *self._outbound(wanted)):
            if info is not None:
                routes.setdefault(source.topic, []).append(info)
            mismatches.setdefault(source.topic, []).extend(texts)
        tables = (state.publishers, state.subscribers, routes)
        names: Iterable[str] = chain(*tables) if wanted is None else wanted
        known = {name for name in yielding_to_data(names) if any(name in table for table in tables)}
        unreachable = {info.node: str(info) for info in unreachable_infos(self._core, self._clock.now())}
        found = []
        for name in sorted_yielding(known):
            yield_to_data()
            nodes, type_name = tuple(state.publishers.get(name, ())), state.types.get(name, "")
            own, crossing = tuple(node for node in nodes if not is_own(node)), tuple(routes.get(name, ()))
            decision = self._decision(name, type_name, own[0] if own else "/")
            topic = TopicInfo(
                name=name,
                type=type_name or next((route.type for route in crossing), ""),
                md5=next((route.md5 for route in crossing if route.md5), ""),
                publishers=own,
                subscribers=tuple(node for node in state.subscribers.get(name, ()) if not is_own(node)),
                routes=crossing,
                crosses=decision.allowed,
                policy=decision.rule,
                mismatches=tuple(mismatches.get(name, ())),
                unreachable=tuple(unreachable[node] for node in nodes if node in unreachable),
            )
            found.append(topic)
        return tuple(found)

    def used(self, most: int) -> tuple[Collection[str] | None, int]:
        """The topics to show where at most so many can be shown, and the number of the others.

        First those with a node of this module or an open route, all of them, then those with a problem, then others.

        Returns:
            The topics, ``None`` for all, and how many are left out.
        """
        state, bridge = self._core.state(), self._bridge.topics
        idle: set[str] = set()
        first, problems = set(state.subscribers), set()
        for _, source, entry in yielding_to_data(list(bridge.imports)):
            if entry.state != "idle" or entry.direct:
                first.add(entry.topic)
            elif not entry.shown or entry.problem or bridge.mismatches(source):
                problems.add(entry.topic)
            else:
                idle.add(entry.topic)
        first.update(source.topic for source in yielding_to_data(bridge.exports.offered))
        others = idle | problems
        first.update(name for name in yielding_to_data(state.publishers) if name not in others)
        problems -= first
        idle -= first | problems
        room = max(0, most - len(first))
        if len(problems) + len(idle) <= room:
            return None, 0
        rest = chain(*(sorted_yielding(part) for part in (problems, idle)))
        return first | set(islice(rest, room)), len(problems) + len(idle) - room

    def _decision(self, name: str, type_name: str, node: str) -> PolicyDecision:
        """Whether a topic of this module may cross."""
        decision = self._bridge.context.policy.judge(name, type_name, node)
        follow = self._bridge.context.settings.time.follow
        if name == CLOCK and follow and not decision.allowed:
            text = f'time.follow = "{follow}": that module\'s comes here; one of this module stays home'
            return PolicyDecision(True, text)
        return decision

    def _inbound(self, wanted: Collection[str] | None) -> Iterator[tuple[Source, RouteInfo, list[str]]]:
        """Each source of a peer with its route, and its mismatches."""
        sessions = {at.peer: at for at in self._bridge.sessions}
        self._clocks.follow(self._clock.now())
        clocks = {peer: self._clocks[peer] for peer in sessions}
        for peer, source, entry in yielding_to_data(list(self._bridge.topics.imports)):
            if wanted is not None and entry.topic not in wanted:
                continue
            yield_to_data()
            at = sessions[peer]
            texts = [f"{at.link.name}: {entry.hidden}"] if entry.cause == CONFLICT else []
            texts += self._bridge.topics.mismatches(source)
            yield Source(entry.topic, source.node), self._import(at, source, entry, clocks[peer]), texts

    def _import(self, at: PeerSession, source: Source, entry: RemoteTopic, clock: PeerClockHistory) -> RouteInfo:
        topics = self._bridge.topics.of(at)
        flow, watch = topics.flow(source), topics.watch(source)
        publication = topics.publication(source)
        about, now = entry.description, self._clock.now()
        latched = about.latching if about is not None else False
        problem = at.proxies.problems.get(source.node, "")
        if not problem and entry.state != "open":
            problem = entry.problem
        info = RouteInfo(
            peer=at.link.name,
            node=source.node,
            direction="in",
            wire=source.topic if source.topic != entry.topic else "",
            state="hidden" if not entry.shown else entry.state,
            type=entry.type,
            md5=about.md5 if about is not None else "",
            dropped=publication.dropped if publication is not None else 0,
            lost=watch.counts[QosEventKind.MESSAGES_LOST] if watch is not None else 0,
            latched=latched,
            contract=_contract(entry.contract or self._bridge.context.contracts.of(source.topic, entry.type)),
            problem=entry.hidden or problem,
            limit="nodes" if entry.cause == CROWDED else "",
            **_events(watch, now),
        )
        own = self._bridge.context.contracts.of(entry.topic, entry.type)
        info = self._direct.inbound(info, at.peer, source, own, now)
        if flow is None:
            return info
        return msgspec.structs.replace(
            info,
            oversized=flow.oversized,
            oversized_bytes=flow.oversized_bytes,
            late=flow.counts["late"] + flow.counts["stale"],
            expired=flow.counts["expired"],
            lane=flow.lane,
            **_figures(flow.quality.summary(clock, now, latching=latched)),
        )

    def _outbound(self, wanted: Collection[str] | None) -> Iterator[tuple[Source, RouteInfo | None, list[str]]]:
        """Each source of this module with its mismatches, and then with its route to each peer that wants it."""
        names = {session.peer: session.link.name for session in self._bridge.sessions.linked()}
        for source, local in yielding_to_data(list(self._bridge.topics.exports.offered.items())):
            if wanted is not None and source.topic not in wanted:
                continue
            yield_to_data()
            yield source, None, list(self._bridge.topics.mismatches(source))
            flowing = list(self._bridge.topics.exports.flowing(source))
            for peer in flowing:
                contract = self._bridge.topics.exports.contract(source, peer)
                info = self._export(source, local, peer, names.get(peer, ""), contract)
                yield source, self._direct.outbound(info, peer, source), []
            for peer in self._direct.granted(source):
                session = self._bridge.sessions.get(peer)
                if peer not in flowing and session is not None:
                    info = self._export(source, local, peer, session.link.name, None)
                    yield source, self._direct.outbound(msgspec.structs.replace(info, state="idle"), peer, source), []
            for peer, away in self._bridge.topics.exports.absent(source).items():
                if peer not in names or self._bridge.topics.exports.contract(source, peer) is None:
                    yield source, self._away(self._export(source, local, peer, "", away), peer), []

    def _away(self, route: RouteInfo, peer: int) -> RouteInfo:
        """A reliable route whose peer has no link, or has not opened it again."""
        name, seconds = self._bridge.topics.losses.away(peer)
        keeps = float(route.contract.get("outage") or limits.RESUME_WINDOW)
        text = f"{name} is away for {shown_seconds(seconds)}; messages are kept for {shown_seconds(keeps)}"
        return msgspec.structs.replace(route, peer=name, state="away", problem=text)

    def _export(
        self, source: Source, local: LocalSource, peer: int, name: str, contract: Contract | None
    ) -> RouteInfo:
        about = self._bridge.topics.exports.description(source)
        flow = self._bridge.topics.outbound.flows.get(source)
        sender = flow.by_peer.get(peer) if flow is not None else None
        offer = self._bridge.topics.exports.offer(peer, source)
        info = RouteInfo(
            peer=name,
            node=source.node,
            direction="out",
            state="open",
            type=local.type,
            md5=about.md5 if about is not None else "",
            lost=sender.sender.lost if isinstance(sender, ReliableRouteSender) else 0,
            kept=sender.sender.pending if isinstance(sender, ReliableRouteSender) else 0,
            latched=about.latching if about is not None else False,
            wire=offer.topic if offer is not None and offer.topic != source.topic else "",
            lane=sender.lane if sender is not None else "",
            contract=_contract(contract or self._bridge.context.contracts.of(source.topic, local.type)),
        )
        if flow is None:
            return info
        return msgspec.structs.replace(
            info,
            messages=flow.messages,
            bytes=flow.bytes - LENGTH.size * flow.messages,
            dropped=flow.dropped,
            oversized=flow.oversized,
            oversized_bytes=flow.oversized_bytes,
        )


def _known(figure: float) -> float | None:
    return None if math.isnan(figure) else figure


def _figures(quality: QualitySummary) -> dict[str, Any]:
    """The fields of a route that its quality gives."""
    latency = None
    if quality.latency is not None and quality.latency_last is not None and quality.latency_error is not None:
        latency = LatencyInfo.of(quality.latency, last=quality.latency_last, error=quality.latency_error)
    return {
        "messages": quality.messages,
        "bytes": quality.bytes - LENGTH.size * quality.messages,
        "age": quality.age,
        "rate": _known(quality.rate),
        "bandwidth": _known(quality.bandwidth - LENGTH.size * quality.rate),
        "period": SampleSpread.of(quality.period) if quality.period.count else None,
        "jitter": _known(quality.jitter),
        "latency": latency,
    }


def _events(watch: QosWatch | None, now: float) -> dict[str, Any]:
    """The fields of a route that its contract's events give."""
    if watch is None:
        return {}
    recent = tuple(
        EventInfo(kind=event.kind.value, count=event.count, text=event.text, ago=now - event.now)
        for event in watch.recent
    )
    return {"events": {kind.value: count for kind, count in watch.counts.items()}, "recent": recent}


def _contract(contract: Contract) -> dict[str, str | float | None]:
    """The fields that differ from the default."""
    return {key: getattr(contract, key) for key in KEYS if getattr(contract, key) != getattr(_DEFAULT, key)}
