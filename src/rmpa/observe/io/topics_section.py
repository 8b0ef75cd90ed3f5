"""The topics' part of the snapshot: the local graph, what crosses the mesh, and how well."""

from __future__ import annotations

import math
from itertools import chain
from typing import TYPE_CHECKING

import msgspec

from rmpa.bridge.data.io.route_sender import ReliableRouteSender
from rmpa.bridge.data.qos_events import shown_seconds
from rmpa.bridge.messages import Source
from rmpa.bridge.policy import Policy, PolicyDecision, is_own
from rmpa.bridge.topics.remote_topic import RouteState
from rmpa.config.param_rules import CLOCK
from rmpa.core import limits
from rmpa.core.contract import KEYS, Contract, Contracts
from rmpa.observe.snapshot import EventInfo, LatencyInfo, LatencySpread, RouteInfo, TopicInfo, UnreachableInfo
from rmpa.ros.wire.tcpros import LENGTH
from rmpa.runtime.event_loop import breathing_sorted, yield_to_data, yielding_to_data
from rmpa.runtime.system_clock import SystemClock

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from rmpa.bridge.data.peer_clock import PeerClock
    from rmpa.bridge.data.quality import QualitySummary
    from rmpa.bridge.io.bridge import Bridge
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.topics.exports import LocalSource
    from rmpa.bridge.topics.remote_topic import RemoteTopic
    from rmpa.config.settings import Settings
    from rmpa.core.stats import SampleSummary
    from rmpa.observe.io.peer_clocks import PeerClocks
    from rmpa.ros.core.api import Core

_DEFAULT = Contract()


