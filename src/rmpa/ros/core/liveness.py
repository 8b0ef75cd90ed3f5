"""Which nodes live, and the notices of changes to nodes."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import random
import time
from collections import OrderedDict, deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias, cast

from rmpa.core.errors import LocalProtocolError, OutOfDescriptors, RemoteProtocolError, UnreachableError
from rmpa.core.timers import Backoff
from rmpa.ros import limits
from rmpa.ros.http.rpc import call, is_own_name, split_uri
from rmpa.ros.node.ask import name_at, refuses, try_connect
from rmpa.ros.wire.xmlrpc import RosFault, XmlRpcValue
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import Use
from rmpa.runtime.kernel_tcp import ask_listening_ports
from rmpa.runtime.loop import sleep_to_tick, yielding_to_data
from rmpa.runtime.tasks import OwnedTasks, end_tasks, keep_task, start_task

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.statistics import Counters
    from rmpa.ros.master.parameters import SlaveCall
    from rmpa.ros.master.registrations import Registrations

_log = logging.getLogger(__name__)

# Time between the two refused connects that prove a node dead: it may be restarting its server.
NODE_RECHECK_DELAY: Final = 0.2

# Nodes that died and are remembered: those who look once in some seconds learn of each.
_DIED: Final = 64
# Concurrent attempts to reach unreachable nodes: each may hold a thread of the resolver for seconds.
_NODE_UNREACHABLE_CHECKS: Final = 4
# With this many updates queued for a node, only the latest of each parameter is kept; with fewer all of them.
_NOTIFY_COALESCE: Final = 64
# Pause before an update is sent again to a node that did not answer.
_NOTIFY_RETRY_FIRST: Final = 0.2
# The longest pause between attempts, while the node is registered.
_NOTIFY_RETRY_MAX: Final = 3.0

# Slave APIs whose ports are remembered: those of the nodes of some large modules.
_LOCAL_PORTS_MAX: Final = 16_384
# Wake-ups in one interval over which the connects to nodes are spread.
_PORTIONS: Final = 10


# Nodes that died without unregistering. A killed node leaves its registrations behind, and roscpp does so even on
# SIGTERM. For a node on this machine the kernel's table shows whether it still listens, which spares the connection
# (rospy starts a thread for each). Other nodes, and all where the kernel does not tell, are checked by connecting.
# Only two refused connects prove a node dead: a network that is down does not.


@dataclass(frozen=True, slots=True)
class Unreachable:
    """A registered node to which connecting fails: an address without a route, a host name that does not resolve.

    It may live: its network may be down for a moment. It stays registered, as at roscore, but after
    ``limits.NODE_UNREACHABLE_AFTER`` it is *withdrawn*: its topics and services are no longer offered to peers.

    Args:
        api: The slave API's URI that it registered with.
        problem: Why the last attempt failed, for people.
        since: When the first attempt failed, in seconds of the monotonic clock.
        withdrawn: Whether its topics and services are no longer offered to peers.
    """

    api: str
    problem: str
    since: float
    withdrawn: bool = False


class Liveness:
    """Checks the nodes of one master.

    Args:
        nodes: All nodes with their slave APIs.
        on_dead: ``(node, api)`` of a node that refused two connects.

    Attributes:
        unreachable: The nodes to which connecting failed when it was last tried, by name; not to be changed by
            others.
        died: The latest nodes that were dead, each with the time in seconds since the epoch.
    """

    def __init__(self, *, nodes: Callable[[], dict[str, str]], on_dead: Callable[[str, str], None]) -> None:
        self._nodes = nodes
        self._on_dead = on_dead
        self._task: asyncio.Task[None] | None = None
        self._checks: dict[str, asyncio.Task[None]] = {}
        # The latest call of ``ask_listening_ports`` in a thread.
        self._ports: asyncio.Future[set[int] | None] | None = None
        self._closed = False
        self.unreachable: dict[str, Unreachable] = {}
        self.died: deque[tuple[str, float]] = deque(maxlen=_DIED)
        self._slow = asyncio.Semaphore(_NODE_UNREACHABLE_CHECKS)

    def start(self) -> None:
        """Begin to check."""
        self._task = keep_task(self._check_all, "node liveness")

    async def close(self) -> None:
        """Stop checking; ``suspect`` does nothing from now on.

        A call of ``ask_listening_ports`` cannot be stopped in its thread. It is waited for, as it has a socket open.
        """
        self._closed = True
        await end_tasks(self._task, *self._checks.values())
        if self._ports is not None:
            await asyncio.wait([self._ports], timeout=runtime_limits.DRAIN_TIMEOUT)

    def suspect(self, node: str) -> None:
        """Check one node now."""
        api = self._nodes().get(node)
        if api is None or node in self._checks or self._closed:
            return
        task = self._checks[node] = start_task(self._check(node, api), f"check {node}")
        task.add_done_callback(lambda _: self._checks.pop(node, None))

    async def _check_all(self) -> None:
        while True:
            # In a thread: where there are thousands of sockets, the kernel may take milliseconds.
            self._ports = asyncio.get_running_loop().run_in_executor(None, ask_listening_ports)
            silent = self._not_listening(await asyncio.shield(self._ports))
            # Connects are spread over the interval, in as few wake-ups as their number allows.
            portions = [silent[first::_PORTIONS] for first in range(min(_PORTIONS, max(1, len(silent))))]
            for portion in portions:
                for node in portion:
                    self.suspect(node)
                await sleep_to_tick(limits.NODE_CHECK_INTERVAL / len(portions))

    def _not_listening(self, ports: set[int] | None) -> list[str]:
        """The nodes that the kernel's table does not prove to live; the others are noted as reached."""
        nodes = self._nodes()
        self.unreachable = {node: found for node, found in self.unreachable.items() if nodes.get(node) == found.api}
        silent = []
        for node, api in yielding_to_data(nodes.items()):
            port = _local_port(api)
            if ports is not None and port in ports:
                self.tried(node, api, "", 0.0)
            else:
                silent.append(node)
        return silent

    async def _check(self, node: str, api: str) -> None:
        try:
            async with self._slow if node in self.unreachable else contextlib.nullcontext():
                problem = await try_connect(api)
        except ConnectionRefusedError:
            await asyncio.sleep(NODE_RECHECK_DELAY)
            if await refuses(api) and self._nodes().get(node) == api:
                _log.warning("= node %s at %s is dead: no process listens there [node-gone]", node, api)
                self.died.append((node, time.time()))
                self._on_dead(node, api)
            return
        except OutOfDescriptors:
            return  # a shortage of this process shows nothing about the node
        if self._nodes().get(node) == api:
            self.tried(node, api, problem, asyncio.get_running_loop().time())

    def tried(self, node: str, api: str, problem: str, now: float) -> None:
        """Take in an attempt to connect to a node that was not refused.

        Args:
            node: The node's name.
            api: Its slave API.
            problem: Why the attempt failed, for people; empty if it did not.
            now: Monotonic seconds.
        """
        known = self.unreachable.pop(node, None)
        was_withdrawn = known is not None and known.withdrawn
        if not problem:
            if was_withdrawn:
                _log.warning("= node %s can be reached again [node-unreachable]", node)
            return
        since = known.since if known is not None and known.api == api else now
        withdrawn = now - since >= limits.NODE_UNREACHABLE_AFTER
        self.unreachable[node] = Unreachable(api, problem, since, withdrawn)
        if withdrawn and not was_withdrawn:
            text = "! node %s at %s cannot be reached (%s); until then peers are not offered it [node-unreachable]"
            _log.warning(text, node, api, problem)


