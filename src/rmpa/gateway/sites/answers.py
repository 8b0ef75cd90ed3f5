"""The neighbour "other sites" with what answers for it: ``rmpa site`` and ``rmpa why``.

What the gateways of two sites tell each other for ``rmpa why``, and the stages at one of them.

The importing gateway asks the exporting one (``get`` on ``rmpa/1/<site>/-gateway/why``), whose stages it shows as
they are told, between those of the site and its own::

    site ─ source there ─ rule there ─ demand there ─ sent ─ rule here ─ shown ─ header (md5) ─ demand here ─ arrived
"""

from __future__ import annotations

import asyncio
import secrets
import time
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge.policy import BridgeContext, Needs
from rmpa.config.peer_rules import Access
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name
from rmpa.gateway import limits
from rmpa.gateway.rules import ACCESS, CrossingRules, MeshSource, SourceKind
from rmpa.gateway.sites.keys import GATEWAY, ROOT, SiteGateway, SiteModule, SiteSource, read_json
from rmpa.gateway.sites.services import ImportedService
from rmpa.gateway.sites.site import SiteNeighbour
from rmpa.gateway.sites.topics import ImportedTopic, SiteContext
from rmpa.gateway.topics import ExportedTopic, flow
from rmpa.gateway.zenoh.threads import first_answer
from rmpa.observe.check import FAIL, OK, UNKNOWN, WARN, Check
from rmpa.observe.sites import REPORT, SITE_INFO, SITE_WHY, SiteInfo, SiteModuleInfo, SiteSourceInfo, SitesReport
from rmpa.observe.why.diagnosis import Diagnosis, permission_there, until_failure
from rmpa.ros.wire.tcpros import Buffer, printable

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.config.settings import Settings
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.sites.plans import SiteExport, SiteImport
    from rmpa.gateway.zenoh.session import ArrivedQuery, OpenSession

# Seconds for a question to another site's gateway.
_SITE_ASK_TIMEOUT: Final = 5.0

_TEXT: Final = "a text of rmpa why"
_NEEDS: Final = Needs(
    (Access.SUBSCRIBE, Access.CALL), "the topic or service, of the site", key="rmpa/1/<site>/-gateway/why"
)
# The words for what a source is.
KINDS: Final = {SourceKind.TOPIC: "topic", SourceKind.SERVICE: "service"}
_DEMAND_THERE: Final = "demand there"
_NO_DEMAND: Final = "that is no fault; to try it: rmpa topic echo"
_ROUTER: Final = "see access_control of the router, if it is a zenohd with rules of your own"
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
        found = read_json(data, cls, _TEXT, limits.KEY_MAX)
        if not is_global_name(found.name):
            raise RemoteProtocolError(f"{found.name[:80]!r} is not a topic, nor a service")
        return found


def parse_ways(data: Buffer) -> tuple[Diagnosis, ...]:
    """The answer of the leading gateway of a site, its texts without control characters: ways out of that site.

    Raises:
        RemoteProtocolError: It is none.
    """
    ways = read_json(data, tuple[Diagnosis, ...], _TEXT, limits.SITE_WHY_MAX)
    return tuple(msgspec.structs.replace(way, stages=tuple(map(_printable, way.stages))) for way in ways)


def _printable(stage: Check) -> Check:
    return Check(printable(stage.name), stage.level, printable(stage.text), printable(stage.remedy))


def sent_stages(site: str, export: ExportedTopic, *, asked: bool) -> list[Check]:
    """The stages of a topic behind its rule at the exporting gateway.

    Args:
        site: Its site.
        export: The topic.
        asked: Whether another site asks, which knows whether it subscribes; else it is a fault that none does.
    """
    if not export.wanted:
        text = f"no other site subscribes, as the gateway of {site} hears: nothing is sent"
        return [Check(_DEMAND_THERE, WARN if asked else FAIL, text, _NO_DEMAND)]
    waiting = f", {export.waiting} wait" if export.waiting else ""
    text = f"the gateway of {site} has sent {export.messages} messages{waiting}"
    losses = (
        (export.dropped, "were dropped by its queue, for the way is slower than the topic"),
        (export.limited, "were left out by rate or size of the rule"),
    )
    remedy = "rate and size of a [[gateway.rule]] say what may be left out; a contract says what goes first"
    sent = flow("sent", text, export.messages, losses, remedy)
    return [Check(_DEMAND_THERE, OK, "another site subscribes"), sent]


