"""What the server knows of the agent: its snapshot, changes of the graph, and its trust.

The agent's snapshot, shared by all clients: the agent is asked at most once in ``limits.WEB_SNAPSHOT_AGE``.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import msgspec

from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.observe import limits as observe_limits
from rmpa.observe.control import ControlReply, ControlRequest, GraphRevision, SnapshotDecoder
from rmpa.observe.control_client import ControlClient, choose_agent, find_agents, same_core
from rmpa.trust.permissions import TrustStatus
from rmpa.web import limits

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping
    from pathlib import Path

    from rmpa.observe.control_client import FoundAgent
    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.hub.graph import GraphWatch

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Reading:
    """What one question to the agent gave.

    Attributes:
        number: Counts the questions, from 1.
        taken: When it ended, in monotonic seconds.
        snapshot: ``None`` if the agent did not answer.
        problem: Why it did not, and what to do.
    """

    number: int
    taken: float
    snapshot: Snapshot | None
    problem: str = ""


class AgentWatch:
    """Asks the agent in a thread of its own; requests that come meanwhile wait for the same answer.

    Args:
        read: Asks the agent; may block, and raises ``RmpaError`` where it does not answer.
        clock: Monotonic seconds.
        read_whole: Asks for a snapshot of which nothing is left out, where ``read`` may leave out what is not used.
    """

    def __init__(
        self,
        read: Callable[[], Snapshot],
        clock: Callable[[], float] = time.monotonic,
        read_whole: Callable[[], Snapshot] | None = None,
    ) -> None:
        self._read = read
        self._read_whole = read_whole
        self._whole: Reading | None = None
        self._pending_whole: asyncio.Task[Reading] | None = None
        self._clock = clock
        self._thread = ThreadPoolExecutor(1, "rmpa-agent-watch")
        self._last: Reading | None = None
        self._pending: asyncio.Task[Reading] | None = None
        self.reads = 0
        """Questions to the agent so far."""
        self.seconds = 0.0
        """Seconds that they took in total."""

    async def reading(self) -> Reading:
        """The newest reading, at most ``limits.WEB_SNAPSHOT_AGE`` old when this was called."""
        if self._pending is None:
            last = self._last
            if last is not None and self._clock() - last.taken < limits.WEB_SNAPSHOT_AGE:
                return last
            self._pending = asyncio.create_task(self._ask(), name="agent watch")
        return await asyncio.shield(self._pending)  # a client that leaves must not end it for the others

    async def whole(self) -> Reading:
        """As ``reading``, with all topics and services also where the usual reading leaves some out."""
        reading = await self.reading()
        snapshot = reading.snapshot
        read = self._read_whole
        if read is None or snapshot is None or not (snapshot.topics_left or snapshot.services_left):
            return reading
        whole = self._whole
        if whole is None or self._clock() - whole.taken >= limits.WEB_WHOLE_AGE:
            if self._pending_whole is None:
                self._pending_whole = asyncio.create_task(self._ask_whole(read), name="agent watch, whole")
            whole = await asyncio.shield(self._pending_whole)
        return whole

    async def _ask_whole(self, read: Callable[[], Snapshot]) -> Reading:
        try:
            snapshot, problem = await asyncio.get_running_loop().run_in_executor(
                self._thread, self._read_safely, read
            )
        finally:
            self._pending_whole = None
        self.reads += 1
        self._whole = Reading(self.reads, self._clock(), snapshot, problem)
        return self._whole

    async def _ask(self) -> Reading:
        began = self._clock()
        try:
            snapshot, problem = await asyncio.get_running_loop().run_in_executor(
                self._thread, self._read_safely, self._read
            )
        finally:
            self._pending = None
        now = self._clock()
        self.reads += 1
        self.seconds += now - began
        self._log_change(snapshot, problem)
        self._last = Reading(self.reads, now, snapshot, problem)
        return self._last

    @staticmethod
    def _read_safely(read: Callable[[], Snapshot]) -> tuple[Snapshot | None, str]:
        try:
            return read(), ""
        except RmpaError as error:
            return None, str(error)

    def _log_change(self, snapshot: Snapshot | None, problem: str) -> None:
        was_up = self._last is not None and self._last.snapshot is not None
        if snapshot is not None and not was_up:
            _log.info("= the agent %s answers", snapshot.agent.name)
        elif snapshot is None and (self._last is None or was_up):
            _log.warning("! the agent does not answer: %s", problem)

    async def close(self) -> None:
        """Wait for a question under way, at most ``limits.WEB_AGENT_TIMEOUT``, and end the thread."""
        if pending := [task for task in (self._pending, self._pending_whole) if task is not None]:
            await asyncio.wait(pending)
        self._thread.shutdown()


class ControlReader:
    """Reads snapshots over one kept connection to the control socket; called by one thread.

    Args:
        environ: Says where the sockets are.
        name: The agent's; ``None``: the one that ``choose_agent`` finds. Once found, it stays the one.
        check: Called with each snapshot before it is used; raises ``RmpaError`` if the server is not for that agent.
    """

    def __init__(
        self, environ: Mapping[str, str], name: str | None, check: Callable[[Snapshot], None] = lambda _: None
    ) -> None:
        self._environ = environ
        self._name = name
        self._check = check
        self._client: ControlClient | None = None
        self._decoder = SnapshotDecoder()
        self._used = 0.0

    def __call__(self) -> Snapshot:
        """Ask for a snapshot, with ``limits.WEB_TOPICS`` topics and services if most of them are not used.

        Raises:
            RmpaError: No agent answers, or several run and none is named.
        """
        return self._read(most=limits.WEB_TOPICS)

    def read_whole(self) -> Snapshot:
        """Ask for a snapshot of which nothing is left out; raises as a call."""
        with ControlClient(choose_agent(self._environ, self._name).path, limits.WEB_WHOLE_TIMEOUT) as client:
            return self._checked(client.snapshot())

    def _read(self, **args: object) -> Snapshot:
        began = time.monotonic()
        if self._client is not None and began - self._used < observe_limits.CONTROL_IDLE_TIMEOUT / 2:
            try:
                return self._ask(self._client, args)
            except UnreachableError:
                if time.monotonic() - began >= limits.WEB_AGENT_TIMEOUT:
                    raise  # the agent hangs; another connection would wait as long
                # It hung up, as it was started anew: look for its new socket.
        self.close()
        agent = choose_agent(self._environ, self._name)
        self._name = agent.name
        self._client = ControlClient(agent.path, limits.WEB_AGENT_TIMEOUT)
        return self._ask(self._client, args)

    def _ask(self, client: ControlClient, args: dict[str, object]) -> Snapshot:
        try:
            snapshot = client.snapshot(self._decoder, **args)
        except RmpaError:
            self.close()
            raise
        self._used = time.monotonic()
        return self._checked(snapshot)

    def _checked(self, snapshot: Snapshot) -> Snapshot:
        self._check(snapshot)
        return snapshot

    def close(self) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None


# Changes of the graph as the agent tells them, so that the hub has them at once and need not read all of it.


_T = TypeVar("_T")


class GraphSignal:
    """Waits for changes at the control socket, one question after the other, and gives them to the graph.

    An older agent, and one whose core is another program, tells only that there is a change: then the master is asked
    for the graph. While no agent answers, the master is asked again and again.

    Args:
        environ: Says where the sockets are.
        agent: Returns the agent's name; ``None``: the one that ``choose_agent`` finds.
        graph: Takes the changes.
    """

    def __init__(self, environ: Mapping[str, str], agent: Callable[[], str | None], graph: GraphWatch) -> None:
        self._environ = environ
        self._agent = agent
        self._graph = graph
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin, in a task."""
        self._task = asyncio.get_running_loop().create_task(self._run(), name="wait for changes of the graph")

    async def close(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    async def _run(self) -> None:
        while True:
            try:
                await self._follow()
            except (RmpaError, OSError, EOFError, asyncio.LimitOverrunError) as error:
                _log.debug("! changes of the graph are not told: %s", error)
            finally:
                self._graph.lose()
            await asyncio.sleep(limits.NODE_RETRY)

    async def _follow(self) -> None:
        master = await self._graph.master()
        agent = await asyncio.to_thread(choose_agent, self._environ, self._agent())
        # Only the first answer, and one after more changes than the agent keeps, has the whole graph.
        async with control_stream(agent.path) as (reader, writer):
            known: int | None = None
            while True:
                args: dict[str, object] = {"after": known, "wait": limits.GRAPH_WAIT, "rows": True}
                async with asyncio.timeout(limits.GRAPH_WAIT + limits.WEB_AGENT_TIMEOUT):
                    told = await ask(reader, writer, ControlRequest("graph", args), GraphRevision)
                known = await self._take(told, known, master)

    async def _take(self, told: GraphRevision, known: int | None, master: str) -> int:
        if told.rows is None:
            if told.revision != known:
                self._graph.look()
            self._graph.told = True
        elif not same_core(told.core_uri, master):
            raise RemoteProtocolError(f"the agent's core is {told.core_uri}, and this node's {master}")
        elif told.revision != known:
            loop = asyncio.get_running_loop()
            began = loop.time()
            self._graph.take(told.rows)
            # Changes of the next moment come together: in a storm of them, half of the time is spent here.
            await asyncio.sleep(max(limits.GRAPH_GATHER, loop.time() - began))
        return told.revision


@contextlib.asynccontextmanager
async def control_stream(path: Path) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """A connection to an agent's control socket."""
    reader, writer = await asyncio.open_unix_connection(path, limit=observe_limits.CONTROL_REPLY_MAX)
    try:
        yield reader, writer
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def ask(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: ControlRequest, kind: type[_T]
) -> _T:
    """The agent's answer to a request.

    Raises:
        RemoteProtocolError: It is refused, or of another kind.
    """
    writer.write(request.serialize())
    reply = ControlReply.parse(await reader.readuntil(b"\n"))
    if not reply.ok:
        raise RemoteProtocolError(reply.error)
    try:
        return msgspec.convert(reply.value, kind)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"the agent answers {request.op} in another way: {error}") from None


