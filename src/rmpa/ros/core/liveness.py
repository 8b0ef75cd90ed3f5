"""Which nodes live: the node at an address, pings, and the notices of changes to nodes.

Finds out which node is at an address: its port may be another node's by now (ros_comm#2018, #2241).
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import random
import re
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

from rmpa.core.counters import Backoff
from rmpa.core.errors import (
    LocalProtocolError,
    OutOfDescriptors,
    PeerRefused,
    RemoteProtocolError,
    RmpaError,
    UnreachableError,
)
from rmpa.core.limits import KIB
from rmpa.ros import limits
from rmpa.ros.environment import NodeConnection, NodePing
from rmpa.ros.http.rpc import call, call_api, connect, is_own_name, split_uri
from rmpa.ros.master.parameters import Effect, ParamUpdate, PublisherUpdate, Shutdown
from rmpa.ros.master.registrations import Reachability
from rmpa.ros.node.service_client import exchange_headers
from rmpa.ros.wire.slave_api import read_bus_info
from rmpa.ros.wire.tcpros import subscriber_header
from rmpa.ros.wire.xmlrpc import RosFault, RosReply
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import Use, is_shortage
from rmpa.runtime.loop import sleep_to_tick, yielding_to_data
from rmpa.runtime.tcp_connections import ask_listening_ports

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rmpa.core.counters import Counters
    from rmpa.ros.master.registrations import Unreachable

_log = logging.getLogger(__name__)

_CALLER_ID: Final = "/rmpa_identify"
_TOPICS_ASKED: Final = 2


async def name_at(api: str, topics: Sequence[str] = ()) -> str | None:
    """Ask the node with this slave API for its name.

    rospy has ``getName``. roscpp has not, but sends its name in the header of every topic that it publishes, and
    every node publishes ``/rosout``.

    Args:
        api: The slave API's URI.
        topics: Other topics that the node may publish.

    Returns:
        Its name, or ``None`` if it cannot be found out.

    Raises:
        UnreachableError: The slave API does not answer.
    """
    try:
        reply = await call_api(api, "getName", _CALLER_ID, use=Use.CORE)
    except (RosFault, RemoteProtocolError):
        pass
    else:
        if reply.code == 1 and isinstance(reply.value, str):
            return reply.value
    for topic in dict.fromkeys(["/rosout", *topics][:_TOPICS_ASKED]):
        try:
            async with asyncio.timeout(limits.SLAVE_CALL_TIMEOUT):
                name = await _publisher_of(api, topic)
        except (RosFault, RemoteProtocolError, OSError) as error:
            _log.debug("= %s does not tell its name for %s: %s", api, topic, error)
            continue
        if name is not None:
            return name
    return None


async def _publisher_of(api: str, topic: str) -> str | None:
    reply = await call_api(api, "requestTopic", _CALLER_ID, topic, [["TCPROS"]], use=Use.CORE)
    match reply:
        case (1, _, ["TCPROS", str(host), int(port)]):
            return await _callerid(host, port, topic)
    return None


async def _callerid(host: str, port: int, topic: str) -> str | None:
    sock = await connect(host, port, Use.CORE)
    try:
        fields = await exchange_headers(sock, subscriber_header(topic, _CALLER_ID))
    finally:
        sock.close()
    return None if fields is None else fields.get("callerid")


# Detects nodes that died without unregistering.
#
# A killed node leaves its registrations behind, and roscpp does so even on SIGTERM. For a node on this machine the
# kernel's table shows whether it still listens, which spares the connection (rospy starts a thread for each). Other
# nodes, and those that the table lacks, are checked by connecting. Only two refused connects prove a node dead: a
# network that is down does not. A node to which connecting fails for another reason is unreachable
# (``ros.master.registrations``).


_TABLES: Final = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
_PIECE: Final = 4 * KIB
_PORTIONS: Final = 10
"""Wake-ups in one interval over which the connects to nodes are spread."""
_LISTENING: Final = re.compile(rb"^ *\d+: [0-9A-F]+:([0-9A-F]{4}) [0-9A-F]+:[0-9A-F]{4} 0A ", re.MULTILINE)


def listening_ports() -> set[int] | None:
    """TCP ports in state LISTEN in this network namespace, or ``None`` where the kernel does not report them.

    Call it in a thread: the kernel may take milliseconds.
    """
    ports = ask_listening_ports()
    return ports if ports is not None else read_tables()


def read_tables() -> set[int] | None:
    """Read the TCP ports in state LISTEN from ``/proc``, for kernels without sock_diag; ``None`` without ``/proc``.

    The kernel takes milliseconds where there are thousands of sockets. The files are read in short pieces, between
    which other threads can run.
    """
    ports: set[int] = set()
    try:
        for table in _TABLES:
            if table == _TABLES[0] or table.exists():
                with table.open("rb", buffering=0) as file:
                    rest = b""
                    while piece := file.read(_PIECE):
                        lines, end, rest = (rest + piece).rpartition(b"\n")
                        ports.update(int(port, 16) for port in _LISTENING.findall(lines + end))
    except OSError:
        return None
    return ports


class Liveness:
    """Checks the nodes of one master.

    Args:
        nodes: All nodes with their slave APIs.
        on_dead: ``(node, api)`` of a node that refused two connects.
        interval: Seconds in which every node is checked once; ``limits.NODE_CHECK_INTERVAL`` by default.
    """

    def __init__(
        self,
        *,
        nodes: Callable[[], dict[str, str]],
        on_dead: Callable[[str, str], None],
        interval: float | None = None,
    ) -> None:
        self._nodes = nodes
        self._on_dead = on_dead
        self._interval = limits.NODE_CHECK_INTERVAL if interval is None else interval
        self._task: asyncio.Task[None] | None = None
        self._checks: dict[str, asyncio.Task[None]] = {}
        self._ports: asyncio.Future[set[int] | None] | None = None
        """The latest call of ``listening_ports`` in a thread."""
        self._closed = False
        self._local_ports: dict[str, int | None] = {}
        """The port of each slave API on this machine; ``None`` of the others."""
        self._reachability = Reachability()
        self._slow = asyncio.Semaphore(limits.NODE_UNREACHABLE_CHECKS)

    @property
    def unreachable(self) -> Mapping[str, Unreachable]:
        """The nodes to which connecting failed, by name; the caller must not change the mapping."""
        return self._reachability.unreachable

    def start(self) -> None:
        """Begin to check."""
        self._task = asyncio.get_running_loop().create_task(self._check_all(), name="node liveness")

    async def close(self) -> None:
        """Stop checking; ``suspect`` does nothing from now on.

        A call of ``listening_ports`` cannot be stopped in its thread; it is waited for, because it has a socket open.
        """
        self._closed = True
        tasks = [*self._checks.values()]
        if self._task is not None:
            tasks.append(self._task)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._ports is not None:
            await asyncio.wait([self._ports], timeout=runtime_limits.DRAIN_TIMEOUT)

    def suspect(self, node: str) -> None:
        """Check one node now."""
        api = self._nodes().get(node)
        if api is None or node in self._checks or self._closed:
            return
        task = asyncio.get_running_loop().create_task(self._check(node, api), name=f"check {node}")
        self._checks[node] = task
        task.add_done_callback(lambda _: self._checks.pop(node, None))

    async def _check_all(self) -> None:
        while True:
            self._ports = asyncio.get_running_loop().run_in_executor(None, listening_ports)
            silent = self._not_listening(await asyncio.shield(self._ports))
            # Connects are spread over the interval, in as few wake-ups as their number allows.
            portion = max(1, math.ceil(len(silent) / _PORTIONS))
            for first in range(0, max(1, len(silent)), portion):
                for node in silent[first : first + portion]:
                    self.suspect(node)
                if first + portion < len(silent):
                    await sleep_to_tick(self._interval / _PORTIONS)
            await sleep_to_tick(self._interval)

    def _not_listening(self, ports: set[int] | None) -> list[str]:
        """The nodes that the kernel's table does not prove to live; the others are noted as reached."""
        nodes = self._nodes()
        self._reachability.keep(nodes)
        before, self._local_ports = self._local_ports, {}
        silent = []
        for node, api in yielding_to_data(nodes.items()):
            port = self._local_ports[api] = before[api] if api in before else _local_port(api)
            if ports is not None and port in ports:
                self._reached(node)
            else:
                silent.append(node)
        return silent

    async def _check(self, node: str, api: str) -> None:
        try:
            if node in self._reachability.unreachable:
                async with self._slow:
                    problem = await try_connect(api)
            else:
                problem = await try_connect(api)
        except ConnectionRefusedError:
            await asyncio.sleep(limits.NODE_RECHECK_DELAY)
            if await refuses(api) and self._nodes().get(node) == api:
                _log.warning("= node %s at %s is dead: no process listens there", node, api)
                self._on_dead(node, api)
            return
        except OutOfDescriptors:
            return  # a shortage of this process shows nothing about the node
        if self._nodes().get(node) != api:
            return
        if not problem:
            self._reached(node)
        elif self._reachability.failed(node, api, problem, asyncio.get_running_loop().time()):
            text = "! node %s at %s cannot be reached (%s): peers are not offered it until it can"
            _log.warning(text, node, api, problem)

    def _reached(self, node: str) -> None:
        if self._reachability.reached(node):
            _log.warning("= node %s can be reached again", node)


