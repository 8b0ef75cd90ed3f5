"""The neighbour "ROS 2" of the gateway, with its answers to ``rmpa why`` and ``rmpa site``.

ROS 2 in the answers of a gateway: ``rmpa why``, ``rmpa site list`` and ``rmpa site info ros2``.
"""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.config.peer_rules import Access
from rmpa.core.contract import Contracts
from rmpa.core.errors import UnreachableError
from rmpa.gateway import limits
from rmpa.gateway.ros2.actions import Ros2Actions
from rmpa.gateway.ros2.format import GID_BYTES, Ros2Endpoint, graph_key
from rmpa.gateway.ros2.graph import SITE, OwnRos2Nodes, Ros2Crossing, Ros2Graph, Ros2TypeAsker, topic_ways
from rmpa.gateway.ros2.mapping import TypeMapping
from rmpa.gateway.ros2.services import Ros2Context, Ros2Services
from rmpa.gateway.ros2.topics import Ros2Topics
from rmpa.gateway.ros2.types import WITHOUT_HASH, Ros2Types
from rmpa.observe.operations import INFO, REPORT, WHY
from rmpa.observe.peer_info import SiteInfo, SiteSourceInfo, SitesReport

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence

    from rmpa.config.rules import GatewaySettings
    from rmpa.config.settings import Settings
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.ros2.services import Ros2Part
    from rmpa.gateway.zenoh.session import Declaration, OpenSession
    from rmpa.observe.operations import SiteAnswerer
    from rmpa.observe.why.diagnosis import Diagnosis


# ROS 2 over rmw_zenoh as a neighbour of the gateway.


_log: Final = logging.getLogger(__name__)
_GID_BYTES_BEFORE: Final = 24
"""RMW_GID_STORAGE_SIZE up to ROS 2 Humble."""


