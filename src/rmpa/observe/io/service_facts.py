"""What this agent knows of one service on its way: for its own user, and for the agent at the other end."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from rmpa.bridge import limits
from rmpa.bridge.naming import Names
from rmpa.bridge.policy import OWN_NODE, Policy, is_own
from rmpa.bridge.services.rules import ServiceRules
from rmpa.config.values import did_you_mean
from rmpa.core.errors import RmpaError
from rmpa.observe.io.topic_facts import name_in
from rmpa.observe.why.diagnosis import Diagnosis, PathStage, StageResult
from rmpa.observe.why.services import FarService, NearService
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.runtime.event_loop import yielding_to_data

if TYPE_CHECKING:
    from rmpa.bridge.io.bridge import Bridge
    from rmpa.bridge.services.io.part import Services
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.config.settings import Settings
    from rmpa.ros.core.api import Core


class ServiceFacts:
    """Reads the rooms, and probes servers; changes nothing.

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
        """Other settings hold from now on."""
        policy, names = Policy(settings.policy, settings.peers, settings.time), Names(settings.peers)
        self._rules = ServiceRules(settings.services, policy, names)

    def known(self, service: str) -> bool:
        """Whether some peer offers a service, by its name here."""
        return any(remote.name == service for _, remote in self._services.imports)

    def offers(self, attached: PeerSession, service: str, instance: str) -> bool:
        """Whether this link brings a service of this module, be it the peer's own or one that it passes on."""
        remote = self._services.imports.get(attached.peer, service)
        if remote is None:
            return False
        return (remote.origin.instance if remote.origin else attached.link.identity.instance.hex()) == instance

    async def nowhere(self, here: str, service: str, linked: list[str]) -> Diagnosis:
        """No peer has it."""
        state = self._core.state()
        own = [node for node in state.services.get(service, {}) if not is_own(node)]
        near = await asyncio.to_thread(did_you_mean, service, {*state.services})
        text = f"no linked peer ({', '.join(linked) or 'there is none'}) provides {service}"
        remedy = f"did you mean {near}?" if near else "`rosservice list` shows what there is, `rmpa peer list` who"
        if own:
            text = f"{own[0]} of this module provides {service}; clients here call it without us"
            remedy = f"whether another module may call it: `rmpa why {here}:{service}` over there"
        stage = PathStage("server", StageResult.FAIL, text, remedy)
        return Diagnosis(kind="service", name=service, peer="", to=here, flows=False, stages=(stage,))

    async def near(self, attached: PeerSession, service: str, wire: str) -> NearService:
        """What is known here of a service of a peer; a client's probe is sent to what stands for it."""
        remote = self._services.imports.get(attached.peer, service)
        if remote is None:
            return NearService(wire=wire)
        shown = self._services.shown(attached.peer, service)
        if shown is None or shown.proxy is None:
            return NearService(wire=wire, offered=True, node=remote.node, hidden=remote.hidden)
        uri = self._core.state().services.get(service, {}).get(shown.proxy.name, "")
        answer, refusal = await _probe(uri, service) if uri else ("", "")
        return NearService(
            wire=wire,
            offered=True,
            node=remote.node,
            hidden=remote.hidden,
            registered=bool(uri),
            answer=answer,
            refusal=refusal,
            calls=shown.stats.calls,
            failed=shown.stats.failed,
            problem=shown.stats.problem,
            mismatch=shown.mismatch,
        )

    async def tell(self, attached: PeerSession, args: dict[str, Any]) -> FarService:
        """Answer the agent of those who would call a service; ours is asked whether it is alive.

        Args:
            attached: Who asks.
            args: ``service``: its name on the way.
        """
        wire = name_in(args, "service")
        peer = attached.link.name
        seen = self._services.exports.seen
        for service in self._bridge.names.of(peer).locals_of(wire):
            server = seen.get(service)
            if server is None:
                for node in self._core.state().services.get(service, {}):
                    if (found := self._core.unreachable().get(node)) is not None:
                        refusal = f"it cannot be reached at {found.api} ({found.problem})"
                        return FarService(node=node, service=service, refusal=refusal)
                continue
            decision = self._rules.judge(service, server.node if server.origin is None else server.origin.node)
            if decision.allowed:
                special = self._rules.judge_for(peer, service, wire)
                decision = special if special.rule else decision
            _, refusal = await _probe(server.uri, service)
            return FarService(
                node=server.node,
                service=service,
                crosses=decision.allowed,
                rule=decision.rule,
                refusal=refusal,
            )
        known = {self._rules.wire_name(peer, service) for service in yielding_to_data(list(seen))}
        # To compare with thousands of names takes longer than a message may wait.
        near = await asyncio.to_thread(did_you_mean, wire, known)
        return FarService(near=near or "")


async def _probe(uri: str, service: str) -> tuple[str, str]:
    """What a server says of its service, and why it does not; as ``rospy.wait_for_service`` asks."""
    try:
        found = await ServiceConnection.open(
            uri, service, OWN_NODE, probe=True, persistent=False, timeout=limits.WHY_PROBE
        )
    except RmpaError as error:
        return "", str(error)
    found.close()
    return f"{found.description.type}, md5 {found.description.md5sum}", ""
