"""Why a topic of a peer does not arrive here: the stages between its publisher and its subscribers, in order.

Pure: what both ends know goes in, stages come out, and the first that fails says what to do. The stages::

    peer ─ link ─ publisher ─ policy there ─ permission there ─ reachable ─ offer ─ limit ─ policy here
         ─ permission here ─ type ─ graph ─ subscriber ─ md5 ─ transport ─ connection ─ route ─ sent ─ arrived
         ─ contract ─ reader

``STAGES`` has those of one publisher: each is a function of its ``Way``, ``None`` where there is nothing to say.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits as bridge_limits
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import Access
from rmpa.config.rules import CLOCK
from rmpa.config.values import did_you_mean
from rmpa.core import limits as core_limits
from rmpa.core.facts import CONFLICT, DENIED, Arrival, PublisherReport, RouteInfo
from rmpa.core.identity import OUTSIDE_GUID, OWN_NODE, is_meant, proxy_name
from rmpa.discovery.limits import HEARTBEAT_LATE
from rmpa.observe import limits as observe_limits
from rmpa.observe.check import FAIL, OK, UNKNOWN, WARN, Check, CheckLevel
from rmpa.observe.why.diagnosis import (
    PERMISSION_HERE,
    PERMISSION_THERE,
    UNASKED,
    UNMEASURED,
    Diagnosis,
    connected_directly,
    misplaced,
    permission_here,
    permission_there,
    remedy_for,
    route_texts,
)
from rmpa.ros import limits as ros_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rmpa.observe.snapshot import PeerInfo, Snapshot
    from rmpa.observe.why.diagnosis import TopicAtPublisher

# Messages sent without one arriving that count as a fault: a single one may still be on its way.
_SEVERAL: Final = 2
_FLOWING: Final = frozenset({"open", "lingering"})


_NOT_OFFERED: Final = Arrival(route=RouteInfo(peer="", node="", direction="in", state=""))


@dataclass(frozen=True, slots=True)
class Ends:
    """What is known at both ends of a topic's path at one moment.

    Args:
        snapshot: The subscribers' agent's: of itself and its peers.
        topic: The topic's name here.
        wire: Its name at the peer.
        subscribers: The local ones.
        arrivals: What is known here of the peer's publishers, by their names.
        there: What the publisher's agent knows; ``None`` if it did not answer.
        refusal: Why it did not.
    """

    snapshot: Snapshot
    topic: str
    wire: str
    subscribers: tuple[str, ...] = ()
    arrivals: Mapping[str, Arrival] = field(default_factory=dict)
    there: TopicAtPublisher | None = None
    refusal: str = ""

    def report(self, node: str) -> PublisherReport | None:
        """The word of the publisher's agent about a publisher."""
        sources = self.there.sources if self.there is not None else ()
        return next((source for source in sources if source.node == node), None)


class Way:
    """The way of one publisher's messages: what both ends know, and know some time later.

    Args:
        ends: What both ends know.
        later: The same some time later, which shows whether messages flow.
        peer: The publisher's module.
        node: The publisher.
    """

    def __init__(self, ends: Ends, later: Ends, peer: str, node: str) -> None:
        self.ends, self.peer = ends, peer
        self.here, self.told = ends.arrivals.get(node, _NOT_OFFERED), ends.report(node)
        self.told_later = later.report(node) or self.told
        arrived = later.arrivals.get(node)
        self.readers_later = arrived.readers if arrived is not None else {}
        self.before, self.now = self.here.route, (arrived or self.here).route
        self.direct_only = bool(connected_directly(self.now)) and not self.here.readers
        self.flows = self.now.state in _FLOWING and not self.direct_only


def find_peer(snapshot: Snapshot, name: str) -> PeerInfo | None:
    """The peer with a name or GUID; of several peers of one name, a linked one."""
    return min(_fitting(snapshot.peers, name), key=lambda p: p.state != "linked", default=None)


def _fitting(peers: Iterable[PeerInfo], name: str) -> list[PeerInfo]:
    return [peer for peer in peers if is_meant(name, peer.name, peer.guid)]


