"""The state that all pages show, made of the agent's snapshots: small, steady, and the same for all clients.

Figures change only when there is something to see (``steady``); counters and distributions are in the details, which
a client gets of what it looks at alone. Entries that did not change are the same objects as before, so a difference
costs little.
"""

from __future__ import annotations

import math
from itertools import islice
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias, cast

import msgspec

from rmpa.web import limits
from rmpa.web.monitor.live import Steady, Tree, Value, steady_figure, without_nulls
from rmpa.web.monitor.questions import NodeEntries, node_detail
from rmpa.web.monitor.resources import resource_detail, resource_entry, resource_flows

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rmpa.observe.peer_info import LinkInfo, PeerInfo
    from rmpa.observe.snapshot import RouteInfo, ServiceInfo, Snapshot, SubscriberTransport, TopicInfo
    from rmpa.web.monitor.resources import ResourceFacts

_STATES = {"refused": "refused", "conflict": "refused", "relayed": "relayed"}
_GONE: Final = "has left the roster: no beacon and no link"
_LOST: Final = frozenset({"linking", "refused", "away"})
"""States of a module of which nothing comes any more."""


def module_state(peer: PeerInfo) -> str:
    """The word for a peer: ``up``, ``silent``, ``linking``, ``refused``, ``relayed`` or ``away``."""
    if peer.state == "linked":
        if peer.link is None or peer.link.heard_ago is None:
            return "up"
        after = peer.link.lease / 2 if peer.link.rests else limits.SILENT_AFTER
        return "silent" if peer.link.heard_ago > after else "up"
    if peer.state in _STATES:
        return _STATES[peer.state]
    return "linking" if peer.beacon_ago is not None and peer.beacon_ago <= limits.AWAY_AFTER else "away"


