"""Judges this machine's agents, and which ports of nodes the network can reach.

Judges the agents of this machine by their snapshots.
"""

from __future__ import annotations

import asyncio
from collections import Counter, defaultdict
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from rmpa.core.counters import remedy
from rmpa.core.errors import RmpaError
from rmpa.core.identity import proxied_peer
from rmpa.observe import limits
from rmpa.observe.doctor.machine import judge_peer_clock
from rmpa.observe.peer_info import FAIL, OK, SKIPPED, WARN, Check
from rmpa.observe.why.diagnosis import misplaced, subscriber_text
from rmpa.observe.why.diagnosis import remedy as remedy_for
from rmpa.ros.http.rpc import call_api
from rmpa.runtime.kernel_tcp import listening_sockets

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from rmpa.observe.peer_info import PeerInfo
    from rmpa.observe.snapshot import AgentInfo, FilesInfo, Snapshot, UnreachableInfo
    from rmpa.runtime.kernel_tcp import TcpSocket
    from rmpa.trust.permissions import TrustStatus

_PERMISSION: Final = "permission."
"""The counters of what ``[[permission]]`` refused begin so."""
_WITHOUT_LINK: Final = {
    "relayed": "another peer passes on its topics",
}
"""States in which a peer has no link, and needs none."""


def judge_agents(agents: Mapping[str, Snapshot | str], version: str) -> list[Check]:
    """Whether agents run, are healthy, and have found peers.

    Args:
        agents: The snapshot of each by its name, or why it does not answer.
        version: The version of this program.
    """
    if not agents:
        text = "none runs here, so what only an agent knows was not looked at"
        return [Check("agent", SKIPPED, text, "start it with `rmpa up`, and ask again")]
    found: list[Check] = []
    for name, shown in agents.items():
        if isinstance(shown, str):
            found.append(Check("agent", FAIL, shown, "is it stopped? its log may tell", where=name))
        else:
            found += _agent(shown, version)
    return found


def _agent(snapshot: Snapshot, version: str) -> Iterator[Check]:
    agent = snapshot.agent
    here = agent.name
    text = f"domain {agent.domain}, core {agent.core_uri}, mesh {agent.guid.partition('#')[0] or 'not joined'}"
    yield Check("agent", OK, text, where=here)
    if agent.core_memory:
        yield Check("core memory", OK, agent.core_memory, where=here)
    if agent.version != version:
        text = f"it is RMPA {agent.version}, this command is {version}"
        yield Check("agent", WARN, text, "start it again with this version", where=here)
    shortage = agent.files.problem if agent.files is not None else ""
    shown = {shortage, *(snapshot.trust.problems if snapshot.trust is not None else ())}  # by checks of their own
    yield from (Check("agent", WARN, note, where=here) for note in snapshot.notes if note not in shown)
    refused = [(n.removeprefix(_PERMISSION), c) for n, c in snapshot.counters.items() if n.startswith(_PERMISSION)]
    if refused:
        text = (
            f"refused so far: {', '.join(f'{count} {access}' for access, count in refused)}; its log names the rules"
        )
        yield Check("permissions", OK, text, where=here)
    yield from map(_unreachable, snapshot.unreachable)
    if agent.files is not None:
        yield _files(agent, agent.files)
    text = f"{agent.proxies} nodes of peers, {agent.proxy_sockets} listening sockets: {agent.proxy_listening}"
    yield Check("proxies", OK, text, where=here)
    for stranger in snapshot.strangers[: limits.DOCTOR_PEERS_LISTED]:
        yield Check.from_message("peer", WARN, stranger.last_error, where=f"{here}-{stranger.name}")
    if not snapshot.peers and not snapshot.strangers:
        text = f"knows no peer (domain {agent.domain}, looking on {', '.join(agent.interfaces) or 'no interface'})"
        advice = (
            f"is `rmpa up` running elsewhere with --domain {agent.domain}? `rmpa doctor --listen 30` tries the way"
        )
        yield Check("peer", WARN, text, advice, where=here)
    if snapshot.trust is not None:
        yield judge_membership(snapshot.trust, snapshot.taken)
    yield from _peers(here, snapshot.peers)
    yield from _transport(snapshot)


def judge_membership(trust: TrustStatus, wall: float) -> Check:
    """How a module's part in its secured mesh is.

    Args:
        trust: Its state.
        wall: Seconds since 1970.
    """
    if trust.problems:
        text, _, what_to_do = trust.problems[0].partition("; ")
        ended = trust.clock_set and wall >= trust.expires
        return Check("trust", FAIL if ended else WARN, text, what_to_do or "rmpa trust status", where=trust.module)
    left = (trust.expires - wall) / 3600
    text = f"its certificate is valid for {left:.0f} h more; group key {trust.key}, deny list {trust.deny_number}"
    return Check("trust", OK, text, where=trust.module)


def _transport(snapshot: Snapshot) -> Iterator[Check]:
    """Subscribers that are relayed although a contract says "direct", or are direct although they must not be."""
    for topic in snapshot.topics:
        for route in topic.routes:
            for one in misplaced(route):
                text = f"of {route.peer}: {subscriber_text(one)}"
                yield Check("transport", WARN, text, remedy_for(one), where=topic.name)


def _unreachable(info: UnreachableInfo) -> Check:
    what_to_do = (
        "if it is alive, start it with ROS_IP=127.0.0.1 and without ROS_HOSTNAME (nodes talk over loopback, the "
        "agent carries what is for others); if it is dead, `rosnode cleanup` removes it"
    )
    return Check("node", FAIL if info.withdrawn else WARN, str(info), what_to_do, where=info.node)


