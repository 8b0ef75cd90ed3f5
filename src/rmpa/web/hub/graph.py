"""The graph of the local core, as the agent tells it or the master is asked for it, and the definitions of types."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import OrderedDict
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.core.log import logged_failure
from rmpa.core.timers import TokenBucket
from rmpa.observe.graph import GraphRows, ServiceRow, TopicRow
from rmpa.ros import limits as ros_limits
from rmpa.ros.http.rpc import exchange, read_response
from rmpa.ros.node.fetch_type import fetch_type
from rmpa.ros.types.codec import MessageCodec, codec_for
from rmpa.ros.types.definitions import UnknownTypeError, known_text
from rmpa.ros.types.find import find_message_type, find_service_type, type_of_header
from rmpa.ros.types.installed import ServiceType, known_services
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import ANY
from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue, call_pieces
from rmpa.runtime.tasks import end_tasks, keep_task, start_task
from rmpa.web import limits
from rmpa.web.hub.node_link import Follower, NodeLink
from rmpa.web.hub.services import ServiceCalls, SharedTasks

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.ros.node.node import Node

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
# Types where the master has none: clients tell ROS 1 by that of ``/rosout``.
_KNOWN_TYPES: Final = {"/rosout": ("rosgraph_msgs/Log",), "/rosout_agg": ("rosgraph_msgs/Log",)}


class GraphTopic(msgspec.Struct, frozen=True):
    """A topic with its types (more than one where publishers disagree) and the names of its nodes."""

    name: str
    types: tuple[str, ...]
    publishers: tuple[str, ...] = ()
    subscribers: tuple[str, ...] = ()


class GraphService(msgspec.Struct, frozen=True):
    """A service with its type ("" while unknown), the nodes that offer it and its URI (rosrpc://host:port)."""

    name: str
    type: str
    providers: tuple[str, ...] = ()
    uri: str = ""


class GraphTable:
    """The graph as it was last told. What did not change costs next to nothing. No I/O.

    Args:
        found: The types and URIs of services, by name, as far as they are known.
        services_changed: ``(names)``: services that have other providers than before, or were registered anew.
    """

    def __init__(
        self, found: Mapping[str, tuple[str, str]], services_changed: Callable[[Iterable[str]], None]
    ) -> None:
        self._found = found
        self._services_changed = services_changed
        self._rows: dict[str, TopicRow] = {}
        self._seen: dict[str, dict[str, None]] = {}
        self._nodes: Sequence[str] | None = None
        # By name, in order of names; replaced by each change, so that it may be kept.
        self.topics: Mapping[str, GraphTopic] = {}
        # Likewise.
        self.services: Mapping[str, GraphService] = {}

    @property
    def nodes(self) -> Sequence[str]:
        """In order of names."""
        if self._nodes is None:
            found = {node for row in self._rows.values() for node in (*row.publishers, *row.subscribers)}
            self._nodes = sorted(found.union(*(service.providers for service in self.services.values())))
        return self._nodes

    def update(self, rows: GraphRows) -> bool:
        """Take rows; returns whether the graph differs from what it was."""
        topics = [row for row in rows.topics if self._rows.get(row.name) != row]
        services = [row for row in rows.services if not rows.whole or self._other_providers(row)]
        if rows.whole:
            names = {row.name for row in rows.topics}
            topics += [TopicRow(name, "", (), ()) for name in self._rows if name not in names]
            names = {row.name for row in rows.services}
            services += [ServiceRow(name, ()) for name in self.services if name not in names]
        if not topics and not services:
            return False
        self._nodes = None
        for row in topics:
            if row.publishers or row.subscribers:
                self._rows[row.name] = row
            else:
                self._rows.pop(row.name, None)
            if not row.publishers:
                self._seen.pop(row.name, None)
        if topics:
            self.topics = _updated(self.topics, {row.name: self._topic(row.name) for row in topics})
        if services:
            self._services_changed([row.name for row in services])
            self.services = _updated(self.services, {row.name: self._service(row) for row in services})
        return True

    def saw_type(self, topic: str, type_: str) -> bool:
        """A publisher of a topic has this type; the master knows one only. Returns whether the graph differs now."""
        seen = self._seen.setdefault(topic, {})
        if type_ in seen or len(seen) >= limits.SEEN_TYPES_MAX:
            return False
        seen[type_] = None
        known = self.topics.get(topic)
        if known is None or type_ in known.types:
            return False
        self.topics = _updated(self.topics, {topic: self._topic(topic)})
        return True

    def found_services(self) -> None:
        """Types of services became known."""
        rows = (ServiceRow(service.name, service.providers) for service in self.services.values())
        self.services = {row.name: service for row in rows if (service := self._service(row))}

    def _other_providers(self, row: ServiceRow) -> bool:
        known = self.services.get(row.name)
        return set(row.providers) != set(known.providers if known else ())

    def _topic(self, name: str) -> GraphTopic | None:
        row = self._rows.get(name)
        if row is None:
            return None
        types = dict.fromkeys(() if row.type in (ANY, "") else (row.type,)) | self._seen.get(name, {})
        known = tuple(types) or _KNOWN_TYPES.get(name, ())
        return GraphTopic(name, known, tuple(sorted(row.publishers)), tuple(sorted(row.subscribers)))

    def _service(self, row: ServiceRow) -> GraphService | None:
        if not row.providers:
            return None
        type_, uri = self._found.get(row.name, ("", ""))
        return GraphService(row.name, type_, tuple(sorted(row.providers)), uri)


def rows_of(state: XmlRpcValue, types: XmlRpcValue) -> GraphRows:
    """All rows, from the answers of a master.

    Args:
        state: The value of ``getSystemState``; what is malformed in it is left out.
        types: The value of ``getTopicTypes``, likewise.
    """
    tables = state if isinstance(state, list) and len(state) == 3 else [[], [], []]
    publishers, subscribers, services = map(_table, tables)
    known: dict[str, str] = {}
    for row in types if isinstance(types, list) else ():
        match row:
            case [str(name), str(type_)]:
                known[name] = type_
    return GraphRows(
        whole=True,
        topics=tuple(
            TopicRow(name, known.get(name, ANY), publishers.get(name, ()), subscribers.get(name, ()))
            for name in publishers.keys() | subscribers.keys()
        ),
        services=tuple(ServiceRow(name, providers) for name, providers in services.items()),
    )


def _table(value: XmlRpcValue) -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    for row in value if isinstance(value, list) else ():
        match row:
            case [str(name), list(nodes)]:
                found[name] = tuple(str(node) for node in nodes)
    return found


def _updated(before: Mapping[str, _T], changes: Mapping[str, _T | None]) -> dict[str, _T]:
    """A copy in order of names with these changes; ``None`` removes."""
    made = {name: value for name, value in {**before, **changes}.items() if value is not None}
    return made if changes.keys() <= before.keys() else dict(sorted(made.items()))


class TypeLibrary:
    """All types that are known: those that rmpa brings, this machine's, and those of publishers.

    A publisher's own definition replaces another version of the same name, because its messages have that form.

    Args:
        link: Has the node, whose publishers are asked.
    """

    def __init__(self, link: NodeLink) -> None:
        self._link = link
        self._messages: OrderedDict[str, MessageType] = OrderedDict()
        self._versions: OrderedDict[tuple[str, str], MessageType] = OrderedDict()
        self._services: OrderedDict[str, ServiceType] = OrderedDict()
        self._missing: OrderedDict[tuple[str, bool], tuple[float, RmpaError]] = OrderedDict()
        self._finding: SharedTasks[str, MessageType] = SharedTasks()
        self._asked = asyncio.Semaphore(4)  # types whose definition is looked for at one time
        # Of types in this machine's packages, on the event loop, ten a second in the long run: first all types of a
        # large robot at once, each searched for once.
        self._searches = TokenBucket(10.0, 500.0)
        # Called with each message type that becomes known.
        self.on_learnt: Callable[[MessageType], None] = lambda _: None

    def message(self, name: str) -> MessageType:
        """A message type that is known or on this machine; its first search reads files.

        Raises:
            DefinitionError: It is not found; the error is repeated within ``limits.PROBE_RETRY``.
        """
        kind = self._messages.get(name)
        if kind is None:
            try:
                kind = self._here(name, known_text(name) is not None, MessageType, find_message_type, service=False)
            except UnknownTypeError as error:
                if error.fetchable:
                    self._finding.start(name, lambda: self._find(name))  # a publisher may tell it, for the next time
                raise
            self._keep(name, kind)
        return kind

    def at_hand(self, name: str) -> MessageType | None:
        """A message type as ``message`` finds it, or ``None``."""
        try:
            return self.message(name)
        except RmpaError:
            return None

    def version(self, name: str, md5sum: str) -> MessageType:
        """The version of a message type that a publisher has; that of ``message`` where its md5 sum is not known.

        Modules may have been built with different versions of one type.

        Raises:
            DefinitionError: As for ``message``.
        """
        return self._versions.get((name, md5sum)) or self.message(name)

    def codec(self, name: str, md5sum: str) -> MessageCodec:
        """Converts messages of a version; raises as ``version``."""
        return codec_for(self.version(name, md5sum))

    def service(self, name: str) -> ServiceType:
        """A service type; as ``message``."""
        kind = self._services.get(name)
        if kind is None:
            kind = self._here(name, name in known_services(), ServiceType, find_service_type, service=True)
            self._services[name] = kind
            _bound(self._services, ros_limits.TYPES_FOUND_MAX)
        return kind

    async def find_message(self, name: str, md5sum: str = "") -> MessageType:
        """A message type that is known, on this machine, or told by a publisher; with ``md5sum`` that version of it.

        Raises:
            DefinitionError: None of them has it.
            UnreachableError: The master does not answer.
        """
        if md5sum:
            if (name, md5sum) not in self._versions:
                raise RmpaError(f"no publisher has told the version {md5sum} of {name}", code="type-mismatch")
            return self._versions[name, md5sum]
        return self._messages.get(name) or await self._finding.get(name, lambda: self._find(name))

    async def find_service(self, name: str) -> ServiceType:
        """A service type that is known or on this machine.

        Raises:
            DefinitionError: It is not found.
        """
        if name not in self._services:
            self._check_missing(name, service=True)
            try:
                self._services[name] = await asyncio.to_thread(find_service_type, name)
            except RmpaError as error:
                raise self._remember(name, error, service=True) from None
        return self._services[name]

    def learn(self, header: Mapping[str, str]) -> None:
        """Take the definition of a publisher's header."""
        name, md5sum = header.get("type", ""), header.get("md5sum", "")
        known = self._messages.get(name)
        if not name or (known is not None and known.md5sum == md5sum) or (name, md5sum) in self._versions:
            return
        if not header.get("message_definition"):
            return
        try:
            kind = type_of_header(header)
        except RmpaError as error:
            _log.debug("! the definition of %s by %s: %s", name, header.get("callerid"), error)
            return
        self._keep(name, kind)

    async def close(self) -> None:
        """End all searches."""
        await self._finding.close()

    async def _find(self, name: str) -> MessageType:
        async with self._asked:
            try:
                kind = await asyncio.to_thread(find_message_type, name)
            except UnknownTypeError as error:
                node = self._link.need()
                fetched = await fetch_type(node.master_uri, node.name, name) if error.fetchable else None
                if fetched is None:
                    raise
                kind = fetched[0]
            return self._messages.get(name) or self._keep(name, kind)

    def _keep(self, name: str, kind: MessageType) -> MessageType:
        self._messages[name] = self._versions[name, kind.md5sum] = kind
        _bound(self._messages, ros_limits.TYPES_FOUND_MAX)
        _bound(self._versions, ros_limits.TYPES_FOUND_MAX)
        self._missing.pop((name, False), None)
        self.on_learnt(kind)
        return kind

    def _here(
        self, name: str, brought: bool, make: Callable[[str], _T], find: Callable[[str], _T], *, service: bool
    ) -> _T:
        """A type that rmpa brings, or that this machine has: its search reads files, and walks through packages.

        Raises:
            RmpaError: It is not found, or too many were searched for just now; the event loop serves robots too.
        """
        self._check_missing(name, service=service)
        if not brought and not self._searches.take(asyncio.get_running_loop().time()):
            raise RmpaError("too many types were searched for at once; ask again in a second")
        try:
            return make(name) if brought else find(name)
        except RmpaError as error:
            raise self._remember(name, error, service=service) from None

    def _check_missing(self, name: str, *, service: bool) -> None:
        when, error = self._missing.get((name, service), (0.0, None))
        if error is not None and asyncio.get_running_loop().time() - when < limits.PROBE_RETRY:
            raise error.with_traceback(None)

    def _remember(self, name: str, error: RmpaError, *, service: bool) -> RmpaError:
        self._missing[name, service] = asyncio.get_running_loop().time(), error
        _bound(self._missing, ros_limits.TYPES_MISSING_MAX)
        return error


def _bound(table: OrderedDict[Any, Any], most: int) -> None:
    while len(table) > most:
        table.popitem(last=False)


class GraphWatch(GraphTable):
    """The graph, always the last one that was told or read, and the clients that follow it.

    Args:
        link: Has the node.
        calls: Knows and finds the types of services; is told of those that have other providers than before.
        master_back: Called when the master answers again after it did not.
    """

    # More than 12 fields: three say how the graph comes, and two are for tests and for the monitor's page.
    def __init__(self, link: NodeLink, calls: ServiceCalls, master_back: Callable[[], None]) -> None:
        super().__init__(calls.found, calls.forget)
        self._link = link
        link.on_registration = self.look
        self._calls = calls
        self._master_back = master_back
        self._followers: dict[Follower, Callable[[], None]] = {}
        self._task: asyncio.Task[None] | None = None
        self._look = asyncio.Event()
        self._documents: tuple[bytes, bytes] = (b"", b"")
        # Set once the graph is known.
        self.loaded = asyncio.Event()
        # Whether there are clients, for which it is read more often.
        self.active = False
        # Whether each change is told by ``look`` or ``take``, so that it need not be searched for.
        self.told = False
        # Whether ``take`` has given the graph, and tells its changes: then the master is not asked for it.
        self.taken = False
        # How often it was read from the master.
        self.reads = 0

    def start(self) -> None:
        """Begin, in a task."""
        self._task = keep_task(self._run, "watch the graph")

    async def close(self) -> None:
        """End."""
        await end_tasks(self._task)

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
        if self.update(rows) or not self.loaded.is_set():
            self._tell()

    def lose(self) -> None:
        """The agent tells no more: the master is asked instead."""
        if self.taken:
            self._documents = (b"", b"")  # they are older than what was taken
        self.taken = self.told = False
        self.look()

    def follow(self, changed: Callable[[], None]) -> Follower:
        """Call ``changed`` at each change; now, too, where the graph is known."""
        follower = Follower(self._followers, changed)
        if self.loaded.is_set():
            changed()
        return follower

    def saw_type(self, topic: str, type_: str) -> bool:
        """A publisher of a topic has this type; the master knows one only. Returns whether the graph differs now."""
        differs = super().saw_type(topic, type_)
        if differs:
            self._tell()
        return differs

    async def find(self, service: str) -> str:
        """The type of a service that the graph does not say; the graph has it then.

        Raises:
            RmpaError: There is no such service, or its server does not answer.
        """
        type_, _ = await self._calls.find(service)
        known = self.services.get(service)
        if known is not None and known.type != type_:
            self._found_types()
        return type_

    async def find_all(self) -> None:
        """Find the types of all services, for ``limits.FIND_ALL_TIMEOUT``; of a server that does not tell none."""
        searches = [
            start_task(self._calls.find(each.name), f"type of {each.name}", raises=(RmpaError,))
            for each in self.services.values()
            if not each.type
        ]
        if searches:
            await asyncio.wait(searches, timeout=limits.FIND_ALL_TIMEOUT)
            await end_tasks(*searches)
            self._found_types()

    def _found_types(self) -> None:
        self.found_services()
        self._tell()

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
            # A new topic shows within 0.1 s while there are clients. Where the agent tells each change, a look only
            # finds what a lost word would have told.
            period = 2.0 if self.told else 0.08 if self.active else 1.0
            # Both ends spend a tenth of the time on looks; one that found a change takes ten times as long.
            share = 1.0 if changed else 10.0
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(period - took, took * share)):
                    await self._look.wait()
                # Many changes at once, as when a page subscribes to all topics, are one look. The first change after
                # a rest does not wait for a large graph's sake: the rest has been as long as a look.
                rested = loop.time() - ended
                await asyncio.sleep(max(limits.GRAPH_GATHER, took - rested))

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
        return self.update(rows)

    def _tell(self) -> None:
        self.loaded.set()
        for changed in [*self._followers.values()]:
            with logged_failure(_log, "a client could not be told of the graph"):
                changed()


async def _exchange(node: Node, method: str) -> bytes:
    document = b"".join(call_pieces(method, (node.name,)))
    return await exchange(node.master_uri, method, document, timeout=ros_limits.SLAVE_CALL_TIMEOUT)