@functools.lru_cache(maxsize=_LOCAL_PORTS_MAX)
def _local_port(api: str) -> int | None:
    """The port of a slave API that is on this machine by its name; ``None`` of another one."""
    try:
        host, port, _ = split_uri(api)
    except UnreachableError:
        return None  # the attempt to connect reports the reason
    return port if is_own_name(host) or host.startswith("127.") else None


# The master's calls of slaves. rosmaster has three threads for all slaves, so three stopped nodes stop every
# notification; here each URI has its own queue. For each topic only the latest list of publishers is queued.
# Parameter updates are all sent, until ``_NOTIFY_COALESCE`` notifications wait; from then on a newer update of a
# parameter replaces an older one.


# The caller id of masters in calls to slaves.
MASTER_ID = "/master"
# By method, by what it tells of, and by a number that lets a newer notification replace an older one.
_Queue: TypeAlias = OrderedDict[tuple[str, str, int], XmlRpcValue]


class Notifier:
    """One queue for each slave API, emptied by a task that runs while there is something in it.

    Args:
        registrations: The master's tables: a failed notification is not sent again once no node has its slave API.
        suspect: Called with each node of a slave API that did not answer: it may be dead.
        counters: ``notify.sent``, ``notify.failed``, ``notify.dropped``.
    """

    def __init__(self, registrations: Registrations, suspect: Callable[[str], None], counters: Counters) -> None:
        self._registrations = registrations
        self._suspect = suspect
        self._counters = counters
        self._queues: dict[str, _Queue] = {}
        self._tasks = OwnedTasks()
        self._closed = False
        self._serial = 0

    def add(self, slave_call: SlaveCall) -> None:
        """Queue a call; a task makes it, never this call."""
        if self._closed:
            return
        api, method, name, value = slave_call
        queue = self._queues.get(api)
        if queue is None:
            queue = self._queues[api] = OrderedDict()
            self._tasks.start(self._empty(api, queue), f"notify {api}")
        number = 0
        if method == "paramUpdate" and len(queue) < _NOTIFY_COALESCE:
            number = self._serial = self._serial + 1
        # Moved to the end: updates of nested parameters overlap, so a newer one must also be sent later.
        queue.pop((method, name, number), None)
        queue[method, name, number] = value
        if len(queue) > limits.NOTIFY_QUEUE_MAX:
            del queue[next(iter(queue))]
            self._counters.add("notify.dropped")

    async def close(self) -> None:
        """Stop at once; queued notifications are not sent."""
        self._closed = True
        await self._tasks.close()

    async def _empty(self, api: str, queue: _Queue) -> None:
        backoff = Backoff(_NOTIFY_RETRY_FIRST, _NOTIFY_RETRY_MAX, random.random)
        try:
            while queue:
                key = method, name, _ = next(iter(queue))
                value = queue.pop(key)
                if await self._sent(api, method, name, value):
                    backoff.reset()
                elif method == "shutdown":
                    continue
                elif not self._registrations.nodes_at(api):
                    queue.clear()
                else:
                    if key not in queue:
                        queue[key] = value
                        queue.move_to_end(key, last=False)
                    await asyncio.sleep(backoff.delay())
        finally:
            del self._queues[api]

    async def _sent(self, api: str, method: str, name: str, value: XmlRpcValue) -> bool:
        """Send one; return whether it need not be sent again."""
        try:
            if method == "shutdown":
                await self._shut_down(api, name, value)
            else:
                _log.debug("> %s %s %s", api, method, name)
                # Given up earlier it might be carried out behind the next one, which is newer.
                await call(api, method, MASTER_ID, name, value, timeout=limits.TCPROS_CONNECT_TIMEOUT, use=Use.CORE)
        except (UnreachableError, RosFault, RemoteProtocolError, LocalProtocolError) as error:
            self._counters.add("notify.failed")
            # A shortage is this process's, and is reported elsewhere: the node may be well.
            short = isinstance(error, OutOfDescriptors)
            _log.log(logging.DEBUG if short else logging.INFO, "! %s: %s", api, error)
            if isinstance(error, UnreachableError) and not short:
                for node in self._registrations.nodes_at(api):
                    self._suspect(node)
            # Else the node got it, or never will: sending again would not help.
            return not isinstance(error, UnreachableError)
        self._counters.add("notify.sent")
        return True

    async def _shut_down(self, api: str, node: str, topics: XmlRpcValue) -> None:
        """Ask a node whose name another node has taken to end, unless its address is another node's by now."""
        found = await name_at(api, cast("list[str]", topics))
        if found is None:
            found = next(iter(self._registrations.nodes_at(api)), None)
        if found is not None and found != node:
            _log.info("= %s is not asked to end: %s is at %s now", node, found, api)
            self._counters.add("notify.stale")
            return
        _log.warning("> %s at %s is asked to end: another node has its name [node-killed]", node, api)
        await call(api, "shutdown", MASTER_ID, f"[{node}] Reason: new node registered with same name", use=Use.CORE)
