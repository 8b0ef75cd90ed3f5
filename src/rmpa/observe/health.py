"""Judges snapshots as statuses of ``/diagnostics``, and publishes them.

Judges snapshots: how the agent, its links and the topics that cross them are.

Levels are those of REP 107. STALE marks what existed before and is gone, such as a lost peer and its topics.
"""

from __future__ import annotations

import logging
from collections import Counter
from typing import TYPE_CHECKING, Final

from rmpa.core.counters import remedy
from rmpa.observe import limits
from rmpa.observe.peer_info import FAIL, OK, STALE, WARN, Check
from rmpa.observe.why.diagnosis import BY_RULE, misplaced, subscriber_text
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.types.definitions import (
    ARRAY_TYPE,
    DiagnosticLevel,
    DiagnosticStatus,
    frame_array,
    known_description,
)
from rmpa.runtime.loop import SystemClock, call_at_tick, yield_to_data

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Iterator, Mapping

    from rmpa.bridge.bridge import Bridge
    from rmpa.observe.peer_info import CheckLevel, PeerInfo
    from rmpa.observe.snapshot import RouteInfo, SampleSpread, ServiceInfo, Snapshot, SubscriberTransport, TopicInfo
    from rmpa.observe.snapshot_builder import SnapshotBuilder
    from rmpa.ros.core.external import Core


# The evidence of each health check: figures as text, their units in the keys, so that rqt can plot them.


def number(value: float | None, scale: float = 1.0) -> str:
    """Six significant digits; empty for ``None``."""
    return "" if value is None else f"{value * scale:.6g}"


def agent_values(snapshot: Snapshot, linked: int) -> dict[str, str]:
    """The agent's own figures, and its counters by name."""
    agent = snapshot.agent
    known = {
        "name": agent.name,
        "GUID": agent.guid,
        "domain": str(agent.domain),
        "ROS core": agent.core_uri,
        "core memory": agent.core_memory,
        "version": agent.version,
        "uptime (s)": number(agent.uptime),
        "CPU (%)": number(agent.cpu),
        "memory (MB)": number(agent.rss, 1e-6),
        "open files": str(agent.files.open) if agent.files else "",
        "limit of open files": str(agent.files.limit) if agent.files else "",
        "peers": str(len(snapshot.peers)),
        "linked": str(linked),
        "proxies": str(agent.proxies),
        "proxies' listening sockets": str(agent.proxy_sockets),
        "real time": "; ".join(agent.realtime),
        "certificate (h left)": number(snapshot.trust.expires - snapshot.taken, 1 / 3600) if snapshot.trust else "",
    }
    return _known(known) | {f"count {name}": str(count) for name, count in snapshot.counters.items()}


def link_values(info: PeerInfo) -> dict[str, str]:
    """The figures of a peer and its link."""
    known = {"state": info.state, "GUID": info.guid, "address": ", ".join(info.addresses)}
    link = info.link
    if link is not None:
        known |= {
            "up (s)": number(link.up_ago),
            "heard (ms ago)": number(link.heard_ago, 1e3),
            "pace": "at rest" if link.rests else "in use",
            "round trip (ms)": number(link.rtt, 1e3),
            "clock offset (ms)": number(link.clock_offset, 1e3),
            "clock error (± ms)": number(link.clock_error, 1e3),
            "bytes in": str(link.bytes_in),
            "bytes out": str(link.bytes_out),
            "queued (B)": str(link.queued),
            "dropped": str(link.dropped),
            "topics in": str(info.topics_in),
            "topics out": str(info.topics_out),
        }
    for bound in info.beyond:
        known[f"{bound.kind} hidden here (limit {bound.limit})"] = str(bound.hidden)
    return _known(known)


def service_values(info: ServiceInfo) -> dict[str, str]:
    """The figures of a service's calls across the mesh."""
    known = {
        "node": info.node,
        "state": info.state,
        "type": info.type,
        "calls": str(info.calls),
        "failed": str(info.failed),
        "under way": str(info.active),
        "last problem": info.problem,
    }
    return _known(known | _milliseconds("latency", info.latency, "p50", "p99", "max"))


