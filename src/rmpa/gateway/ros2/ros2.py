"""The neighbour "ROS 2" of the gateway, over rmw_zenoh, with its answers to ``rmpa why`` and ``rmpa site``."""

from __future__ import annotations

import logging
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.agent.trust import trust_store
from rmpa.config.peer_rules import Access
from rmpa.core.contract import Contracts
from rmpa.core.errors import StartError, UnreachableError
from rmpa.core.identity import is_own
from rmpa.gateway import limits
from rmpa.gateway.ros2.actions import Ros2Actions
from rmpa.gateway.ros2.format import EntityKind, Ros2Node, graph_key
from rmpa.gateway.ros2.graph import SITE
from rmpa.gateway.ros2.pairs import PART
from rmpa.gateway.ros2.rclpy_session import RclpySession, shown_in_ros2
from rmpa.gateway.ros2.services import Ros2Context, Ros2Services
from rmpa.gateway.ros2.topics import Ros2Export, Ros2Import, Ros2Publisher, Ros2Topics
from rmpa.gateway.ros2.types import DISTRIBUTIONS
from rmpa.gateway.rules import CrossingRules, MeshSource, SourceKind
from rmpa.gateway.topics import flow
from rmpa.observe.check import FAIL, OK, WARN, Check
from rmpa.observe.sites import PARAM, REPORT, SITE_INFO, SITE_WHY, SiteAnswerer, SiteInfo, SiteSourceInfo, SitesReport
from rmpa.observe.why.diagnosis import Diagnosis, until_failure
from rmpa.ros.types.find import find_message_type

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa.config.rules import GatewaySettings
    from rmpa.config.settings import Settings
    from rmpa.gateway.own_graph import AgentGraph
    from rmpa.gateway.ros2.graph import Declared, Ros2Link
    from rmpa.ros.types.messages import MessageType

_log: Final = logging.getLogger(__name__)
_RULES: Final = "change [[gateway.rule]] in the rmpa.toml of the gateway, and reload it"
_DROPPED: Final = "were dropped by a full queue"
_LIMITED: Final = "were left out for the rule's rate or size"
_UNCONVERTED: Final = "could not be converted"


