"""The gateway's own graph for its neighbours: the sources of the modules at this site, and what neighbours bring in.

All is called in the event loop, callbacks too. ::

    modules ⇢ mesh ⇢ proxies in the core ⇢ MeshSources, TopicTap, ServicePool ⇢ neighbour
    modules ⇠ mesh ⇠ relay ⇠ proxies in the core ⇠ ProxiedTopic, ProxiedService ⇠ neighbour
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.messages import is_crossing_name, is_crossing_type
from rmpa.bridge.policy import is_outside, service_place
from rmpa.bridge.services.bodies import LocalService, ServicePool
from rmpa.bridge.sessions import Part
from rmpa.bridge.topics.exports import local_sources
from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.core.identity import OWN_NODE, is_own
from rmpa.core.log import logged_failure
from rmpa.gateway.foreign import ForeignSite, ProxiedService, ProxiedTopic
from rmpa.gateway.rules import ForeignSource, MeshSource, SourceKey, SourceKind
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.node.subscription import InProcessConnection, PublisherConnection, TopicConnection
from rmpa.ros.wire.tcpros import LENGTH, Buffer, Header, ServiceDescription, TopicDescription
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings

_log = logging.getLogger(__name__)
# The node that subscribes to what neighbours want.
TAP_NODE: Final = f"{OWN_NODE}/gateway"
_ANY: Final = "*"
_KINDS: Final = {RegistrationKind.PUBLISHER: SourceKind.TOPIC, RegistrationKind.SERVICE: SourceKind.SERVICE}


class MeshSources:
    """Follows the gateway's graph, and reports which sources of the mesh there are.

    A source counts if the gateway's own policy lets it cross. What a neighbour has brought here, through this gateway
    or another one of this site, does not count.

    Args:
        agent: The gateway's agent.
        name: Its name among its peers.
    """

    def __init__(self, agent: Agent, name: str) -> None:
        self._agent = agent
        self._name = name
        self._relay = agent.bridge.relay
        self.watchers: list[Callable[[MeshSource, bool], None]] = []
        self._by_name: dict[tuple[SourceKind, str], dict[SourceKey, MeshSource]] = {}
        self._changed: dict[tuple[SourceKind, str], None] = {}
        self._soon: asyncio.Handle | None = None
        self._begun = False

    @property
    def reported(self) -> list[MeshSource]:
        """The sources that there are, as they were reported."""
        return [source for found in self._by_name.values() for source in found.values()]

    def begin(self) -> None:
        """Begin to report; the agent's place in the network is known."""
        self._begun = True
        self.look_at_all()

    def close(self) -> None:
        """Report nothing more."""
        self._begun = False
        self.watchers.clear()
        if self._soon is not None:
            self._soon.cancel()
            self._soon = None

    def changed(self, change: GraphChange) -> None:
        """Have a name examined that was registered or unregistered."""
        if change.kind in _KINDS:
            self._look((_KINDS[change.kind], change.name))

    def look_at_all(self) -> None:
        """Have every name examined."""
        state = self._agent.core.state()
        topics = [(SourceKind.TOPIC, topic) for topic in state.publishers]
        services = [(SourceKind.SERVICE, service) for service in state.services]
        for name in (*topics, *services, *self._by_name):
            self._look(name)

    def _look(self, name: tuple[SourceKind, str]) -> None:
        self._changed[name] = None
        if self._begun and self._soon is None:
            self._soon = asyncio.get_running_loop().call_soon(self._examine)

    def _examine(self) -> None:
        self._soon = None
        changed, self._changed = self._changed, {}
        for kind, name in yielding_to_data(list(changed)):
            sources = (self._topic if kind is SourceKind.TOPIC else self._service)(name)
            found = {(kind, name, source.proxy): source for source in sources}
            before = self._by_name.pop((kind, name), {})
            if found:
                self._by_name[kind, name] = found
            for key, source in before.items():
                if found.get(key) != source:
                    self._tell(source, there=False)
            for key, source in found.items():
                if before.get(key) != source:
                    self._tell(source, there=True)

    def _tell(self, source: MeshSource, *, there: bool) -> None:
        for on_change in tuple(self.watchers):
            with logged_failure(_log, "a neighbour failed at %s; the others are informed", source):
                on_change(source, there)

    def _topic(self, topic: str) -> Iterator[MeshSource]:
        for node, local in local_sources(self._agent.core, self._relay, topic).items():
            shown, origin = self._relay.source((topic, node)), local.origin
            if not self._may_cross(topic, local.type, node if origin is None else origin.node):
                continue
            if origin is None:
                yield self._own(SourceKind.TOPIC, node, topic, local.type)
            elif shown is not None and not is_outside(origin):
                module = origin.name, origin.instance, origin.node, shown[1].topic
                yield MeshSource(SourceKind.TOPIC, *module, local.type, topic, node)

    def _service(self, service: str) -> Iterator[MeshSource]:
        for node in self._agent.core.state().services.get(service, {}) if is_crossing_name(service) else ():
            judge = self._agent.bridge.context.services.judge
            if not is_own(node):
                if judge(service, node).allowed:
                    yield self._own(SourceKind.SERVICE, node, service, _ANY)
                continue
            place = service_place(service, node)
            origin, shown = self._relay.origin(place), self._relay.source(place)
            if origin is None or shown is None or is_outside(origin) or not judge(service, origin.node).allowed:
                continue
            remote = self._agent.services.imports.get(shown[0], service)
            wire = remote.wire if remote is not None else service
            yield MeshSource(SourceKind.SERVICE, origin.name, origin.instance, origin.node, wire, _ANY, service, node)

    def _own(self, kind: SourceKind, node: str, name: str, type_name: str) -> MeshSource:
        """A source of the gateway's own module."""
        return MeshSource(kind, self._name, self._relay.instance, node, name, type_name, name, node)

    def _may_cross(self, topic: str, type_name: str, node: str) -> bool:
        known = is_crossing_name(topic) and is_crossing_name(node) and is_crossing_type(type_name)
        return known and self._agent.bridge.context.policy.judge(topic, type_name, node).allowed


