"""Which sites were there and are not, and what they had: for "unreachable since". Without I/O."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.gateway import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.gateway.sites.keys import SiteSource

_ENDING: Final = 2.0
"""Seconds within which a gateway that ends withdraws what it announced: that too is what its site had."""


class SiteHistory:
    """Remembers since when other sites are there or away.

    Args:
        now: Monotonic seconds.
    """

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._there: frozenset[str] = frozenset()
        self._since: dict[str, float] = {}
        self._sources: dict[str, set[SiteSource]] = {}
        self._withdrawn: dict[str, deque[tuple[float, SiteSource]]] = {}
        self._ended: set[str] = set()
        """The sites whose sources are those from before they were away."""

    @property
    def away(self) -> tuple[str, ...]:
        """The sites that were there and are not, by name."""
        return tuple(sorted(self._since.keys() - self._there))

    def since_ago(self, site: str) -> float | None:
        """Seconds since a site came or left; ``None``: it was never seen."""
        return self._now() - self._since[site] if site in self._since else None

    def source(self, source: SiteSource, *, there: bool) -> None:
        """A site announces a source, or withdraws it; not called for those that go together with their site."""
        site = source.module.site
        if site in self._ended:
            self._forget(site)
        known = self._sources.setdefault(site, set())
        if there:
            known.add(source)
            return
        known.discard(source)
        withdrawn = self._withdrawn.setdefault(site, deque(maxlen=limits.SITE_SOURCES_MAX))
        withdrawn.append((self._now(), source))
        while withdrawn[0][0] < self._now() - _ENDING:
            withdrawn.popleft()

    def had(self, name: str) -> tuple[tuple[str, str], ...]:
        """The sites that are away and had a topic or service of this name, each with its module."""
        away = self.away
        found = {
            (s.module.site, s.module.name) for site in away for s in self._sources.get(site, ()) if s.name == name
        }
        return tuple(sorted(found))

    def seen(self, sites: Iterable[str]) -> None:
        """These sites are there now, and no others."""
        there = frozenset(sites)
        for site in there ^ self._there:
            self._since[site] = self._now()
        for site in self._there - there:
            self._ended.add(site)
            withdrawn = self._withdrawn.pop(site, ())
            self._sources.setdefault(site, set()).update(s for at, s in withdrawn if at >= self._now() - _ENDING)
        self._there = there
        while len(self._since) > limits.SITES_REMEMBERED_MAX and (away := self.away):
            oldest = min(away, key=self._since.__getitem__)
            del self._since[oldest]
            self._forget(oldest)
        self._bound()

    def _bound(self) -> None:
        """Forget what the sites had that left first, if it is too much."""
        away = sorted(self.away, key=self._since.__getitem__)
        total = sum(len(self._sources.get(site, ())) for site in away)
        for site in away:
            if total <= limits.SITES_SOURCES_MAX:
                return
            total -= len(self._sources.get(site, ()))
            self._forget(site)

    def _forget(self, site: str) -> None:
        """Forget what a site had."""
        self._ended.discard(site)
        self._sources.pop(site, None)
        self._withdrawn.pop(site, None)
