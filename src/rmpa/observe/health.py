"""Judges snapshots as statuses of ``/diagnostics``, and publishes them: the agent, its links, what crosses them.

Levels are those of REP 107. STALE marks what existed before and is gone, such as a lost peer and its topics.
"""

from __future__ import annotations

import logging
from collections import Counter
from operator import attrgetter
from typing import TYPE_CHECKING, Final

from rmpa.observe import limits
from rmpa.observe.check import FAIL, OK, STALE, WARN, Check, CheckLevel
from rmpa.observe.why.diagnosis import BY_RULE, connected_directly, misplaced, subscriber_text
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel, DiagnosticStatus, frame_array, known_description
from rmpa.runtime.accept import open_files_advice
from rmpa.runtime.loop import SystemClock, call_at_tick, yield_to_data

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from rmpa.bridge.facts import BridgeFacts
    from rmpa.core.facts import RouteInfo, ServiceInfo, TopicInfo
    from rmpa.core.statistics import SampleSpread
    from rmpa.observe.snapshot import PeerInfo, Snapshot
    from rmpa.observe.snapshot_builder import SnapshotBuilder


_log = logging.getLogger(__name__)

# The topic of REP 107.
TOPIC: Final = "/diagnostics"
_ARRAY: Final = known_description(ARRAY_TYPE)
# The figures of a status by their name, with their unit, so that rqt can plot them; what is empty or ``None`` is left
# out.
Values = dict[str, str | float | None]


def _texts(*values: Values) -> dict[str, str]:
    """Figures as text, with six significant digits."""
    found = {}
    for part in values:
        for name, value in part.items():
            if isinstance(value, float):
                found[name] = f"{value:.6g}"
            elif value is not None and value != "":
                found[name] = str(value)
    return found


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else value * scale


def _milliseconds(what: str, spread: SampleSpread | None, *fields: str) -> Values:
    return {} if spread is None else {f"{what} {field} (ms)": getattr(spread, field) * 1e3 for field in fields}


def agent_values(snapshot: Snapshot, linked: int) -> dict[str, str]:
    """The agent's own figures, and its counters by name."""
    agent, trust, files = snapshot.agent, snapshot.trust, snapshot.agent.files
    known: Values = {
        "name": agent.name,
        "GUID": agent.guid,
        "domain": agent.domain,
        "ROS core": agent.core_uri,
        "core memory": agent.core_memory,
        "version": agent.version,
        "uptime (s)": agent.uptime,
        "CPU (%)": agent.cpu,
        "memory (MB)": _scaled(agent.rss, 1e-6),
        "open files": files.open if files else None,
        "limit of open files": files.limit if files else None,
        "peers": len(snapshot.peers),
        "linked": linked,
        "proxies": agent.proxies,
        "proxies' listening sockets": agent.proxy_sockets,
        "real time": "; ".join(agent.realtime),
        "certificate (h left)": (trust.expires - snapshot.taken) / 3600 if trust else None,
    }
    return _texts(known, {f"count {name}": count for name, count in snapshot.counters.items()})


def link_values(info: PeerInfo) -> dict[str, str]:
    """The figures of a peer and its link."""
    known: Values = {"state": info.state, "GUID": info.guid, "address": ", ".join(info.addresses)}
    if (link := info.link) is not None:
        known |= {
            "up (s)": link.up_ago,
            "heard (ms ago)": _scaled(link.heard_ago, 1e3),
            "pace": "at rest" if link.rests else "in use",
            "round trip (ms)": _scaled(link.rtt, 1e3),
            "clock offset (ms)": _scaled(link.clock_offset, 1e3),
            "clock error (± ms)": _scaled(link.clock_error, 1e3),
            "bytes in": link.bytes_in,
            "bytes out": link.bytes_out,
            "queued (B)": link.queued,
            "dropped": link.dropped,
            "topics in": info.topics_in,
            "topics out": info.topics_out,
        }
    return _texts(known, {f"{at.kind} hidden here (limit {at.limit})": at.hidden for at in info.beyond})


