"""Why a topic of a peer does not arrive here: the stages between its publisher and its subscribers, in order.

Pure: what both ends know goes in, stages come out, and the first that fails says what to do. The stages::

    peer ─ link ─ publisher ─ policy there ─ permission there ─ offer ─ limit ─ policy here ─ permission here ─ type
         ─ graph ─ subscriber ─ md5 ─ transport ─ route ─ sent ─ arrived ─ contract ─ reader

Of subscribers that are connected directly ``direct_stages`` judges what follows the transport.
"""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.policy import OUTSIDE_GUID
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access
from rmpa.config.values import did_you_mean
from rmpa.core import limits as core_limits
from rmpa.observe import limits as observe_limits
from rmpa.observe.peer_info import FAIL, OK, UNKNOWN, WARN, Check, CheckLevel
from rmpa.observe.why.diagnosis import (
    PERMISSION_HERE,
    PERMISSION_THERE,
    UNASKED,
    Diagnosis,
    adrift_stages,
    connected_directly,
    connection,
    permission_here,
    permission_there,
    transport,
    until_failure,
)
from rmpa.ros import limits as ros_limits

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.observe.peer_info import PeerInfo
    from rmpa.observe.snapshot import RouteInfo, Snapshot
    from rmpa.observe.why.diagnosis import BothEnds, PublisherReport, TopicAtSubscriber


_SEVERAL: Final = 2
"""Messages sent without one arriving that count as a fault: a single one may still be on its way."""
_FLOWING: Final = frozenset({"open", "lingering"})


def find_peer(snapshot: Snapshot, name: str) -> PeerInfo | None:
    """The peer with a name or GUID; of several peers of one name, a linked one."""
    fitting = _fitting(snapshot.peers, name)
    return min(fitting, key=lambda p: p.state != "linked", default=None)


def _fitting(peers: Iterable[PeerInfo], name: str) -> list[PeerInfo]:
    return [p for p in peers if name in (p.name, p.guid, p.guid.partition("#")[0])]


def peer_stages(snapshot: Snapshot, name: str) -> tuple[Check, ...]:
    """The first two stages: whether the peer is known, and whether it is linked."""
    agent = snapshot.agent
    peer = find_peer(snapshot, name)
    if peer is None and (strangers := _fitting(snapshot.strangers, name)):
        return (Check.from_message("peer", FAIL, f"{name} is {strangers[0].last_error}"),)
    if peer is None:
        where = ", ".join(agent.interfaces) or "no interface"
        known = [p.name for p in snapshot.peers]
        similar = did_you_mean(name, known)
        text = f"{agent.name} knows no peer {name!r} (domain {agent.domain}, looking on {where}); "
        text += f"known are {', '.join(known)}" if known else "it knows no peer at all"
        remedy = f"did you mean {similar}? If not, " if similar else ""
        remedy += (
            f"see that `rmpa up` runs there with --domain {agent.domain}; `rmpa doctor` on both checks multicast, "
            "and --seed HOST:PORT reaches it where there is none"
        )
        return (Check("peer", FAIL, text, remedy),)
    if peer.state == "conflict":
        return (_conflict(peer, FAIL),)
    if peer.state == "relayed":
        outside = peer.guid == OUTSIDE_GUID
        heard = Check(
            "peer", OK, f"{peer.name} is another site" if outside else f"{peer.name} is known ({peer.guid})"
        )
        return (heard, Check("link", OK, f"no link of its own; {peer.via} passes on what it publishes"))
    found = Check("peer", OK, f"{peer.name} is known, by {peer.source or 'its link'} ({peer.guid})")
    if peer.conflicts:  # two peers of one name, say: both are linked
        found = _conflict(peer, WARN)
    if peer.state != "linked" or peer.link is None:
        return (found, _unlinked(peer))
    return (found, _linked(peer))


def _conflict(peer: PeerInfo, level: CheckLevel) -> Check:
    texts, remedies = zip(
        *(conflict.partition("; ")[::2] for conflict in peer.conflicts or (peer.state,)), strict=True
    )
    remedy = "; ".join(filter(None, remedies)) or "give each module a --name and an address of its own"
    return Check("peer", level, "; ".join(texts), remedy)


