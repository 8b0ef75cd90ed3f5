"""Makes the neighbour "other sites" with all its parts, from the settings."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any

from rmpa.config.peer_rules import Access
from rmpa.core.errors import UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.graph.own_graph import AgentGraph
from rmpa.gateway.own_policy import OwnPolicy
from rmpa.gateway.site_permissions import SitePermissions
from rmpa.gateway.sites.history import SiteHistory
from rmpa.gateway.sites.io.action_part import SiteActions
from rmpa.gateway.sites.io.neighbour import SiteNeighbour
from rmpa.gateway.sites.io.param_exports import SiteParamExports
from rmpa.gateway.sites.io.param_imports import SiteParamImports
from rmpa.gateway.sites.io.service_exports import SiteServiceExports
from rmpa.gateway.sites.io.service_imports import SiteServiceImports
from rmpa.gateway.sites.io.site_answers import SiteAnswers
from rmpa.gateway.sites.io.site_why import SiteWhy
from rmpa.gateway.sites.io.topic_part import SiteTopics
from rmpa.gateway.sites.keys import SiteGateway
from rmpa.gateway.sites.rules import CrossingRules
from rmpa.runtime.loop import SystemClock
from rmpa.trust.documents import refusal

if TYPE_CHECKING:
    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.sites.params import SiteAsker
    from rmpa.gateway.sites.part import SitePart
    from rmpa.gateway.zenoh.session import OpenSession


def make_site_neighbour(graph: AgentGraph, session: OpenSession, settings: Settings) -> SiteNeighbour:
    """Make the neighbour "other sites"; it is not started. ``settings.gateway.site`` is not empty."""
    gateway, clock, counters = settings.gateway, SystemClock(), graph.agent.bridge.counters
    policy, history = OwnPolicy(settings), SiteHistory(clock.now)
    rules = CrossingRules(gateway.rules, policy.judge, SitePermissions(graph.agent.bridge.gate))

    def why_not(site: str, source: MeshSource) -> str:
        return rules.refusal(site, source.module, source.name, Access.CALL)

    parts: list[SitePart] = [
        SiteTopics(gateway.site, graph, session, rules, settings.make_contracts(), clock, counters),
        SiteServiceExports(gateway.site, session, graph, policy.timeout, why_not),
        SiteServiceImports(gateway.site, session, graph, policy.timeout, clock.wall_ns),
        SiteActions(graph.attend),
    ]
    own = SiteGateway(gateway.site, gateway.rank, secrets.token_hex(16))
    neighbour = SiteNeighbour(graph, session, own, rules, parts, counters)
    neighbour.on_sites = history.seen
    neighbour.on_site_source = lambda source, there: history.source(source, there=there)
    _add_questions(neighbour, graph.agent, session, own, rules, history, clock, settings.name)
    return neighbour


def _add_questions(
    neighbour: SiteNeighbour,
    agent: Agent,
    session: OpenSession,
    own: SiteGateway,
    rules: CrossingRules,
    history: SiteHistory,
    clock: SystemClock,
    name: str,
) -> None:
    """Add what answers ``rmpa site``, ``rmpa param`` and ``rmpa why`` about other sites."""

    async def ask_module(module: str, what: str, args: dict[str, Any]) -> object:
        for peer in agent.bridge.sessions.linked():
            if peer.link.name == module:
                return await agent.bridge.rpc.request(peer, what, args, limits.SITE_PARAM_TIMEOUT)
        where = f"site {own.site} as {module!r}"
        raise UnreachableError("module", where, "`rmpa peer list` there shows which are linked to its gateway")

    def may_not(asker: SiteAsker, module: str, parameter: str, told: str) -> str:
        return rules.refusal(asker.site, module, parameter, Access.PARAM, asker.modules, told)

    gate = agent.bridge.gate

    def may_not_here(asker: str, parameter: str, told: str) -> str:
        if not asker or gate.admits(Access.PARAM, asker, parameter):
            return ""
        return refusal(Access.PARAM, asker, told)

    def may(asker: str, access: Access, source: str) -> bool:
        return not asker or gate.judge(access, asker, source).allowed

    exports = SiteParamExports(own.site, session, ask_module, may_not)
    imports = SiteParamImports(
        own.site,
        session,
        clock.wall_ns,
        may_not_here if gate.on else None,
    )
    neighbour.add(exports)
    neighbour.on_leads = exports.lead
    why = SiteWhy(own.site, name, session, neighbour, history, rules, may)
    answers = SiteAnswers(
        name,
        own,
        neighbour,
        history,
        lambda: session.endpoints,
        imports.ask,
        why,
        may if gate.on else None,
    )
    neighbour.add(answers)
    agent.sites.serve(answers)
