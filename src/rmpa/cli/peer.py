"""``rmpa peer list|info|ping``: the peers that this machine's agent knows."""

from __future__ import annotations

import contextlib
import os
import time
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.options import LINES, FiniteRange, Selection, agent_option, completes, json_option, summary
from rmpa.cli.output import Column, duration, find_peer, print_json, print_line, print_table, size, warn
from rmpa.cli.topic import shown_state
from rmpa.core.counters import SampleSummary
from rmpa.core.errors import PeerRefused
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.observe.peer_info import FOREIGN
from rmpa.observe.snapshot import PingReply

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.observe.peer_info import LaneInfo, LinkInfo, PeerInfo
    from rmpa.observe.snapshot import RouteInfo, Snapshot, TopicInfo

_COLOURS: Final = {
    "linked": "green",
    "relayed": "green",
    "linking": "yellow",
    "refused": "red",
    "conflict": "red",
    "foreign": "yellow",
}
_USUAL: Final = frozenset({"linked", "relayed"})
"""States that are no problem."""
_COLUMNS: Final = tuple(
    Column(title, right=title not in ("PEER", "STATE", "ADDRESS", "DIALLED"))
    for title in ("PEER", "STATE", "SINCE", "ADDRESS", "RTT", "DIALLED", "CLOCK", "IN", "OUT", "QUEUE", "DROPS")
)
_BRIEF: Final = 5
"""Columns that are shown without ``-v``: they fit 80 characters."""
_ROUTES: Final = (
    *map(Column, ("  TOPIC", "TYPE", "NODE", "ROUTE")),
    *(Column(title, right=True) for title in ("MESSAGES", "RATE", "LATENCY", "P99", "LOST")),
)


def connect(agent: str | None) -> ControlClient:
    """A connection to the agent of that name, or to the only one of this machine."""
    return ControlClient(choose_agent(os.environ, agent).path)


@click.command(
    "list",
    epilog="""\
\b
Examples:
  rmpa peer list
  rmpa peer list -v
  rmpa peer list 'arm*' --state linked --state refused
  rmpa peer list --json | jq '.[].name'
""",
)
@click.argument("pattern", default="", shell_complete=completes("peer"))
@click.option("-v", "--verbose", is_flag=True, help="With the side that dialled, clock, traffic, queue and drops.")
@click.option("--state", "states", multiple=True, help="Only peers in this state; may be given again.")
@click.option("--limit", type=click.IntRange(1), help=f"At most so many. [default: {LINES} on a terminal]")
@click.option("--all", "everything", is_flag=True, help="Leave nothing out on a terminal.")
@json_option
@agent_option
def list_(
    pattern: str,
    verbose: bool,
    states: tuple[str, ...],
    limit: int | None,
    everything: bool,
    as_json: bool,
    agent: str | None,
) -> None:
    """List the peers, all or those with names like PATTERN, and how their links are.

    A link is "at rest" while nothing depends on it: its silence is then noticed after 16 s in place of 1 s, with more
    than 50 peers later.

    CLOCK is the peer's wall clock less ours, with the bound of its error. Of very many peers a terminal shows a
    summary and the first ones: those with a problem, then those with most traffic.
    """
    with connect(agent) as client:
        snapshot = client.snapshot(topics=())
    selection = Selection(pattern, limit=limit, everything=everything)
    known = (*snapshot.peers, *snapshot.strangers)
    fitting = set(selection.names(peer.name for peer in known))
    peers = [p for p in known if p.name in fitting and (not states or p.state in states)]
    if as_json:
        print_json(peers)
        return
    if not known:
        where = ", ".join(snapshot.agent.interfaces) or "no interface"
        click.echo(f"{snapshot.agent.name} knows no peers yet (domain {snapshot.agent.domain}, looking on {where})")
    elif not peers:
        click.echo(summary(len(known), "peers", (p.state for p in known)) + "; none of them fits")
    else:
        if selection.is_long(peers):
            peers.sort(key=_urgency)
            click.echo(summary(len(peers), "peers", (p.state for p in peers)) + "\n")
        shown = selection.shown(peers)
        width = len(_COLUMNS) if verbose else _BRIEF
        colours = [_COLOURS.get(p.state, "") for p in shown]
        print_table(_COLUMNS[:width], [_row(p)[:width] for p in shown], colours=colours)
        selection.print_rest(peers, "peers", "rmpa peer list 'arm*', --state linked")
    troubles = _troubles(snapshot, peers)
    told = selection.shown(troubles)
    for trouble in told:
        warn(trouble)
    if len(told) < len(troubles):
        warn(f"... {len(troubles) - len(told):,} more of this kind; all: rmpa peer list --all")