def peer_stages(snapshot: Snapshot, name: str) -> tuple[Check, ...]:
    """The first two stages: whether the peer is known, and whether it is linked."""
    peer, agent = find_peer(snapshot, name), snapshot.agent
    if peer is None and (strangers := _fitting(snapshot.strangers, name)):
        return (Check.from_message("peer", FAIL, f"{name} is {strangers[0].last_error}"),)
    if peer is None and (relay := snapshot.lost.get(name)):
        text = f"{name} was reached by way of {relay}, which does not pass on what it publishes any more"
        remedy = f"start {relay} again or see `rmpa peer info {relay}`; or give {name} a link of its own"
        return (Check("peer", FAIL, text, remedy),)
    if peer is None:
        known = [p.name for p in snapshot.peers]
        text = f"{agent.name} knows no peer {name!r} (domain {agent.domain}, looking on "
        text += f"{', '.join(agent.interfaces) or 'no interface'}); "
        text += f"known are {', '.join(known)}" if known else "it knows no peer at all"
        similar = did_you_mean(name, known)
        remedy = f"did you mean {similar}? If not, " if similar else ""
        remedy += f"see that `rmpa up` runs there with --domain {agent.domain}; `rmpa doctor` on both checks "
        remedy += "multicast, and --seed HOST:PORT reaches it where there is none"
        return (Check("peer", FAIL, text, remedy),)
    if peer.state == "conflict":
        return (_conflict(peer, FAIL),)
    if peer.state == "relayed":
        text = "another site" if peer.guid == OUTSIDE_GUID else f"known ({peer.guid})"
        return (Check("peer", OK, f"{peer.name} is {text}"), _relay(peer, find_peer(snapshot, peer.via)))
    found = Check("peer", OK, f"{peer.name} is known, by {peer.source or 'its link'} ({peer.guid})")
    # Two peers of one name, say: both are linked.
    return (_conflict(peer, WARN) if peer.conflicts else found, _link(peer))


def _relay(peer: PeerInfo, relay: PeerInfo | None) -> Check:
    """Whether the relay by which a peer is reached is linked, as far as it is known."""
    if relay is None or relay.state == "linked":
        return Check("link", OK, f"no link of its own; {peer.via} passes on what it publishes")
    text = f"no link of its own, and {peer.via}, which passes on what it publishes, is away"
    remedy = f"see that {peer.via} runs and is reached, or give {peer.name} a link of its own"
    return Check("link", FAIL, text, remedy)


def _conflict(peer: PeerInfo, level: CheckLevel) -> Check:
    conflicts = peer.conflicts or (peer.state,)
    texts, remedies = zip(*(conflict.partition("; ")[::2] for conflict in conflicts), strict=True)
    remedy = "; ".join(filter(None, remedies)) or "give each module a --name and an address of its own"
    return Check("peer", level, "; ".join(texts), remedy)


def _link(peer: PeerInfo) -> Check:
    if (link := peer.link) is not None and peer.state == "linked":
        text = f"linked by {link.remote} for {link.up_ago:.0f} s"
        text += f", round trip {link.rtt * 1e3:.1f} ms" if link.rtt is not None else ""
        if link.is_silent:
            text += f"; silent for {link.heard_ago:.1f} s"
            return Check("link", WARN, text, "if it stays so, the cable or the radio is the place to look at")
        return Check("link", OK, text)
    text = f"{peer.name} is {peer.state}"
    if peer.last_error:
        text += f": {peer.last_error}"
    elif peer.beacon_ago is not None:
        text += f": its beacons come (the last {peer.beacon_ago:.1f} s ago), but there is no TCP connection"
    if peer.state == "refused":
        return Check("link", FAIL, text, "do what the text says; both sides are asked again by themselves")
    remedy = ""
    if peer.beacon_ago is None or peer.beacon_ago > HEARTBEAT_LATE:
        remedy = "its beacons have stopped too: is the machine on, and its cable or Wi-Fi connected? If so, "
    remedy += f"see that TCP to {peer.guid.partition('#')[0]} is open on both machines (a firewall? give it a fixed "
    remedy += "port with --port), and that the machines reach each other: `rmpa doctor`"
    return Check("link", FAIL, text, remedy)


