"""What the server knows of the agent: its snapshot, which all clients share, changes of the graph, and its trust."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple

from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.observe import limits as observe_limits
from rmpa.observe.control_client import ControlClient, FoundAgent, choose_agent, find_agents, same_core
from rmpa.observe.graph import GraphRevision
from rmpa.runtime.tasks import end_tasks, keep_task
from rmpa.trust.permissions import TrustStatus
from rmpa.web import limits
from rmpa.web.hub.services import SharedTasks

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.hub.graph import GraphWatch

_log = logging.getLogger(__name__)


class Reading(NamedTuple):
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
        self._read = {False: read, True: read_whole or read}
        self._clock = clock
        self._thread = ThreadPoolExecutor(1, "rmpa-agent-watch")
        self._last: dict[bool, Reading] = {}
        self._asking: SharedTasks[bool, Reading] = SharedTasks()
        # Questions to the agent so far.
        self.reads = 0
        # Seconds that they took in total.
        self.seconds = 0.0

    async def reading(self, *, whole: bool = False) -> Reading:
        """The newest reading, at most ``limits.WEB_SNAPSHOT_AGE`` old when this was called.

        Args:
            whole: With all topics and services also where the usual reading leaves some out; at most
                ``limits.WEB_WHOLE_AGE`` old then.
        """
        if whole:
            usual = await self.reading()
            if usual.snapshot is None or not (usual.snapshot.topics_left or usual.snapshot.services_left):
                return usual
        last, age = self._last.get(whole), limits.WEB_WHOLE_AGE if whole else limits.WEB_SNAPSHOT_AGE
        if last is not None and self._clock() - last.taken < age:
            return last
        return await self._asking.get(whole, lambda: self._ask(whole))

    async def _ask(self, whole: bool) -> Reading:
        began, before = self._clock(), self._last.get(whole)
        snapshot, problem = None, ""
        try:
            snapshot = await asyncio.get_running_loop().run_in_executor(self._thread, self._read[whole])
        except RmpaError as error:
            problem = str(error)
        now = self._clock()
        self.reads += 1
        self.seconds += now - began
        self._last[whole] = made = Reading(self.reads, now, snapshot, problem)
        was_up = before is not None and before.snapshot is not None
        if snapshot is not None and not was_up:
            _log.info("= the agent %s answers", snapshot.agent.name)
        elif snapshot is None and (before is None or was_up):
            _log.warning("! the agent does not answer: %s [no-agent]", problem)
        return made

    async def close(self) -> None:
        """Wait for a question under way, at most ``limits.WEB_AGENT_TIMEOUT``, and end the thread."""
        await self._asking.close()
        await asyncio.to_thread(self._thread.shutdown)


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
        self._used = 0.0

    def __call__(self) -> Snapshot:
        """Ask for a snapshot, with ``limits.WEB_TOPICS`` topics and services if most of them are not used.

        Raises:
            RmpaError: No agent answers, or several run and none is named.
        """
        began = time.monotonic()
        if self._client is not None and began - self._used < observe_limits.CONTROL_IDLE_TIMEOUT / 2:
            try:
                return self._ask(self._client)
            except UnreachableError:
                if time.monotonic() - began >= limits.WEB_AGENT_TIMEOUT:
                    raise  # the agent hangs; another connection would wait as long
                # It hung up, as it was started again: look for its new socket.
        self.close()
        agent = choose_agent(self._environ, self._name)
        self._name = agent.name
        self._client = ControlClient(agent.path, limits.WEB_AGENT_TIMEOUT)
        return self._ask(self._client)

    def read_whole(self) -> Snapshot:
        """Ask for a snapshot of which nothing is left out; raises as a call."""
        # A large graph takes the agent a second of processor time.
        with ControlClient(choose_agent(self._environ, self._name).path, timeout=8.0) as client:
            snapshot = client.snapshot()
        self._check(snapshot)
        return snapshot

    def _ask(self, client: ControlClient) -> Snapshot:
        try:
            snapshot = client.snapshot(most=limits.WEB_TOPICS)
        except RmpaError:
            self.close()
            raise
        self._used = time.monotonic()
        self._check(snapshot)
        return snapshot

    def close(self) -> None:
        """Close the connection."""
        if self._client is not None:
            self._client.close()
            self._client = None


class AgentFollower:
    """Holds a connection to the agent's control socket: whether this server fits the agent, and the graph's changes.

    A server is never less secure than its agent. The end of the connection tells that the agent may be another one
    now: also one of another name that took over the core, since the server's node stays registered there.

    The hub has the graph's changes at once, and need not read all of it. An agent whose core is another program tells
    only that there is a change: then the master is asked for the graph. While no agent answers, the master is asked
    again and again.

    Args:
        environ: Says where the sockets are.
        agent: The agent's name; ``None``: the one that ``choose_agent`` finds. Once found, it stays the one.
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
        # Set once an agent answers that this server may not speak to: the server is to be made anew.
        self.misfit = asyncio.Event()

    def start(self, graph: GraphWatch) -> None:
        """Begin, in a task; ``graph`` takes the changes."""
        self._task = keep_task(functools.partial(self._run, graph), "follow the agent")

    async def close(self) -> None:
        """End."""
        await end_tasks(self._task)

    def check(self, snapshot: Snapshot) -> None:
        """Check the agent that sent a snapshot; may be called in any thread.

        Raises:
            PeerRefused: This server may not show it.
        """
        if not self._fits(snapshot.trust):
            self._loop.call_soon_threadsafe(self.misfit.set)
            problem = "is secured, and this server starts again with its certificate and permissions"
            raise PeerRefused(f"agent {snapshot.agent.name}", problem, "ask again")

    async def _run(self, graph: GraphWatch) -> None:
        pause = limits.TRUST_RETRY
        while not self.misfit.is_set():
            try:
                agent = await asyncio.to_thread(self._find)
                with await asyncio.to_thread(
                    ControlClient, agent.path, limits.GRAPH_WAIT + limits.WEB_AGENT_TIMEOUT
                ) as client:
                    pause = limits.TRUST_RETRY
                    await self._follow(agent.name, graph, client)
            except (RmpaError, OSError) as error:  # TimeoutError is an OSError
                _log.debug("! the agent is not followed: %s", error)
                if isinstance(error, PeerRefused | RemoteProtocolError):  # it will not tell more in a moment
                    pause = limits.NODE_RETRY
            finally:
                graph.lose()
            await asyncio.sleep(pause)
            pause = min(2 * pause, limits.NODE_RETRY)

    async def _follow(self, name: str, graph: GraphWatch, client: ControlClient) -> None:
        """Ask one run of an agent until it ends."""
        within = limits.WEB_AGENT_TIMEOUT
        async with asyncio.timeout(within):
            status = await client.ask("trust", TrustStatus, what="status")
        if not self._fits(status if status.on else None):
            self.misfit.set()
            return
        self._agent = self._agent or name
        async with asyncio.timeout(within):  # the agent may have gone meanwhile
            master = await graph.master()
        # Only the first answer, and one after more changes than the agent keeps, has the whole graph.
        known: int | None = None
        while True:
            args: dict[str, Any] = {"after": known, "wait": limits.GRAPH_WAIT, "rows": True}
            told = await client.ask("graph", GraphRevision, **args)
            if told.rows is None:
                if told.revision != known:
                    graph.look()
                graph.told = True
            elif not same_core(told.core_uri, master):
                raise RemoteProtocolError(f"the agent's core is {told.core_uri}, and this node's {master}")
            elif told.revision != known:
                began = self._loop.time()
                graph.take(told.rows)
                # Changes of the next moment come together: in a storm of them, half of the time is spent here.
                await asyncio.sleep(max(limits.GRAPH_GATHER, self._loop.time() - began))
            known = told.revision

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
