"""ROS 2 in the answers of a gateway: ``rmpa why``, ``rmpa site list`` and ``rmpa site info ros2``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

from rmpa.config.peer_rules import Access
from rmpa.core.errors import UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.ros2.crossing import SITE
from rmpa.observe.io.site_requests import INFO, REPORT, WHY
from rmpa.observe.sites import SiteInfo, SiteSourceInfo, SitesReport

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.gateway.ros2.io.neighbour import Ros2Neighbour
    from rmpa.observe.io.site_requests import SiteAnswerer
    from rmpa.observe.why.diagnosis import Diagnosis


class Ros2Answers:
    """Answers questions about ROS 2, and has those about other sites answered.

    Args:
        name: The gateway's name among its peers.
        neighbour: ROS 2.
        endpoints: Returns the Zenoh endpoints that the session is connected to.
        sites: Answers for the other sites; ``None``: the gateway joins none.
        may: ``(asker, access, name)``: whether a linked module may have a topic or service, by its name here.
    """

    def __init__(
        self,
        name: str,
        neighbour: Ros2Neighbour,
        endpoints: Callable[[], tuple[str, ...]],
        sites: SiteAnswerer | None = None,
        may: Callable[[str, Access, str], bool] = lambda _asker, _access, _name: True,
    ) -> None:
        self._name = name
        self._neighbour = neighbour
        self._endpoints = endpoints
        self._sites = sites
        self._may = may

    async def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Any:
        """The reply to one question of ``observe.io.site_requests``; raises as that says."""
        site = str(args.get("site") or "")
        if what == WHY:
            name, module = (str(args.get(key) or "") for key in ("name", "module"))
            ways: list[Diagnosis] = []
            if self._tells(asker, "topic", name) or self._tells(asker, "service", name):
                ways = await self._neighbour.ways(name, site, module, asker, service=args.get("service") is True)
            return [*ways, *(await self._sites.answer(what, args, asker) if self._sites is not None else ())]
        if what == REPORT or (what == INFO and site == SITE):
            report = await self._report_of_sites(asker)
            if what == INFO:
                return msgspec.structs.replace(report, sites=(self._site(asker, sources=True),))
            return msgspec.structs.replace(report, sites=(*report.sites, self._site(asker, sources=False)))
        if self._sites is None:
            raise UnreachableError(f"site {site!r}", "this gateway", f"it joins {SITE} alone")
        return await self._sites.answer(what, args, asker)

    def _tells(self, asker: str, kind: str, name: str) -> bool:
        """Whether a module is told of a topic or service that has this name here."""
        return self._may(asker, Access.CALL if kind == "service" else Access.SUBSCRIBE, name)

    async def _report_of_sites(self, asker: str) -> SitesReport:
        if self._sites is not None:
            found: SitesReport = await self._sites.answer(REPORT, {}, asker)
            return found
        endpoints = self._endpoints()
        problem = "" if endpoints else "it is connected to no other Zenoh session"
        return SitesReport(gateway=self._name, site="", leads=True, problem=problem, endpoints=endpoints)

    def _site(self, asker: str, *, sources: bool) -> SiteInfo:
        report = self._neighbour.report()
        every = list(_sources(report)) if sources else []
        listed = [source for source in every if self._tells(asker, source.kind, source.here or source.name)]
        refused = report.get("topics_refused")
        return SiteInfo(
            name=SITE,
            state="joined",
            gateways=1,
            sources=tuple(listed[: limits.SITE_REPORT_SOURCES_MAX]),
            not_shown=len(refused) if isinstance(refused, dict) else 0,
            beyond=max(0, len(listed) - limits.SITE_REPORT_SOURCES_MAX),
        )


def _sources(report: Mapping[str, Any]) -> Iterator[SiteSourceInfo]:
    """What ROS 2 has, with what is wrong with it; then problems of what the modules have."""
    for row in report.get("topics", ()):
        if row["direction"] == "in":
            shown = {key: row[key] for key in ("node", "type", "here", "problem")}
            yield SiteSourceInfo(kind="topic", module="", name=row["topic"], **shown)
    for name, kind in report.get("services_in", {}).items():
        yield SiteSourceInfo(kind="service", module="", node="", name=name, type=kind, here=name)
    for what, text in report.get("problems", {}).items():
        name, _, node = what.partition(" of ")
        yield SiteSourceInfo(kind="topic", module="", node=node, name=name, problem=text)