class _ByteRates:
    """Bytes a second of a link each way, from its counters, smoothed."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, int, int]] = {}
        self._rates: dict[str, tuple[float, float]] = {}

    def update(self, name: str, now: float, link: LinkInfo | None) -> tuple[float, float] | None:
        """In and out; ``None`` before there are two counts of one link."""
        if link is None:
            self._last.pop(name, None)
            self._rates.pop(name, None)
            return None
        before = self._last.get(name)
        self._last[name] = (now, link.bytes_in, link.bytes_out)
        if before is None or link.bytes_in < before[1] or link.bytes_out < before[2]:
            self._rates.pop(name, None)
            return None
        span = now - before[0]
        if span <= 0:
            return self._rates.get(name)
        fresh = ((link.bytes_in - before[1]) / span, (link.bytes_out - before[2]) / span)
        old = self._rates.get(name, fresh)
        share = 1 - math.exp(-span / limits.RATE_SMOOTHING)
        self._rates[name] = made = (old[0] + share * (fresh[0] - old[0]), old[1] + share * (fresh[1] - old[1]))
        return made

    def keep(self, names: Iterable[str]) -> None:
        """Forget all others."""
        wanted = set(names)
        for name in list(self._last):
            if name not in wanted:
                self._last.pop(name, None)
                self._rates.pop(name, None)


_Facts: TypeAlias = tuple[str, tuple[bool, bool], list[tuple[str, bool]], int, int, str, bool]
"""Of a topic: its type, whether this module publishes and subscribes, peers and whether they send it, messages lost,
messages dropped, the problem, whether it crosses."""
_Figures: TypeAlias = tuple[float | None, float | None, float | None]


class _KnownTopic(NamedTuple):
    """A topic of the last snapshot.

    Args:
        topic: The topic.
        entry: What the state says of it.
        figures: Its rate, bandwidth and latency as shown.
        facts: All else of which the entry is made.
        flows: What it adds to flows: each a peer and whether that sends it, messages and bytes a second.
    """

    topic: TopicInfo
    entry: Tree
    figures: _Figures
    facts: _Facts
    flows: list[tuple[tuple[str, bool], float, float]]


_UNKNOWN_FIGURES: _Figures = (None, None, None)


class StateBuilder:
    """Makes the state of each snapshot.

    Args:
        own: The name of the agent's module.
    """

    def __init__(self, own: str) -> None:
        self.own = own
        """The name of the agent's module."""
        self._seen: dict[str, float] = {}
        """When each module was in the roster last, those included that have left it."""
        self._steady = Steady()
        self._bytes = _ByteRates()
        self._known: dict[str, _KnownTopic] = {}
        self._nodes = NodeEntries()
        self._served: dict[str, tuple[ServiceInfo, Tree]] = {}
        self._sections: Tree = {}

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
        taken = snapshot.taken
        peers = snapshot.peers[: limits.MODULES_SHOWN]
        self._bytes.keep(peer.name for peer in peers)
        self._remember(peers, taken)
        topics, flows = self._topics_and_flows(snapshot.topics)
        nodes = self._nodes.build(snapshot)
        modules: Tree = dict(self._modules(snapshot, peers))
        lost = {name for name, module in modules.items() if _is_lost(module)}
        state: Tree = {
            "reach": {"ok": True},
            "agent": self._agent(snapshot),
            "modules": modules,
            "flows": {**flows, **resource_flows(resources, self.own, self._steady)},
            "topics": topics,
            "services": self._services(snapshot.services[: limits.SERVICES_SHOWN]),
            "nodes": dict(islice(nodes.items(), limits.NODES_SHOWN)),
            "resources": {one.key: resource_entry(one, self.own, lost=one.peer in lost) for one in resources},
            "alarms": {
                str(alarm.get("id", index)): {**alarm, "module": alarm.get("module") or self.own}
                for index, alarm in enumerate(alarms)
                if alarm.get("module") not in lost
            },
            "parameters": parameters,
            "notes": [
                *snapshot.notes[:100],
                *(f"{one.name}: {one.last_error}" for one in snapshot.strangers),
            ],
            "unreachable": [str(each) for each in snapshot.unreachable[:100]],
        }
        hidden = {
            "topics": max(0, len(snapshot.topics) - limits.TOPICS_SHOWN) + snapshot.topics_left,
            "services": max(0, len(snapshot.services) - limits.SERVICES_SHOWN) + snapshot.services_left,
            "modules": len(snapshot.peers) - limits.MODULES_SHOWN,
            "nodes": len(nodes) - limits.NODES_SHOWN,
        }
        state["hidden"] = {kind: count for kind, count in hidden.items() if count > 0}
        self._steady.sweep()
        return self._shared(state)

    def unreachable(self, since: float, error: str, remedy: str) -> Tree:
        """The state while the agent does not answer: what was last known, marked as such."""
        known: Tree = dict(self._sections) or {"agent": {"name": self.own}, "modules": {}, "topics": {}}
        return known | {"reach": {"ok": False, "since": round(since, 1), "error": error, "remedy": remedy}}

    def _shared(self, state: Tree) -> Tree:
        """``state`` with the objects of the last one wherever these are equal."""
        for name, section in state.items():
            before = self._sections.get(name)
            if not isinstance(section, dict) or not isinstance(before, dict):
                continue
            for key, value in section.items():
                old = before.get(key)
                if old is not value and type(old) is type(value) and old == value:
                    section[key] = old
            if before == section:
                state[name] = before
        self._sections = dict(state)
        return state

    def _agent(self, snapshot: Snapshot) -> Tree:
        agent, steady = snapshot.agent, self._steady
        files = agent.files
        return _tree({
            "name": agent.name,
            "guid": agent.guid,
            "version": agent.version,
            "domain": agent.domain,
            "core_uri": agent.core_uri,
            "pid": agent.pid,
            "started": agent.started,
            "cpu": steady.figure("cpu", agent.cpu, share=0.15, least=1.0),
            "rss": steady.figure("rss", agent.rss),
            "addresses": agent.addresses,
            "config_file": agent.config_file,
            "realtime": agent.realtime,
            "files_open": steady.figure("files", files.open, least=2.0) if files else None,
            "files_limit": files.limit if files else None,
            "files_problem": files.problem if files else None,
            "proxies": agent.proxies,
            "core_memory": agent.core_memory,
        })  # fmt: skip

    def _modules(self, snapshot: Snapshot, peers: Sequence[PeerInfo]) -> Iterable[tuple[str, Tree]]:
        yield self.own, {"state": "here", "since": round(snapshot.agent.started, 1)}
        for peer in peers:
            yield peer.name, self._module(peer, snapshot.taken)
        starts = snapshot.agent.uptime < limits.AGENT_SETTLES
        for name in sorted(self._seen.keys() - {peer.name for peer in snapshot.peers}):
            if starts:
                text = "not found yet: the agent of this module has just started"
                yield name, {"state": "linking", "since": round(snapshot.agent.started, 1), "error": text}
            else:
                yield name, {"state": "away", "since": self._lost_since(name), "error": _GONE}

    def _remember(self, peers: Sequence[PeerInfo], taken: float) -> None:
        """Keep modules that have left the roster for a while, as many as can be shown."""
        self._seen |= {peer.name: taken for peer in peers}
        known = sorted(self._seen, key=self._seen.__getitem__, reverse=True)[: limits.MODULES_SHOWN]
        self._seen = {name: self._seen[name] for name in known if taken - self._seen[name] <= limits.FORGET_AFTER}

    def _lost_since(self, name: str) -> float:
        """Since when nothing comes of a module that is in the roster no more."""
        known = self._sections.get("modules")
        before = known.get(name) if isinstance(known, dict) else None
        since = before.get("since") if isinstance(before, dict) and _is_lost(before) else None
        return since if isinstance(since, float) else round(self._seen[name], 1)

    def _module(self, peer: PeerInfo, taken: float) -> Tree:
        link, steady, name = peer.link, self._steady, peer.name
        rates = self._bytes.update(name, taken, link)
        state, ago = module_state(peer), peer.since_ago
        if state == "silent" and link is not None and link.heard_ago is not None:
            ago = link.heard_ago
        entry = {
            "state": state,
            "since": steady.moment(f"{name} since", taken - ago),
            "error": "; ".join(filter(None, ("" if link else peer.last_error, *peer.conflicts))),
            "guid": peer.guid,
            "source": peer.source,
            "via": peer.via,
            "topics_in": peer.topics_in,
            "topics_out": peer.topics_out,
            "hidden": [bound.text for bound in peer.beyond],
            "direct_in": peer.direct_in,
            "direct_out": peer.direct_out,
        }
        if link is not None:
            entry |= {
                "remote": link.remote,
                "rtt": steady.figure(f"{name} rtt", link.rtt, share=0.25, least=5e-5),
                "offset": steady.figure(f"{name} offset", link.clock_offset, share=0.1, least=2e-5),
                "offset_error": steady.figure(f"{name} error", link.clock_error, share=0.25, least=2e-5),
                "queued": steady.figure(f"{name} queued", link.queued, share=0.25),
                "dropped": link.dropped,
                "bytes_in": steady.figure(f"{name} in", rates[0] if rates else None, share=0.1, least=20.0),
                "bytes_out": steady.figure(f"{name} out", rates[1] if rates else None, share=0.1, least=20.0),
            }
        return _given(entry)

    def _topics_and_flows(self, topics: Sequence[TopicInfo]) -> tuple[Tree, dict[str, Tree]]:
        """The topics by name, and what flows on the own links, ``from>to``.

        Most topics of a large mesh are idle, and their entries are kept until they change.
        """
        known, shown = self._known, limits.TOPICS_SHOWN
        entries: Tree = {}
        kept: dict[str, _KnownTopic] = {}
        flows: dict[tuple[str, bool], list[tuple[float, float, str]]] = {}
        for index, topic in enumerate(topics):
            name = topic.name
            before = known.get(name)
            if before is None or before.flows or (before.topic is not topic and before.topic != topic):
                before = self._topic(topic, before)
            kept[name] = before
            if index < shown:
                entries[name] = before.entry
            for end, rate, bandwidth in before.flows:
                flows.setdefault(end, []).append((rate, bandwidth, name))
        self._known = kept
        return entries, dict(self._flow(*end, parts) for end, parts in flows.items())

    def _flow(self, peer: str, incoming: bool, parts: list[tuple[float, float, str]]) -> tuple[str, Tree]:
        """Its key ``from>to``; messages and bytes a second, and the busiest topics."""
        key = f"{peer}>{self.own}" if incoming else f"{self.own}>{peer}"
        parts.sort(key=lambda part: (-part[0], part[2]))
        names = list(dict.fromkeys(part[2] for part in parts))[: limits.FLOW_TOPICS]
        names.sort()
        return key, _given({
            "rate": self._steady.figure(f"{key} rate", sum(part[0] for part in parts)),
            "bandwidth": self._steady.figure(f"{key} bandwidth", sum(part[1] for part in parts), share=0.1),
            "topics": names,
        })  # fmt: skip

    def _services(self, services: Sequence[ServiceInfo]) -> Tree:
        """By ``service_key``; entries are kept until they change."""
        served: dict[str, tuple[ServiceInfo, Tree]] = {}
        for service in services:
            key = service_key(service)
            before = self._served.get(key)
            same = before is not None and (before[0] is service or before[0] == service)
            served[key] = before if before is not None and same else (service, _service(service))
        self._served = served
        return {key: entry for key, (_, entry) in served.items()}

    def _topic(self, topic: TopicInfo, before: _KnownTopic | None) -> _KnownTopic:
        most = bandwidth = 0.0
        latency: float | None = None
        lost = dropped = 0
        problem = _problem(topic)
        ends: list[tuple[str, bool]] = []
        flows: list[tuple[tuple[str, bool], float, float]] = []
        for route in topic.routes:
            rate, bytes_ = route.rate or 0.0, route.bandwidth or 0.0
            bandwidth += bytes_
            lost += route.lost + route.expired
            dropped += route.dropped + route.oversized
            incoming = route.direction == "in"
            end = route.peer, incoming
            if rate:
                flows.append((end, rate, bytes_))
                most = max(most, rate)
            if incoming:
                ends.append(end)
                if route.latency is not None and (latency is None or route.latency.p50 > latency):
                    latency = route.latency.p50
            elif route.state == "open" or any(map(_is_direct, route.subscribers)):
                ends.append(end)
            if route.problem and not problem:
                problem = route.problem
        old = before.figures if before is not None else _UNKNOWN_FIGURES
        figures = (
            steady_figure(old[0], most or None),
            steady_figure(old[1], bandwidth or None, 0.1),
            steady_figure(old[2], latency, 0.25, 1e-4),
        )
        here = bool(topic.publishers), bool(topic.subscribers)
        facts: _Facts = (topic.type, here, ends, lost, dropped, problem, topic.crosses)
        if before is not None and before.figures == figures and before.facts == facts:
            return _KnownTopic(topic, before.entry, figures, facts, flows)
        return _KnownTopic(topic, _topic_entry(self.own, figures, facts), figures, facts, flows)