def _local_port(api: str) -> int | None:
    """The port of a slave API that is on this machine by its name; ``None`` of another one."""
    try:
        host, port, _ = split_uri(api)
    except UnreachableError:
        return None  # the attempt to connect reports the reason
    return port if is_own_name(host) or host.startswith("127.") else None


async def refuses(api: str) -> bool:
    """Whether connects to a slave API are refused; ``False`` where that cannot be found out."""
    try:
        await try_connect(api)
    except ConnectionRefusedError:
        return True
    except OutOfDescriptors:
        return False
    return False


async def try_connect(api: str) -> str:
    """Connect to a slave API and close the connection; return why it cannot be reached, or an empty text.

    Raises:
        ConnectionRefusedError: Nothing listens at that address.
        OutOfDescriptors: No file descriptor is left for the attempt.
    """
    try:
        host, port, _ = split_uri(api)
        async with asyncio.timeout(limits.TCPROS_CONNECT_TIMEOUT):
            sock = await connect(host, port, Use.CORE)
    except ConnectionRefusedError:
        raise
    except TimeoutError:
        return f"no answer in {limits.TCPROS_CONNECT_TIMEOUT:g} s"
    except UnreachableError as error:
        return error.remedy or str(error)
    except OSError as error:
        if is_shortage(error):
            raise OutOfDescriptors("node", api) from error
        return os.strerror(error.errno) if error.errno else str(error)
    sock.close()
    return ""