class Ros2Neighbour:
    """Joins the gateway's graph with a ROS 2 graph: topics, services and actions.

    Args:
        graph: The gateway's own graph.
        session: The Zenoh session.
        settings: The table ``[gateway]``.
        contracts: The contracts of topics; by default those without any rule.
        find: Finds a ROS 1 type on this machine by its name; by default as agents do.

    Attributes:
        sites: Answers for the other sites; ``None``: the gateway joins none.
        permissions: Which linked module may be told of a topic or service, by its name here.

    Raises:
        ConfigError: The distribution is not known, or a mapping file is wrong.
    """

    def __init__(
        self,
        graph: AgentGraph,
        session: Ros2Link,
        settings: GatewaySettings,
        contracts: Contracts | None = None,
        find: Callable[[str], MessageType] = find_message_type,
    ) -> None:
        context = self.context = Ros2Context(graph, session, settings, contracts or Contracts(), find)
        self.topics = Ros2Topics(context)
        self.services = Ros2Services(context)
        # It takes all topics and services of actions, so that no other part carries them.
        self._actions = Ros2Actions(context)
        # By proxy.
        self._sources: dict[str, set[MeshSource]] = {}
        # The proxies that another gateway shows in ROS 2, with its session.
        self._standing_by: dict[str, str] = {}
        self.sites: SiteAnswerer | None = None
        self.permissions = CrossingRules()
        self._watch: Declared | None = None
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
        self._actions.close()
        self.services.close()
        self.topics.close()
        await self.context.close()

    def report(self) -> dict[str, object]:
        """The graph of ROS 2, and the problems, as JSON values."""
        return {
            "nodes": sorted(self.context.ros2.nodes),
            "standing_by": dict(self._standing_by),
            "ignored_tokens": dict(self.context.ros2.ignored),
            "problems": dict(self.context.problems),
        }

    def _token(self, key: str, alive: bool) -> None:
        if self._closed:
            return
        entity = self.context.ros2.change(key, alive=alive)
        if isinstance(entity, Ros2Node):
            self._judge(entity.name)  # of another gateway, if it is of a module
        elif entity is not None:
            _log.debug("%s %s", "+" if alive else "-", entity.token())
            if PART in entity.name:
                self._actions.endpoint(entity, there=alive)
            elif entity.kind is EntityKind.SERVICE:
                self.services.endpoint(entity, there=alive)
            elif entity.kind is not EntityKind.CLIENT:
                self.topics.endpoint(entity, there=alive)
            if alive:
                self.context.asker.appeared()

    def _mesh_source(self, source: MeshSource, there: bool) -> None:
        if self._closed:
            return
        self._judge(source.proxy)
        sources = self._sources.setdefault(source.proxy, set())
        (sources.add if there else sources.discard)(source)
        if source.proxy not in self._standing_by:
            self._offer(source, there=there)
        if not sources:
            del self._sources[source.proxy]
            self._standing_by.pop(source.proxy, None)

    def _judge(self, node: str) -> None:
        """Show a module's node, or stand by for another gateway that shows it: only one of them may."""
        leader, stands_by = self.context.ros2.led_by(node), node in self._standing_by
        if leader and not stands_by:
            _log.info("= the gateway with session %s shows %s in ROS 2; this one is on standby", leader, node)
            self._standing_by[node] = leader
        elif not leader:
            self._standing_by.pop(node, None)
        if bool(leader) != stands_by:
            for source in tuple(self._sources.get(node, ())):
                self._offer(source, there=stands_by)

    def _offer(self, source: MeshSource, *, there: bool) -> None:
        if self._actions.takes(source):
            self._actions.mesh_source(source, there=there)
        elif source.kind is SourceKind.SERVICE:
            self.services.mesh_source(source, there=there)
        else:
            self.topics.mesh_source(source, there=there)

    def ways(self, name: str, site: str = "", module: str = "") -> list[Diagnosis]:
        """The ways of a topic between ROS 2 and the modules.

        ::

            out: rule ─ type ─ heard (hashes) ─ demand ─ sent          in: rule ─ type ─ shown ─ demand ─ arrived

        Args:
            name: The topic, by its name at the module that asks; from ROS 2 alone also by its name there.
            site: From this site alone: ``ros2``; empty for all.
            module: From this module alone; empty for all. ROS 2 has none.
        """
        if site not in ("", SITE):
            return []
        gateway = self.context.graph.name
        ways = []
        for imported in self.topics.imports.values():
            if name in (imported.decision.name, imported.first.name if site else ""):
                for each in imported.publishers.values():
                    stages = until_failure(_in_stages(imported, each))
                    ways.append(_way(stages, imported.decision.name, each.node, SITE, gateway))
        for export in self.topics.exports() if not site else ():
            source = export.source
            if source.here == name:
                stages = until_failure(_out_stages(export, self.context.problems))
                ways.append(_way(stages, name, source.node, source.module, SITE))
        for what, why in self.topics.refused.items():
            topic, _, node = what.partition(" of ")
            coming = not is_own(node)
            if topic == name and (coming or not site):
                ends = (SITE, gateway) if coming else (gateway, SITE)
                ways.append(_way((Check("rule", FAIL, why, _RULES),), name, node, *ends))
        return [way for way in ways if module in ("", way.peer)]

    async def answer(self, what: str, args: dict[str, Any], asker: str = "", /) -> Any:
        """The reply to one question of ``observe.operations``; raises as that says."""
        name, site, module = (str(args.get(key) or "") for key in ("name", "site", "module"))
        if what == SITE_WHY:
            visible = any(self.permissions.tells(asker, kind, name) for kind in SourceKind)
            ways = self.ways(name, site, module) if visible and args.get("service") is not True else []
            return [*ways, *(await self.sites.answer(what, args, asker) if self.sites is not None else ())]
        if what == PARAM and site == SITE:
            denial = partial(self.permissions.denial, asker, access=Access.CALL)
            return await self.context.asker.parameters(args, denial if asker else lambda _: "")
        if what == REPORT or (what == SITE_INFO and site == SITE):
            report = await self._report(asker)
            if what == SITE_INFO:
                return msgspec.structs.replace(report, sites=(self._site(asker, sources=True),))
            return msgspec.structs.replace(report, sites=(*report.sites, self._site(asker, sources=False)))
        if self.sites is None:
            raise UnreachableError(f"site {site!r}", "this gateway", f"it joins {SITE} alone")
        return await self.sites.answer(what, args, asker)

    async def _report(self, asker: str) -> SitesReport:
        if self.sites is not None:
            found: SitesReport = await self.sites.answer(REPORT, {}, asker)
            return found
        context = self.context
        endpoints = context.session.endpoints
        problem = "" if endpoints else "it is connected to no other Zenoh session"
        return SitesReport(gateway=context.graph.name, site="", leads=True, problem=problem, endpoints=endpoints)

    def _site(self, asker: str, *, sources: bool) -> SiteInfo:
        listed = list(self._rows(asker)) if sources else []
        return SiteInfo(
            name=SITE,
            state="joined",
            gateways=1,
            sources=tuple(listed[: limits.SITE_REPORT_SOURCES_MAX]),
            not_shown=len(self.topics.refused),
            beyond=max(0, len(listed) - limits.SITE_REPORT_SOURCES_MAX),
        )

    def _rows(self, asker: str) -> Iterator[SiteSourceInfo]:
        """What ROS 2 has, with what is wrong with it; then problems of what the modules have."""
        rows: list[tuple[SourceKind, str, str, str, str, str]] = [
            (SourceKind.TOPIC, each.first.name, one.node, each.ros1_type, each.decision.name, each.problem_of(one))
            for each in self.topics.imports.values()
            for one in each.publishers.values()
        ]
        rows += [
            (SourceKind.SERVICE, name, "", one.server.type, name, "") for name, one in self.services.shown.items()
        ]
        for what, problem in self.context.problems.items():
            name, _, node = what.partition(" of ")
            rows.append((SourceKind.TOPIC, name, node, "*", "", problem))
        for kind, name, node, type_name, here, problem in rows:
            if self.permissions.tells(asker, kind, here or name):
                row = {"node": node, "name": name, "type": type_name, "here": here, "problem": problem}
                yield SiteSourceInfo(kind=kind.name.lower(), module="", **row)


