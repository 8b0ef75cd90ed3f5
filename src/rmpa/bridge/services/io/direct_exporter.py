"""The server's side of direct calls: tells peers at which port the server of a service listens, or why not."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rmpa.bridge.direct.conditions import Condition, Grant, Unmet
from rmpa.bridge.direct.grants import Grants
from rmpa.bridge.direct.io.endpoints import LocalEndpoints
from rmpa.bridge.permission_gate import OPEN_GATE, Needs, PermissionGate
from rmpa.config.peer_rules import Access
from rmpa.core.contract import Transport

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.bridge.direct.requests import DirectAsk, Want
    from rmpa.bridge.services.actions import LocalService
    from rmpa.bridge.services.exports import ServiceExports
    from rmpa.bridge.services.rules import ServiceRules
    from rmpa.bridge.session.peer_rpc import PeerRpc
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.bridge.session.peer_sessions import PeerSessions
    from rmpa.core.counters import Counters
    from rmpa.ros.core.api import Core


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
