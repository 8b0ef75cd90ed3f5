"""What other sites have, which gateway of a site leads, and the rules of what crosses.

What other sites have, from their liveliness tokens.

Sans-I/O. Tokens come and go one by one, in any order. A source is there while its own token and that of its module
are. What a gateway withdraws goes at once (after ``limits.SITE_SETTLE``); what is lost together with the leading
gateway of its site, or with the way to it, stays for ``limits.SITE_GRACE``, so that neither a short break of a link
nor a change of the leading gateway takes everything down and up::

    ABSENT ──token──► THERE ──token gone──► SETTLING ──0.05 s──► ABSENT
                        ▲                      │ leading gateway gone too
                        └──token (renewed)── GRACE ──0.5 s──► ABSENT
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Final

from rmpa.config.peer_rules import Access
from rmpa.config.rules import ROS2, Crossing
from rmpa.core.counters import Counters, TimerQueue
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name, matches
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.keys import SiteGateway, SiteModule, SiteSource, parse_token

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from rmpa.bridge.policy import PolicyDecision
    from rmpa.config.rules import CrossingRule
    from rmpa.gateway.neighbour import SitePermissions

    Judge = Callable[[SourceKind, str, str, str], PolicyDecision]


class CatalogueChange(Enum):
    """What has happened to a module or a source."""

    FOUND = "found"
    RENEWED = "renewed"
    """Its token had gone and came back in time: another gateway may have it now."""
    GONE = "gone"


@dataclass(frozen=True, slots=True)
class CatalogueEvent:
    """A change of what other sites have. A module is found before its sources, and goes after them."""

    change: CatalogueChange
    item: SiteModule | SiteSource


@dataclass(slots=True)
class _Site:
    gateways: set[SiteGateway] = field(default_factory=set)
    modules: dict[SiteModule, set[SiteSource]] = field(default_factory=dict)
    """Those whose token is there, or just went, with the sources likewise."""
    orphans: dict[SiteModule, set[SiteSource]] = field(default_factory=dict)
    """Sources whose token came before that of their module."""
    sources: int = 0
    """With the orphans."""
    interrupted_until: float = 0.0
    refused: int = 0


class SiteCatalogue:
    """Keeps what other sites have.

    Args:
        own: This site's name, whose tokens are ignored.
        counters: ``site.token.malformed``, ``site.token.later_version``, ``site.limit``.
    """

    def __init__(self, own: str, counters: Counters | None = None) -> None:
        self._own = own
        self._sites: dict[str, _Site] = {}
        self._sources = 0
        """Of all sites together."""
        self._ending: TimerQueue[str] = TimerQueue()
        self._by_token: dict[str, SiteModule | SiteSource] = {}
        self._events: list[CatalogueEvent] = []
        self.counters = counters if counters is not None else Counters()

    # --- what is there ------------------------------------------------------------------------------------------

    @property
    def sites(self) -> tuple[str, ...]:
        """The names of the other sites, in order."""
        return tuple(sorted(self._sites))

    def gateways(self, site: str) -> list[SiteGateway]:
        """The gateways of another site, the leading one first."""
        found = self._sites.get(site)
        return sorted(found.gateways, key=lambda each: each.order) if found is not None else []

    def modules(self, site: str) -> list[SiteModule]:
        """The modules of another site, by name."""
        found = self._sites.get(site)
        return sorted(found.modules, key=lambda each: (each.name, each.instance)) if found is not None else []

    def sources(self, module: SiteModule) -> list[SiteSource]:
        """The sources of a module, by name and node."""
        found = self._sites.get(module.site)
        known = found.modules.get(module, set()) if found is not None else set()
        return sorted(known, key=lambda each: (each.name, each.node, each.kind))

    def refused(self, site: str) -> int:
        """Tokens of a site that were left out because there are too many."""
        found = self._sites.get(site)
        return found.refused if found is not None else 0

    def all(self) -> Iterator[SiteModule | SiteSource]:
        """Everything that is there, modules before their sources."""
        for site in self.sites:
            for module in self.modules(site):
                yield module
                yield from self.sources(module)

    def take_events(self) -> list[CatalogueEvent]:
        """The changes since the last call, in order."""
        events, self._events = self._events, []
        return events

    # --- tokens -------------------------------------------------------------------------------------------------

    def token(self, key: str, now: float, *, alive: bool) -> None:
        """A liveliness token came or went. What is none is counted and ignored.

        Args:
            key: The token.
            now: Monotonic seconds.
            alive: Whether it is there.
        """
        try:
            item = parse_token(key)
        except RemoteProtocolError:
            self.counters.add("site.token.malformed")
            return
        if item is None:
            self.counters.add("site.token.later_version")
            return
        name = item.module.site if isinstance(item, SiteSource) else item.site
        if name == self._own:
            return
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
        self._forget_if_empty(name)

    def next_timer(self) -> float | None:
        """When ``handle_timer`` is to be called; ``None``: nothing waits."""
        return self._ending.next()

    def handle_timer(self, now: float) -> None:
        """End what is due."""
        while (key := self._ending.pop(now)) is not None:
            item = self._by_token.pop(key)
            name = item.module.site if isinstance(item, SiteSource) else item.site
            site = self._sites[name]
            if isinstance(item, SiteModule):
                self._end_module(site, item)
            else:
                self._end_source(site, item)
            self._forget_if_empty(name)

    def _gateway(self, site: _Site, gateway: SiteGateway, now: float, *, alive: bool) -> None:
        if alive:
            if len(site.gateways) < limits.SITE_MODULES_MAX:
                site.gateways.add(gateway)
            return
        leader = min(site.gateways, key=lambda each: each.order, default=None)
        site.gateways.discard(gateway)
        if gateway != leader:
            return
        site.interrupted_until = now + limits.SITE_GRACE
        for key, item in self._by_token.items():
            if (item.module.site if isinstance(item, SiteSource) else item.site) == gateway.site:
                self._ending.set(key, site.interrupted_until)

    def _came(self, site: _Site, item: SiteModule | SiteSource, key: str) -> None:
        if self._by_token.pop(key, None) is not None:
            self._ending.set(key, None)
            self._tell(CatalogueChange.RENEWED, item)
            return
        if isinstance(item, SiteModule):
            if item in site.modules:
                return
            if len(site.modules) >= limits.SITE_MODULES_MAX:
                self._refuse(site)
                return
            sources = site.modules[item] = site.orphans.pop(item, set())
            self._tell(CatalogueChange.FOUND, item)
            for source in sorted(sources, key=SiteSource.token):
                self._tell(CatalogueChange.FOUND, source)
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
            self._tell(CatalogueChange.FOUND, item)

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
            self._ending.set(key, max(now + limits.SITE_SETTLE, site.interrupted_until))

    def _end_module(self, site: _Site, module: SiteModule) -> None:
        for source in sorted(site.modules.pop(module), key=SiteSource.token):
            key = source.token()
            self._ending.set(key, None)
            if self._by_token.pop(key, None) is None:
                # Its token is there still: it may be shown again with its module's.
                site.orphans.setdefault(module, set()).add(source)
            else:
                self._count(site, -1)
            self._tell(CatalogueChange.GONE, source)
        self._tell(CatalogueChange.GONE, module)

    def _end_source(self, site: _Site, source: SiteSource) -> None:
        site.modules[source.module].discard(source)
        self._count(site, -1)
        self._tell(CatalogueChange.GONE, source)

    def _count(self, site: _Site, more: int) -> None:
        site.sources += more
        self._sources += more

    def _refuse(self, site: _Site) -> None:
        site.refused += 1
        self.counters.add("site.limit")

    def _forget_if_empty(self, name: str) -> None:
        site = self._sites[name]
        if not (site.gateways or site.modules or site.orphans):
            del self._sites[name]

    def _tell(self, change: CatalogueChange, item: SiteModule | SiteSource) -> None:
        self._events.append(CatalogueEvent(change, item))


# Which gateway of a site leads, where there are several: the others stand by, so that no message crosses twice.


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
        return min((self._own, *self._others), key=lambda each: each.order)

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


# Counts messages and bytes of one topic, and their rate from report to report. Sans-I/O.


class SiteTraffic:
    """Messages and bytes, cheaply for each message: rates are computed where they are read.

    Args:
        now: Monotonic seconds.
    """

    __slots__ = ("_at", "_bytes_at", "_messages_at", "bandwidth", "bytes", "messages", "rate")

    def __init__(self, now: float) -> None:
        self.messages = 0
        """Messages ever seen."""
        self.bytes = 0
        """Bytes ever seen."""
        self.rate = 0.0
        """Messages a second between the last two readings."""
        self.bandwidth = 0.0
        """Bytes a second between the last two readings."""
        self._at, self._messages_at, self._bytes_at = now, 0, 0

    def add(self, size: int, messages: int = 1) -> None:
        """Count messages of ``size`` bytes together."""
        self.messages += messages
        self.bytes += size

    def read(self, now: float) -> None:
        """Compute the rates since the last reading, if that is at least a second ago."""
        passed = now - self._at
        if passed >= 1:
            self.rate = (self.messages - self._messages_at) / passed
            self.bandwidth = (self.bytes - self._bytes_at) / passed
            self._at, self._messages_at, self._bytes_at = now, self.messages, self.bytes


# What may cross between this site and others, and its name here: a pure table that names the rule that decided.


_OUT: Final = (Crossing.BOTH, Crossing.OUT)
_IN: Final = (Crossing.BOTH, Crossing.IN)
_EVERY_SITE: Final = ("*", "**")
_NO_RULE: Final = "no gateway.rule fits: everything crosses"


@dataclass(frozen=True, slots=True)
class CrossingDecision:
    """Whether a source may cross, and how.

    Args:
        allowed: Whether it may.
        why: The rule that decided, as text.
        name: The name here of what comes in; empty if it may not cross.
        rate: Messages a second of what goes out; ``None``: no limit.
        size: Bytes a second of what goes out; ``None``: no limit.
        addressed: Whether what goes out does not go to all other sites alike: ``outgoing_to`` decides for each.
    """

    allowed: bool
    why: str
    name: str = ""
    rate: float | None = None
    size: int | None = None
    addressed: bool = False


class CrossingRules:
    """Judges sources by ``[[gateway.rule]]``: the first rule that fits holds; without one everything crosses.

    Args:
        rules: In the order of the file.
        judge: The gateway's own policy, ``(kind, name, type, node)``, which must let a source cross too: by its name
            in its module if it goes out, by its name here if it comes in. ``None``: it lets everything cross.
        permissions: ``[[permission]]``, which must let other sites do it too; what they refuse is counted. ``None``:
            trust is off.
    """

    def __init__(
        self,
        rules: Sequence[CrossingRule] = (),
        judge: Judge | None = None,
        permissions: SitePermissions | None = None,
    ) -> None:
        self._rules = tuple(rules)
        self._judge = judge
        self._permissions = permissions

    def outgoing(self, kind: SourceKind, module: str, name: str, type_name: str, node: str) -> CrossingDecision:
        """Decide whether a source of this site goes out to any other site, and whether to all of them alike.

        Args:
            kind: What it is.
            module: The module that has it.
            name: Its name in its module.
            type_name: Its type.
            node: Its node in its module.
        """
        decision = self._policy(kind, name, type_name, node)
        if not decision.allowed:
            return decision
        found = []
        for number, rule in self._fitting(module, name):
            if all(site == ROS2 for site in rule.sites):
                continue  # it is about no site
            found.append(_outgoing(number, rule))
            if any(glob in _EVERY_SITE for glob in rule.sites):
                break
        else:
            found.append(decision)
        first = found[0]
        if all((each.allowed, each.rate, each.size) == (first.allowed, first.rate, first.size) for each in found):
            return first
        named = next(each for each in found if each.allowed)
        return CrossingDecision(True, named.why, addressed=True)

    def outgoing_to(self, site: str, module: str, name: str) -> CrossingDecision:
        """Decide whether a source that ``outgoing`` lets out goes to one other site; permissions are not asked.

        Args:
            site: The other site; empty for a program that names none.
            module: The module that has it.
            name: Its name in its module.
        """
        for number, rule in self._fitting(module, name):
            if any(matches(glob, site) for glob in rule.sites):
                return _outgoing(number, rule, site)
        return CrossingDecision(True, _NO_RULE)

    def refusal(
        self,
        site: str,
        module: str,
        name: str,
        access: Access = Access.SUBSCRIBE,
        askers: tuple[str, ...] = (),
        told: str | None = None,
    ) -> str:
        """Why another site may not have a source or parameter of this one; empty if it may.

        Args:
            site: The other site; empty for a program that names none.
            module: The module that has it.
            name: Its name in its module.
            access: What the other site would do with it.
            askers: The modules of the other site that ask, as it says.
            told: The name for the text, if ``name`` was found in what was asked for and may be a secret.
        """
        decision = self.outgoing_to(site, module, name)
        if not decision.allowed:
            return decision.why
        return self.denial(site, name, access, askers, told)

    def denial(
        self,
        site: str,
        name: str,
        access: Access,
        askers: tuple[str, ...] = (),
        told: str | None = None,
    ) -> str:
        """Why the permissions, without the rules, do not let another site have a name; empty if they do."""
        return "" if self._permissions is None else self._permissions.why_not(access, site, name, askers, told)

    def incoming(
        self, kind: SourceKind, site: str, module: str, name: str, type_name: str, node: str
    ) -> CrossingDecision:
        """Decide whether a source of another site is shown here, and under which name.

        Args:
            kind: What it is.
            site: The other site.
            module: The module that has it.
            name: Its name in its module.
            type_name: Its type.
            node: Its node in its module.
        """
        here, why = name, _NO_RULE
        for number, rule in self._fitting(module, name):
            if not any(matches(glob, site) for glob in rule.sites):
                continue
            why = _named(number, rule)
            if rule.crossing not in _IN:
                return CrossingDecision(False, f"{why} lets it not come in")
            here = rule.name.replace("{name}", name).replace("{site}", site).replace("{module}", module)
            break
        if not is_global_name(here):
            return CrossingDecision(False, f"{why} names it {here!r}, which is no global name of ROS")
        decision = self._policy(kind, here, type_name, node)
        if not decision.allowed:
            return decision
        access = Access.PUBLISH if kind is SourceKind.TOPIC else Access.SERVE
        if self._permissions is not None and not self._permissions.admits(access, site, module, here):
            return CrossingDecision(False, self._permissions.judge(access, site, module, here).rule)
        return CrossingDecision(True, why, here)

    def _fitting(self, module: str, name: str) -> Iterator[tuple[int, CrossingRule]]:
        for number, rule in enumerate(self._rules, 1):
            if any(matches(glob, name) for glob in rule.names) and any(
                matches(glob, module) for glob in rule.modules
            ):
                yield number, rule

    def _policy(self, kind: SourceKind, name: str, type_name: str, node: str) -> CrossingDecision:
        decision = None if self._judge is None else self._judge(kind, name, type_name, node)
        if decision is None or decision.allowed:
            return CrossingDecision(True, _NO_RULE)
        return CrossingDecision(False, decision.rule)


def _outgoing(number: int, rule: CrossingRule, site: str = "") -> CrossingDecision:
    """What one rule says of a source that it fits; ``site`` is named in the reason."""
    if rule.crossing in _OUT:
        return CrossingDecision(True, _named(number, rule), rate=rule.rate, size=rule.size)
    return CrossingDecision(False, f"{_named(number, rule)} lets it not go out{f' to {site}' if site else ''}")


def _named(number: int, rule: CrossingRule) -> str:
    return f"gateway.rule {number} ({rule.crossing}: {', '.join(rule.names)})"