def route_values(route: RouteInfo) -> dict[str, str]:
    """The figures of one source of a topic."""
    period, latency = route.period, route.latency
    known = {
        "node": route.node,
        "type": route.type,
        "state": route.state,
        "transport": route.transport,
        "relayed by": route.condition if route.condition != BY_RULE else "",
        "lane": route.lane,
        "rate (Hz)": number(route.rate),
        "bandwidth (B/s)": number(route.bandwidth),
        "age (s)": number(route.age),
    }
    if period is not None:
        known |= _milliseconds("period", period, "mean", "sd", "min", "max", "p99")
        known["jitter (ms)"] = number(route.jitter, 1e3)
    if latency is not None:
        known |= _milliseconds("latency", latency, "p50", "p99", "max", "last")
        known["latency error (± ms)"] = number(latency.error, 1e3)
    if route.direction == "out":
        known |= {"waiting": str(route.kept)}
    if route.oversized:
        known |= {"too long": str(route.oversized), "too long, last (B)": str(route.oversized_bytes)}
    if route.messages or route.dropped or route.lost:
        counted = ("messages", "lost", "late", "expired", "dropped")
        known |= {name: str(getattr(route, name)) for name in counted}
    for one in route.subscribers:
        known |= _direct_values(one)
    known |= {f"contract {key}": str(value) for key, value in route.contract.items()}
    known |= {f"events {kind}": str(count) for kind, count in route.events.items()}
    return _known(known)


def _direct_values(one: SubscriberTransport) -> dict[str, str]:
    """What is known of a subscriber that is connected directly."""
    if one.transport != "direct":
        return {}
    known = {"to": one.endpoint, "since (s)": number(one.since_ago), "interruptions": str(one.interruptions or "")}
    return {f"direct {one.node} {key}": value for key, value in known.items()}


def _milliseconds(what: str, spread: SampleSpread | None, *fields: str) -> dict[str, str]:
    if spread is None:
        return {}
    return {f"{what} {field} (ms)": number(getattr(spread, field), 1e3) for field in fields}


def _known(values: dict[str, str]) -> dict[str, str]:
    return {key: value for key, value in values.items() if value}


HERE: Final = "rmpa: this module"
"""The name of the agent's own status."""
_LINKED: Final = "linked"
_UNKNOWN: Final = "loss_unknown"
_LOST, _RESTORED, _DEADLINE = "liveliness_lost", "liveliness_restored", "deadline_missed"
_MISSES: Final = {
    "lost": "lost",
    "late": "late",
    "expired": "beyond their lifespan",
    "dropped": "dropped for a slow receiver",
    "oversized": "left out, too long to cross",
    _UNKNOWN: "times an unknown number lost",
    _DEADLINE: "deadlines missed",
}
_LEVELS: Final = {
    OK: DiagnosticLevel.OK,
    WARN: DiagnosticLevel.WARN,
    FAIL: DiagnosticLevel.ERROR,
    STALE: DiagnosticLevel.STALE,
}


def diagnostic_status(check: Check, module: str) -> DiagnosticStatus:
    """A check as an element of ``/diagnostics``; ``module`` is the agent's name, which stands as hardware id."""
    return DiagnosticStatus(_LEVELS[check.level], check.name, check.message, module, check.evidence)


class Health:
    """Judges snapshots in turn, and compares each with the one before it to find what is new."""

    def __init__(self) -> None:
        self._counts: dict[str, Counter[str]] = {}
        """The counts of the last snapshot, by the check's name."""
        self._linked: dict[str, float] = {}
        """When each peer was last linked, by name; forgotten after ``limits.DIAGNOSTICS_STALE``."""
        self._topics: dict[str, set[str]] = {}
        """The names of the checks of each peer's topics."""

    def judge(self, snapshot: Snapshot, now: float) -> Iterator[Check]:
        """One check for the agent, each peer, each topic that comes from a peer or that a peer cannot take.

        And one for each node that cannot be reached and each service that was called across the mesh. All names
        differ.

        Args:
            snapshot: With all topics and services.
            now: Monotonic seconds.
        """
        counts: dict[str, Counter[str]] = {}
        peers = _by_name(snapshot.peers)
        yield _agent(snapshot)
        for name, info in peers.items():
            if info.state == _LINKED:
                self._linked[name] = now
                self._topics[name] = set()
            counts[name] = Counter(dropped=info.link.dropped if info.link else 0)
            yield _peer(name, info, self._new(name, counts[name]), was_linked=name in self._linked)
        for name, topic, route in _incoming(snapshot.topics):
            if route.peer not in peers or peers[route.peer].state != _LINKED:
                continue  # the route waits for its peer: stale, like everything of that peer
            counts[name] = _missing(route)
            self._topics.setdefault(route.peer, set()).add(name)
            level, text = _judge_route(topic, route, self._new(name, counts[name]))
            yield Check(name, level, text, evidence=route_values(route))
        for name, route in _outgoing(snapshot.topics):
            counts[name] = Counter(lost=route.lost, oversized=route.oversized)
            # The last snapshot did not have this check, so no messages were missed before.
            before = self._counts.get(name, Counter()) if self._counts else counts[name]
            yield _sent(name, route, counts[name] - before)
        yield from _refused(snapshot)
        for node in snapshot.unreachable:
            values = {"unreachable for (s)": number(node.ago)}
            yield Check(f"rmpa: node {node.node}", WARN, str(node), evidence=values)
        for service in snapshot.services:
            if service.calls:
                name = f"rmpa: {service.peer}: " if service.peer else "rmpa: "
                name += f"service {service.name}"
                counts[name] = Counter(calls=service.calls, failed=service.failed)
                yield _service(name, service, self._new(name, counts[name]))
        yield from self._stale(peers, now)
        self._counts = counts

    def _new(self, name: str, counts: Counter[str]) -> Counter[str]:
        """The counts since the last snapshot; empty if that snapshot did not have this check."""
        return counts - self._counts.get(name, counts)

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
            text = f"{name} is gone" if info is None else f"no link to {name}"
            values = {"linked before (s)": number(now - last)}
            if info is None:
                yield Check(f"rmpa: {name}", STALE, text, evidence=values)
            for topic in sorted(self._topics.get(name, ())):
                yield Check(topic, STALE, text, evidence=values)


