"""Direct transport in the snapshot: which subscribers of a route are direct, and why others are relayed."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec

from rmpa.bridge.direct.conditions import Condition, unmet_by_contract
from rmpa.bridge.direct.direct_route import DirectState, Path
from rmpa.core.contract import Transport
from rmpa.observe.io.direct_sampler import DirectFlow, DirectSampler
from rmpa.observe.snapshot import RouteInfo, SubscriberTransport

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from rmpa.bridge.direct.direct_route import DirectRoute, Interruption
    from rmpa.bridge.direct.publisher_side import Granted
    from rmpa.bridge.io.bridge import Bridge
    from rmpa.bridge.messages import Source
    from rmpa.core.contract import Contract
    from rmpa.observe.io.direct_sampler import DirectSample
    from rmpa.ros.core.api import Core

_PATHS = {Path.NONE: "", Path.RELAY: "relay", Path.DIRECT: "direct"}


class DirectSection:
    """Reads what the bridge knows of direct transport; changes nothing.

    Args:
        core: The agent's ROS core.
        bridge: Its bridge.
    """

    def __init__(self, core: Core, bridge: Bridge) -> None:
        self._core = core
        self._bridge = bridge
        self.sampler = DirectSampler(self._flows)
        """The figures of direct connections."""

    def _flows(self, topics: Collection[str] | None) -> Iterator[DirectFlow]:
        """The direct connections of local nodes, of some topics or of all."""
        part = self._bridge.topics
        for key, route in part.direct_imports.routes.connected():
            entry = part.imports.get(key.peer, key.source)
            if entry is not None and (topics is None or entry.topic in topics):
                yield self._flow_in(entry.topic, key.subscriber, route)
        for source, _, name, granted in part.direct_exports.grants:
            if topics is None or source.topic in topics:
                yield _flow_out(source, name, granted)

    def _flow_in(self, topic: str, subscriber: str, route: DirectRoute) -> DirectFlow:
        uri = self._core.state().subscribers.get(topic, {}).get(subscriber, "")
        return DirectFlow(subscriber, uri, topic, subscriber, route.endpoint or ("", 0))

    def inbound(
        self, info: RouteInfo, peer: int, source: Source, topic: str, contract: Contract, now: float
    ) -> RouteInfo:
        """Add the transport to a route from a peer.

        Args:
            info: The route.
            peer: The number of the peer's session.
            source: The source, by its wire name.
            topic: Its local name.
            contract: This module's for the topic.
            now: Monotonic seconds.
        """
        topics = self._bridge.topics
        session = self._bridge.sessions.get(peer)
        publication = topics.of(session).publication(source) if session is not None else None
        relayed = publication is not None and publication.subscribers > 0
        routes = topics.direct_imports.routes.of(peer, source)
        known = topics.direct_imports.interruptions
        subscribers = tuple(
            _interrupted(
                self._measured(_subscriber(name, route, now), topic, route),
                known.get(session.link.name, source, name) if session is not None else None,
                now,
            )
            for name, route in routes
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

    def _measured(self, one: SubscriberTransport, topic: str, route: DirectRoute) -> SubscriberTransport:
        return _with(one, self.sampler[self._flow_in(topic, one.node, route)]) if route.path is Path.DIRECT else one

    def outbound(self, info: RouteInfo, peer: int, source: Source) -> RouteInfo:
        """Add the transport to a route to a peer that is relayed at present."""
        subscribers = self.granted_to(peer, source)
        transport = _transport(direct=bool(subscribers), relayed=info.state == "open")
        return msgspec.structs.replace(info, transport=transport, subscribers=subscribers)

    def granted(self, source: Source) -> list[int]:
        """The peers that have subscribers with a direct connection to a local source."""
        grants = self._bridge.topics.direct_exports.grants
        return list(dict.fromkeys(peer for peer, _, _ in grants.of(source)))

    def granted_to(self, peer: int, source: Source) -> tuple[SubscriberTransport, ...]:
        """A peer's subscribers that may connect to a local source directly, by name."""
        exports, session = self._bridge.topics.direct_exports, self._bridge.sessions.get(peer)
        grants, known = exports.grants, exports.interruptions
        return tuple(
            _interrupted(
                _with(
                    SubscriberTransport(node=name, transport="direct", state="granted", endpoint=str(granted.port)),
                    self.sampler[_flow_out(source, name, granted)],
                ),
                known.get(session.link.name, source, name) if session is not None else None,
                asyncio.get_running_loop().time(),
            )
            for owner, name, granted in sorted(grants.of(source), key=lambda grant: grant[:2])
            if owner == peer
        )


def direct_counts(bridge: Bridge, peer: int) -> tuple[int, int]:
    """The number of direct connections to a peer's publishers, and of the grants that it has here."""
    there = sum(1 for key, _ in bridge.topics.direct_imports.routes.connected() if key.peer == peer)
    return there, sum(1 for _, owner, _, _ in bridge.topics.direct_exports.grants if owner == peer)


def _flow_out(source: Source, subscriber: str, granted: Granted) -> DirectFlow:
    return DirectFlow(source.node, granted.uri, source.topic, subscriber)


def _with(one: SubscriberTransport, sample: DirectSample) -> SubscriberTransport:
    """A subscriber with what its node, or its publisher, said last."""
    return msgspec.structs.replace(
        one, connected=sample.connected, figures=sample.figures, unmeasured=sample.problem, silent=sample.silent
    )


def _interrupted(one: SubscriberTransport, found: Interruption | None, now: float) -> SubscriberTransport:
    """A subscriber with when it was without its path."""
    if found is None:
        return one
    ended = now if found.ended is None else found.ended
    return msgspec.structs.replace(
        one,
        interruptions=found.count,
        interrupted=ended - found.began,
        interrupted_ago=None if found.ended is None else now - ended,
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


def _subscriber(name: str, route: DirectRoute, now: float) -> SubscriberTransport:
    direct = route.path is Path.DIRECT
    unmet = route.unmet if route.state is DirectState.RELAYED else None
    return SubscriberTransport(
        node=name,
        transport=_PATHS[route.path],
        state=route.state.name.lower(),
        since_ago=now - (route.answered_at if direct else route.since),
        wanted=route.wanted.value,
        endpoint=f"{route.endpoint[0]}:{route.endpoint[1]}" if direct and route.endpoint is not None else "",
        condition=unmet.condition.value if unmet is not None else "",
        text=unmet.text if unmet is not None else "",
        stuck=route.stuck,
    )