def _urgency(info: PeerInfo) -> tuple[int, int, str]:
    """The order of a list that is not shown whole: problems first, then by traffic."""
    link = info.link
    problem = info.conflicts or info.beyond
    usual = info.state in _USUAL and not problem
    return int(usual), 0 if link is None else -(link.bytes_in + link.bytes_out), info.name


def _row(info: PeerInfo) -> list[str]:
    link = info.link
    if info.via:
        return [info.name, info.state, "-", f"via {info.via}", *"-------"]
    if link is None:
        return [info.name, info.state, duration(info.since_ago), info.guid.partition("#")[0], *"-------"]
    clock = "-" if link.clock_offset is None else f"{duration(link.clock_offset)} ±{duration(link.clock_error)}"
    return [
        info.name,
        f"{info.state}, at rest" if link.rests else info.state,
        duration(info.since_ago),
        link.remote,
        duration(link.rtt),
        "by us" if link.dialled else "by it",
        clock,
        size(link.bytes_in),
        size(link.bytes_out),
        size(link.queued),
        str(link.dropped),
    ]


def _troubles(snapshot: Snapshot, peers: Sequence[PeerInfo]) -> list[str]:
    found = list(snapshot.notes)
    for info in peers:
        found += [f"{info.name}: {conflict}" for conflict in info.conflicts]
        found += [bound.text for bound in info.beyond]
        if info.last_error and info.state not in _USUAL:
            again = "" if info.next_attempt is None else f"; next attempt in {duration(info.next_attempt)}"
            found.append(f"{info.name}: {info.last_error}{again}")
    return found


@click.command(epilog="\b\nExamples:\n  rmpa peer info base\n")
@click.argument("name", shell_complete=completes("peer"))
@json_option
@agent_option
def info(name: str, as_json: bool, agent: str | None) -> None:
    """Show all that is known of the peer NAME (or of one by its GUID).

    Clock is its wall clock less ours, with the bound of what is known of it. Of each topic that comes from it: how
    often it came in the last minute, and the median and 99th percentile of its one-way latency, true within ±.
    """
    with connect(agent) as client:
        snapshot = client.snapshot()
    found = find_peer(snapshot, name)
    if as_json:
        print_json(found)
        return
    for label, text in _facts(found):
        print_line(f"{label + ':':<13} {text}")
    for direction, title in (("in", "it publishes"), ("out", "we publish to it")):
        routes = [
            (t, r) for t in snapshot.topics for r in t.routes if r.peer == found.name and r.direction == direction
        ]
        if routes:
            click.echo(f"\nTopics that {title}:")
            columns = _ROUTES if direction == "in" else _ROUTES[:5]
            print_table(columns, [_route_row(t, r)[: len(columns)] for t, r in routes])


def _route_row(topic: TopicInfo, route: RouteInfo) -> list[str]:
    latency = route.latency
    return [
        *(f"  {topic.name}", route.type or topic.type or "-", route.node, shown_state(route)),
        str(route.messages),
        "-" if route.rate is None else f"{route.rate:.1f} Hz",
        "-" if latency is None else f"{duration(latency.p50)} ±{duration(latency.error)}",
        "-" if latency is None else duration(latency.p99),
        str(route.lost + route.late + route.expired),
    ]


def _lane_state(lane: LaneInfo) -> str:
    if lane.connected:
        return "connected"
    return "connected when a message wants it" if lane.unneeded else "no connection"


def _pace_text(link: LinkInfo) -> str:
    if link.rests:
        return f"at rest: nothing depends on the link, and its silence is noticed after {link.lease:.0f} s"
    return "in use: its silence is noticed within 1 s"