def _way(stages: tuple[Check, ...], name: str, node: str, peer: str, to: str) -> Diagnosis:
    return Diagnosis.of(stages, name=name, peer=peer, to=to, node=node)


def _out_stages(export: Ros2Export, problems: Mapping[str, str]) -> Iterator[Check]:
    yield Check("rule", OK, export.why)
    if problem := export.problem or (
        problems.get(shown_in_ros2(export.endpoint.endpoint)) if export.endpoint is not None else ""
    ):
        yield Check("type", FAIL, problem)
    if export.endpoint is None:
        text = f"ROS 2 has no {export.source.type}; its publisher is being asked for the definition"
        yield Check("type", WARN, text)
        return
    kept = ", transient local" if export.latched else ""
    yield Check("type", OK, f"it is {export.endpoint.endpoint.type} in ROS 2{kept}")
    ends = ((what.partition(" of "), text) for what, text in problems.items())
    deaf = [
        f"{node}: {text}"
        for (topic, _, node), text in ends
        if topic == export.source.here and node.startswith("/") and not is_own(node)
    ]
    if deaf:
        yield Check("heard", WARN if export.wanted else FAIL, "; ".join(deaf))
    if not export.wanted:
        yield Check("demand", WARN, "no node of ROS 2 subscribes: nothing is sent")
        return
    yield Check("demand", OK, "a node of ROS 2 subscribes")
    waiting = f", {export.waiting} wait" if export.waiting else ""
    losses = (
        (export.dropped, _DROPPED),
        (export.limited, _LIMITED),
        (export.unconverted, _UNCONVERTED),
    )
    yield flow("sent", f"{export.messages} messages were sent{waiting}", export.messages, losses)


