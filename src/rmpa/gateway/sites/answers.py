"""The neighbour "other sites" with all that answers for it: ``rmpa site``, ``rmpa param`` and ``rmpa why``."""

from __future__ import annotations

import secrets
from typing import TYPE_CHECKING, Any

from rmpa.bridge.context import BridgeContext
from rmpa.core.errors import RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.identity import peer_name_problem
from rmpa.gateway import limits
from rmpa.gateway.rules import CrossingRules
from rmpa.gateway.sites.keys import SiteGateway
from rmpa.gateway.sites.params import SiteParams
from rmpa.gateway.sites.site import SiteNeighbour
from rmpa.gateway.sites.topics import SiteContext
from rmpa.gateway.sites.why import KINDS, SiteWhy
from rmpa.observe.operations import INFO, PARAM, REPORT, WHY
from rmpa.observe.peer_info import SiteInfo, SiteModuleInfo, SiteSourceInfo, SitesReport

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from rmpa.config.settings import Settings
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.sites.keys import SiteModule, SiteSource
    from rmpa.gateway.zenoh.session import OpenSession


class SiteAnswers:
    """Answers questions about other sites, of this machine and of linked modules: a ``SiteAnswerer``.

    Args:
        sites: The neighbour "other sites".
        params: Asks modules of other sites about parameters.
    """

    def __init__(self, sites: SiteNeighbour, params: SiteParams) -> None:
        self._sites = sites
        self._rules = sites.context.rules
        self._params = params
        self._why = SiteWhy(sites)

    async def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Any:
        """The reply to one question of ``observe.operations``; raises as that says."""
        name, site, module = (str(args.get(key) or "") for key in ("name", "site", "module"))
        others = {*self._sites.catalogue.sites, *self._sites.history.away} - {self._sites.own.site}
        known = [self._sites.own.site, *sorted(others)]
        if what == REPORT:
            return self._report(known, asker, sources=False)
        if what == WHY:
            return await self._why.ways(name, site, module, asker, service=args.get("service") is True)
        if what == INFO:
            # Of a site that is not known the names of all are the answer.
            return self._report([site] if site in known else known, asker, sources=site in known)
        for each in (site, module):
            if peer_name_problem(each) is not None:
                raise RemoteProtocolError(f"{each[:80]!r} is not the name of a site or a module")
        self._require(site)
        if what == PARAM:
            return await self._params.ask(asker, site, module, args)
        raise RemoteProtocolError(f"{what[:80]!r} is no question about sites")

    def _owns(self, asker: str, module: str) -> bool:
        """Whether what a module of this site has is told by this gateway: the others it asks itself."""
        return not self._rules.secured or asker in ("", module)

    def _require(self, site: str) -> None:
        sites = self._sites.catalogue.sites
        if site == self._sites.own.site or site in sites:
            return
        ago = self._sites.history.since_ago(site)
        if ago is not None:
            raise RmpaError(f"site {site} is unreachable since {ago:.0f} s; `rmpa site list` shows all")
        known = f"known are: {', '.join(sites) or 'none'}"
        raise UnreachableError(f"site {site!r}", "any Zenoh router that this gateway reaches", known)

    # --- what is there ----------------------------------------------------------------------------------------------

    def _report(self, names: list[str], asker: str, *, sources: bool) -> SitesReport:
        own, endpoints = self._sites.own, self._sites.context.session.endpoints
        return SitesReport(
            gateway=self._sites.context.graph.name,
            site=own.site,
            leads=self._sites.leads,
            rank=own.rank,
            problem="" if endpoints else "it is connected to no other Zenoh session",
            endpoints=endpoints,
            sites=tuple(
                (self._this_site if name == own.site else self._other)(name, asker, sources) for name in names
            ),
        )

    def _this_site(self, name: str, asker: str, sources: bool) -> SiteInfo:
        offered = [(source, "") for source, _ in self._sites.exports.offered()]
        refused = [each for each in self._sites.exports.refusals() if self._owns(asker, each[0].module)]
        told = [each for each in offered if self._owns(asker, each[0].module)]
        modules = sorted({(source.module, source.instance) for source, _ in offered})
        rows = [
            SiteSourceInfo(
                kind=KINDS[source.kind],
                module=source.module,
                node=source.node,
                name=source.name,
                type=source.type,
                here=source.here,
                problem=why,
            )
            for source, why in sorted([*told, *refused], key=lambda each: (each[0].name, each[0].module))
        ]
        return SiteInfo(
            name=name,
            state="this site",
            gateways=1,
            modules=tuple(
                _counted(module, run, [row for row in rows if row.module == module and not row.problem])
                for module, run in modules
            ),
            sources=tuple(rows[: limits.SITE_REPORT_SOURCES_MAX]) if sources else (),
            not_shown=len(refused),
        )

    def _other(self, name: str, asker: str, sources: bool) -> SiteInfo:
        catalogue = self._sites.catalogue
        if name not in catalogue.sites:
            return SiteInfo(name=name, state="unreachable", since_ago=self._sites.history.since_ago(name))
        refused = {
            source: why
            for source, why in self._sites.imports.refusals()
            if source.site == name and self._rules.tells(asker, source.kind, source.name)
        }
        rows: list[SiteSourceInfo] = []
        modules = []
        for module in catalogue.modules(name):
            each = list(self._rows(module, asker, refused))
            modules.append(_counted(module.name, module.instance, each))
            rows += each
        gateways = catalogue.gateways(name)
        return SiteInfo(
            name=name,
            state="joined" if gateways else "no gateway",
            since_ago=self._sites.history.since_ago(name),
            gateways=len(gateways),
            modules=tuple(modules),
            sources=tuple(rows[: limits.SITE_REPORT_SOURCES_MAX]) if sources else (),
            not_shown=len(refused),
            beyond=catalogue.refused(name),
        )

    def _rows(self, module: SiteModule, asker: str, refused: Mapping[SiteSource, str]) -> Iterator[SiteSourceInfo]:
        for source in self._sites.catalogue.sources(module):
            entry = self._sites.imports.entry(source)
            if self._rules.tells(asker, source.kind, entry.source.name if entry is not None else source.name):
                yield SiteSourceInfo(
                    kind=KINDS[source.kind],
                    module=module.name,
                    node=source.node,
                    name=source.name,
                    type=source.type,
                    here=entry.source.name if entry is not None and self._sites.leads else "",
                    problem=refused.get(source, ""),
                )