def _unlinked(peer: PeerInfo) -> Check:
    text = f"{peer.name} is {peer.state}"
    if peer.last_error:
        text += f": {peer.last_error}"
    elif peer.beacon_ago is not None:
        text += f": its beacons come (the last {peer.beacon_ago:.1f} s ago), but there is no TCP connection"
    port = peer.guid.partition("#")[0]
    remedy = (
        f"see that TCP to {port} is open on both machines (a firewall? give it a fixed port with --port), and that "
        "the machines reach each other: `rmpa doctor`"
    )
    if peer.state == "refused":
        remedy = "do what the text says; both sides are asked again by themselves"
    return Check("link", FAIL, text, remedy)


def _linked(peer: PeerInfo) -> Check:
    link = peer.link
    assert link is not None  # noqa: S101 - the caller has looked
    text = f"linked by {link.remote} for {link.up_ago:.0f} s"
    if link.rtt is not None:
        text += f", round trip {link.rtt * 1e3:.1f} ms"
    if link.heard_ago is not None and link.heard_ago > link.lease / 2:
        text += f"; silent for {link.heard_ago:.1f} s"
        return Check("link", WARN, text, "if it stays so, the cable or the radio is the place to look at")
    return Check("link", OK, text)


def diagnose_topic(ends: BothEnds, peer: str, later: BothEnds | None = None, wire: str = "") -> tuple[Diagnosis, ...]:
    """Judge all stages for each publisher that a peer has of a topic.

    Args:
        ends: What both ends know.
        peer: The peer's name (or GUID), as the user wrote it.
        later: What both ends know some time later, which shows whether messages flow.
        wire: The topic's name at the peer; if empty, the name here.

    Returns:
        One diagnosis for each publisher; a single one where a stage before the publishers fails.
    """
    snapshot, topic = ends.here.snapshot, ends.here.topic
    to = snapshot.agent.name
    known = find_peer(snapshot, peer)
    name = known.name if known is not None else peer
    wire = wire or topic
    begin = peer_stages(snapshot, peer)
    if begin[-1].name == "link" and begin[-1].level is FAIL:
        left = [route for route in _routes((later or ends).here, name) if connected_directly(route)]
        if left:
            stages = [(route.node, (*begin[:-1], *adrift_stages(begin[-1], route))) for route in left]
            return tuple(Diagnosis.of(found, name=topic, peer=name, to=to, node=node) for node, found in stages)
    if begin[-1].level is not FAIL:
        begin += (_published(ends, name, wire),)
    if begin[-1].level is FAIL:
        return (Diagnosis.of(begin, name=topic, peer=name, to=to),)
    return tuple(
        Diagnosis.of(
            until_failure(chain(begin, _source_stages(ends, later, name, node, wire))),
            name=topic,
            peer=name,
            to=to,
            node=node,
        )
        for node in _nodes(ends, name)
    )


def _nodes(ends: BothEnds, peer: str) -> list[str]:
    reported = [source.node for source in ends.there.sources] if ends.there is not None else []
    known = [route.node for route in _routes(ends.here, peer)]
    return list(dict.fromkeys([*reported[: observe_limits.WHY_SOURCES_MAX], *known]))[
        : observe_limits.WHY_SOURCES_MAX
    ]


def _routes(here: TopicAtSubscriber, peer: str) -> list[RouteInfo]:
    topics = [topic for topic in here.snapshot.topics if topic.name == here.topic]
    routes = [r for t in topics for r in t.routes if r.direction == "in" and r.peer == (here.carrier or peer)]
    return [route for route in routes if here.proxies is None or route.node in here.proxies]


def _report(ends: BothEnds | None, node: str) -> PublisherReport | None:
    sources = ends.there.sources if ends is not None and ends.there is not None else ()
    return next((source for source in sources if source.node == node), None)


def _route(ends: BothEnds | None, peer: str, node: str) -> RouteInfo | None:
    routes = _routes(ends.here, peer) if ends is not None else []
    return next((route for route in routes if route.node == node), None)


