"""What this agent knows of a service on its path: for its own user, and for the agent at the other end."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from rmpa.bridge.policy import OWN_NODE, Policy, is_own
from rmpa.bridge.proxies import Names
from rmpa.bridge.services.exports import ServiceRules
from rmpa.config.peer_rules import Access
from rmpa.config.values import did_you_mean
from rmpa.core.errors import RmpaError
from rmpa.observe import limits as observe_limits
from rmpa.observe.check import FAIL, OK, Check
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.observe.why.io.topic_evidence import name_in
from rmpa.observe.why.services import ServiceAtClient, ServiceAtServer, ServiceTransport
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.runtime.loop import yielding_to_data

if TYPE_CHECKING:
    from rmpa.bridge.bridge import Bridge
    from rmpa.bridge.services.part import Services
    from rmpa.bridge.sessions import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.ros.core.api import Core


class ServiceEvidence:
    """Reads what the rooms know of one service, and probes servers; changes nothing.

    Args:
        settings: The agent's.
        core: Its ROS core.
        bridge: Its bridge.
        services: The bridge's part for services.
    """

    def __init__(self, settings: Settings, core: Core, bridge: Bridge, services: Services) -> None:
        self._core = core
        self._bridge = bridge
        self._services = services
        self.reload(settings)

    def reload(self, settings: Settings) -> None:
        """Use other settings from now on."""
        policy, names = Policy(settings.policy, settings.peers, settings.time), Names(settings.naming)
        self._rules = ServiceRules(settings.services, policy, names)

    def known(self, service: str) -> bool:
        """Whether a peer offers a service; ``service`` is its name here."""
        return any(remote.name == service for _, remote in self._services.imports)

    def offers(self, session: PeerSession, service: str, instance: str) -> bool:
        """Whether a link carries a service of the module with this instance id: the peer's own, or a relayed one."""
        remote = self._services.imports.get(session.peer, service)
        if remote is None:
            return False
        return (remote.origin.instance if remote.origin else session.link.identity.instance.hex()) == instance

    async def nowhere(self, here: str, service: str, linked: list[str]) -> Diagnosis:
        """The diagnosis of a service that no peer has."""
        state = self._core.state()
        own = [node for node in state.services.get(service, {}) if not is_own(node)]
        similar = await asyncio.to_thread(did_you_mean, service, {*state.services})
        text = f"no linked peer ({', '.join(linked) or 'there is none'}) provides {service}"
        remedy = (
            f"did you mean {similar}?" if similar else "`rosservice list` shows what there is, `rmpa peer list` who"
        )
        if own:
            text = f"{own[0]} of this module provides {service}; clients here call it without us"
            remedy = f"whether another module may call it: `rmpa why {here}:{service}` over there"
        stage = Check("server", OK if own else FAIL, text, remedy)
        return Diagnosis.of((stage,), kind="service", name=service, peer="", to=here)

    async def here(self, session: PeerSession, service: str, wire: str) -> ServiceAtClient:
        """What is known here of a service of a peer; its proxy is probed as a client would."""
        remote = self._services.imports.get(session.peer, service)
        if remote is None:
            return ServiceAtClient(wire=wire)
        shown = self._services.shown(session.peer, service)
        if shown is None or shown.proxy is None:
            return ServiceAtClient(
                wire=wire, offered=True, node=remote.node, hidden=remote.hidden, denied=remote.denied
            )
        uri = self._core.state().services.get(service, {}).get(shown.proxy.name, "")
        answer, refusal = await _probe(uri, service) if uri else ("", "")
        return ServiceAtClient(
            wire=wire,
            offered=True,
            node=remote.node,
            hidden=remote.hidden,
            registered=bool(uri),
            transport=self._transport(session.peer, service),
            answer=answer,
            refusal=refusal,
            calls=shown.stats.calls,
            failed=shown.stats.failed,
            problem=shown.stats.problem,
            mismatch=shown.mismatch,
        )

    def _transport(self, peer: int, service: str) -> ServiceTransport:
        direct = self._services.direct_imports
        wanted, answer, unmet = (
            self._rules.transport(service),
            direct.answer(peer, service),
            direct.unmet(peer, service),
        )
        if answer is not None:
            return ServiceTransport(wanted, answer.uri)
        if unmet is None:
            return ServiceTransport(wanted)
        return ServiceTransport(wanted, condition=unmet.condition, problem=unmet.text)

    async def answer(self, session: PeerSession, args: dict[str, Any]) -> ServiceAtServer:
        """The reply to ``why.service``; the server is probed.

        Args:
            session: The peer that asks.
            args: ``service``: its name on the wire.
        """
        wire = name_in(args, "service")
        peer = session.link.name
        seen, gate = self._services.exports.seen, self._bridge.gate
        services = self._bridge.topics.names.of(peer).locals_of(wire)
        services = tuple(service for service in services if gate.judge(Access.CALL, peer, service).allowed)
        if not services:
            return ServiceAtServer(permitted=False)
        for service in services:
            server = seen.get(service)
            if server is None:
                for node in self._core.state().services.get(service, {}):
                    if (found := self._core.unreachable().get(node)) is not None:
                        refusal = f"it cannot be reached at {found.api} ({found.problem})"
                        return ServiceAtServer(node=node, service=service, refusal=refusal)
                continue
            decision = self._rules.judge(service, server.node if server.origin is None else server.origin.node)
            if decision.allowed:
                special = self._rules.judge_for(peer, service, wire)
                decision = special if special.rule else decision
            _, refusal = await _probe(server.uri, service)
            return ServiceAtServer(
                node=server.node,
                service=service,
                crosses=decision.allowed,
                rule=decision.rule,
                refusal=refusal,
                permitted=True if gate.on else None,
            )
        known = {
            self._rules.wire_name(peer, service)
            for service in yielding_to_data(list(seen))
            if gate.judge(Access.CALL, peer, service).allowed
        }
        # In a thread: comparing thousands of names takes longer than a message may wait.
        similar = await asyncio.to_thread(did_you_mean, wire, known)
        return ServiceAtServer(similar=similar or "")


async def _probe(uri: str, service: str) -> tuple[str, str]:
    """A server's description of its service, and why there is none; asked as ``rospy.wait_for_service`` does."""
    try:
        found = await ServiceConnection.open(
            uri, service, OWN_NODE, probe=True, persistent=False, timeout=observe_limits.WHY_PROBE
        )
    except RmpaError as error:
        return "", str(error)
    found.close()
    return f"{found.description.type}, md5 {found.description.md5sum}", ""