def _topic_entry(own: str, figures: _Figures, facts: _Facts) -> Tree:
    type_, (published, subscribed), ends, lost, dropped, problem, crosses = facts
    sources = {peer for peer, incoming in ends if incoming} | ({own} if published else set())
    targets = {peer for peer, incoming in ends if not incoming} | ({own} if subscribed else set())
    return _said({
        "type": type_,
        "from": sorted(sources),
        "to": sorted(targets),
        "rate": figures[0],
        "bandwidth": figures[1],
        "latency": figures[2],
        "lost": lost,
        "dropped": dropped,
        "problem": problem,
        "crosses": crosses,
    })  # fmt: skip


def _is_lost(module: Value) -> bool:
    return isinstance(module, dict) and module.get("state") in _LOST


def _is_direct(subscriber: SubscriberTransport) -> bool:
    return subscriber.transport == "direct"


def _said(entry: Mapping[str, object]) -> Tree:
    """Without what says nothing: no, none, nothing, not known. A page takes a missing member as that."""
    return cast("Tree", {key: value for key, value in entry.items() if value})


def _given(entry: Mapping[str, object]) -> Tree:
    """Without empty texts and lists, and without what is not known; zeros stay."""
    return cast("Tree", {key: value for key, value in entry.items() if value or value == 0})


