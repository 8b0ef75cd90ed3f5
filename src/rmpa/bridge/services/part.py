"""Services across modules: peers call the services of this module, and their services appear in the local graph.

The two plans are pure (``services.imports``, ``services.exports``); this part of the bridge carries out their
actions. A call takes this way::

    client → proxy's ServiceEndpoint → Caller ⇢ link ⇢ Server → ServicePool → server
                                              ⇠      ⇠
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.grants import ServiceGrants
from rmpa.bridge.driver import GraphDriver
from rmpa.bridge.messages import AdvertiseServices, CloseService, OpenService, ServiceClosed, ServiceOpened, Source
from rmpa.bridge.policy import Needs, service_place
from rmpa.bridge.services.bodies import (
    EndedService,
    ExportAction,
    ForgetAbout,
    ImportAction,
    LocalService,
    OpenedService,
    Provide,
    Withdraw,
)
from rmpa.bridge.services.calls import Budgets, Caller, CallStats, Serving, description_of
from rmpa.bridge.services.direct import ServicePaths
from rmpa.bridge.services.exports import ServiceExports, ServiceRouteState
from rmpa.bridge.services.imports import ServiceImports
from rmpa.bridge.sessions import Part, PeerState, UnchangedGraph
from rmpa.core.counters import RefusalLog
from rmpa.core.identity import is_own
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.bridge.context import Shared
    from rmpa.bridge.messages import Message
    from rmpa.bridge.sessions import PeerSession
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.tcpros import ServiceDescription

_log = logging.getLogger(__name__)

_MISMATCH: Final = "service.mismatch"


@dataclass(slots=True, eq=False)
class ShownService:
    """A peer's service in the local graph.

    Args:
        peer: The peer's number.
        service: The service's name here.
        node: Its node, in the peer's graph.
        peer_name: The peer's name.
        stats: Counts and latencies of its calls.
        proxy: The proxy of its node; ``None`` until that exists.
        endpoint: The endpoint that clients connect to; ``None`` until the proxy exists.
        caller: Makes the calls while the service is open.
        waiting: Calls that wait until the service is open.
        asking: Requests for its types that wait until the service is open.
        mismatch: The error that the last client with another MD5 sum got; empty if there was none.
    """

    peer: int
    service: str
    node: str
    peer_name: str
    stats: CallStats = field(default_factory=CallStats)
    proxy: SlaveNode | None = None
    endpoint: ServiceEndpoint | None = None
    caller: Caller | None = None
    waiting: list[ServiceCall] = field(default_factory=list)
    asking: list[asyncio.Future[ServiceDescription | str]] = field(default_factory=list)
    mismatch: str = ""


class Services(Part):
    """Both directions of services, for all peers.

    Args:
        shared: The core, the peers and the rules.
    """

    advertisement = "services"

    def __init__(self, shared: Shared) -> None:
        self._shared = shared
        core, sessions, rpc, counters = shared.core, shared.sessions, shared.rpc, shared.counters
        rules, limit_settings, gate = shared.context.services, shared.context.settings.limits, shared.context.gate
        self._core = core
        self._sessions = sessions
        self._rpc = rpc
        self.exports = ServiceExports(rules, limit_settings, gate)
        """The outbound plan; read by snapshots too."""
        self.imports = ServiceImports(rules, limit_settings, gate)
        """The inbound plan; read by snapshots too."""
        self.make_room: Callable[[str], None] = lambda _: None
        """Called with a service whose name a node has already: a gateway's node of another site leaves it."""
        self._budgets: dict[int, Budgets] = {}
        self._shown: dict[tuple[int, str], ShownService] = {}
        self._callers: dict[tuple[int, int], ShownService] = {}
        self._unchanged = UnchangedGraph()
        self._driver: GraphDriver[ExportAction | ImportAction, AdvertiseServices] = GraphDriver(
            sessions,
            RefusalLog(_log, counters),
            exports=self.exports,
            imports=self.imports,
            look_at=self._look_at,
            advertisement=AdvertiseServices,
            apply=self._apply,
            do=self._do,
            on_idle=self._settled,
        )
        self._act = self._driver.act
        self._serving = Serving(core, self.exports, sessions, self._budgets, self._act)
        self.direct_exports = ServiceGrants(shared, self.exports, self._driver.warn)
        """Direct calls of peers' nodes to local servers."""
        self.direct_imports = ServicePaths(shared, self._driver.warn, self.imports, self._proxy_uri)
        """Direct calls of local nodes to peers' servers."""
        rpc.on_notification(_MISMATCH, self._told_of_mismatch, Needs((), "a text for the log"))

    def __iter__(self) -> Iterator[ShownService]:
        """The peers' services in the local graph."""
        return iter(self._shown.values())

    def shown(self, peer: int, service: str) -> ShownService | None:
        """A peer's service in the local graph, by its name here; ``None`` if it is not shown."""
        return self._shown.get((peer, service))

    @property
    def idle(self) -> bool:
        """Whether every change of the local graph was processed."""
        return self._driver.idle

    @property
    def served(self) -> Mapping[str, CallStats]:
        """Counts and latencies of the peers' calls, by service of this module."""
        return self._serving.stats

    def reached_here(self, instance: str, *, reached: bool) -> None:
        """Set whether this module reaches another one outside the mesh; see ``ServiceImports.reached_here``."""
        self._act(self.imports.reached_here(instance, reached=reached))

    def reload(self) -> None:
        """Judge by the new rules; services that they do not affect stay shown and open."""
        rules, limit_settings = self._shared.context.services, self._shared.context.settings.limits
        self._driver.rejudge(
            chain(self.exports.apply_rules(rules, limit_settings), self.imports.apply_rules(rules, limit_settings))
        )
        self.direct_exports.judge_again()
        for shown in yielding_to_data(list(self._shown.values()), every=16):
            self.direct_imports.shown(shown.peer, shown.service)
            timeout, endpoint = rules.timeout(shown.service), shown.endpoint
            if endpoint is not None and endpoint.timeout != timeout:
                endpoint.timeout = timeout
                if shown.caller is not None and not shown.caller.active:
                    # The next call opens it again, with the new timeout in its request.
                    self._act(self.imports.release(shown.peer, shown.service, "its timeout has changed"))

    # --- the bridge's part -------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin with the services of the local graph, and with the checks that their servers live."""
        self._driver.look(self._core.state().services)
        self._serving.start()

    async def close(self) -> None:
        """End all calls and all connections to servers."""
        self._driver.close()
        await self.direct_imports.close()
        await self._serving.close()

    def link_up(self, session: PeerSession) -> None:
        """Advertise this module's services to the peer, and open the services of the peer that calls wait for."""
        peer, link = session.peer, session.link
        self._budgets[peer] = Budgets()
        instance = link.identity.instance.hex()
        self.imports.ways.instance = self._shared.relay.instance
        self._act(self.imports.link_up(peer, link.name, link.guid.value, instance))
        self._act(self.exports.link_up(peer, link.name, instance))
        for shown in [one for one in self._shown.values() if one.peer == peer and (one.waiting or one.asking)]:
            self._want(shown)
        self.direct_imports.link_up(session)
        self.direct_exports.link_up(session)
        self._driver.schedule()

    def link_down(self, session: PeerSession) -> None:
        """Fail the calls under way; the peer's services stay in the graph until ``grace_over`` or ``gone``."""
        self.direct_imports.link_down(session)
        self.direct_exports.link_down(session)
        self._driver.link_down(session)
        self._act(self.imports.link_down(session.peer))
        self._act(self.exports.link_down(session.peer))

    def grace_over(self, session: PeerSession) -> bool:
        """Remove the peer's services; if its agent has crashed, those that are called directly stay for a time."""
        called = self.direct_imports.called(session.peer)
        if not called:
            self._act(self.imports.gone(session.peer))
            return False
        self._act(self.imports.keep(session.peer, called))
        return True

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:
        """Remove services that were kept for direct calls; return until when they stay."""
        if seconds < limits.DIRECT_KEEP and self.direct_imports.called(session.peer):
            return limits.DIRECT_KEEP
        self._act(self.imports.gone(session.peer))
        return None

    def gone(self, session: PeerSession) -> None:
        """Remove the peer's services, and what else is known of the peer."""
        self.direct_imports.gone(session)
        self.direct_exports.gone(session)
        self._act(self.imports.gone(session.peer))
        self._act(self.imports.unlinked(session.peer))
        self._budgets.pop(session.peer, None)
        self._driver.gone(session)

    def advertised(self, session: PeerSession, payload: bytes) -> None:
        """Queue an advertisement of a peer's services."""
        self._driver.advertised(session, payload)

    def message(self, session: PeerSession, message: Message) -> bool:
        """Handle a control message about services; ``False`` for other messages."""
        peer = session.peer
        match message:
            case AdvertiseServices():
                for actions in self._apply(session, message):
                    self._act(actions)
            case OpenService():
                self._act(self.exports.opened(peer, message))
            case CloseService():
                self._act(self.exports.closed(peer, message))
            case ServiceOpened():
                self._act(self.imports.opened(peer, message))
            case ServiceClosed():
                _log.debug("< %s closes route %d: %s", session.link.name, message.route, message.reason)
                self._act(self.imports.closed(peer, message))
            case _:
                return False
        return True

    def _apply(self, session: PeerSession, message: AdvertiseServices) -> Iterator[list[ImportAction]]:
        if message.added or message.removed:
            changes = (len(message.added), len(message.removed))
            _log.info("< %s provides %d more services, %d less", session.link.name, *changes)
        return (self.imports.take_in(session.peer, change) for change in self.imports.portions(session.peer, message))

    def graph_changed(self, change: GraphChange) -> None:
        """Have a service examined for which a node was registered or unregistered."""
        if change.kind is RegistrationKind.SERVICE:
            self._driver.look((change.name,))

    def _settled(self) -> None:
        self._serving.changed()

    def depends(self, session: PeerSession) -> bool:
        """Whether nodes of this module have direct connections to the peer's."""
        return self._driver.waits(session) or bool(self.direct_imports.called(session.peer))

    def lane_lost(self, session: PeerSession) -> None:
        """Report calls that the loss of the bulk lane's connection may have left without an answer."""
        peer = session.peer
        for (owner, _), shown in list(self._callers.items()):
            if owner == peer and shown.caller is not None:
                shown.caller.lane_lost()
        self._serving.lane_lost(peer)

    def reconcile(self) -> None:
        """Register missing services again, and close routes and connections that are not used."""
        state = self._core.state()
        services = state.services
        if self._unchanged.is_due(state, steady=not self._core.unreachable()):
            self._driver.look((*self.exports.seen, *services))
        before = asyncio.get_running_loop().time() - limits.SERVICE_IDLE
        for shown in yielding_to_data(list(self._shown.values()), every=16):
            proxy, caller = shown.proxy, shown.caller
            if proxy is not None and shown.service not in services:
                self._register(shown, proxy)
            if caller is not None and not caller.active and caller.used_at < before:
                self._act(self.imports.release(shown.peer, shown.service))
        self._serving.close_idle(before)

    # --- the local graph ---------------------------------------------------------------------------------------

    def _look_at(self, names: Iterable[str]) -> None:
        services: Mapping[str, Mapping[str, str]] | None = None
        for service in names:
            if services is None:  # not without a name: after each change this copies the core's tables
                services = self._core.state().services
            providers = services.get(service, {})
            local = next((LocalService(node, uri) for node, uri in providers.items() if not is_own(node)), None)
            # Imports first: a peer's service of this name is hidden before the local one is offered.
            self._act(self.imports.local(service, local.node if local is not None else None))
            offered = local if local is not None and not self._withdrawn(service, local.node) else None
            self._act(self.exports.graph(service, offered or self._to_relay(service, providers)))
            self.direct_exports.server(service, self.exports.offered.get(service))

    def _withdrawn(self, service: str, node: str) -> bool:
        """Whether the core found a server unreachable and withdrew it, and no peer has its service open."""
        found = self._core.unreachable().get(node)
        return found is not None and found.withdrawn and not self.exports.callers(service)

    def _to_relay(self, service: str, providers: Mapping[str, str]) -> LocalService | None:
        """The server of a service that is relayed for another module; ``None`` if there is none."""
        for node, uri in providers.items():
            if (origin := self._shared.relay.origin(service_place(service, node))) is not None:
                return LocalService(node, uri, origin)
        return None

    # --- carrying out ------------------------------------------------------------------------------------------

    def _do(self, action: ExportAction | ImportAction) -> None:
        match action:
            case Provide() | Withdraw() | OpenedService() | EndedService() | ForgetAbout():
                self._do_shown(action)
            case _:
                self._serving.do(action)

    def _do_shown(self, action: Provide | Withdraw | OpenedService | EndedService | ForgetAbout) -> None:
        match action:
            case Provide():
                self._provide(action)
            case Withdraw():
                self._withdraw(action)
            case OpenedService():
                self._opened(action)
            case EndedService():
                self._ended(action)
            case ForgetAbout():
                shown = self._shown.get((action.peer, action.service))
                if shown is not None:
                    if shown.endpoint is not None:
                        shown.endpoint.description = None
                    self.direct_imports.renewed(action.peer, action.service, shown.node)

    # --- peers' services here ----------------------------------------------------------------------------------

    def _provide(self, action: Provide) -> None:
        session = self._sessions.get(action.peer)
        if session is None:
            return
        remote = self.imports.get(action.peer, action.service)
        origin = remote.origin if remote is not None else None
        name = self._sessions.proxy_name(session, action.node, origin)
        source, place = Source(f"service {action.service}", action.node), service_place(action.service, name)
        self._shared.relay.pass_on(session.peer, session.link.identity, source, place, origin)
        shown = self._shown[action.peer, action.service] = ShownService(
            action.peer, action.service, action.node, self.imports.peer_name(action.peer)
        )
        session.proxies.hold(action.node, f"service {action.service}", lambda proxy: self._expose(shown, proxy))
        self.direct_imports.shown(action.peer, action.service)

    def _expose(self, shown: ShownService, proxy: SlaveNode) -> None:
        """Register a service at its proxy, which exists now; do nothing if the service was withdrawn meanwhile."""
        if self._shown.get((shown.peer, shown.service)) is not shown or shown.endpoint is not None:
            return
        shown.proxy = proxy
        shown.endpoint = ServiceEndpoint(
            shown.service,
            proxy.name,
            lambda call: self._call(shown, call),
            lambda: self._describe(shown),
            timeout=self._shared.context.services.timeout(shown.service),
            on_mismatch=lambda fields, text: self._mismatched(shown, fields, text),
        )
        proxy.add_service(shown.endpoint)
        self._register(shown, proxy)

    def _proxy_uri(self, peer: int, service: str) -> str:
        """The address of the proxy of a peer's service; empty if there is none."""
        shown = self._shown.get((peer, service))
        return shown.proxy.service_uri if shown is not None and shown.proxy is not None else ""

    def _register(self, shown: ShownService, proxy: SlaveNode) -> None:
        if self._is_taken(shown, proxy):
            self.make_room(shown.service)
        if self._is_taken(shown, proxy):
            return  # another node was first: the scan hides this service, or did so already
        code, status, _ = self._core.call("registerService", proxy.name, shown.service, proxy.service_uri, proxy.uri)
        if code != 1:
            _log.error("! the local core does not take %s of %s: %s", shown.service, proxy.name, status)

    def _is_taken(self, shown: ShownService, proxy: SlaveNode) -> bool:
        return any(node != proxy.name for node in self._core.state().services.get(shown.service, {}))

    def _withdraw(self, action: Withdraw) -> None:
        self._shared.relay.gone(action.peer, Source(f"service {action.service}", action.node))
        shown = self._shown.pop((action.peer, action.service), None)
        if shown is None:
            return
        remote = self.imports.get(action.peer, action.service)
        denied = remote is not None and remote.denied
        self.direct_imports.hidden(action.peer, action.service, action.node, end=denied)
        proxy = shown.proxy
        text = f"service [{shown.service}] of {shown.peer_name}: {action.reason}"
        self._fail_waiting(shown, text)
        if proxy is not None:
            self._core.call("unregisterService", proxy.name, shown.service, proxy.service_uri)
            proxy.remove_service(shown.service, text)
        session = self._sessions.get(action.peer)
        if session is not None:
            session.proxies.release(action.node, f"service {action.service}")

    def _call(self, shown: ShownService, call: ServiceCall) -> None:
        """Make a client's call, or have it wait until the service is open; the hot path."""
        if shown.caller is not None:
            shown.caller.call(call)
            return
        shown.waiting.append(call)
        call.on_gone = lambda: shown.waiting.remove(call) if call in shown.waiting else None
        self._want(shown)

    async def _describe(self, shown: ShownService) -> ServiceDescription | str:
        remote = self.imports.get(shown.peer, shown.service)
        if remote is not None and remote.about is not None:
            return description_of(remote.about)
        if shown.caller is not None:  # its offer has come again since it was opened: the server may be another one
            if shown.caller.active:
                return shown.caller.description
            self._act(self.imports.release(shown.peer, shown.service, "its type is asked for again"))
        answer: asyncio.Future[ServiceDescription | str] = asyncio.get_running_loop().create_future()
        shown.asking.append(answer)
        self._want(shown)
        return await answer

    def _want(self, shown: ShownService) -> None:
        """Open a service, unless its peer has no link now: then the next ``link_up``, or ``gone``, ends the wait."""
        remote, session = self.imports.get(shown.peer, shown.service), self._sessions.get(shown.peer)
        if remote is None or not remote.shown:
            self._fail_waiting(shown, f"service [{shown.service}] of {shown.peer_name} has just gone")
        elif session is not None and session.state is PeerState.AWAY:
            text = f"service [{shown.service}]: the agent of {shown.peer_name} has crashed, only direct calls work"
            self._fail_waiting(shown, text)
        elif remote.state is ServiceRouteState.IDLE and not self.imports.is_away(shown.peer):
            self._act(self.imports.want(shown.peer, shown.service, asyncio.get_running_loop().time()))

    def _opened(self, action: OpenedService) -> None:
        shown = self._shown.get((action.peer, action.service))
        session = self._sessions.get(action.peer)
        if shown is None or session is None or not session.linked:
            return
        what = f"service [{shown.service}] of {shown.peer_name}"
        description, budgets = description_of(action.about), self._budgets[action.peer]
        caller = shown.caller = Caller(session.link, action.requests, what, budgets, shown.stats, description)
        session.link.routes[action.route] = caller
        self._callers[action.peer, action.route] = shown
        asking, shown.asking = shown.asking, []
        for future in asking:
            if not future.done():
                future.set_result(description)
        waiting, shown.waiting = shown.waiting, []
        for call in waiting:
            caller.call(call)

    def _ended(self, action: EndedService) -> None:
        session = self._sessions.get(action.peer)
        if session is not None:
            session.link.routes.pop(action.route, None)
        shown = self._callers.pop((action.peer, action.route), None)
        if shown is not None and shown.caller is not None:
            caller, shown.caller = shown.caller, None
            caller.close(action.reason)
        shown = self._shown.get((action.peer, action.service))
        if shown is not None and shown.caller is None:
            self._fail_waiting(shown, f"service [{shown.service}] of {shown.peer_name}: {action.reason}")

    def _fail_waiting(self, shown: ShownService, text: str) -> None:
        asking, shown.asking = shown.asking, []
        for future in asking:
            if not future.done():
                future.set_result(text)
        waiting, shown.waiting = shown.waiting, []
        for call in waiting:
            shown.stats.calls += 1
            shown.stats.fail(text)
            call.fail(text)

    def _mismatched(self, shown: ShownService, fields: Mapping[str, str], text: str) -> None:
        """Report a client that was refused for its MD5 sum, here and at the peer."""
        caller_id = printable(fields.get("callerid", ""))
        shown.mismatch = text
        shown.stats.calls += 1
        shown.stats.fail(text)
        self._driver.warn(_MISMATCH, f"{shown.service}{caller_id}", text)
        session, remote = self._sessions.get(shown.peer), self.imports.get(shown.peer, shown.service)
        if session is not None and session.linked and remote is not None:
            args: dict[str, Any] = {"service": remote.wire, "text": text[: limits.CONTROL_TEXT_MAX]}
            self._rpc.notify(session, _MISMATCH, args)

    def _told_of_mismatch(self, session: PeerSession, args: dict[str, Any]) -> None:
        text = printable(str(args.get("text", ""))[: limits.CONTROL_TEXT_MAX])
        self._driver.warn("service.mismatch_remote", session.link.name, f"{session.link.name}: {text}")