def service_values(info: ServiceInfo) -> dict[str, str]:
    """The figures of a service's calls across the mesh."""
    known: Values = {name: getattr(info, name) for name in ("node", "state", "type", "calls", "failed")}
    known |= {"under way": info.active, "last problem": info.problem}
    return _texts(known, _milliseconds("latency", info.latency, "p50", "p99", "max"))


def route_values(route: RouteInfo) -> dict[str, str]:
    """The figures of one source of a topic."""
    known: Values = {
        "node": route.node,
        "type": route.type,
        "state": route.state,
        "transport": route.transport,
        "relayed by": route.condition if route.condition != BY_RULE else "",
        "lane": route.lane,
        "rate (Hz)": route.rate,
        "bandwidth (B/s)": route.bandwidth,
        "age (s)": route.age,
    }
    if route.period is not None:
        known |= _milliseconds("period", route.period, "mean", "sd", "min", "max", "p99")
        known["jitter (ms)"] = _scaled(route.jitter, 1e3)
    if route.latency is not None:
        known |= _milliseconds("latency", route.latency, "p50", "p99", "max", "last")
        known["latency error (± ms)"] = route.latency.error * 1e3
    if route.direction == "out":
        known["waiting"] = route.kept
    if route.oversized:
        known |= {"too long": route.oversized, "too long, last (B)": route.oversized_bytes}
    if route.messages or route.dropped or route.lost:
        known |= {name: getattr(route, name) for name in ("messages", "lost", "late", "expired", "dropped")}
    for one in connected_directly(route):
        what = f"direct {one.node}"
        known |= {f"{what} to": one.endpoint, f"{what} since (s)": one.since_ago}
        known[f"{what} interruptions"] = one.interruptions or None
    contract: Values = {f"contract {key}": str(value) for key, value in route.contract.items()}
    return _texts(known, contract, {f"events {kind}": count for kind, count in route.events.items()})


# The name of the agent's own status.
HERE: Final = "rmpa: this module"
_LINKED: Final = "linked"
_LOST, _RESTORED = "liveliness_lost", "liveliness_restored"
_COUNTS: Final = ("lost", "late", "expired", "dropped", "oversized")
_counts = attrgetter(*_COUNTS)
_MISSES: Final = {
    "lost": "lost",
    "late": "late",
    "expired": "beyond their lifespan",
    "dropped": "dropped for a slow receiver",
    "oversized": "left out, too long to cross",
    "loss_unknown": "times an unknown number lost",
    "deadline_missed": "deadlines missed",
}
_LEVELS: Final = {
    OK: DiagnosticLevel.OK,
    WARN: DiagnosticLevel.WARN,
    FAIL: DiagnosticLevel.ERROR,
    STALE: DiagnosticLevel.STALE,
}


def diagnostic_status(check: Check, module: str) -> DiagnosticStatus:
    """A check as an element of ``/diagnostics``; ``module`` is the agent's name, which stands as hardware id."""
    evidence = check.evidence | ({"code": check.code} if check.code else {})
    return DiagnosticStatus(_LEVELS[check.level], check.name, check.message, module, evidence)