def _counted(name: str, instance: str, sources: list[SiteSourceInfo]) -> SiteModuleInfo:
    services = sum(source.kind == "service" for source in sources)
    return SiteModuleInfo(
        name=name,
        instance=instance,
        topics=len(sources) - services,
        services=services,
        shown=sum(bool(source.here) for source in sources),
    )


def make_site_neighbour(graph: AgentGraph, session: OpenSession, settings: Settings) -> SiteNeighbour:
    """Make the neighbour "other sites"; it is not started. ``settings.gateway.site`` is not empty."""
    gateway, agent = settings.gateway, graph.agent
    bridge = BridgeContext.of(settings)
    rules = CrossingRules(gateway.rules, bridge, agent.bridge.gate)
    context = SiteContext(
        gateway.site, graph, session, rules, bridge, settings.make_contracts(), agent.bridge.counters
    )
    neighbour = SiteNeighbour(context, SiteGateway(gateway.site, gateway.rank, secrets.token_hex(16)))

    async def ask_module(module: str, what: str, args: dict[str, Any]) -> object:
        for peer in agent.bridge.sessions.linked():
            if peer.link.name == module:
                return await agent.bridge.rpc.request(peer, what, args, limits.SITE_PARAM_TIMEOUT)
        where = f"site {gateway.site} as {module!r}"
        raise UnreachableError("module", where, "`rmpa peer list` there shows which are linked to its gateway")

    params = SiteParams(context, ask_module)
    neighbour.on_leads = lambda leads: params.lead(leads=leads)
    neighbour.closing.append(params.close)
    agent.sites.serve(SiteAnswers(neighbour, params))
    return neighbour
