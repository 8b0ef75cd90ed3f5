"""Makes the neighbour "other sites" with all its parts, from the settings."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING

from rmpa.bridge.naming import Names
from rmpa.bridge.policy import Policy
from rmpa.bridge.services.rules import ServiceRules
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.io.neighbour import SiteNeighbour
from rmpa.gateway.sites.io.service_part import SiteServices
from rmpa.gateway.sites.io.topic_part import SiteTopics
from rmpa.gateway.sites.keys import SiteGateway
from rmpa.gateway.sites.rules import CrossingRules
from rmpa.runtime.system_clock import SystemClock

if TYPE_CHECKING:
    from rmpa.bridge.policy import PolicyDecision
    from rmpa.config.settings import Settings
    from rmpa.gateway.neighbour import MeshSource, OwnGraph
    from rmpa.gateway.sites.part import SitePart
    from rmpa.gateway.zenoh_api import ZenohSession


def make_site_neighbour(graph: OwnGraph, session: ZenohSession, settings: Settings) -> SiteNeighbour:
    """Make the neighbour "other sites"; it is not started.

    Args:
        graph: The gateway's graph.
        session: The Zenoh session.
        settings: The gateway's; ``settings.gateway.site`` is not empty.
    """
    policy = Policy(settings.policy, settings.peers, settings.time)
    services = ServiceRules(settings.services, policy, Names(settings.peers))

    def judge(kind: SourceKind, name: str, type_name: str, node: str) -> PolicyDecision:
        if kind is SourceKind.SERVICE:
            return services.judge(name, node)
        return policy.judge(name, type_name, node)

    gateway, clock = settings.gateway, SystemClock()
    rules = CrossingRules(gateway.rules, judge)

    def why_not(site: str, source: MeshSource) -> str:
        return rules.refusal(site, source.module, source.name)

    parts: list[SitePart] = [
        SiteTopics(gateway.site, graph, session, rules, settings.make_contracts(), clock),
        SiteServices(gateway.site, session, graph, services.timeout, why_not, clock.wall_ns),
    ]
    own = SiteGateway(gateway.site, gateway.rank, secrets.token_hex(16))
    return SiteNeighbour(graph, session, own, rules, parts)
