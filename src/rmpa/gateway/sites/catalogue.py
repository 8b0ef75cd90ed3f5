"""What other sites have or had, since when they are there or away, and which gateway of a site leads. Without I/O.

Tokens come and go one by one, in any order. A source is there while its own token and that of its module are. What a
gateway withdraws goes at once (after ``_SITE_SETTLE``); what is lost together with the leading gateway of its
site, or with the way to it, stays for ``limits.SITE_GRACE``, so that neither a short break of a link nor a change of
the leading gateway takes everything down and up::

    ABSENT ──token──► THERE ──token gone──► SETTLING ──0.05 s──► ABSENT
                        ▲                      │ leading gateway gone too
                        └──token (renewed)── GRACE ──0.5 s──► ABSENT
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.statistics import Counters
from rmpa.core.timers import TimerQueue
from rmpa.gateway import limits
from rmpa.gateway.sites.keys import SiteGateway, SiteModule, SiteSource, parse_token

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.sites.plans import SiteImports

# Seconds from the end of a token to the end of what it stands for. The tokens of a gateway that was killed go one by
# one, within some milliseconds: its own may be the last, and then the others are lost and not withdrawn.
_SITE_SETTLE: Final = 0.05

# Seconds within which a gateway that ends withdraws what it announced: that too is what its site had.
_ENDING: Final = 2.0


@dataclass(slots=True)
class _Site:
    gateways: set[SiteGateway] = field(default_factory=set)
    # Those whose token is there, or just went, with the sources likewise.
    modules: dict[SiteModule, set[SiteSource]] = field(default_factory=dict)
    # Sources whose token came before that of their module.
    orphans: dict[SiteModule, set[SiteSource]] = field(default_factory=dict)
    # With the orphans.
    sources: int = 0
    # Sources that have ended lately, and when.
    ended: dict[SiteSource, float] = field(default_factory=dict)
    # Since when it is told of.
    since: float | None = None
    interrupted_until: float = 0.0
    refused: int = 0


_NO_SITE: Final = _Site()


class SiteCatalogue:
    """Keeps what other sites have, and what those had that are away.

    Args:
        own: This site's name, whose tokens are ignored.
        imports: Is told of each source that is found, renewed (its token had gone and came back in time: another
            gateway may have it now), or gone.
        seen: ``(site, there)``: a site has come, before its sources are looked at, or has left.
        counters: ``site.token.malformed``, ``site.token.later_version``, ``site.limit``.
    """

    def __init__(
        self,
        own: str,
        imports: SiteImports,
        seen: Callable[[str, bool], None],
        counters: Counters | None = None,
    ) -> None:
        self._own = own
        self._imports = imports
        self._seen = seen
        # When each site left that is away, and what it had; the oldest first.
        self._away: dict[str, tuple[float, list[SiteSource]]] = {}
        self._sites: dict[str, _Site] = {}
        # Of all sites together.
        self._sources = 0
        self._ending: TimerQueue[str] = TimerQueue()
        self._by_token: dict[str, SiteModule | SiteSource] = {}
        self.counters = counters if counters is not None else Counters()

    @property
    def sites(self) -> tuple[str, ...]:
        """The names of the other sites, in order."""
        return tuple(sorted(self._sites))

    @property
    def away(self) -> tuple[str, ...]:
        """The sites that were there and are not, by name."""
        return tuple(sorted(self._away))

    def since_ago(self, site: str, now: float) -> float | None:
        """Seconds since a site came or left; ``None``: it was never seen."""
        since = self._away[site][0] if site in self._away else self._sites.get(site, _NO_SITE).since
        return None if since is None else now - since

    def had(self, name: str) -> tuple[tuple[str, str], ...]:
        """The sites that are away and had a topic or service of this name, each with its module."""
        sources = (source for _, had in self._away.values() for source in had)
        return tuple(sorted({(each.site, each.module.name) for each in sources if each.name == name}))

    def gateways(self, site: str) -> list[SiteGateway]:
        """The gateways of another site, the leading one first."""
        return sorted(self._sites.get(site, _NO_SITE).gateways)

    def modules(self, site: str) -> list[SiteModule]:
        """The modules of another site, by name."""
        return sorted(self._sites.get(site, _NO_SITE).modules, key=lambda each: (each.name, each.instance))

    def sources(self, module: SiteModule) -> list[SiteSource]:
        """The sources of a module, by name and node."""
        known = self._sites.get(module.site, _NO_SITE).modules.get(module, ())
        return sorted(known, key=lambda each: (each.name, each.node, each.kind))

    def refused(self, site: str) -> int:
        """Tokens of a site that were left out because there are too many."""
        return self._sites.get(site, _NO_SITE).refused

    def token(self, key: str, now: float, *, alive: bool) -> SiteModule | SiteSource | SiteGateway | None:
        """A liveliness token came or went. What is none is counted and ignored.

        Args:
            key: The token.
            now: Monotonic seconds.
            alive: Whether it is there.

        Returns:
            What it stands for, also at this site.
        """
        try:
            item = parse_token(key)
        except RemoteProtocolError:
            self.counters.add("site.token.malformed")
            return None
        if item is None:
            self.counters.add("site.token.later_version")
        elif item.site != self._own:
            self._changed(item, key, now, alive=alive)
        return item

    def _changed(self, item: SiteModule | SiteSource | SiteGateway, key: str, now: float, *, alive: bool) -> None:
        name = item.site
        site = self._sites.get(name)
        if site is None:
            if not alive:
                return
            if len(self._sites) >= limits.SITES_MAX:
                self.counters.add("site.limit")
                return
            site = self._sites[name] = _Site()
        if isinstance(item, SiteGateway):
            self._gateway(site, item, now, alive=alive)
        elif alive:
            self._came(site, item, key)
        else:
            self._went(site, item, key, now)
        self._judge(name, now)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: nothing waits."""
        return self._ending.next()

    def handle_timer(self, now: float) -> None:
        """End what is due."""
        while (key := self._ending.pop(now)) is not None:
            item = self._by_token.pop(key)
            site = self._sites[item.site]
            if isinstance(item, SiteModule):
                self._end_module(site, item, now)
            else:
                site.modules[item.module].discard(item)
                self._count(site, -1)
                self._end(site, item, now)
            self._judge(item.site, now)

    def _gateway(self, site: _Site, gateway: SiteGateway, now: float, *, alive: bool) -> None:
        if alive:
            if len(site.gateways) < limits.SITE_MODULES_MAX:
                site.gateways.add(gateway)
            return
        leader = min(site.gateways, default=None)
        site.gateways.discard(gateway)
        if gateway != leader:
            return
        site.interrupted_until = now + limits.SITE_GRACE
        for key, item in self._by_token.items():
            if item.site == gateway.site:
                self._ending.set(key, site.interrupted_until)

    def _came(self, site: _Site, item: SiteModule | SiteSource, key: str) -> None:
        if self._by_token.pop(key, None) is not None:
            self._ending.set(key, None)
            if isinstance(item, SiteSource):
                self._imports.renewed(item)
            return
        if isinstance(item, SiteModule):
            if item in site.modules:
                return
            if len(site.modules) >= limits.SITE_MODULES_MAX:
                self._refuse(site)
                return
            sources = site.modules[item] = site.orphans.pop(item, set())
            for source in sorted(sources, key=SiteSource.token):
                self._imports.found(source)
            return
        known = site.modules.get(item.module)
        into = known if known is not None else site.orphans.setdefault(item.module, set())
        if item in into:
            return
        if site.sources >= limits.SITE_SOURCES_MAX or self._sources >= limits.SITES_SOURCES_MAX:
            if not into and known is None:
                del site.orphans[item.module]
            self._refuse(site)
            return
        into.add(item)
        self._count(site, 1)
        if known is not None:
            self._imports.found(item)

    def _went(self, site: _Site, item: SiteModule | SiteSource, key: str, now: float) -> None:
        if isinstance(item, SiteSource) and item in site.orphans.get(item.module, ()):
            site.orphans[item.module].discard(item)
            self._count(site, -1)
            if not site.orphans[item.module]:
                del site.orphans[item.module]
            return
        there = item in site.modules if isinstance(item, SiteModule) else item in site.modules.get(item.module, ())
        if there and key not in self._by_token:
            self._by_token[key] = item
            self._ending.set(key, max(now + _SITE_SETTLE, site.interrupted_until))

    def _end(self, site: _Site, source: SiteSource, now: float) -> None:
        """A source is gone; what ended before its site could end with it is forgotten."""
        ended = site.ended
        ended.pop(source, None)
        ended[source] = now
        while ended[oldest := next(iter(ended))] < now - _ENDING:
            del ended[oldest]
        self._imports.gone(source)

    def _end_module(self, site: _Site, module: SiteModule, now: float) -> None:
        for source in sorted(site.modules.pop(module), key=SiteSource.token):
            key = source.token()
            self._ending.set(key, None)
            if self._by_token.pop(key, None) is None:
                # Its token is there still: it may be shown again with its module's.
                site.orphans.setdefault(module, set()).add(source)
            else:
                self._count(site, -1)
            self._end(site, source, now)

    def _count(self, site: _Site, more: int) -> None:
        site.sources += more
        self._sources += more

    def _refuse(self, site: _Site) -> None:
        site.refused += 1
        self.counters.add("site.limit")

    def _judge(self, name: str, now: float) -> None:
        """Tell of a site that has come, or left; of those that are away, the oldest are forgotten."""
        site = self._sites[name]
        if site.gateways or site.modules or site.orphans:
            if site.since is None:
                site.since = now
                self._away.pop(name, None)
                self._seen(name, True)
            return
        del self._sites[name]
        if site.since is None:
            return
        self._away[name] = now, [source for source, at in site.ended.items() if at >= now - _ENDING]
        while self._away and len(self._away) + len(self._sites) > limits.SITES_REMEMBERED_MAX:
            del self._away[next(iter(self._away))]
        total = sum(len(had) for _, had in self._away.values())
        for _, had in self._away.values():
            if total > limits.SITES_SOURCES_MAX:
                total -= len(had)
                had.clear()
        self._seen(name, False)