def diagnose_topic(ends: Ends, peer: str, later: Ends | None = None) -> tuple[Diagnosis, ...]:
    """Judge all stages for each publisher that a peer has of a topic.

    Args:
        ends: What both ends know.
        peer: The peer's name (or GUID), as the user wrote it.
        later: What both ends know some time later, which shows whether messages flow.

    Returns:
        One diagnosis for each publisher; a single one where a stage before the publishers fails.
    """
    known, begin = find_peer(ends.snapshot, peer), peer_stages(ends.snapshot, peer)
    name = known.name if known is not None else peer
    later = later or ends
    walked: dict[str, tuple[Check, ...]] = {}
    if begin[-1].level is not FAIL:
        begin += (_published(ends, name),)
    elif begin[-1].name == "link":
        for node, left in later.arrivals.items():
            if connected_directly(left.route):
                walked[node] = (*begin[:-1], _adrift(begin[-1], name), *_direct(left.route))
    if begin[-1].level is not FAIL:
        reported = [source.node for source in ends.there.sources] if ends.there is not None else []
        nodes = dict.fromkeys((*reported[: observe_limits.WHY_SOURCES_MAX], *ends.arrivals))
        for node in [*nodes][: observe_limits.WHY_SOURCES_MAX]:
            walked[node] = (*begin, *_walk(Way(ends, later, name, node)))
    to = ends.snapshot.agent.name
    return tuple(
        Diagnosis.of(stages, name=ends.topic, peer=name, to=to, node=node)
        for node, stages in (walked or {"": begin}).items()
    )


def _walk(way: Way) -> Iterable[Check]:
    """The stages up to the first that fails, or after which nothing is sent."""
    for stage in (*STAGES, *(FLOW_STAGES if way.flows else ())):
        if (check := stage(way)) is not None:
            yield check
            if check.level is FAIL or check.name == UNASKED:
                return


def _adrift(link: Check, peer: str) -> Check:
    """The link of a peer whose agent has died: the messages of its direct subscribers go on without it."""
    text = f"{link.text}; without its agent only what is connected directly goes on"
    return Check("link", WARN, text, f"start the agent of {peer} again: it takes the direct connections over")


def _published(ends: Ends, peer: str) -> Check:
    there, wire = ends.there, ends.wire
    if there is None and ends.arrivals:
        text = f"its agent does not answer ({ends.refusal}), but it offered {wire} of {', '.join(ends.arrivals)}"
        return Check("publisher", UNKNOWN, text)
    if there is None:
        text = f"{peer} offers no {wire}, and its agent gives no reason ({ends.refusal})"
        return Check("publisher", FAIL, text, f"ask on {peer} itself: rostopic info {wire}")
    if there.permitted is False:
        return permission_there(peer, ends.snapshot.agent.name, Access.SUBSCRIBE, wire)
    if there.sources:
        nodes = ", ".join(source.node for source in there.sources)
        text = f"{nodes} on {peer} publish{'' if len(there.sources) > 1 else 'es'} {wire}"
        others = {source.topic for source in there.sources} - {"", wire}
        return Check("publisher", OK, f"{text} ({', '.join(sorted(others))} there)" if others else text)
    text = f"no node of {peer} publishes {wire}"
    if there.subscribers:
        one = len(there.subscribers) == 1
        text += f"; {', '.join(there.subscribers)} there only subscribe{'s' if one else ''} to it"
    remedy = f"start its publisher there, or see `rmpa topic list {peer}:/`"
    return Check("publisher", FAIL, text, f"did you mean {there.similar}?" if there.similar else remedy)


def _policy_there(way: Way) -> Check:
    if way.told is None:
        return Check("policy there", UNKNOWN, f"{way.peer} did not tell")
    if way.told.crosses:
        return Check("policy there", OK, f"{way.peer} lets it cross: {way.told.rule}")
    remedy = f"change [bridge] or [[peer]] in the rmpa.toml of {way.peer}, and `rmpa reload` there"
    if way.told.rule.startswith("built in"):
        remedy = "no rule of yours can let it cross; republish it there under another name (topic_tools relay)"
    return Check("policy there", FAIL, f"{way.peer} does not let it cross: {way.told.rule}", remedy)


def _permission_there(way: Way) -> Check | None:
    if way.ends.there is None or not way.ends.there.permitted:
        return None
    return Check(PERMISSION_THERE, OK, f"{way.peer} lets {way.ends.snapshot.agent.name} subscribe to it")


def _reachable(way: Way) -> Check | None:
    """The node is registered at the peer, and the peer's agent cannot connect to it."""
    if way.told is None or not way.told.unreachable:
        return None
    remedy = (
        "if it is alive, start it with ROS_IP=127.0.0.1 (and no ROS_HOSTNAME) in its shell; if it is dead, "
        f"`rosnode cleanup` on {way.peer} removes it"
    )
    text = f"{way.told.node} is registered on {way.peer}, but cannot be reached at {way.told.unreachable}"
    return Check("reachable", FAIL, text, remedy)


