"""Services between the mesh and bridges, one object for each.

A bridge answers a call that failed as one that succeeded, with the error's text as the response; here an error is an
error, which bridges understand.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.bridge.permission_gate import Needs
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.gateway.ros1_bridge import limits
from rmpa.gateway.ros1_bridge.keys import BridgedKind, BridgedTopic
from rmpa.ros.wire.services import ServiceDescription

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from rmpa.gateway.neighbour import ForeignSource, MeshSource, OwnGraph
    from rmpa.gateway.ros1_bridge.io.announcer import BridgeAnnouncer
    from rmpa.gateway.zenoh_api import Declared, ZenohQuery, ZenohSession

_NEEDS = Needs(
    (), "the service crosses by `[[gateway.rule]]` for `ros1_bridge`", key="services for zenoh-bridge-ros1"
)
_REMEDY: Final = "is zenoh-bridge-ros1 there connected, and its server alive?"


class BridgedServiceExport:
    """A service of a module that bridges call.

    Args:
        graph: The gateway's graph.
        session: The Zenoh session.
        announcer: Announces it.
        source: The service.
        namespace: The bridge namespace.
        timeout: Seconds that a call may take.
        why: The rule that lets it cross.
    """

    def __init__(
        self,
        graph: OwnGraph,
        session: ZenohSession,
        announcer: BridgeAnnouncer,
        source: MeshSource,
        namespace: str,
        timeout: float,
        why: str,
    ) -> None:
        self._graph = graph
        self._session = session
        self._announcer = announcer
        self.source: Final = source
        self._namespace = namespace
        self._timeout = timeout
        self._why = why
        self._topic: BridgedTopic | None = None
        self._queryable: Declared | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._calls = self._failed = 0
        self._problem = "its server was not asked for its type yet"

    def start(self) -> None:
        """Ask its server for its type, which the key has, and announce it."""
        self._run(self._learn())

    def close(self) -> None:
        """Announce it no more; calls under way get no answer."""
        for task in self._tasks:
            task.cancel()
        if self._queryable is not None:
            self._queryable.close()
            self._queryable = None
        if self._topic is not None:
            self._announcer.remove(BridgedKind.SERVICE, self._topic)
            self._topic = None

    def report(self) -> dict[str, object]:
        """Its state, as JSON values."""
        return {
            "direction": "out",
            "service": self.source.here,
            "module": self.source.module,
            "node": self.source.node,
            "type": "" if self._topic is None else self._topic.type,
            "rule": self._why,
            "calls": self._calls,
            "failed": self._failed,
            "problem": self._problem,
        }

    async def _learn(self) -> None:
        while self._topic is None:
            try:
                async with asyncio.timeout(limits.TYPE_TIMEOUT):
                    found = await self._graph.describe(self.source)
            except (RmpaError, TimeoutError) as error:
                self._problem = f"its server does not tell its type: {error}"
                await asyncio.sleep(limits.TYPE_TIMEOUT)
                continue
            self._problem = ""
            self._topic = BridgedTopic(self.source.here, found.type, found.md5sum, self._namespace)
            self._queryable = self._session.queryable(self._topic.key(), self._asked, _NEEDS)
            self._announcer.add(BridgedKind.SERVICE, self._topic)

    def _asked(self, query: ZenohQuery) -> None:
        if len(self._tasks) >= limits.CALLS_MAX:
            self._failed += 1
            query.reply_error(f"{len(self._tasks)} calls of {self.source.here} are under way")
            return
        self._run(self._answer(query))

    async def _answer(self, query: ZenohQuery) -> None:
        self._calls += 1
        try:
            async with asyncio.timeout(self._timeout):
                response = await self._graph.call(self.source, query.payload, self._timeout)
        except PeerRefused as error:
            self._failed += 1
            query.reply_error(error.reason)
        except (RmpaError, TimeoutError) as error:
            self._failed += 1
            query.reply_error(str(error) or f"no answer within {self._timeout:g} s")
        else:
            query.reply(query.key, bytes(response))
            query.finish()

    def _run(self, work: Coroutine[object, object, None]) -> None:
        task = asyncio.get_running_loop().create_task(work, name=f"zenoh-bridge-ros1 {self.source.here}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


class BridgedServiceImport:
    """A service of a bridge in the gateway's graph.

    Args:
        graph: The gateway's graph.
        session: The Zenoh session.
        announcer: Announces a client, without which the bridge does not serve.
        topic: The service.
        source: What it is here.
        timeout: Seconds that a call may take.
        why: The rule that lets it cross.
    """

    def __init__(
        self,
        graph: OwnGraph,
        session: ZenohSession,
        announcer: BridgeAnnouncer,
        topic: BridgedTopic,
        source: ForeignSource,
        timeout: float,
        why: str,
    ) -> None:
        self._session = session
        self._announcer = announcer
        self._topic = topic
        self.source_here: Final = source
        self._timeout = timeout
        self._why = why
        self._calls = self._failed = 0
        announcer.add(BridgedKind.CLIENT, topic)
        self._foreign = graph.show_service(source, self._serve, self._describe)

    def close(self) -> None:
        """Take it out of the graph."""
        self._foreign.close()
        self._announcer.remove(BridgedKind.CLIENT, self._topic)

    def report(self) -> dict[str, object]:
        """Its state, as JSON values."""
        return {
            "direction": "in",
            "service": self._topic.name,
            "here": self.source_here.name,
            "node": self.source_here.node,
            "type": self._topic.type,
            "rule": self._why,
            "calls": self._calls,
            "failed": self._failed,
            "problem": self._foreign.problem,
        }

    async def _describe(self) -> ServiceDescription:
        kind = self._topic.type
        return ServiceDescription(kind, self._topic.md5, f"{kind}Request", f"{kind}Response")

    async def _serve(self, request: bytes) -> bytes:
        self._calls += 1
        replies = await self._session.get(self._topic.key(), request, timeout=self._timeout)
        for reply in replies:
            if reply.ok:
                return reply.payload
        self._failed += 1
        if replies:
            raise PeerRefused("zenoh-bridge-ros1", replies[0].payload.decode(errors="replace"))
        raise UnreachableError(f"server of {self._topic.name}", "a zenoh-bridge-ros1", _REMEDY)
