"""Records about nodes, as ``rmpa node`` shows them and agents send them to each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping


class NodeLine(msgspec.Struct, kw_only=True, frozen=True):
    """One node in a list.

    Attributes:
        name: Its name in its own graph.
        uri: Its slave API; empty if the master does not have it.
        publications: Number of topics that it publishes.
        subscriptions: Number of topics that it subscribes to.
        services: Number of services that it provides.
        problem: Why its core cannot connect to it, for people; empty if it can, or has not tried.
    """

    name: str
    uri: str = ""
    publications: int = 0
    subscriptions: int = 0
    services: int = 0
    problem: str = ""


class NodeConnection(msgspec.Struct, kw_only=True, frozen=True):
    """One connection of a node over which messages of a topic go, as the node tells it (``getBusInfo``).

    Attributes:
        topic: The topic.
        inbound: Whether it is from a publisher; else it is to a subscriber.
        other: The node at its other end; that node's slave API where the name is not known.
        connected: Whether messages can flow, as far as the node knows.
    """

    topic: str
    inbound: bool
    other: str
    connected: bool = True


class NodeFacts(msgspec.Struct, kw_only=True, frozen=True):
    """Everything known of one node.

    Attributes:
        name: Its name in its own graph.
        uri: Its slave API.
        pid: Its process id; ``None`` if it did not answer.
        problem: Why it did not answer, for people; empty if it did.
        publications: Types by topic; ``*`` for an unknown type.
        subscriptions: Types by topic.
        services: The names of its services.
        connections: What it tells of its connections; ``None`` where it does not, or an earlier release answers.
    """

    name: str
    uri: str = ""
    pid: int | None = None
    problem: str = ""
    publications: dict[str, str] = {}
    subscriptions: dict[str, str] = {}
    services: tuple[str, ...] = ()
    connections: tuple[NodeConnection, ...] | None = None


class NodePing(msgspec.Struct, kw_only=True, frozen=True):
    """One answer of a node to a ping.

    Attributes:
        uri: Its slave API.
        time: Seconds from the call to the answer, measured on the node's machine.
        pid: Its process id.
    """

    uri: str
    time: float
    pid: int


class NodeEnd(msgspec.Struct, kw_only=True, frozen=True):
    """The result of a request to shut a node down.

    Attributes:
        gone: Whether nothing listens at its slave API any more.
    """

    gone: bool


class PeerNodes(msgspec.Struct, kw_only=True, frozen=True):
    """One module's nodes.

    Attributes:
        peer: The peer's name.
        nodes: Its own nodes.
        problem: Why the peer did not answer, for people; then ``nodes`` are its proxies in this graph.
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
    """List every node of a graph, sorted by name.

    Args:
        publishers: Nodes by topic.
        subscribers: Nodes by topic.
        services: Nodes by service.
        uris: Known slave APIs by node.
        problems: By node: why connecting to it fails.
        yielder: Iterates, and serves pending data in between, in graphs of thousands of topics.
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
    """The registrations of one node; the node itself is not asked.

    Args:
        node: Its name.
        uri: Its slave API.
        publishers: Nodes by topic.
        subscribers: Nodes by topic.
        services: Nodes by service.
        types: Known types by topic.
    """
    return NodeFacts(
        name=node,
        uri=uri,
        publications={topic: types.get(topic, "*") for topic in sorted(publishers) if node in publishers[topic]},
        subscriptions={topic: types.get(topic, "*") for topic in sorted(subscribers) if node in subscribers[topic]},
        services=tuple(service for service in sorted(services) if node in services[service]),
    )