def _offer(way: Way) -> Check:
    peer, told = way.peer, way.told
    if way.here is not _NOT_OFFERED:
        return Check("offer", OK, f"{way.ends.snapshot.agent.name} knows of it, as {way.before.type}")
    if told is not None and told.type in ("", "*"):
        text = f"its node has registered it at {peer} without a type"
        return Check("offer", FAIL, text, "a publisher must register with its type; is it an old script?")
    if told is not None and told.beyond:
        text = f"{peer} does not offer it: it has more topics than limits.topics = {told.beyond} of that module"
        return Check("offer", FAIL, text, "raise it there and `rmpa reload`, or deny some by bridge.deny there")
    if told is not None and not told.offered:
        text = f"{peer} does not offer it: its name or type is none that can cross, or is too long"
        return Check("offer", FAIL, text, f"names of at most {config_limits.CROSSING_NAME_MAX} characters cross")
    peers = [p for p in way.ends.snapshot.peers if p.name == peer]
    for bound in (bound for p in peers for bound in p.beyond if bound.kind == "topics"):
        return Check.from_message("limit", FAIL, bound.text)
    text = f"the offer of it has not come here ({peers[0].topics_in if peers else 0} topics of {peer} have)"
    wait = f"if it stays so for more than {bridge_limits.RECONCILE_INTERVAL:g} s"
    return Check("offer", FAIL, text, f"{wait}, it is a bug of ours: both logs, please")


def _limit(way: Way) -> Check | None:
    """A limit of this module hides the topic: the setting, and how much else it hides."""
    if not (limit := way.before.limit):
        return None
    peers = [p for p in way.ends.snapshot.peers if p.name == way.before.peer]
    hidden = [b.hidden for p in peers for b in p.beyond if b.kind == limit]
    text = way.before.problem + (f"; {hidden[0]} {limit} of it are hidden" if hidden else "")
    remedy = f"raise limits.{limit} in this module's rmpa.toml and `rmpa reload`, or deny what is not needed"
    return Check("limit", FAIL, text, remedy)


def _policy_here(way: Way) -> Check:
    route, topic = way.before, way.ends.topic
    if way.here.cause == DENIED:
        return permission_here(route.peer, Access.PUBLISH, topic, way.here.permission)
    if route.state == "hidden" and way.here.cause != CONFLICT:
        remedy = "change [bridge] or [[peer]] in this module's rmpa.toml, and `rmpa reload`"
        return Check("policy here", FAIL, f"this module does not take it: {route.problem}", remedy)
    was = f" (its {route.wire})" if route.wire else ""
    return Check("policy here", OK, f"this module takes it as {topic}{was}")


def _permission_here(way: Way) -> Check | None:
    shown = way.here.permission and way.before.state != "hidden"
    return Check(PERMISSION_HERE, OK, way.here.permission) if shown else None


def _type(way: Way) -> Check:
    if way.here.cause == CONFLICT:
        return Check.from_message("time" if way.ends.topic == CLOCK else "type", FAIL, way.before.problem)
    return Check("type", OK, f"no local publisher has another type than {way.before.type}")


def _graph(way: Way) -> Check:
    proxy = way.here.proxy or proxy_name(f"{OWN_NODE}/{way.before.peer}", way.before.node)
    if way.here.registered:
        return Check("graph", OK, f"its proxy {proxy} stands in the local graph")
    text = f"its proxy {proxy} is not in the local graph as a publisher of {way.ends.topic}"
    if way.before.problem:
        return Check.from_message("graph", FAIL, f"{text}: {way.before.problem}")
    again = f"it is put there again within {bridge_limits.RECONCILE_INTERVAL:g} s"
    return Check("graph", FAIL, text, f"{again}; if not, the agent's log says why")


