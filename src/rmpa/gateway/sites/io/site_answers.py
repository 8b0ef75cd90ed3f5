"""Answers ``rmpa site``, ``rmpa param`` and ``rmpa why`` about other sites, to this machine and to linked modules."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.identity import peer_name_problem
from rmpa.core.names import is_global_name
from rmpa.gateway import limits
from rmpa.gateway.neighbour import SourceKind
from rmpa.gateway.sites.attachment import SiteAttachment
from rmpa.gateway.sites.io.site_why import ACCESS
from rmpa.gateway.sites.last_values import HEADER, ValueHeader, ValueKey, value_key
from rmpa.gateway.sites.part import PassivePart
from rmpa.gateway.sites.services import NO_MD5
from rmpa.observe.io.site_requests import BODY, INFO, LAST, PARAM, REPORT, WHY
from rmpa.observe.sites import LastValueInfo, SiteInfo, SiteModuleInfo, SiteSourceInfo, SitesReport, ValuePortion

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable

    from rmpa.config.permission_rules import Access
    from rmpa.gateway.sites.history import SiteHistory
    from rmpa.gateway.sites.io.seen_values import SiteSeenValues
    from rmpa.gateway.sites.io.site_why import SiteWhy
    from rmpa.gateway.sites.keys import SiteGateway, SiteModule
    from rmpa.gateway.sites.known_sites import Sites
    from rmpa.gateway.zenoh_api import ZenohReply, ZenohSession

_KINDS: Final = {SourceKind.TOPIC: "topic", SourceKind.SERVICE: "service"}


class SiteAnswers(PassivePart):
    """A ``SiteAnswerer``, and a ``SitePart`` to be closed.

    Args:
        gateway: This gateway's name.
        own: This gateway among those of its site.
        session: The Zenoh session.
        sites: What is known of sites.
        history: Since when sites are there or away.
        seen: What came of other sites' latched topics, which answers for a site that is off as a whole.
        endpoints: The Zenoh endpoints that the session is connected to.
        ask_param: Asks a module of another site about a parameter: asker, site, module, question, arguments.
        why: Tells the ways of a topic or a service through this gateway; closed here.
        stamp: The wall clock, nanoseconds since 1970.
        may: ``(asker, access, name)``: whether a module of this site may have a topic or service, by its name here.
            ``None``: trust is off, and each may have all.
    """

    name = "answers"

    def __init__(
        self,
        gateway: str,
        own: SiteGateway,
        session: ZenohSession,
        sites: Sites,
        history: SiteHistory,
        seen: SiteSeenValues,
        endpoints: Callable[[], tuple[str, ...]],
        ask_param: Callable[[str, str, str, str, dict[str, Any]], Awaitable[object]],
        why: SiteWhy,
        stamp: Callable[[], int],
        may: Callable[[str, Access, str], bool] | None = None,
    ) -> None:
        self._gateway = gateway
        self._own = own
        self._session = session
        self._sites = sites
        self._history = history
        self._seen = seen
        self._endpoints = endpoints
        self._ask_param = ask_param
        self._why = why
        self._stamp = stamp
        self._may = may
        self._readings: dict[tuple[str, str, str, str], bytes] = {}
        self._forgetting: asyncio.TimerHandle | None = None

    async def close(self) -> None:
        """Forget what is being read, and answer other gateways no more."""
        self._why.close()
        self._readings.clear()
        if self._forgetting is not None:
            self._forgetting.cancel()

    async def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Any:
        """The reply to one question of ``observe.io.site_requests``; raises as that says."""
        if what == REPORT:
            return self._report(self._site_names(), asker, sources=False)
        if what == WHY:
            name, site, module = (str(args.get(key) or "") for key in ("name", "site", "module"))
            return await self._why.ways(name, site, module, asker, service=args.get("service") is True)
        site = str(args.get("site", ""))
        if what == INFO:
            return await self._info(site, asker)
        module = str(args.get("module", ""))
        for name in (site, module):
            if peer_name_problem(name) is not None:
                raise RemoteProtocolError(f"{name[:80]!r} is not the name of a site or a module")
        if what in (LAST, BODY) and site == self._own.site and not self._owns(asker, module):
            # This gateway's permissions say nothing about what that module lets the asking one have.
            raise PeerRefused(site, f"{module} is a module of this very site: subscribe to it")
        if what == LAST:
            return await self._last(site, module, _topic(args))
        if what == BODY:
            return await self._portion(site, module, _topic(args), args)
        self._require(site)
        if what == PARAM:
            inner = args.get("args")
            if not isinstance(inner, dict):
                raise RemoteProtocolError("a question about a parameter has no arguments")
            return await self._ask_param(asker, site, module, str(args.get("what", "")), inner)
        raise RemoteProtocolError(f"{what[:80]!r} is no question about sites")

    async def _info(self, site: str, asker: str) -> SitesReport:
        known = self._site_names()
        seen = await self._seen.of_site(site)
        if site not in known and not seen:
            return self._report(known, asker, sources=False)  # the names of all are the answer
        report = self._report([site], asker, sources=True)
        away = self._is_away(site)
        told = {key: header for key, header in seen.items() if self._tells(asker, SourceKind.TOPIC, key.topic)}
        values = [_info(key, header, self._own.site, text=False) for key, header in told.items()] if away else []
        found = msgspec.structs.replace(report.sites[0], values=(*report.sites[0].values, *_sorted(values)))
        return msgspec.structs.replace(report, sites=(found,))

    def _tells(self, asker: str, kind: SourceKind, name: str) -> bool:
        """Whether a module of this site is told of a topic or service that has this name here."""
        return self._may is None or self._may(asker, ACCESS[kind], name)

    def _owns(self, asker: str, module: str) -> bool:
        """Whether what a module of this site has is told by this gateway: the others it asks itself."""
        return self._may is None or asker in ("", module)

    def _is_away(self, site: str) -> bool:
        """Whether a site is another one that is not there now."""
        return site != self._own.site and site not in self._sites.catalogue.sites

    # --- what is there ----------------------------------------------------------------------------------------------

    def _site_names(self) -> list[str]:
        others = {*self._sites.catalogue.sites, *self._history.away} - {self._own.site}
        return [self._own.site, *sorted(others)]

    def _require(self, site: str) -> None:
        if site == self._own.site or site in self._sites.catalogue.sites:
            return
        ago = self._history.since_ago(site)
        if ago is not None:
            raise RmpaError(f"site {site} is unreachable since {ago:.0f} s; `rmpa site list` shows all")
        known = ", ".join(self._sites.catalogue.sites) or "none"
        raise UnreachableError(f"site {site!r}", "any Zenoh router that this gateway reaches", f"known are: {known}")

    def _report(self, names: list[str], asker: str, *, sources: bool) -> SitesReport:
        found = self._sites.report()
        return SitesReport(
            gateway=self._gateway,
            site=self._own.site,
            leads=self._sites.leads,
            rank=self._own.rank,
            problem="" if self._endpoints() else "it is connected to no other Zenoh session",
            endpoints=self._endpoints(),
            sites=tuple(
                self._this_site(asker, sources=sources, parts=found.get("parts"))
                if name == self._own.site
                else self._other(name, asker, sources=sources)
                for name in names
            ),
        )

    def _this_site(self, asker: str, *, sources: bool, parts: object) -> SiteInfo:
        exports = self._sites.exports
        modules: dict[tuple[str, str], list[int]] = {}
        for source in exports.sources:
            counts = modules.setdefault((source.module, source.instance), [0, 0])
            counts[source.kind is SourceKind.SERVICE] += self._owns(asker, source.module)
        refused = [(source, why) for source, why in exports.refusals() if self._owns(asker, source.module)]
        listed: list[SiteSourceInfo] = []
        if sources:
            offered = [(source, "") for source in exports.sources if self._owns(asker, source.module)]
            listed = [
                SiteSourceInfo(
                    kind=_KINDS[source.kind],
                    module=source.module,
                    node=source.node,
                    name=source.name,
                    type=source.type,
                    here=source.here,
                    problem=why,
                )
                for source, why in sorted([*offered, *refused], key=lambda each: (each[0].name, each[0].module))
            ]
        return SiteInfo(
            name=self._own.site,
            state="this site",
            gateways=1,
            modules=tuple(
                SiteModuleInfo(name=name, instance=run, topics=counts[0], services=counts[1], shown=sum(counts))
                for (name, run), counts in sorted(modules.items())
            ),
            sources=tuple(listed[: limits.SITE_REPORT_SOURCES_MAX]),
            not_shown=len(refused),
            values=tuple(value for value in _values(parts) if sources and self._owns(asker, value.module)),
        )

    def _other(self, site: str, asker: str, *, sources: bool) -> SiteInfo:
        catalogue = self._sites.catalogue
        if site not in catalogue.sites:
            return SiteInfo(name=site, state="unreachable", since_ago=self._history.since_ago(site))
        refused = {
            (source.kind, source.module, source.node, source.name): why
            for source, why in self._sites.imports.refusals()
            if source.module.site == site and self._tells(asker, source.kind, source.name)
        }
        modules, listed = [], []
        for module in catalogue.modules(site):
            each = self._module(module, asker, refused)
            modules.append(_counted(module, each))
            listed += each
        gateways = catalogue.gateways(site)
        return SiteInfo(
            name=site,
            state="joined" if gateways else "no gateway",
            since_ago=self._history.since_ago(site),
            gateways=len(gateways),
            modules=tuple(modules),
            sources=tuple(listed[: limits.SITE_REPORT_SOURCES_MAX]) if sources else (),
            not_shown=len(refused),
            beyond=catalogue.refused(site),
        )

    def _module(
        self, module: SiteModule, asker: str, refused: dict[tuple[SourceKind, SiteModule, str, str], str]
    ) -> list[SiteSourceInfo]:
        found = []
        for source in self._sites.catalogue.sources(module):
            entry = self._sites.imports.entry(source)
            if not self._tells(asker, source.kind, entry.source.name if entry is not None else source.name):
                continue
            found.append(
                SiteSourceInfo(
                    kind=_KINDS[source.kind],
                    module=module.name,
                    node=source.node,
                    name=source.name,
                    type=source.type,
                    here=entry.source.name if entry is not None and self._sites.leads else "",
                    problem=refused.get((source.kind, module, source.node, source.name), ""),
                )
            )
        return found

    # --- last values ------------------------------------------------------------------------------------------------

    async def _last(self, site: str, module: str, topic: str) -> list[LastValueInfo]:
        """The last values of a topic, from its site; from what was seen of it here if it is away or has none."""
        found: dict[str, LastValueInfo] = {}
        for reply in () if self._is_away(site) else await self._get(value_key(site, module, topic) + f"?{HEADER}"):
            header = ValueHeader.parse(reply.payload)
            value = _info(ValueKey(module, topic, header.node), header)
            if header.node not in found or found[header.node].stamp < value.stamp:  # two gateways may have one
                found[header.node] = value
        if not found:
            for key, header in (await self._seen.of_site(site)).items():
                if (key.module, key.topic) == (module, topic):
                    found[key.node] = _info(key, header, self._own.site)
        if not found:
            self._require(site)
        return [found[node] for node in sorted(found)]

    async def _portion(self, site: str, module: str, topic: str, args: dict[str, Any]) -> ValuePortion:
        offset, node = args.get("offset"), str(args.get("node", ""))
        if not isinstance(offset, int) or offset < 0:
            raise RemoteProtocolError(f"{offset!r} is not an offset in a value")
        key = site, module, topic, node
        body = self._readings.get(key) if offset else None
        if body is None:
            body = self._readings[key] = await self._body(site, module, topic, node)
        portion = body[offset : offset + limits.VALUE_PORTION]
        if offset + len(portion) >= len(body):
            self._readings.pop(key, None)
        self._forget_later()
        return ValuePortion(size=len(body), data=portion)

    async def _body(self, site: str, module: str, topic: str, node: str) -> bytes:
        newest: tuple[int, bytes] | None = None
        for reply in () if self._is_away(site) else await self._get(value_key(site, module, topic)):
            attachment = SiteAttachment.parse(reply.attachment)
            if attachment.node == node and (newest is None or attachment.stamp > newest[0]):
                newest = attachment.stamp, reply.payload
        if newest is not None:
            return newest[1]
        seen = await self._seen.body(site, ValueKey(module, topic, node))
        if seen is None:
            self._require(site)
            raise UnreachableError("value", f"{topic} of {node} of {site}/{module}")
        return seen

    async def _get(self, selector: str) -> list[ZenohReply]:
        asker = SiteAttachment(1, self._stamp(), NO_MD5, "/rmpa", (self._own.site,))
        replies = await self._session.get(
            selector, b"", asker.serialize(), timeout=limits.SITE_ASK_TIMEOUT, all_complete=True
        )
        good = [reply for reply in replies if reply.ok]
        if not good and replies:
            raise PeerRefused("the gateway", replies[0].payload.decode(errors="replace"))
        return good

    def _forget_later(self) -> None:
        if self._forgetting is not None:
            self._forgetting.cancel()
        loop = asyncio.get_running_loop()
        self._forgetting = loop.call_later(limits.VALUE_READING_IDLE, self._readings.clear)


def _counted(module: SiteModule, sources: list[SiteSourceInfo]) -> SiteModuleInfo:
    services = sum(source.kind == "service" for source in sources)
    return SiteModuleInfo(
        name=module.name,
        instance=module.instance,
        topics=len(sources) - services,
        services=services,
        shown=sum(bool(source.here) for source in sources),
    )


def _values(parts: object) -> tuple[LastValueInfo, ...]:
    """The values in the report of ``SiteLastValues``."""
    part = parts.get("last_values") if isinstance(parts, dict) else None
    values = part.get("values", ()) if isinstance(part, dict) else ()
    return _sorted(
        LastValueInfo(
            module=value["module"],
            topic=value["topic"],
            node=value["node"],
            type=value["type"],
            latching=value["latching"],
            stamp=value["stamp"] / 1e9,
            size=value["size"],
        )
        for value in values
    )


def _sorted(values: Iterable[LastValueInfo]) -> tuple[LastValueInfo, ...]:
    return tuple(sorted(values, key=lambda each: (each.topic, each.module, each.node)))


def _info(key: ValueKey, header: ValueHeader, seen_at: str = "", *, text: bool = True) -> LastValueInfo:
    return LastValueInfo(
        module=key.module,
        topic=key.topic,
        node=key.node,
        type=header.type,
        md5sum=header.md5sum,
        definition=header.definition if text else "",
        latching=header.latching,
        stamp=header.stamp / 1e9,
        size=header.size,
        seen_at=seen_at,
    )


def _topic(args: dict[str, Any]) -> str:
    topic = args.get("topic")
    if not isinstance(topic, str) or not is_global_name(topic):
        raise RmpaError(f"{str(topic)[:80]!r} is not a topic")
    return topic
