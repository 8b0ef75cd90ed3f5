"""The part of the neighbour "other sites" for services."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.io.service_exports import SiteServiceExports
from rmpa.gateway.sites.io.service_imports import SiteServiceImports
from rmpa.gateway.sites.part import SitePart

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.sites.part import SiteExport, SiteImport
    from rmpa.gateway.zenoh.session import OpenSession


class SiteServices(SitePart):
    """Services between sites: a ``SitePart``.

    Args:
        site: This site's name.
        session: The Zenoh session.
        graph: The gateway's graph.
        timeout: Seconds that a call may take, by the service's name in the gateway's graph (``[[service]]``).
        why_not: ``(site, source)``: why a site may not call a service of this one; empty if it may.
        stamp: The wall clock, nanoseconds since 1970.
    """

    name = "services"

    def __init__(
        self,
        site: str,
        session: OpenSession,
        graph: AgentGraph,
        timeout: Callable[[str], float],
        why_not: Callable[[str, MeshSource], str],
        stamp: Callable[[], int],
    ) -> None:
        self._exports = SiteServiceExports(site, session, graph, timeout, why_not)
        self._imports = SiteServiceImports(site, session, graph, timeout, stamp)

    def export(self, entry: SiteExport) -> None:
        """Let other sites call a service."""
        if entry.source.kind is SourceKind.SERVICE:
            self._exports.export(entry.source, entry.announced.to)

    def withdraw(self, entry: SiteExport) -> None:
        """Take it back; calls under way end as the server lets them."""
        if entry.source.kind is SourceKind.SERVICE:
            self._exports.withdraw(entry.source, entry.announced.to)

    def show(self, entry: SiteImport) -> None:
        """Put a service of another site into the graph."""
        if entry.source.kind is SourceKind.SERVICE:
            self._imports.show(entry.source, entry.announced)

    def renew(self, old: SiteImport, new: SiteImport) -> None:
        """The service is of another run of its module."""
        if new.source.kind is not SourceKind.SERVICE:
            return
        if old.source != new.source:
            self._imports.hide(old.source)
        self._imports.renew(new.source, new.announced)

    def hide(self, entry: SiteImport) -> None:
        """Take it out of the graph; calls under way end with an error."""
        if entry.source.kind is SourceKind.SERVICE:
            self._imports.hide(entry.source)

    def report(self) -> dict[str, object]:
        """The services that go out and come in, with their calls."""
        return {"out": self._exports.report(), "in": self._imports.report()}

    async def close(self) -> None:
        """End all calls."""
        self._imports.close()
        await self._exports.close()
