"""The state that all pages show, made of the agent's snapshots: small, steady, and the same for all clients.

An entry says what a snapshot says, rounded. Its figures are new only where there is something to see (``_STEADY``),
and an entry of which nothing is new is the same object as before, so a difference costs little. Counters and
distributions are in the details, which a client gets of what it looks at alone.
"""

from __future__ import annotations

import math
from collections import defaultdict
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import msgspec

from rmpa.core.facts import LinkInfo, RouteInfo, ServiceInfo, TopicInfo
from rmpa.core.identity import proxied_node
from rmpa.discovery.limits import HEARTBEAT_LATE
from rmpa.web.monitor import limits
from rmpa.web.monitor.messages import Tree, old_after, without_nulls
from rmpa.web.monitor.resources import ResourceFacts, resource_detail, resource_entry, resource_flows

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.observe.snapshot import AgentInfo, ModuleFacts, PeerInfo, Snapshot

_T = TypeVar("_T")
_SMALL: Final = 0.03
# Figures by their member's name: a change is shown that is larger than this share of what is shown, and than this
# amount, so that noise moves nothing.
_STEADY: Final[Mapping[str, tuple[float, float]]] = {
    "since": (0.0, 0.5),
    "stopped": (0.0, 0.5),
    "cpu": (0.15, 1.0),
    "rss": (_SMALL, 0.0),
    "files_open": (_SMALL, 2.0),
    "rate": (_SMALL, 0.0),
    "bandwidth": (0.1, 0.0),
    "latency": (0.25, 1e-4),
    "rtt": (0.25, 5e-5),
    "offset": (0.1, 2e-5),
    "offset_error": (0.25, 2e-5),
    "queued": (0.25, 0.0),
    "bytes_in": (0.1, 20.0),
    "bytes_out": (0.1, 20.0),
}
# Are computed from a moving age: seconds since the epoch, of which three digits would say nothing.
_MOMENTS: Final = ("since", "stopped")
_GONE: Final = "has left the roster: no beacon and no link"
# States of a module of which nothing comes any more.
_LOST: Final = frozenset({"linking", "refused", "away", "lost"})


def steady_entry(before: Mapping[str, Any] | None, entry: Tree) -> Tree:
    """An entry with the figures that are to be shown; ``before`` itself, which is shown now, where nothing is new."""
    for name in entry.keys() & _STEADY.keys():
        value, shown = cast("float", entry[name]), before.get(name) if before is not None else None
        share, least = _STEADY[name]
        if not math.isfinite(value):
            del entry[name]
        elif shown and abs(value - shown) <= max(share * abs(shown), least):
            entry[name] = shown
        else:
            entry[name] = round(value, 1) if name in _MOMENTS else float(f"{value:.3g}")
    return cast("Tree", before) if before == entry else entry


