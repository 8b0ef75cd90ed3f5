"""Judges the agents that run on this machine, by what they show of themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.core.open_files import remedy
from rmpa.observe.doctor.finding import Finding, FindingLevel
from rmpa.observe.doctor.machine import judge_peer_clock

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.observe.snapshot import AgentInfo, FilesInfo, PeerInfo, Snapshot, UnreachableInfo


def judge_agents(agents: Mapping[str, Snapshot | str], version: str) -> list[Finding]:
    """Whether agents run, are healthy, and have found others.

    Args:
        agents: What each shows, by its name; or why it does not answer.
        version: Of this program.
    """
    if not agents:
        text = "none runs here, so what only an agent knows was not looked at"
        return [Finding("agent", "", FindingLevel.SKIPPED, text, "start it with `rmpa up`, and ask again")]
    found = []
    for name, shown in agents.items():
        if isinstance(shown, str):
            found.append(Finding("agent", name, FindingLevel.FAIL, shown, "is it stopped? its log may tell"))
        else:
            found += _agent(shown, version)
    return found


def _agent(snapshot: Snapshot, version: str) -> list[Finding]:
    agent = snapshot.agent
    text = f"domain {agent.domain}, core {agent.core_uri}, mesh {agent.guid.partition('#')[0] or 'not joined'}"
    found = [Finding("agent", agent.name, FindingLevel.OK, text)]
    if agent.core_memory:
        found.append(Finding("core memory", agent.name, FindingLevel.OK, agent.core_memory))
    if agent.version != version:
        text = f"it is RMPA {agent.version}, this command is {version}"
        found.append(Finding("agent", agent.name, FindingLevel.WARN, text, "start it again with this version"))
    problem = agent.files.problem if agent.files is not None else ""
    found += [Finding("agent", agent.name, FindingLevel.WARN, note) for note in snapshot.notes if note != problem]
    found += [_unreachable(info) for info in snapshot.unreachable]
    if agent.files is not None:
        found.append(_files(agent, agent.files))
    text = f"{agent.proxies} nodes of peers, {agent.proxy_sockets} listening sockets: {agent.proxy_listening}"
    found.append(Finding("proxies", agent.name, FindingLevel.OK, text))
    if not snapshot.peers:
        where = ", ".join(agent.interfaces) or "no interface"
        text = f"knows no peer (domain {agent.domain}, looking on {where})"
        advice = (
            f"is `rmpa up` running elsewhere with --domain {agent.domain}? `rmpa multicast` tries the way by hand"
        )
        found.append(Finding("peer", agent.name, FindingLevel.WARN, text, advice))
    for peer in snapshot.peers:
        found += _peer(agent.name, peer)
    return found


def _unreachable(info: UnreachableInfo) -> Finding:
    what_to_do = (
        "if it is alive, start it with ROS_IP=127.0.0.1 and without ROS_HOSTNAME (nodes talk over loopback, the "
        "agent carries what is for others); if it is dead, `rosnode cleanup` removes it"
    )
    return Finding(
        "node", info.node, FindingLevel.FAIL if info.withdrawn else FindingLevel.WARN, str(info), what_to_do
    )


def _files(agent: AgentInfo, files: FilesInfo) -> Finding:
    kept = f"the last {files.reserved} are kept for the core and the links"
    text = f"{files.open} of {files.limit} file descriptors are open; {kept}"
    if files.problem:
        text, _, what_to_do = files.problem.partition("; ")
        return Finding("files", agent.name, FindingLevel.FAIL, f"{text}; {files.open} are open", what_to_do)
    if files.near:
        return Finding("files", agent.name, FindingLevel.WARN, text, remedy(agent.pid))
    return Finding("files", agent.name, FindingLevel.OK, text)


def _peer(agent: str, peer: PeerInfo) -> list[Finding]:
    subject = f"{agent}-{peer.name}"
    found = []
    for conflict in peer.conflicts:
        text, _, remedy = conflict.partition("; ")
        found.append(
            Finding("peer", subject, FindingLevel.FAIL, text, remedy or "give each module a --name of its own")
        )
    link = peer.link
    if link is None:
        text = f"{peer.state}: {peer.last_error or 'no TCP connection yet'}"
        level = FindingLevel.FAIL if peer.state == "refused" else FindingLevel.WARN
        advice = "see that TCP gets through on both machines: firewall, routes; or do what the text says"
        return [*found, Finding("peer", subject, level, text, advice)]
    way = "found by multicast" if peer.source == "multicast" else f"found by {peer.source or 'its link'}"
    found.append(Finding("peer", subject, FindingLevel.OK, f"linked by {link.remote}, {way}"))
    if link.path_problem:
        found.append(Finding("mtu", subject, FindingLevel.WARN, link.path_problem, link.path_remedy))
    if link.dropped:
        text = f"{link.dropped} messages were given up, for the link is slower than what it should carry"
        advice = "`rmpa peer info` shows of which topics; contracts.md tells what to do (max_rate, priority)"
        found.append(Finding("peer", subject, FindingLevel.WARN, text, advice))
    if link.clock_offset is not None:
        found.append(judge_peer_clock(agent, peer.name, link.clock_offset, link.clock_error))
    return found