def _facts(info: PeerInfo) -> list[tuple[str, str]]:
    if info.via:
        topics = f"{info.topics_in} topics that it publishes"
        return [("Peer", info.name), ("GUID", info.guid), ("State", f"relayed: {info.via} passes on {topics}")]
    strange = info.state == FOREIGN
    facts = [
        ("Peer", info.name),
        ("GUID", info.guid),
        ("State", f"{info.state} for {duration(info.since_ago)}"),
        ("Addresses", ", ".join(info.addresses) or "-"),
        ("Found", f"{duration(info.found_ago)} ago by {info.source or ('a beacon' if strange else 'a link')}"),
        ("Last beacon", f"{duration(info.beacon_ago)} ago" if info.beacon_ago is not None else "-"),
    ]
    link = info.link
    if link is not None:
        who = "dialled by us" if link.dialled else "dialled by it"
        clock = "-" if link.clock_offset is None else f"{duration(link.clock_offset)} ± {duration(link.clock_error)}"
        facts += [
            ("Link", f"{link.remote}, {who}, up for {duration(link.up_ago)}, heard {duration(link.heard_ago)} ago"),
            ("Pace", _pace_text(link)),
            *(("Lane", f"{lane.name}: {_lane_state(lane)}") for lane in link.lanes),
            ("Round trip", duration(link.rtt)),
            ("Clock", f"{clock} (its clock less ours)"),
            ("Traffic", f"{size(link.bytes_in)} in, {size(link.bytes_out)} out, {size(link.queued)} queued"),
            ("Drops", f"{link.dropped} messages"),
        ]
        if info.direct_in or info.direct_out:
            ours = f"{info.direct_in} of the subscribers here to its nodes"
            facts.append(("Direct", f"{ours}, {info.direct_out} of its subscribers to nodes here"))
    if info.last_error:
        facts.append(("Last error", info.last_error))
    if info.next_attempt is not None:
        facts.append(("Next attempt", f"in {duration(info.next_attempt)}"))
    facts += [("Limit", bound.text) for bound in info.beyond]
    return facts + [("Conflict", conflict) for conflict in info.conflicts]


@click.command(epilog="\b\nExamples:\n  rmpa peer ping base\n  rmpa peer ping base -c 10 -i 0.1\n")
@click.argument("name", shell_complete=completes("peer"))
@click.option("-c", "--count", type=click.IntRange(1), help="Stop after so many. [default: at Ctrl-C]")
@click.option("-i", "--interval", type=FiniteRange(0.01), default=1.0, show_default=True, help="Seconds between.")
@json_option
@agent_option
def ping(name: str, count: int | None, interval: float, as_json: bool, agent: str | None) -> int:
    """Measure the round trip to the peer NAME over the mesh.

    Exits 1 if no answer came.
    """
    times: list[float] = []
    sent = 0
    with connect(agent) as client:
        found = find_peer(client.snapshot(topics=()), name)
        with contextlib.suppress(KeyboardInterrupt):
            while count is None or sent < count:
                if sent:
                    time.sleep(interval)
                sent += 1
                _ping_once(client, found, sent, times, as_json=as_json)
    _ping_summary(found.name, sent, times, as_json=as_json)
    return 0 if times else 1


def _ping_once(client: ControlClient, peer: PeerInfo, number: int, times: list[float], *, as_json: bool) -> None:
    name = peer.name
    try:
        # By GUID: two peers may have the same name.
        reply = client.call("ping", PingReply, peer=peer.guid, count=1)
        elapsed, problem = (reply.times[0] if reply.times else None), "no answer"
    except PeerRefused as error:
        reply, elapsed, problem = PingReply(times=()), None, error.reason
    if elapsed is not None:
        times.append(elapsed)
    if as_json:
        answer = {"peer": name, "seq": number, "time": elapsed, "remote": reply.remote}
        print_json(answer if elapsed is not None else answer | {"error": problem})
    elif elapsed is None:
        print_line(f"{name}: seq={number} {problem}")
    else:
        print_line(f"{name} ({reply.remote}): seq={number} time={elapsed * 1e3:.3f} ms")


def _ping_summary(name: str, sent: int, times: list[float], *, as_json: bool) -> None:
    summary = SampleSummary.of(times)
    figures = {"min": summary.minimum, "avg": summary.mean, "max": summary.maximum, "sd": summary.sd}
    if as_json:
        print_json({"peer": name, "sent": sent, "received": len(times), **figures})
        return
    lost = 100 * (sent - len(times)) / sent if sent else 0
    click.echo(f"\n--- {name} ping statistics ---")
    click.echo(f"{sent} sent, {len(times)} received, {lost:.0f} % lost")
    if times:
        click.echo(f"rtt min/avg/max/sd = {'/'.join(f'{v * 1e3:.3f}' for v in figures.values())} ms")
