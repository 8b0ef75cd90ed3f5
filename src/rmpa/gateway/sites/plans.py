"""What a site offers, and what is shown here of others: plans of exports and imports. Without I/O."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.rules import CrossingRules, ForeignSource, MeshSource, SourceKey, SourceKind
from rmpa.gateway.sites.keys import UNKNOWN_TYPE, SiteModule, SiteSource

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator


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
