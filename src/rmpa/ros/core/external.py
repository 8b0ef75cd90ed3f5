"""The interface of a ROS core as the agent needs it, and the core that is a roscore of its own.

A ROS master does not notify of changes in its graph, so it is polled, a few times a second and in one call. The
agent's registrations are sent in order, many in one call. One task does both in turn, so a poll is never older than
the writes before it. While the master does not answer, the last known graph stays.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from abc import ABC, abstractmethod
from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import LocalProtocolError, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.facts import UnreachableInfo
from rmpa.core.log import logged_failure
from rmpa.core.statistics import Counters
from rmpa.ros import limits
from rmpa.ros.core.liveness import Liveness, Unreachable
from rmpa.ros.http.rpc import call, call_api, exchange, read_response
from rmpa.ros.master import mirror
from rmpa.ros.master.parameters import GraphChange, GraphState, RegistrationKind
from rmpa.ros.node.ask import refuses
from rmpa.ros.wire.xmlrpc import RosFault, RosReply, XmlRpcValue, brief, call_pieces
from rmpa.runtime.accept import Use
from rmpa.runtime.loop import sleep_to_tick, yield_to_data, yielding_to_data
from rmpa.runtime.tasks import end_tasks, keep_task

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.ros.master.registrations import Registrations

_log = logging.getLogger(__name__)

# Time between two polls while nothing changes.
MASTER_LOOK_IDLE: Final = 0.5
# Time between two polls of a roscore that does not answer: a restarted one has our registrations within a second.
MASTER_RETRY: Final = 0.5
# Time-out of one poll of or write to a roscore; one on a busy board answered in 0.3 s.
MASTER_TIMEOUT: Final = 3.0
# Registrations queued for a roscore; above it the queue is dropped, and the next poll finds what is missing.
MASTER_WRITES_MAX: Final = 20_000
# Time in which an ending agent unregisters at a roscore.
MASTER_FAREWELL: Final = 2.0

# Time for which another agent at the same roscore is told after its last registration was seen.
_MASTER_OTHER_AGENT: Final = 10.0
# Time between two polls of a roscore whose graph has just changed; a poll of 50 nodes costs it some milliseconds.
_MASTER_LOOK_FIRST: Final = 0.1
# The longest pause between two polls, so that a change is seen within a second.
_MASTER_LOOK_MAX: Final = 0.8
# The pause is at least this many times the duration of the poll: polls take at most a twentieth of its time.
_MASTER_LOOK_SHARE: Final = 20
# Delay of a poll out of turn, after a node is suspected to be dead or moved: one change is seldom alone.
_MASTER_LOOK_SOON: Final = 0.02
# Time-out for calls of a roscore with parameters, which may be megabytes.
_MASTER_ASK_TIMEOUT: Final = 10.0
# Seconds for which changes of the graph are gathered for one line of the log, and nodes that it names.
_GRAPH_LINE: Final = 1.0
_GRAPH_NODES: Final = 5
# Registrations in one call to a roscore, some 10 ms of its work.
_MASTER_WRITES_AT_ONCE: Final = 64
LOOPBACK: Final = "127.0.0.1"


class Core(ABC):
    """The local graph: read at any time, changed by ``call``, observed by ``on_change``.

    Args:
        registrations: The local graph's tables, or a copy of a real roscore's.
        nodes: The nodes that are checked, with their slave APIs.

    Attributes:
        counters: Counts what goes wrong.
        liveness: Checks the graph's nodes.
        listeners: Called after each change.
        uri: The master's URI: ``ROS_MASTER_URI`` of the nodes of this graph.
        node_host: The address that the agent's own nodes (its proxies among them) listen at.
        node_address: The address of the agent's own nodes that is registered in this graph.
    """

    node_host = node_address = LOOPBACK

    def __init__(self, uri: str, registrations: Registrations, nodes: Callable[[], dict[str, str]]) -> None:
        self.uri = uri
        self.registrations = registrations
        self.counters = Counters()
        self.liveness = Liveness(nodes=nodes, on_dead=self._dead)
        self.listeners: list[Callable[[GraphChange], None]] = []
        # The changes of the next line of the log.
        self._changes: list[GraphChange] = []

    @abstractmethod
    async def start(self) -> None:
        """Start the core, or connect to it.

        Raises:
            StartError: The core cannot be started with these settings.
        """

    @abstractmethod
    async def close(self) -> None:
        """Unregister what the agent registered; an embedded core ends."""

    @abstractmethod
    def call(self, method: str, *params: XmlRpcValue) -> RosReply:
        """Register or unregister, or write a parameter, as over XML-RPC but without waiting.

        For a real roscore the call is queued, and the reply follows from the local copy of the graph. Use ``ask`` for
        values that only the master has, such as parameters.

        Returns:
            ``(code, status, value)``; the value must not be changed, nor may ``params`` be afterwards.
        """

    @abstractmethod
    async def ask(self, method: str, *params: XmlRpcValue) -> RosReply:
        """Call any method, after all previous ``call``s, and wait for the master's own answer.

        Raises:
            UnreachableError: The master does not answer (a real roscore may be gone).
            RosFault: There is no such method.
            RemoteProtocolError: The answer is malformed.
            LocalProtocolError: A parameter cannot be expressed in XML-RPC.
        """

    def state(self) -> GraphState:
        """All known registrations; the same object until one changes."""
        return self.registrations.state()

    def publishers(self, topic: str) -> Mapping[str, str]:
        """The publishers of a topic with their slave APIs; never changed afterwards."""
        return self.registrations.at(RegistrationKind.PUBLISHER, topic)

    def subscribers(self, topic: str) -> Mapping[str, str]:
        """The subscribers of a topic with their slave APIs; never changed afterwards."""
        return self.registrations.at(RegistrationKind.SUBSCRIBER, topic)

    def type_of(self, topic: str, node: str = "") -> str:
        """The type of a node's topic, else the one that was registered last by any; ``*`` for none."""
        return self.registrations.type_of(topic, node)

    def on_change(self, callback: Callable[[GraphChange], None]) -> None:
        """Call ``callback`` in the loop after each change of a registration."""
        self.listeners.append(callback)

    def report(self, changes: Iterable[GraphChange]) -> None:
        """Call the listeners with each change, in order; an exception of one is logged, and affects no other.

        Each change is logged at debug level, and at most once a second one line about all.
        """
        for change in changes:
            _log.debug("= %s", change)
            if not self._changes:
                asyncio.get_running_loop().call_later(_GRAPH_LINE, self._tell)
            self._changes.append(change)
            for callback in self.listeners:
                with logged_failure(_log, "a listener failed at %s", change):
                    callback(change)

    def _tell(self) -> None:
        changes, self._changes = self._changes, []
        if len(changes) == 1:
            _log.info("= %s", changes[0])
            return
        more = sum(change.added for change in changes)
        nodes = list(dict.fromkeys(change.node for change in changes))
        names = ", ".join(nodes[:_GRAPH_NODES]) + (", …" if len(nodes) > _GRAPH_NODES else "")
        _log.info("= %d registrations more, %d less, of %d nodes: %s", more, len(changes) - more, len(nodes), names)

    @abstractmethod
    def _dead(self, node: str, api: str) -> None:
        """Take the registrations of a node that is dead."""

    def on_lookup(self, callback: Callable[[str, str, str, str], str]) -> bool:  # noqa: ARG002 - for the embedded core
        """Let ``callback`` answer ``lookupService`` for each caller.

        Args:
            callback: ``(service, uri, caller id, slave API)``: the URI to answer in place of the registered ``uri``,
                or an empty text. The slave API is the caller's; empty if no node of that name is registered. It is
                called for each lookup of a registered service, and must return at once.

        Returns:
            Whether this core can do so: a real roscore cannot.
        """
        return False

    def on_log(self, callback: Callable[[str, memoryview], None]) -> bool:  # noqa: ARG002 - for the embedded core
        """Call ``callback`` with the publishing node and the framed bytes of each message of /rosout.

        Returns:
            Whether this core does so: a real roscore does not.
        """
        return False

    def unreachable(self) -> Mapping[str, Unreachable]:
        """The registered nodes to which connecting fails, by name; the caller must not change the mapping."""
        return self.liveness.unreachable

    def unreachable_infos(self) -> tuple[UnreachableInfo, ...]:
        """The piece of the snapshot: the nodes to which connecting fails, by name."""
        now = asyncio.get_running_loop().time()
        return tuple(
            UnreachableInfo(
                node=node, uri=found.api, problem=found.problem, ago=now - found.since, withdrawn=found.withdrawn
            )
            for node, found in sorted(self.unreachable().items())
        )

    def suspect(self, node: str) -> None:
        """Check now whether this node is dead or has moved."""
        self.liveness.suspect(node)

    def notes(self) -> tuple[str, ...]:
        """Problems that the user should know of, such as a master that does not answer."""
        return ()

    def restored(self) -> str:
        """Where the core stores its state and what it restored, for people; empty for nothing."""
        return ""