class AgentGraph(Part):
    """The graph of a gateway's agent: a part of its bridge, added before the agent starts.

    Args:
        agent: The agent; it has to relay.
        settings: Its settings.

    Attributes:
        name: The gateway's name among its peers.
        reloaded: Called with other rules, after the graph has taken them.
        node: The node that taps topics.
    """

    def __init__(self, agent: Agent, settings: Settings) -> None:
        self.agent: Final = agent
        self.name: Final = settings.name
        self.reloaded: Callable[[Settings], None] = lambda _: None
        self._core = agent.core
        self._sources = MeshSources(agent, settings.name)
        self._sources.watchers.append(self._source_changed)
        agent.services.make_room = self._make_room
        self._taps: dict[str, set[TopicTap]] = {}
        self._pools: dict[str, ServicePool] = {}
        self._sites: dict[str, ForeignSite] = {}
        self.node: Final = SlaveNode(
            TAP_NODE,
            agent.core.node_host,
            agent.core.uri,
            advertised_host=agent.core.node_address,
            counters=agent.bridge.counters,
            taps=self._connections,
        )

    def watch(self, on_change: Callable[[MeshSource, bool], None]) -> None:
        """Call ``on_change(source, there)`` for each source that is there now, and at each change."""
        self._sources.watchers.append(on_change)
        for source in self._sources.reported:
            on_change(source, True)

    def tap(
        self,
        source: MeshSource,
        on_message: Callable[[memoryview], None],
        on_described: Callable[[TopicDescription], None],
        on_lost: Callable[[str], None],
        *,
        listener: str = "",
    ) -> TopicTap:
        """Subscribe to a local topic.

        Args:
            source: The topic.
            on_message: ``(body)``: without its length; the view is valid during the call only.
            on_described: The publisher's header, at each connection, before its first message.
            on_lost: ``(reason)``: the connection ended or was refused; it is tried again while the source is there.
            listener: The node that the publisher sees; by default one of the gateway. Clients of actions want the one
                that publishes the status.
        """
        tap = TopicTap(self, source, listener or TAP_NODE, on_message, on_described, on_lost)
        taps = self._taps.setdefault(source.here, set())
        taps.add(tap)
        if len(taps) == 1:
            self._register_subscriber(source.here)
        tap.follow(self._core.publishers(source.here).get(source.proxy, ""))
        return tap

    def attend(self, source: MeshSource, listener: ForeignSource) -> TopicTap:
        """Listen under the name that a foreign node has here, and drop what comes.

        Publishers of actions accept a server by the name of its connections; see ``bridge.topics.reports``.

        Args:
            source: The topic.
            listener: A source of the node that listens to it.
        """
        name = self._site(listener).key(listener)[2]
        return self.tap(source, lambda _: None, lambda _: None, lambda _: None, listener=name)

    async def describe(self, source: MeshSource) -> ServiceDescription:
        """Ask a local service for its type."""
        return await self._pool(source).describe()

    async def call(self, source: MeshSource, request: Buffer, timeout: float) -> bytes | bytearray:  # noqa: ASYNC109
        """Call a local service; return the serialized response, within ``timeout`` seconds for all.

        Raises:
            PeerRefused: The server answered with an error; its text is the error's.
            RmpaError: The server could not be reached, or did not answer in time.
        """
        answer: asyncio.Future[tuple[bool, Buffer]] = asyncio.get_running_loop().create_future()

        def done(ok: bool, body: Buffer) -> None:
            if not answer.done():
                answer.set_result((ok, bytes(body) if isinstance(body, memoryview) else body))

        self._pool(source).call(bytes(request) if isinstance(request, memoryview) else request, timeout, done)
        try:
            async with asyncio.timeout(timeout):
                ok, body = await answer
        except TimeoutError:
            raise UnreachableError(
                f"server of service {source.here}", f"{source.module} within {timeout:g} s"
            ) from None
        if not ok:
            raise PeerRefused(f"service {source.here}", bytes(body).decode(errors="replace"), code="service-failed")
        return body if isinstance(body, bytes | bytearray) else bytes(body)

    def show_topic(self, source: ForeignSource, on_demand: Callable[[bool], None]) -> ProxiedTopic:
        """Put a foreign topic into the graph, with its own proxy node and origin.

        Args:
            source: The topic.
            on_demand: ``(wanted)``: a first node or module has subscribed, or the last one has left.
        """
        return ProxiedTopic(source, self._site(source), on_demand)

    def show_service(
        self,
        source: ForeignSource,
        serve: Callable[[bytes], Awaitable[bytes]],
        describe: Callable[[], Awaitable[ServiceDescription]],
    ) -> ProxiedService:
        """Put a foreign service into the graph.

        Args:
            source: The service.
            serve: Awaited with each request for its response; an ``RmpaError`` is the client's error.
            describe: Awaited once a client or a module asks for its type; an ``RmpaError`` is the client's error.
        """
        return ProxiedService(source, self._site(source), serve, describe)

    async def begin(self) -> None:
        """Begin to follow the graph, once the agent has started and its place in the network is known."""
        self.node.master_uri = self._core.uri
        await self.node.start()
        self._sources.begin()

    def unwatch(self) -> None:
        """Forget all that ``watch`` was given: the neighbours are closed."""
        self._sources.watchers[1:] = []

    async def end(self) -> None:
        """Take everything back, before the agent closes; the neighbours are closed."""
        self._sources.close()
        for tap in [tap for taps in self._taps.values() for tap in taps]:
            tap.close()
        for site in self._sites.values():
            for shown in [one for same in site.shown.values() for one in reversed(same)]:
                shown.close()
        await asyncio.gather(*(site.proxies.close() for site in self._sites.values()))
        self._sites.clear()
        for pool in self._pools.values():
            pool.close("the gateway ends")
            await pool.closed()
        self._pools.clear()
        await self.node.close()

    def reload(self) -> None:
        """Take other rules."""
        self._sources.look_at_all()
        self.reloaded(self.agent.bridge.context.settings)

    def graph_changed(self, change: GraphChange) -> None:
        """Follow publishers and services that come, go or move."""
        self._sources.changed(change)
        if change.kind is RegistrationKind.PUBLISHER and change.name in self._taps:
            self._follow(change.name)
        elif change.kind is RegistrationKind.SERVICE and not change.added:
            for shown in self._services_of(change.name):
                shown.reconcile()

    def reconcile(self) -> None:
        """Mend what the core has lost, and try again what failed."""
        for site in self._sites.values():
            site.proxies.reconcile()
            for shown in yielding_to_data([same[0] for same in site.shown.values()]):
                shown.reconcile()
        subscribers = self._core.state().subscribers
        for topic in yielding_to_data(list(self._taps)):
            if TAP_NODE not in subscribers.get(topic, {}):
                self._register_subscriber(topic)
            self._follow(topic)
        before = asyncio.get_running_loop().time() - bridge_limits.SERVICE_IDLE
        for service, pool in list(self._pools.items()):
            pool.close_idle(before)
            if pool.unused:
                del self._pools[service]
        self._sources.look_at_all()

    def _site(self, source: ForeignSource) -> ForeignSite:
        if source.site not in self._sites:
            self._sites[source.site] = ForeignSite(self.agent, source, -1 - len(self._sites))
        return self._sites[source.site]

    def _register_subscriber(self, topic: str) -> None:
        self._core.call("registerSubscriber", TAP_NODE, topic, _ANY, self.node.uri)

    def tap_closed(self, tap: TopicTap) -> None:
        """A tap is closed; the gateway subscribes no more with the last one of a topic."""
        topic = tap.source.here
        taps = self._taps.get(topic, set())
        taps.discard(tap)
        if not taps and self._taps.pop(topic, None) is not None:
            self._core.call("unregisterSubscriber", TAP_NODE, topic, self.node.uri)

    def _follow(self, topic: str) -> None:
        publishers = self._core.publishers(topic)
        for tap in tuple(self._taps.get(topic, ())):
            tap.follow(publishers.get(tap.source.proxy, ""))

    def _connections(self) -> list[TopicConnection]:
        connections = (tap.connection for taps in self._taps.values() for tap in taps)
        return [connection for connection in connections if connection is not None]

    def _make_room(self, name: str) -> None:
        for shown in self._services_of(name):
            shown.make_room()

    def _services_of(self, name: str) -> list[ProxiedService]:
        """The foreign services of a name, of each site the one that is in the graph."""
        firsts = (same[0] for site in self._sites.values() for key, same in site.shown.items() if key[1] == name)
        return [shown for shown in firsts if isinstance(shown, ProxiedService)]

    def _source_changed(self, source: MeshSource, there: bool) -> None:
        if not there and source.kind is SourceKind.SERVICE:
            pool = self._pools.pop(source.here, None)
            if pool is not None:
                pool.close("its server has gone")

    def _pool(self, source: MeshSource) -> ServicePool:
        """The connections to the server of a local service.

        Raises:
            UnreachableError: It is not in the graph any more.
        """
        uri = self._core.state().services.get(source.here, {}).get(source.proxy)
        if uri is None:
            raise UnreachableError(f"server of service {source.here}", f"{source.module}: it has gone")
        server = LocalService(source.proxy, uri)
        pool = self._pools.get(source.here)
        if pool is None or pool.server != server:
            if pool is not None:
                pool.close("its server has restarted")
            pool = ServicePool(source.here, server, lambda: self._core.suspect(source.proxy))
            self._pools[source.here] = pool
        return pool


