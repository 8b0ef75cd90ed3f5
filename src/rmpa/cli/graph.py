"""The graph of a ROS master: topics, services and nodes, and the names that users write for them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import click

from rmpa.bridge.proxies import proxied_node, proxied_peer
from rmpa.cli.output import printable, warn
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.identity import is_legal_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rmpa.cli.master import Master
    from rmpa.observe.peer_info import PeerInfo
    from rmpa.observe.snapshot import Snapshot


@dataclass(frozen=True, slots=True)
class GraphName:
    """A topic, service, node or resource as a user names it: ``/cmd``, or ``joystick:/cmd`` for one peer's.

    A module of another site is the peer ``warehouse/arm``.
    """

    name: str
    peer: str | None = None

    def matches(self, node: str) -> bool:
        """Whether what this local node (perhaps a proxy) offers is meant."""
        if self.peer is None or (proxy := proxied_node(node)) is None:
            return self.peer is None
        return proxy[0] == self.peer or ("/" in self.peer and "".join(proxy).startswith(f"{self.peer}/"))

    def contains(self, name: str, peers: Iterable[str | None]) -> bool:
        """Whether a name is in this namespace, and from the peer if one is named.

        Args:
            name: Of a topic, service or node.
            peers: The peers that offer it.
        """
        inside = self.name == "/" or f"{name}/".startswith(f"{self.name}/")
        return inside and (self.peer is None or self.peer in peers)

    def __str__(self) -> str:
        """As a user writes it."""
        return self.name if self.peer is None else f"{self.peer}:{self.name}"


EVERYTHING = GraphName("/")
"""The namespace of all names, of this module and of its peers."""


def read_name(text: str, what: str = "topic") -> GraphName:
    """Read ``NAME`` or ``PEER:NAME``; a relative name is one of the root namespace.

    Args:
        text: What the user wrote.
        what: ``topic``, ``service``, ``node`` or ``resource``, for the error.

    Raises:
        ConfigError: It is no legal name.
    """
    peer, colon, name = text.rpartition(":")
    if not name or not is_legal_name(name) or name.startswith("~") or (colon and not peer):
        raise ConfigError(what.upper(), f"{text!r} is not a {what}", "write /name, or PEER:/name for one peer's")
    return GraphName("/" + name.strip("/"), peer or None)


def find_peer(snapshot: Snapshot, wanted: str) -> PeerInfo:
    """The peer of that name or GUID.

    Raises:
        RmpaError: There is none; the text offers the nearest name.
    """
    for info in (*snapshot.peers, *snapshot.strangers):
        if wanted in (info.name, info.guid, info.guid.partition("#")[0]):
            return info
    names = [info.name for info in snapshot.peers]
    near = did_you_mean(wanted, names)
    known = f"known are {', '.join(names)}" if names else "no peer is known yet"
    raise RmpaError(
        f"{snapshot.agent.name} knows no peer {wanted!r}; " + (f"did you mean {near}?" if near else known)
    )


def require_peer(master: Master, graph: Graph, wanted: GraphName) -> None:
    """Check that the peer of a name is known here: a node of it stands in the graph, or the agent knows the peer.

    Raises:
        UnreachableError: The master is not an agent's core, and so knows no peers.
        RmpaError: There is no such peer; the text offers the nearest name.
    """
    if wanted.peer is None or any(wanted.matches(node) for node in graph.nodes):
        return
    snapshot = master.snapshot(topics=())
    if snapshot is None:
        raise master.no_agent()
    known = {peer.name for peer in snapshot.peers}
    if wanted.peer == snapshot.agent.name and wanted.peer not in known:
        raise RmpaError(f"{wanted.peer} is this module itself: leave it out and write {wanted.name}")
    # Of a module of another site, SITE/MODULE, the agent knows the site.
    peer = find_peer(snapshot, wanted.peer.partition("/")[0])
    if peer.name not in wanted.peer:
        raise RmpaError(f"{wanted.peer} is the GUID of {peer.name}: write {peer.name}:{wanted.name}")


def read_namespace(text: str, what: str) -> GraphName:
    """Read a namespace; an empty text is that of all names.

    Raises:
        ConfigError: As ``read_name``.
    """
    return read_name(text, what) if text else EVERYTHING


def origin_json(node: str) -> dict[str, str]:
    """A node for JSON: a proxy with the peer and the node that it stands for."""
    proxy = proxied_node(node)
    return {"node": node} if proxy is None else {"node": node, "peer": proxy[0], "remote_node": proxy[1]}


def origin_text(node: str) -> str:
    """A node in words: a proxy with the peer and the node that it stands for."""
    proxy = proxied_node(node)
    return node if proxy is None else f"{proxy[1]} of peer {proxy[0]}, by its proxy {node}"


def print_names(names: Iterable[str], nodes: dict[str, list[str]]) -> None:
    """Print names, one a line, each with the peers that offer it behind it.

    Args:
        names: Of topics or services.
        nodes: The nodes that offer each.
    """
    for name in names:
        click.echo(printable(name) + peers_mark(nodes.get(name, ())))


def peers_mark(nodes: Iterable[str]) -> str:
    """The peers of some nodes behind a name, ``  [joystick]``; empty where there are none."""
    peers = ", ".join(peers_of(nodes))
    return click.style(printable(f"  [{peers}]"), fg="cyan") if peers else ""


def peers_of(nodes: Iterable[str]) -> list[str]:
    """The peers of the proxies among some nodes, in order."""
    return sorted({peer for node in nodes if (peer := proxied_peer(node)) is not None})


def unknown_name(what: str, name: str, known: Iterable[str]) -> RmpaError:
    """The error for a name that is not in the graph: it offers the nearest one.

    Args:
        what: ``topic``, ``service``, ``node`` or ``resource``.
        name: The name.
        known: Those that there are.
    """
    near = did_you_mean(name, known)
    return RmpaError(f"no {what} {name}; " + (f"did you mean {near}?" if near else f"`rmpa {what} list` shows all"))


def warn_unpublished(master: Master, graph: Graph, wanted: GraphName) -> None:
    """Say on stderr that no node publishes a topic yet, if that is so: a command waits for its messages.

    Args:
        master: The master of the graph.
        graph: The graph.
        wanted: The topic; with a peer only that peer's publishers count.
    """
    if any(map(wanted.matches, graph.publishers.get(wanted.name, ()))):
        return
    near = did_you_mean(wanted.name, graph.publishers) if wanted.name not in graph.publishers else None
    hint = f"did you mean {near}?" if near else f"`rmpa why {wanted}` says why" if master.agent is not None else ""
    warn(f"{wanted} is not published yet; waiting" + (f" ({hint})" if hint else ""))


@dataclass(frozen=True, slots=True)
class Graph:
    """The graph of a master.

    Args:
        publishers: The names of the nodes by topic, in order.
        subscribers: Likewise.
        types: By topic; a topic without a known type is not in it.
        services: The names of the nodes by service; one at the most, with a correct master.
    """

    publishers: dict[str, list[str]] = field(default_factory=dict)
    subscribers: dict[str, list[str]] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    services: dict[str, list[str]] = field(default_factory=dict)

    @property
    def topics(self) -> list[str]:
        """All topics, in order."""
        return sorted(self.publishers.keys() | self.subscribers.keys())

    @property
    def nodes(self) -> list[str]:
        """The names of all nodes, in order."""
        tables = (self.publishers, self.subscribers, self.services)
        return sorted({node for table in tables for nodes in table.values() for node in nodes})

    def require_topic(self, topic: str) -> None:
        """Check that a topic is there.

        Raises:
            RmpaError: It is not; the text offers the nearest one.
        """
        if topic not in self.publishers and topic not in self.subscribers:
            raise unknown_name("topic", topic, self.topics)

    def require_service(self, wanted: GraphName) -> str:
        """Check that a service is there; return the node that serves it.

        Raises:
            RmpaError: It is not, or another module's; the text offers the nearest one.
        """
        if wanted.name not in self.services:
            raise unknown_name("service", wanted.name, self.services)
        nodes = self.services[wanted.name]
        if wanted.peer is not None and not any(map(wanted.matches, nodes)):
            remedy = f"what {wanted.peer} offers under this name is hidden by it, if there is any"
            served = f"service {wanted.name} is served by {', '.join(nodes)}"
            raise RmpaError(f"{served}, not by peer {wanted.peer}; {remedy}")
        return nodes[0] if nodes else ""


async def read_graph(master: Master) -> Graph:
    """Ask a master for its graph.

    Raises:
        UnreachableError: It does not answer.
        RmpaError: It answers with something else.
    """
    from rmpa.ros.http.rpc import call_api

    try:
        state = (await call_api(master.uri, "getSystemState", "/rmpa_topic")).value
        types = (await call_api(master.uri, "getTopicTypes", "/rmpa_topic")).value
    except UnreachableError:
        raise master.unreachable() from None
    match state, types:
        case [list(publishers), list(subscribers), list(services), *_], list(pairs):
            known = {str(p[0]): str(p[1]) for p in pairs if isinstance(p, list) and len(p) == 2 and p[1] != "*"}
            return Graph(_nodes(publishers), _nodes(subscribers), known, _nodes(services))
    raise RmpaError(f"{master.uri} answers getSystemState with something else; is it a ROS master?")


def _nodes(pairs: Sequence[object]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for pair in pairs:
        match pair:
            case [str(name), list(nodes)]:
                found[name] = sorted(str(node) for node in nodes)
    return found
