"""The nodes of all modules, as a snapshot tells of them: of a peer those that publish or serve something here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from rmpa.bridge.proxies import proxied_node

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from rmpa.observe.snapshot import Snapshot, TopicInfo
    from rmpa.web.monitor.patch import Tree

_COUNTS: Final = ("publishes", "subscribes", "serves")
_Registered: TypeAlias = tuple[tuple[str, ...], tuple[str, ...], tuple[tuple[str, str], ...]]
"""Of a topic: this module's publishers and subscribers, and those that publish it in other modules, by module."""


def node_key(module: str, node: str) -> str:
    """``module:/name`` for a node of a peer, ``/name`` for one of this module, whose ``module`` is empty."""
    return f"{module}:{node}" if module else node


class NodeEntries:
    """The nodes of each snapshot; they are counted again only where something was registered or withdrawn."""

    def __init__(self) -> None:
        self._registered: dict[str, tuple[TopicInfo, _Registered]] = {}
        self._others: tuple[object, ...] = ()
        self._entries: dict[str, Tree] = {}

    def build(self, snapshot: Snapshot) -> dict[str, Tree]:
        """All nodes by ``node_key``, each with ``name``, ``module`` (a peer's) and how much it publishes and so on.

        The same object where nothing has changed; not to be changed by the caller.
        """
        before, now = self._registered, {}
        same = True
        for topic in snapshot.topics:
            known = before.get(topic.name)
            if known is None or known[0] is not topic:
                registered = _registered(topic)
                same = same and known is not None and known[1] == registered
                known = topic, registered
            now[topic.name] = known
        served = tuple((service.peer, service.node) for service in snapshot.services if service.node)
        problems = {info.node: info.problem for info in snapshot.unreachable}
        others = (served, problems)
        if not same or len(now) != len(before) or others != self._others:
            self._entries = _count([registered for _, registered in now.values()], served, problems)
        self._registered, self._others = now, others
        return self._entries


def _registered(topic: TopicInfo) -> _Registered:
    incoming = tuple((route.peer, route.node) for route in topic.routes if route.direction == "in")
    return topic.publishers, topic.subscribers, incoming


def _count(
    topics: Iterable[_Registered], served: Iterable[tuple[str, str]], problems: Mapping[str, str]
) -> dict[str, Tree]:
    counts: dict[tuple[str, str], list[int]] = {}

    def add(module: str, node: str, at: int) -> None:
        counts.setdefault((module, node), [0] * len(_COUNTS))[at] += 1

    for publishers, subscribers, incoming in topics:
        for node in publishers:
            add("", node, 0)
        for node in subscribers:
            add("", node, 1)
        for module, node in incoming:
            add(module, node, 0)
    for module, node in served:
        add(module, node, 2)
    return {
        node_key(module, node): _entry(module, node, counts[module, node], "" if module else problems.get(node, ""))
        for module, node in sorted(counts)
    }


def _entry(module: str, node: str, counts: Iterable[int], problem: str) -> Tree:
    told: Tree = {"name": node, "module": module, **dict(zip(_COUNTS, counts, strict=True)), "problem": problem}
    return {key: value for key, value in told.items() if value}


def node_detail(snapshot: Snapshot, key: str) -> Tree | None:
    """The topics and services of one node by its ``node_key``; ``None`` where it has none."""
    head, colon, tail = key.partition(":")
    module, node = (head, tail) if colon else ("", key)
    publishes = [
        topic.name
        for topic in snapshot.topics
        if (not module and node in topic.publishers)
        or any(
            route.direction == "in" and (route.peer, route.node) == (module, node)
            for route in (topic.routes if module else ())
        )
    ]
    subscribes = [topic.name for topic in snapshot.topics if not module and node in topic.subscribers]
    services = [
        node_key(service.peer, service.name)
        for service in snapshot.services
        if (service.peer, service.node) == (module, node)
    ]
    if not publishes and not subscribes and not services:
        return None
    found: Tree = {"publishes": [*publishes], "subscribes": [*subscribes], "services": [*services]}
    problem = next((str(info) for info in snapshot.unreachable if not module and info.node == node), "")
    return {**found, "problem": problem} if problem else found


def shown_node(own: str) -> str:
    """A node of this module's graph as ``node_key`` has it: a proxy is its node in the peer's module."""
    peer = proxied_node(own)
    return node_key(*peer) if peer is not None else own
