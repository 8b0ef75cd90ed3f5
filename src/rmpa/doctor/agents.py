"""Judges the agents that run on this machine, by what they show of themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.doctor.finding import Finding, Level
from rmpa.doctor.machine import judge_peer_clock

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.monitor.snapshot import PeerInfo, Snapshot


def judge_agents(agents: Mapping[str, Snapshot | str], version: str) -> list[Finding]:
    """Whether agents run, are healthy, and have found others.

    Args:
        agents: What each shows, by its name; or why it does not answer.
        version: Of this program.
    """
    if not agents:
        text = "none runs here, so what only an agent knows was not looked at"
        return [Finding("agent", "", Level.SKIPPED, text, "start it with `rmpa up`, and ask again")]
    found = []
    for name, shown in agents.items():
        if isinstance(shown, str):
            found.append(Finding("agent", name, Level.FAIL, shown, "is it stopped? its log may tell"))
        else:
            found += _agent(shown, version)
    return found


def _agent(snapshot: Snapshot, version: str) -> list[Finding]:
    agent = snapshot.agent
    text = f"domain {agent.domain}, core {agent.core_uri}, mesh {agent.guid.partition('#')[0] or 'not joined'}"
    found = [Finding("agent", agent.name, Level.OK, text)]
    if agent.version != version:
        text = f"it is RMPA {agent.version}, this command is {version}"
        found.append(Finding("agent", agent.name, Level.WARN, text, "start it again with this version"))
    found += [Finding("agent", agent.name, Level.WARN, note) for note in snapshot.notes]
    if not snapshot.peers:
        where = ", ".join(agent.interfaces) or "no interface"
        text = f"knows no peer (domain {agent.domain}, looking on {where})"
        remedy = (
            f"is `rmpa up` running elsewhere with --domain {agent.domain}? `rmpa multicast` tries the way by hand"
        )
        found.append(Finding("peer", agent.name, Level.WARN, text, remedy))
    for peer in snapshot.peers:
        found += _peer(agent.name, peer)
    return found


def _peer(agent: str, peer: PeerInfo) -> list[Finding]:
    subject = f"{agent}-{peer.name}"
    found = [
        Finding("peer", subject, Level.FAIL, conflict, "give each module a --name of its own")
        for conflict in peer.conflicts
    ]
    link = peer.link
    if link is None:
        text = f"{peer.state}: {peer.last_error or 'no TCP connection yet'}"
        level = Level.FAIL if peer.state == "refused" else Level.WARN
        remedy = "see that TCP gets through on both machines: firewall, routes; or do what the text says"
        return [*found, Finding("peer", subject, level, text, remedy)]
    way = "found by multicast" if peer.source == "multicast" else f"found by {peer.source or 'its link'}"
    found.append(Finding("peer", subject, Level.OK, f"linked by {link.remote}, {way}"))
    if link.dropped:
        text = f"{link.dropped} messages were given up, for the link is slower than what it should carry"
        remedy = "`rmpa peer info` shows of which topics; contracts.md tells what to do (max_rate, priority)"
        found.append(Finding("peer", subject, Level.WARN, text, remedy))
    if link.clock_offset is not None:
        found.append(judge_peer_clock(agent, peer.name, link.clock_offset, link.clock_error))
    return found
