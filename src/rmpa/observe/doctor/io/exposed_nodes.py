"""Finds the TCP ports of a core's nodes that other machines reach."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from rmpa.bridge.proxies import proxied_peer
from rmpa.core.errors import RmpaError
from rmpa.observe import limits
from rmpa.observe.doctor.exposed_nodes import is_beyond_loopback
from rmpa.ros.http.rpc import call_api
from rmpa.runtime.tcp_connections import listening_sockets

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from rmpa.runtime.tcp_connections import ListeningSocket

_CALLER: Final = "/rmpa_doctor"
_AGENTS_OWN: Final = ("/rmpa", "/rosout")


def exposed_nodes(core_uri: str, agent_pid: int) -> dict[str, tuple[int, ...]] | None:
    """The TCP ports, beyond loopback, of each node of a core; those of the agent and its proxies are left out.

    A node is found by the port of its slave API; its other ports are those of the same process, where this user may
    see its descriptors.

    Returns:
        Ports by node; ``None`` where the core or the kernel does not tell.
    """
    sockets = listening_sockets()
    if sockets is None:
        return None
    try:
        nodes = asyncio.run(_slave_ports(core_uri))
    except (RmpaError, OSError, ValueError, TimeoutError):
        return None
    return exposed_ports(nodes, sockets, owners({each.inode for each in sockets}), agent_pid)


def exposed_ports(
    nodes: Mapping[str, int], sockets: Sequence[ListeningSocket], processes: Mapping[int, int], agent_pid: int
) -> dict[str, tuple[int, ...]]:
    """The ports beyond loopback of each node.

    Args:
        nodes: The port of each node's slave API.
        sockets: All sockets that listen.
        processes: The process of each socket, by its inode, where it is known.
        agent_pid: The agent's process, whose sockets are its own affair.
    """
    by_process, by_port = defaultdict(set), defaultdict(set)
    for each in sockets:
        by_port[each.port].add(each)
        if each.inode in processes:
            by_process[processes[each.inode]].add(each)
    found: dict[str, tuple[int, ...]] = {}
    for node, port in nodes.items():
        owners_of_it = {processes[each.inode] for each in by_port[port] if each.inode in processes}
        if agent_pid in owners_of_it:
            continue
        its = by_port[port].union(*(by_process[pid] for pid in owners_of_it))
        ports = {each.port for each in its if is_beyond_loopback(each.address)}
        if ports:
            found[node] = tuple(sorted(ports))
    return found


async def _slave_ports(core_uri: str) -> dict[str, int]:
    async with asyncio.timeout(limits.DOCTOR_NODES_TIMEOUT):
        state = (await call_api(core_uri, "getSystemState", _CALLER)).value
        kinds = state if isinstance(state, list) else []
        rows = [row for kind in kinds if isinstance(kind, list) for row in kind if isinstance(row, list)]
        names = {str(node) for row in rows if len(row) == 2 and isinstance(row[1], list) for node in row[1]}
        own = [name for name in names if proxied_peer(name) is None and name not in _AGENTS_OWN]
        found = {}
        for name in sorted(own)[: limits.DOCTOR_NODES_MAX]:
            uri = (await call_api(core_uri, "lookupNode", _CALLER, name)).value
            port = urlsplit(uri).port if isinstance(uri, str) else None
            if port:
                found[name] = port
        return found


def owners(inodes: set[int]) -> dict[int, int]:
    """The process of each socket that this user may see, by the socket's inode."""
    found = {}
    for process in Path("/proc").iterdir():
        if not process.name.isdecimal():
            continue
        try:
            for link in (process / "fd").iterdir():
                target = str(link.readlink())
                if target.startswith("socket:[") and (inode := int(target[8:-1])) in inodes:
                    found[inode] = int(process.name)
        except OSError:  # of another user, or ended meanwhile
            continue
    return found