class Ros2Neighbour:
    """Joins the gateway's graph with a ROS 2 graph, by its parts.

    Args:
        graph: The gateway's own graph.
        session: The Zenoh session.
        settings: The table ``[gateway]``.
        parts: Make what joins actions, services and topics, in the order in which they are asked.
        contracts: The contracts of topics; by default those without any rule.

    Raises:
        ConfigError: The distribution is not known, or a mapping file is wrong.
    """

    def __init__(
        self,
        graph: AgentGraph,
        session: OpenSession,
        settings: GatewaySettings,
        parts: Sequence[Callable[[Ros2Context], Ros2Part]],
        contracts: Contracts | None = None,
    ) -> None:
        ros2 = settings.ros2
        mapping = TypeMapping()
        for path in ros2.mapping:
            mapping.read(Path(path))
        self._tasks: set[asyncio.Task[None]] = set()
        self._problems: dict[str, str] = {}
        self._sources: dict[str, set[MeshSource]] = {}
        self._standing_by: dict[str, str] = {}
        size = _GID_BYTES_BEFORE if ros2.distribution in WITHOUT_HASH else GID_BYTES
        types, there = Ros2Types(ros2.distribution), Ros2Graph(ros2.domain, session.zid)
        nodes = OwnRos2Nodes(session, ros2.domain, graph.name, size)
        self.context: Final = Ros2Context(
            graph,
            session,
            settings,
            contracts if contracts is not None else Contracts(),
            types,
            mapping,
            Ros2Crossing(settings.rules),
            nodes,
            there,
            Ros2TypeAsker(session, nodes, there, types),
            self._spawn,
            self._say,
        )
        self._parts = [make(self.context) for make in parts]
        self._watch: Declaration | None = None
        self._closed = False

    def start(self) -> None:
        """Begin, in the event loop."""
        self._watch = self.context.session.watch_tokens(graph_key(self.context.settings.ros2.domain), self._token)
        self.context.graph.watch(self._mesh_source)

    async def close(self) -> None:
        """Take back all tokens, publishers and subscriptions."""
        self._closed = True
        if self._watch is not None:
            self._watch.close()
        for part in self._parts:
            part.close()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def report(self) -> dict[str, object]:
        """The graph of ROS 2, what each part joins, and the problems, as JSON values."""
        context = self.context
        shown: dict[str, object] = {
            "domain": context.settings.ros2.domain,
            "nodes": sorted(context.ros2.nodes),
            "endpoints": len(context.ros2),
            "standing_by": dict(self._standing_by),
            "ignored_tokens": dict(context.ros2.ignored),
            "problems": dict(self._problems),
        }
        for part in self._parts:
            shown |= part.report()
        return shown

    async def ways(
        self, name: str, site: str = "", module: str = "", asker: str = "", *, service: bool = False
    ) -> list[Diagnosis]:
        """The ways of a topic between ROS 2 and the modules, for ``rmpa why``.

        Args:
            name: The topic, by its name at the module that asks.
            site: From this site alone: ``ros2``; empty for all.
            module: From this module alone; empty for all. ROS 2 has none.
            asker: The module that asks.
            service: Whether a service is meant.
        """
        del asker
        if service or site not in ("", SITE):
            return []
        ways = topic_ways(self.report(), name, self.context.graph.name, here_only=site == SITE)
        return [way for way in ways if module in ("", way.peer)]

    def _token(self, key: str, alive: bool) -> None:
        if self._closed:
            return
        if rival := self.context.ros2.rival(key, alive=alive):
            self._judge_again(rival)
        entity = self.context.ros2.change(key, alive=alive)
        if isinstance(entity, Ros2Endpoint):
            _log.debug("%s %s", "+" if alive else "-", entity.token())
            any(part.endpoint(entity, there=alive) for part in self._parts)
            if alive:
                self.context.asker.appeared()

    def _mesh_source(self, source: MeshSource, there: bool) -> None:
        if self._closed:
            return
        sources = self._sources.setdefault(source.proxy, set())
        (sources.add if there else sources.discard)(source)
        if not sources:
            del self._sources[source.proxy]
        if source.proxy in self._standing_by:
            if not sources:
                self._lead(source.proxy)
        elif there and (leader := self.context.ros2.led_by(source.proxy)):
            self._stand_by(source.proxy, leader)
        else:
            self._offer(source, there=there)

    def _offer(self, source: MeshSource, *, there: bool) -> None:
        any(part.mesh_source(source, there=there) for part in self._parts)

    def _judge_again(self, node: str) -> None:
        """Another gateway shows a node of a module, or does not any more: only one of them may."""
        leader = self.context.ros2.led_by(node)
        if leader and node in self._sources and node not in self._standing_by:
            self._stand_by(node, leader)
            for source in tuple(self._sources[node]):
                self._offer(source, there=False)
        elif not leader and node in self._standing_by:
            self._lead(node)
            for source in tuple(self._sources.get(node, ())):
                self._offer(source, there=True)

    def _stand_by(self, node: str, leader: str) -> None:
        self._standing_by[node] = leader
        _log.info("= the gateway with session %s shows %s in ROS 2; this one stands by", leader, node)

    def _lead(self, node: str) -> None:
        del self._standing_by[node]

    def _spawn(self, work: Coroutine[None, None, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            _log.error("a task of the neighbour ROS 2 ended with an error", exc_info=error)

    def _say(self, subject: str, text: str) -> None:
        if not text:
            self._problems.pop(subject, None)
        elif self._problems.get(subject) != text:
            if len(self._problems) >= limits.ROS2_PROBLEMS_MAX:
                del self._problems[next(iter(self._problems))]
            self._problems[subject] = text
            _log.warning("ROS 2: %s: %s", subject, text)


class Ros2Answers:
    """Answers questions about ROS 2, and has those about other sites answered.

    Args:
        name: The gateway's name among its peers.
        neighbour: ROS 2.
        endpoints: Returns the Zenoh endpoints that the session is connected to.
        sites: Answers for the other sites; ``None``: the gateway joins none.
        may: ``(asker, access, name)``: whether a linked module may have a topic or service, by its name here.
    """

    def __init__(
        self,
        name: str,
        neighbour: Ros2Neighbour,
        endpoints: Callable[[], tuple[str, ...]],
        sites: SiteAnswerer | None = None,
        may: Callable[[str, Access, str], bool] = lambda _asker, _access, _name: True,
    ) -> None:
        self._name = name
        self._neighbour = neighbour
        self._endpoints = endpoints
        self._sites = sites
        self._may = may

    async def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Any:
        """The reply to one question of ``observe.operations``; raises as that says."""
        site = str(args.get("site") or "")
        if what == WHY:
            name, module = (str(args.get(key) or "") for key in ("name", "module"))
            ways: list[Diagnosis] = []
            if self._tells(asker, "topic", name) or self._tells(asker, "service", name):
                ways = await self._neighbour.ways(name, site, module, asker, service=args.get("service") is True)
            return [*ways, *(await self._sites.answer(what, args, asker) if self._sites is not None else ())]
        if what == REPORT or (what == INFO and site == SITE):
            report = await self._report_of_sites(asker)
            if what == INFO:
                return msgspec.structs.replace(report, sites=(self._site(asker, sources=True),))
            return msgspec.structs.replace(report, sites=(*report.sites, self._site(asker, sources=False)))
        if self._sites is None:
            raise UnreachableError(f"site {site!r}", "this gateway", f"it joins {SITE} alone")
        return await self._sites.answer(what, args, asker)

    def _tells(self, asker: str, kind: str, name: str) -> bool:
        """Whether a module is told of a topic or service that has this name here."""
        return self._may(asker, Access.CALL if kind == "service" else Access.SUBSCRIBE, name)

    async def _report_of_sites(self, asker: str) -> SitesReport:
        if self._sites is not None:
            found: SitesReport = await self._sites.answer(REPORT, {}, asker)
            return found
        endpoints = self._endpoints()
        problem = "" if endpoints else "it is connected to no other Zenoh session"
        return SitesReport(gateway=self._name, site="", leads=True, problem=problem, endpoints=endpoints)

    def _site(self, asker: str, *, sources: bool) -> SiteInfo:
        report = self._neighbour.report()
        every = list(_sources(report)) if sources else []
        listed = [source for source in every if self._tells(asker, source.kind, source.here or source.name)]
        refused = report.get("topics_refused")
        return SiteInfo(
            name=SITE,
            state="joined",
            gateways=1,
            sources=tuple(listed[: limits.SITE_REPORT_SOURCES_MAX]),
            not_shown=len(refused) if isinstance(refused, dict) else 0,
            beyond=max(0, len(listed) - limits.SITE_REPORT_SOURCES_MAX),
        )


def _sources(report: Mapping[str, Any]) -> Iterator[SiteSourceInfo]:
    """What ROS 2 has, with what is wrong with it; then problems of what the modules have."""
    for row in report.get("topics", ()):
        if row["direction"] == "in":
            shown = {key: row[key] for key in ("node", "type", "here", "problem")}
            yield SiteSourceInfo(kind="topic", module="", name=row["topic"], **shown)
    for name, kind in report.get("services_in", {}).items():
        yield SiteSourceInfo(kind="service", module="", node="", name=name, type=kind, here=name)
    for what, text in report.get("problems", {}).items():
        name, _, node = what.partition(" of ")
        yield SiteSourceInfo(kind="topic", module="", node=node, name=name, problem=text)


# Makes the neighbour ROS 2 with all its parts, and has it answer for itself.


def make_ros2_neighbour(graph: AgentGraph, session: OpenSession, settings: Settings) -> Ros2Neighbour:
    """Make the neighbour, after that of the sites if there is one; it is not started.

    Raises:
        ConfigError: A setting of it is wrong.
    """
    agent = graph.agent
    parts = (Ros2Actions, Ros2Services, Ros2Topics)
    neighbour = Ros2Neighbour(graph, session, settings.gateway, parts, settings.make_contracts())
    sites = agent.sites.answerer if settings.gateway.site else None
    gate = agent.bridge.gate

    def may(asker: str, access: Access, name: str) -> bool:
        return not asker or gate.judge(access, asker, name).allowed

    agent.sites.serve(Ros2Answers(settings.name, neighbour, lambda: session.endpoints, sites, may))
    return neighbour
