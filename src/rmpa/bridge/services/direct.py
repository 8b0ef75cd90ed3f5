"""The clients' side of direct calls: answers the lookups of this module's nodes with the servers' own addresses."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.grants import Grants, Want
from rmpa.bridge.direct.nodes import (
    Condition,
    Grant,
    LocalEndpoints,
    Unmet,
    connecting,
    end_these,
    end_to,
    unmet_by_trust,
)
from rmpa.bridge.direct.paths import Path, Paths
from rmpa.bridge.policy import OPEN_GATE, Needs, PermissionGate
from rmpa.config.peer_rules import Access
from rmpa.core.contract import Transport
from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE, is_own
from rmpa.ros.environment import host_of, is_loopback
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.context import ServiceRules
    from rmpa.bridge.direct.grants import DirectAsk
    from rmpa.bridge.rpc import PeerRpc
    from rmpa.bridge.services.bodies import LocalService
    from rmpa.bridge.services.exports import RemoteService, ServiceExports
    from rmpa.bridge.services.imports import ServiceImports
    from rmpa.bridge.sessions import PeerSession, PeerSessions
    from rmpa.core.counters import Counters
    from rmpa.ros.core.external import Core

_log = logging.getLogger(__name__)
_OWN_TOOLS: Final = "/rmpa_service"
"""The names of the nodes of ``rmpa service`` begin so: their calls are relayed, so that the agents measure them."""


@dataclass(slots=True)
class DirectAnswer:
    """What lookups of a service are answered.

    Args:
        path: The path.
        endpoint: The server's address and port.
        nearby: Whether the server runs on this machine, so that clients that are bound to loopback reach it too.
        lookups: How many lookups were answered so.
        looked_at: How many of these the last ``_look`` has seen.
        waiting: The sockets that were connecting then, by their cookies.
    """

    path: Path
    endpoint: tuple[str, int]
    nearby: bool
    lookups: int = 0
    looked_at: int = 0
    waiting: frozenset[tuple[int, int]] = frozenset()

    @property
    def uri(self) -> str:
        """The server's address, ``rosrpc://address:port``."""
        return f"rosrpc://{self.endpoint[0]}:{self.endpoint[1]}"


