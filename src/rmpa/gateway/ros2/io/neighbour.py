"""ROS 2 over rmw_zenoh as a neighbour of the gateway."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.contract import Contracts
from rmpa.gateway import limits
from rmpa.gateway.ros2.attachment import GID_BYTES
from rmpa.gateway.ros2.crossing import SITE, Ros2Crossing
from rmpa.gateway.ros2.graph import Ros2Graph
from rmpa.gateway.ros2.io.own_nodes import OwnRos2Nodes
from rmpa.gateway.ros2.io.part import Ros2Context
from rmpa.gateway.ros2.io.type_asker import Ros2TypeAsker
from rmpa.gateway.ros2.mapping import TypeMapping
from rmpa.gateway.ros2.tokens import Ros2Endpoint, graph_key
from rmpa.gateway.ros2.types import WITHOUT_HASH, Ros2Types
from rmpa.gateway.ros2.why import topic_ways

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from rmpa.config.rules import GatewaySettings
    from rmpa.gateway.graph.own_graph import AgentGraph
    from rmpa.gateway.neighbour import MeshSource
    from rmpa.gateway.ros2.io.part import Ros2Part
    from rmpa.gateway.zenoh.session import Declaration, OpenSession
    from rmpa.observe.why.diagnosis import Diagnosis

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
