"""``rmpa peer``: the peers that this machine's agent knows; ``rmpa site``: other sites that gateways join."""

from __future__ import annotations

import contextlib
from dataclasses import replace
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec

from rmpa.cli.graph import find_peer, shown_state, suggestion
from rmpa.cli.options import (
    Options,
    Selection,
    agent_verb,
    argument,
    flag,
    limit_options,
    option,
    peers,
    ping_options,
    pings,
    summary,
)
from rmpa.cli.output import Table, Text, duration, printable, size, warn
from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError
from rmpa.core.statistics import SampleSpread
from rmpa.observe import limits
from rmpa.observe.control_client import GATEWAY_REPORT, ControlClient
from rmpa.observe.sites import REPORT, SITE_INFO, SiteInfo, SitesReport
from rmpa.observe.snapshot import PENDING, ModuleFacts, PeerInfo, PingReply, Snapshot

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.core.facts import RouteInfo, TopicInfo

_T = TypeVar("_T")
# By the state of a peer or site.
_COLOURS: Final = {
    **dict.fromkeys(("linked", "relayed", "this site", "joined"), "green"),
    **dict.fromkeys(("linking", "pending", "foreign", "no gateway"), "yellow"),
    **dict.fromkeys(("refused", "revoked", "conflict", "unreachable"), "red"),
}
# States that are no problem.
_USUAL: Final = frozenset({"linked", "relayed"})
# Seconds after which it is said what a link waits for: most are up after 0.3 s.
_YOUNG: Final = 5.0
# Columns that are shown without ``-v``: they fit 80 characters.
_BRIEF: Final = "PEER, STATE, >SINCE, ADDRESS, RTT"
# What is shown of a module, of what its agent tells: a title, and the fact as text; empty where it is not known.
MODULE_FACTS: Final[tuple[tuple[str, Callable[[ModuleFacts], str]], ...]] = (
    ("Version", lambda module: module.version),
    ("Host", lambda module: module.host),
    ("System", lambda module: module.system),
    ("Runs for", lambda module: duration(module.uptime)),
    ("CPU", lambda module: "" if module.cpu is None else f"{module.cpu:.1f} % of a core"),
    ("Memory", lambda module: "" if module.rss is None else size(module.rss)),
    ("Open files", lambda module: "" if module.files is None else f"{module.files.open} of {module.files.limit}"),
    ("Proxies", lambda module: str(module.proxies)),
    ("Core", lambda module: module.core_uri),
)


@agent_verb(
    argument("pattern", peers, default=""),
    flag("-v --verbose", "With the side that dialled, clock, traffic, queue and drops."),
    option("--state states", help="Only peers in this state; may be given again.", multiple=True),
    *limit_options,
)
def peer_list(
    pattern: str, verbose: bool, states: tuple[str, ...], limit: int | None, everything: bool, options: Options
) -> None:
    """List the peers, all or those with names like PATTERN, and the state of their links.

    A link is "at rest" while nothing uses it: a lost peer is then noticed after 16 s instead of 1 s.

    A module that is "pending" needs an invitation, and the line below the table has the command that makes it. Its
    name and address are not proved.

    CLOCK is the peer's wall clock minus ours, with the largest possible error. With very many peers a terminal shows
    a summary and the first ones: those with a problem, then those with most traffic.

    ---

    Examples:
      rmpa peer list
      rmpa peer list -v
      rmpa peer list 'arm*' --state linked --state refused
      rmpa peer list --json | jq '.[].name'
    """
    with options.client() as client:
        snapshot = client.snapshot(topics=())
    selection = Selection(pattern, limit=limit, everything=everything or options.as_json)
    known = (*snapshot.peers, *snapshot.strangers)
    peers = [p for p in known if selection.wants(p.name, ()) and (not states or p.state in states)]

    def text() -> Iterator[Text]:
        if not known:
            where = ", ".join(snapshot.agent.interfaces) or "no interface"
            yield f"{snapshot.agent.name} knows no peers yet (domain {snapshot.agent.domain}, looking on {where})"
        elif not peers:
            yield summary(len(known), "peers", (p.state for p in known)) + "; none of them matches"
        else:
            titles = _BRIEF + (", DIALLED, >CLOCK, >IN, >OUT, >QUEUE, >DROPS" if verbose else "")
            shown = selection.first(peers, _urgency)
            rows = [_row(p)[: titles.count(",") + 1] for p in shown]
            about = summary(len(peers), "peers", (p.state for p in peers))
            table = Table(titles, rows, [_COLOURS.get(p.state, "") for p in shown])
            yield selection.framed(peers, "peers", about, "rmpa peer list 'arm*', --state linked", table)
        troubles = _troubles(snapshot, sorted(peers, key=_urgency) if selection.is_long(peers) else peers)
        for trouble in troubles[: selection.lines]:
            warn(*trouble)
        if selection.is_long(troubles):
            left = len(troubles) - (selection.lines or 0)
            warn(f"... {left:,} more of this kind; all: rmpa peer list --all", "peer-unlinked")

    options.show(peers, text())