def _subscriber(way: Way) -> Check:
    """Whether a local subscriber is connected to the proxy, or directly."""
    listed, direct = ", ".join(way.ends.subscribers), connected_directly(way.before)
    if way.here.readers or direct:
        names = [", ".join(dict.fromkeys(node for node, *_ in way.here.readers.values()))] if way.here.readers else []
        texts = [f"{name} connected to its proxy" for name in names]
        if direct:
            texts.append(f"{', '.join(one.node for one in direct)} was answered the publisher's own address")
        return Check("subscriber", OK, "; ".join(texts))
    if way.here.mismatches:
        return Check("subscriber", OK, f"{listed or 'a node'} wants it")
    if undecided := [one.node for one in way.before.subscribers if one.state == "asking"]:
        text = f"{', '.join(undecided)} subscribes, and whether it may be connected directly is not decided yet"
        return Check("subscriber", FAIL, text, "ask again in a moment; it is relayed if the peer does not answer")
    if not listed:
        text = f"no node here subscribes to {way.ends.topic}, so nothing is sent"
        return Check(UNASKED, WARN, text, f"to try it: rmpa topic echo {way.ends.topic}")
    text, agent = f"{listed} subscribes, but has not connected to its proxy", way.ends.snapshot.agent
    if agent.files is not None and agent.files.problem:
        problem, _, remedy = agent.files.problem.partition("; ")
        text = f"{text}; the agent has no file descriptor to accept it with: {problem}"
        return Check("subscriber", FAIL, text, remedy)
    remedy = (
        "look into that node's log; its ROS_IP and ROS_HOSTNAME must be of this machine, and its "
        f"ROS_MASTER_URI {agent.core_uri}: `rmpa doctor`"
    )
    return Check("subscriber", FAIL, text, remedy)


def _md5(way: Way) -> Check | None:
    refused, remedy = "; ".join(way.here.mismatches), "build both sides with one version of the message"
    if not way.here.readers and not connected_directly(way.before):
        return Check("md5", FAIL, refused, f"{remedy}; `rosmsg md5 TYPE` on both shows which differs")
    if refused:
        return Check("md5", WARN, refused, remedy)
    return Check("md5", OK, f"{way.before.md5} on both sides") if way.before.md5 else None


def _transport(way: Way) -> Check:
    return _direct(way.now)[0]


def _connection(way: Way) -> Check | None:
    return _direct(way.now)[1] if connected_directly(way.now) else None


def _direct(route: RouteInfo) -> tuple[Check, Check]:
    """The transport of each subscriber, which is never the stage that fails, and the direct connections.

    Their messages do not pass the agents; their agent looks each second whether the connections stand.
    """
    troubled = misplaced(route)
    text = "; ".join(route_texts(route)) or "relayed"
    transport = Check("transport", WARN if troubled else OK, text, remedy_for(troubled[0]) if troubled else "")
    text = ", ".join(f"{one.node} is connected to {one.endpoint}" for one in connected_directly(route))
    return transport, Check("connection", OK, f"{text}; {UNMEASURED}")


def _route(way: Way) -> Check | None:
    route, peer, told = way.now, way.peer, way.told_later
    if way.direct_only:
        return None
    if route.state in _FLOWING:
        lane = f", {route.lane} lane" if route.lane else ""
        return Check("route", OK, f"open{lane}{', latched' if route.latched else ''}")
    if route.state == "opening" and told is not None and told.route == "opening":
        text = f"{peer}'s agent waits for the publisher {route.node} to answer its connection"
        return Check("route", FAIL, text, f"is that node stopped or stuck? on {peer}: rosnode ping {route.node}")
    if route.state == "opening":
        text = f"{peer} has been asked for it and has not answered"
        return Check("route", FAIL, text, "ask again in a moment; if it stays so, see the log there")
    text = f"{route.state}: {route.problem or 'no node has asked for it yet'}"
    return Check("route", FAIL, text, f"it is tried again by itself; on {peer}: rosnode info {route.node}")


def _sent(way: Way) -> Check:
    told, peer, node = way.told_later, way.peer, way.now.node
    if told is None:
        return Check("sent", UNKNOWN, f"{peer} did not say")
    if told.oversized:
        text = f"{told.oversized} messages of its publisher {node} are too long, the last has "
        text += f"{told.oversized_bytes} bytes, and at most {ros_limits.TCPROS_MESSAGE_MAX} cross"
        text += f"; {told.messages} others came" if told.messages else ""
        return Check("sent", WARN if told.messages else FAIL, text, "send them in parts, or compressed")
    if not told.messages and not way.now.messages:
        text = f"its publisher {node} is connected, and has published nothing since"
        return Check("sent", FAIL, text, f"look at that node; on {peer}: rostopic hz {way.ends.wire}")
    text = f"{told.messages} messages from its publisher so far"
    if told.lost:
        text += f"; {told.lost} of them given up, while {peer} had no link to this module or a slow one"
        return Check("sent", WARN, text, "a longer outage, or more depth, in [[contract]] keeps more")
    if told.dropped:
        text += f"; {told.dropped} dropped there"
        return Check("sent", WARN, text, "the link is slower than the topic")
    return Check("sent", OK, text)


