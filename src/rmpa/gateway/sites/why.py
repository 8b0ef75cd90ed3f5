"""Gathers what ``rmpa why`` judges of the way between sites: from this gateway, and from the other site's."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.bridge.policy import Needs
from rmpa.config.peer_rules import Access
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.keys import GATEWAY, ROOT
from rmpa.observe.peer_info import FAIL, OK, UNKNOWN, WARN, Check
from rmpa.observe.why.diagnosis import Diagnosis, permission_there, until_failure
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.sites.catalogue import CrossingRules
    from rmpa.gateway.sites.keys import SiteHistory, SiteSource
    from rmpa.gateway.sites.site import SiteNeighbour
    from rmpa.gateway.zenoh.config import ArrivedQuery
    from rmpa.gateway.zenoh.session import Declaration, OpenSession
    from rmpa.ros.wire.tcpros import Buffer


# ``rmpa why`` through gateways: what the gateways of two sites tell each other, and the stages at one of them.
#
# The importing gateway asks the exporting one (``get`` on ``rmpa/1/<site>/-gateway/why``), whose stages it shows as
# they are told, between those of the site and its own::
#
#     site ─ source there ─ rule there ─ demand there ─ sent ─ rule here ─ shown ─ header (md5) ─ demand here ─
#     arrived
#
# Without I/O.


_T = TypeVar("_T")
DEMAND_THERE: Final = "demand there"
"""The stage of the other sites' subscribers, as the exporting gateway hears of them."""
NO_DEMAND: Final = "that is no fault; to try it: rmpa topic echo"
ROUTER: Final = "allow it by [[permission]] of the router, for the names of both gateways (zenohd: access_control)"
_RULES: Final = "change [[gateway.rule]] in the rmpa.toml of the gateway of {}, and run rmpa reload there"
_PERMISSIONS: Final = (
    "change [[permission]] in the rmpa.toml of the gateway of {} and of its modules, and reload them"
)


class WhyQuestion(msgspec.Struct, kw_only=True, frozen=True):
    """What one gateway asks another.

    Attributes:
        site: The site that asks.
        name: A topic or service, by its name in its module.
        module: Of this module alone; empty for all.
        service: Whether a service is meant.
    """

    site: str
    name: str
    module: str = ""
    service: bool = False

    @classmethod
    def parse(cls, data: Buffer) -> WhyQuestion:
        """Read one.

        Raises:
            RemoteProtocolError: It is none.
        """
        found = _parse(data, cls, limits.KEY_MAX)
        if not is_global_name(found.name):
            raise RemoteProtocolError(f"{found.name[:80]!r} is not a topic, nor a service")
        return found


def parse_ways(data: Buffer) -> tuple[Diagnosis, ...]:
    """The answer of the leading gateway of a site, its texts without control characters: ways out of that site.

    Raises:
        RemoteProtocolError: It is none.
    """
    ways = _parse(data, tuple[Diagnosis, ...], limits.SITE_WHY_MAX)
    return tuple(msgspec.structs.replace(way, stages=tuple(map(_printable, way.stages))) for way in ways)


def _parse(data: Buffer, kind: type[_T], most: int) -> _T:
    if len(data) > most:
        raise RemoteProtocolError(f"a text of rmpa why has {len(data)} bytes, more than {most}")
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise RemoteProtocolError(f"not a text of rmpa why: {printable(str(error))}") from None


def _printable(stage: Check) -> Check:
    return Check(printable(stage.name), stage.level, printable(stage.text), printable(stage.remedy))


def why_key(site: str) -> str:
    """The key at which the gateways of a site answer."""
    return f"{ROOT}/{site}/{GATEWAY}/why"


@dataclass(frozen=True, slots=True)
class SourceHere:
    """What the importing gateway knows of one topic or service of another site.

    Args:
        kind: What it is.
        site: Its site.
        module: Its module.
        node: Its node there.
        name: Its name there.
        here: Its name here; empty if it is not shown.
        refused: Why it is not shown; empty if it is.
        rule: The rule that lets it come in.
        report: What its part reports; empty if it was never used.
    """

    kind: SourceKind
    site: str
    module: str
    node: str
    name: str
    here: str = ""
    refused: str = ""
    rule: str = ""
    report: Mapping[str, Any] | None = None