class Health:
    """Judges snapshots in turn, and compares each with the one before it to find what is new."""

    def __init__(self) -> None:
        # The counts of the last snapshot, by the check's name.
        self._counts: dict[str, dict[str, int]] | None = None
        # When each peer was last linked, by name; forgotten after ``limits.DIAGNOSTICS_STALE``.
        self._linked: dict[str, float] = {}
        # The names of the checks of each peer's topics.
        self._topics: dict[str, set[str]] = {}

    def judge(self, snapshot: Snapshot, now: float) -> Iterator[Check]:
        """One check for the agent, each peer, each topic that comes from a peer or that a peer cannot take.

        And one for each node that cannot be reached and each service that was called across the mesh. All names
        differ.

        Args:
            snapshot: With all topics and services.
            now: Monotonic seconds.
        """
        before, counts = self._counts, dict[str, dict[str, int]]()

        def new(name: str, present: dict[str, int]) -> Counter[str]:
            """The counts since the last snapshot; none if that snapshot did not have this check."""
            counts[name] = present
            was = (before or {}).get(name, present)
            return Counter(present) - Counter(was) if was != present else Counter()

        peers = _by_name(snapshot.peers)
        yield _agent(snapshot)
        for name, info in peers.items():
            if info.state == _LINKED:
                self._linked[name] = now
                self._topics[name] = set()
            dropped = new(name, {"dropped": info.link.dropped if info.link else 0})["dropped"]
            level, text = _judge_peer(info, dropped, was_linked=name in self._linked)
            yield Check(f"rmpa: {name}", level, text, evidence=link_values(info))
        for name, topic, route in _incoming(snapshot.topics):
            if route.peer in peers and peers[route.peer].state == _LINKED:
                # Else the route waits for its peer: stale, like everything of that peer.
                missed = dict(zip(_COUNTS, _counts(route), strict=True))
                missed |= {kind: count for kind, count in route.events.items() if kind in _MISSES}
                self._topics.setdefault(route.peer, set()).add(name)
                level, text = _judge_route(topic, route, new(name, missed))
                yield Check(name, level, text, evidence=route_values(route))
        for name, route in _outgoing(snapshot.topics):
            counts[name] = {"lost": route.lost, "oversized": route.oversized}
            # A snapshot that did not have this check had missed no messages.
            was = (counts if before is None else before).get(name, {})
            yield _sent(name, route, Counter(counts[name]) - Counter(was))
        yield from _troubles(snapshot)
        yield from _called(snapshot.services, new)
        yield from self._stale(peers, now)
        self._counts = counts

    def _stale(self, peers: Mapping[str, PeerInfo], now: float) -> Iterator[Check]:
        """Peers that are gone, and the topics of those that are not linked."""
        for name, last in list(self._linked.items()):
            info = peers.get(name)
            if info is not None and info.state == _LINKED:
                continue
            if now - last > limits.DIAGNOSTICS_STALE:
                del self._linked[name]
                self._topics.pop(name, None)
                continue
            text, values = f"no link to {name}", _texts({"linked before (s)": now - last})
            if info is None:
                text = f"{name} is gone"
                yield Check(f"rmpa: {name}", STALE, text, evidence=values)
            for topic in sorted(self._topics.get(name, ())):
                yield Check(topic, STALE, text, evidence=values)


def _troubles(snapshot: Snapshot) -> Iterator[Check]:
    """Local topics that do not fit a subscriber elsewhere, and nodes that cannot be reached."""
    for topic in snapshot.topics:  # of a peer's topic its own check says it
        if topic.mismatches and not any(route.direction == "in" for route in topic.routes):
            yield Check(f"rmpa: {topic.name}", FAIL, "; ".join(topic.mismatches))
    for node in snapshot.unreachable:
        values = _texts({"unreachable for (s)": node.ago})
        yield Check(f"rmpa: node {node.node}", WARN, str(node), evidence=values)


def _called(services: Iterable[ServiceInfo], new: Callable[[str, dict[str, int]], Counter[str]]) -> Iterator[Check]:
    """The services that were called. New failures are one warning: a server may fail calls on purpose."""
    for service in services:
        if service.calls:
            name = f"rmpa: {f'{service.peer}: ' if service.peer else ''}service {service.name}"
            count = new(name, {"calls": service.calls, "failed": service.failed})
            text = f"{count['calls']} calls" + (f", {service.active} under way" if service.active else "")
            if count["failed"]:
                text = f"{count['failed']} of {count['calls']} calls failed: {service.problem}"
            yield Check(name, WARN if count["failed"] else OK, text, evidence=service_values(service))