class StateBuilder:
    """Makes the state of each snapshot.

    Args:
        own: The name of the agent's module.
    """

    def __init__(self, own: str) -> None:
        # The name of the agent's module.
        self.own = own
        # When each module was in the roster last, those included that have left it.
        self._seen: dict[str, float] = {}
        # The last counts of each link, and its bytes a second in and out.
        self._links: dict[str, tuple[tuple[float, int, int], list[float]]] = {}
        # What each linked module's link carries: topics with their messages a second; and what a lost link carried.
        self._carried: dict[str, dict[str, float]] = {}
        self._lost: dict[str, dict[str, float]] = {}
        # By section and key, the entries that are shown, with what they were made of.
        self._entries: dict[str, dict[str, tuple[object, Tree]]] = {}
        self._state: Tree = {"agent": {"name": own}, "modules": {}, "topics": {}}

    def build(
        self,
        snapshot: Snapshot,
        resources: Sequence[ResourceFacts] = (),
        alarms: Sequence[Tree] = (),
        parameters: int = 0,
    ) -> Tree:
        """The state of ``snapshot``.

        Args:
            snapshot: The newest.
            resources: The Smart Resources of all modules.
            alarms: The alarms that stand, each with ``id``, ``module`` (empty: this one), ``resource``, ``level``,
                ``text`` and ``at``.
            parameters: How often the parameters of this module's core have changed.
        """
        modules = dict(self._modules(snapshot))
        lost = {name for name, module in modules.items() if module["state"] in _LOST}
        taken = snapshot.taken
        flows = self._flows(snapshot.topics) | resource_flows(resources, self.own)
        nodes = node_entries(snapshot)
        topics, services = snapshot.topics[: limits.TOPICS_SHOWN], snapshot.services[: limits.SERVICES_SHOWN]
        hidden = {
            "topics": len(snapshot.topics) - len(topics) + snapshot.topics_left,
            "services": len(snapshot.services) - len(services) + snapshot.services_left,
            "modules": max(0, len(snapshot.peers) - limits.MODULES_SHOWN),
            "nodes": max(0, len(nodes) - limits.NODES_SHOWN),
        }
        self._state = {
            "reach": {"ok": True},
            "agent": self._steady("agent", [("", snapshot.agent)], _agent)[""],
            "modules": self._steady("modules", modules.items()),
            "flows": self._steady("flows", flows.items()),
            "topics": self._steady(
                "topics", ((each.name, each) for each in topics), lambda one: self._topic(one, taken)
            ),
            "services": self._steady("services", ((service_key(each), each) for each in services), _service),
            "nodes": self._steady("nodes", islice(nodes.items(), limits.NODES_SHOWN)),
            "resources": self._steady(
                "resources", ((one.key, resource_entry(one, self.own, lost=one.peer in lost)) for one in resources)
            ),
            "alarms": {
                str(alarm.get("id", index)): {**alarm, "module": alarm.get("module") or self.own}
                for index, alarm in enumerate(alarms)
                if alarm.get("module") not in lost
            },
            "parameters": parameters,
            "notes": [*snapshot.notes[:100]],
            # By GUID and name: each alone may be one that a member has.
            "outside": self._steady("outside", self._outside(snapshot)),
            "unreachable": [str(each) for each in snapshot.unreachable[:100]],
            "hidden": {kind: count for kind, count in hidden.items() if count},
        }
        return self._state

    def unreachable(self, since: float, error: str, remedy: str) -> Tree:
        """The state while the agent does not answer: what was last known, marked as such."""
        return self._state | {"reach": {"ok": False, "since": round(since, 1), "error": error, "remedy": remedy}}

    def _steady(
        self,
        section: str,
        sources: Iterable[tuple[str, _T]],
        make: Callable[[_T], Tree] = lambda entry: entry,  # type: ignore[assignment,return-value]
    ) -> Tree:
        """The entries of a section by key; one whose source is the object of last time is not made again."""
        before, now = self._entries.get(section, {}), {}
        for key, source in sources:
            known = before.get(key)
            if known is None or known[0] is not source:
                known = source, steady_entry(known[1] if known is not None else None, make(source))
            now[key] = known
        self._entries[section] = now
        return {key: entry for key, (_, entry) in now.items()}

    def _modules(self, snapshot: Snapshot) -> Iterable[tuple[str, Tree]]:
        taken, peers = snapshot.taken, snapshot.peers[: limits.MODULES_SHOWN]
        # Modules that have left the roster are kept for a while, as many as can be shown.
        seen = self._seen | {peer.name: taken for peer in peers}
        newest = sorted(seen, key=seen.__getitem__, reverse=True)[: limits.MODULES_SHOWN]
        stays = self._lost.keys()
        self._seen = {
            name: seen[name] for name in newest if name in stays or taken - seen[name] <= limits.FORGET_AFTER
        }
        self._note_lost(snapshot)
        started = round(snapshot.agent.started, 1)
        yield self.own, {"state": "here", "since": started}
        links, self._links = self._links, {}
        for peer in peers:
            rates = self._rates(peer.name, taken, peer.link, links) if peer.link is not None else []
            entry = _module(peer, taken, rates)
            yield peer.name, self._as_lost(entry, peer.name, snapshot) if peer.name in self._lost else entry
        present = {peer.name for peer in snapshot.peers}
        if snapshot.trust is None:  # where a secured mesh is not this one's, its members are outside, and not away
            present |= {one.name for one in snapshot.strangers}
        for name in sorted(self._seen.keys() - present):
            if snapshot.agent.uptime < limits.AGENT_SETTLES:
                text = "not found yet: the agent of this module has just started"
                yield name, {"state": "linking", "since": started, "error": text}
            else:
                before = self._entries.get("modules", {}).get(name, (None, {}))[1]
                since = before.get("since") if before.get("state") in _LOST else None
                entry = {"state": "away", "since": since or self._seen[name], "error": _GONE}
                yield name, self._as_lost(entry, name, snapshot) if name in self._lost else entry

    def _note_lost(self, snapshot: Snapshot) -> None:
        """Note which links were lost without a farewell, and what they carried, until they are back.

        A module that ends says so, and leaves the roster at once; of one whose cable is out the entry stays.
        """
        carried: dict[str, dict[str, float]] = {}
        for topic in snapshot.topics:
            for route in topic.routes:
                if route.state == "open" or route.transport in ("direct", "both"):
                    topics = carried.setdefault(route.peer, {})
                    topics[topic.name] = max(topics.get(topic.name, 0.0), route.rate or 0.0)
        before, self._carried = self._carried, {}
        for peer in snapshot.peers:
            if peer.state in ("linked", "relayed"):
                self._lost.pop(peer.name, None)
                self._carried[peer.name] = carried.get(peer.name, {})
            elif peer.name in before:
                self._lost[peer.name] = before[peer.name]

    def _as_lost(self, entry: Tree, name: str, snapshot: Snapshot) -> Tree:
        """The entry of a module whose link was lost, with the topics that stopped and the messages that it costs."""
        topics = self._lost[name]
        away = [
            r for t in snapshot.topics for r in t.routes if (r.peer, r.direction, r.state) == (name, "out", "away")
        ]
        busiest = sorted(topics, key=lambda topic: (-topics[topic], topic))
        told: Tree = {
            "topics": {topic: float(f"{topics[topic]:.3g}") for topic in busiest[: limits.LOST_TOPICS]},
            "more": max(0, len(topics) - limits.LOST_TOPICS),
            "kept": sum(route.kept for route in away),
            "dropped": sum(route.lost + route.dropped for route in away),
        }
        return {**entry, "state": "lost", "lost": told}

    def _outside(self, snapshot: Snapshot) -> Iterable[tuple[str, Tree]]:
        """The modules that are not of this mesh; for one that a page can invite here with ``here``."""
        here = snapshot.trust is not None and snapshot.trust.is_authority
        for one in snapshot.strangers:
            entry = {"address": one.guid.partition("#")[0], "since": snapshot.taken - one.since_ago}
            entry |= {"text": one.last_error, "here": here, **_as_told(one, "name", "state", "invite")}
            yield f"{one.guid} {one.name}", _told(entry)

    def _rates(
        self, name: str, taken: float, link: LinkInfo, links: Mapping[str, tuple[tuple[float, int, int], list[float]]]
    ) -> list[float]:
        """Bytes a second in and out, smoothed; empty before there are two counts of one link."""
        counts = taken, link.bytes_in, link.bytes_out
        before, rates = links.get(name, (counts, []))
        span = taken - before[0]
        if counts[1] < before[1] or counts[2] < before[2]:
            rates = []  # another link
        elif span > 0:
            fresh = [(counts[way] - before[way]) / span for way in (1, 2)]
            share = 1 - math.exp(-span)  # a time constant of 1 s
            rates = [old + share * (new - old) for old, new in zip(rates or fresh, fresh, strict=True)]
        self._links[name] = counts, rates
        return rates

    def _flows(self, topics: Iterable[TopicInfo]) -> dict[str, Tree]:
        """What flows on the own links, by ``from>to``: messages and bytes a second, and the busiest topics."""
        parts: dict[str, list[tuple[float, float, str]]] = {}
        for topic in topics:
            for route in topic.routes:
                if route.rate and not is_stopped(route):
                    key = f"{route.peer}>{self.own}" if route.direction == "in" else f"{self.own}>{route.peer}"
                    parts.setdefault(key, []).append((-route.rate, route.bandwidth or 0.0, topic.name))
        return {
            key: {
                "rate": -sum(rate for rate, _, _ in busiest),
                "bandwidth": sum(bandwidth for _, bandwidth, _ in busiest),
                "topics": [*sorted([*dict.fromkeys(name for _, _, name in sorted(busiest))][:8])],
            }
            for key, busiest in parts.items()
        }

    def _topic(self, topic: TopicInfo, taken: float) -> Tree:
        sources = {self.own} if topic.publishers else set()
        targets = {node.partition(":")[0] for node in topic.remote_subscribers}
        targets |= {self.own} if topic.subscribers else set()
        rate = bandwidth = latency = stopped = 0.0
        flows = False
        lost = dropped = 0
        problem = next(iter((*topic.mismatches, *topic.unreachable)), "")
        for route in topic.routes:  # of thousands of topics: one loop is half as long as one for each figure
            if route.direction == "in":
                sources.add(route.peer)
                if route.latency is not None and route.latency.p50 > latency:
                    latency = route.latency.p50
            elif route.state == "open" or any(each.transport == "direct" for each in route.subscribers):
                targets.add(route.peer)
            if route.rate and is_stopped(route):
                stopped = max(stopped, taken - (route.age or 0.0))
            elif route.rate:
                flows = True
            rate = max(rate, route.rate or 0.0)
            bandwidth += route.bandwidth or 0.0
            lost += route.lost + route.expired
            dropped += route.dropped + route.oversized
            problem = problem or route.problem
        return _told({
            "type": topic.type,
            "from": sorted(sources),
            "to": sorted(targets),
            "rate": rate,
            "stopped": 0.0 if flows else stopped,
            "bandwidth": bandwidth,
            "latency": latency,
            "lost": lost,
            "dropped": dropped,
            "problem": problem,
            "crosses": topic.crosses,
        })  # fmt: skip