def _files(agent: AgentInfo, files: FilesInfo) -> Check:
    kept = f"the last {files.reserved} are kept for the core and the links"
    text = f"{files.open} of {files.limit} file descriptors are open; {kept}"
    if files.problem:
        text, _, what_to_do = files.problem.partition("; ")
        return Check("files", FAIL, f"{text}; {files.open} are open", what_to_do, where=agent.name)
    if files.near:
        return Check("files", WARN, text, remedy(agent.pid), where=agent.name)
    return Check("files", OK, text, where=agent.name)


def _peers(agent: str, peers: Sequence[PeerInfo]) -> Iterator[Check]:
    """All results about a few peers; of many peers the problems, and how many have none."""
    found = [(peer, [*_peer(agent, peer)]) for peer in peers]
    if len(peers) <= limits.DOCTOR_PEERS_LISTED:
        yield from (check for _, checks in found for check in checks)
        return
    yield from (check for _, checks in found for check in checks if check.level is not OK)
    well = Counter(peer.state for peer, checks in found if all(check.level is OK for check in checks))
    states = ", ".join(f"{count:,} {state}" for state, count in well.most_common())
    if well:
        yield Check("peer", OK, f"{well.total():,} of {len(peers):,} have no problem: {states}", where=agent)


def _peer(agent: str, peer: PeerInfo) -> Iterator[Check]:
    both = f"{agent}-{peer.name}"
    for conflict in peer.conflicts:
        level = FAIL if peer.state == "conflict" else WARN
        yield Check.from_message("peer", level, conflict, "give each module a --name of its own", both)
    link = peer.link
    if peer.state in _WITHOUT_LINK:
        yield Check("peer", OK, f"{peer.state}: {_WITHOUT_LINK[peer.state]}", where=both)
        return
    if link is None:
        level = FAIL if peer.state == "refused" else WARN
        text = f"{peer.state}: {peer.last_error or 'no TCP connection yet'}"
        advice = "see that TCP gets through on both machines: firewall, routes; or do what the text says"
        yield Check("peer", level, text, advice, where=both)
        return
    way = "found by multicast" if peer.source == "multicast" else f"found by {peer.source or 'its link'}"
    rest = ", at rest" if link.rests else ""
    yield Check("peer", OK, f"linked by {link.remote}{rest}, {way}", where=both)
    if link.dropped:
        text = f"{link.dropped} messages were given up, for the link is slower than what it should carry"
        advice = "`rmpa peer info` shows of which topics; contracts.md tells what to do (max_rate, priority)"
        yield Check("peer", WARN, text, advice, where=both)
    if link.clock_offset is not None:
        yield judge_peer_clock(agent, peer.name, link.clock_offset, link.clock_error)


# Judges which nodes of a secured module listen beyond this machine: what ROS 1 leaves open (docs/security.md).


_NAME: Final = "exposed nodes"
_LISTED: Final = 5
_REMEDY: Final = (
    "start them with ROS_IP=127.0.0.1 (roscpp's XML-RPC port stays open), and let a firewall drop what comes from "
    "outside to them (docs/security.md)"
)
_DIRECT: Final = "; direct transport needs them open, and crosses the network unprotected"


def judge_exposed_nodes(
    agent: str, exposed: Mapping[str, tuple[int, ...]] | None, *, trusted: bool, direct: bool = False
) -> Check:
    """Whether other machines reach the nodes of one agent's core past the agent.

    Args:
        agent: The agent's name.
        exposed: The TCP ports, beyond loopback, of each node that has some; ``None``: they cannot be read.
        trusted: Whether the module is in a secured mesh; else nothing is protected, and no ports are listed.
        direct: Whether the settings allow direct transport.
    """
    if not trusted:
        return Check(_NAME, SKIPPED, "trust is off: the mesh is open too (rmpa trust init)", where=agent)
    if exposed is None:
        return Check(_NAME, SKIPPED, "the core or the kernel does not tell the nodes' ports", where=agent)
    if not exposed:
        return Check(_NAME, OK, "every node listens on loopback alone", where=agent)
    listed = [f"{node} ({', '.join(map(str, ports))})" for node, ports in sorted(exposed.items())]
    more = f" and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
    text = f"other machines reach {', '.join(listed[:_LISTED])}{more} without any check"
    return Check(_NAME, WARN, text, _REMEDY + (_DIRECT if direct else ""), where=agent)


def is_beyond_loopback(address: str) -> bool:
    """Whether a socket that listens at an address is reached from other machines."""
    try:
        return not ip_address(address).is_loopback
    except ValueError:
        return True


# Finds the TCP ports of a core's nodes that other machines reach.


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
    nodes: Mapping[str, int], sockets: Sequence[TcpSocket], processes: Mapping[int, int], agent_pid: int
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
        by_port[each.local[1]].add(each)
        if each.inode in processes:
            by_process[processes[each.inode]].add(each)
    found: dict[str, tuple[int, ...]] = {}
    for node, port in nodes.items():
        owners_of_it = {processes[each.inode] for each in by_port[port] if each.inode in processes}
        if agent_pid in owners_of_it:
            continue
        its = by_port[port].union(*(by_process[pid] for pid in owners_of_it))
        ports = {each.local[1] for each in its if is_beyond_loopback(each.local[0])}
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