_PARAM_WRITES: Final = frozenset({"setParam", "deleteParam"})
_MULTICALL: Final = "system.multicall"


class ExternalCore(Core):
    """The graph of a master that is another program.

    Args:
        uri: The master's URI.
        own_node: The agent's own node, which asks the master.
        node_host: The address at which the agent's nodes listen.
        node_address: The address of the agent's nodes that is registered.
    """

    def __init__(
        self,
        uri: str,
        *,
        own_node: str,
        node_host: str = LOOPBACK,
        node_address: str = LOOPBACK,
    ) -> None:
        self._mirror = mirror.Mirror(yielder=yielding_to_data)
        super().__init__(uri, self._mirror.registrations, self._mirror.others)
        self.node_host, self.node_address = node_host, node_address
        self._own_node = own_node
        self._writes: deque[mirror.Call] = deque()
        self._written = asyncio.Event()
        self._written.set()
        self._wake = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._revival: asyncio.Task[None] | None = None
        self._ending = False
        self._problem = "it was not asked yet"
        self._other_until = 0.0
        # The slave API of a node of another agent that has taken the name of the agent's own node.
        self._other_agent = ""
        # What the next poll looks up, its encoded request, and the last answer: both are mostly unchanged.
        self._nodes: tuple[str, ...] = ()
        self._services: tuple[str, ...] = ()
        self._request = b""
        self._seen = b""
        self._pace = _MASTER_LOOK_FIRST

    async def start(self) -> None:
        """Poll the master for the first time; one that does not answer is polled again in the background."""
        self._loop = asyncio.get_running_loop()
        self._next_poll = self._loop.time()
        await self._poll()
        await self._flush()
        self._task = keep_task(self._work, f"looking at the roscore {self.uri}")
        self._revival = keep_task(self._revive, "ask for nodes that left")
        self.liveness.start()

    async def close(self) -> None:
        """Unregister all that the agent registered at the master, if it answers in ``MASTER_FAREWELL``."""
        self._ending = True
        if not self._problem:
            for method, params in self._mirror.unregister_calls():
                self.call(method, *params)
        self._wake.set()
        if self._task is not None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(MASTER_FAREWELL):
                    await asyncio.shield(self._task)
            if self._writes and not self._problem:
                _log.warning(
                    "! %d changes could not be sent to the roscore at %s [core-slow]", len(self._writes), self.uri
                )
        await end_tasks(self._task, self._revival)
        await self.liveness.close()
        self._problem = "the agent has ended"
        self._drop_writes()

    def notes(self) -> tuple[str, ...]:
        """Whether the master does not answer, or another agent is at it too."""
        if self._problem:
            where = f"the roscore at {self.uri} does not answer ({self._problem})"
            return (f"{where}: what flows goes on, new nodes are not seen; start it again",)
        if self._other_agent and self._loop.time() < self._other_until:
            where = f"another agent (its node at {self._other_agent}) is at the roscore {self.uri} too"
            return (f"{where}, and each undoes what the other registers: end one, or give it a roscore of its own",)
        return ()

    def call(self, method: str, *params: XmlRpcValue) -> RosReply:
        """Queue a registration or a write of a parameter, after all previous calls."""
        yield_to_data()
        if method in mirror.REGISTRATIONS:
            reply = self._apply(method, params)
        elif method not in _PARAM_WRITES:
            return RosReply(-1, f"{method} is for the master itself to answer: it has to be asked", 0)
        elif self._problem:
            return RosReply(0, self.notes()[0], 0)
        else:
            reply = RosReply(1, "will be written", 0)
        if reply.code == 1:
            self._write((method, params))
        return reply

    async def ask(self, method: str, *params: XmlRpcValue) -> RosReply:
        registers = method in mirror.REGISTRATIONS
        if registers:
            reply = self._apply(method, params)
            if reply.code != 1:
                return reply
        await self._written.wait()
        if self._problem and (registers or method in _PARAM_WRITES):
            raise UnreachableError("ROS master", self.uri, self._problem)
        return await call_api(self.uri, method, *params, timeout=_MASTER_ASK_TIMEOUT, use=Use.CORE)

    def _apply(self, method: str, params: Sequence[XmlRpcValue]) -> RosReply:
        reply = self._mirror.apply(method, params)
        self._report_changes()
        return reply

    def suspect(self, node: str) -> None:
        if node not in self._mirror.ours():
            self.liveness.suspect(node)
        self._poll_soon()

    async def _work(self) -> None:
        while True:
            try:
                await self._flush()
                if self._ending:
                    return
                if self._loop.time() >= self._next_poll:
                    await self._poll()
            except Exception:
                self._seen = b""
                raise
            if self._problem or not self._writes:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout_at(self._next_poll):
                        await self._wake.wait()
            self._wake.clear()

    def _poll_soon(self) -> None:
        if self._task is not None and not self._problem:
            self._next_poll = min(self._next_poll, self._loop.time() + _MASTER_LOOK_SOON)
            self._pace = _MASTER_LOOK_FIRST
            self._wake.set()

    def _write(self, write: mirror.Call) -> None:
        """Queue a call; drop it while the master does not answer.

        The first poll afterwards finds the registrations that the master lacks.
        """
        if self._problem:
            return
        self._writes.append(write)
        self._written.clear()
        self._wake.set()
        if len(self._writes) > MASTER_WRITES_MAX:
            # Dropping all is cheaper than choosing: the next poll finds what is missing.
            _log.warning(
                "! the roscore at %s is slow: %d changes are sent again [core-slow]", self.uri, len(self._writes)
            )
            self._drop_writes()
            self._poll_soon()

    def _drop_writes(self) -> None:
        self._seen = b""
        self._writes.clear()
        self._written.set()

    async def _flush(self) -> None:
        while self._writes and not self._problem:
            batch = [self._writes.popleft() for _ in range(min(len(self._writes), _MASTER_WRITES_AT_ONCE))]
            self._seen = b""  # so that the next poll parses its answer even if the bytes are unchanged
            try:
                await self._send(batch)
            except UnreachableError as error:
                self._lost(error)
        self._written.set()

    async def _send(self, batch: list[mirror.Call]) -> None:
        """Send calls as one ``system.multicall``; if that fails as a whole, one by one."""
        try:
            # A master needs long to read parameters of megabytes.
            large = any(method in _PARAM_WRITES for method, _ in batch)
            timeout = _MASTER_ASK_TIMEOUT if large else MASTER_TIMEOUT
            answers = await self._many([mirror.one_call(*write) for write in batch], timeout)
        except (LocalProtocolError, RemoteProtocolError, RosFault) as error:
            if len(batch) == 1:
                self._refused(batch[0], error)
                return
            for write in batch:
                await self._send([write])
            return
        for write, answer in zip(yielding_to_data(batch), answers, strict=False):
            match answer:
                case [[1, _, _]]:
                    pass
                case [[int(code), str(status), _]]:
                    self._refused(write, RosFault(code, status))
                case _:
                    self._refused(write, RosFault(1, brief(answer)))

    def _refused(self, write: mirror.Call, error: Exception) -> None:
        self.counters.add("master.refused")
        method, params = write
        _log.error(
            "! the roscore at %s does not accept %s%s: %s [core-refuses]", self.uri, method, brief(params), error
        )
        self._mirror.forget(write)
        self._report_changes()

    async def _poll(self) -> None:
        """Poll the master once, and schedule the next poll."""
        begin = self._loop.time()
        try:
            changed = await self._survey()
        except (RosFault, RemoteProtocolError) as error:
            self._lost(RemoteProtocolError(f"it answers otherwise than a ROS master: {error}"))
        except UnreachableError as error:
            self._lost(error)
        else:
            self.counters.add("master.looks")
            self._pace = _MASTER_LOOK_FIRST if changed else min(self._pace * 1.5, MASTER_LOOK_IDLE)
        took = self._loop.time() - begin
        # Reporting a large graph takes the master long; between polls it needs time for its own work.
        pause = min(max(self._pace, _MASTER_LOOK_SHARE * took), _MASTER_LOOK_MAX)
        self._next_poll = self._loop.time() + (MASTER_RETRY if self._problem else pause)

    async def _survey(self) -> bool:
        """Ask for the whole graph; return whether the answer differs from the last one."""
        seen = self._mirror.asked
        if not self._request:
            calls = mirror.survey_calls(self._own_node, self._nodes, self._services)
            self._request = b"".join(yielding_to_data(call_pieces(_MULTICALL, [calls])))
        body = await exchange(self.uri, _MULTICALL, self._request, timeout=MASTER_TIMEOUT, use=Use.CORE)
        if body == self._seen and not self._problem:
            return False
        answer = await read_response(body)
        survey = mirror.read_survey(answer, self._nodes, self._services, yielder=yielding_to_data)
        self._seen = body
        await self._complete(survey)
        if self._ending:
            return True
        if self._problem and self._task is not None:
            _log.warning("= the roscore at %s answers again [core-slow]", self.uri)
        self._problem = ""
        self._take(survey, seen)
        return True

    async def _complete(self, survey: mirror.Survey) -> None:
        """Look up the nodes and services that are new in a survey; later polls include them in their request."""
        nodes, services = survey.nodes(), survey.holders[RegistrationKind.SERVICE]
        new_nodes = [node for node in nodes if node not in survey.uris]
        new_services = [service for service in services if service not in survey.services]
        if new_nodes or new_services:
            answer = await self._many(mirror.lookup_calls(self._own_node, new_nodes, new_services))
            uris, places = mirror.read_lookups(answer, new_nodes, new_services, yielder=yielding_to_data)
            survey.uris |= uris
            survey.services |= places
        if tuple(nodes) != self._nodes or tuple(services) != self._services:
            self._nodes, self._services = tuple(nodes), tuple(services)
            self._request, self._seen = b"", b""

    def _take(self, survey: mirror.Survey, seen: int) -> None:
        if other := self._mirror.taken(survey, self._own_node, seen):
            if not self._other_agent:
                _log.error(
                    "! another agent (its node is %s) uses the roscore %s too: end one of them [core-refuses]",
                    other,
                    self.uri,
                )
            self._other_agent, self._other_until = other, self._loop.time() + _MASTER_OTHER_AGENT
        again = self._mirror.update(survey, seen)
        self._report_changes()
        if again and self._loop.time() >= self._other_until:
            _log.info("= %d registrations are made, or ended again at %s", len(again), self.uri)
        if again:  # of any number: the bound would only drop them until the next poll
            self._writes += again
            self._written.clear()

    async def _many(self, calls: Sequence[XmlRpcValue], within: float = 0.0) -> list[XmlRpcValue]:
        answers = await call(self.uri, _MULTICALL, calls, timeout=within or MASTER_TIMEOUT, use=Use.CORE)
        if not isinstance(answers, list) or len(answers) != len(calls):
            raise RemoteProtocolError(f"{len(calls)} calls were answered with {brief(answers)}")
        return answers

    def _report_changes(self) -> None:
        _, changes = self.registrations.take()  # the master itself notifies the nodes
        self.report(yielding_to_data(changes))

    def _lost(self, error: RmpaError) -> None:
        problem = str(error)
        if not self._problem or self._task is None:
            _log.warning(
                "! the roscore at %s: %s; rmpa waits for it, open connections go on [core-slow]", self.uri, problem
            )
        self._problem = problem
        self._drop_writes()

    def _dead(self, node: str, api: str) -> None:
        self.counters.add("node.dead")
        self._mirror.mark_dead(node, api)
        self._report_changes()

    async def _revive(self) -> None:
        """Check whether nodes that were taken for dead accept connections, and restore those that do."""
        while True:
            await sleep_to_tick(limits.NODE_CHECK_INTERVAL)
            for node, api in list(self._mirror.dead.items()):
                if not await refuses(api) and self._mirror.dead.get(node) == api:
                    _log.info("= node %s at %s lives after all", node, api)
                    del self._mirror.dead[node]
                    self._seen = b""