def _published(ends: BothEnds, peer: str, wire: str) -> Check:
    there = ends.there
    if there is None:
        offered = [route.node for route in _routes(ends.here, peer)]
        if offered:
            text = f"its agent does not tell ({ends.refusal}), but it offered {wire} of {', '.join(offered)}"
            return Check("publisher", UNKNOWN, text)
        text = f"{peer} offers no {wire}, and its agent does not tell why ({ends.refusal})"
        return Check("publisher", FAIL, text, f"ask on {peer} itself: rostopic info {wire}")
    if there.permitted is False:
        to = ends.here.snapshot.agent.name
        return permission_there(peer, to, Access.SUBSCRIBE, wire)
    if there.sources:
        nodes = ", ".join(source.node for source in there.sources)
        text = f"{nodes} on {peer} publish{'' if len(there.sources) > 1 else 'es'} {wire}"
        others = {source.topic for source in there.sources} - {"", wire}
        return Check("publisher", OK, f"{text} ({', '.join(sorted(others))} over there)" if others else text)
    text = f"no node of {peer} publishes {wire}"
    if there.subscribers:
        text += f"; {', '.join(there.subscribers)} there only subscribe to it"
    remedy = f"start its publisher there, or see `rmpa topic list {peer}:/`"
    if there.similar:
        remedy = f"did you mean {there.similar}?"
    return Check("publisher", FAIL, text, remedy)


def _source_stages(ends: BothEnds, later: BothEnds | None, peer: str, node: str, wire: str) -> Iterator[Check]:
    """Generate the stages of one publisher lazily: stages after the first that fails need not be built."""
    report = _report(ends, node)
    yield _policy_there(report, peer)
    if ends.there is not None and ends.there.permitted:
        yield Check(PERMISSION_THERE, OK, f"{peer} lets {ends.here.snapshot.agent.name} subscribe to it")
    if report is not None and report.unreachable:
        yield _unreachable(report, peer)
    route = _route(ends, peer, node)
    if route is None:
        yield _not_offered(ends, report, peer)
        return
    yield Check("offer", OK, f"{ends.here.snapshot.agent.name} knows of it, as {route.type}")
    if route.limit:
        yield _limit(ends.here, route)
        return
    yield _policy_here(ends.here, route)
    if (permission := ends.here.proxy(node).permission) and route.state != "hidden":
        yield Check(PERMISSION_HERE, OK, permission)
    yield _type(ends.here, route)
    yield _in_graph(ends.here, route)
    for stage in _subscriber(ends.here, route):
        yield stage
        if stage.name == UNASKED:
            return
    now, report_now = _route(later, peer, node) or route, _report(later, node) or report
    relayed = bool(ends.here.proxy(node).connections)
    yield transport(now)
    if connected_directly(now):
        yield connection(now)
        if not relayed:
            return
    yield _open_route(now, report_now, peer)
    if now.state in _FLOWING:
        yield _sent(now, report_now, peer, wire)
        yield _arrived(route, now, report, report_now, peer, ends.here.snapshot.agent.name)
        yield _contract(now)
        yield _reading(ends, later, node)


def _policy_there(report: PublisherReport | None, peer: str) -> Check:
    if report is None:
        return Check("policy there", UNKNOWN, f"{peer} did not tell")
    if report.crosses:
        return Check("policy there", OK, f"{peer} lets it cross: {report.rule}")
    remedy = f"change [bridge] in the rmpa.toml of {peer}, and `rmpa reload` there"
    if report.rule.startswith("built in"):
        remedy = "no rule of yours can let it cross; republish it there under another name (topic_tools relay)"
    return Check("policy there", FAIL, f"{peer} keeps it at home: {report.rule}", remedy)


def _unreachable(report: PublisherReport, peer: str) -> Check:
    """The node is registered at the peer, and the peer's agent cannot connect to it."""
    text = f"{report.node} is registered on {peer}, but cannot be reached at {report.unreachable}"
    remedy = (
        "if it is alive, start it with ROS_IP=127.0.0.1 (and no ROS_HOSTNAME) in its shell; if it is dead, "
        f"`rosnode cleanup` on {peer} removes it"
    )
    return Check("reachable", FAIL, text, remedy)