def _urgency(info: PeerInfo) -> tuple[int, int, str]:
    """The order of a list that is not shown whole: problems first, then by traffic."""
    usual = info.state in _USUAL and not (info.conflicts or info.beyond)
    return int(usual), 0 if info.link is None else -(info.link.bytes_in + info.link.bytes_out), info.name


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
        *map(size, (link.bytes_in, link.bytes_out, link.queued)),
        str(link.dropped),
    ]


def _troubles(snapshot: Snapshot, peers: list[PeerInfo]) -> list[tuple[str, str]]:
    """Each with its code."""
    found = [(note, "agent-trouble") for note in snapshot.notes]
    named: dict[str, list[str]] = {}  # to a module without keys all of a mesh are pending, by one text
    for info in peers:
        named.setdefault(info.last_error, []).append(info.name)
    for info in peers:
        if info.state == PENDING:
            if names := named.pop(info.last_error, []):
                found.append((f"{', '.join(names)}: {info.last_error}", info.code))
            continue
        found += [(f"{info.name}: {conflict}", "name-conflict") for conflict in info.conflicts]
        found += [(bound.text, "limit-reached") for bound in info.beyond]
        if info.last_error and info.state not in _USUAL:
            again = "" if info.next_attempt is None else f"; next attempt in {duration(info.next_attempt)}"
            found.append((f"{info.name}: {info.last_error}{again}", info.code))
        elif info.state == "linking" and not info.conflicts and info.since_ago >= _YOUNG:
            text = f"waits for a TCP connection with {info.guid.partition('#')[0]}; rmpa why --module {info.name}"
            found.append((f"{info.name}: {text}", "peer-unlinked"))
    return found


@agent_verb(argument("name", peers))
def peer_info(name: str, options: Options) -> None:
    """Show all that is known of the peer NAME (or of one by its GUID).

    Its own agent is asked for its version, machine and figures. Clock is its wall clock minus ours, with the largest
    possible error. For each topic that comes from it: the rate over the last minute, and the median and 99th
    percentile of the one-way latency, with the largest possible error (±).

    ---

    Examples:
      rmpa peer info base
    """
    facts, problem = None, ""
    with options.client() as client:
        snapshot = client.snapshot()
        found = find_peer(snapshot, name)
        if found.link is not None:
            try:
                facts = client.call("agent", ModuleFacts, peer=found.guid)
            except RmpaError as error:
                problem = error.reason if isinstance(error, PeerRefused) else str(error)

    def text() -> Iterator[Text]:
        about = [(label, shown(facts)) for label, shown in MODULE_FACTS] if facts is not None else []
        lines = (*_link_facts(found), *about, ("Its agent", problem))
        yield (f"{label + ':':<13} {text}" for label, text in lines if text)
        for direction, title in (("in", "it publishes"), ("out", "we publish to it")):
            of_topics = [(topic, route) for topic in snapshot.topics for route in topic.routes]
            rows = [_route(t, r) for t, r in of_topics if r.peer == found.name and r.direction == direction]
            titles = "  TOPIC, TYPE, NODE, ROUTE, >MESSAGES"
            if direction == "in":
                titles += ", >RATE, >LATENCY, >P99, >LOST"
            if rows:
                yield from ("", f"Topics that {title}:")
                yield Table(titles, [row[: titles.count(",") + 1] for row in rows])

    options.show(msgspec.to_builtins(found) | {"module": facts}, text())


def _route(topic: TopicInfo, route: RouteInfo) -> list[str]:
    latency = route.latency
    return [
        *(f"  {topic.name}", route.type or topic.type or "-", route.node, shown_state(route)),
        str(route.messages),
        "-" if route.rate is None else f"{route.rate:.1f} Hz",
        "-" if latency is None else f"{duration(latency.p50)} ±{duration(latency.error)}",
        "-" if latency is None else duration(latency.p99),
        str(route.lost + route.late + route.expired),
    ]