def _in_stages(imported: Ros2Import, publisher: Ros2Publisher) -> Iterator[Check]:
    here, there = imported.decision.name, imported.first
    yield Check("rule", OK, imported.decision.why)
    own = imported.declared
    in_ros2 = imported.part.context.problems.get(shown_in_ros2(own), "") if own is not None else ""
    if problem := imported.problem_of(publisher) or in_ros2:
        yield Check("type", FAIL, problem)
    kept = ", transient local" if publisher.latched else ""
    yield Check("type", OK, f"{there.type} of ROS 2 is {imported.ros1_type} here{kept}")
    was = f" (ROS 2's {there.name})" if there.name != here else ""
    yield Check("shown", OK, f"it is {here} here{was}, at /rmpa/{SITE}{publisher.node}")
    if not publisher.wanted:
        yield Check("demand", WARN, "no node of a module subscribes: it crosses once one does")
        return
    yield Check("demand", OK, "a node of a module subscribes")
    losses = (
        (imported.sequences.lost, "were lost on the way, by their numbers"),
        (publisher.dropped, _DROPPED),
        (imported.limited, _LIMITED),
        (imported.unconverted, _UNCONVERTED),
        (imported.early.dropped, "came before a node subscribed"),
    )
    yield flow("arrived", f"{publisher.received} messages have come", publisher.received, losses)


def make_ros2_neighbour(graph: AgentGraph, session: Ros2Link, settings: Settings) -> Ros2Neighbour:
    """Make the neighbour, after that of the sites if there is one, and have it answer; it is not started.

    Raises:
        ConfigError: A setting of it is wrong.
    """
    agent, gateway = graph.agent, settings.gateway
    if isinstance(session, RclpySession) and session.hello["distribution"] in DISTRIBUTIONS:
        gateway = replace(gateway, ros2=replace(gateway.ros2, distribution=session.hello["distribution"]))
    neighbour = Ros2Neighbour(graph, session, gateway, settings.make_contracts())
    if isinstance(session, RclpySession):
        session.say, session.hash_of = neighbour.context.say, neighbour.context.types.known_hash
    neighbour.permissions = CrossingRules(gate=agent.bridge.gate)
    neighbour.sites = agent.sites.answerer if settings.gateway.site else None
    agent.sites.serve(neighbour)
    return neighbour


def pythons(chosen: str, environ: Mapping[str, str]) -> list[str]:
    """The Pythons that may be ROS 2's: the chosen one alone, else each ``python3`` of PATH, then the system's.

    A gateway in isolated mode has a Python of its own (the bundle), which is not ROS 2's even if it could import it.
    """
    if chosen:
        return [chosen]
    folders = [*environ.get("PATH", "").split(os.pathsep), "/usr/bin"]
    found = dict.fromkeys(Path(folder).resolve() / "python3" for folder in folders if folder.startswith("/"))
    own = Path(sys.executable).resolve() if sys.flags.isolated else None
    return [str(each) for each in found if os.access(each, os.X_OK) and each.resolve() != own]


async def open_rclpy_session(settings: Settings) -> RclpySession:
    """Start ROS 2's half by the first Python that has rclpy.

    Raises:
        StartError: None has it; or the mesh is secured and ROS 2 is not, and ``gateway.insecure`` is not set.
    """
    gateway, environ = settings.gateway, dict(os.environ)
    store = trust_store(settings)
    secured = store is not None and store.exists
    if secured and not gateway.insecure and environ.get("ROS_SECURITY_ENABLE", "").lower() != "true":
        problem = "is not secured, and this module is in a secured mesh"
        remedy = "set ROS_SECURITY_ENABLE=true and its keystore (SROS 2), or say --insecure"
        raise StartError("ROS 2", problem, remedy, code="no-rclpy")
    asked: list[str] = []
    for python in pythons(gateway.ros2.python, environ):
        session = RclpySession(python, gateway.ros2.domain, settings.name, environ)
        try:
            await session.start()
        except StartError as error:
            asked.append(str(error.problem))
            continue
        return session
    problem = "; ".join(asked) or "no python3 was found"
    remedy = "source ROS 2 (source /opt/ros/<distribution>/setup.bash), or name its Python with --ros2-python"
    raise StartError("ROS 2", problem, remedy, code="no-rclpy")
