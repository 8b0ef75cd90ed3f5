"""The neighbour "other sites": what crosses between this site and others that one network of Zenoh joins."""

from __future__ import annotations

import logging
import time
from typing import TYPE_CHECKING

import rmpa
from rmpa.core.log import RefusalLog, logged_failure
from rmpa.core.timers import earliest
from rmpa.gateway import limits
from rmpa.gateway.rules import ForeignSource, MeshSource, SourceKind
from rmpa.gateway.sites.catalogue import Leader, SiteCatalogue
from rmpa.gateway.sites.keys import ANY_GATEWAY, ROOT, SiteGateway, SiteModule, token_keys
from rmpa.gateway.sites.plans import SiteExport, SiteExports, SiteImport, SiteImports
from rmpa.gateway.sites.services import ImportedService, SiteActions, SiteServices
from rmpa.gateway.sites.topics import ImportedTopic, SiteContext, SiteTopics
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.zenoh.session import Declaration

_log = logging.getLogger(__name__)


class SiteNeighbour:
    """Joins other sites: a ``Neighbour``.

    While this gateway leads its site it does what the plans say; else it follows only, ready to lead.

    Args:
        context: What is shared with topics and services.
        own: This gateway: its site, rank and run.

    Attributes:
        catalogue: What the other sites have.
        exports: What this site offers.
        imports: What is shown of the other sites.
        imported: What runs for it, by what is shown and the name there: a rule may give several topics one name.
        leads: Whether this gateway is the one of its site that exports and imports.
        questions: Declare what it answers while it leads.
    """

    # More than twelve fields: it is the one place that knows the machines and the parts.

    def __init__(self, context: SiteContext, own: SiteGateway) -> None:
        self.context = context
        self.own = own
        self.exports = SiteExports(own.site, context.rules, self._own_changed)
        self.imports = SiteImports(context.rules, self._import_changed)
        self.catalogue = SiteCatalogue(own.site, self.imports, self._site_seen, context.counters)
        self.topics = SiteTopics(context)
        self.services = SiteServices(context)
        self.imported: dict[tuple[ForeignSource, str], ImportedTopic | ImportedService] = {}
        self.leads = False
        self.questions: list[Callable[[], Declaration]] = list(self.topics.questions)
        self._actions = SiteActions(context.graph)
        self._leader = Leader(own, limits.LEADER_PATIENCE, time.monotonic())
        self._tokens: dict[str, Declaration] = {}
        self._declared: list[Declaration] = []
        self._answering: list[Declaration] = []
        self._refusals = RefusalLog(_log, context.counters)
        self._timer = MachineTimer(self._next_timer, self._handle_timer)
        self._closed = False

    def start(self) -> None:
        """Announce this gateway, and begin to follow the graph and the other sites."""
        session = self.context.session
        self._declared = [session.watch_tokens(key, self._on_token) for key in token_keys(self.own.site)]
        self._declared.append(session.watch_tokens(ANY_GATEWAY, self._on_gateway))
        self._declared.append(session.token(self.own.token()))
        self.context.graph.watch(self._on_source)
        self._timer.arm()

    async def close(self) -> None:
        """Take back everything."""
        if self._closed:
            return
        self._closed = True
        self._timer.close()
        self._rest()
        await self.topics.close()
        await self.services.close()
        for declared in self._declared:
            declared.close()

    def report(self) -> dict[str, object]:
        """Which sites are there, as JSON values."""
        return {"sites": self.catalogue.sites, "leads": self.leads}

    def _on_token(self, key: str, alive: bool) -> None:
        if self._closed:
            return
        now = time.monotonic()
        item = self.catalogue.token(key, now, alive=alive)
        if isinstance(item, SiteGateway):
            (self._leader.seen if alive else self._leader.gone)(item, now)
        self._follow()

    def _on_gateway(self, key: str, alive: bool) -> None:
        """Tell of a gateway whose keys this one does not read, as it will never be a site here."""
        parts = key.split("/")
        theirs, site = "/".join(parts[:2]), parts[2][: limits.SITE_NAME_MAX]
        if alive and theirs != ROOT and not self._closed:
            text = f"the gateway of site {site} speaks {theirs[:20]}, we speak {ROOT} (rmpa {rmpa.__version__})"
            remedy = "install the same release of rmpa on both"
            self._refusals.refuse(time.monotonic(), "site.other_release", site, f"{text}: {remedy}")

    def _on_source(self, source: MeshSource, there: bool) -> None:
        if not self._closed:
            self.exports.changed(source, there=there)
            self.imports.own_changed(source, there=there)

    def _next_timer(self) -> float | None:
        return earliest(self.catalogue.next_timer(), self._leader.next_timer())

    def _handle_timer(self, now: float) -> None:
        self.catalogue.handle_timer(now)
        self._leader.handle_timer(now)
        self._follow()

    def _follow(self) -> None:
        """Lead or rest."""
        if self._leader.leads and not self.leads:
            self._lead()
        elif self.leads and not self._leader.leads:
            _log.info("= another gateway of site %s leads now", self.own.site)
            self._rest()
        self._timer.arm()

    def _site_seen(self, site: str, there: bool) -> None:
        if there:
            _log.info("= site %s is joined", site)
            self.exports.sites_seen(self.catalogue.sites)
        else:
            _log.warning("! site %s is unreachable; `rmpa site list` shows all [site-unreachable]", site)

    def _lead(self) -> None:
        _log.info("= this gateway leads site %s", self.own.site)
        self.leads = True
        self._answering = [declare() for declare in self.questions]
        items: list[SiteModule | SiteExport] = [*self.exports.modules, *self.exports.entries]
        for item in items:
            self._own_changed(item, there=True)
        for shown in self.imports.entries:
            self._import_changed(None, shown)

    def _rest(self) -> None:
        if self.leads:
            for shown in self.imports.entries:
                self._import_changed(shown, None)
            items: list[SiteModule | SiteExport] = [*self.exports.entries, *self.exports.modules]
            for item in items:
                self._own_changed(item, there=False)
            self.leads = False
            for declared in self._answering:
                declared.close()

    def _own_changed(self, item: SiteModule | SiteExport, there: bool) -> None:
        if not self.leads:
            return
        with logged_failure(_log, "%s failed; the other changes are made", item):
            token = (item if isinstance(item, SiteModule) else item.announced).token()
            if not there:
                self._tokens.pop(token).close()
            if not isinstance(item, SiteModule):
                topic = item.source.kind is SourceKind.TOPIC
                part = self.topics if topic else self.services
                (part.export if there else part.withdraw)(item)
                if topic:
                    self._actions.client(item.source, there=there)
            if there:
                self._tokens[token] = self.context.session.token(token)

    def _import_changed(self, old: SiteImport | None, new: SiteImport | None) -> None:
        entry = new or old
        if not self.leads or entry is None:
            return
        with logged_failure(_log, "%s failed; the other changes are made", entry):
            source, key = entry.source, (entry.source, entry.announced.name)
            topic = source.kind is SourceKind.TOPIC
            if old is not None and new is not None:
                self.imported[key].renew(new)
                return
            if new is None:
                self.imported.pop(key).close()
            else:
                self.imported[key] = ImportedTopic(new, self.topics) if topic else ImportedService(new, self.context)
            if topic:
                self._actions.server(source, there=new is not None)