def _link_facts(info: PeerInfo) -> Iterator[tuple[str, str]]:
    yield "Peer", info.name
    yield "GUID", info.guid
    if info.via:
        yield "State", f"relayed: {info.via} passes on {info.topics_in} topics that it publishes"
        return
    yield "State", f"{info.state} for {duration(info.since_ago)}"
    yield "Addresses", ", ".join(info.addresses) or "-"
    yield "Found", f"{duration(info.found_ago)} ago by {info.source or 'a beacon'}"
    yield "Last beacon", f"{duration(info.beacon_ago)} ago" if info.beacon_ago is not None else "-"
    if (link := info.link) is not None:
        who = "dialled by us" if link.dialled else "dialled by it"
        clock = "-" if link.clock_offset is None else f"{duration(link.clock_offset)} ± {duration(link.clock_error)}"
        rest = f"at rest: nothing depends on the link, and its silence is noticed after {link.lease:.0f} s"
        yield "Link", f"{link.remote}, {who}, up for {duration(link.up_ago)}, heard {duration(link.heard_ago)} ago"
        yield "Pace", rest if link.rests else "in use: its silence is noticed within 1 s"
        for lane in link.lanes:
            idle = "connected when a message wants it" if lane.unneeded else "no connection"
            yield "Lane", f"{lane.name}: {'connected' if lane.connected else idle}"
        yield "Round trip", duration(link.rtt)
        yield "Clock", f"{clock} (its clock less ours)"
        yield "Traffic", f"{size(link.bytes_in)} in, {size(link.bytes_out)} out, {size(link.queued)} queued"
        yield "Drops", f"{link.dropped} messages"
        if info.direct_in or info.direct_out:
            ours = f"{info.direct_in} of the subscribers here to its nodes"
            yield "Direct", f"{ours}, {info.direct_out} of its subscribers to nodes here"
    yield from (("Last error", info.last_error), ("Invitation", info.invite))
    if info.next_attempt is not None:
        yield "Next attempt", f"in {duration(info.next_attempt)}"
    yield from (("Limit", bound.text) for bound in info.beyond)
    yield from (("Conflict", conflict) for conflict in info.conflicts)


@agent_verb(argument("name", peers), ping_options)
def peer_ping(name: str, count: int | None, interval: float, options: Options) -> int:
    """Measure the round trip to the peer NAME over the mesh.

    Exits 1 if no answer came.

    ---

    Examples:
      rmpa peer ping base
      rmpa peer ping base -c 10 -i 0.1
    """
    times: list[float] = []
    sent = 0
    with options.client() as client:
        found = find_peer(client.snapshot(topics=()), name)
        with contextlib.suppress(KeyboardInterrupt):
            for sent in pings(count, interval):
                _ping_once(client, found, sent, times, options)
    of = SampleSpread.of(times)
    figures = {"min": of.min, "avg": of.mean, "max": of.max, "sd": of.sd}
    lost = 100 * (sent - len(times)) / sent if sent else 0
    lines = [f"--- {found.name} ping statistics ---", f"{sent} sent, {len(times)} received, {lost:.0f} % lost"]
    if times:
        lines.append(f"rtt min/avg/max/sd = {'/'.join(f'{v * 1e3:.3f}' for v in figures.values())} ms")
    options.show({"peer": found.name, "sent": sent, "received": len(times), **figures}, "", lines)
    return 0 if times else 1


def _ping_once(client: ControlClient, peer: PeerInfo, number: int, times: list[float], options: Options) -> None:
    """Ping a peer, note its time, and print the result, at which Ctrl-C may end the command."""
    reply, problem = PingReply(times=()), "no answer"
    try:
        reply = client.call("ping", PingReply, peer=peer.guid, count=1)  # by GUID: two peers may have the same name
    except PeerRefused as error:
        problem = error.reason
    elapsed = reply.times[0] if reply.times else None
    shown = {"peer": peer.name, "seq": number, "time": elapsed, "remote": reply.remote}
    if elapsed is None:
        options.show(shown | {"error": problem}, f"{peer.name}: seq={number} {problem}")
    else:
        times.append(elapsed)
        options.show(shown, f"{peer.name} ({reply.remote}): seq={number} time={elapsed * 1e3:.3f} ms")


name_option = option("--name", "GATEWAY", "Ask this gateway of this machine, not --agent's.")


def _connect(options: Options, name: str | None) -> ControlClient:
    return replace(options, agent=name or options.agent).client(limits.CONTROL_HANDLER_TIMEOUT)


def _ask(client: ControlClient, what: str, kind: type[_T], **args: object) -> _T:
    try:
        return msgspec.convert(client.pass_on("site", object, what=what, args=args), kind)
    except msgspec.ValidationError as error:
        raise RemoteProtocolError(f"the gateway answers in another way: {error}; is it another version?") from None


