"""The nodes of all modules, as a snapshot tells of them: of a peer those that publish or serve something here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.bridge.proxy_names import proxied_node

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.observe.snapshot import Snapshot
    from rmpa.web.monitor.patch import Tree

_COUNTS: Final = ("publishes", "subscribes", "serves")


def node_key(module: str, node: str) -> str:
    """``module:/name`` for a node of a peer, ``/name`` for one of this module, whose ``module`` is empty."""
    return f"{module}:{node}" if module else node


def node_entries(snapshot: Snapshot) -> dict[str, Tree]:
    """All nodes by ``node_key``, each with ``name``, ``module`` (a peer's) and how much it publishes and so on."""
    counts: dict[tuple[str, str], list[int]] = {}
    for module, node, at in _registrations(snapshot):
        counts.setdefault((module, node), [0] * len(_COUNTS))[at] += 1
    problems = {info.node: info.problem for info in snapshot.unreachable}
    return {
        node_key(module, node): _entry(module, node, counts[module, node], "" if module else problems.get(node, ""))
        for module, node in sorted(counts)
    }


def _registrations(snapshot: Snapshot) -> Iterator[tuple[str, str, int]]:
    """Each publisher, subscriber and server: its module, its name, and which of ``_COUNTS`` it is."""
    for topic in snapshot.topics:
        for node in topic.publishers:
            yield "", node, 0
        for node in topic.subscribers:
            yield "", node, 1
        for route in topic.routes:
            if route.direction == "in":
                yield route.peer, route.node, 0
    for service in snapshot.services:
        if service.node:
            yield service.peer, service.node, 2


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
