"""Services across modules: peers call the services of this module, and their services appear in the local graph.

``services.books`` decides; this part carries out what they decide. A call takes this way::

    client → proxy's ServiceEndpoint → ShownService ⇢ link ⇢ Server → ServicePool → server
                                                    ⇠      ⇠
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.grants import ServiceGrants
from rmpa.bridge.graph_part import GraphPart
from rmpa.bridge.messages import CloseService, Message, OpenService, ServiceClosed, ServiceOpened, Source
from rmpa.bridge.offers import PeerState
from rmpa.bridge.policy import Needs, Place, service_place
from rmpa.bridge.services.bodies import LocalService
from rmpa.bridge.services.books import RemoteService, ServiceExports, ServiceImports
from rmpa.bridge.services.calls import Budgets, Server, Serving, ShownService
from rmpa.bridge.services.direct import ServicePaths
from rmpa.core.facts import DENIED
from rmpa.core.identity import is_own
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.ros.node.service_server import ServiceEndpoint
from rmpa.ros.wire.tcpros import ServiceDescription, printable
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.peer_offers import Remote
    from rmpa.bridge.sessions import PeerSession
    from rmpa.ros.node.slave_node import SlaveNode

_log = logging.getLogger(__name__)

_MISMATCH: Final = "service.mismatch"


class Services(GraphPart):
    """Both directions of services, for all peers.

    Args:
        bridge: The core, the peers and the rules.

    Attributes:
        make_room: Called with a service whose name a node has already: a gateway's node of another site leaves it.
        serving: The servers of this module that peers call.
    """

    advertisement = "services"
    verb = "provides"
    exports: ServiceExports
    imports: ServiceImports
    direct_exports: ServiceGrants
    direct_imports: ServicePaths

    def __init__(self, bridge: Bridge) -> None:
        super().__init__(bridge, ServiceExports, ServiceImports)
        self._core = bridge.core
        self.make_room: Callable[[str], None] = lambda _: None
        self._budgets: dict[int, Budgets] = {}
        self._shown: dict[RemoteService, ShownService] = {}
        self.serving = Serving(bridge, self.exports, self._budgets)
        self.direct_exports = ServiceGrants(bridge, self.exports, self.warn)
        self.direct_imports = ServicePaths(bridge, self.warn, self._proxy_uri)
        self.direct = self.direct_imports, self.direct_exports
        bridge.rpc.on_notification(_MISMATCH, self._told_of_mismatch, Needs((), "a text for the log"))

    def __iter__(self) -> Iterator[ShownService]:
        """The peers' services in the local graph."""
        return iter(self._shown.values())

    def shown(self, remote: RemoteService) -> ShownService | None:
        """A peer's service in the local graph; ``None`` if it is not shown."""
        return self._shown.get(remote)

    def reload(self) -> None:
        """As of ``GraphPart``."""
        super().reload()
        self.direct_exports.judge_again()
        for shown in yielding_to_data(list(self)):
            self.direct_imports.shown(shown.remote)
            timeout, endpoint = self.context.services.timeout(shown.remote.name), shown.endpoint
            if endpoint is not None and endpoint.timeout != timeout:
                endpoint.timeout = timeout
                if shown.is_open and not shown.active:
                    # The next call opens it again, with the new timeout in its request.
                    self.imports.release(shown.remote, "its timeout has changed")

    def _settled(self) -> None:
        """As of ``GraphPart``; the servers of what is offered now are looked after."""
        self.serving.look_after()

    async def close(self) -> None:
        """End all calls and all connections to servers."""
        await super().close()
        await self.direct_imports.close()
        await self.serving.close()

    def link_up(self, session: PeerSession) -> None:
        """As of ``GraphPart``; open the services of the peer that calls wait for."""
        self._budgets[session.peer] = Budgets()
        super().link_up(session)
        for shown in [one for one in self if one.remote.peer == session.peer and one.wanted]:
            self._want(shown)

    def grace_over(self, session: PeerSession) -> bool:
        """Remove the peer's services; if its agent has crashed, those that are called directly stay for a time."""
        called = self.direct_imports.called(session.peer)
        self.run(self.imports.gone(session.peer, called))
        return bool(called)

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:
        """Remove services that were kept for direct calls; return until when they stay."""
        if seconds < limits.DIRECT_KEEP and self.direct_imports.called(session.peer):
            return limits.DIRECT_KEEP
        self.run(self.imports.gone(session.peer))
        return None

    def gone(self, session: PeerSession) -> None:
        """As of ``GraphPart``; what its calls hold is free."""
        super().gone(session)
        self._budgets.pop(session.peer, None)

    def message(self, session: PeerSession, message: Message) -> bool:
        """Handle a control message about services; ``False`` for other messages."""
        peer = session.peer
        match message:
            case OpenService():
                self.exports.opened(peer, message)
            case CloseService():
                self.exports.closed(peer, message)
            case ServiceOpened():
                self.imports.opened(peer, message)
            case ServiceClosed():
                _log.debug("< %s closes route %d: %s", session.link.name, message.route, message.reason)
                self.imports.closed(peer, message)
            case _:
                return False
        return True

    def graph_changed(self, change: GraphChange) -> None:
        """Have a service looked at for which a node was registered or unregistered."""
        if change.kind is RegistrationKind.SERVICE:
            self.look((change.name,))

    def depends(self, session: PeerSession) -> bool:
        """As of ``GraphPart``; or whether nodes of this module have direct connections to the peer's."""
        return super().depends(session) or bool(self.direct_imports.called(session.peer))

    def lane_lost(self, session: PeerSession) -> None:
        """Report calls that the loss of the bulk lane's connection may have left without an answer."""
        for taker in list(session.link.routes.values()):
            if isinstance(taker, ShownService | Server):
                taker.lane_lost()

    def reconcile(self) -> None:
        """Register missing services again, and close routes and connections that are not used."""
        self.look_again()
        services = self._core.state().services
        before = self.now() - limits.SERVICE_IDLE
        for shown in yielding_to_data(list(self)):
            if shown.proxy is not None and shown.remote.name not in services:
                self._register(shown, shown.proxy)
            if shown.is_open and not shown.active and shown.used_at < before:
                self.imports.release(shown.remote, "no node calls it")
        self.serving.close_idle(before)

    def _names(self) -> Iterable[str]:
        return (*self.exports.seen, *self._core.state().services)

    def _look_at(self, name: str) -> None:
        providers = self._core.state().services.get(name, {})
        local = next((LocalService(node, uri) for node, uri in providers.items() if not is_own(node)), None)
        # Imports first: a peer's service of this name is hidden before the local one is offered.
        self.imports.local(name, local.node if local is not None else None)
        if local is None or self._withdrawn(name, local.node):
            local = self._to_relay(name, providers)
        self.exports.put(name, local)

    def _withdrawn(self, service: str, node: str) -> bool:
        """Whether the core found a server unreachable and withdrew it, and no peer has its service open."""
        found = self._core.unreachable().get(node)
        return found is not None and found.withdrawn and not self.exports.callers(service)

    def _to_relay(self, service: str, providers: Mapping[str, str]) -> LocalService | None:
        """The server of a service that is relayed for another module; ``None`` if there is none."""
        for node, uri in providers.items():
            if (origin := self.bridge.relay.origin(service_place(service, node))) is not None:
                return LocalService(node, uri, origin)
        return None

    def provide(self, remote: RemoteService) -> None:
        """Register a peer's service in the local graph, at the proxy of the node that provides it."""
        peer, service, node = remote.peer, remote.name, remote.node
        session = self.bridge.sessions.get(peer)
        if session is None:
            return
        proxies, owner = self.bridge.sessions.proxies(session, node, remote.origin)
        self.pass_on(remote)
        shown = self._shown[remote] = ShownService(remote, session, self._want)
        proxies.hold(owner, f"service {service}", lambda proxy: self._expose(shown, proxy))
        self.direct_imports.shown(remote)

    def _relayed(self, entry: Remote[Any], proxy: str) -> tuple[Source, Place]:
        return Source(f"service {entry.name}", entry.node), service_place(entry.name, proxy)

    def _expose(self, shown: ShownService, proxy: SlaveNode) -> None:
        """Register a service at its proxy, which exists now; do nothing if the service was withdrawn meanwhile."""
        if self._shown.get(shown.remote) is not shown or shown.endpoint is not None:
            return
        shown.proxy = proxy
        shown.endpoint = ServiceEndpoint(
            shown.remote.name,
            proxy.name,
            shown.call,
            lambda: self._describe(shown),
            timeout=self.context.services.timeout(shown.remote.name),
            on_mismatch=lambda fields, text: self._mismatched(shown, fields, text),
        )
        proxy.add_service(shown.endpoint)
        self._register(shown, proxy)

    def _proxy_uri(self, peer: int, service: str) -> str:
        """The address of the proxy of a peer's service; empty if there is none."""
        remote = self.imports.get(peer, service)
        shown = self._shown.get(remote) if remote is not None else None
        return shown.proxy.service_uri if shown is not None and shown.proxy is not None else ""

    def _register(self, shown: ShownService, proxy: SlaveNode) -> None:
        service = shown.remote.name
        if self._is_taken(service, proxy):
            self.make_room(service)
        if self._is_taken(service, proxy):
            return  # another node was first: the scan hides this service, or did so already
        code, status, _ = self._core.call("registerService", proxy.name, service, proxy.service_uri, proxy.uri)
        if code != 1:
            _log.error("! the ROS core does not accept %s of %s: %s [core-refuses]", service, proxy.name, status)

    def _is_taken(self, service: str, proxy: SlaveNode) -> bool:
        return any(node != proxy.name for node in self._core.state().services.get(service, {}))

    def withdraw(self, remote: RemoteService, reason: str) -> None:
        """Remove a peer's service from the local graph; its waiting calls fail with the reason."""
        self.bridge.relay.gone(remote.peer, Source(f"service {remote.name}", remote.node))
        shown = self._shown.pop(remote, None)
        if shown is None:
            return
        self.direct_imports.hidden(remote, end=remote.cause == DENIED)
        text = f"{shown.text}: {reason}"
        shown.fail_waiting(text)
        if (proxy := shown.proxy) is not None:
            self._core.call("unregisterService", proxy.name, remote.name, proxy.service_uri)
            proxy.remove_service(remote.name, text)
        proxies, owner = self.bridge.sessions.proxies(shown.session, remote.node, remote.origin)
        proxies.release(owner, f"service {remote.name}")

    def forget_about(self, remote: RemoteService) -> None:
        """What is known of a shown service may no longer be true."""
        shown = self._shown.get(remote)
        if shown is not None:
            if shown.endpoint is not None:
                shown.endpoint.description = None
            self.direct_imports.renewed(remote)

    async def _describe(self, shown: ShownService) -> ServiceDescription | str:
        if shown.remote.about is not None:
            return shown.remote.about
        if shown.is_open:  # its offer has come again since it was opened: the server may be another one
            if shown.active and shown.description is not None:
                return shown.description
            self.imports.release(shown.remote, "its type is asked for again")
        answer: asyncio.Future[ServiceDescription | str] = asyncio.get_running_loop().create_future()
        shown.asking.append(answer)
        self._want(shown)
        return await answer

    def _want(self, shown: ShownService) -> None:
        """Open a service, unless its peer has no link now: then the next ``link_up``, or ``gone``, ends the wait."""
        remote, session = shown.remote, shown.session
        if not remote.shown:
            shown.fail_waiting(f"{shown.text} has just gone")
        elif session.state is PeerState.AWAY:
            crashed = f"the agent of {session.link.name} has crashed, only direct calls work"
            shown.fail_waiting(f"service [{remote.name}]: {crashed}")
        elif session.linked:
            self.imports.want(remote, self.now())

    def opened(self, remote: RemoteService) -> None:
        """A service can be called: requests go out on ``remote.requests``, replies come in on ``remote.route``."""
        shown = self._shown.get(remote)
        if shown is not None and shown.session.linked and remote.about is not None:
            shown.session.link.routes[remote.route] = shown
            shown.open(remote.about, self._budgets[remote.peer])

    def ended(self, remote: RemoteService, route: int, reason: str) -> None:
        """A service cannot be called, or no longer: its calls fail with the reason; ``route`` was that of replies."""
        session = self.bridge.sessions.get(remote.peer)
        if session is not None:
            session.link.routes.pop(route, None)
        if (shown := self._shown.get(remote)) is not None:
            shown.close(reason)

    def _mismatched(self, shown: ShownService, fields: Mapping[str, str], text: str) -> None:
        """Report a client that was refused for its MD5 sum, here and at the peer."""
        caller_id = printable(fields.get("callerid", ""))
        shown.mismatch = text
        shown.stats.calls += 1
        shown.stats.fail(text)
        self.warn(_MISMATCH, f"{shown.remote.name}{caller_id}", text)
        if shown.session.linked:
            args: dict[str, Any] = {"service": shown.remote.wire, "text": text[: limits.CONTROL_TEXT_MAX]}
            self.bridge.rpc.notify(shown.session, _MISMATCH, args)

    def _told_of_mismatch(self, session: PeerSession, args: dict[str, Any]) -> None:
        text = printable(str(args.get("text", ""))[: limits.CONTROL_TEXT_MAX])
        self.warn("service.mismatch_remote", session.link.name, f"{session.link.name}: {text}")