@agent_verb(name_option)
def site_list(name: str | None, options: Options) -> int:
    """List this site and the others that its gateways join.

    SOURCES counts the topics (one for each publisher) and services that a site offers, SHOWN those in the graph here.
    BY is the gateway that was asked; a standby gateway shows none.

    ---
    Exit codes: 0 each site is joined; 1 one is not, or no gateway answers.

    Examples:
      rmpa site list
      rmpa site list --name store-gateway
      rmpa site list --json | jq -r '.[].sites[].name'
    """
    with _connect(options, name) as client:
        reports = _ask(client, REPORT, tuple[SitesReport, ...])
        if not reports:
            warn(_why_none(client), "site-unreachable")

    def text() -> Iterator[Text]:
        rows = [(report, site) for report in reports for site in report.sites]
        titles = "SITE, STATE, >SINCE, >GATEWAYS, >MODULES, >SOURCES, >SHOWN, BY"
        if reports:
            yield Table(titles, [_site_row(*row) for row in rows], [_COLOURS.get(s.state, "") for _, s in rows])
        for report in reports:
            if report.problem:
                warn(f"{report.gateway}: {report.problem}", "zenoh-trouble")
            if not any(site.state != "this site" for site in report.sites):
                where = ": it is connected to nothing; is the router of gateway.connect there?"
                if report.endpoints:
                    where = f": it is connected to {', '.join(report.endpoints)}, where no other gateway is"
                warn(f"{report.gateway} of site {report.site} knows no other site{where}", "site-unreachable")

    options.show(reports, text())
    well = all(s.state in ("this site", "joined") for report in reports for s in report.sites)
    return 0 if reports and well and not any(report.problem for report in reports) else 1


def _why_none(client: ControlClient) -> str:
    """Why no gateway answers: this agent is a gateway whose session is not open, or it knows none."""
    with contextlib.suppress(RmpaError):  # no gateway: it has no such operation
        problem = str(client.call(GATEWAY_REPORT, dict[str, object]).get("problem", ""))
        return f"{client.name} joins no site: {problem or 'it is a gateway without --site'}"
    start = "start one with `rmpa gateway --site NAME`; in a secured mesh `relays` of [trust] names it"
    return f"{client.name} is no gateway, and is linked to none: {start}"


def _site_row(report: SitesReport, site: SiteInfo) -> list[str]:
    modules = len({module.name for module in site.modules})
    sources = sum(module.topics + module.services for module in site.modules)
    shown = sum(module.shown for module in site.modules)
    counts = map(str, (site.gateways, modules, sources, shown))
    by = report.gateway + ("" if report.leads else " (standby)")
    return [site.name, site.state, duration(site.since_ago), *counts, by]


@agent_verb(argument("site"), name_option)
def site_info(site: str, name: str | None, options: Options) -> int:
    """Show the modules of SITE, what they offer, its name here, and why something does not cross.

    ---
    Exit codes: 0 the site is joined, or this one; 1 it is not there, or not known.

    Examples:
      rmpa site info warehouse
      rmpa site info hall --json | jq '.sites[0].sources[] | select(.here=="")'
    """
    with _connect(options, name) as client:
        report = _ask(client, SITE_INFO, SitesReport, site=site)
    found = next((each for each in report.sites if each.name == site), None)
    if found is None:
        known = [each.name for each in report.sites]
        hint = suggestion(site, known, f"known are {', '.join(known)}")
        raise RmpaError(f"{report.gateway} knows no site {printable(site)!r}; {hint}", code="unknown-name")
    options.show(report, _site_text(report, found))
    return 0 if found.state in ("this site", "joined") else 1


def _site_text(report: SitesReport, site: SiteInfo) -> Iterator[Text]:
    since = f" for {duration(site.since_ago)}" if site.since_ago is not None else ""
    stands_by = "" if report.leads else ", on standby"
    yield f"Site:      {site.name}"
    yield f"State:     {site.state}{since}"
    yield f"Gateways:  {site.gateways}"
    of_site = f" of site {report.site}" if report.site else ""
    yield f"Seen by:   {report.gateway}{of_site}{stands_by}"
    yield f"Connected: {', '.join(report.endpoints) or 'to nothing'}"
    if site.not_shown:
        yield f"Kept out:  {site.not_shown} topics and services, by rules or for their names"
    if site.beyond:
        yield f"Limit:     {site.beyond} topics and services were left out: the site has too many"
    if site.modules:
        rows = [[f"  {m.name}", str(m.topics), str(m.services), str(m.shown)] for m in site.modules]
        yield from ("", "Modules:")
        yield Table("  MODULE, >TOPICS, >SERVICES, >SHOWN", rows)
    if site.sources:
        rows = [[f"  {s.name}", s.kind, s.type, s.module, s.node, s.here or "-"] for s in site.sources]
        yield from ("", "Topics and services:")
        yield Table("  NAME, KIND, TYPE, MODULE, NODE, HERE", rows)
    for source in site.sources:
        if source.problem:
            warn(f"{source.name} of {source.module}: {source.problem}", "rule-excludes")
