"""All checks of ``rmpa doctor``, and those of this machine's agents and of the nodes that the network can reach.

A check is a function of ``DoctorInput``, in a module of this folder: it reads something of this machine, and has a
pure ``judge_…`` function say what that means. ``CHECKS`` lists them; a new check is a row there.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from functools import partial
from ipaddress import ip_address
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import psutil

import rmpa
from rmpa.core.errors import RmpaError
from rmpa.core.identity import proxied_peer
from rmpa.observe import limits
from rmpa.observe.check import FAIL, OK, SKIPPED, WARN, Check
from rmpa.observe.doctor import machine, network, repairs
from rmpa.observe.why.diagnosis import judge_peer_clock, misplaced, remedy_for, subscriber_text
from rmpa.ros.http.rpc import call
from rmpa.ros.master.mirror import lookup_calls, read_lookups
from rmpa.runtime.accept import open_files_advice
from rmpa.runtime.plugins import DOCTOR_CHECKS, find_plugins, load_plugin, plugin_error

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from rmpa.core.facts import UnreachableInfo
    from rmpa.observe.doctor.machine import DoctorInput
    from rmpa.observe.snapshot import AgentInfo, PeerInfo, Snapshot
    from rmpa.trust.permissions import TrustStatus

# The counters of what ``[[permission]]`` refused begin so.
_PERMISSION: Final = "permission."


def judge_agents(agents: Mapping[str, Snapshot | str], version: str) -> Iterator[Check]:
    """Whether agents run, are healthy, and have found peers.

    Args:
        agents: The snapshot of each by its name, or why it does not answer.
        version: The version of this program.
    """
    if not agents:
        text = "none runs here, so what only an agent knows was not looked at"
        yield Check("agent", SKIPPED, text, "start it with `rmpa up`, and ask again")
    for name, shown in agents.items():
        if isinstance(shown, str):
            yield Check("agent", FAIL, shown, "is it stopped? see its log", where=name)
        else:
            yield from _agent(shown, version)


def _agent(snapshot: Snapshot, version: str) -> Iterator[Check]:
    agent, trust = snapshot.agent, snapshot.trust
    check = partial(Check, where=agent.name)
    mesh = agent.guid.partition("#")[0] or "not joined"
    yield check("agent", OK, f"domain {agent.domain}, core {agent.core_uri}, mesh {mesh}")
    if agent.core_memory:
        yield check("core memory", OK, agent.core_memory)
    if agent.version != version:
        text = f"it is RMPA {agent.version}, this command is {version}"
        yield check("agent", WARN, text, "start it again with this version")
    # What checks of their own show is left out.
    shown = {agent.files.problem if agent.files is not None else "", *(trust.problems if trust is not None else ())}
    yield from (check("agent", WARN, note) for note in snapshot.notes if note not in shown)
    counters = snapshot.counters.items()
    refused = [f"{count} {n.removeprefix(_PERMISSION)}" for n, count in counters if n.startswith(_PERMISSION)]
    if refused:
        yield check("permissions", OK, f"refused so far: {', '.join(refused)}; its log names the rules")
    yield from map(_unreachable, snapshot.unreachable)
    yield from _files(agent)
    text = f"{agent.proxies} nodes of peers, {agent.proxy_sockets} listening sockets: {agent.proxy_listening}"
    yield check("proxies", OK, text)
    for stranger in snapshot.strangers[: limits.DOCTOR_PEERS_LISTED]:
        yield Check.from_message("peer", WARN, stranger.last_error, where=f"{agent.name}-{stranger.name}")
    if (left := len(snapshot.strangers) - limits.DOCTOR_PEERS_LISTED) > 0:
        yield check("peer", WARN, f"and {left} more modules that are not of this mesh", "rmpa peer list names them")
    if not snapshot.peers and not snapshot.strangers:
        text = f"knows no peer (domain {agent.domain}, looking on {', '.join(agent.interfaces) or 'no interface'})"
        remedy = (
            f"is `rmpa up` running elsewhere with --domain {agent.domain}? `rmpa doctor --listen 30` tries the way"
        )
        yield check("peer", WARN, text, remedy)
    if trust is not None:
        yield judge_membership(trust, snapshot.taken)
    yield from _peers(agent.name, snapshot.peers)
    # Subscribers that are relayed although a contract says "direct", or are direct although they must not be.
    for topic in snapshot.topics:
        for route in topic.routes:
            for one in misplaced(route):
                text = f"of {route.peer}: {subscriber_text(one)}"
                yield Check("transport", WARN, text, remedy_for(one), where=topic.name)


def judge_membership(trust: TrustStatus, wall: float) -> Check:
    """How a module's part in its secured mesh is.

    Args:
        trust: Its state.
        wall: Seconds since 1970.
    """
    if trust.problems:
        text, _, remedy = trust.problems[0].partition("; ")
        ended = trust.clock_set and wall >= trust.expires
        return Check("trust", FAIL if ended else WARN, text, remedy or "rmpa trust status", where=trust.module)
    left = (trust.expires - wall) / 3600
    text = f"its certificate is valid for {left:.0f} h more; group key {trust.key}, deny list {trust.deny_number}"
    return Check("trust", OK, text, where=trust.module)


def _unreachable(info: UnreachableInfo) -> Check:
    remedy = (
        "if it is alive, start it with ROS_IP=127.0.0.1 and without ROS_HOSTNAME (nodes talk over loopback, the "
        "agent carries what is for others); if it is dead, `rosnode cleanup` removes it"
    )
    return Check("node", FAIL if info.withdrawn else WARN, str(info), remedy, where=info.node)


def _files(agent: AgentInfo) -> Iterator[Check]:
    if (files := agent.files) is None:
        return
    text, level, remedy = f"{files.open} of {files.limit} file descriptors are open; ", OK, ""
    text += f"the last {files.reserved} are kept for the core and the links"
    if files.problem:
        problem, _, remedy = files.problem.partition("; ")
        text, level = f"{problem}; {files.open} are open", FAIL
    elif files.near:
        level, remedy = WARN, open_files_advice(agent.pid)
    yield Check("files", level, text, remedy, where=agent.name)


def _peers(agent: str, peers: Sequence[PeerInfo]) -> Iterator[Check]:
    """All results about a few peers; of many peers the problems, and how many have none."""
    well = Counter[str]()
    for peer in peers:
        checks = [*_peer(agent, peer)]
        bad = [check for check in checks if check.level is not OK]
        yield from checks if len(peers) <= limits.DOCTOR_PEERS_LISTED else bad
        well[peer.state] += not bad
    if len(peers) > limits.DOCTOR_PEERS_LISTED and well.total():
        states = ", ".join(f"{count:,} {state}" for state, count in well.most_common() if count)
        yield Check("peer", OK, f"{well.total():,} of {len(peers):,} have no problem: {states}", where=agent)


def _peer(agent: str, peer: PeerInfo) -> Iterator[Check]:
    link, check = peer.link, partial(Check, "peer", where=f"{agent}-{peer.name}")
    for conflict in peer.conflicts:
        level = FAIL if peer.state == "conflict" else WARN
        remedy = "give each module a --name of its own"
        yield Check.from_message("peer", level, conflict, remedy, f"{agent}-{peer.name}")
    if peer.state == "relayed":
        yield check(OK, "relayed: another peer passes on its topics")
    elif link is None:
        text = f"{peer.state}: {peer.last_error or 'no TCP connection yet'}"
        remedy = "do what the text says"
        if peer.state != "refused":  # else TCP got through
            remedy = f"see that TCP gets through on both machines: firewall, routes; or {remedy}"
        yield check(FAIL if peer.state == "refused" else WARN, text, remedy)
    else:
        rest = ", at rest" if link.rests else ""
        yield check(OK, f"linked by {link.remote}{rest}, found by {peer.source or 'its link'}")
        if link.dropped:
            text = f"{link.dropped} messages were dropped, because the link is slower than its topics"
            remedy = "`rmpa peer info` shows of which topics; docs/guides/contracts.md: max_rate, priority"
            yield check(WARN, text, remedy)
        if link.clock_offset is not None:
            yield judge_peer_clock(agent, peer.name, link.clock_offset, link.clock_error)


_LISTED: Final = 5
_AGENTS_OWN: Final = ("/rmpa", "/rosout")
_WEB: Final = "/rmpa_web"


def _exposed_nodes(given: DoctorInput) -> Iterable[Check]:
    for name, shown in given.snapshots.items():
        trusted = shown.trust is not None
        found = exposed_nodes(shown.agent.core_uri, shown.agent.pid) if trusted else None
        yield judge_exposed_nodes(name, found, trusted=trusted, direct=given.settings.allows_direct)
    if not given.snapshots:
        yield Check("exposed nodes", SKIPPED, "no agent runs")


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
    check = partial(Check, "exposed nodes", where=agent)
    if not trusted:
        return check(SKIPPED, "trust is off: the mesh is open too (rmpa trust init)")
    if exposed is None:
        return check(SKIPPED, "the nodes' ports cannot be read from the core or the kernel")
    if not exposed:
        return check(OK, "every node listens on loopback alone")
    listed = [f"{node} ({', '.join(map(str, ports))})" for node, ports in sorted(exposed.items())]
    more = f" and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
    remedy = (
        "start them with ROS_IP=127.0.0.1 (roscpp's XML-RPC port stays open), and let a firewall drop what comes "
        "from outside to them (docs/reference/security.md)"
    )
    remedy += "; direct transport needs them open, and crosses the network unprotected" if direct else ""
    return check(WARN, f"other machines reach {', '.join(listed[:_LISTED])}{more} without any check", remedy)


def is_beyond_loopback(address: str) -> bool:
    """Whether a socket that listens at an address is reached from other machines."""
    try:
        return not ip_address(address).is_loopback
    except ValueError:
        return True


def exposed_nodes(core_uri: str, agent_pid: int) -> dict[str, tuple[int, ...]] | None:
    """The TCP ports, beyond loopback, of each node of a core; those of the agent and its proxies are left out.

    A node is found by the port of its slave API; its other ports are those of the same process, where this user may
    see its descriptors.

    Returns:
        Ports by node; ``None`` where the core or the kernel does not tell.
    """
    try:
        nodes = asyncio.run(_slave_ports(core_uri))
        sockets = [
            (at.laddr.ip, at.laddr.port, at.pid)
            for at in psutil.net_connections("tcp")
            if at.laddr and at.status == psutil.CONN_LISTEN
        ]
    except (RmpaError, OSError, ValueError, psutil.Error):
        return None
    found = {}
    for node, port in nodes.items():
        processes = {pid for _, at, pid in sockets if at == port and pid is not None}
        if node.startswith(_WEB):  # its other ports are those of HTTP, which ask for the token
            processes &= {agent_pid}
        its = [(address, at) for address, at, pid in sockets if at == port or pid in processes]
        ports = {at for address, at in its if is_beyond_loopback(address)}
        if ports and agent_pid not in processes:
            found[node] = tuple(sorted(ports))
    return found


async def _slave_ports(core_uri: str) -> dict[str, int]:
    async with asyncio.timeout(limits.DOCTOR_NODES_TIMEOUT):
        names = (await machine.survey(core_uri)).nodes()
        own = sorted(name for name in names if proxied_peer(name) is None and name not in _AGENTS_OWN)
        own = own[: limits.DOCTOR_NODES_MAX]
        answer = await call(core_uri, "system.multicall", lookup_calls(machine.CALLER, own, ()))
        ports = {name: urlsplit(uri).port for name, uri in read_lookups(answer, own, ())[0].items()}
        return {name: port for name, port in ports.items() if port}


# All checks, in the order of the output; at least one result of each has its name. Each takes 2 s at most.
CHECKS: Final[dict[str, Callable[[DoctorInput], Iterable[Check]]]] = {
    "settings": lambda given: given.settings_checks,
    "agent": lambda given: judge_agents(given.agents, rmpa.__version__),
    "interface": network.interfaces,
    "multicast": network.multicast,
    "firewall": network.firewall,
    "rp_filter": network.rp_filter,
    "radio": network.radio,
    "route": network.routes,
    "port": network.ports,
    "ROS": machine.shell,
    "clock": machine.clocks,
    "realtime": machine.rights,
    "boot": lambda _: [machine.judge_unit(machine.read_unit())],
    "directory": repairs.directories,
    "exposed nodes": _exposed_nodes,
}


def examine(given: DoctorInput) -> Iterator[Check]:
    """Run all checks, then those of other packages; each result comes as soon as it is there, the whole in 2 s."""
    for check in CHECKS.values():
        yield from check(given)
    for name, entry in find_plugins(DOCTOR_CHECKS).items():
        try:
            for found in load_plugin(entry)(given):
                if not isinstance(found, Check):
                    raise plugin_error(entry, TypeError(f"{found!r} is no Check"))  # noqa: TRY301
                yield found
        except RmpaError as error:
            yield Check(name, WARN, str(error), code=error.code)
        except Exception as error:  # noqa: BLE001 - another's code
            yield Check(name, WARN, str(plugin_error(entry, error)), code="plugin-broken")