# Which gateway of a site leads, where there are several. The others stand by, so that no message crosses twice.


class Leader:
    """Decides whether this gateway leads its site.

    Liveliness tokens are lost for a moment where a link to a router breaks. So a gateway waits for ``patience``
    before it leads, and one that hears of a better one stops at once: for a moment none leads, never two that hear
    each other.

    Args:
        own: This gateway.
        patience: Seconds for which it must have been the best before it leads.
        now: Monotonic seconds.
    """

    def __init__(self, own: SiteGateway, patience: float, now: float) -> None:
        self._own = own
        self._patience = patience
        self._others: set[SiteGateway] = set()
        self._best_since: float | None = now
        self.leads = False

    @property
    def leader(self) -> SiteGateway:
        """The gateway that leads, or will: the least of those that are known."""
        return min((self._own, *self._others))

    def seen(self, other: SiteGateway, now: float) -> None:
        """A gateway's token appeared; those of other sites and this gateway's own are ignored."""
        if other.site == self._own.site and other.instance != self._own.instance:
            self._others.add(other)
            self._judge(now)

    def gone(self, other: SiteGateway, now: float) -> None:
        """A gateway's token disappeared."""
        self._others.discard(other)
        self._judge(now)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: nothing waits."""
        return None if self.leads or self._best_since is None else self._best_since + self._patience

    def handle_timer(self, now: float) -> None:
        """Begin to lead if it is time."""
        due = self.next_timer()
        if due is not None and now >= due:
            self.leads = True

    def _judge(self, now: float) -> None:
        if self.leader != self._own:
            self.leads, self._best_since = False, None
        elif self._best_since is None:
            self._best_since = now