def _not_offered(ends: BothEnds, report: PublisherReport | None, peer: str) -> Check:
    if report is not None and report.type in ("", "*"):
        text = f"its node has not told {peer}'s core what type it is"
        return Check("offer", FAIL, text, "a publisher tells its type when it registers; is it an old script?")
    if report is not None and report.beyond:
        text = f"{peer} does not offer it: it has more topics than limits.topics = {report.beyond} of that module"
        return Check("offer", FAIL, text, "raise it over there and `rmpa reload`, or deny some by bridge.deny there")
    if report is not None and not report.offered:
        text = f"{peer} does not offer it: its name or type is none that can cross, or is too long"
        return Check("offer", FAIL, text, f"names of at most {config_limits.CROSSING_NAME_MAX} characters cross")
    peers = [p for p in ends.here.snapshot.peers if p.name == peer]
    for bound in (bound for p in peers for bound in p.beyond if bound.kind == "topics"):
        return Check.from_message("limit", FAIL, bound.text)
    count = peers[0].topics_in if peers else 0
    text = f"the offer of it has not come here ({count} topics of {peer} have)"
    remedy = (
        f"if it stays so for more than {bridge_limits.RECONCILE_INTERVAL:g} s, it is a bug of ours: both logs, please"
    )
    return Check("offer", FAIL, text, remedy)


def _limit(here: TopicAtSubscriber, route: RouteInfo) -> Check:
    """A limit of this module hides the topic: the setting, and how much else it hides."""
    peers = [p for p in here.snapshot.peers if p.name == route.peer]
    hidden = [b.hidden for p in peers for b in p.beyond if b.kind == route.limit]
    text = route.problem + (f"; {hidden[0]} {route.limit} of it are hidden" if hidden else "")
    remedy = f"raise limits.{route.limit} in this module's rmpa.toml and `rmpa reload`, or deny what is not needed"
    return Check("limit", FAIL, text, remedy)


def _policy_here(here: TopicAtSubscriber, route: RouteInfo) -> Check:
    if here.proxy(route.node).denied:
        return permission_here(route.peer, Access.PUBLISH, here.topic, here.proxy(route.node).permission)
    if route.state == "hidden" and not here.proxy(route.node).conflict:
        remedy = "change [bridge] in this module's rmpa.toml, and `rmpa reload`"
        return Check("policy here", FAIL, f"this module does not take it: {route.problem}", remedy)
    was = f" (its {route.wire})" if route.wire else ""
    return Check("policy here", OK, f"this module takes it as {here.topic}{was}")


def _type(here: TopicAtSubscriber, route: RouteInfo) -> Check:
    if here.proxy(route.node).conflict:
        return Check.from_message("type", FAIL, route.problem)
    return Check("type", OK, f"no local publisher has another type than {route.type}")


def _in_graph(here: TopicAtSubscriber, route: RouteInfo) -> Check:
    state = here.proxy(route.node)
    proxy = state.name or f"/rmpa/{route.peer}{route.node}"
    if not state.registered:
        text = f"its proxy {proxy} is not in the local graph as a publisher of {here.topic}"
        if route.problem:
            return Check.from_message("graph", FAIL, f"{text}: {route.problem}")
        remedy = (
            f"it is put there again within {bridge_limits.RECONCILE_INTERVAL:g} s; if not, the agent's log says why"
        )
        return Check("graph", FAIL, text, remedy)
    return Check("graph", OK, f"its proxy {proxy} stands in the local graph")


