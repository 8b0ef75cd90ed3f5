"""How the agent, its links and what comes over them are: snapshots judged by REP 107's levels.

STALE is what was there and is not any more: a peer that is gone, and what came from it.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Final

from rmpa.core.open_files import remedy
from rmpa.observe import limits
from rmpa.observe.health_values import agent_values, link_values, number, route_values, service_values
from rmpa.ros.types.diagnostic_array import DiagnosticLevel, DiagnosticStatus

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rmpa.observe.snapshot import PeerInfo, RouteInfo, ServiceInfo, Snapshot, TopicInfo

HERE: Final = "rmpa: this module"
"""The agent's own status."""
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


class Health:
    """Judges one snapshot after the other; remembers the last one, for what is new in this."""

    def __init__(self) -> None:
        self._counts: dict[str, Counter[str]] = {}
        self._linked: dict[str, float] = {}
        """When each peer was last linked, by name; forgotten after ``limits.DIAGNOSTICS_STALE``."""
        self._topics: dict[str, set[str]] = {}
        """The names of the statuses of what came from each of these."""

    def judge(self, snapshot: Snapshot, now: float) -> Iterator[DiagnosticStatus]:
        """One status for the agent, one for each peer, one for each topic that comes from one or does not fit there.

        And one for each service that was called across the mesh.

        Args:
            snapshot: All of it.
            now: Monotonic seconds.
        """
        here = snapshot.agent.name
        counts: dict[str, Counter[str]] = {}
        peers = _by_name(snapshot.peers)
        yield _agent(snapshot)
        for name, info in peers.items():
            if info.state == _LINKED:
                self._linked[name] = now
                self._topics[name] = set()
            counts[name] = Counter(dropped=info.link.dropped if info.link else 0)
            yield _peer(name, here, info, self._new(name, counts[name]), was_linked=name in self._linked)
        for name, topic, route in _named(snapshot.topics):
            if route.peer not in peers or peers[route.peer].state != _LINKED:
                continue  # it waits for its peer: stale, as all that came from it
            counts[name] = _missing(route)
            self._topics.setdefault(route.peer, set()).add(name)
            yield _route(name, here, topic, route, self._new(name, counts[name]))
        for name, route in _outgoing(snapshot.topics):
            counts[name] = Counter(lost=route.lost, oversized=route.oversized)
            # A status that was not there before: nothing was missed then.
            before = self._counts.get(name, Counter()) if self._counts else counts[name]
            yield _sent(name, here, route, counts[name] - before)
        yield from _refused(snapshot, here)
        for node in snapshot.unreachable:
            values = {"unreachable for (s)": number(node.ago)}
            yield DiagnosticStatus(DiagnosticLevel.WARN, f"rmpa: node {node.node}", str(node), here, values)
        for service in snapshot.services:
            if service.calls:
                name = f"rmpa: {service.peer}: " if service.peer else "rmpa: "
                name += f"service {service.name}"
                counts[name] = Counter(calls=service.calls, failed=service.failed)
                yield _service(name, here, service, self._new(name, counts[name]))
        yield from self._stale(peers, here, now)
        self._counts = counts

    def _new(self, name: str, counts: Counter[str]) -> Counter[str]:
        """What was counted since the snapshot before; nothing for who was not in it."""
        return counts - self._counts.get(name, counts)

    def _stale(self, peers: dict[str, PeerInfo], here: str, now: float) -> Iterator[DiagnosticStatus]:
        """Peers that are gone, and what came from those that are not linked."""
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
                yield DiagnosticStatus(DiagnosticLevel.STALE, f"rmpa: {name}", text, here, values)
            for topic in sorted(self._topics.get(name, ())):
                yield DiagnosticStatus(DiagnosticLevel.STALE, topic, text, here, values)


def _by_name(peers: tuple[PeerInfo, ...]) -> dict[str, PeerInfo]:
    """Peers by unique names; the ghost of one that is back under another GUID is left out."""
    found: dict[str, PeerInfo] = {}
    for info in sorted(peers, key=lambda info: (info.state != _LINKED, info.guid)):
        if info.name not in found:
            found[info.name] = info
        elif info.state in (_LINKED, "conflict"):
            found[f"{info.name} ({info.guid})"] = info
    return found


def _named(topics: tuple[TopicInfo, ...]) -> Iterator[tuple[str, TopicInfo, RouteInfo]]:
    """What comes from peers, each with its status's name, which must be unique."""
    for topic in topics:
        sources = [route for route in topic.routes if route.direction == "in"]
        several = Counter(route.peer for route in sources)
        taken: Counter[str] = Counter()
        for route in sources:
            name = f"rmpa: {route.peer}: {topic.name}" + (f" ({route.node})" if several[route.peer] > 1 else "")
            taken[name] += 1
            yield name if taken[name] == 1 else f"{name} #{taken[name]}", topic, route


def _outgoing(topics: tuple[TopicInfo, ...]) -> Iterator[tuple[str, RouteInfo]]:
    """What peers miss, or may miss, of what goes to them, each with its status's name, which must be unique."""
    taken: Counter[str] = Counter()
    for topic in topics:
        for route in topic.routes:
            if route.direction == "out" and (route.state == "away" or route.lost or route.oversized):
                name = f"rmpa: to {route.peer}: {topic.name} ({route.node})"
                taken[name] += 1
                yield name if taken[name] == 1 else f"{name} #{taken[name]}", route