def _arrived(way: Way) -> Check:
    now, told = way.now, way.told_later
    moved = now.messages - way.before.messages
    sent = told.messages - way.told.messages if way.told is not None and told is not None else 0
    rate = float(now.contract.get("max_rate") or core_limits.CONTRACT_RATE_MAX)
    rarely = rate * observe_limits.WHY_WINDOW < _SEVERAL
    if not now.messages or (sent >= _SEVERAL and not moved and not rarely):
        text = f"{way.peer} has {f'sent {sent}' if sent else 'sent some'} meanwhile, and none arrived at "
        text += way.ends.snapshot.agent.name
        text += f" ({told.dropped} were dropped there)" if told is not None and told.dropped else ""
        remedy = "is the link too slow? `rmpa peer info`; a max_rate or priority helps (docs/guides/contracts.md)"
        return Check("arrived", FAIL, text, remedy)
    age, usual = now.age or 0.0, now.period.p99 if now.period is not None else None
    text = f"{now.messages} messages, the last {age:.2f} s ago"
    text += f", {now.rate:.1f} Hz" if now.rate is not None else ""
    silent = max(2.0, 10.0 * (usual or 0.0))  # ten of its longest usual periods
    if usual is not None and not moved and age > silent:
        text = f"nothing for {age:.1f} s; until then a message came every {usual * 1e3:.0f} ms at the latest"
        return Check("arrived", FAIL, text, f"its publisher {now.node} on {way.peer} stopped publishing: look at it")
    if usual is None and not now.latched and age > silent:
        return Check("arrived", WARN, text, "a topic of few messages? it is not known how often they should come")
    return Check("arrived", OK, text)


def _contract(way: Way) -> Check:
    route = way.now
    missing = {key: getattr(route, key) for key in ("lost", "late", "expired") if getattr(route, key)}
    events = {kind: count for kind, count in route.events.items() if kind != "messages_lost"}
    if not missing and not events:
        said = ", ".join(f"{key} {value}" for key, value in route.contract.items())
        return Check("contract", OK, f"kept ({said})" if said else "nothing lost, late or expired")
    parts = [f"{count} {key}" for key, count in missing.items()]
    parts += [f"{kind.replace('_', ' ')} {count} times" for kind, count in events.items()]
    remedy = "`rmpa topic info` shows when; docs/guides/contracts.md what to do"
    if ("lost" in missing or "loss_unknown" in events) and route.contract.get("reliability") == "reliable":
        remedy = "a longer outage, or more depth, in [[contract]] keeps more; `rmpa topic info` shows when"
    return Check("contract", WARN, ", ".join(parts), remedy)


def _reader(way: Way) -> Check:
    after = way.readers_later
    if not after:
        return Check("reader", FAIL, "its subscribers have just left", "start them again")
    waited = {number: waiting for number, (_, waiting, _) in way.here.readers.items()}
    stuck = [one for number, one in after.items() if one[1] and waited.get(number, one[1])]
    remedy = "its callbacks are too slow, or it is stopped; no other subscriber waits for it"
    if stuck:
        names = ", ".join(f"{node} ({waiting} B wait, {dropped} dropped)" for node, waiting, dropped in stuck)
        if len(stuck) == len(after):
            return Check("reader", FAIL, f"{names} does not read", remedy)
        return Check("reader", WARN, f"{names} does not keep up; others do", remedy)
    if slow := [f"{node} has missed {dropped}" for node, _, dropped in after.values() if dropped]:
        return Check("reader", WARN, ", ".join(slow), remedy)
    return Check("reader", OK, f"{', '.join(dict.fromkeys(node for node, *_ in after.values()))} takes them")


# The stages of one publisher, in order. The walk ends at the first that fails.
STAGES: Final[tuple[Callable[[Way], Check | None], ...]] = (
    *(_policy_there, _permission_there, _reachable, _offer, _limit, _policy_here, _permission_here, _type, _graph),
    *(_subscriber, _md5, _transport, _connection, _route),
)
# Those that follow where the route is open, and messages pass the agents.
FLOW_STAGES: Final[tuple[Callable[[Way], Check], ...]] = (_sent, _arrived, _contract, _reader)