def sent_stages(site: str, report: Mapping[str, Any], *, asked: bool) -> list[Check]:
    """The stages of a topic behind its rule at the exporting gateway.

    Args:
        site: Its site.
        report: What its part reports.
        asked: Whether another site asks, which knows whether it subscribes; else it is a fault that none does.
    """
    if not report.get("wanted"):
        text = f"no other site subscribes, as the gateway of {site} hears: nothing is sent"
        return [Check(DEMAND_THERE, WARN if asked else FAIL, text, NO_DEMAND)]
    losses = {
        "dropped": "were dropped by its queue, for the way is slower than the topic",
        "limited": "were left out by rate or size of the rule",
    }
    lost = [f"{report[key]} {words}" for key, words in losses.items() if report.get(key)]
    text = f"the gateway of {site} has sent {report.get('messages', 0)} messages"
    if waiting := report.get("waiting"):
        text += f", {waiting} wait"
    remedy = "rate and size of a [[gateway.rule]] say what may be left out; a contract says what goes first"
    sent = Check("sent", OK if report.get("messages") else WARN, text)
    if lost:
        sent = Check("sent", WARN, f"{text}; {', '.join(lost)}", remedy)
    return [Check(DEMAND_THERE, OK, "another site subscribes"), sent]


def here_stages(own: str, found: SourceHere) -> list[Check]:
    """The stages of the importing site, whose name is ``own``."""
    if found.refused:
        return [refused_stage("here", found.refused, own)]
    was = f" (its {found.name})" if found.here != found.name else ""
    shown = f"it is {found.here} here{was}, at /rmpa/{found.site}/{found.module}{found.node}"
    stages = [Check("rule here", OK, found.rule or "it may come in"), Check("shown", OK, shown)]
    report = found.report or {}
    if problem := report.get("problem"):
        name = "md5" if "md5" in str(problem) else "header" if found.kind is SourceKind.TOPIC else "calls"
        level = FAIL if found.kind is SourceKind.TOPIC else WARN
        return [*stages, Check(name, level, str(problem), ROUTER if name == "header" else "")]
    if found.kind is SourceKind.SERVICE:
        calls, failed = int(report.get("calls", 0)), int(report.get("failed", 0))
        return [*stages, Check("calls", OK, f"{calls} calls from here, {failed} failed")]
    if not report.get("wanted"):
        text = "no node of this site subscribes: it crosses once one does"
        return [*stages, Check("demand here", FAIL, text, NO_DEMAND)]
    return [*stages, Check("demand here", OK, "a node of this site subscribes"), _arrived(report)]


def refused_stage(where: str, refused: str, site: str) -> Check:
    """The stage of a source that may not cross.

    Args:
        where: ``here`` or ``there``.
        refused: The rule or permission that decided, as text.
        site: The site whose gateway has refused it.
    """
    if "[[permission]]" in refused or refused.startswith("the permissions"):
        return Check(f"permission {where}", FAIL, refused, _PERMISSIONS.format(site))
    return Check(f"rule {where}", FAIL, refused, _RULES.format(site))


def _arrived(report: Mapping[str, Any]) -> Check:
    messages, rate = int(report.get("messages", 0)), float(report.get("rate", 0.0))
    if not messages:
        return Check("arrived", WARN, "no message has come since then", "does its publisher publish?")
    text = f"{messages} messages have come, {rate:.1f} Hz"
    losses = {
        "lost": "were lost between the gateways",
        "mismatched": "have another md5 sum than their header",
        "dropped": "were dropped here for slow subscribers",
    }
    lost = [f"{report[key]} {words}" for key, words in losses.items() if report.get(key)]
    return Check("arrived", WARN if lost else OK, "; ".join((text, *lost)))


_NEEDS = Needs(
    (Access.SUBSCRIBE, Access.CALL),
    "the topic or service, of the site",
    key="rmpa/1/<site>/-gateway/why",
)
ACCESS: Final = {SourceKind.TOPIC: Access.SUBSCRIBE, SourceKind.SERVICE: Access.CALL}
"""What a module or a site must be allowed to be told of a source."""
_KINDS = {SourceKind.TOPIC: "topic", SourceKind.SERVICE: "service"}
_PARTS = {SourceKind.TOPIC: "topics", SourceKind.SERVICE: "services"}
_ReportKey = tuple[SourceKind, str, str, str, str, str]
"""Kind, site, module, node, name there, and the site that it is for (empty: for all)."""


