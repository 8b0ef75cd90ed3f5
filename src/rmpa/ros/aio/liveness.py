"""Notices nodes that died without a word, so that their registrations can go.

A killed node leaves its registrations behind, and roscpp does so even on SIGTERM. Whether a node still listens is
read from the kernel's own table where the node is on this machine, because rospy starts a thread for everybody who
only knocks; others are connected to. Only a refused connect, twice, is death: a network that is down is none.
"""

from __future__ import annotations

import asyncio
import logging
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core import limits
from rmpa.core.errors import UnreachableError
from rmpa.ros.aio.http_client import connect, is_own_name, split_uri
from rmpa.ros.aio.sock_diag import ask_listening_ports

if TYPE_CHECKING:
    from collections.abc import Callable

_log = logging.getLogger(__name__)

_TABLES: Final = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
_PIECE: Final = 4 * limits.KIB
_LISTENING: Final = re.compile(rb"^ *\d+: [0-9A-F]+:([0-9A-F]{4}) [0-9A-F]+:[0-9A-F]{4} 0A ", re.MULTILINE)


def listening_ports() -> set[int] | None:
    """TCP ports that somebody listens at in this network namespace, or ``None`` where the kernel does not tell.

    For a thread: the kernel may take milliseconds.
    """
    ports = ask_listening_ports()
    return ports if ports is not None else read_tables()


def read_tables() -> set[int] | None:
    """The same from ``/proc``, where it cannot be asked for.

    The kernel takes milliseconds where there are thousands of sockets. Between two short pieces the interpreter is
    left to others.
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
    """Looks after the nodes of one master.

    Args:
        nodes: All nodes with their slave APIs.
        on_dead: ``(node, api)`` of a node that refused two connects.
        interval: Seconds in which every node is looked at once.
    """

    def __init__(
        self,
        *,
        nodes: Callable[[], dict[str, str]],
        on_dead: Callable[[str, str], None],
        interval: float = limits.NODE_CHECK_INTERVAL,
    ) -> None:
        self._nodes = nodes
        self._on_dead = on_dead
        self._interval = interval
        self._rounds: asyncio.Task[None] | None = None
        self._checks: dict[str, asyncio.Task[None]] = {}
        self._closed = False

    def start(self) -> None:
        """Look from now on."""
        self._rounds = asyncio.get_running_loop().create_task(self._go_round(), name="node liveness")

    async def close(self) -> None:
        """Look no longer; later suspicions are not heard."""
        self._closed = True
        tasks = [*self._checks.values()]
        if self._rounds is not None:
            tasks.append(self._rounds)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def suspect(self, node: str) -> None:
        """Check one node now."""
        api = self._nodes().get(node)
        if api is None or node in self._checks or self._closed:
            return
        task = asyncio.get_running_loop().create_task(self._check(node, api), name=f"check {node}")
        self._checks[node] = task
        task.add_done_callback(lambda _: self._checks.pop(node, None))

    async def _go_round(self) -> None:
        while True:
            ports = await asyncio.to_thread(listening_ports)
            nodes = self._nodes()
            pause = self._interval / max(1, len(nodes))
            for node, api in nodes.items():
                await asyncio.sleep(pause)
                if not _listens(api, ports):
                    self.suspect(node)
            if not nodes:
                await asyncio.sleep(pause)

    async def _check(self, node: str, api: str) -> None:
        if not await refuses(api):
            return
        await asyncio.sleep(limits.NODE_RECHECK_DELAY)
        if await refuses(api) and self._nodes().get(node) == api:
            _log.warning("= node %s at %s is dead: nobody listens there", node, api)
            self._on_dead(node, api)


def _listens(api: str, ports: set[int] | None) -> bool:
    try:
        host, port, _ = split_uri(api)
    except UnreachableError:
        return True  # what cannot be asked is left alone
    return ports is not None and (is_own_name(host) or host.startswith("127.")) and port in ports


async def refuses(api: str) -> bool:
    """Whether nobody listens at a slave API's address; ``False`` where that cannot be found out."""
    try:
        host, port, _ = split_uri(api)
        async with asyncio.timeout(limits.TCPROS_CONNECT_TIMEOUT):
            sock = await connect(host, port)
    except ConnectionRefusedError:
        return True
    except (OSError, UnreachableError):
        return False
    sock.close()
    return False
