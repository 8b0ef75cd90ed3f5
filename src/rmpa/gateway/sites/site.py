"""The neighbour "other sites": the plans of what is offered to them and shown of them, and what carries these out."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import rmpa
from rmpa.core.identity import is_type_name
from rmpa.core.log import RefusalLog, logged_failure
from rmpa.core.timers import earliest
from rmpa.gateway import limits
from rmpa.gateway.rules import ForeignSource, SourceKind
from rmpa.gateway.sites.catalogue import Leader, SiteCatalogue
from rmpa.gateway.sites.keys import (
    ANY_GATEWAY,
    ROOT,
    UNKNOWN_TYPE,
    SiteGateway,
    SiteModule,
    SiteSource,
    token_keys,
)
from rmpa.gateway.sites.services import ImportedService, SiteActions, SiteServices
from rmpa.gateway.sites.topics import ImportedTopic, SiteTopics
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from rmpa.gateway.rules import CrossingRules, MeshSource, SourceKey
    from rmpa.gateway.sites.topics import SiteContext
    from rmpa.gateway.zenoh.session import Declaration

_log = logging.getLogger(__name__)

# Bytes of a node's name in an attachment.
_NODE_NAME_MAX: Final = 255


@dataclass(frozen=True, slots=True)
class SiteExport:
    """A source of this site that other sites may have.

    Args:
        source: The source in the gateway's graph.
        announced: What its token says of it; ``announced.key()`` is the key of its messages or calls. A source that
            is offered to some sites alone has an export for each of them, which ``announced.to`` names.
        rate: Messages a second that cross at most; ``None``: no limit.
        size: Bytes a second that cross at most; ``None``: no limit.
    """

    source: MeshSource
    announced: SiteSource
    rate: float | None = None
    size: int | None = None


@dataclass(frozen=True, slots=True)
class SiteImport:
    """A source of another site that is shown here.

    Args:
        source: The source in the gateway's graph, under its name here.
        announced: What its token says of it; another run of the module makes another one.
        why: The rule that lets it come in.
    """

    source: ForeignSource
    announced: SiteSource
    why: str = ""


class SiteExports:
    """Plans what this site offers: each source once to all sites, or once to each site that the rules let have it.

    Args:
        site: This site's name.
        rules: Decide what may cross.
        changed: ``(item, there)``: a module or a source is to be announced, or withdrawn; a module before its
            sources, and after them.

    Attributes:
        modules: The modules that offer something, with the number of exports.
    """

    def __init__(
        self, site: str, rules: CrossingRules, changed: Callable[[SiteModule | SiteExport, bool], None]
    ) -> None:
        self._site = site
        self._rules = rules
        self._changed = changed
        self._sources: dict[SourceKey, MeshSource] = {}
        # By the site that it is for; empty: for all.
        self._entries: dict[SourceKey, dict[str, SiteExport]] = {}
        # The other sites that were ever there: a site that is away for a while keeps what is addressed to it.
        self._sites: dict[str, None] = {}
        self._addressed: set[SourceKey] = set()
        self._announced: set[SiteSource] = set()
        self._refused: dict[SourceKey, str] = {}
        # Of what is refused: what may be offered once something else has gone.
        self._crowded: dict[SourceKey, None] = {}
        self.modules: dict[SiteModule, int] = {}

    @property
    def entries(self) -> list[SiteExport]:
        """What is offered; a source that is addressed to several sites is there for each of them."""
        return [entry for entries in self._entries.values() for entry in entries.values()]

    def judged(self) -> Iterator[tuple[MeshSource, list[SiteExport], str]]:
        """Each source of this site with its exports, and why it stays home; empty for no reason."""
        for key, source in self._sources.items():
            yield source, list(self._entries.get(key, {}).values()), self._refused.get(key, "")

    def changed(self, source: MeshSource, *, there: bool) -> None:
        """A source of this site came, changed (another type, run or module under the same name and proxy) or went."""
        key = (source.kind, source.here, source.proxy)
        known = self._sources.pop(key, None) is not None
        if there:
            self._sources[key] = source
        self._judge(key)
        if known and not there:
            for waiting in list(self._crowded):
                self._judge(waiting)

    def sites_seen(self, there: Iterable[str]) -> None:
        """These other sites are there now: sources that are not for all are offered to those that may have them."""
        there = dict.fromkeys(there)
        if there.keys() <= self._sites.keys():
            return
        self._sites |= there
        if len(self._sites) > limits.SITES_REMEMBERED_MAX:
            self._sites = there
        for key in tuple(self._addressed):
            self._judge(key)

    def _judge(self, key: SourceKey) -> None:
        """Offer a source to all that may have it, and to no others."""
        wanted = self._wanted(key)
        for site, entry in tuple(self._entries.get(key, {}).items()):
            if wanted.get(site) != entry:
                self._withdraw(key, site)
        for site, entry in wanted.items():
            if site not in self._entries.get(key, ()):
                self._offer(key, site, entry)

    def _wanted(self, key: SourceKey) -> dict[str, SiteExport]:
        """The exports of a source by the site that each is for; why there are none is remembered."""
        self._refused.pop(key, None)
        self._crowded.pop(key, None)
        self._addressed.discard(key)
        source = self._sources.get(key)
        if source is None:
            return {}
        decision = self._rules.outgoing(source)
        decisions = {"": decision} if decision.allowed else {}
        if decision.addressed:
            self._addressed.add(key)
            judged = {site: self._rules.offered_to(site, source) for site in self._sites}
            decisions = {site: each for site, each in judged.items() if each.allowed}
            nowhere = f"{decision.why}; no site that may have it was here yet"
            decision = next(iter(judged.values()), replace(decision, why=nowhere))
        if not decisions:
            self._refused[key] = decision.why
        module = SiteModule(self._site, source.module, source.instance)
        return {
            site: SiteExport(
                source,
                SiteSource(module, source.kind, source.type, source.node, source.name, site),
                each.rate,
                each.size,
            )
            for site, each in decisions.items()
        }

    def _offer(self, key: SourceKey, site: str, entry: SiteExport) -> None:
        announced = entry.announced
        reason = _problem(announced)
        if not reason:
            if announced in self._announced:
                reason = "another proxy of the same source is offered already"
            elif len(self._announced) >= limits.SITE_SOURCES_MAX:
                reason = f"{limits.SITE_SOURCES_MAX} sources of this site are offered already"
            if reason:
                self._crowded[key] = None
        if reason:
            self._refused[key] = reason
            return
        module = announced.module
        if module not in self.modules:
            self.modules[module] = 0
            self._changed(module, True)
        self.modules[module] += 1
        self._entries.setdefault(key, {})[site] = entry
        self._announced.add(announced)
        self._changed(entry, True)

    def _withdraw(self, key: SourceKey, site: str) -> None:
        entry = self._entries[key].pop(site)
        if not self._entries[key]:
            del self._entries[key]
        self._announced.remove(entry.announced)
        self._changed(entry, False)
        module = entry.announced.module
        self.modules[module] -= 1
        if not self.modules[module]:
            del self.modules[module]
            self._changed(module, False)


def _problem(announced: SiteSource) -> str:
    """Why a source cannot be announced; empty if it can."""
    unasked = announced.kind is SourceKind.SERVICE and announced.type == UNKNOWN_TYPE
    if not unasked and not is_type_name(announced.type):
        return f"its type is not known ({announced.type!r})"
    if len(announced.node.encode()) > _NODE_NAME_MAX:
        return f"its node's name has more than {_NODE_NAME_MAX} bytes"
    if len(announced.token()) > limits.KEY_MAX:
        return f"its names and type have more than {limits.KEY_MAX} characters"
    return ""


# Site, module, kind, node, name there.
_Ident = tuple[str, str, SourceKind, str, str]
_Name = tuple[SourceKind, str]


class SiteImports:
    """Plans what is shown of other sites, and under which names.

    A source is known by site, module, kind, node and name; a new run of its module continues it. Of two sources that
    want one name here with different types (or two services of one name) the first is shown, and one of this site's
    own modules goes before all others; the reason is told for the other, which is shown once the name is free. Of one
    name only the first ``limits.SITE_NAMES_WAITING_MAX`` wait.

    Args:
        rules: Decide what may cross, and its name here.
        changed: ``(old, new)``: what was shown until now (``None``: nothing) and what is to be shown (``None``:
            nothing); with both it is the same source, to be asked anew.
    """

    def __init__(self, rules: CrossingRules, changed: Callable[[SiteImport | None, SiteImport | None], None]) -> None:
        self._rules = rules
        self._changed = changed
        self._runs: dict[_Ident, list[SiteSource]] = {}
        self._shown: dict[_Ident, SiteImport] = {}
        # Why it is not shown, and the name that it waits for.
        self._hidden: dict[_Ident, tuple[str, _Name | None]] = {}
        self._holders: dict[_Name, dict[_Ident, SiteImport]] = {}
        self._waiting: dict[_Name, dict[_Ident, None]] = {}
        self._own: dict[_Name, list[MeshSource]] = {}

    @property
    def entries(self) -> list[SiteImport]:
        """What is shown."""
        return list(self._shown.values())

    def judged(self) -> Iterator[tuple[SiteSource, SiteImport | None, str]]:
        """Each source of other sites with what is shown of it, and why nothing is."""
        for ident, runs in self._runs.items():
            yield runs[-1], self._shown.get(ident), self._hidden.get(ident, ("", None))[0]

    def outcome(self, source: SiteSource) -> tuple[SiteImport | None, str]:
        """What is shown for a source of another site, and why nothing is."""
        return self._shown.get(_ident(source)), self._hidden.get(_ident(source), ("", None))[0]

    def found(self, source: SiteSource) -> None:
        """A source of another site is there."""
        runs = self._runs.setdefault(_ident(source), [])
        if source not in runs:
            runs.append(source)
            self._judge(_ident(source))

    def renewed(self, source: SiteSource) -> None:
        """The token of a source was away for a moment."""
        shown = self._shown.get(_ident(source))
        if shown is not None and shown.announced == source:
            self._changed(shown, shown)

    def gone(self, source: SiteSource) -> None:
        """A source of another site is gone."""
        ident = _ident(source)
        runs = self._runs.get(ident, [])
        if source in runs:
            runs.remove(source)
            self._judge(ident)
            if not runs:
                del self._runs[ident]

    def own_changed(self, source: MeshSource, *, there: bool) -> None:
        """A source of this site came or went: it may be in the way of others, or no longer."""
        name = (source.kind, source.here)
        own = self._own.setdefault(name, [])
        if there and source not in own:
            own.append(source)
            for ident, entry in list(self._holders.get(name, {}).items()):
                if self._conflict(ident, entry):
                    self._judge(ident)
        elif not there and source in own:
            own.remove(source)
            self._retry(name)
        if not own:
            self._own.pop(name, None)

    def _judge(self, ident: _Ident) -> None:
        """Show, renew or hide a source by the last of its runs."""
        runs, old = self._runs[ident], self._shown.get(ident)
        _, waited_for = self._hidden.pop(ident, ("", None))
        if waited_for is not None:
            del self._waiting[waited_for][ident]
            if not self._waiting[waited_for]:
                del self._waiting[waited_for]
        new = self._plan(ident, runs[-1]) if runs else None
        if new is not None and old is not None and old.source == new.source:
            self._shown[ident] = self._holders[_name(new)][ident] = new
            if old != new:
                self._changed(old, new)
            return
        if old is not None:
            name = _name(old)
            del self._shown[ident], self._holders[name][ident]
            if not self._holders[name]:
                del self._holders[name]
            self._changed(old, None)
        if new is not None:
            self._shown[ident] = self._holders.setdefault(_name(new), {})[ident] = new
            self._changed(None, new)
        if old is not None:
            self._retry(_name(old))

    def _plan(self, ident: _Ident, announced: SiteSource) -> SiteImport | None:
        """What is to be shown of a source; ``None``: nothing, and why is remembered."""
        module, kind = announced.module, announced.kind

        def named(name: str) -> ForeignSource:
            return ForeignSource(kind, module.site, module.name, announced.node, name, announced.type)

        decision = self._rules.incoming(named(announced.name))
        if not decision.allowed:
            self._hidden[ident] = decision.why, None
            return None
        entry = SiteImport(named(decision.name), announced, decision.why)
        if not (conflict := self._conflict(ident, entry)):
            return entry
        waiting = self._waiting.setdefault(_name(entry), {})
        if room := len(waiting) < limits.SITE_NAMES_WAITING_MAX:
            waiting[ident] = None
        self._hidden[ident] = conflict, _name(entry) if room else None
        return None

    def _conflict(self, ident: _Ident, entry: SiteImport) -> str:
        """Why a source cannot have its name here; empty if it can."""
        name, wanted = _name(entry), entry.source
        for own in self._own.get(name, ()):
            where = f"{own.module}{own.node} of this site"
            if wanted.kind is SourceKind.SERVICE:
                return f"{wanted.name} is a service of {where}; a gateway.rule can give it another name here"
            if own.type not in (wanted.type, "*"):
                return f"{wanted.name} has the type {own.type} at {where}, and {wanted.type} there"
        # All that are shown under one name have one type: any of them tells.
        holders = self._holders.get(name, {}).items()
        shown = next((shown.source for other, shown in holders if other != ident), None)
        if shown is not None:
            where = f"{shown.site}/{shown.module}{shown.node}"
            if wanted.kind is SourceKind.SERVICE:
                return f"{wanted.name} is shown from {where} already; a gateway.rule can give it another name here"
            if shown.type != wanted.type:
                return f"{wanted.name} is shown from {where} with the type {shown.type}, not {wanted.type}"
        return ""

    def _retry(self, name: _Name) -> None:
        for ident in list(self._waiting.get(name, ())):
            self._judge(ident)


def _ident(source: SiteSource) -> _Ident:
    return source.module.site, source.module.name, source.kind, source.node, source.name


def _name(entry: SiteImport) -> _Name:
    return entry.source.kind, entry.source.name


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
        imported: What runs for it, by what is shown.
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
        self.imported: dict[ForeignSource, ImportedTopic | ImportedService] = {}
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
            source, topic = entry.source, entry.source.kind is SourceKind.TOPIC
            if old is not None and new is not None:
                self.imported[source].renew(new)
                return
            if new is None:
                self.imported.pop(source).close()
            else:
                self.imported[source] = (
                    ImportedTopic(new, self.topics) if topic else ImportedService(new, self.context)
                )
            if topic:
                self._actions.server(source, there=new is not None)