def _subscriber(here: TopicAtSubscriber, route: RouteInfo) -> Iterator[Check]:
    """Whether a local subscriber is connected to the proxy, and whether one was refused."""
    proxy = here.proxy(route.node)
    connections, refused = proxy.connections, proxy.mismatches
    topics = [topic for topic in here.snapshot.topics if topic.name == here.topic]
    listed = topics[0].subscribers if topics else ()
    direct = connected_directly(route)
    undecided = [one.node for one in route.subscribers if one.state == "asking"]
    if not connections and not direct:
        if refused:
            yield Check("subscriber", OK, f"{', '.join(listed) or 'a node'} wants it")
            remedy = "build both sides with one version of the message; `rosmsg md5 TYPE` on both shows which differs"
            yield Check("md5", FAIL, "; ".join(refused), remedy)
        elif undecided:
            text = f"{', '.join(undecided)} subscribes, and whether it may be connected directly is not decided yet"
            yield Check("subscriber", FAIL, text, "ask again in a moment; it is relayed if the peer does not answer")
        elif listed:
            text = f"{', '.join(listed)} subscribes, but has not connected to its proxy"
            files = here.snapshot.agent.files
            if files is not None and files.problem:
                problem, _, remedy = files.problem.partition("; ")
                yield Check(
                    "subscriber",
                    FAIL,
                    f"{text}; the agent has no file descriptor to accept it with: {problem}",
                    remedy,
                )
                return
            remedy = (
                "look into that node's log; its ROS_IP and ROS_HOSTNAME must be of this machine, and its "
                f"ROS_MASTER_URI {here.snapshot.agent.core_uri}: `rmpa doctor`"
            )
            yield Check("subscriber", FAIL, text, remedy)
        else:
            text = f"no node here subscribes to {here.topic}, so nothing is sent"
            yield Check(UNASKED, WARN, text, f"to try it: rmpa topic echo {here.topic}")
        return
    there = ["connected to its proxy"] if connections else []
    names = [", ".join(dict.fromkeys(c.node for c in connections))] if connections else []
    if direct:
        names.append(", ".join(one.node for one in direct))
        there.append("was answered the publisher's own address")
    yield Check("subscriber", OK, "; ".join(map(" ".join, zip(names, there, strict=True))))
    if refused:
        yield Check("md5", WARN, "; ".join(refused), "build both sides with one version of the message")
    elif route.md5:
        yield Check("md5", OK, f"{route.md5} on both sides")


def _open_route(route: RouteInfo, report: PublisherReport | None, peer: str) -> Check:
    if route.state in _FLOWING:
        lane = f", {route.lane} lane" if route.lane else ""
        return Check("route", OK, f"open{lane}{', latched' if route.latched else ''}")
    if route.state == "opening":
        text = f"{peer} has been asked for it and has not answered"
        if report is not None and report.route == "opening":
            return Check(
                "route",
                FAIL,
                f"{peer}'s agent waits for the publisher {route.node} to answer its connection",
                f"is that node stopped or stuck? on {peer}: rosnode ping {route.node}",
            )
        return Check("route", FAIL, text, "ask again in a moment; if it stays so, see the log there")
    problem = route.problem or "no node has asked for it yet"
    remedy = f"it is tried again by itself; on {peer}: rosnode info {route.node}"
    return Check("route", FAIL, f"{route.state}: {problem}", remedy)


def _sent(route: RouteInfo, report: PublisherReport | None, peer: str, wire: str) -> Check:
    if report is None:
        return Check("sent", UNKNOWN, f"{peer} did not tell")
    if report.oversized:
        text = f"{report.oversized} messages of its publisher {route.node} are too long, the last has "
        text += f"{report.oversized_bytes} bytes, and at most {ros_limits.TCPROS_MESSAGE_MAX} cross"
        text += f"; {report.messages} others came" if report.messages else ""
        return Check("sent", WARN if report.messages else FAIL, text, "send them in parts, or compressed")
    if not report.messages and not route.messages:
        text = f"its publisher {route.node} is connected, and has published nothing since"
        return Check("sent", FAIL, text, f"look at that node; on {peer}: rostopic hz {wire}")
    text = f"{report.messages} messages from its publisher so far"
    if report.lost:
        text += f"; {report.lost} of them given up, while {peer} had no link to this module or a slow one"
        return Check("sent", WARN, text, "a longer outage, or more depth, in [[contract]] keeps more")
    if report.dropped:
        return Check(
            "sent", WARN, f"{text}; {report.dropped} given up over there", "the link is slower than the topic"
        )
    return Check("sent", OK, text)


