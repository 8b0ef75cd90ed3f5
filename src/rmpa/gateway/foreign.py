"""Topics and services of a neighbour in the gateway's graph, and taps that listen to the gateway's own.

A service of a neighbour in the gateway's graph.
"""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.messages import Source
from rmpa.bridge.policy import service_place
from rmpa.core import limits as core_limits
from rmpa.core.errors import RmpaError
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.service_server import ServiceEndpoint
from rmpa.ros.node.subscription import InProcessConnection, PublisherConnection
from rmpa.ros.wire.tcpros import LENGTH, TopicDescription, printable

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.bridge.messages import Origin
    from rmpa.bridge.policy import Relay
    from rmpa.bridge.proxies import PeerProxies
    from rmpa.gateway.neighbour import ForeignSource, MeshSource
    from rmpa.ros.core.external import Core
    from rmpa.ros.node.service_server import ServiceCall
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.node.subscription import TopicConnection
    from rmpa.ros.wire.tcpros import Buffer, Header, ServiceDescription


# What a foreign topic and service share in the gateway's graph: its proxy node, or why it has none.


_log = logging.getLogger(__name__)


class ProxiedSource(ABC):
    """A foreign source in the gateway's graph.

    Args:
        source: The source.
        origin: The origin to offer it with.
        number: The number of its site in the relay.
        core: The gateway's core.
        relay: Offers it to the modules.
        proxies: The proxies of its site.
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
        on_closed: Callable[[], None],
    ) -> None:
        self.source = source
        self._origin = origin
        self._number = number
        self._core = core
        self._relay = relay
        self._proxies = proxies
        self._on_closed = on_closed
        self._key = f"{source.kind.name} {source.name}"
        self._node: SlaveNode | None = None
        self._begun = False
        self._refused = "another source of this node has its name here"
        self._mismatch = ""
        self._closed = False

    def begin(self) -> None:
        """Put it into the graph, in a later turn of the loop."""
        self._begun = True
        self._refused = ""
        self._proxies.hold(self._origin.node, self._key, self._ready, self._left)

    def refuse(self, text: str) -> None:
        """Say why it cannot be in the graph."""
        self._refused = text

    @property
    def problem(self) -> str:
        """Why it is not in the graph, or not understood by its subscribers or clients; empty for nothing."""
        return self._refused or self._proxies.problems.get(self._origin.node, "") or self._mismatch

    def close(self) -> None:
        """Take it out of the graph in a later turn of the loop; what its users wait for ends now."""
        if self._closed:
            return
        self._closed = True
        self._withdraw()
        if self._begun:
            self._proxies.release(self._origin.node, self._key)
        self._on_closed()

    def _registered(self, node: SlaveNode, code: int, status: str) -> None:
        """Take in the core's answer to a registration."""
        self._refused = "" if code == 1 else f"the gateway's core does not take it: {status}"
        if self._refused:
            _log.error("! %s of %s: %s", self.source.name, node.name, self._refused)

    @abstractmethod
    def _withdraw(self) -> None:
        """End what subscribers or clients have of it."""

    @abstractmethod
    def _ready(self, node: SlaveNode) -> None:
        """Its proxy node is in the graph: show the source there."""

    @abstractmethod
    def _left(self, node: SlaveNode) -> None:
        """Take the source out of the graph: its proxy node leaves."""


# Subscriptions of the gateway to the topics of its own graph.


_PREFIX = LENGTH.size


class TopicTap:
    """A subscription to one topic of one node; it reconnects until it is closed or the source is gone.

    Args:
        source: The topic.
        caller_id: The subscribing node.
        number: Returns the connection's number within that node.
        find: ``(node, slave API, topic)``: the topic of a proxy of this process; ``None`` for other publishers.
        on_message: ``(body)``.
        on_described: ``(description)``.
        on_lost: ``(reason)``.
        on_closed: Called once it is closed.
    """

    def __init__(
        self,
        source: MeshSource,
        caller_id: str,
        number: Callable[[], int],
        find: Callable[[str, str, str], Publication | None],
        *,
        on_message: Callable[[memoryview], None],
        on_described: Callable[[TopicDescription], None],
        on_lost: Callable[[str], None],
        on_closed: Callable[[TopicTap], None],
    ) -> None:
        self.source = source
        self._caller_id = caller_id
        self._number = number
        self._find = find
        self._on_message = on_message
        self._on_described = on_described
        self._on_lost = on_lost
        self._on_closed = on_closed
        self.connection: TopicConnection | None = None
        """The connection to the publisher; ``None`` while its address is not known."""
        self._description: TopicDescription | None = None
        self._closed = False

    @property
    def description(self) -> TopicDescription | None:
        """The publisher's header; ``None`` until it is connected."""
        connected = self.connection is not None and self.connection.connected
        return self._description if connected else None

    def follow(self, uri: str) -> None:
        """Connect to the publisher at this slave API, unless it is connected there already.

        Args:
            uri: The publisher's address; empty: it is not in the graph.
        """
        connection = self.connection
        if self._closed or (connection is not None and connection.uri == uri and connection.refused is None):
            return
        if connection is not None:
            connection.close()
            self.connection = None
            if connection.uri != uri:
                self._on_lost("its node is at another address now" if uri else "its node has gone")
        if uri and not self._closed:
            self._connect(uri)

    def _connect(self, uri: str) -> None:
        on_message, here, proxy = self._on_message, self.source.here, self.source.proxy

        def find() -> Callable[[InProcessConnection], None] | None:
            publication = self._find(proxy, uri, here)
            return publication.attach if publication is not None else None

        kind = PublisherConnection if find() is None else InProcessConnection
        self.connection = kind(
            here,
            uri,
            self._caller_id,
            on_message=lambda framed: on_message(framed[_PREFIX:]),
            on_header=self._described,
            on_refused=self._refused,
            on_lost=self._on_lost,
            number=self._number(),
            find=find,
        )
        self.connection.start()

    def _refused(self, text: str) -> None:
        self._on_lost(f"its publisher refuses: {text}")

    def _described(self, fields: Header) -> None:
        self._description = TopicDescription.from_header(fields)
        self._on_described(self._description)

    def close(self) -> None:
        """Disconnect; no callback is called afterwards."""
        if self._closed:
            return
        self._closed = True
        if self.connection is not None:
            self.connection.close()
        self._on_closed(self)


