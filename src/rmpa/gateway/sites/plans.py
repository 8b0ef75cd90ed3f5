"""What a site offers and takes: plans of exports and imports, and how the parts report them. Without I/O.

Which sources of this site other sites may have: from the mesh's sources and the rules to tokens. Sans-I/O.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.neighbour import ForeignSource, SourceKind
from rmpa.gateway.sites.keys import UNKNOWN_TYPE, SiteModule, SiteSource

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.core.counters import Counters
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.sites.catalogue import CrossingDecision, CrossingRules, SiteCatalogue


# What plugs into the neighbour "other sites": a part carries sources of one kind, or something else of modules.


@dataclass(frozen=True, slots=True)
class SiteExport:
    """A source of this site that other sites may have; its liveliness token is declared by the neighbour.

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
    """

    source: ForeignSource
    announced: SiteSource


class SitePart:
    """One part of the neighbour "other sites"; called only while this gateway leads its site, in the event loop.

    A gateway that stops leading withdraws and hides everything, and says of all modules that they are gone. What a
    part does not override it ignores.
    """

    name = ""
    """The key of its report."""

    def export(self, entry: SiteExport) -> None:
        """Offer a source of this site: declare what its messages or calls need."""

    def withdraw(self, entry: SiteExport) -> None:
        """Take back what ``export`` made."""

    def show(self, entry: SiteImport) -> None:
        """Put a source of another site into the graph."""

    def renew(self, old: SiteImport, new: SiteImport) -> None:
        """A source that is shown is now of another run of its module, or its way was interrupted: ask it anew."""

    def hide(self, entry: SiteImport) -> None:
        """Take back what ``show`` made."""

    def module_changed(self, module: SiteModule, there: bool) -> None:
        """A module came or went; one of this site has this site's name."""

    def report(self) -> dict[str, object]:
        """What ``rmpa why`` and ``rmpa site`` are answered from, as JSON values."""
        return {}

    async def close(self) -> None:
        """End it: everything was withdrawn and hidden before."""


_Key = tuple[SourceKind, str, str]


@dataclass(frozen=True, slots=True)
class ExportChange:
    """A module or a source is to be announced, or withdrawn; a module before its sources, and after them."""

    item: SiteModule | SiteExport
    there: bool


