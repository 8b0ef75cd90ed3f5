"""The neighbour "other sites": what crosses between this site and others that one network of Zenoh joins."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.core.counters import earliest, logged_failure
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.sites.catalogue import CatalogueChange, Leader, SiteCatalogue
from rmpa.gateway.sites.keys import GATEWAY, SiteGateway, SiteModule, SiteSource, parse_token, token_keys
from rmpa.gateway.sites.plans import SiteExports, SiteImports, refusals_report, site_counts, sites_report
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.core.counters import Counters
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.sites.catalogue import CrossingRules
    from rmpa.gateway.sites.plans import SiteExport, SitePart
    from rmpa.gateway.zenoh.session import Declaration, OpenSession

_log = logging.getLogger(__name__)


class SiteNeighbour:
    """Joins other sites: a ``Neighbour``.

    Args:
        graph: The gateway's graph.
        session: The Zenoh session.
        own: This gateway: its site, rank and run.
        rules: Decide what may cross.
        parts: Carry topics, services and so on.
        counters: As of ``SiteCatalogue``.
    """

    def __init__(
        self,
        graph: AgentGraph,
        session: OpenSession,
        own: SiteGateway,
        rules: CrossingRules,
        parts: Sequence[SitePart],
        counters: Counters | None = None,
    ) -> None:
        self._graph = graph
        self._session = session
        self._own = own
        self._parts = tuple(parts)
        self.catalogue = SiteCatalogue(own.site, counters)
        """What the other sites have."""
        self.exports = SiteExports(own.site, rules)
        """What this site offers."""
        self.imports = SiteImports(rules)
        """What is shown of the other sites."""
        self.on_sites: Callable[[tuple[str, ...]], None] = lambda _: None
        """Called with the names of the other sites, after each change of them."""
        self.on_site_source: Callable[[SiteSource, bool], None] = lambda _source, _there: None
        """Called when another site announces or withdraws a source; not for those that go together with the site."""
        self.on_leads: Callable[[bool], None] = lambda _: None
        """Called when this gateway begins to lead its site, and when it ends."""
        self._leader: Leader | None = None
        self._active = False
        self._sites: tuple[str, ...] = ()
        self._tokens: dict[str, Declaration] = {}
        self._declared: list[Declaration] = []
        self._timer = MachineTimer(self._next_timer, self._handle_timer)
        self._closed = False

    def add(self, part: SitePart) -> None:
        """Add a part that needs this neighbour, before ``start()``."""
        self._parts = (*self._parts, part)

    @property
    def leads(self) -> bool:
        """Whether this gateway is the one of its site that exports and imports."""
        return self._active

    def start(self) -> None:
        """Announce this gateway, and begin to follow the graph and the other sites."""
        self._leader = Leader(self._own, limits.LEADER_PATIENCE, self._now())
        for key in token_keys(self._own.site):
            self._declared.append(self._session.watch_tokens(key, self._on_token))
        self._declared.append(self._session.token(self._own.token()))
        self._graph.watch(self._on_source)
        self._timer.arm()

    async def close(self) -> None:
        """Take back everything."""
        if self._closed:
            return
        self._closed = True
        self._timer.close()
        self._rest()
        for part in self._parts:
            await part.close()
        for declared in self._declared:
            declared.close()

    def report(self) -> dict[str, object]:
        """Sites, modules, what crosses and what does not, as JSON values."""
        parts: dict[str, dict[str, object]] = {}
        for part in self._parts:
            parts.setdefault(part.name, {}).update(part.report())
        return {
            "site": self._own.site,
            "sites": sites_report(self.catalogue, self.imports),
            "refused": refusals_report(self.exports, self.imports),
            "counters": site_counts(self.catalogue.counters),
            "parts": parts,
        }

    # --- changes --------------------------------------------------------------------------------------------------

    @staticmethod
    def _now() -> float:
        return asyncio.get_running_loop().time()

    def _on_token(self, key: str, alive: bool) -> None:
        if self._closed:
            return
        now = self._now()
        self.catalogue.token(key, now, alive=alive)
        self._judge_leader(key, alive=alive, now=now)
        self._after(now)

    def _judge_leader(self, key: str, *, alive: bool, now: float) -> None:
        if f"/{GATEWAY}/" not in key:
            return
        try:
            item = parse_token(key)
        except RemoteProtocolError:
            return  # the catalogue has counted it
        if self._leader is not None and isinstance(item, SiteGateway):
            (self._leader.seen if alive else self._leader.gone)(item, now)

    def _on_source(self, source: MeshSource, there: bool) -> None:
        if self._closed:
            return
        self.exports.changed(source, there=there)
        self.imports.own_changed(source, there=there)
        self._act()

    def _next_timer(self) -> float | None:
        return earliest(self.catalogue.next_timer(), self._leader.next_timer() if self._leader is not None else None)

    def _handle_timer(self, now: float) -> None:
        self.catalogue.handle_timer(now)
        if self._leader is not None:
            self._leader.handle_timer(now)
        self._after(now)

    def _after(self, now: float) -> None:
        """Act on what the machines have decided."""
        del now
        for event in self.catalogue.take_events():
            item = event.item
            if isinstance(item, SiteModule):
                if event.change is not CatalogueChange.RENEWED:
                    self._act()
                    self._module_changed(item, there=event.change is CatalogueChange.FOUND)
            elif event.change is CatalogueChange.FOUND:
                self.imports.found(item)
                self.on_site_source(item, True)
            elif event.change is CatalogueChange.RENEWED:
                self.imports.renewed(item)
            else:
                self.imports.gone(item)
                if item.module.site in self.catalogue.sites:
                    self.on_site_source(item, False)
        leads = self._leader is not None and self._leader.leads
        if leads and not self._active:
            self._lead()
        elif self._active and not leads:
            _log.info("= another gateway of site %s leads now", self._own.site)
            self._rest()
        if (sites := self.catalogue.sites) != self._sites:
            self._tell_sites(sites)
        self._act()
        self._timer.arm()

    def _tell_sites(self, there: tuple[str, ...]) -> None:
        """Tell which sites have come, and which have gone."""
        for site in there:
            if site not in self._sites:
                _log.info("= site %s is joined", site)
        for site in self._sites:
            if site not in there:
                text = "! site %s is unreachable: its gateway has ended, or the way to it; `rmpa site list`"
                _log.warning(text, site)
        self._sites = there
        self.exports.sites_seen(there)
        self.on_sites(there)

    def _act(self) -> None:
        """Do what the plans say, or forget it while another gateway leads."""
        exports, imports = self.exports.take_changes(), self.imports.take_changes()
        if not self._active:
            return
        for change in exports:
            with logged_failure(_log, "%s failed; the other changes are made", change):
                if isinstance(change.item, SiteModule):
                    self._own_module(change.item, there=change.there)
                elif change.there:
                    self._export(change.item)
                else:
                    self._withdraw(change.item)
        for each in imports:
            for part in self._parts:
                with logged_failure(_log, "%s failed; the other changes are made", each):
                    if each.old is not None and each.new is not None:
                        part.renew(each.old, each.new)
                    elif each.new is not None:
                        part.show(each.new)
                    elif each.old is not None:
                        part.hide(each.old)

    # --- leading --------------------------------------------------------------------------------------------------

    def _lead(self) -> None:
        _log.info("= this gateway leads site %s", self._own.site)
        self._act()
        self._active = True
        self.on_leads(True)
        for module in self.exports.modules:
            self._own_module(module, there=True)
        for entry in self.exports.entries:
            self._export(entry)
        for item in self.catalogue.all():
            if isinstance(item, SiteModule):
                self._module_changed(item, there=True)
        for shown in self.imports.entries:
            for part in self._parts:
                part.show(shown)

    def _rest(self) -> None:
        if not self._active:
            return
        self._act()
        for shown in self.imports.entries:
            for part in self._parts:
                part.hide(shown)
        for item in self.catalogue.all():
            if isinstance(item, SiteModule):
                self._module_changed(item, there=False)
        for entry in self.exports.entries:
            self._withdraw(entry)
        for module in self.exports.modules:
            self._own_module(module, there=False)
        self._active = False
        self.on_leads(False)

    def _export(self, entry: SiteExport) -> None:
        for part in self._parts:
            part.export(entry)
        token = entry.announced.token()
        self._tokens[token] = self._session.token(token)

    def _withdraw(self, entry: SiteExport) -> None:
        self._tokens.pop(entry.announced.token()).close()
        for part in self._parts:
            part.withdraw(entry)

    def _own_module(self, module: SiteModule, *, there: bool) -> None:
        token = module.token()
        if there:
            self._module_changed(module, there=True)
            self._tokens[token] = self._session.token(token)
        else:
            self._tokens.pop(token).close()
            self._module_changed(module, there=False)

    def _module_changed(self, module: SiteModule, *, there: bool) -> None:
        if self._active:
            for part in self._parts:
                part.module_changed(module, there)