class DirectServiceImporter(Paths):
    """Direct calls of local nodes to services of peers.

    Args:
        core: The local core.
        imports: The peers' services.
        rules: The rules of this module; replaced by ``reload``.
        sessions: The peers.
        rpc: Carries the requests.
        proxy_uri: ``(peer, service)``: the proxy's address for a service; empty if there is none.
        on_warning: ``(kind, subject, text)``: logs and counts a warning.
        counters: Count ``direct.service_stopped``, ``direct.service_unreachable`` and ``direct.lookup_relayed``.
        gate: Whether the mesh is secured.
    """

    kind = "service"

    def __init__(
        self,
        core: Core,
        imports: ServiceImports,
        rules: ServiceRules,
        sessions: PeerSessions,
        rpc: PeerRpc,
        *,
        proxy_uri: Callable[[int, str], str],
        on_warning: Callable[[str, str, str], None],
        counters: Counters,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        super().__init__(sessions, rpc, on_warning, counters, gate)
        own = Needs((), "the peer's own services that are called directly")
        rpc.on_notification("direct.service_again", self._asked_again, own)
        self._imports = imports
        self._rules = rules
        self._proxy_uri = proxy_uri
        self.answers: dict[str, DirectAnswer] = {}
        """The services whose lookups are answered with the server's address, by their names here."""
        self._used: dict[str, set[tuple[str, int]]] = {}
        """By the peer's name: the addresses to which clients may have connections."""
        self._looking: asyncio.TimerHandle | None = None
        self._able = core.on_lookup(self._lookup)

    # --- lookups -------------------------------------------------------------------------------------------------

    def _lookup(self, service: str, uri: str, caller: str, api: str) -> str:
        """Answer a lookup; see ``Core.on_lookup``. It is called for each of them."""
        found = self.answers.get(service)
        if found is None or not found.path.decided.is_set() or self._proxy_uri(found.path.peer, service) != uri:
            return ""
        local_only = not found.nearby and is_loopback(host_of(api))
        if not api or local_only or is_own(caller) or caller.startswith(_OWN_TOOLS):
            self._counters.add("direct.lookup_relayed")
            return ""
        found.lookups += 1
        if self._looking is None and not found.nearby:
            self._looking = asyncio.get_running_loop().call_later(limits.DIRECT_CHECK, self._look)
        return found.uri

    def _look(self) -> None:
        """Find servers that clients cannot reach any more, as behind a new firewall: relay them.

        It is called while services are looked up. A connection that waits for its first answer from one look to the
        next is ended, so that its client gets an error instead of waiting for minutes.
        """
        self._looking = None
        again = False
        for found in list(self.answers.values()):
            if found.nearby or (found.lookups == found.looked_at and not found.waiting):
                continue
            again, found.looked_at = True, found.lookups
            waiting = connecting(found.endpoint)
            stuck = [one for one in waiting if one.cookie in found.waiting]
            found.waiting = frozenset(one.cookie for one in waiting)
            if stuck:
                end_these(stuck)
                self._counters.add("direct.service_unreachable")
                self._stop(found.path)
                self._decide(found.path, Unmet(Condition.REACHABLE, f"clients get no answer from {found.uri}"))
        if again and not self._closed:
            self._looking = asyncio.get_running_loop().call_later(limits.DIRECT_CHECK, self._look)

    def answer(self, peer: int, service: str) -> DirectAnswer | None:
        """What lookups of a peer's service are answered; ``None``: the proxy's address."""
        found = self.answers.get(service)
        return found if found is not None and found.path.peer == peer else None

    def unmet(self, peer: int, service: str) -> Unmet | None:
        """Why the calls of a shown service are relayed; ``None``: they are direct, or it is not decided yet."""
        remote = self._imports.get(peer, service)
        if remote is None:
            return None
        path = self.get(peer, Want(service, remote.node))
        return path.unmet if path is not None else self._unmet_here(peer, service, remote)

    # --- the local graph -----------------------------------------------------------------------------------------

    def reload(self, rules: ServiceRules) -> None:
        """Take new rules."""
        self._rules = rules

    def shown(self, peer: int, service: str) -> None:
        """Judge a service that is in the local graph, or to which other rules apply."""
        remote = self._imports.get(peer, service)
        if remote is None or not remote.shown:
            return
        want, wanted = Want(service, remote.node), self._rules.transport(service)
        for path in self:
            if path.peer == peer and path.want.name == want.name and (path.want != want or wanted is Transport.RELAY):
                self.forget(path)  # nothing is kept of services that are relayed by rule
        if wanted is not Transport.RELAY:
            self.judge(peer, want, wanted, self._unmet_here(peer, service, remote))

    def hidden(self, peer: int, service: str, node: str, *, end: bool = False) -> None:
        """Forget a service that leaves the local graph; clients keep the connections that they have.

        Args:
            peer: The peer.
            service: The service.
            node: The node that provides it.
            end: End these connections, too: the peer may not serve it here any more.
        """
        found, path = self.answer(peer, service), self.get(peer, Want(service, node))
        if path is not None:
            self.forget(path)
        if end and found is not None:
            self._end(self._imports.peer_name(peer), (found.endpoint,), same_machine=found.nearby)

    def forget(self, path: Path) -> None:
        """As of ``Paths``; lookups are answered with the proxy's address again."""
        super().forget(path)
        path.found = None
        self._decided(path)

    def renewed(self, peer: int, service: str, node: str) -> None:
        """Ask again for a service that was offered again: its server may be another one."""
        path = self.get(peer, Want(service, node))
        if path is not None and path.unmet_here is None:
            self._start(path)

    def _unmet_here(self, peer: int, service: str, remote: RemoteService) -> Unmet | None:
        if self._rules.transport(service) is Transport.RELAY:
            return Unmet(Condition.TRANSPORT, 'transport is "relay" in this module')
        if not self._able:
            return Unmet(Condition.CORE, "this module uses a roscore, which answers all nodes alike")
        if self._rules.has_timeout(service):
            text = f"its timeout of {self._rules.timeout(service):g} s is kept by agents: a direct call has none"
            return Unmet(Condition.CONTRACT, text)
        if remote.origin is not None:
            return Unmet(Condition.OWN_SOURCE, f"it is {remote.origin.name}'s, and comes by a relay")
        if remote.wire != service:
            return Unmet(Condition.NAME, f"it is {remote.wire} in the server's module")
        session = self._sessions.get(peer)
        same_machine = session is not None and session.same_machine
        return unmet_by_trust(self._gate, "this module", same_machine=same_machine)

    # --- links ---------------------------------------------------------------------------------------------------

    def link_down(self, session: PeerSession, *, crashed: bool) -> None:
        """Stop direct calls to a peer that cannot be reached, those under way too; unless only its agent has died."""
        super().link_down(session, crashed=crashed)
        if not crashed:
            self._end(session.link.name, self._used.pop(session.link.name, set()), same_machine=session.same_machine)

    def called(self, peer: int) -> set[str]:
        """The services of a peer that are called directly."""
        return {service for service, found in self.answers.items() if found.path.peer == peer}

    def gone(self, session: PeerSession) -> None:
        """As of ``Paths``."""
        super().gone(session)
        self._used.pop(session.link.name, None)

    def _end(self, name: str, endpoints: Iterable[tuple[str, int]], *, same_machine: bool) -> None:
        """Ends the connections of clients; over loopback nothing can hang, and others use the same address."""
        for endpoint in () if same_machine else endpoints:
            self._counters.add("direct.service_stopped")
            if problem := end_to(endpoint):
                text = "! %s: calls under way to %s:%d may hang: they cannot be ended (%s); see rmpa doctor"
                _log.warning(text, name, *endpoint, problem)

    # --- carrying out --------------------------------------------------------------------------------------------

    async def _probe(self, session: PeerSession, path: Path, grant: Grant) -> str:
        address = f"rosrpc://{session.address}:{grant.port}"
        try:
            connection = await ServiceConnection.open(
                address, path.want.name, OWN_NODE, persistent=False, probe=True, timeout=limits.DIRECT_PROBE_TIMEOUT
            )
        except RmpaError as error:
            return str(error)
        connection.close()
        if connection.caller_id != grant.node:
            return f"{printable(connection.caller_id) or 'another program'} listens at {address}"
        return ""

    def _subject(self, path: Path) -> str:
        return f"{path.want.name} of {self._imports.peer_name(path.peer)}"

    def _decided(self, path: Path) -> None:
        service, session, endpoint = path.want.name, self._sessions.get(path.peer), self.target(path)
        before = self.answer(path.peer, service)
        path.endpoint = endpoint
        if session is None or endpoint is None:
            if before is not None and before.path is path:
                del self.answers[service]
                _log.info("= %s of %s is relayed", service, self._imports.peer_name(path.peer))
            return
        if before is not None and (before.path, before.endpoint) == (path, endpoint):
            return
        found = self.answers[service] = DirectAnswer(path, endpoint, session.same_machine)
        used = self._used.setdefault(session.link.name, set())
        if len(used) < limits.DIRECT_MAX:
            used.add(endpoint)
        _log.info("= %s of %s is called directly at %s", service, session.link.name, found.uri)

    async def close(self) -> None:
        """As of ``Paths``."""
        if self._looking is not None:
            self._looking.cancel()
        self.answers.clear()
        await super().close()


# The server's side of direct calls: tells peers at which port the server of a service listens, or why not.


class DirectServiceExporter(Grants):
    """The direct calls of peers' nodes to local servers.

    Args:
        core: The local core.
        exports: Knows what is offered to each peer.
        rules: The rules of this module; replaced by ``reload``.
        sessions: The peers.
        rpc: Carries the requests.
        on_warning: ``(kind, subject, text)``: logs and counts a warning.
        counters: Count ``direct.granted`` and ``direct.ended``.
        gate: Whether the mesh is secured.
    """

    kind = "service"

    def __init__(
        self,
        core: Core,
        exports: ServiceExports,
        rules: ServiceRules,
        sessions: PeerSessions,
        rpc: PeerRpc,
        *,
        on_warning: Callable[[str, str, str], None],
        counters: Counters,
        gate: PermissionGate = OPEN_GATE,
    ) -> None:
        super().__init__(sessions, rpc, counters, gate)
        offered = Needs((Access.CALL,), "the service: only what is offered to the peer")
        rpc.on_request("direct.service", self._ask, offered)
        rpc.on_notification(
            "direct.service_release", self._released, Needs((), "what was granted to the peer itself")
        )
        self._exports = exports
        self._rules = rules
        self._endpoints = LocalEndpoints(core)
        self._on_warning = on_warning
        self._servers: dict[str, LocalService] = {}
        """The servers of services that were asked for, as they were last seen."""

    def reload(self, rules: ServiceRules) -> None:
        """Take new rules, and end what they do not allow."""
        self._rules = rules
        self.judge_again()

    def server(self, service: str, server: LocalService | None) -> None:
        """Have peers ask again for a service that has another server now."""
        before = self._servers.get(service)
        if before is not None and before != server:
            del self._servers[service]
            self._again(lambda want: want.name == service)

    async def _ask(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        reply = await super()._ask(session, args)
        if "why" in reply and self._rules.transport(args["name"]) is Transport.DIRECT:
            name, service = session.link.name, args["name"]
            text = f'{service}: calls from {name} are relayed although transport is "direct": {reply["text"]}'
            self._on_warning("direct.relayed", f"{name} {service} {reply['why']}", text)
        return reply

    async def _find(self, session: PeerSession, want: Want) -> Grant | Unmet:
        return self._endpoints.of_service(session, want.node, self._exports.offered[want.name].uri, want.name)

    def _unmet(self, session: PeerSession, asked: DirectAsk) -> Unmet | None:
        service = asked.name
        local, server = self._exports.local(session.peer, service), self._exports.offered.get(service)
        if server is not None:
            self._servers[service] = server
        if local is None or server is None:
            return Unmet(Condition.OFFERED, f"{service} is not offered")
        if local != service:
            return Unmet(Condition.NAME, f"it is {local} in the server's module")
        if server.origin is not None:
            return Unmet(Condition.OWN_SOURCE, "it comes by a relay")
        if server.node != asked.node:
            return Unmet(Condition.OFFERED, f"{server.node} provides {service} now")
        if self._rules.transport(service) is Transport.RELAY:
            return Unmet(Condition.TRANSPORT, 'transport is "relay" in the server\'s module')
        return self._unmet_by_trust(session, "the server's module")