class SiteWhy:
    """The ways of topics and services through this gateway.

    Args:
        site: This site's name.
        gateway: This gateway's name among its peers.
        session: The Zenoh session.
        sites: What is known of sites.
        history: Since when sites are there or away.
        rules: Decide what may cross.
        may: ``(asker, access, name)``: whether a module of this site may have a topic or service, by its name here.
    """

    def __init__(
        self,
        site: str,
        gateway: str,
        session: OpenSession,
        sites: SiteNeighbour,
        history: SiteHistory,
        rules: CrossingRules,
        may: Callable[[str, Access, str], bool] = lambda _asker, _access, _name: True,
    ) -> None:
        self._site = site
        self._gateway = gateway
        self._session = session
        self._sites = sites
        self._history = history
        self._rules = rules
        self._may = may
        self._queryable: Declaration = session.queryable(why_key(site), self._take, _NEEDS)

    def close(self) -> None:
        """Answer no more."""
        self._queryable.close()

    async def ways(
        self, name: str, site: str = "", module: str = "", asker: str = "", *, service: bool = False
    ) -> list[Diagnosis]:
        """The ways of a name to here from other sites, and from a module of this site to others.

        Args:
            name: A topic or service, by its name at the module that asks.
            site: From this site alone; empty for all.
            module: From this module of it alone; empty for all.
            asker: The module that asks, whose own sources are told of too; empty for this machine's user.
            service: Whether a service is meant.
        """
        known = site in self._sites.catalogue.sites or site in self._history.away
        if not self._sites.leads or (site and not known and not module):
            return []  # a name that is no site's is a peer's
        kinds = (SourceKind.SERVICE,) if service else tuple(ACCESS)
        found = [
            each
            for each in self._here(name, site, module)
            if each.kind in kinds and self._may(asker, ACCESS[each.kind], each.here or each.name)
        ]
        ways = list(await asyncio.gather(*(self._way(each) for each in found)))
        permitted = [kind for kind in kinds if self._may(asker, ACCESS[kind], name)]
        if site and not ways and not permitted:
            denied = permission_there(self._gateway, asker, ACCESS[kinds[0]], name)
            return [self._diagnosis(name, f"{site}/{module}" if module else site, "", kinds[0], [denied])]
        if site and not ways:
            ways.append(await self._no_way(name, site, module, permitted))
        if not site and permitted:
            for away, had in self._history.had(name):
                ways.append(await self._no_way(name, away, had, permitted))
        if not site:

            def own(source: MeshSource) -> bool:
                mine = source.module == asker and source.name == name if asker else source.here == name
                return mine and source.kind in kinds

            ways += [msgspec.structs.replace(way, name=name) for way in self._leaving(own)]
        return ways

    # --- what comes in ----------------------------------------------------------------------------------------------

    def _here(self, name: str, site: str, module: str) -> Iterator[SourceHere]:
        reports = self._reports("in")
        for entry in self._sites.imports.entries:
            source, there = entry.source, entry.announced
            if name not in (source.name, there.name) or not _meant(there, site, module):
                continue
            if name != source.name and not site:
                continue  # its name there is asked for with its site alone
            key = source.kind, source.site, source.module, source.node, there.name, ""
            rule = self._rules.incoming(
                source.kind, source.site, source.module, there.name, source.type, source.node
            ).why
            yield SourceHere(
                source.kind,
                source.site,
                source.module,
                source.node,
                there.name,
                source.name,
                "",
                rule,
                reports.get(key),
            )
        for there, why in self._sites.imports.refusals():
            if there.name == name and _meant(there, site, module):
                yield SourceHere(
                    there.kind, there.module.site, there.module.name, there.node, there.name, refused=why
                )

    async def _way(self, here: SourceHere) -> Diagnosis:
        ways, refusal = await self._ask(here.site, here.name, here.module)
        mine = _KINDS[here.kind], here.module
        there = next((way for way in ways if (way.kind, way.peer) == mine and way.node in (here.node, "")), None)
        stages = [
            self._site_stage(here.site),
            *_told(here.site, here.module, here.name, there, refusal),
            *here_stages(self._site, here),
        ]
        unheard = next((at for at, stage in enumerate(stages) if stage.name == DEMAND_THERE), None)
        if unheard is not None and stages[unheard].level is not OK and here.report and here.report.get("wanted"):
            text = f"a node here subscribes, and the gateway of {here.site} hears of none: a router keeps it back"
            stages[unheard] = Check("router", FAIL, text, ROUTER)
        return self._diagnosis(here.here or here.name, f"{here.site}/{here.module}", here.node, here.kind, stages)

    async def _no_way(self, name: str, site: str, module: str, kinds: list[SourceKind]) -> Diagnosis:
        """A site is named that has nothing of that name, as it is seen here; of kinds that the asker may have."""
        service = SourceKind.TOPIC not in kinds
        ways, refusal = await self._ask(site, name, module, service=service)
        there = next((way for way in ways if way.kind in [_KINDS[kind] for kind in kinds]), None)
        stages = [self._site_stage(site), *_told(site, module, name, there, refusal)]
        if there is not None and there.flows:
            text = f"site {site} offers it, and the offer has not come here"
            remedy = "in a moment? else routers that do not reach each other, or too many sources: `rmpa site info`"
            stages.append(Check("offer", FAIL, text, remedy))
        elif refusal:
            stages.append(
                Check("offer", FAIL, f"site {site} announces no {name}", f"`rmpa why {name}` there tells more")
            )
        kind = SourceKind.SERVICE if service else SourceKind.TOPIC
        return self._diagnosis(
            name, f"{site}/{module}" if module else site, there.node if there else "", kind, stages
        )

    def _site_stage(self, site: str) -> Check:
        gateways = len(self._sites.catalogue.gateways(site))
        if site not in self._sites.catalogue.sites:
            if site in self._history.away:
                text = f"site {site} is unreachable since {self._history.since_ago(site) or 0:.0f} s"
                return Check(
                    "site", FAIL, text, "is its gateway on, and its way to the router? `rmpa site list` there"
                )
            text = f"no gateway of a site {site} is at the routers that this site's gateway reaches"
            return Check("site", FAIL, text, "`rmpa site list` shows the sites; gateway.connect of both must meet")
        if not gateways:
            text = f"there is no gateway at site {site} any more, and what it announced is about to go"
            return Check("site", FAIL, text, f"start `rmpa gateway --site {site}` there")
        return Check("site", OK, f"site {site} is joined by {gateways} gateway{'s' if gateways > 1 else ''}")

    def _diagnosis(self, name: str, peer: str, node: str, kind: SourceKind, stages: list[Check]) -> Diagnosis:
        return Diagnosis.of(
            until_failure(stages), kind=_KINDS[kind], name=name, peer=peer, to=f"site {self._site}", node=node
        )

    # --- what goes out ----------------------------------------------------------------------------------------------

    def _leaving(self, meant: Callable[[MeshSource], bool], asking: str = "") -> Iterator[Diagnosis]:
        """The ways of sources of this site to the one that is ``asking``; empty: for its own module, to all."""
        reports, exports, hidden = self._reports("out"), self._sites.exports, set()
        for entry in exports.entries:
            source, to = entry.source, entry.announced.to
            if not meant(source):
                continue
            refused = self._rules.refusal(asking, source.module, source.name, ACCESS[source.kind]) if asking else ""
            if asking and to not in ("", asking):
                if not refused or source in hidden:
                    continue  # another entry is the one for the site that asks
                hidden.add(source)
            rule = self._rules.outgoing(source.kind, source.module, source.name, source.type, source.node).why
            if to:
                rule = self._rules.outgoing_to(to, source.module, source.name).why
            report = reports.get((source.kind, self._site, source.module, source.node, source.name, to), {})
            yield self._way_out(source, asking, to, rule, refused, report)
        for source, why in exports.refusals():
            if meant(source):
                yield self._way_out(source, asking, "", "", why, {})

    def _way_out(
        self, source: MeshSource, asking: str, to: str, rule: str, refused: str, report: dict[str, Any]
    ) -> Diagnosis:
        where = "there" if asking else "here"
        text = f"{source.node} of {source.module} at {self._site} has it: {source.type}"
        stages = [Check(f"source {where}", OK, text)]
        if refused:
            stages.append(refused_stage(where, refused, self._site))
        else:
            stages.append(Check(f"rule {where}", OK, rule or "it may go out"))
            if source.kind is SourceKind.TOPIC:
                if problem := report.get("problem"):
                    remedy = f"`rmpa why {source.name}` at {self._site}"
                    stages.append(Check(f"publisher {where}", FAIL, str(problem), remedy))
                stages += sent_stages(self._site, report, asked=bool(asking))
        return Diagnosis.of(
            until_failure(stages),
            kind=_KINDS[source.kind],
            name=source.name if asking else source.here,
            peer=source.module,
            to=f"site {asking or to}" if asking or to else "other sites",
            node=source.node,
        )

    def _reports(self, way: str) -> dict[_ReportKey, dict[str, Any]]:
        """What the parts report of each source."""
        found: dict[_ReportKey, dict[str, Any]] = {}
        parts = self._sites.report().get("parts")
        for kind, part in _PARTS.items():
            report = parts.get(part) if isinstance(parts, dict) else None
            for each in report.get(way, ()) if isinstance(report, dict) else ():
                site, node, to = each.get("site", self._site), each.get("node", ""), each.get("to", "")
                found[kind, site, each["module"], node, each["name"], to] = each
        return found

    # --- the other gateway --------------------------------------------------------------------------------------

    async def _ask(
        self, site: str, name: str, module: str, *, service: bool = False
    ) -> tuple[tuple[Diagnosis, ...], str]:
        """What the gateway of a site tells, and why it does not."""
        if site not in self._sites.catalogue.sites:
            return (), "it is not there"
        question = msgspec.json.encode(WhyQuestion(site=self._site, name=name, module=module, service=service))
        replies = await self._session.get(why_key(site), question, timeout=limits.SITE_ASK_TIMEOUT, all_complete=True)
        problem = "it does not answer; is it of an earlier release?"
        for reply in replies:
            try:
                if reply.ok:
                    return parse_ways(reply.payload), ""
                problem = reply.payload.decode(errors="replace")
            except RemoteProtocolError as error:
                problem = str(error)
        return (), problem

    def _take(self, query: ArrivedQuery) -> None:
        if not self._sites.leads:
            query.finish()
            return
        try:
            question = WhyQuestion.parse(query.payload)
        except RemoteProtocolError as error:
            query.reply_error(str(error))
            return
        kinds = (SourceKind.SERVICE,) if question.service else tuple(ACCESS)
        denials = {kind: self._rules.denial(question.site, question.name, ACCESS[kind]) for kind in kinds}

        def meant(source: MeshSource) -> bool:
            named = source.name == question.name and question.module in ("", source.module)
            return named and not denials.get(source.kind, "")

        ways = list(self._leaving(meant, question.site))
        if denial := denials[kinds[0]]:
            # Whether or not it is there: that is not told.
            stages = [refused_stage("there", denial, self._site)]
            ways.append(self._diagnosis(question.name, question.module, "", kinds[0], stages))
        query.reply(query.key, msgspec.json.encode(ways))
        query.finish()


def _told(site: str, module: str, name: str, there: Diagnosis | None, refusal: str) -> tuple[Check, ...]:
    """The stages of the exporting site, as its gateway tells them."""
    if refusal:
        return (Check("source there", UNKNOWN, f"the gateway of {site} does not tell: {refusal}"),)
    if there is None:
        whose = f"{module} at {site}" if module else f"a module at {site}"
        text = f"no node of {whose} has {name}, as the gateway there sees it"
        remedy = f"start it there; or the [bridge] or [services] of {whose} keeps it at home: `rmpa why {name}` there"
        return (Check("source there", FAIL, text, remedy),)
    return there.stages


def _meant(there: SiteSource, site: str, module: str) -> bool:
    return site in ("", there.module.site) and module in ("", there.module.name)