def is_stopped(route: RouteInfo) -> bool:
    """Whether the last message of a route is old by the route's own period: its figures say what was.

    One message alone has no period, as a latched one.
    """
    period = route.period.p50 if route.period is not None else 1 / route.rate if route.rate else 0.0
    return period > 0 and route.age is not None and route.age > old_after(period)


def module_facts(module: ModuleFacts) -> Tree:
    """The facts of this module, or of a peer's; those of its files stand beside the others."""
    built: dict[str, Any] = msgspec.to_builtins(module)
    files = built.pop("files") or {}
    return _tree(built | {f"files_{name}": files.get(name) for name in ("open", "limit", "problem")})


def _agent(agent: AgentInfo) -> Tree:
    facts = module_facts(agent)
    del facts["uptime"]  # it would change all the time; ``started`` says it
    return facts


def module_state(peer: PeerInfo) -> str:
    """The word for a peer: ``up``, ``silent``, ``linking``, ``refused``, ``relayed`` or ``away``."""
    if peer.state == "linked":
        return "silent" if peer.link is not None and peer.link.is_silent else "up"
    if peer.state in ("refused", "conflict"):
        return "refused"
    if peer.state == "relayed":
        return "relayed"
    late = peer.beacon_ago is None or peer.beacon_ago > HEARTBEAT_LATE
    return "away" if late else "linking"