def here_stages(entry: SiteImport, found: ImportedTopic | ImportedService | None) -> list[Check]:
    """The stages of the importing site for what is shown there; ``found`` is ``None`` if it does not lead."""
    source, there, topic = entry.source, entry.announced.name, entry.source.kind is SourceKind.TOPIC
    was = f" (its {there})" if source.name != there else ""
    shown = f"it is {source.name} here{was}, at /rmpa/{source.site}/{source.module}{source.node}"
    stages = [Check("rule here", OK, entry.why or "it may come in"), Check("shown", OK, shown)]
    if found is None:
        return stages
    if found.problem:
        name = "md5" if "md5" in found.problem else "header" if topic else "calls"
        return [*stages, Check(name, FAIL if topic else WARN, found.problem, _ROUTER if name == "header" else "")]
    if isinstance(found, ImportedService):
        return [*stages, Check("calls", OK, f"{found.calls} calls from here, {found.failed} failed")]
    if not found.wanted:
        text = "no node of this site subscribes: it crosses once one does"
        return [*stages, Check("demand here", FAIL, text, _NO_DEMAND)]
    stages.append(Check("demand here", OK, "a node of this site subscribes"))
    if not found.messages:
        return [*stages, Check("arrived", WARN, "no message has come since then", "does its publisher publish?")]
    losses = (
        (found.lost, "were lost between the gateways"),
        (found.mismatched, "have another md5 sum than their header"),
        (found.dropped, "were dropped here for slow subscribers"),
    )
    text = f"{found.messages} messages have come, {found.rate():.1f} Hz"
    return [*stages, flow("arrived", text, found.messages, losses)]


def _refused_stage(where: str, refused: str, site: str) -> Check:
    """The stage of a source that may not cross.

    Args:
        where: ``here`` or ``there``.
        refused: The rule or permission that decided, as text.
        site: The site whose gateway has refused it.
    """
    if "[[permission]]" in refused or refused.startswith("the permissions"):
        return Check(f"permission {where}", FAIL, refused, _PERMISSIONS.format(site))
    return Check(f"rule {where}", FAIL, refused, _RULES.format(site))


def _told(site: str, module: str, name: str, there: Diagnosis | None, refusal: str) -> tuple[Check, ...]:
    """The stages of the exporting site, as its gateway tells them."""
    if refusal:
        return (Check("source there", UNKNOWN, f"the gateway of {site} does not tell: {refusal}"),)
    if there is None:
        whose = f"{module} at {site}" if module else f"a module at {site}"
        text = f"no node of {whose} has {name}, as the gateway there sees it"
        remedy = (
            f"start it there; or the [bridge] or [services] of {whose} does not let it cross: `rmpa why {name}` there"
        )
        return (Check("source there", FAIL, text, remedy),)
    return there.stages


