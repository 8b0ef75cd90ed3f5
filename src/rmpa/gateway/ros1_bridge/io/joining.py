"""Makes the neighbour zenoh-bridge-ros1 from the settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge.naming import Names
from rmpa.bridge.policy import Policy
from rmpa.bridge.services.rules import ServiceRules
from rmpa.core.names import matches
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.ros1_bridge.io.neighbour import SITE, Ros1BridgeNeighbour
from rmpa.gateway.site_permissions import SitePermissions
from rmpa.gateway.sites.rules import CrossingRules

if TYPE_CHECKING:
    from rmpa.agent import Agent
    from rmpa.bridge.policy import PolicyDecision
    from rmpa.config.settings import Settings
    from rmpa.gateway.neighbour import OwnGraph
    from rmpa.gateway.zenoh_api import ZenohSession


def make_ros1_bridge_neighbour(
    graph: OwnGraph, session: ZenohSession, settings: Settings, agent: Agent | None = None
) -> Ros1BridgeNeighbour:
    """Make the neighbour; it is not started.

    Args:
        graph: The gateway's graph.
        session: The Zenoh session.
        settings: The gateway's; ``[bridge]`` and ``[services]`` must let cross what ``[[gateway.rule]]`` lets.
        agent: The gateway's agent, whose ``[[permission]]`` hold for a module named ``ros1_bridge``.
    """
    policy = Policy(settings.policy, settings.peers, settings.time)
    services = ServiceRules(settings.services, policy, Names(settings.peers))

    def judge(kind: SourceKind, name: str, type_name: str, node: str) -> PolicyDecision:
        if kind is SourceKind.SERVICE:
            return services.judge(name, node)
        return policy.judge(name, type_name, node)

    own = [rule for rule in settings.gateway.rules if any(matches(glob, SITE) for glob in rule.sites)]
    permissions = None if agent is None else SitePermissions(agent.bridge.gate)
    rules = CrossingRules(own, judge, permissions)
    return Ros1BridgeNeighbour(graph, session, rules, settings.gateway.ros1_bridge_namespace, services.timeout)