def _module(peer: PeerInfo, taken: float, rates: Sequence[float]) -> Tree:
    link, state, ago = peer.link, module_state(peer), peer.since_ago
    if state == "silent" and link is not None and link.heard_ago is not None:
        ago = link.heard_ago
    entry = {
        "state": state,
        "since": taken - ago,
        "error": "; ".join(filter(None, ("" if link else peer.last_error, *peer.conflicts))),
        "hidden": [bound.text for bound in peer.beyond],
        **_as_told(peer, "code", "guid", "source", "via", "topics_in", "topics_out", "direct_in", "direct_out"),
        **dict(zip(("bytes_in", "bytes_out"), rates, strict=False)),
    }
    if link is not None:
        entry |= {"offset": link.clock_offset, "offset_error": link.clock_error}
        entry |= _as_told(link, "remote", "rtt", "queued", "dropped")
    return _told(entry, zeros=True)


def _as_told(facts: object, *names: str) -> dict[str, Any]:
    """Facts that a page is shown under the names, and as the values, that their owner gives them."""
    return {name: getattr(facts, name) for name in names}


def _told(entry: Mapping[str, object], *, zeros: bool = False) -> Tree:
    """Without what says nothing: no, none, nothing, not known. A page takes a missing member as that."""
    return cast("Tree", {key: value for key, value in entry.items() if value or (zeros and value == 0)})


def service_key(service: ServiceInfo) -> str:
    """``module:/name`` for a peer's service, ``/name`` for one of this module."""
    return node_key(service.peer, service.name)


def _service(service: ServiceInfo) -> Tree:
    told = _as_told(service, "name", "node", "type", "state", "calls", "failed", "transport")
    return _told(told | {"module": service.peer, "problem": service.problem or service.hidden})


