"""The graph as the local core shows it: read again and again, compared as bytes, and parsed where it has changed."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.ros import limits as ros_limits
from rmpa.ros.http.client import exchange, read_response
from rmpa.ros.wire.tcpros import ANY
from rmpa.ros.wire.xmlrpc import RosReply, call_pieces
from rmpa.web import limits
from rmpa.web.hub.requests import GraphService, GraphTopic

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.ros.node.node import Node
    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.web.hub.clients import Key
    from rmpa.web.hub.node_link import NodeLink
    from rmpa.web.hub.services import FoundService

_log = logging.getLogger(__name__)
Rows = dict[str, tuple[str, ...]]
_KNOWN_TYPES: Final = {"/rosout": "rosgraph_msgs/Log", "/rosout_agg": "rosgraph_msgs/Log"}
"""Types where the master has none: clients tell ROS 1 by that of ``/rosout``."""


class GraphWatch:
    """The graph, always the last one that was read, and the clients that follow it.

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
        self._services_changed = services_changed
        self._master_back = master_back
        self._followers: dict[Key, Callable[[], None]] = {}
        self._seen: dict[str, dict[str, None]] = {}
        self._state: tuple[Rows, Rows, Rows] = ({}, {}, {})
        self._types: dict[str, str] = {}
        self._task: asyncio.Task[None] | None = None
        self._look = asyncio.Event()
        self._documents: tuple[bytes, bytes] = (b"", b"")
        self.loaded = asyncio.Event()
        """Set once the graph is known."""
        self.active = False
        """Whether there are clients, for which it is read more often."""
        self.told = False
        """Whether each change is told by ``look``, so that it need not be searched for."""
        self.topics: Mapping[str, GraphTopic] = {}
        """By name, in order of names."""
        self.services: Mapping[str, GraphService] = {}
        """Likewise."""
        self.nodes: Sequence[str] = ()
        """In order of names."""
        self.changes = 0
        """How often it has changed."""
        self.reads = 0
        """How often it was read."""

    def start(self) -> None:
        """Begin, in a task."""
        self._task = asyncio.get_running_loop().create_task(self._run(), name="watch the graph")

    async def close(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    def look(self) -> None:
        """Read it soon: something has changed, or a client has come."""
        self._look.set()

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
        seen = self._seen.setdefault(topic, {})
        if type_ not in seen and len(seen) < limits.SEEN_TYPES_MAX:
            seen[type_] = None
            known = self.topics.get(topic)
            if known is not None and type_ not in known.types:
                self._rebuild()

    def found_service(self) -> None:
        """The type of a service became known."""
        self._rebuild()

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
            if changed or not self.loaded.is_set():
                self._rebuild()
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
        self.reads += 1
        state = await _exchange(node, "getSystemState")
        if state == self._documents[0]:
            return False
        types = await _exchange(node, "getTopicTypes")
        parsed = RosReply.of(await read_response(state)).value
        self._types = _pairs(RosReply.of(await read_response(types)).value)
        rows = parsed if isinstance(parsed, list) and len(parsed) == 3 else [[], [], []]
        before = self._state[2]
        self._state = (_rows(rows[0]), _rows(rows[1]), _rows(rows[2]))
        self._documents = (state, types)
        other = [name for name, nodes in before.items() if self._state[2].get(name) != nodes]
        if other:
            self._services_changed(other)
        return True

    def _rebuild(self) -> None:
        publishers, subscribers, services = self._state
        names = sorted(publishers.keys() | subscribers.keys())
        for name in self.topics.keys() - publishers.keys():
            self._seen.pop(name, None)
        self.topics = {
            name: GraphTopic(name, self._types_of(name), publishers.get(name, ()), subscribers.get(name, ()))
            for name in names
        }
        self.services = {name: self._service(name, services[name]) for name in sorted(services)}
        self.nodes = tuple(sorted({node for rows in self._state for nodes in rows.values() for node in nodes}))
        self.changes += 1
        self.loaded.set()
        for changed in [*self._followers.values()]:
            try:
                changed()
            except Exception:  # noqa: BLE001 - a fault of one client must not end the watch for all
                _log.exception("! a client could not be told of the graph")

    def _types_of(self, topic: str) -> tuple[str, ...]:
        first = self._types.get(topic, ANY)
        known = dict.fromkeys(() if first in (ANY, "") else (first,))
        known |= self._seen.get(topic, {})
        return tuple(known) or ((_KNOWN_TYPES[topic],) if topic in _KNOWN_TYPES else ())

    def _service(self, name: str, providers: tuple[str, ...]) -> GraphService:
        found = self._found.get(name)
        return GraphService(name, found.type if found else "", providers, found.uri if found else "")


async def _exchange(node: Node, method: str) -> bytes:
    document = b"".join(call_pieces(method, (node.name,)))
    return await exchange(node.master_uri, method, document, timeout=ros_limits.SLAVE_CALL_TIMEOUT)


def _rows(value: XmlRpcValue) -> Rows:
    found: Rows = {}
    for row in value if isinstance(value, list) else ():
        match row:
            case [str(name), list(nodes)]:
                found[name] = tuple(sorted(str(node) for node in nodes))
    return found


def _pairs(value: XmlRpcValue) -> dict[str, str]:
    found: dict[str, str] = {}
    for row in value if isinstance(value, list) else ():
        match row:
            case [str(name), str(type_)]:
                found[name] = type_
    return found
