"""Which sources of this site other sites may have: from the mesh's sources and the rules to tokens. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core.names import is_type_name
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.keys import UNKNOWN_TYPE, SiteModule, SiteSource
from rmpa.gateway.sites.part import SiteExport

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.sites.rules import CrossingRules

_Key = tuple[SourceKind, str, str]


@dataclass(frozen=True, slots=True)
class ExportChange:
    """A module or a source is to be announced, or withdrawn; a module before its sources, and after them."""

    item: SiteModule | SiteExport
    there: bool


class SiteExports:
    """Plans what this site offers.

    Args:
        site: This site's name.
        rules: Decide what may cross.
    """

    def __init__(self, site: str, rules: CrossingRules) -> None:
        self._site = site
        self._rules = rules
        self._sources: dict[_Key, MeshSource] = {}
        self._entries: dict[_Key, SiteExport] = {}
        self._announced: dict[SiteSource, _Key] = {}
        self._refused: dict[_Key, str] = {}
        self._crowded: dict[_Key, MeshSource] = {}
        """Of what is refused: what may be offered once something else has gone."""
        self._modules: dict[SiteModule, int] = {}
        self._changes: list[ExportChange] = []

    @property
    def entries(self) -> list[SiteExport]:
        """What is offered."""
        return list(self._entries.values())

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

    def _drop(self, key: _Key) -> None:
        self._sources.pop(key, None)
        self._refused.pop(key, None)
        self._crowded.pop(key, None)
        entry = self._entries.pop(key, None)
        if entry is None:
            return
        del self._announced[entry.announced]
        self._changes.append(ExportChange(entry, there=False))
        module = entry.announced.module
        self._modules[module] -= 1
        if not self._modules[module]:
            del self._modules[module]
            self._changes.append(ExportChange(module, there=False))

    def _judge(self, key: _Key, source: MeshSource) -> None:
        decision = self._rules.outgoing(source.kind, source.module, source.name, source.type, source.node)
        announced = self._announcement(source)
        module = announced.module
        reason = decision.why if not decision.allowed else _problem(announced)
        if not reason and (crowded := self._crowding(announced)):
            self._crowded[key], reason = source, crowded
        if reason:
            self._refused[key] = reason
            return
        if module not in self._modules:
            self._modules[module] = 0
            self._changes.append(ExportChange(module, there=True))
        self._modules[module] += 1
        entry = SiteExport(source, announced, decision.rate, decision.size)
        self._entries[key] = entry
        self._announced[announced] = key
        self._changes.append(ExportChange(entry, there=True))

    def _crowding(self, announced: SiteSource) -> str:
        """Why a source must wait until another one has gone; empty if it need not."""
        if announced in self._announced:
            return "another proxy of the same source is offered already"
        if len(self._entries) >= limits.SITE_SOURCES_MAX:
            return f"{limits.SITE_SOURCES_MAX} sources of this site are offered already"
        return ""

    def _retry(self) -> None:
        for key, source in list(self._crowded.items()):
            if not self._crowding(self._announcement(source)):
                del self._crowded[key], self._refused[key]
                self._judge(key, source)

    def _announcement(self, source: MeshSource) -> SiteSource:
        module = SiteModule(self._site, source.module, source.instance)
        return SiteSource(module, source.kind, source.type, source.node, source.name)


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