def node_key(module: str, node: str) -> str:
    """``module:/name`` for a node of a peer, ``/name`` for one of this module, whose ``module`` is empty."""
    return f"{module}:{node}" if module else node


def shown_node(own: str) -> str:
    """A node of this module's graph as ``node_key`` has it: a proxy is its node in the peer's module."""
    peer = proxied_node(own)
    return node_key(*peer) if peer is not None else own


def node_entries(snapshot: Snapshot) -> dict[str, Tree]:
    """The nodes of all modules by ``node_key``: how many topics each publishes and subscribes to, what it serves.

    Of a peer those of which something is shown here.
    """
    publishes: dict[tuple[str, str], int] = defaultdict(int)
    subscribes, serves = publishes.copy(), publishes.copy()
    for topic in snapshot.topics:
        for node in topic.publishers:
            publishes["", node] += 1
        for node in (*topic.subscribers, *topic.remote_subscribers):
            module, _, name = node.rpartition(":")
            subscribes[module, name] += 1
        for route in topic.routes:
            if route.direction == "in":
                publishes[route.peer, route.node] += 1
    for service in snapshot.services:
        if service.node:
            serves[service.peer, service.node] += 1
    problems = {info.node: info.problem for info in snapshot.unreachable}
    return {
        node_key(*key): _told({
            "name": key[1],
            "module": key[0],
            "publishes": publishes.get(key),
            "subscribes": subscribes.get(key),
            "serves": serves.get(key),
            "problem": "" if key[0] else problems.get(key[1]),
        })
        for key in sorted(publishes.keys() | subscribes.keys() | serves.keys())
    }  # fmt: skip


def node_detail(snapshot: Snapshot, key: str) -> Tree | None:
    """The topics and services of one node by its ``node_key``; ``None`` where it has none."""
    module, _, node = key.rpartition(":")
    publishes = [
        topic.name
        for topic in snapshot.topics
        if (not module and node in topic.publishers)
        or (module and any((each.direction, each.peer, each.node) == ("in", module, node) for each in topic.routes))
    ]
    subscribes = [topic.name for topic in snapshot.topics if key in (*topic.subscribers, *topic.remote_subscribers)]
    services = [service_key(each) for each in snapshot.services if (each.peer, each.node) == (module, node)]
    if not publishes and not subscribes and not services:
        return None
    found: Tree = {"publishes": [*publishes], "subscribes": [*subscribes], "services": [*services]}
    problem = next((str(info) for info in snapshot.unreachable if not module and info.node == node), "")
    return {**found, "problem": problem} if problem else found


def details(snapshot: Snapshot, resources: Mapping[str, ResourceFacts], kind: str, name: str) -> Tree | None:
    """All that is known of one thing, for its page; ``None`` where there is no such thing.

    Args:
        snapshot: The newest.
        resources: By ``ResourceFacts.key``.
        kind: ``module``, ``topic``, ``service``, ``node`` or ``resource``; or ``counters``, without a name.
        name: A module's or topic's name; ``service_key`` of a service; ``node_key``; ``key`` of a resource.
    """
    agent = snapshot.agent
    if kind == "counters":
        return dict(sorted(snapshot.counters.items()))
    if kind == "resource":
        return resource_detail(resources[name], agent.name) if name in resources else None
    if kind == "node":
        return node_detail(snapshot, name)
    things: dict[str, list[tuple[str, msgspec.Struct]]] = {
        "module": [(agent.name, agent), *((each.name, each) for each in snapshot.peers)],
        "service": [(service_key(each), each) for each in snapshot.services],
        "topic": [(each.name, each) for each in snapshot.topics],
    }
    found = next((thing for key, thing in things.get(kind, ()) if key == name), None)
    if found is None:
        return None
    made: Any = _tree(msgspec.to_builtins(found))
    if isinstance(found, TopicInfo):
        for info, route in zip(found.routes, made["routes"], strict=True):
            if is_stopped(info):
                route["stopped"] = round(snapshot.taken - route["age"], 1)
            for event in route.get("recent", ()):
                event["at"] = round(snapshot.taken - event.pop("ago"), 1)  # an age would change all the time
        made["routes"] = {f"{each['direction']} {each['peer']} {each['node']}": each for each in made["routes"]}
    return cast("Tree", made)


def _tree(value: Mapping[str, object]) -> Tree:
    return cast("Tree", without_nulls(dict(value)))
