"""Direct transport in the snapshot: which subscribers of a route are direct, and why others are relayed."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec

from rmpa.bridge.direct.grants import Want
from rmpa.bridge.direct.nodes import Condition, unmet_by_contract
from rmpa.core.contract import Transport
from rmpa.observe.snapshot import RouteInfo, SubscriberTransport

if TYPE_CHECKING:
    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.direct.paths import Interruption, Path
    from rmpa.bridge.messages import Source
    from rmpa.core.contract import Contract


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
                known.get(session.link.name, path.want) if session is not None else None,
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
                exports.interruptions.get(session.link.name, want) if session is not None else None,
                asyncio.get_running_loop().time(),
            )
            for want, grant in wants
        )


def direct_counts(bridge: Bridge, peer: int) -> tuple[int, int]:
    """The number of direct connections to a peer's publishers, and of the grants that it has here."""
    there = sum(path.peer == peer and path.endpoint is not None for path in bridge.topics.direct_imports)
    return there, sum(owner == peer for owner, _, _ in bridge.topics.direct_exports)


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


def _subscriber(path: Path, now: float) -> SubscriberTransport:
    endpoint = path.endpoint
    unmet = path.unmet
    return SubscriberTransport(
        node=path.want.user,
        transport="direct" if endpoint is not None else "relay" if path.answered else "",
        state=path.state,
        since_ago=now - (path.answered_at if endpoint is not None else path.since),
        wanted=path.wanted.value,
        endpoint=f"{endpoint[0]}:{endpoint[1]}" if endpoint is not None else "",
        condition=unmet.condition.value if unmet is not None else "",
        text=unmet.text if unmet is not None else "",
        stuck=path.stuck,
    )
