"""Which sources of other sites are shown here, and under which names. Sans-I/O.

A source is known by site, module, kind, node and name; a new run of its module continues it. Of two sources that want
one name here with different types (or two services of one name) the first is shown, and one of this site's own
modules goes before all others; the reason is told for the other, which is shown once the name is free. Of one name
only the first ``limits.SITE_NAMES_WAITING_MAX`` wait.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.gateway import limits
from rmpa.gateway.neighbour import ForeignSource, SourceKind
from rmpa.gateway.sites.part import SiteImport

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.sites.keys import SiteSource
    from rmpa.gateway.sites.rules import CrossingRules

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
