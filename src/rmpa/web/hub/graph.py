"""The graph of the local core: as the agent tells it, else read from the master again and again."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING

from rmpa.core.errors import RmpaError
from rmpa.ros import limits as ros_limits
from rmpa.ros.http.rpc import exchange, read_response
from rmpa.ros.wire.xmlrpc import RosReply, call_pieces
from rmpa.web import limits
from rmpa.web.hub.graph_table import GraphTable, rows_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.observe.control import GraphRows
    from rmpa.ros.node.node import Node
    from rmpa.web.hub.clients import Key
    from rmpa.web.hub.node_link import NodeLink
    from rmpa.web.hub.requests import GraphService, GraphTopic
    from rmpa.web.hub.services import FoundService

_log = logging.getLogger(__name__)


class GraphWatch:
    """The graph, always the last one that was told or read, and the clients that follow it.

    Args:
        link: Has the node.
        found: What is known of services.
        services_changed: ``(names)``: services that have other providers than before.
        master_back: Called when the master answers again after it did not.
    """

    def __init__(
        self,
        link: NodeLink,
        found: Mapping[str, FoundService],
        *,
        services_changed: Callable[[Iterable[str]], None],
        master_back: Callable[[], None],
    ) -> None:
        self._link = link
        link.on_registration.append(self.look)
        self._found = found
        self._table = GraphTable(self._service, services_changed)
        self._master_back = master_back
        self._followers: dict[Key, Callable[[], None]] = {}
        self._task: asyncio.Task[None] | None = None
        self._look = asyncio.Event()
        self._documents: tuple[bytes, bytes] = (b"", b"")
        self.loaded = asyncio.Event()
        """Set once the graph is known."""
        self.active = False
        """Whether there are clients, for which it is read more often."""
        self.told = False
        """Whether each change is told by ``look`` or ``take``, so that it need not be searched for."""
        self.taken = False
        """Whether ``take`` has given the graph, and tells its changes: then the master is not asked for it."""
        self.changes = 0
        """How often it has changed."""
        self.reads = 0
        """How often it was read from the master."""

    @property
    def topics(self) -> Mapping[str, GraphTopic]:
        """By name, in order of names."""
        return self._table.topics

    @property
    def services(self) -> Mapping[str, GraphService]:
        """By name, in order of names."""
        return self._table.services

    @property
    def nodes(self) -> Sequence[str]:
        """In order of names."""
        return self._table.nodes

    def start(self) -> None:
        """Begin, in a task."""
        self._task = asyncio.get_running_loop().create_task(self._run(), name="watch the graph")

    async def close(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    def look(self) -> None:
        """Read it soon: something has changed, or a client has come. Where ``take`` tells all that is not needed."""
        if not self.taken:
            self._look.set()

    async def master(self) -> str:
        """The URI of the master; waits until there is one."""
        return (await self._link.current()).master_uri

    def take(self, rows: GraphRows) -> None:
        """Take all rows of the agent, or those that have changed since."""
        self.taken = self.told = True
        if self._table.update(rows) or not self.loaded.is_set():
            self._tell()

    def lose(self) -> None:
        """The agent tells no more: the master is asked instead."""
        if self.taken:
            self._documents = (b"", b"")  # they are older than what was taken
        self.taken = self.told = False
        self.look()

    def follow(self, key: Key, changed: Callable[[], None]) -> None:
        """Call ``changed`` at each change; now, too, where the graph is known."""
        self._followers[key] = changed
        if self.loaded.is_set():
            changed()

    def unfollow(self, key: Key) -> None:
        """End a ``follow``."""
        self._followers.pop(key, None)

    def forget_client(self, number: int) -> None:
        """End what a client follows."""
        for key in [key for key in self._followers if key[0] == number]:
            del self._followers[key]

    def saw_type(self, topic: str, type_: str) -> None:
        """A publisher of a topic has this type; the master knows one only."""
        if self._table.saw_type(topic, type_):
            self._tell()

    def found_service(self) -> None:
        """The type of a service became known."""
        self._table.found_services()
        self._tell()

    # --- inside -----------------------------------------------------------------------------------------------

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        away = False
        while True:
            node = await self._link.current()
            self._look.clear()
            began = loop.time()
            try:
                changed = await self._read(node)
            except RmpaError as error:
                _log.debug("! the graph cannot be read: %s", error)
                away = True
                await self._link.check_master()
                await asyncio.sleep(limits.NODE_RETRY)
                continue
            if away:
                away = False
                self._master_back()
            if changed or not (self.loaded.is_set() or self.taken):
                self._tell()
            ended = loop.time()
            took = ended - began
            period = self._period()
            share = limits.GRAPH_CHANGED_SHARE if changed else limits.GRAPH_SHARE
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(period - took, took * share)):
                    await self._look.wait()
                # Many changes at once, as when a page subscribes to all topics, are one look. The first change after
                # a rest does not wait for a large graph's sake: the rest has been as long as a look.
                rested = loop.time() - ended
                await asyncio.sleep(max(limits.GRAPH_GATHER, took - rested))

    def _period(self) -> float:
        if self.told:
            return limits.GRAPH_TOLD_PERIOD
        return limits.GRAPH_PERIOD if self.active else limits.GRAPH_IDLE_PERIOD

    async def _read(self, node: Node) -> bool:
        """Read the graph; returns whether it differs from the last one."""
        if self.taken:
            await _exchange(node, "getPid")  # whether the master is there: its graph is told
            return False
        self.reads += 1
        state = await _exchange(node, "getSystemState")
        if state == self._documents[0]:
            return False
        types = await _exchange(node, "getTopicTypes")
        rows = rows_of(RosReply.of(await read_response(state)).value, RosReply.of(await read_response(types)).value)
        return self._take_read(rows, (state, types))

    def _take_read(self, rows: GraphRows, documents: tuple[bytes, bytes]) -> bool:
        if self.taken:
            return False  # what was told meanwhile is newer
        self._documents = documents
        return self._table.update(rows)

    def _tell(self) -> None:
        self.changes += 1
        self.loaded.set()
        for changed in [*self._followers.values()]:
            try:
                changed()
            except Exception:  # noqa: BLE001 - a fault of one client must not end the watch for all
                _log.exception("! a client could not be told of the graph")

    def _service(self, name: str) -> tuple[str, str]:
        found = self._found.get(name)
        return (found.type, found.uri) if found else ("", "")


async def _exchange(node: Node, method: str) -> bytes:
    document = b"".join(call_pieces(method, (node.name,)))
    return await exchange(node.master_uri, method, document, timeout=ros_limits.SLAVE_CALL_TIMEOUT)