# Calls to one node's slave API: ping and shut down.


async def ping_node(node: str, uri: str, caller_id: str) -> NodePing:
    """Ask a node for its process id, and measure the time of the call.

    Args:
        node: Its name, for errors.
        uri: Its slave API.
        caller_id: The asking node's name.

    Raises:
        UnreachableError: The node does not answer.
        PeerRefused: The node answers with an error.
        RemoteProtocolError: The answer is malformed.
    """
    loop = asyncio.get_running_loop()
    begin = loop.time()
    reply = await _call(node, uri, "getPid", caller_id)
    if reply.code != 1 or not isinstance(reply.value, int):
        raise PeerRefused(node, reply.status or "it does not tell its process")
    return NodePing(uri=uri, time=loop.time() - begin, pid=reply.value)


async def node_connections(uri: str, caller_id: str, names: Mapping[str, str]) -> tuple[NodeConnection, ...] | None:
    """Ask a node for its connections; ``None`` if it does not answer.

    Args:
        uri: Its slave API.
        caller_id: The asking node's name.
        names: Nodes by their slave APIs: of a publisher a subscriber knows that address alone.
    """
    try:
        links = read_bus_info(await call(uri, "getBusInfo", caller_id))
    except (RmpaError, RosFault):
        return None
    found = (
        NodeConnection(
            topic=link.topic, inbound=link.inbound, other=names.get(link.other, link.other), connected=link.connected
        )
        for link in links
    )
    return tuple(islice(found, limits.NODE_CONNECTIONS_SHOWN))


async def end_node(node: str, uri: str, caller_id: str, reason: str) -> bool:
    """Ask a node to end, and wait up to ``limits.NODE_KILL_WAIT`` until it has.

    Args:
        node: Its name, for errors.
        uri: Its slave API.
        caller_id: The asking node's name.
        reason: For the node's log.

    Returns:
        Whether nothing listens at its slave API any more.

    Raises:
        UnreachableError: The node does not answer, and its port does not refuse connections.
        PeerRefused: The node refuses.
        RemoteProtocolError: The answer is malformed.
    """
    try:
        reply = await _call(node, uri, "shutdown", caller_id, reason)
    except (UnreachableError, RemoteProtocolError):
        # A node may end before it answers.
        if not await refuses(uri):
            raise
        return True
    if reply.code != 1:
        raise PeerRefused(node, reply.status or "it does not end")
    return await _ended(uri)


async def _ended(uri: str) -> bool:
    loop = asyncio.get_running_loop()
    give_up = loop.time() + limits.NODE_KILL_WAIT
    while not await refuses(uri):
        if loop.time() >= give_up:
            return False
        await asyncio.sleep(limits.NODE_KILL_LOOK)
    return True


async def _call(node: str, uri: str, method: str, *params: str) -> RosReply:
    try:
        return await call_api(uri, method, *params)
    except RosFault as error:
        raise PeerRefused(node, error.text) from error


# Sends the master's notifications to slave APIs: in order and one at a time to each, independently of the others.
#
# rosmaster has three threads for all slaves, so three stopped nodes stop every notification; here each URI has its
# own
# queue. For each topic only the latest list of publishers is queued. Parameter updates are all sent, until
# ``limits.NOTIFY_COALESCE`` notifications wait; from then on a newer update of a parameter replaces an older one.


MASTER_ID = "/master"
"""The caller id of masters in calls to slaves."""

_Key: TypeAlias = tuple[type[Effect], str, int]


