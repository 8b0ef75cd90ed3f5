"""A topic of a neighbour in the gateway's graph: its proxy, its publication, its offer to the mesh."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.messages import Source
from rmpa.core import limits as core_limits
from rmpa.gateway.graph.foreign_source import ProxiedSource
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.wire.tcpros import LENGTH, printable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.bridge.messages import Origin
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.proxies import PeerProxies
    from rmpa.gateway.neighbour import ForeignSource
    from rmpa.ros.core.api import Core
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.tcpros import Buffer, TopicDescription


class ProxiedTopic(ProxiedSource, PublicationEvents):
    """A foreign topic in the gateway's graph; until ``describe`` its subscribers wait.

    Args:
        source: The topic.
        origin: The origin to offer it with.
        number: The number of its site in the relay.
        core: The gateway's core.
        relay: Offers it to the modules.
        proxies: The proxies of its site.
        on_demand: ``(wanted)``: a first subscriber has come, or the last one has left.
        on_closed: Called once it is closed.
    """

    def __init__(
        self,
        source: ForeignSource,
        origin: Origin,
        number: int,
        *,
        core: Core,
        relay: Relay,
        proxies: PeerProxies,
        on_demand: Callable[[bool], None],
        on_closed: Callable[[], None],
    ) -> None:
        super().__init__(source, origin, number, core=core, relay=relay, proxies=proxies, on_closed=on_closed)
        self._on_demand = on_demand
        self._offered = Source(source.name, proxies.name(origin.node))
        self._wanted = False
        self.publication = Publication(source.name, self._offered.node, events=self)
        """Its messages for subscribers, here and of the mesh."""

    def describe(self, description: TopicDescription) -> None:
        """Set type, md5 sum, definition and latching; subscribers of another definition are disconnected."""
        if self.publication.describe(description) and not self._closed:
            for delay in bridge_limits.CALL_BACK_DELAYS:
                asyncio.get_running_loop().call_later(delay, self._register)

    def publish(self, body: Buffer) -> int:
        """Send one message without its length; return the messages dropped for slow subscribers."""
        size = len(body)
        if size <= core_limits.CUT_THROUGH_BYTES:
            return self.publication.publish_framed(LENGTH.pack(size) + body)
        before = self.publication.dropped
        self.publication.begin(LENGTH.size + size)
        self.publication.extend(LENGTH.pack(size))
        self.publication.extend(body)
        return self.publication.dropped - before

    def forget_latched(self) -> None:
        """Drop the latched message: its publisher is gone."""
        self.publication.forget_latched()

    def reconcile(self, publishers: Mapping[str, Mapping[str, str]]) -> None:
        """Register it again if the core has lost it."""
        node = self._node
        if node is not None and publishers.get(self.source.name, {}).get(node.name) != node.uri:
            self._register()

    def _withdraw(self) -> None:
        self.publication.withdraw()

    def _demand(self, *, wanted: bool) -> None:
        if wanted != self._wanted and not self._closed:
            self._wanted = wanted
            self._on_demand(wanted)

    def first_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        self._demand(wanted=True)

    def last_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        self._demand(wanted=False)

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        """Of ``PublicationEvents``."""
        self._mismatch = f"{printable(fields.get('callerid', ''))}: {text}"

    def _ready(self, node: SlaveNode) -> None:
        self._node = node
        self._relay.shown(self._number, self._offered, (self.source.name, node.name), self._origin)
        node.add_publication(self.publication)
        self._register()

    def _register(self) -> None:
        node = self._node
        if node is None:
            return
        code, status, _ = self._core.call(
            "registerPublisher", node.name, self.source.name, self.source.type, node.uri
        )
        self._registered(node, code, status)

    def _left(self, node: SlaveNode) -> None:
        self._node = None
        self._core.call("unregisterPublisher", node.name, self.source.name, node.uri)
        node.remove_publication(self.source.name)
        self._relay.gone(self._number, self._offered)