def _by_name(peers: tuple[PeerInfo, ...]) -> dict[str, PeerInfo]:
    """Peers by unique names, without the old entry of a peer that is back under another GUID."""
    found: dict[str, PeerInfo] = {}
    for info in sorted(peers, key=lambda info: (info.state != _LINKED, info.guid)):
        if info.name not in found:
            found[info.name] = info
        elif info.state in (_LINKED, "conflict"):
            found[f"{info.name} ({info.guid})"] = info
    return found


class _UniqueNames:
    """Numbers repeated names: ``x``, ``x #2``, ``x #3``."""

    def __init__(self) -> None:
        self._taken: Counter[str] = Counter()

    def __call__(self, name: str) -> str:
        self._taken[name] += 1
        return name if self._taken[name] == 1 else f"{name} #{self._taken[name]}"


def _incoming(topics: tuple[TopicInfo, ...]) -> Iterator[tuple[str, TopicInfo, RouteInfo]]:
    """The routes from peers, each with the unique name of its check."""
    for topic in topics:
        sources = [route for route in topic.routes if route.direction == "in"]
        several = Counter(route.peer for route in sources)
        unique = _UniqueNames()
        for route in sources:
            node = f" ({route.node})" if several[route.peer] > 1 else ""
            yield unique(f"rmpa: {route.peer}: {topic.name}{node}"), topic, route


def _outgoing(topics: tuple[TopicInfo, ...]) -> Iterator[tuple[str, RouteInfo]]:
    """The routes to peers that miss, or may miss, messages, each with the unique name of its check."""
    unique = _UniqueNames()
    for topic in topics:
        for route in topic.routes:
            if route.direction == "out" and (route.state == "away" or route.lost or route.oversized):
                yield unique(f"rmpa: to {route.peer}: {topic.name} ({route.node})"), route


def _sent(name: str, route: RouteInfo, new: Counter[str]) -> Check:
    """The messages that a peer misses: a warning if a count has grown, or if the peer is away and some are lost."""
    texts = [route.problem] if route.problem else []
    texts += [f"{count} {_MISSES[kind]}" for kind, count in new.items()]
    if route.lost and not new["lost"]:
        texts.append(f"{route.lost} messages lost to it until now")
    level = WARN if new or (route.state == "away" and route.lost) else OK
    return Check(name, level, "; ".join(texts) or "nothing is missed", evidence=route_values(route))


def _refused(snapshot: Snapshot) -> Iterator[Check]:
    """Local topics that do not fit a subscriber elsewhere; a topic of a peer has a check already."""
    for topic in snapshot.topics:
        if topic.mismatches and not any(route.direction == "in" for route in topic.routes):
            yield Check(f"rmpa: {topic.name}", FAIL, "; ".join(topic.mismatches))


def _service(name: str, info: ServiceInfo, new: Counter[str]) -> Check:
    """A service that was called. New failures are one warning, because a server may fail calls on purpose."""
    if new["failed"]:
        level, text = WARN, f"{new['failed']} of {new['calls']} calls failed: {info.problem}"
    else:
        level, text = OK, f"{new['calls']} calls" + (f", {info.active} under way" if info.active else "")
    return Check(name, level, text, evidence=service_values(info))


def _missing(route: RouteInfo) -> Counter[str]:
    return Counter(
        lost=route.lost,
        late=route.late,
        expired=route.expired,
        dropped=route.dropped,
        oversized=route.oversized,
        deadline_missed=route.events.get(_DEADLINE, 0),
        loss_unknown=route.events.get(_UNKNOWN, 0),
    )


