"""Answers ``rmpa site``, ``rmpa param`` and ``rmpa why`` about other sites, to this machine and to linked modules."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from rmpa.core.errors import RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.identity import peer_name_problem
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.io.site_why import ACCESS
from rmpa.gateway.sites.part import SitePart
from rmpa.observe.io.site_requests import INFO, PARAM, REPORT, WHY
from rmpa.observe.sites import SiteInfo, SiteModuleInfo, SiteSourceInfo, SitesReport

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.config.peer_rules import Access
    from rmpa.gateway.sites.history import SiteHistory
    from rmpa.gateway.sites.io.neighbour import SiteNeighbour
    from rmpa.gateway.sites.io.site_why import SiteWhy
    from rmpa.gateway.sites.keys import SiteGateway, SiteModule

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
        """The reply to one question of ``observe.io.site_requests``; raises as that says."""
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