# Whether a server fits the agent that it speaks to: it is never less secure than that.


class TrustWatch:
    """Notices an agent that is secured in another way than this server: the server is then to be made anew.

    It holds a connection to the agent's control socket, whose end tells that the agent may be another one now: also
    one of another name that took over the core, since the server's node stays registered there.

    Args:
        environ: Says where the sockets are.
        agent: The agent's name; ``None``: the one that ``choose_agent`` finds.
        fits: Whether this server may speak to an agent; ``None``: one without trust.
    """

    def __init__(
        self, environ: Mapping[str, str], agent: str | None, fits: Callable[[TrustStatus | None], bool]
    ) -> None:
        self._environ = environ
        self._agent = agent
        self._core = ""
        self._fits = fits
        self._loop = asyncio.get_running_loop()
        self._task: asyncio.Task[None] | None = None
        self.misfit = asyncio.Event()
        """Set once an agent answers that this server may not speak to."""

    def start(self) -> None:
        """Begin, in a task."""
        self._task = self._loop.create_task(self._run(), name="watch whether the agent is secured")

    async def close(self) -> None:
        """End."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    def check(self, snapshot: Snapshot) -> None:
        """Check the agent that sent a snapshot; may be called in any thread.

        Raises:
            PeerRefused: This server may not show it.
        """
        if not self._fits(snapshot.trust):
            self._loop.call_soon_threadsafe(self.misfit.set)
            problem = "is secured, and this server begins anew with its certificate and permissions"
            raise PeerRefused(f"agent {snapshot.agent.name}", problem, "ask again")

    async def _run(self) -> None:
        pause = limits.TRUST_RETRY
        while not self.misfit.is_set():
            try:
                await self._follow()
                pause = limits.TRUST_RETRY
            except (RmpaError, OSError, EOFError, TimeoutError, asyncio.LimitOverrunError) as error:
                _log.debug("! whether the agent is secured is not known: %s", error)
            await asyncio.sleep(pause)
            pause = min(2 * pause, limits.NODE_RETRY)

    async def _follow(self) -> None:
        """Ask one run of an agent, and wait for its end."""
        agent = await asyncio.to_thread(self._find)
        async with control_stream(agent.path) as (reader, writer):
            async with asyncio.timeout(limits.WEB_AGENT_TIMEOUT):
                status = await ask(reader, writer, ControlRequest("trust", {"what": "status"}), TrustStatus)
            if not self._fits(status if status.on else None):
                self.misfit.set()
                return
            self._agent = self._agent or agent.name
            await reader.read()  # idle connections are ended, too: then it is asked again

    def _find(self) -> FoundAgent:
        """The agent; where it does not run, one that has its core."""
        agents = find_agents(self._environ)
        found = next((agent for agent in agents if agent.name == self._agent), None)
        for agent in agents if found is None and self._core else ():
            with contextlib.suppress(RmpaError), ControlClient(agent.path) as client:
                if same_core(client.agent().core_uri, self._core):
                    return agent
        if found is None:
            found = choose_agent(self._environ, self._agent)
        with ControlClient(found.path) as client:
            self._core = client.agent().core_uri
        return found