def _sent(name: str, here: str, route: RouteInfo, new: Counter[str]) -> DiagnosticStatus:
    """What a peer misses: worth a warning while it is away, and when it has become more."""
    texts = [route.problem] if route.problem else []
    texts += [f"{count} {_MISSES[kind]}" for kind, count in new.items()]
    if route.lost and not new["lost"]:
        texts.append(f"{route.lost} messages lost to it until now")
    level = DiagnosticLevel.WARN if new or (route.state == "away" and route.lost) else DiagnosticLevel.OK
    return DiagnosticStatus(level, name, "; ".join(texts) or "nothing is missed", here, route_values(route))


def _refused(snapshot: Snapshot, here: str) -> Iterator[DiagnosticStatus]:
    """Our own topics that somebody elsewhere could not take; one that comes from a peer has a status already."""
    for topic in snapshot.topics:
        if topic.mismatches and not any(route.direction == "in" for route in topic.routes):
            yield DiagnosticStatus(
                DiagnosticLevel.ERROR, f"rmpa: {topic.name}", "; ".join(topic.mismatches), here, {}
            )


def _service(name: str, here: str, info: ServiceInfo, new: Counter[str]) -> DiagnosticStatus:
    """A service that was called; its failures are told once, for they may be the server's own words."""
    if new["failed"]:
        level, text = DiagnosticLevel.WARN, f"{new['failed']} of {new['calls']} calls failed: {info.problem}"
    else:
        level, text = (
            DiagnosticLevel.OK,
            f"{new['calls']} calls" + (f", {info.active} under way" if info.active else ""),
        )
    return DiagnosticStatus(level, name, text, here, service_values(info))


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


def _agent(snapshot: Snapshot) -> DiagnosticStatus:
    linked = sum(info.state == _LINKED for info in snapshot.peers)
    notes, files = list(snapshot.notes), snapshot.agent.files
    if files is not None and files.near and not files.problem:
        notes.append(f"{files.open} of {files.limit} file descriptors are open; {remedy(snapshot.agent.pid)}")
    level = DiagnosticLevel.WARN if notes else DiagnosticLevel.OK
    if files is not None and files.problem:
        level = DiagnosticLevel.ERROR
    text = "; ".join(notes) or f"{linked} of {len(snapshot.peers)} known peers linked"
    return DiagnosticStatus(level, HERE, text, snapshot.agent.name, agent_values(snapshot, linked))


def _peer(name: str, here: str, info: PeerInfo, new: Counter[str], *, was_linked: bool) -> DiagnosticStatus:
    link = info.link
    if info.state == _LINKED and link is not None:
        level, text = (
            DiagnosticLevel.OK,
            "linked" + (f", round trip {link.rtt * 1e3:.2f} ms" if link.rtt is not None else ""),
        )
        troubles = [f"{link.path_problem}; {link.path_remedy}"] if link.path_problem else []
        troubles += [bound.text for bound in info.beyond]
        if troubles:
            level, text = DiagnosticLevel.WARN, "; ".join(troubles)
        if new["dropped"]:
            level, text = DiagnosticLevel.WARN, f"{new['dropped']} messages dropped: the link takes them too slowly"
    elif info.state in ("conflict", "refused"):
        level, text = DiagnosticLevel.ERROR, "; ".join((*info.conflicts, info.last_error)).strip("; ") or info.state
    else:
        level = DiagnosticLevel.STALE if was_linked else DiagnosticLevel.WARN
        text = info.state + (f": {info.last_error}" if info.last_error else "")
    return DiagnosticStatus(level, f"rmpa: {name}", text, here, link_values(info))


def _route(name: str, here: str, topic: TopicInfo, route: RouteInfo, new: Counter[str]) -> DiagnosticStatus:
    level, text = _judged(topic, route, new)
    return DiagnosticStatus(level, name, text, here, route_values(route))


def _judged(topic: TopicInfo, route: RouteInfo, new: Counter[str]) -> tuple[DiagnosticLevel, str]:
    """The worst that is true of a route now, or since the last look."""
    if route.limit:
        return DiagnosticLevel.WARN, route.problem  # the peer's own status says it for all of them
    if route.state == "hidden":
        return DiagnosticLevel.ERROR, route.problem or "hidden"
    if route.events.get(_LOST, 0) > route.events.get(_RESTORED, 0):
        return DiagnosticLevel.ERROR, next(
            (e.text for e in reversed(route.recent) if e.kind == _LOST), "does not live"
        )
    if topic.mismatches:
        return DiagnosticLevel.ERROR, "; ".join(topic.mismatches)
    if route.problem:
        return DiagnosticLevel.WARN, route.problem
    deadline = route.contract.get("deadline")
    if isinstance(deadline, float) and route.age is not None and route.age > deadline:
        return DiagnosticLevel.WARN, f"no message for {route.age:.3g} s; deadline {deadline:.3g} s"
    if any(new.values()):
        return DiagnosticLevel.WARN, ", ".join(f"{count} {_MISSES[kind]}" for kind, count in new.items() if count)
    return DiagnosticLevel.OK, _flowing(route)


def _flowing(route: RouteInfo) -> str:
    if route.state == "idle":
        return "nobody here listens"
    if route.rate is None:
        return f"{route.state}, last message {route.age:.3g} s ago" if route.age is not None else route.state
    latency = f", {route.latency.p50 * 1e3:.2f} ms" if route.latency is not None else ""
    return f"{route.rate:.1f} Hz{latency}"