def _agent(snapshot: Snapshot) -> Check:
    linked = sum(info.state == _LINKED for info in snapshot.peers)
    notes, files = list(snapshot.notes), snapshot.agent.files
    if files is not None and files.near and not files.problem:
        notes.append(f"{files.open} of {files.limit} file descriptors are open; {remedy(snapshot.agent.pid)}")
    level = FAIL if files is not None and files.problem else WARN if notes else OK
    text = "; ".join(notes) or f"{linked} of {len(snapshot.peers)} known peers linked"
    return Check(HERE, level, text, evidence=agent_values(snapshot, linked))


def _peer(name: str, info: PeerInfo, new: Counter[str], *, was_linked: bool) -> Check:
    level, text = _judge_peer(info, new["dropped"], was_linked=was_linked)
    return Check(f"rmpa: {name}", level, text, evidence=link_values(info))


def _judge_peer(info: PeerInfo, dropped: int, *, was_linked: bool) -> tuple[CheckLevel, str]:
    """The worst present state of a peer; ``dropped`` is the number of messages dropped since the last snapshot."""
    link = info.link
    if info.state == _LINKED and link is not None:
        if dropped:
            return WARN, f"{dropped} messages dropped: the link takes them too slowly"
        troubles = [*info.conflicts, *(bound.text for bound in info.beyond)]
        if troubles:
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
        return WARN, "; ".join(subscriber_text(one) for one in troubled)
    deadline = route.contract.get("deadline")
    if isinstance(deadline, float) and route.age is not None and route.age > deadline:
        return WARN, f"no message for {route.age:.3g} s; deadline {deadline:.3g} s"
    if any(new.values()):
        return WARN, ", ".join(f"{count} {_MISSES[kind]}" for kind, count in new.items() if count)
    return OK, _flowing(route)


def _flowing(route: RouteInfo) -> str:
    direct = [subscriber_text(one) for one in route.subscribers if one.transport == "direct"]
    if direct and route.transport == "direct":
        return "; ".join(direct)
    return "; ".join([_relayed(route), *direct])


def _relayed(route: RouteInfo) -> str:
    if route.state == "idle":
        return "no node here subscribes"
    if route.rate is None:
        return f"{route.state}, last message {route.age:.3g} s ago" if route.age is not None else route.state
    latency = f", {route.latency.p50 * 1e3:.2f} ms" if route.latency is not None else ""
    return f"{route.rate:.1f} Hz{latency}"


# Publishes the agent's health on ``/diagnostics`` once a second (REP 107).
#
# The agent's own node publishes it, so it does not cross to other modules. Without a subscriber nothing is built.


_log = logging.getLogger(__name__)

TOPIC: Final = "/diagnostics"
_ARRAY: Final = known_description(ARRAY_TYPE)
"""The topic of REP 107."""


class Diagnostics(PublicationEvents):
    """Publishes judged snapshots; follows the peers' clocks as often, and seldom while no link is in use.

    Args:
        core: The local core.
        bridge: Has the node that publishes; started before.
        snapshots: Builds what is judged.
    """

    def __init__(self, core: Core, bridge: Bridge, snapshots: SnapshotBuilder) -> None:
        self._core = core
        self._bridge = bridge
        self._snapshots = snapshots
        self._clock = SystemClock()
        self._health = Health()
        self._sequence = 0
        self._publication = Publication(
            TOPIC,
            bridge.node.name,
            _ARRAY,
            queue_messages=limits.DIAGNOSTICS_QUEUE,
            events=self,
        )
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Advertise, and publish once a second."""
        node = self._bridge.node
        node.add_publication(self._publication)
        code, text, _ = self._core.call("registerPublisher", node.name, TOPIC, ARRAY_TYPE, node.uri)
        if code != 1:
            _log.error("! the local core does not take %s: %s", TOPIC, text)
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
        self._timer = call_at_tick(limits.DIAGNOSTICS_INTERVAL if used else limits.CLOCKS_IDLE_INTERVAL, self._look)

    def first_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        if self._timer is not None:
            self._timer.cancel()
            self._again()

    def _look(self) -> None:
        self._again()
        self._snapshots.topics.follow_clocks()
        if self._publication.subscribers:
            self._publish()

    def _publish(self) -> None:
        self._sequence += 1
        snapshot, parts = self._snapshots.build(most=limits.DIAGNOSTICS_TOPICS), []
        for check in self._health.judge(snapshot, self._clock.now()):
            parts.append(diagnostic_status(check, snapshot.agent.name).serialize())
            yield_to_data()
        self._publication.publish_framed(frame_array(self._sequence, self._clock.wall_ns(), parts))
