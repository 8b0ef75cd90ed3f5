"""The server's side of direct calls: tells peers at which port the server of a service listens, or why not."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

from rmpa.bridge.direct import service_requests as requests
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet, reply_of, unmet_by_trust
from rmpa.bridge.direct.io.endpoints import LocalEndpoints
from rmpa.bridge.direct.io.nodes import end_from
from rmpa.bridge.direct.server_side import ReofferService, ServiceGrants, WithdrawService
from rmpa.bridge.direct.service_requests import RetryService, ServiceDirectClosed
from rmpa.bridge.permission_gate import OPEN_GATE, Needs, PermissionGate
from rmpa.config.permission_rules import Access
from rmpa.core.contract import Transport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.direct.server_side import ServerAction
    from rmpa.bridge.services.actions import LocalService
    from rmpa.bridge.services.exports import ServiceExports
    from rmpa.bridge.services.rules import ServiceRules
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core

_log = logging.getLogger(__name__)


class DirectServiceExporter:
    """Answers the peers' requests for direct calls, and withdraws what was granted.

    Args:
        core: The local core.
        exports: Knows what is offered to each peer.
        rules: The rules of this module; replaced by ``reload``.
        sessions: The peers.
        rpc: Carries the requests.
        on_warning: ``(kind, subject, text)``: logs and counts a warning.
        counters: Count ``direct.service_granted``, ``direct.service_withdrawn`` and ``direct.service_ended``.
        gate: Whether the mesh is secured.
    """

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
        self._gate = gate
        self._exports = exports
        self._rules = rules
        self._endpoints = LocalEndpoints(core)
        self._sessions = sessions
        self._rpc = rpc
        self._on_warning = on_warning
        self._counters = counters
        self.grants = ServiceGrants()
        """What the peers were answered."""
        offered = Needs((Access.CALL,), "the service: only what is offered to the peer")
        rpc.on_request(requests.SERVICE, self._answer, offered)
        rpc.on_notification(requests.SERVICE_CLOSE, self._released, Needs((), "what was granted to the peer itself"))

    def reload(self, rules: ServiceRules) -> None:
        """Take new rules, and withdraw the grants that they do not allow."""
        self._rules = rules
        before = {(peer, told.port) for _, peer, told in self.grants if told.port is not None}
        self._act(self.grants.judge_again(self._unmet, secured=self._gate.on))
        if self._gate.on:
            for peer, port in before - {(peer, told.port) for _, peer, told in self.grants}:
                session = self._sessions.get(peer)
                if session is not None and not session.same_machine:
                    self._end(session, port)

    def server(self, service: str, server: LocalService | None) -> None:
        """Compare the grants for a service with its present server."""
        self._act(self.grants.server(service, server.node if server else "", server.uri if server else ""))

    def link_down(self, session: PeerSession, *, crashed: bool) -> None:
        """End the servers' connections to a peer that cannot be reached; unless only its agent has died."""
        ports = self.grants.ports(session.peer)
        self.grants.peer_gone(session.peer)
        if crashed or session.same_machine:
            return  # over loopback there is nothing that could hang, and local clients have the same address
        for port in ports:
            self._end(session, port)

    def _end(self, session: PeerSession, port: int) -> None:
        self._counters.add("direct.service_ended")
        if problem := end_from(port, session.address):
            text = "! %s: replies of local servers to it may hang: they cannot be ended (%s)"
            _log.info(text, session.link.name, problem)

    # --- requests ------------------------------------------------------------------------------------------------

    def _answer(self, session: PeerSession, args: dict[str, Any]) -> dict[str, object]:
        asked = requests.read_ask(args)
        found = self._find(session, asked.service, asked.node)
        server = self._exports.offered.get(asked.service)
        # A peer is not told of a service that it may not have. Of one that it may have, the advertisement tells it.
        hidden = self._gate.on and self._exports.local(session.peer, asked.service) is None
        if server is not None and not hidden:
            self.grants.answered(session.peer, asked.service, asked.node, server.uri, found)
        if isinstance(found, Grant):
            self._counters.add("direct.service_granted")
            return reply_of(found)
        if self._rules.transport(asked.service) is Transport.DIRECT:
            name = session.link.name
            text = f'{asked.service}: calls from {name} are relayed although transport is "direct": {found.text}'
            self._on_warning("direct.service_relayed", f"{name} {asked.service} {found.condition}", text)
        return reply_of(found)

    def _released(self, session: PeerSession, args: dict[str, Any]) -> None:
        closed = requests.read_close(args)
        self.grants.released(session.peer, closed.service, closed.node)

    def _find(self, session: PeerSession, service: str, node: str) -> Grant | Unmet:
        unmet = self._unmet(service, session.peer) or self.grants.full(session.peer, service)
        if unmet is not None:
            return unmet
        server = self._exports.offered[service]
        if server.node != node:
            return Unmet(Condition.OFFERED, f"{server.node} provides {service} now")
        return self._endpoints.of_service(session, node, server.uri, service)

    def _unmet(self, service: str, peer: int) -> Unmet | None:
        """The condition that a service, by its name on the wire, does not meet for a peer."""
        local = self._exports.local(peer, service)
        if local is None:
            return Unmet(Condition.OFFERED, f"{service} is not offered")
        if local != service:
            return Unmet(Condition.NAME, f"it is {local} in the server's module")
        if self._exports.offered[service].origin is not None:
            return Unmet(Condition.OWN_SOURCE, "it comes by a relay")
        if self._rules.transport(service) is Transport.RELAY:
            return Unmet(Condition.TRANSPORT, 'transport is "relay" in the server\'s module')
        session = self._sessions.get(peer)
        same_machine = session is not None and session.same_machine
        return unmet_by_trust(self._gate, "the server's module", same_machine=same_machine)

    # --- carrying out --------------------------------------------------------------------------------------------

    def _act(self, actions: Iterable[ServerAction]) -> None:
        for action in actions:
            session = self._sessions.get(action.peer)
            if session is None or not session.linked:
                continue
            match action:
                case WithdrawService():
                    self._counters.add("direct.service_withdrawn")
                    why, text = action.unmet.condition.value, action.unmet.text
                    closed = ServiceDirectClosed(action.service, action.node, why, text)
                    self._rpc.notify(session, requests.SERVICE_CLOSED, requests.write(closed))
                case ReofferService():
                    again = RetryService(action.service, action.node)
                    self._rpc.notify(session, requests.SERVICE_RETRY, requests.write(again))
