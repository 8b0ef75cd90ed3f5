"""What can be said of one node, as ``rmpa node`` shows it and agents tell each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping


class NodeLine(msgspec.Struct, kw_only=True, frozen=True):
    """One node in a list.

    Attributes:
        name: Its name in its own graph.
        uri: Its slave API; empty where the master does not know it.
        publications: How many topics it publishes.
        subscriptions: How many it subscribes to.
        services: How many services it provides.
        problem: Why its core cannot connect to it, ready to read; empty where it can, or has not tried.
    """

    name: str
    uri: str = ""
    publications: int = 0
    subscriptions: int = 0
    services: int = 0
    problem: str = ""


class NodeFacts(msgspec.Struct, kw_only=True, frozen=True):
    """All that is known of one node.

    Attributes:
        name: Its name in its own graph.
        uri: Its slave API.
        pid: Its process; ``None`` where it did not answer.
        problem: Why it did not answer, ready to read; empty where it did.
        publications: Types by topic; ``*`` where nobody has told the type.
        subscriptions: Likewise.
        services: The names of its services.
    """

    name: str
    uri: str = ""
    pid: int | None = None
    problem: str = ""
    publications: dict[str, str] = {}
    subscriptions: dict[str, str] = {}
    services: tuple[str, ...] = ()


class NodePing(msgspec.Struct, kw_only=True, frozen=True):
    """One answer of a node.

    Attributes:
        uri: Its slave API.
        time: From the call to the answer, in seconds, measured on the node's machine.
        pid: Its process.
    """

    uri: str
    time: float
    pid: int


class NodeEnd(msgspec.Struct, kw_only=True, frozen=True):
    """What became of a node that was asked to end.

    Attributes:
        gone: Whether nothing listens at its slave API any more.
    """

    gone: bool


class PeerNodes(msgspec.Struct, kw_only=True, frozen=True):
    """One module's nodes.

    Attributes:
        peer: The peer's name.
        nodes: Its own nodes.
        problem: Why it did not tell, ready to read; ``nodes`` are those that stand in this graph then.
    """

    peer: str
    nodes: tuple[NodeLine, ...] = ()
    problem: str = ""


def list_nodes(
    publishers: Mapping[str, Collection[str]],
    subscribers: Mapping[str, Collection[str]],
    services: Mapping[str, Collection[str]],
    uris: Mapping[str, str],
    problems: Mapping[str, str],
    yielder: Callable[[Iterable[Collection[str]]], Iterable[Collection[str]]] = iter,
) -> tuple[NodeLine, ...]:
    """Every node of a graph, by name.

    Args:
        publishers: Nodes by topic.
        subscribers: Likewise.
        services: Nodes by service.
        uris: Slave APIs by node, as far as they are known.
        problems: By node: why it cannot be connected to.
        yielder: For graphs of thousands of topics.
    """
    counts: dict[str, list[int]] = {}
    for index, table in enumerate((publishers, subscribers, services)):
        for nodes in yielder(list(table.values())):
            for node in nodes:
                counts.setdefault(node, [0, 0, 0])[index] += 1
    return tuple(
        NodeLine(
            name=node,
            uri=uris.get(node, ""),
            publications=counts[node][0],
            subscriptions=counts[node][1],
            services=counts[node][2],
            problem=problems.get(node, ""),
        )
        for node in sorted(counts)
    )


def describe_node(
    node: str,
    uri: str,
    publishers: Mapping[str, Collection[str]],
    subscribers: Mapping[str, Collection[str]],
    services: Mapping[str, Collection[str]],
    types: Mapping[str, str],
) -> NodeFacts:
    """What the graph says of one node; whether it answers is not asked.

    Args:
        node: Its name.
        uri: Its slave API.
        publishers: Nodes by topic.
        subscribers: Likewise.
        services: Nodes by service.
        types: By topic, as far as they are known.
    """
    return NodeFacts(
        name=node,
        uri=uri,
        publications={topic: types.get(topic, "*") for topic in sorted(publishers) if node in publishers[topic]},
        subscriptions={topic: types.get(topic, "*") for topic in sorted(subscribers) if node in subscribers[topic]},
        services=tuple(service for service in sorted(services) if node in services[service]),
    )