class ProxiedService(ProxiedSource):
    """A foreign service in the gateway's graph; calls under way get an error once it is closed.

    A graph has one server of each service: while another node has its name, it waits, and ``problem`` says so.

    Args:
        source: The service.
        origin: The origin to offer it with.
        number: The number of its site in the relay.
        core: The gateway's core.
        relay: Offers it to the modules.
        proxies: The proxies of its site.
        serve: Awaited with each request for its response.
        describe: Awaited for the service's type.
        timeout: Seconds for a call.
        taken: Returns which module has a service of this name; empty if there is none.
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
        serve: Callable[[bytes], Awaitable[bytes]],
        describe: Callable[[], Awaitable[ServiceDescription]],
        timeout: float,
        taken: Callable[[], str],
        on_closed: Callable[[], None],
    ) -> None:
        super().__init__(source, origin, number, core=core, relay=relay, proxies=proxies, on_closed=on_closed)
        self._serve = serve
        self._taken = taken
        self._offered = Source(service_place(source.name, "")[0], proxies.name(origin.node))
        self._calls: set[asyncio.Task[None]] = set()
        self.endpoint = ServiceEndpoint(
            source.name,
            self._offered.node,
            self._called,
            describe,
            timeout=timeout,
            on_mismatch=self._mismatched,
        )
        """Takes the clients."""

    def reconcile(self, services: Mapping[str, Mapping[str, str]]) -> None:
        """Register it if the core has lost it, or if its name has become free."""
        node = self._node
        if node is not None and services.get(self.source.name, {}).get(node.name) != node.service_uri:
            self._register()

    def make_room(self) -> None:
        """Leave the name to a module's service, until that one has gone."""
        if self._node is not None and self._taken():
            self._unregister(self._node)
            self._register()

    def _withdraw(self) -> None:
        self.endpoint.withdraw(f"service [{self.source.name}] of {self.source.site} has gone")
        for task in self._calls:
            task.cancel()

    def _called(self, call: ServiceCall) -> None:
        task = asyncio.get_running_loop().create_task(self._answer(call), name=f"call {self.source.name}")
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)
        call.on_gone = lambda: _cancel(task)

    async def _answer(self, call: ServiceCall) -> None:
        try:
            call.reply(True, await self._serve(bytes(call.request)))
        except RmpaError as error:
            call.fail(str(error))
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! service %s of %s failed", self.source.name, self.source.site)
            call.fail(f"service [{self.source.name}]: the gateway failed at this call; its log says why")

    def _mismatched(self, _fields: Mapping[str, str], text: str) -> None:
        self._mismatch = text

    def _ready(self, node: SlaveNode) -> None:
        self._node = node
        self._relay.shown(self._number, self._offered, service_place(self.source.name, node.name), self._origin)
        node.add_service(self.endpoint)
        self._register()

    def _register(self) -> None:
        node = self._node
        if node is None:
            return
        other = next((one for one in self._core.state().services.get(self.source.name, {}) if one != node.name), "")
        if other := other or self._taken():
            self._refused = f"{other} has a service of this name here"
            return
        code, status, _ = self._core.call("registerService", node.name, self.source.name, node.service_uri, node.uri)
        self._registered(node, code, status)

    def _unregister(self, node: SlaveNode) -> None:
        self._core.call("unregisterService", node.name, self.source.name, node.service_uri)

    def _left(self, node: SlaveNode) -> None:
        self._node = None
        self._unregister(node)
        node.remove_service(self.source.name)
        self._relay.gone(self._number, self._offered)


def _cancel(task: asyncio.Task[None]) -> None:
    task.cancel()


# A topic of a neighbour in the gateway's graph: its proxy, its publication, its offer to the mesh.


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