class SiteExports:
    """Plans what this site offers: each source once to all sites, or once to each site that the rules let have it.

    Args:
        site: This site's name.
        rules: Decide what may cross.
    """

    def __init__(self, site: str, rules: CrossingRules) -> None:
        self._site = site
        self._rules = rules
        self._sources: dict[_Key, MeshSource] = {}
        self._entries: dict[_Key, dict[str, SiteExport]] = {}
        """By the site that it is for; empty: for all."""
        self._sites: dict[str, None] = {}
        """The other sites that were ever there: a site that is away for a while keeps what is addressed to it."""
        self._addressed: set[_Key] = set()
        self._announced: dict[SiteSource, _Key] = {}
        self._refused: dict[_Key, str] = {}
        self._crowded: dict[_Key, SiteSource] = {}
        """Of what is refused: what may be offered once something else has gone."""
        self._modules: dict[SiteModule, int] = {}
        self._changes: list[ExportChange] = []

    @property
    def entries(self) -> list[SiteExport]:
        """What is offered; a source that is addressed to several sites is there for each of them."""
        return [entry for entries in self._entries.values() for entry in entries.values()]

    @property
    def sources(self) -> list[MeshSource]:
        """The sources that are offered, each once."""
        return [self._sources[key] for key in self._entries]

    @property
    def modules(self) -> list[SiteModule]:
        """The modules that offer something."""
        return list(self._modules)

    def refusals(self) -> Iterator[tuple[MeshSource, str]]:
        """What stays home, with the reason."""
        for key, reason in self._refused.items():
            yield self._sources[key], reason

    def take_changes(self) -> list[ExportChange]:
        """The changes since the last call, in order."""
        changes, self._changes = self._changes, []
        return changes

    def changed(self, source: MeshSource, *, there: bool) -> None:
        """A source of this site came, changed (another type, run or module under the same name and proxy) or went."""
        key = (source.kind, source.here, source.proxy)
        old = self._sources.get(key)
        if there and old == source:
            return
        self._drop(key)
        if there:
            self._sources[key] = source
            self._judge(key, source)
        elif old is not None:
            self._retry()

    def sites_seen(self, there: Iterable[str]) -> None:
        """These other sites are there now: sources that are not for all are offered to those that may have them."""
        there = tuple(there)
        new = [site for site in there if site not in self._sites]
        if not new:
            return
        self._sites.update(dict.fromkeys(new))
        if len(self._sites) > limits.SITES_REMEMBERED_MAX:
            self._sites = dict.fromkeys(there)
            for key in self._addressed:
                for site in [site for site in self._entries.get(key, ()) if site not in self._sites]:
                    self._withdraw(key, site)
        for key in self._addressed:
            self._judge(key, self._sources[key])

    def _drop(self, key: _Key) -> None:
        self._sources.pop(key, None)
        self._refused.pop(key, None)
        self._crowded.pop(key, None)
        self._addressed.discard(key)
        for site in list(self._entries.get(key, ())):
            self._withdraw(key, site)

    def _withdraw(self, key: _Key, site: str) -> None:
        entry = self._entries[key].pop(site)
        if not self._entries[key]:
            del self._entries[key]
        del self._announced[entry.announced]
        self._changes.append(ExportChange(entry, there=False))
        module = entry.announced.module
        self._modules[module] -= 1
        if not self._modules[module]:
            del self._modules[module]
            self._changes.append(ExportChange(module, there=False))

    def _judge(self, key: _Key, source: MeshSource) -> None:
        """Offer a source to all that may have it, and to which it is not offered yet."""
        self._refused.pop(key, None)
        self._crowded.pop(key, None)
        decision = self._rules.outgoing(source.kind, source.module, source.name, source.type, source.node)
        if not decision.allowed:
            self._refused[key] = decision.why
            return
        if not decision.addressed:
            self._offer(key, source, "", decision)
            return
        self._addressed.add(key)
        for site in self._sites:
            if site in self._entries.get(key, ()):
                continue
            each = self._rules.outgoing_to(site, source.module, source.name)
            if each.allowed:
                self._offer(key, source, site, each)
        if key not in self._entries and key not in self._refused:
            self._refused[key] = f"{decision.why} names the sites that it goes out to, of which none was here yet"

    def _offer(self, key: _Key, source: MeshSource, site: str, decision: CrossingDecision) -> None:
        announced = self._announcement(source, site)
        module = announced.module
        reason = _problem(announced)
        if not reason and (crowded := self._crowding(announced)):
            self._crowded[key], reason = announced, crowded
        if reason:
            self._refused[key] = reason
            return
        if module not in self._modules:
            self._modules[module] = 0
            self._changes.append(ExportChange(module, there=True))
        self._modules[module] += 1
        entry = SiteExport(source, announced, decision.rate, decision.size)
        self._entries.setdefault(key, {})[site] = entry
        self._announced[announced] = key
        self._changes.append(ExportChange(entry, there=True))

    def _crowding(self, announced: SiteSource) -> str:
        """Why a source must wait until another one has gone; empty if it need not."""
        if announced in self._announced:
            return "another proxy of the same source is offered already"
        if len(self._announced) >= limits.SITE_SOURCES_MAX:
            return f"{limits.SITE_SOURCES_MAX} sources of this site are offered already"
        return ""

    def _retry(self) -> None:
        for key, announced in list(self._crowded.items()):
            if len(self._announced) >= limits.SITE_SOURCES_MAX:
                return
            if not self._crowding(announced):
                self._judge(key, self._sources[key])

    def _announcement(self, source: MeshSource, site: str) -> SiteSource:
        module = SiteModule(self._site, source.module, source.instance)
        return SiteSource(module, source.kind, source.type, source.node, source.name, site)


def _problem(announced: SiteSource) -> str:
    """Why a source cannot be announced; empty if it can."""
    unasked = announced.kind is SourceKind.SERVICE and announced.type == UNKNOWN_TYPE
    if not unasked and not is_type_name(announced.type):
        return f"its type is not known ({announced.type!r})"
    if len(announced.node.encode()) > limits.NODE_NAME_MAX:
        return f"its node's name has more than {limits.NODE_NAME_MAX} bytes"
    if len(announced.token()) > limits.KEY_MAX:
        return f"its names and type have more than {limits.KEY_MAX} characters"
    return ""


