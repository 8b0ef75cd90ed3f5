"""The neighbour "other sites" with all its parts, and its answers to ``rmpa site``.

Makes the neighbour "other sites" with all its parts, from the settings.
"""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any, Final

from rmpa.config.peer_rules import Access
from rmpa.core.errors import RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.identity import peer_name_problem
from rmpa.gateway import limits
from rmpa.gateway.neighbour import OwnPolicy, SitePermissions, SourceKind
from rmpa.gateway.sites.catalogue import CrossingRules
from rmpa.gateway.sites.imported_topic import SiteTopics
from rmpa.gateway.sites.keys import SiteGateway, SiteHistory
from rmpa.gateway.sites.params import SiteParamExports, SiteParamImports
from rmpa.gateway.sites.plans import SitePart
from rmpa.gateway.sites.services import SiteActions, SiteServiceExports, SiteServiceImports
from rmpa.gateway.sites.site import SiteNeighbour
from rmpa.gateway.sites.why import ACCESS, SiteWhy
from rmpa.observe.operations import INFO, PARAM, REPORT, WHY
from rmpa.observe.peer_info import SiteInfo, SiteModuleInfo, SiteSourceInfo, SitesReport
from rmpa.runtime.loop import SystemClock
from rmpa.trust.permissions import refusal

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.sites.keys import SiteModule
    from rmpa.gateway.sites.params import SiteAsker
    from rmpa.gateway.zenoh.session import OpenSession


# Answers ``rmpa site``, ``rmpa param`` and ``rmpa why`` about other sites, to this machine and to linked modules.


_KINDS: Final = {SourceKind.TOPIC: "topic", SourceKind.SERVICE: "service"}