def _arrived(
    before: RouteInfo,
    now: RouteInfo,
    report: PublisherReport | None,
    report_now: PublisherReport | None,
    peer: str,
    module: str,
) -> Check:
    moved = now.messages - before.messages
    sent = report_now.messages - report.messages if report is not None and report_now is not None else None
    rarely = (
        float(now.contract.get("max_rate") or core_limits.CONTRACT_RATE_MAX) * observe_limits.WHY_WINDOW < _SEVERAL
    )
    if not now.messages or (sent is not None and sent >= _SEVERAL and not moved and not rarely):
        text = f"{peer} has {'sent ' + str(sent) if sent else 'sent some'} meanwhile, and none arrived at {module}"
        dropped = (
            f" ({report_now.dropped} were given up over there)"
            if report_now is not None and report_now.dropped
            else ""
        )
        remedy = "is the link too slow? `rmpa peer info`; a max_rate or priority helps (docs/contracts.md)"
        return Check("arrived", FAIL, text + dropped, remedy)
    age = now.age or 0.0
    usual = now.period.p99 if now.period is not None else None
    text = f"{now.messages} messages, the last {age:.2f} s ago"
    if now.rate is not None:
        text += f", {now.rate:.1f} Hz"
    if (
        usual is not None
        and not moved
        and age > max(observe_limits.WHY_SILENT, observe_limits.WHY_SILENT_PERIODS * usual)
    ):
        text = f"nothing for {age:.1f} s; until then a message came every {usual * 1e3:.0f} ms at the latest"
        return Check("arrived", FAIL, text, f"its publisher {now.node} on {peer} has fallen silent: look at it")
    if usual is None and not now.latched and age > observe_limits.WHY_SILENT:
        return Check("arrived", WARN, text, "a topic of few messages? nothing tells how often they should come")
    return Check("arrived", OK, text)


def _contract(route: RouteInfo) -> Check:
    missing = {key: getattr(route, key) for key in ("lost", "late", "expired") if getattr(route, key)}
    events = {kind: count for kind, count in route.events.items() if kind != "messages_lost"}
    if not missing and not events:
        said = ", ".join(f"{key} {value}" for key, value in route.contract.items())
        return Check("contract", OK, f"kept ({said})" if said else "nothing lost, late or expired")
    parts = [f"{count} {key}" for key, count in missing.items()]
    parts += [f"{kind.replace('_', ' ')} {count} times" for kind, count in events.items()]
    remedy = "`rmpa topic info` tells when; docs/contracts.md what to do"
    if ("lost" in missing or "loss_unknown" in events) and route.contract.get("reliability") == "reliable":
        remedy = "a longer outage, or more depth, in [[contract]] keeps more; `rmpa topic info` tells when"
    return Check("contract", WARN, ", ".join(parts), remedy)


def _reading(ends: BothEnds, later: BothEnds | None, node: str) -> Check:
    before = {reader.number: reader for reader in ends.here.proxy(node).connections}
    after = (later or ends).here.proxy(node).connections
    if not after:
        return Check("reader", FAIL, "its subscribers have just left", "start them again")
    stuck = [reader for reader in after if reader.waiting and before.get(reader.number, reader).waiting]
    slow = [reader for reader in after if reader.dropped]
    names = ", ".join(f"{reader.node} ({reader.waiting} B wait, {reader.dropped} dropped)" for reader in stuck)
    remedy = "its callbacks are too slow, or it is stopped; no other subscriber waits for it"
    if stuck and len(stuck) == len(after):
        return Check("reader", FAIL, f"{names} does not read", remedy)
    if stuck:
        return Check("reader", WARN, f"{names} does not keep up; others do", remedy)
    if slow:
        text = ", ".join(f"{reader.node} has missed {reader.dropped}" for reader in slow)
        return Check("reader", WARN, text, remedy)
    return Check("reader", OK, f"{', '.join(dict.fromkeys(r.node for r in after))} takes them")