# Which sources of other sites are shown here, and under which names. Sans-I/O.
#
# A source is known by site, module, kind, node and name; a new run of its module continues it. Of two sources that
# want
# one name here with different types (or two services of one name) the first is shown, and one of this site's own
# modules goes before all others; the reason is told for the other, which is shown once the name is free. Of one
# name
# only the first ``limits.SITE_NAMES_WAITING_MAX`` wait.


_Ident = tuple[str, str, SourceKind, str, str]
"""Site, module, kind, node, name there."""
_Name = tuple[SourceKind, str]


@dataclass(frozen=True, slots=True)
class ImportChange:
    """A source of another site is to be shown, renewed, or hidden.

    Args:
        old: What was shown until now; ``None``: nothing.
        new: What is to be shown; ``None``: nothing. With ``old``: it is the same source, to be asked anew.
    """

    old: SiteImport | None
    new: SiteImport | None


class SiteImports:
    """Plans what is shown of other sites.

    Args:
        rules: Decide what may cross, and its name here.
    """

    def __init__(self, rules: CrossingRules) -> None:
        self._rules = rules
        self._runs: dict[_Ident, list[SiteSource]] = {}
        self._shown: dict[_Ident, SiteImport] = {}
        self._hidden: dict[_Ident, str] = {}
        self._holders: dict[_Name, dict[_Ident, SiteImport]] = {}
        self._waiting: dict[_Name, dict[_Ident, None]] = {}
        self._waits_for: dict[_Ident, _Name] = {}
        self._own: dict[_Name, list[MeshSource]] = {}
        self._changes: list[ImportChange] = []

    @property
    def entries(self) -> list[SiteImport]:
        """What is shown."""
        return list(self._shown.values())

    def refusals(self) -> Iterator[tuple[SiteSource, str]]:
        """What is not shown, with the reason."""
        for ident, reason in self._hidden.items():
            yield self._runs[ident][-1], reason

    def entry(self, source: SiteSource) -> SiteImport | None:
        """What is shown for a source of another site."""
        return self._shown.get(_ident(source))

    def take_changes(self) -> list[ImportChange]:
        """The changes since the last call, in order."""
        changes, self._changes = self._changes, []
        return changes

    def found(self, source: SiteSource) -> None:
        """A source of another site is there."""
        ident = _ident(source)
        runs = self._runs.setdefault(ident, [])
        if source in runs:
            return
        runs.append(source)
        self._rejudge(ident)

    def renewed(self, source: SiteSource) -> None:
        """The token of a source was away for a moment."""
        shown = self._shown.get(_ident(source))
        if shown is not None and shown.announced == source:
            self._changes.append(ImportChange(shown, shown))

    def gone(self, source: SiteSource) -> None:
        """A source of another site is gone."""
        ident = _ident(source)
        runs = self._runs.get(ident, [])
        if source not in runs:
            return
        runs.remove(source)
        if runs:
            self._rejudge(ident)
            return
        del self._runs[ident]
        self._hidden.pop(ident, None)
        self._stop_waiting(ident)
        self._hide(ident)

    def own_changed(self, source: MeshSource, *, there: bool) -> None:
        """A source of this site came or went: it may be in the way of others, or no longer."""
        name = (source.kind, source.here)
        own = self._own.setdefault(name, [])
        if there and source not in own:
            own.append(source)
            for ident, entry in list(self._holders.get(name, {}).items()):
                if self._conflict(ident, entry):
                    self._rejudge(ident)
        elif not there and source in own:
            own.remove(source)
            self._retry(name)
        if not own:
            self._own.pop(name, None)

    def _rejudge(self, ident: _Ident) -> None:
        """Show, renew or hide a source of which a run is there."""
        announced = self._runs[ident][-1]
        self._hidden.pop(ident, None)
        self._stop_waiting(ident)
        new, reason = self._plan(ident, announced)
        old = self._shown.get(ident)
        if new is None:
            self._hidden[ident] = reason
            self._hide(ident)
        elif old is None or old.source != new.source:
            self._hide(ident)
            self._show(ident, new)
        elif old != new:
            self._shown[ident] = self._holders[_name(new)][ident] = new
            self._changes.append(ImportChange(old, new))

    def _plan(self, ident: _Ident, announced: SiteSource) -> tuple[SiteImport | None, str]:
        module = announced.module
        decision = self._rules.incoming(
            announced.kind, module.site, module.name, announced.name, announced.type, announced.node
        )
        if not decision.allowed:
            return None, decision.why
        source = ForeignSource(
            announced.kind, module.site, module.name, announced.node, decision.name, announced.type
        )
        entry = SiteImport(source, announced)
        conflict = self._conflict(ident, entry)
        if conflict:
            waiting = self._waiting.setdefault(_name(entry), {})
            if len(waiting) < limits.SITE_NAMES_WAITING_MAX:
                waiting[ident] = None
                self._waits_for[ident] = _name(entry)
            return None, conflict
        return entry, ""

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
        holders = ((other, shown) for other, shown in self._holders.get(name, {}).items() if other != ident)
        for _, shown in itertools.islice(holders, 1):
            where = f"{shown.source.site}/{shown.source.module}{shown.source.node}"
            if wanted.kind is SourceKind.SERVICE:
                return f"{wanted.name} is shown from {where} already; a gateway.rule can give it another name here"
            if shown.source.type != wanted.type:
                return f"{wanted.name} is shown from {where} with the type {shown.source.type}, not {wanted.type}"
        return ""

    def _show(self, ident: _Ident, entry: SiteImport) -> None:
        self._shown[ident] = entry
        self._holders.setdefault(_name(entry), {})[ident] = entry
        self._changes.append(ImportChange(None, entry))

    def _hide(self, ident: _Ident) -> None:
        entry = self._shown.pop(ident, None)
        if entry is None:
            return
        name = _name(entry)
        del self._holders[name][ident]
        if not self._holders[name]:
            del self._holders[name]
        self._changes.append(ImportChange(entry, None))
        self._retry(name)

    def _retry(self, name: _Name) -> None:
        for ident in list(self._waiting.get(name, ())):
            self._rejudge(ident)

    def _stop_waiting(self, ident: _Ident) -> None:
        name = self._waits_for.pop(ident, None)
        if name is not None:
            del self._waiting[name][ident]
            if not self._waiting[name]:
                del self._waiting[name]