def unreachable_infos(core: Core, now: float) -> tuple[UnreachableInfo, ...]:
    """The nodes of the local graph that nothing can connect to, by name.

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
    """Reads what is known of topics; changes nothing.

    Data may go on between two topics, and change the plan: what is iterated over is a copy.

    Args:
        settings: The agent's.
        core: Its ROS core.
        bridge: Its bridge.
        clocks: Those of its peers.
    """

    def __init__(self, settings: Settings, core: Core, bridge: Bridge, clocks: PeerClocks) -> None:
        self._core = core
        self._clocks = clocks
        self._bridge = bridge
        self._clock = SystemClock()
        self.reload(settings)

    def reload(self, settings: Settings) -> None:
        """Other settings hold from now on."""
        self._policy = Policy(settings.policy, settings.peers, settings.time)
        self._contracts = Contracts(settings.contracts)
        self._follow = settings.time.follow

    def infos(self, wanted: Collection[str] | None = None) -> tuple[TopicInfo, ...]:
        """Every topic of the graph and every one that peers offer, by name; or those that are wanted."""
        state = self._core.state()
        routes: dict[str, list[RouteInfo]] = {}
        mismatches: dict[str, list[str]] = {}
        for source, info, texts in (*self._inbound(wanted), *self._left_out(wanted), *self._outbound(wanted)):
            if info is not None:
                routes.setdefault(source.topic, []).append(info)
            mismatches.setdefault(source.topic, []).extend(texts)
        tables = (state.publishers, state.subscribers, routes)
        names: Iterable[str] = chain(*tables) if wanted is None else wanted
        known = {name for name in yielding_to_data(names) if any(name in table for table in tables)}
        unreachable = {info.node: str(info) for info in unreachable_infos(self._core, self._clock.now())}
        return tuple(
            self._topic(
                name,
                state.types.get(name, ""),
                tuple(node for node in state.publishers.get(name, {}) if not is_own(node)),
                tuple(node for node in state.subscribers.get(name, {}) if not is_own(node)),
                tuple(routes.get(name, ())),
                tuple(mismatches.get(name, ())),
                tuple(text for node in state.publishers.get(name, {}) if (text := unreachable.get(node))),
            )
            for name in breathing_sorted(known)
        )

    def _topic(
        self,
        name: str,
        type_name: str,
        publishers: tuple[str, ...],
        subscribers: tuple[str, ...],
        routes: tuple[RouteInfo, ...],
        mismatches: tuple[str, ...],
        unreachable: tuple[str, ...],
    ) -> TopicInfo:
        yield_to_data()
        decision = self._policy.judge(name, type_name, publishers[0] if publishers else "/")
        if name == CLOCK and self._follow and not decision.allowed:
            text = f'time.follow = "{self._follow}": that module\'s comes here; one of this module stays home'
            decision = PolicyDecision(True, text)
        return TopicInfo(
            name=name,
            type=type_name or next((route.type for route in routes), ""),
            md5=next((route.md5 for route in routes if route.md5), ""),
            publishers=publishers,
            subscribers=subscribers,
            routes=routes,
            crosses=decision.allowed,
            policy=decision.rule,
            mismatches=mismatches,
            unreachable=unreachable,
        )

    def _inbound(self, wanted: Collection[str] | None) -> Iterator[tuple[Source, RouteInfo, list[str]]]:
        """Each source of a peer, its route, and what did not fit it."""
        attached = {at.peer: at for at in self._bridge.everyone()}
        self._clocks.follow(self._clock.now())
        clocks = {peer: self._clocks[peer] for peer in attached}
        for peer, source, entry in yielding_to_data(list(self._bridge.imports)):
            if wanted is not None and entry.topic not in wanted:
                continue
            yield_to_data()
            at = attached[peer]
            texts = [f"{at.link.name}: {entry.hidden}"] if entry.conflict else []
            texts += self._bridge.mismatches(source)
            yield Source(entry.topic, source.node), self._import(at, source, entry, clocks[peer]), texts

    def _left_out(self, wanted: Collection[str] | None) -> Iterator[tuple[Source, RouteInfo, list[str]]]:
        """What peers offer beyond ``limits.topics``."""
        names = {at.peer: at.link.name for at in self._bridge.everyone()}
        for peer, topic, offer in self._bridge.imports.left_out():
            if wanted is not None and topic not in wanted:
                continue
            yield_to_data()
            limit = self._bridge.imports.beyond(peer).limit
            problem = f"{names[peer]} has more topics than limits.topics = {limit} of this module"
            yield (
                Source(topic, offer.node),
                RouteInfo(
                    peer=names[peer],
                    node=offer.node,
                    direction="in",
                    state="hidden",
                    type=offer.type,
                    problem=problem,
                    wire=offer.topic if offer.topic != topic else "",
                    limit="topics",
                ),
                [],
            )

    def _import(self, at: PeerSession, source: Source, entry: RemoteTopic, clock: PeerClock) -> RouteInfo:
        topics = self._bridge.topics.of(at)
        flow = topics.flow(source, entry.route)
        publication = topics.publication(source)
        past = topics.past(source) if flow is None else None
        happened = flow.watch if flow is not None else past
        latched = entry.description.latching if entry.description else False
        now = self._clock.now()
        quality = flow.quality.summary(clock, now, latching=latched) if flow else None
        problem = at.proxies.problems.get(source.node, "")
        if not problem and entry.state is not RouteState.OPEN:
            problem = entry.problem
        return RouteInfo(
            peer=at.link.name,
            node=source.node,
            direction="in",
            wire=source.topic if source.topic != entry.topic else "",
            state="hidden" if not entry.shown else entry.state.name.lower(),
            type=entry.type,
            md5=entry.description.md5 if entry.description else "",
            messages=quality.messages if quality else 0,
            bytes=quality.bytes - LENGTH.size * quality.messages if quality else 0,
            dropped=publication.dropped if publication else 0,
            lost=flow.lost if flow else past.lost if past else 0,
            oversized=flow.oversized if flow else 0,
            oversized_bytes=flow.oversized_bytes if flow else 0,
            late=flow.late + flow.stale if flow else 0,
            expired=flow.expired if flow else 0,
            lane=flow.lane if flow else "",
            events={kind.value: count for kind, count in happened.counts.items()} if happened else {},
            recent=tuple(
                EventInfo(kind=event.kind.value, count=event.count, text=event.text, ago=now - event.now)
                for event in happened.recent
            )
            if happened
            else (),
            age=quality.age if quality else None,
            rate=_known(quality.rate) if quality else None,
            bandwidth=_known(quality.bandwidth - LENGTH.size * quality.rate) if quality else None,
            period=_spread(quality.period) if quality else None,
            jitter=_known(quality.jitter) if quality else None,
            latency=_latency(quality) if quality else None,
            latched=latched,
            contract=_contract(entry.contract or self._contracts.of(source.topic, entry.type)),
            problem=entry.hidden or problem,
            limit="nodes" if entry.crowded else "",
        )

    def _outbound(self, wanted: Collection[str] | None) -> Iterator[tuple[Source, RouteInfo | None, list[str]]]:
        """Each source of ours with what did not fit it, and its route to each peer that wants it."""
        names = {attached.peer: attached.link.name for attached in self._bridge.attached()}
        for source, local in yielding_to_data(list(self._bridge.exports.offered.items())):
            if wanted is not None and source.topic not in wanted:
                continue
            yield_to_data()
            yield source, None, list(self._bridge.mismatches(source))
            for peer in list(self._bridge.exports.flowing(source)):
                contract = self._bridge.exports.contract(source, peer)
                yield source, self._export(source, local, peer, names.get(peer, ""), contract), []
            for peer, away in self._bridge.exports.absent(source).items():
                if peer not in names or self._bridge.exports.contract(source, peer) is None:
                    yield source, self._away(self._export(source, local, peer, "", away), peer), []

    def _away(self, route: RouteInfo, peer: int) -> RouteInfo:
        """A reliable route whose peer has no link, or has not asked for it again."""
        name, seconds = self._bridge.losses.away(peer)
        keeps = float(route.contract.get("outage") or limits.RESUME_WINDOW)
        if seconds < keeps:
            text = f"{name} is away for {shown_seconds(seconds)}; messages are kept for {shown_seconds(keeps)}"
        else:
            text = f"{name} is away for {shown_seconds(seconds)}, longer than the outage of {shown_seconds(keeps)}: "
            text += "messages are counted, not kept"
        return msgspec.structs.replace(route, peer=name, state="away", problem=text)

    def _export(
        self, source: Source, local: LocalSource, peer: int, name: str, contract: Contract | None
    ) -> RouteInfo:
        about = self._bridge.exports.description(source)
        flow = self._bridge.outbound.flows.get(source)
        leg = flow.by_peer.get(peer) if flow else None
        offer = self._bridge.exports.offer(peer, source)
        return RouteInfo(
            peer=name,
            node=source.node,
            direction="out",
            state="open",
            type=local.type,
            md5=about.md5 if about else "",
            messages=flow.messages if flow else 0,
            bytes=flow.bytes - LENGTH.size * flow.messages if flow else 0,
            dropped=flow.dropped if flow else 0,
            lost=self._bridge.outbound.lost(source, peer),
            kept=leg.sender.pending if isinstance(leg, ReliableRouteSender) else 0,
            oversized=flow.oversized if flow else 0,
            oversized_bytes=flow.oversized_bytes if flow else 0,
            latched=about.latching if about else False,
            wire=offer.topic if offer is not None and offer.topic != source.topic else "",
            lane=leg.lane if leg else "",
            contract=_contract(contract or self._contracts.of(source.topic, local.type)),
        )


def _known(figure: float) -> float | None:
    return None if math.isnan(figure) else figure


def _spread(summary: SampleSummary) -> LatencySpread | None:
    if not summary.count:
        return None
    return LatencySpread(
        count=summary.count,
        mean=summary.mean,
        sd=summary.sd,
        min=summary.minimum,
        max=summary.maximum,
        p50=summary.p50,
        p99=summary.p99,
    )


def _latency(quality: QualitySummary) -> LatencyInfo | None:
    s, last, error = quality.latency, quality.latency_last, quality.latency_error
    if s is None or last is None or error is None:
        return None
    return LatencyInfo(
        count=s.count,
        mean=s.mean,
        sd=s.sd,
        min=s.minimum,
        max=s.maximum,
        p50=s.p50,
        p99=s.p99,
        last=last,
        error=error,
    )


def _contract(contract: Contract) -> dict[str, str | float | None]:
    """What is not the default."""
    return {key: getattr(contract, key) for key in KEYS if getattr(contract, key) != getattr(_DEFAULT, key)}