class SiteAnswers:
    """Answers questions about other sites, of this machine and of linked modules: a ``SiteAnswerer``.

    Args:
        sites: The neighbour "other sites".
    """

    def __init__(self, sites: SiteNeighbour) -> None:
        self._sites = sites
        self._rules = sites.context.rules
        self._site = sites.own.site
        session = sites.context.session
        sites.questions.append(lambda: session.queryable(_why_key(self._site), self._take, _NEEDS))

    async def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Any:
        """The reply to one question of ``observe.operations``; raises as that says."""
        name, site, module = (str(args.get(key) or "") for key in ("name", "site", "module"))
        others = {*self._sites.catalogue.sites, *self._sites.catalogue.away} - {self._site}
        known = [self._site, *sorted(others)]
        if what == REPORT:
            return self._report(known, asker, sources=False)
        if what == SITE_WHY:
            return await self.ways(name, site, module, asker, service=args.get("service") is True)
        if what == SITE_INFO:
            # Of a site that is not known the names of all are the answer.
            return self._report([site] if site in known else known, asker, sources=site in known)
        raise RemoteProtocolError(f"{what[:80]!r} is no question about sites")

    def _owns(self, asker: str, module: str) -> bool:
        """Whether what a module of this site has is told by this gateway: the others it asks itself."""
        return not self._rules.secured or asker in ("", module)

    def _report(self, names: list[str], asker: str, *, sources: bool) -> SitesReport:
        endpoints = self._sites.context.session.endpoints
        return SitesReport(
            gateway=self._sites.context.graph.name,
            site=self._site,
            leads=self._sites.leads,
            rank=self._sites.own.rank,
            problem="" if endpoints else "it is connected to no other Zenoh session",
            endpoints=endpoints,
            sites=tuple(
                (self._this_site if name == self._site else self._other)(name, asker, sources) for name in names
            ),
        )

    def _this_site(self, name: str, asker: str, sources: bool) -> SiteInfo:
        judged = list(self._sites.exports.judged())
        modules = sorted({(source.module, source.instance) for source, entries, _ in judged if entries})
        visible = [each for each in judged if self._owns(asker, each[0].module)]
        rows = [
            _source_info(source, source.module, source.here, "" if entries else why)
            for source, entries, why in sorted(visible, key=lambda each: (each[0].name, each[0].module))
        ]
        return SiteInfo(
            name=name,
            state="this site",
            gateways=1,
            modules=tuple(
                _counted(module, run, [row for row in rows if row.module == module and not row.problem])
                for module, run in modules
            ),
            sources=tuple(rows[: limits.SITE_REPORT_SOURCES_MAX]) if sources else (),
            not_shown=sum(bool(why) for _, _, why in visible),
        )

    def _other(self, name: str, asker: str, sources: bool) -> SiteInfo:
        catalogue = self._sites.catalogue
        if name not in catalogue.sites:
            return SiteInfo(name=name, state="unreachable", since_ago=catalogue.since_ago(name, time.monotonic()))
        rows: list[SiteSourceInfo] = []
        modules = []
        for module in catalogue.modules(name):
            each = list(self._rows(module, asker))
            modules.append(_counted(module.name, module.instance, each))
            rows += each
        gateways = catalogue.gateways(name)
        return SiteInfo(
            name=name,
            state="joined" if gateways else "no gateway",
            since_ago=catalogue.since_ago(name, time.monotonic()),
            gateways=len(gateways),
            modules=tuple(modules),
            sources=tuple(rows[: limits.SITE_REPORT_SOURCES_MAX]) if sources else (),
            not_shown=sum(bool(row.problem) for row in rows),
            beyond=catalogue.refused(name),
        )

    def _rows(self, module: SiteModule, asker: str) -> Iterator[SiteSourceInfo]:
        for source in self._sites.catalogue.sources(module):
            entry, why = self._sites.imports.outcome(source)
            if self._rules.tells(asker, source.kind, entry.source.name if entry is not None else source.name):
                here = entry.source.name if entry is not None and self._sites.leads else ""
                yield _source_info(source, module.name, here, why)

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
        known = site in self._sites.catalogue.sites or site in self._sites.catalogue.away
        if not self._sites.leads or (site and not known and not module):
            return []  # a name that is no site's is a peer's
        kinds = (SourceKind.SERVICE,) if service else tuple(ACCESS)

        def meant(there: SiteSource, entry: SiteImport | None) -> bool:
            here = entry.source.name if entry is not None else there.name
            named = name in (here, there.name if site else here)  # its name there is asked for with its site alone
            fits = site in ("", there.site) and module in ("", there.module.name)
            return named and fits and there.kind in kinds and self._rules.tells(asker, there.kind, here)

        visible = [each for each in self._sites.imports.judged() if meant(*each[:2])]
        visible.sort(key=lambda each: each[1] is None)
        ways = list(await asyncio.gather(*(self._way(*each) for each in visible)))
        permitted = [kind for kind in kinds if self._rules.tells(asker, kind, name)]
        if site and not ways and permitted:
            ways.append(await self._no_way(name, site, module, permitted))
        elif site and not ways:
            denied = permission_there(self._sites.context.graph.name, asker, ACCESS[kinds[0]], name)
            ways.append(self._diagnosis(name, f"{site}/{module}" if module else site, "", kinds[0], [denied]))
        if site:
            return ways
        for away, had in self._sites.catalogue.had(name) if permitted else ():
            ways.append(await self._no_way(name, away, had, permitted))

        def own(source: MeshSource) -> bool:
            mine = source.module == asker and source.name == name if asker else source.here == name
            return mine and source.kind in kinds

        return [*ways, *(msgspec.structs.replace(way, name=name) for way in self._leaving(own))]

    async def _way(self, there: SiteSource, entry: SiteImport | None, refused: str) -> Diagnosis:
        site, module = there.site, there.module.name
        ways, refusal = await self._ask(site, there.name, module)
        mine = KINDS[there.kind], module
        found = next((way for way in ways if (way.kind, way.peer) == mine and way.node in (there.node, "")), None)
        stages = [self._site_stage(site), *_told(site, module, there.name, found, refusal)]
        found_here = self._sites.imported.get((entry.source, entry.announced.name)) if entry is not None else None
        here = [_refused_stage("here", refused, self._site)] if entry is None else here_stages(entry, found_here)
        unheard = next((at for at, stage in enumerate(stages) if stage.name == _DEMAND_THERE), None)
        wanted = isinstance(found_here, ImportedTopic) and found_here.wanted
        if unheard is not None and stages[unheard].level is not OK and wanted:
            text = f"a node here subscribes, and the gateway of {site} hears of none: a router keeps it back"
            stages[unheard] = Check("router", FAIL, text, _ROUTER)
        name = entry.source.name if entry is not None else there.name
        return self._diagnosis(name, f"{site}/{module}", there.node, there.kind, [*stages, *here])

    async def _no_way(self, name: str, site: str, module: str, kinds: list[SourceKind]) -> Diagnosis:
        """A site is named that has nothing of that name, as it is seen here; of kinds that the asker may have."""
        kind = SourceKind.TOPIC if SourceKind.TOPIC in kinds else SourceKind.SERVICE
        ways, refusal = await self._ask(site, name, module, service=kind is SourceKind.SERVICE)
        there = next((way for way in ways if way.kind in [KINDS[each] for each in kinds]), None)
        stages = [self._site_stage(site), *_told(site, module, name, there, refusal)]
        if there is not None and there.flows:
            text = f"site {site} offers it, and the offer has not come here"
            remedy = "in a moment? else routers that do not reach each other, or too many sources: `rmpa site info`"
            stages.append(Check("offer", FAIL, text, remedy))
        elif refusal:
            text, remedy = f"site {site} announces no {name}", f"`rmpa why {name}` there shows more"
            stages.append(Check("offer", FAIL, text, remedy))
        node = there.node if there is not None else ""
        return self._diagnosis(name, f"{site}/{module}" if module else site, node, kind, stages)

    def _site_stage(self, site: str) -> Check:
        catalogue = self._sites.catalogue
        gateways = len(catalogue.gateways(site))
        if site not in catalogue.sites:
            if site in catalogue.away:
                text = f"site {site} is unreachable since {catalogue.since_ago(site, time.monotonic()) or 0:.0f} s"
                remedy = "is its gateway on, and its way to the router? `rmpa site list` there"
                return Check("site", FAIL, text, remedy)
            text = f"no gateway of a site {site} is at the routers that this site's gateway reaches"
            return Check("site", FAIL, text, "`rmpa site list` shows the sites; gateway.connect of both must meet")
        if not gateways:
            text = f"there is no gateway at site {site} any more, and what it announced is about to go"
            return Check("site", FAIL, text, f"start `rmpa gateway --site {site}` there")
        return Check("site", OK, f"site {site} is joined by {gateways} gateway{'s' if gateways > 1 else ''}")

    def _diagnosis(self, name: str, peer: str, node: str, kind: SourceKind, stages: list[Check]) -> Diagnosis:
        to = f"site {self._site}"
        return Diagnosis.of(until_failure(stages), kind=KINDS[kind], name=name, peer=peer, to=to, node=node)

    def _leaving(self, meant: Callable[[MeshSource], bool], asking: str = "") -> Iterator[Diagnosis]:
        """The ways of sources of this site to the one that is ``asking``; empty: for its own module, to all."""
        for source, entries, why in self._sites.exports.judged():
            if not meant(source):
                continue
            refused = self._rules.refusal(asking, source.module, source.name, ACCESS[source.kind]) if asking else ""
            offered = [entry for entry in entries if not asking or entry.announced.to in ("", asking)]
            for entry in offered:
                yield self._way_out(source, asking, entry, refused)
            if why or (refused and entries and not offered):
                yield self._way_out(source, asking, None, refused or why)

    def _way_out(self, source: MeshSource, asking: str, entry: SiteExport | None, refused: str) -> Diagnosis:
        where, to = "there" if asking else "here", entry.announced.to if entry is not None else ""
        text = f"{source.node} of {source.module} at {self._site} has it: {source.type}"
        stages = [Check(f"source {where}", OK, text)]
        if refused or entry is None:
            stages.append(_refused_stage(where, refused, self._site))
        else:
            rules = self._rules
            rule = rules.outgoing_to(to, source.module, source.name) if to else rules.outgoing(source)
            stages.append(Check(f"rule {where}", OK, rule.why))
            if (export := self._sites.topics.exported(entry)) is not None:
                if export.problem:
                    remedy = f"`rmpa why {source.name}` at {self._site}"
                    stages.append(Check(f"publisher {where}", FAIL, export.problem, remedy))
                stages += sent_stages(self._site, export, asked=bool(asking))
        return Diagnosis.of(
            until_failure(stages),
            kind=KINDS[source.kind],
            name=source.name if asking else source.here,
            peer=source.module,
            to=f"site {asking or to}" if asking or to else "other sites",
            node=source.node,
        )

    async def _ask(
        self, site: str, name: str, module: str, *, service: bool = False
    ) -> tuple[tuple[Diagnosis, ...], str]:
        """What the gateway of a site tells, and why it does not."""
        if site not in self._sites.catalogue.sites:
            return (), "it is not there"
        question = msgspec.json.encode(WhyQuestion(site=self._site, name=name, module=module, service=service))
        replies = await self._sites.context.session.get(
            _why_key(site), question, timeout=_SITE_ASK_TIMEOUT, all_complete=True
        )
        if (reply := first_answer(replies)) is None:
            return (), "it does not answer; is it of an earlier release?"
        try:
            return (parse_ways(reply.payload), "") if reply.ok else ((), reply.text)
        except RemoteProtocolError as error:
            return (), str(error)

    def _take(self, query: ArrivedQuery) -> None:
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
            stages = [_refused_stage("there", denial, self._site)]
            ways.append(self._diagnosis(question.name, question.module, "", kinds[0], stages))
        query.reply(msgspec.json.encode(ways))