def _problem(topic: TopicInfo) -> str:
    """What is wrong with the topic itself, or empty; its routes have problems of their own."""
    if topic.mismatches:
        return topic.mismatches[0]
    return topic.unreachable[0] if topic.unreachable else ""


def service_key(service: ServiceInfo) -> str:
    """``module:/name`` for a peer's service, ``/name`` for one of this module."""
    return f"{service.peer}:{service.name}" if service.peer else service.name


def _service(service: ServiceInfo) -> Tree:
    entry = {
        "name": service.name,
        "module": service.peer,
        "node": service.node,
        "type": service.type,
        "state": service.state,
        "calls": service.calls,
        "failed": service.failed,
        "transport": service.transport,
        "problem": service.problem or service.hidden,
    }
    return _said(entry)


def details(snapshot: Snapshot, resources: Mapping[str, ResourceFacts], kind: str, name: str) -> Tree | None:
    """All that is known of one thing, for its page; ``None`` where there is no such thing.

    Args:
        snapshot: The newest.
        resources: By ``ResourceFacts.key``.
        kind: ``module``, ``topic``, ``service``, ``node`` or ``resource``; or ``counters``, without a name.
        name: A module's or topic's name; ``service_key`` of a service; ``node_key``; ``key`` of a resource.
    """
    own = snapshot.agent.name
    if kind == "counters":
        return dict(sorted(snapshot.counters.items()))
    if kind == "resource":
        return resource_detail(resources[name], own) if name in resources else None
    if kind == "node":
        return node_detail(snapshot, name)
    if kind == "module" and name == own:
        return _tree(msgspec.to_builtins(snapshot.agent))
    found: object = None
    if kind == "module":
        found = next((peer for peer in snapshot.peers if peer.name == name), None)
    elif kind == "service":
        found = next((each for each in snapshot.services if service_key(each) == name), None)
    elif kind == "topic":
        found = next((topic for topic in snapshot.topics if topic.name == name), None)
    if found is None:
        return None
    made = _tree(msgspec.to_builtins(found))
    if kind == "topic":
        routes = made.get("routes")
        for route in routes if isinstance(routes, list) else ():
            _date_events(route, snapshot.taken)
        made["routes"] = (
            {_route_key(route): route for route in routes if isinstance(route, dict)}
            if isinstance(routes, list)
            else {}
        )
    return made


def _date_events(route: Value, taken: float) -> None:
    """Give the last events of a route their moments in place of their ages, which change all the time."""
    events = route.get("recent") if isinstance(route, dict) else None
    for event in events if isinstance(events, list) else ():
        if isinstance(event, dict) and isinstance(ago := event.pop("ago", None), float | int):
            event["at"] = round(taken - ago, 1)


def _route_key(route: Mapping[str, Value] | RouteInfo) -> str:
    values = route if isinstance(route, dict) else {}
    return f"{values.get('direction')} {values.get('peer')} {values.get('node')}"


def _tree(value: Mapping[str, object]) -> Tree:
    made = without_nulls(dict(value))
    return made if isinstance(made, dict) else {}
