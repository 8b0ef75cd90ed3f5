"""Makes the neighbour zenoh-bridge-ros1 from the settings."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core.names import matches
from rmpa.gateway.own_policy import OwnPolicy
from rmpa.gateway.ros1_bridge.io.neighbour import SITE, Ros1BridgeNeighbour
from rmpa.gateway.site_permissions import SitePermissions
from rmpa.gateway.sites.rules import CrossingRules

if TYPE_CHECKING:
    from rmpa.agent import Agent
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
    policy = OwnPolicy(settings)
    own = [rule for rule in settings.gateway.rules if any(matches(glob, SITE) for glob in rule.sites)]
    permissions = None if agent is None else SitePermissions(agent.bridge.gate)
    rules = CrossingRules(own, policy.judge, permissions)
    return Ros1BridgeNeighbour(graph, session, rules, settings.gateway.ros1_bridge_namespace, policy.timeout)
