"""Drives the exports: one subscription to each local publisher that some peer wants."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.bridge.aio.flows import ExportFlow
from rmpa.bridge.aio.legs import ReliableLeg
from rmpa.bridge.messages import Description, Source
from rmpa.bridge.policy import OWN_NODE
from rmpa.core import limits
from rmpa.core.errors import RemoteProtocolError
from rmpa.mesh.reliable import ResumeTable
from rmpa.ros.aio.subscription import PublisherConnection
from rmpa.ros.tcpros import Description as TcprosDescription

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.bridge.actions import AddRoute, Connect, RemoveRoute, SuspendRoute
    from rmpa.bridge.aio.legs import DataLink, Leg
    from rmpa.ros.aio.core_api import Core
    from rmpa.ros.aio.slave_server import SlaveNode

_log = logging.getLogger(__name__)


class Outbound:
    """Subscriptions to local publishers, as the agent's own node.

    Args:
        core: The local core; the agent's subscriptions are registered there, so that the stock tools show them.
        node: The agent's own node.
        on_described: Called with a source and its publisher's header.
        on_lost: Called with a source and a reason when its publisher is no longer connected.
        on_given_up: Called with a source and a peer that is away when no more can be kept for it.
    """

    def __init__(
        self,
        core: Core,
        node: SlaveNode,
        *,
        on_described: Callable[[Source, Description], None],
        on_lost: Callable[[Source, str], None],
        on_given_up: Callable[[Source, int], None],
    ) -> None:
        self._core = core
        self._node = node
        self._on_described = on_described
        self._on_lost = on_lost
        self._connections: dict[Source, PublisherConnection] = {}
        self._flows: dict[Source, ExportFlow] = {}
        self._legs: dict[tuple[int, int], Leg] = {}
        self._parked: ResumeTable[tuple[int, Source]] = ResumeTable()
        self._on_given_up = on_given_up

    @property
    def flows(self) -> Mapping[Source, ExportFlow]:
        """What flows, for the monitor."""
        return self._flows

    @property
    def connections(self) -> Iterable[PublisherConnection]:
        """To the local publishers."""
        return self._connections.values()

    def connect(self, action: Connect) -> None:
        """Subscribe to one publisher; its answer comes by ``on_described`` or ``on_lost``."""
        source = action.source
        flow = self._flows[source] = ExportFlow()
        if sum(s.topic == source.topic for s in self._flows) == 1:
            self._core.call("registerSubscriber", OWN_NODE, source.topic, "*", self._node.uri)
        _log.debug("> subscribe to %s at %s", source, action.uri)
        connection = PublisherConnection(
            source.topic,
            action.uri,
            OWN_NODE,
            on_message=flow.message,
            on_parts=flow,
            on_header=lambda fields: self._header(source, fields),
            on_refused=lambda text: self._gone(source, connection, f"its publisher refuses: {text}"),
            on_lost=lambda reason: self._gone(source, connection, reason),
            number=self._node.next_number(),
        )
        self._connections[source] = connection
        connection.start()

    def disconnect(self, source: Source) -> None:
        """Leave one publisher."""
        connection = self._connections.pop(source, None)
        if connection is not None:
            connection.close()
        self._drop(source)

    def add_route(self, action: AddRoute, link: DataLink) -> None:
        """Send a source to one more peer, or go on where its last link ended."""
        flow = self._flows[action.source]
        leg = flow.by_peer.get(action.peer)
        self._parked.claim((action.peer, action.source), None, 0.0)
        if action.after is not None and isinstance(leg, ReliableLeg) and leg.sender.epoch == action.epoch:
            try:
                leg.resume(link, action.route, action.after)
            except RemoteProtocolError:
                flow.remove(action.peer)  # the link is closed for it; the next one begins a numbering of its own
                raise
        else:
            leg = flow.add(action.peer, link, action.route, action.contract, action.epoch)
        self._legs[action.peer, action.route] = leg

    def suspend_route(self, action: SuspendRoute) -> None:
        """Keep a source's messages for a peer whose link is gone."""
        flow = self._flows.get(action.source)
        if flow is not None:
            leg = flow.by_peer.get(action.peer)
            self._forget(leg, action.peer)
            if isinstance(leg, ReliableLeg):
                key = (action.peer, action.source)
                flow.suspend(
                    action.peer, lambda payload, stamp: self._give_up(self._parked.offer(key, payload, stamp))
                )
                self._give_up(self._parked.park(key, leg.sender, asyncio.get_running_loop().time()))

    def remove_route(self, action: RemoveRoute) -> None:
        """Send a source to a peer no longer."""
        self._parked.claim((action.peer, action.source), None, 0.0)
        flow = self._flows.get(action.source)
        if flow is not None:
            self._forget(flow.by_peer.get(action.peer), action.peer)
            flow.remove(action.peer)

    def _keep(self, key: tuple[int, Source], message: bytes, stamp_ns: int) -> None:
        self._give_up(self._parked.offer(key, message, stamp_ns))

    def _give_up(self, keys: list[tuple[int, Source]]) -> None:
        """Too much is kept for peers that are away: let go of what waited longest."""
        for peer, source in keys:
            flow = self._flows.get(source)
            if flow is not None:
                flow.remove(peer)
            self._on_given_up(source, peer)

    def leg(self, peer: int, route: int) -> Leg | None:
        """One peer's route."""
        return self._legs.get((peer, route))

    def lane_lost(self, peer: int) -> None:
        """The connection of a peer's bulk lane is gone."""
        for (owner, _), leg in list(self._legs.items()):
            if owner == peer:
                leg.lane_lost()

    def _forget(self, leg: Leg | None, peer: int) -> None:
        if leg is not None and self._legs.get((peer, leg.route)) is leg:
            del self._legs[peer, leg.route]

    def close(self) -> None:
        """Leave all publishers."""
        for source in list(self._connections):
            self.disconnect(source)

    def _header(self, source: Source, fields: Mapping[str, str]) -> None:
        about = TcprosDescription.from_header(fields)
        text = about.definition.encode(errors="surrogateescape").decode("latin-1")
        description = Description(about.type, about.md5sum, text, about.latching)
        if description.problem:
            self._gone(source, self._connections[source], description.problem)
            return
        if description.latching:
            self._flows[source].latch()
        self._on_described(source, description)

    def _gone(self, source: Source, connection: PublisherConnection, reason: str) -> None:
        if self._connections.get(source) is not connection:
            return
        self._connections.pop(source).close()
        _log.info("= %s: %s", source, reason)
        self._on_lost(source, reason[: limits.CONTROL_TEXT_MAX])
        self._drop(source)
        self._core.suspect(source.node)

    def _drop(self, source: Source) -> None:
        flow = self._flows.pop(source, None)
        if flow is not None:
            for peer in list(flow.by_peer):
                self._parked.claim((peer, source), None, 0.0)
                self._forget(flow.by_peer[peer], peer)
            flow.close()
        if flow is not None and not any(s.topic == source.topic for s in self._flows):
            self._core.call("unregisterSubscriber", OWN_NODE, source.topic, self._node.uri)