class SiteAnswers(SitePart):
    """A ``SiteAnswerer``, and a ``SitePart`` to be closed.

    Args:
        gateway: This gateway's name.
        own: This gateway among those of its site.
        sites: What is known of sites.
        history: Since when sites are there or away.
        endpoints: The Zenoh endpoints that the session is connected to.
        ask_param: Asks a module of another site about a parameter: asker, site, module, question, arguments.
        why: Tells the ways of a topic or a service through this gateway; closed here.
        may: ``(asker, access, name)``: whether a module of this site may have a topic or service, by its name here.
            ``None``: trust is off, and each may have all.
    """

    name = "answers"

    def __init__(
        self,
        gateway: str,
        own: SiteGateway,
        sites: SiteNeighbour,
        history: SiteHistory,
        endpoints: Callable[[], tuple[str, ...]],
        ask_param: Callable[[str, str, str, str, dict[str, Any]], Awaitable[object]],
        why: SiteWhy,
        may: Callable[[str, Access, str], bool] | None = None,
    ) -> None:
        self._gateway = gateway
        self._own = own
        self._sites = sites
        self._history = history
        self._endpoints = endpoints
        self._ask_param = ask_param
        self._why = why
        self._may = may

    async def close(self) -> None:
        """Answer other gateways no more."""
        self._why.close()

    async def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Any:
        """The reply to one question of ``observe.operations``; raises as that says."""
        if what == REPORT:
            return self._report(self._site_names(), asker, sources=False)
        if what == WHY:
            name, site, module = (str(args.get(key) or "") for key in ("name", "site", "module"))
            return await self._why.ways(name, site, module, asker, service=args.get("service") is True)
        site = str(args.get("site", ""))
        if what == INFO:
            known = self._site_names()
            # Of a site that is not known the names of all are the answer.
            return self._report([site] if site in known else known, asker, sources=site in known)
        module = str(args.get("module", ""))
        for name in (site, module):
            if peer_name_problem(name) is not None:
                raise RemoteProtocolError(f"{name[:80]!r} is not the name of a site or a module")
        self._require(site)
        if what == PARAM:
            return await self._ask_param(asker, site, module, str(args.get("what", "")), args)
        raise RemoteProtocolError(f"{what[:80]!r} is no question about sites")

    def _tells(self, asker: str, kind: SourceKind, name: str) -> bool:
        """Whether a module of this site is told of a topic or service that has this name here."""
        return self._may is None or self._may(asker, ACCESS[kind], name)

    def _owns(self, asker: str, module: str) -> bool:
        """Whether what a module of this site has is told by this gateway: the others it asks itself."""
        return self._may is None or asker in ("", module)

    # --- what is there ----------------------------------------------------------------------------------------------

    def _site_names(self) -> list[str]:
        others = {*self._sites.catalogue.sites, *self._history.away} - {self._own.site}
        return [self._own.site, *sorted(others)]

    def _require(self, site: str) -> None:
        if site == self._own.site or site in self._sites.catalogue.sites:
            return
        ago = self._history.since_ago(site)
        if ago is not None:
            raise RmpaError(f"site {site} is unreachable since {ago:.0f} s; `rmpa site list` shows all")
        known = ", ".join(self._sites.catalogue.sites) or "none"
        raise UnreachableError(f"site {site!r}", "any Zenoh router that this gateway reaches", f"known are: {known}")

    def _report(self, names: list[str], asker: str, *, sources: bool) -> SitesReport:
        return SitesReport(
            gateway=self._gateway,
            site=self._own.site,
            leads=self._sites.leads,
            rank=self._own.rank,
            problem="" if self._endpoints() else "it is connected to no other Zenoh session",
            endpoints=self._endpoints(),
            sites=tuple(
                self._this_site(asker, sources=sources)
                if name == self._own.site
                else self._other(name, asker, sources=sources)
                for name in names
            ),
        )

    def _this_site(self, asker: str, *, sources: bool) -> SiteInfo:
        exports = self._sites.exports
        modules: dict[tuple[str, str], list[int]] = {}
        for source in exports.sources:
            counts = modules.setdefault((source.module, source.instance), [0, 0])
            counts[source.kind is SourceKind.SERVICE] += self._owns(asker, source.module)
        refused = [(source, why) for source, why in exports.refusals() if self._owns(asker, source.module)]
        listed: list[SiteSourceInfo] = []
        if sources:
            offered = [(source, "") for source in exports.sources if self._owns(asker, source.module)]
            listed = [
                SiteSourceInfo(
                    kind=_KINDS[source.kind],
                    module=source.module,
                    node=source.node,
                    name=source.name,
                    type=source.type,
                    here=source.here,
                    problem=why,
                )
                for source, why in sorted([*offered, *refused], key=lambda each: (each[0].name, each[0].module))
            ]
        return SiteInfo(
            name=self._own.site,
            state="this site",
            gateways=1,
            modules=tuple(
                SiteModuleInfo(name=name, instance=run, topics=counts[0], services=counts[1], shown=sum(counts))
                for (name, run), counts in sorted(modules.items())
            ),
            sources=tuple(listed[: limits.SITE_REPORT_SOURCES_MAX]),
            not_shown=len(refused),
        )

    def _other(self, site: str, asker: str, *, sources: bool) -> SiteInfo:
        catalogue = self._sites.catalogue
        if site not in catalogue.sites:
            return SiteInfo(name=site, state="unreachable", since_ago=self._history.since_ago(site))
        refused = {
            (source.kind, source.module, source.node, source.name): why
            for source, why in self._sites.imports.refusals()
            if source.module.site == site and self._tells(asker, source.kind, source.name)
        }
        modules, listed = [], []
        for module in catalogue.modules(site):
            each = self._module(module, asker, refused)
            modules.append(_counted(module, each))
            listed += each
        gateways = catalogue.gateways(site)
        return SiteInfo(
            name=site,
            state="joined" if gateways else "no gateway",
            since_ago=self._history.since_ago(site),
            gateways=len(gateways),
            modules=tuple(modules),
            sources=tuple(listed[: limits.SITE_REPORT_SOURCES_MAX]) if sources else (),
            not_shown=len(refused),
            beyond=catalogue.refused(site),
        )

    def _module(
        self, module: SiteModule, asker: str, refused: dict[tuple[SourceKind, SiteModule, str, str], str]
    ) -> list[SiteSourceInfo]:
        found = []
        for source in self._sites.catalogue.sources(module):
            entry = self._sites.imports.entry(source)
            if not self._tells(asker, source.kind, entry.source.name if entry is not None else source.name):
                continue
            found.append(
                SiteSourceInfo(
                    kind=_KINDS[source.kind],
                    module=module.name,
                    node=source.node,
                    name=source.name,
                    type=source.type,
                    here=entry.source.name if entry is not None and self._sites.leads else "",
                    problem=refused.get((source.kind, module, source.node, source.name), ""),
                )
            )
        return found


def _counted(module: SiteModule, sources: list[SiteSourceInfo]) -> SiteModuleInfo:
    services = sum(source.kind == "service" for source in sources)
    return SiteModuleInfo(
        name=module.name,
        instance=module.instance,
        topics=len(sources) - services,
        services=services,
        shown=sum(bool(source.here) for source in sources),
    )


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
