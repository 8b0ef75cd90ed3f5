"""The gateway's own graph for its neighbours: what is offered, with its origin.

The origin with which the relay offers what a neighbour of the gateway has. Pure.
"""

from __future__ import annotations

import asyncio
import hashlib
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.messages import Origin, is_crossing_name, is_crossing_type
from rmpa.bridge.policy import OUTSIDE_GUID, is_outside
from rmpa.bridge.proxies import PeerProxies
from rmpa.bridge.services.bodies import LocalService, ServicePool
from rmpa.bridge.sessions import Part
from rmpa.core import limits as core_limits
from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.core.identity import OWN_NODE, peer_name_problem
from rmpa.gateway.foreign import ProxiedService, ProxiedTopic, TopicTap
from rmpa.gateway.neighbour import ForeignSource, MeshSource, MeshSources, SourceKind
from rmpa.ros.master.parameters import RegistrationKind
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings
    from rmpa.gateway.neighbour import SourceKey
    from rmpa.ros.master.parameters import GraphChange
    from rmpa.ros.node.subscription import TopicConnection
    from rmpa.ros.wire.tcpros import Buffer, ServiceDescription, TopicDescription

_INSTANCE_LABEL: Final = b"rmpa site 1"


def site_instance(site: str) -> str:
    """The instance of a site, 32 hexadecimal digits: the same in all gateways that reach it."""
    digest = hashlib.sha256(_INSTANCE_LABEL + site.encode()).digest()
    return digest[: core_limits.INSTANCE_ID_BYTES].hex()


def foreign_node(source: ForeignSource) -> str:
    """The node in the origin's graph: ``/<module>/<node>``, or ``/<node>`` where there is no module."""
    return f"/{source.module}{source.node}" if source.module else source.node


def foreign_origin(source: ForeignSource) -> Origin:
    """The origin of a neighbour's source; its path is empty."""
    return Origin(source.site, OUTSIDE_GUID, site_instance(source.site), foreign_node(source), ())


# The gateway's own graph, for its neighbours. All is called in the event loop, callbacks too.
#
# ::
#
#     modules ⇢ mesh ⇢ proxies in the core ⇢ MeshSources, TopicTap, ServicePool ⇢ neighbour
#     modules ⇠ mesh ⇠ relay ⇠ proxies in the core ⇠ ProxiedTopic, ProxiedService ⇠ neighbour


TAP_NODE: Final = f"{OWN_NODE}/gateway"
"""The node that subscribes to what neighbours want."""
_ANY: Final = "*"


@dataclass(slots=True)
class _Site:
    """What one site, or another neighbour, has in the gateway's graph.

    Args:
        number: Its number in the relay: negative, for no peer has such a one.
        instance: Its instance in the origins.
        proxies: Its proxies.
        shown: Its topics and services, by kind, name here, and proxy; the first one of several is in the graph.
    """

    number: int
    instance: str
    proxies: PeerProxies
    shown: dict[SourceKey, list[ProxiedTopic | ProxiedService]] = field(default_factory=dict)