def _ident(source: SiteSource) -> _Ident:
    return source.module.site, source.module.name, source.kind, source.node, source.name


def _name(entry: SiteImport) -> _Name:
    return entry.source.kind, entry.source.name


# What ``rmpa site`` shows of other sites, as JSON values. Sans-I/O.


REFUSALS_SHOWN: Final = 1000
"""Sources that do not cross, of each way, that a report names; the others are counted."""


def sites_report(catalogue: SiteCatalogue, imports: SiteImports) -> dict[str, object]:
    """Each other site: its gateways, modules, and how many sources of each are there and shown here."""
    found: dict[str, object] = {}
    for site in catalogue.sites:
        modules = []
        for module in catalogue.modules(site):
            sources = catalogue.sources(module)
            shown = sum(imports.entry(source) is not None for source in sources)
            modules.append(
                {"name": module.name, "instance": module.instance, "sources": len(sources), "shown": shown}
            )
        found[site] = {
            "gateways": [{"rank": each.rank, "instance": each.instance} for each in catalogue.gateways(site)],
            "modules": modules,
            "beyond_limits": catalogue.refused(site),
        }
    return found


def site_counts(counters: Counters) -> dict[str, int]:
    """The counts that are about sites, of counters that may be the agent's."""
    return {name: count for name, count in counters.as_dict().items() if name.startswith("site.")}


def refusals_report(exports: SiteExports, imports: SiteImports) -> dict[str, object]:
    """What does not cross, with the reason."""
    out = [
        {"kind": source.kind, "module": source.module, "node": source.node, "name": source.name, "why": why}
        for source, why in exports.refusals()
    ]
    into = [
        {
            "kind": source.kind,
            "site": source.module.site,
            "module": source.module.name,
            "node": source.node,
            "name": source.name,
            "why": why,
        }
        for source, why in imports.refusals()
    ]
    return {
        "out": out[:REFUSALS_SHOWN],
        "in": into[:REFUSALS_SHOWN],
        "more": max(0, len(out) - REFUSALS_SHOWN) + max(0, len(into) - REFUSALS_SHOWN),
    }
