"""Which sources of this site other sites may have: from the mesh's sources and the rules to tokens. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core.identity import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.keys import UNKNOWN_TYPE, SiteModule, SiteSource
from rmpa.gateway.sites.part import SiteExport

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.sites.rules import CrossingDecision, CrossingRules

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
