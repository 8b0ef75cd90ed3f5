"""Detects nodes that died without unregistering.

A killed node leaves its registrations behind, and roscpp does so even on SIGTERM. For a node on this machine the
kernel's table shows whether it still listens, which spares the connection (rospy starts a thread for each). Other
nodes, and those that the table lacks, are checked by connecting. Only two refused connects prove a node dead: a
network that is down does not. A node to which connecting fails for another reason is unreachable
(``ros.master.reachability``).
"""

from __future__ import annotations

import asyncio
import logging
import math
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import OutOfDescriptors, UnreachableError
from rmpa.core.limits import KIB
from rmpa.ros import limits
from rmpa.ros.http.client import connect, is_own_name, split_uri
from rmpa.ros.master.reachability import Reachability
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import Use, is_shortage
from rmpa.runtime.loop import sleep_to_tick, yielding_to_data
from rmpa.runtime.tcp_connections import ask_listening_ports

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.ros.master.reachability import Unreachable

_log = logging.getLogger(__name__)

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