@dataclass(eq=False, slots=True)
class TopicTap:
    """A subscription to one topic of one node; it reconnects until it is closed or the source is gone.

    Args:
        graph: Is told once it is closed, and finds publishers in this process.
        source: The topic.
        caller_id: The subscribing node.
        on_message: ``(body)``.
        on_described: ``(description)``.
        on_lost: ``(reason)``.
        connection: The connection to the publisher; ``None`` while its address is not known.
    """

    graph: AgentGraph
    source: MeshSource
    caller_id: str
    on_message: Callable[[memoryview], None]
    on_described: Callable[[TopicDescription], None]
    on_lost: Callable[[str], None]
    connection: TopicConnection | None = None
    _description: TopicDescription | None = field(default=None, init=False)
    _closed: bool = field(default=False, init=False)

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
                self.on_lost("its node is at another address now" if uri else "its node has gone")
        if uri and not self._closed:
            self._connect(uri)

    def close(self) -> None:
        """Disconnect; no callback is called afterwards."""
        if not self._closed:
            self._closed = True
            if self.connection is not None:
                self.connection.close()
            self.graph.tap_closed(self)

    def _connect(self, uri: str) -> None:
        on_message, source = self.on_message, self.source

        def find() -> Callable[[InProcessConnection], None] | None:
            publication = self.graph.agent.bridge.proxy_nodes.publication(source.proxy, uri, source.here)
            return publication.attach if publication is not None else None

        kind = PublisherConnection if find() is None else InProcessConnection
        self.connection = kind(
            source.here,
            uri,
            self.caller_id,
            on_message=lambda framed: on_message(framed[LENGTH.size :]),
            on_header=self._described,
            on_refused=lambda text: self.on_lost(f"its publisher refuses: {text}"),
            on_lost=self.on_lost,
            number=self.graph.node.next_number(),
            find=find,
        )
        self.connection.start()

    def _described(self, fields: Header) -> None:
        self._description = TopicDescription.from_header(fields)
        self.on_described(self._description)