class Notifier:
    """One queue for each slave API, emptied by a task that runs while there is something in it.

    Args:
        nodes_at: Returns the nodes that are registered with a slave API; a failed notification is not sent again if
            there are none.
        on_unreachable: Called with a slave API that did not answer: its nodes may be dead.
        counters: ``notify.sent``, ``notify.failed``, ``notify.dropped``.
    """

    def __init__(
        self,
        *,
        nodes_at: Callable[[str], list[str]],
        on_unreachable: Callable[[str], None],
        counters: Counters,
    ) -> None:
        self._nodes_at = nodes_at
        self._on_unreachable = on_unreachable
        self._counters = counters
        self._queues: dict[str, dict[_Key, Effect]] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._closed = False
        self._serial = 0

    @property
    def waiting(self) -> int:
        """Notifications in the queues."""
        return sum(map(len, self._queues.values()))

    def add(self, effect: Effect) -> None:
        """Queue a notification; a task sends it, never this call."""
        if self._closed:
            return
        queue = self._queues.setdefault(effect.api, {})
        key = self._key(effect, len(queue))
        # Moved to the end: updates of nested parameters overlap, so a newer one must also be sent later.
        queue.pop(key, None)
        queue[key] = effect
        if len(queue) > limits.NOTIFY_QUEUE_MAX:
            del queue[next(iter(queue))]
            self._counters.add("notify.dropped")
        if effect.api not in self._tasks:
            self._tasks[effect.api] = asyncio.get_running_loop().create_task(
                self._empty(effect.api, queue), name=f"notify {effect.api}"
            )

    def _key(self, effect: Effect, waiting: int) -> _Key:
        """The key by which a newer notification replaces an older one."""
        match effect:
            case PublisherUpdate(topic=name) | Shutdown(node=name):
                return type(effect), name, 0
            case ParamUpdate(key=name):
                self._serial += 1
                return ParamUpdate, name, self._serial if waiting < limits.NOTIFY_COALESCE else 0

    async def close(self) -> None:
        """Stop at once; queued notifications are not sent."""
        self._closed = True
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _empty(self, api: str, queue: dict[_Key, Effect]) -> None:
        backoff = Backoff(limits.NOTIFY_RETRY_FIRST, limits.NOTIFY_RETRY_MAX, random.random)
        try:
            while queue:
                key = next(iter(queue))
                effect = queue.pop(key)
                if await self._sent(effect):
                    backoff.reset()
                elif isinstance(effect, Shutdown):
                    continue
                elif not self._nodes_at(api):
                    queue.clear()
                else:
                    if key not in queue:
                        rest = dict(queue)
                        queue.clear()
                        queue.update({key: effect, **rest})
                    await asyncio.sleep(backoff.delay())
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! notifications to %s failed", api)
        finally:
            del self._queues[api], self._tasks[api]

    async def _sent(self, effect: Effect) -> bool:
        """Send one; return whether it need not be sent again."""
        try:
            await self._send(effect)
        except OutOfDescriptors as error:
            # The shortage is this process's, and is reported elsewhere: the node may be well.
            self._counters.add("notify.failed")
            _log.debug("! %s", error)
            return False
        except UnreachableError as error:
            self._counters.add("notify.failed")
            _log.info("! %s", error)
            self._on_unreachable(effect.api)
            return False
        except (RosFault, RemoteProtocolError, LocalProtocolError) as error:
            # The node got it, or never will: sending again would not help.
            self._counters.add("notify.failed")
            _log.info("! %s: %s", effect.api, error)
        else:
            self._counters.add("notify.sent")
        return True

    async def _send(self, effect: Effect) -> None:
        match effect:
            case PublisherUpdate(api, topic, publishers):
                _log.debug("> %s publisherUpdate %s %s", api, topic, publishers)
                await call(api, "publisherUpdate", MASTER_ID, topic, list(publishers), use=Use.CORE)
            case ParamUpdate(api, key, value):
                _log.debug("> %s paramUpdate %s", api, key)
                await call(api, "paramUpdate", MASTER_ID, key, value, use=Use.CORE)
            case Shutdown():
                await self._shut_down(effect)

    async def _shut_down(self, effect: Shutdown) -> None:
        """Ask a node whose name another node has taken to end, unless its address is another node's by now."""
        found = await name_at(effect.api, effect.topics)
        if found is None and self._nodes_at(effect.api):
            found = self._nodes_at(effect.api)[0]
        if found is not None and found != effect.node:
            _log.info("= %s is not asked to end: %s is at %s now", effect.node, found, effect.api)
            self._counters.add("notify.stale")
            return
        _log.warning("> %s at %s is asked to end: another node has its name", effect.node, effect.api)
        reason = f"[{effect.node}] Reason: new node registered with same name"
        await call(effect.api, "shutdown", MASTER_ID, reason, use=Use.CORE)
