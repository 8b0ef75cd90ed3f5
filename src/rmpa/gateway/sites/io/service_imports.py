"""Puts the services of other sites into the gateway's graph, and calls them."""

from __future__ import annotations

import asyncio
import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.attachment import SiteAttachment
from rmpa.gateway.sites.part import SitePart
from rmpa.gateway.sites.services import DESCRIPTION, NO_MD5, read_description, unanswered
from rmpa.gateway.zenoh_api import ZenohPriority

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.graph.foreign_service import ProxiedService
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.neighbour import ForeignSource
    from rmpa.gateway.sites.keys import SiteSource
    from rmpa.gateway.sites.part import SiteImport
    from rmpa.gateway.zenoh.session import OpenSession
    from rmpa.ros.wire.tcpros import ServiceDescription


@dataclass(slots=True, eq=False)
class _Imported:
    """One service of another site."""

    source: SiteSource
    foreign: ForeignSource
    gone: asyncio.Event = field(default_factory=asyncio.Event)
    service: ProxiedService | None = None
    description: ServiceDescription | None = None
    calls: int = 0
    failed: int = 0
    problem: str = ""

    def report(self) -> dict[str, object]:
        return {
            "site": self.source.module.site,
            "module": self.source.module.name,
            "node": self.source.node,
            "name": self.source.name,
            "here": self.foreign.name,
            "type": self.description.type if self.description is not None else self.source.type,
            "calls": self.calls,
            "failed": self.failed,
            "problem": (self.service.problem if self.service is not None else "") or self.problem,
        }


class SiteServiceImports(SitePart):
    """The services of other sites in the gateway's graph: a ``SitePart``.

    Args:
        site: This site's name.
        session: The Zenoh session.
        graph: The gateway's graph.
        timeout: Seconds that a call may take, by the service's name in the gateway's graph (``[[service]]``).
        stamp: The wall clock, nanoseconds since 1970.
    """

    name = "services"

    def __init__(
        self,
        site: str,
        session: OpenSession,
        graph: AgentGraph,
        timeout: Callable[[str], float],
        stamp: Callable[[], int],
    ) -> None:
        self._site = site
        self._session = session
        self._graph = graph
        self._timeout = timeout
        self._stamp = stamp
        self._numbers = itertools.count(1)
        self._imported: dict[ForeignSource, _Imported] = {}

    def show(self, entry: SiteImport) -> None:
        """Show a service."""
        foreign = entry.source
        self._hide(foreign)
        if foreign.kind is SourceKind.SERVICE:
            made = self._imported[foreign] = _Imported(entry.announced, foreign)
            made.service = self._graph.show_service(
                foreign, lambda request: self._call(made, request), lambda: self._describe(made)
            )

    def renew(self, old: SiteImport, new: SiteImport) -> None:
        """A service is of another run of its module: calls under way end with an error, and its type is unknown."""
        if old.source != new.source:
            self._hide(old.source)
        entry = self._imported.get(new.source)
        if entry is None:
            self.show(new)
            return
        entry.gone.set()
        entry.source, entry.description, entry.gone = new.announced, None, asyncio.Event()

    def hide(self, entry: SiteImport) -> None:
        """Take a service back; calls under way end with an error at once."""
        self._hide(entry.source)

    async def close(self) -> None:
        """Take all services back."""
        for foreign in list(self._imported):
            self._hide(foreign)

    def report(self) -> dict[str, object]:
        """What ``rmpa why`` is answered from, as JSON values."""
        return {"in": [entry.report() for entry in self._imported.values()]}

    # --- inside ---------------------------------------------------------------------------------------------------

    def _hide(self, foreign: ForeignSource) -> None:
        entry = self._imported.pop(foreign, None)
        if entry is not None:
            entry.gone.set()
            if entry.service is not None:
                entry.service.close()

    async def _call(self, entry: _Imported, request: bytes) -> bytes:
        """Call the service.

        Raises:
            PeerRefused: Its server, or its site's gateway, answered with an error; the reason is its text.
            UnreachableError: No answer came.
        """
        entry.calls += 1
        try:
            md5 = entry.description.md5sum if entry.description is not None else NO_MD5
            timeout = self._timeout(entry.foreign.name)
            return await self._ask(entry, "", request, md5, timeout)
        except (PeerRefused, UnreachableError) as error:
            entry.failed += 1
            entry.problem = error.reason if isinstance(error, PeerRefused) else str(error)
            raise

    async def _describe(self, entry: _Imported) -> ServiceDescription:
        """Ask for the type; raises as ``_call``, and ``RemoteProtocolError`` for a reply that is none."""
        reply = await self._ask(entry, f"?{DESCRIPTION}", b"", NO_MD5, limits.DESCRIBE_TIMEOUT)
        entry.description = read_description(reply)
        return entry.description

    async def _ask(self, entry: _Imported, parameters: str, request: bytes, md5: str, within: float) -> bytes:
        source, loop = entry.source, asyncio.get_running_loop()
        module, site = source.module.name, source.module.site
        call = SiteAttachment(next(self._numbers), self._stamp(), md5, source.node, (self._site,))
        began = loop.time()
        asking = loop.create_task(
            self._session.get(
                source.key() + parameters,
                request,
                call.serialize(),
                timeout=within + limits.SITE_CALL_GRACE,
                priority=ZenohPriority.INTERACTIVE_HIGH,
            )
        )
        leaving = loop.create_task(entry.gone.wait())  # of the run that is called, not of the next
        try:
            await asyncio.wait((asking, leaving), return_when=asyncio.FIRST_COMPLETED)
            replies = asking.result() if asking.done() else []
        finally:
            for task in (asking, leaving):
                task.cancel()
            await asyncio.gather(asking, leaving, return_exceptions=True)
        for reply in sorted(replies, key=lambda each: not each.ok):
            if reply.ok:
                return reply.payload
            raise PeerRefused(f"{module} at site {site}", reply.payload.decode(errors="replace"))
        text = unanswered(source.name, module, site, loop.time() - began, within)
        raise PeerRefused(f"site {site}", text)