class AgentGraph(Part):
    """The graph of a gateway's agent: a part of its bridge, added before the agent starts.

    Args:
        agent: The agent; it has to relay.
        settings: Its settings.
    """

    def __init__(self, agent: Agent, settings: Settings) -> None:
        self._agent = agent
        self._name = settings.name
        self._core = agent.core
        self._bridge = agent.bridge
        self._sources = MeshSources(agent, settings)
        self._sources.watch(self._source_changed)
        agent.services.make_room = self._make_room
        self.reloaded: Callable[[Settings], None] = lambda _: None
        """Called with other rules, after the graph has taken them."""
        self._taps: dict[str, set[TopicTap]] = {}
        self._pools: dict[str, ServicePool] = {}
        self._sites: dict[str, _Site] = {}
        self._node = SlaveNode(
            TAP_NODE,
            agent.core.node_host,
            agent.core.uri,
            advertised_host=agent.core.node_address,
            counters=agent.bridge.counters,
            taps=self._connections,
        )

    # --- for neighbours ---------------------------------------------------------------------------------------

    @property
    def agent(self) -> Agent:
        """The gateway's agent."""
        return self._agent

    @property
    def name(self) -> str:
        """The gateway's name among its peers."""
        return self._name

    @property
    def sources(self) -> Mapping[SourceKey, MeshSource]:
        """The local sources by kind, name here and node here. What came from a neighbour is not among them."""
        return MappingProxyType(self._sources.known)

    def watch(self, on_change: Callable[[MeshSource, bool], None]) -> None:
        """Call ``on_change(source, there)`` for each source that is there now, and at each change."""
        self._sources.watch(on_change)

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
        tap = TopicTap(
            source,
            listener or TAP_NODE,
            self._node.next_number,
            self._bridge.proxy_nodes.publication,
            on_message=on_message,
            on_described=on_described,
            on_lost=on_lost,
            on_closed=self._tap_closed,
        )
        taps = self._taps.setdefault(source.here, set())
        taps.add(tap)
        if len(taps) == 1:
            self._register_subscriber(source.here)
        tap.follow(self._core.publishers(source.here).get(source.proxy, ""))
        return tap

    def attend(self, source: MeshSource, listener: ForeignSource) -> TopicTap:
        """Listen under the name that a foreign node has here, and drop what comes.

        Publishers of actions accept a server by the name of its connections; see ``bridge.topics.subscribers``.

        Args:
            source: The topic.
            listener: A source of the node that listens to it.
        """
        _, (_, _, name) = self._place(listener)
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
            raise PeerRefused(f"service {source.here}", bytes(body).decode(errors="replace"))
        return body if isinstance(body, bytes | bytearray) else bytes(body)

    def show_topic(self, source: ForeignSource, on_demand: Callable[[bool], None]) -> ProxiedTopic:
        """Put a foreign topic into the graph, with its own proxy node and origin.

        Args:
            source: The topic.
            on_demand: ``(wanted)``: a first node or module has subscribed, or the last one has left.
        """
        site, key = self._place(source)
        shown = ProxiedTopic(
            source,
            foreign_origin(source),
            site.number,
            core=self._core,
            relay=self._bridge.relay,
            proxies=site.proxies,
            on_demand=on_demand,
            on_closed=lambda: self._hidden(site, key, shown),
        )
        self._show(site, key, shown)
        return shown

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
        site, key = self._place(source)
        shown = ProxiedService(
            source,
            foreign_origin(source),
            site.number,
            core=self._core,
            relay=self._bridge.relay,
            proxies=site.proxies,
            serve=serve,
            describe=describe,
            timeout=self._bridge.context.services.timeout(source.name),
            taken=lambda: self._module_with(source.name),
            on_closed=lambda: self._hidden(site, key, shown),
        )
        self._show(site, key, shown)
        return shown

    # --- the bridge's part ------------------------------------------------------------------------------------

    async def begin(self) -> None:
        """Begin to follow the graph, once the agent has started and its place in the network is known."""
        self._node.master_uri = self._core.uri
        await self._node.start()
        self._sources.begin()

    def unwatch(self) -> None:
        """Forget all that ``watch`` was given: the neighbours are closed."""
        self._sources.unwatch(self._source_changed)

    async def end(self) -> None:
        """Take everything back, before the agent closes; the neighbours are closed."""
        self._sources.close()
        for taps in list(self._taps.values()):
            for tap in list(taps):
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
        await self._node.close()

    def reload(self) -> None:
        """Take other rules."""
        self._sources.look_at_all()
        self.reloaded(self._bridge.context.settings)

    def graph_changed(self, change: GraphChange) -> None:
        """Follow publishers and services that come, go or move."""
        self._sources.changed(change)
        if change.kind is RegistrationKind.PUBLISHER and change.name in self._taps:
            self._follow(change.name)
        elif change.kind is RegistrationKind.SERVICE and not change.added:
            self._retry_service(change.name)

    def reconcile(self) -> None:
        """Mend what the core has lost, and try again what failed."""
        state = self._core.state()
        for site in self._sites.values():
            site.proxies.reconcile()
            for shown in yielding_to_data([same[0] for same in site.shown.values()], every=16):
                if isinstance(shown, ProxiedTopic):
                    shown.reconcile(state.publishers)
                else:
                    shown.reconcile(state.services)
        for topic in yielding_to_data(list(self._taps), every=16):
            if TAP_NODE not in state.subscribers.get(topic, {}):
                self._register_subscriber(topic)
            self._follow(topic)
        before = asyncio.get_running_loop().time() - bridge_limits.SERVICE_IDLE
        for service, pool in list(self._pools.items()):
            pool.close_idle(before)
            if pool.unused:
                del self._pools[service]
        self._sources.look_at_all()

    # --- inside -----------------------------------------------------------------------------------------------

    def _place(self, source: ForeignSource) -> tuple[_Site, SourceKey]:
        """The site of a foreign source, and the key of the source there."""
        origin = foreign_origin(source)
        site = self._sites.get(source.site)
        if site is None:
            bad = peer_name_problem(source.site)
            prefix = "" if bad else self._bridge.sessions.reserved_name(origin)[: -len(origin.node)]
            site = self._sites[source.site] = _Site(
                -1 - len(self._sites), site_instance(source.site), PeerProxies(prefix, self._bridge.proxy_nodes)
            )
        return site, (source.kind, source.name, site.proxies.name(origin.node))

    def _show(self, site: _Site, key: SourceKey, shown: ProxiedTopic | ProxiedService) -> None:
        if problem := _name_problem(shown.source):
            shown.refuse(problem)
            return
        if not site.shown:
            self._reach(site, reached=True)
        same = site.shown.setdefault(key, [])
        same.append(shown)
        if len(same) == 1:
            shown.begin()

    def _hidden(self, site: _Site, key: SourceKey, shown: ProxiedTopic | ProxiedService) -> None:
        same = site.shown.get(key, [])
        if shown not in same:
            return
        first = same[0] is shown
        same.remove(shown)
        if same and first:
            same[0].begin()
        elif not same:
            del site.shown[key]
            if not site.shown:
                self._reach(site, reached=False)

    def _reach(self, site: _Site, *, reached: bool) -> None:
        """Hide, or show, what other gateways of this site bring from there: this gateway has its own way."""
        self._bridge.topics.reached_here(site.instance, reached=reached)
        self._agent.services.reached_here(site.instance, reached=reached)

    def _register_subscriber(self, topic: str) -> None:
        self._core.call("registerSubscriber", TAP_NODE, topic, _ANY, self._node.uri)

    def _tap_closed(self, tap: TopicTap) -> None:
        topic = tap.source.here
        taps = self._taps.get(topic, set())
        taps.discard(tap)
        if not taps and self._taps.pop(topic, None) is not None:
            self._core.call("unregisterSubscriber", TAP_NODE, topic, self._node.uri)

    def _follow(self, topic: str) -> None:
        publishers = self._core.publishers(topic)
        for tap in tuple(self._taps.get(topic, ())):
            tap.follow(publishers.get(tap.source.proxy, ""))

    def _connections(self) -> list[TopicConnection]:
        taps = [tap for taps in self._taps.values() for tap in taps]
        return [tap.connection for tap in taps if tap.connection is not None]

    def _module_with(self, service: str) -> str:
        """The module of this mesh that has a service of this name; empty if there is none."""
        found = self._agent.services.imports.shown(service)
        if found is None or (found.origin is not None and is_outside(found.origin)):
            return ""
        return self._agent.services.imports.peer_name(found.peer)

    def _make_room(self, name: str) -> None:
        for shown in self._services_of(name):
            shown.make_room()

    def _retry_service(self, name: str) -> None:
        services = self._core.state().services
        for shown in self._services_of(name):
            shown.reconcile(services)

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


def _name_problem(source: ForeignSource) -> str:
    """Why a foreign source cannot be in a graph of ROS 1, or empty."""
    if problem := peer_name_problem(source.site):
        return f"site {source.site[:64]!r}: {problem}"
    for name in (foreign_node(source), source.name):
        if not is_crossing_name(name):
            return f"{name[:64]!r} is not a global name of ROS, or too long"
    if source.kind is SourceKind.TOPIC and not is_crossing_type(source.type):
        return f"{source.type[:64]!r} is not a message type of ROS 1"
    return ""