def _by_name(peers: tuple[PeerInfo, ...]) -> dict[str, PeerInfo]:
    """Peers by unique names, without the old entry of a peer that is back under another GUID."""
    found: dict[str, PeerInfo] = {}
    for info in sorted(peers, key=lambda info: (info.state != _LINKED, info.guid)):
        if info.name not in found:
            found[info.name] = info
        elif info.state in (_LINKED, "conflict"):
            found[f"{info.name} ({info.guid})"] = info
    return found


def _numbered(name: str, taken: Counter[str]) -> str:
    """A name that was not taken before: ``x``, ``x #2``, ``x #3``."""
    taken[name] += 1
    return name if taken[name] == 1 else f"{name} #{taken[name]}"


def _incoming(topics: tuple[TopicInfo, ...]) -> Iterator[tuple[str, TopicInfo, RouteInfo]]:
    """The routes from peers, each with the unique name of its check."""
    taken = Counter[str]()
    for topic in topics:
        sources = [route for route in topic.routes if route.direction == "in"]
        several = Counter(route.peer for route in sources)
        for route in sources:
            node = f" ({route.node})" if several[route.peer] > 1 else ""
            yield _numbered(f"rmpa: {route.peer}: {topic.name}{node}", taken), topic, route


def _outgoing(topics: tuple[TopicInfo, ...]) -> Iterator[tuple[str, RouteInfo]]:
    """The routes to peers that miss, or may miss, messages, each with the unique name of its check."""
    taken = Counter[str]()
    for topic in topics:
        for route in topic.routes:
            if route.direction == "out" and (route.state == "away" or route.lost or route.oversized):
                yield _numbered(f"rmpa: to {route.peer}: {topic.name} ({route.node})", taken), route


def _sent(name: str, route: RouteInfo, new: Counter[str]) -> Check:
    """The messages that a peer misses: a warning if a count has grown, or if the peer is away and some are lost."""
    texts = [route.problem] if route.problem else []
    texts += [f"{count} {_MISSES[kind]}" for kind, count in new.items()]
    if route.lost and not new["lost"]:
        texts.append(f"{route.lost} messages lost to it until now")
    level = WARN if new or (route.state == "away" and route.lost) else OK
    return Check(name, level, "; ".join(texts) or "nothing is missed", evidence=route_values(route))


def _agent(snapshot: Snapshot) -> Check:
    linked = sum(info.state == _LINKED for info in snapshot.peers)
    notes, files = list(snapshot.notes), snapshot.agent.files
    if files is not None and files.near and not files.problem:
        advice = open_files_advice(snapshot.agent.pid)
        notes.append(f"{files.open} of {files.limit} file descriptors are open; {advice}")
    level = FAIL if files is not None and files.problem else WARN if notes else OK
    text = "; ".join(notes) or f"{linked} of {len(snapshot.peers)} known peers linked"
    return Check(HERE, level, text, evidence=agent_values(snapshot, linked))


def _judge_peer(info: PeerInfo, dropped: int, *, was_linked: bool) -> tuple[CheckLevel, str]:
    """The worst present state of a peer; ``dropped`` is the number of messages dropped since the last snapshot."""
    link = info.link
    if info.state == _LINKED and link is not None:
        if dropped:
            return WARN, f"{dropped} messages dropped: the link takes them too slowly"
        if troubles := [*info.conflicts, *(bound.text for bound in info.beyond)]:
            return WARN, "; ".join(troubles)
        return OK, "linked" + (f", round trip {link.rtt * 1e3:.2f} ms" if link.rtt is not None else "")
    if info.state == "relayed":
        return OK, f"relayed: {info.via or 'another peer'} passes on what it publishes"
    if info.state in ("conflict", "refused"):
        return FAIL, "; ".join((*info.conflicts, info.last_error)).strip("; ") or info.state
    return STALE if was_linked else WARN, info.state + (f": {info.last_error}" if info.last_error else "")