def _why_key(site: str) -> str:
    return f"{ROOT}/{site}/{GATEWAY}/why"


def _source_info(source: MeshSource | SiteSource, module: str, here: str, problem: str) -> SiteSourceInfo:
    names = {"module": module, "node": source.node, "name": source.name, "type": source.type, "here": here}
    return SiteSourceInfo(kind=KINDS[source.kind], **names, problem=problem)


def _counted(name: str, instance: str, sources: list[SiteSourceInfo]) -> SiteModuleInfo:
    services = sum(source.kind == "service" for source in sources)
    return SiteModuleInfo(
        name=name,
        instance=instance,
        topics=len(sources) - services,
        services=services,
        shown=sum(bool(source.here) for source in sources),
    )


def make_site_neighbour(graph: AgentGraph, session: OpenSession, settings: Settings) -> SiteNeighbour:
    """Make the neighbour "other sites"; it is not started. ``settings.gateway.site`` is not empty."""
    gateway, agent = settings.gateway, graph.agent
    bridge = BridgeContext.of(settings)
    rules = CrossingRules(gateway.rules, bridge, agent.bridge.gate)
    context = SiteContext(
        gateway.site, graph, session, rules, bridge, settings.make_contracts(), agent.bridge.counters
    )
    neighbour = SiteNeighbour(context, SiteGateway(gateway.site, gateway.rank, secrets.token_hex(16)))
    agent.sites.serve(SiteAnswers(neighbour))
    return neighbour