def _judge_route(topic: TopicInfo, route: RouteInfo, new: Counter[str]) -> tuple[CheckLevel, str]:
    """The worst present state of a route; ``new`` counts the messages that it missed since the last snapshot."""
    if route.limit:
        return WARN, route.problem  # the peer's own check says it for all of them
    if route.state == "hidden":
        return FAIL, route.problem or "hidden"
    if route.events.get(_LOST, 0) > route.events.get(_RESTORED, 0):
        return FAIL, next((e.text for e in reversed(route.recent) if e.kind == _LOST), "does not live")
    if topic.mismatches:
        return FAIL, "; ".join(topic.mismatches)
    if route.problem:
        return WARN, route.problem
    if troubled := misplaced(route):
        return WARN, "; ".join(map(subscriber_text, troubled))
    deadline = route.contract.get("deadline")
    if isinstance(deadline, float) and route.age is not None and route.age > deadline:
        return WARN, f"no message for {route.age:.3g} s; deadline {deadline:.3g} s"
    if any(new.values()):
        return WARN, ", ".join(f"{count} {_MISSES[kind]}" for kind, count in new.items() if count)
    direct = [*map(subscriber_text, connected_directly(route))]
    relayed = [] if direct and route.transport == "direct" else [_relayed(route)]
    return OK, "; ".join((*relayed, *direct))


def _relayed(route: RouteInfo) -> str:
    if route.state == "idle":
        return "no node here subscribes"
    if route.rate is None:
        return f"{route.state}, last message {route.age:.3g} s ago" if route.age is not None else route.state
    latency = f", {route.latency.p50 * 1e3:.2f} ms" if route.latency is not None else ""
    return f"{route.rate:.1f} Hz{latency}"


class Diagnostics(PublicationEvents):
    """Publishes judged snapshots; follows the peers' clocks as often, and seldom while no link is in use.

    The agent's own node publishes them, so they do not cross to other modules. Without a subscriber nothing is built.

    Args:
        facts: What the bridge tells; its node publishes, and has been started.
        snapshots: Builds what is judged.
    """

    def __init__(self, facts: BridgeFacts, snapshots: SnapshotBuilder) -> None:
        self._facts = facts
        self._bridge, self._core = facts.bridge, facts.bridge.core
        self._snapshots = snapshots
        self._clock = SystemClock()
        self._health = Health()
        self._sequence = 0
        # The queue is short: a newer message repeats all of an older one.
        self._publication = Publication(TOPIC, facts.bridge.node.name, _ARRAY, queue_messages=10, events=self)
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Advertise, and publish once a second."""
        node = self._bridge.node
        node.add_publication(self._publication)
        code, text, _ = self._core.call("registerPublisher", node.name, TOPIC, ARRAY_TYPE, node.uri)
        if code != 1:
            _log.error("! the ROS core does not accept %s: %s [core-refuses]", TOPIC, text)
        self._again()

    def close(self) -> None:
        """Unadvertise."""
        if self._timer is not None:
            self._timer.cancel()
        node = self._bridge.node
        self._core.call("unregisterPublisher", node.name, TOPIC, node.uri)
        node.remove_publication(TOPIC)

    def _again(self) -> None:
        used = self._publication.subscribers or any(not s.link.rests for s in self._bridge.sessions.linked())
        # Once a second as in diagnostic_updater; a link that is used again is noticed by the next look.
        self._timer = call_at_tick(1.0 if used else 5.0, self._look)

    def first_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        if self._timer is not None:
            self._timer.cancel()
            self._again()

    def _look(self) -> None:
        self._again()
        self._facts.topics.follow_clocks()
        if self._publication.subscribers:
            self._publish()

    def _publish(self) -> None:
        self._sequence += 1
        snapshot, parts = self._snapshots.build(most=limits.DIAGNOSTICS_TOPICS), []
        for check in self._health.judge(snapshot, self._clock.now()):
            parts.append(diagnostic_status(check, snapshot.agent.name).serialize())
            yield_to_data()
        self._publication.publish_framed(frame_array(self._sequence, self._clock.wall_ns(), parts))
