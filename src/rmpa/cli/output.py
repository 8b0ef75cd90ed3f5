"""What commands print (lines, tables, JSON), and the graph and the master that they read.

What commands print: lines, tables, JSON, and numbers with units.

Colours are click's: it drops them where standard output is no terminal, and everywhere with ``NO_COLOR``.
"""

from __future__ import annotations

import contextlib
import math
import re
import sys
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import TYPE_CHECKING, Final

import click
import msgspec

from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.identity import is_legal_name, proxied_node, proxied_peer
from rmpa.observe.control_client import ControlClient, choose_agent, find_agents, same_core
from rmpa.observe.peer_info import CheckLevel
from rmpa.observe.snapshot import Snapshot
from rmpa.ros.environment import DEFAULT_MASTER_URI

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from rmpa.observe.peer_info import PeerInfo

_ANY_WIDTH: Final = 10_000
"""Columns of a terminal that no table needs."""
_INDENT: Final = "    "
_UNITS: Final = ("B", "kB", "MB", "GB", "TB")
LEVEL_COLOURS: Final = {
    CheckLevel.OK: "green",
    CheckLevel.WARN: "yellow",
    CheckLevel.FAIL: "red",
    CheckLevel.SKIPPED: "cyan",
    CheckLevel.UNKNOWN: "yellow",
    CheckLevel.STALE: "yellow",
}
"""Of the results of ``rmpa doctor`` and ``rmpa why``, on a terminal."""


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table: its heading, and whether its cells are aligned to the right, as numbers are."""

    title: str
    right: bool = False


def json_text(value: object) -> str:
    """A value as JSON; msgspec structs are objects, NaN and infinity are null."""
    return msgspec.json.encode(value).decode()


def print_json(value: object) -> None:
    """One JSON document on one line of standard output, at once."""
    click.echo(json_text(value))


def print_table(columns: Sequence[Column], rows: Sequence[Sequence[str]], *, colours: Sequence[str] = ()) -> None:
    """Print a table under its headings: by rich on a terminal, as aligned plain text elsewhere.

    No cell is cut. Where a table is wider than the terminal, each row is a paragraph: the first cell, then the others
    behind their headings.

    Args:
        columns: From left to right.
        rows: One text a column; control characters are escaped here.
        colours: One name of a colour a row, for the second column on terminals; empty for none.
    """
    rows = [[printable(cell) for cell in row] for row in rows]
    if sys.stdout.isatty():
        _print_rich(columns, rows, colours)
        return
    # Not by rich: it takes seconds over the ten thousand topics that a peer may have.
    lines = [[column.title for column in columns], *rows]
    width = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    for line in lines:
        cells = (t.rjust(w) if c.right else t.ljust(w) for c, t, w in zip(columns, line, width, strict=True))
        sys.stdout.write("  ".join(cells).rstrip() + "\n")


def _print_rich(columns: Sequence[Column], rows: Sequence[Sequence[str]], colours: Sequence[str]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        table.add_column(column.title, justify="right" if column.right else "left", no_wrap=True)
    for row, style in zip_longest(rows, colours, fillvalue=""):
        table.add_row(*(Text(cell, style=style if index == 1 else "") for index, cell in enumerate(row)))
    if console.measure(table, options=console.options.update(width=_ANY_WIDTH)).maximum <= console.width:
        console.print(table)
        return
    for row, style in zip_longest(rows, colours, fillvalue=""):
        console.print(Text(row[0], style="bold"), overflow="fold")
        line = Text()
        for index, (column, cell) in enumerate(zip(columns[1:], row[1:], strict=True)):
            if cell in ("", "-"):
                continue
            fact = Text(f"{column.title.strip().lower()} {cell}", style="" if index else style)
            if line and len(_INDENT) + line.cell_len + 2 + fact.cell_len > console.width:
                console.print(_INDENT, line, sep="", overflow="fold")
                line = Text()
            line = Text(", ").join((line, fact)) if line else fact
        console.print(_INDENT, line, sep="", overflow="fold")


def warn(text: str) -> None:
    """One line on stderr, yellow on a terminal; control characters are escaped."""
    click.secho(f"! {printable(text)}", err=True, fg="yellow")


def print_error(error: object) -> None:
    """``rmpa: …`` on stderr. An error may hold the words of a peer or a node: control characters are escaped."""
    click.echo("\n".join(map(printable, f"rmpa: {error}".split("\n"))), err=True)


def print_line(text: str = "", colour: str | None = None) -> None:
    """One line on standard output at once; control characters are escaped, and terminals show the colour."""
    text = printable(text)
    click.echo(text if colour is None else click.style(text, fg=colour))


def printable(text: str) -> str:
    """Text from the network without characters that move a terminal's cursor: each is escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def duration(seconds: float | None) -> str:
    """A time: ``432 µs``, ``12.3 ms``, ``4.2 s``, ``3 min 20 s``, ``2 h 5 min``, ``3 d 4 h``; ``-`` for none."""
    if seconds is None or math.isnan(seconds):
        return "-"
    length = abs(seconds)
    if length < 0.9995e-3:
        return f"{seconds * 1e6:.0f} µs"
    if length < 0.09995:
        return f"{seconds * 1e3:.2f} ms"
    if length < 1:
        return f"{seconds * 1e3:.0f} ms"
    if length < 59.95:
        return f"{seconds:.1f} s"
    whole = round(length)
    sign = "-" if seconds < 0 else ""  # a clock may be behind by hours; floor division would round away from zero
    if whole < 3600:
        return f"{sign}{whole // 60} min {whole % 60} s"
    if whole < 86400:
        return f"{sign}{whole // 3600} h {whole % 3600 // 60} min"
    return f"{sign}{whole // 86400} d {whole % 86400 // 3600} h"


def size(count: float | None) -> str:
    """A number of bytes: ``17 B``, ``1.23 kB``, ``45.6 MB`` (powers of 1000); ``-`` for none."""
    if count is None or math.isnan(count):
        return "-"
    power = 0
    while abs(count) >= 999.5 and power < len(_UNITS) - 1:
        count /= 1000
        power += 1
    if power == 0:
        return f"{count:.0f} B"
    digits = 2 if abs(count) < 9.995 else 1 if abs(count) < 99.95 else 0
    return f"{count:.{digits}f} {_UNITS[power]}"


# The ROS master that a command asks.
#
# In this order: ``--master``; the core of the agent named by ``--agent`` or RMPA_AGENT; ROS_MASTER_URI, as the
# stock
# tools have it; the core of the only agent of this machine; ``http://localhost:11311``.


_REMEDY: Final = "start one with `rmpa up` or `rmpa core`, or name it with --master"


@dataclass(frozen=True, slots=True)
class Master:
    """The master to ask.

    Args:
        uri: Its address.
        source: Why it was chosen (``--master``, ``ROS_MASTER_URI`` …), for the text of errors.
        agent: The control socket of the agent whose core it is; ``None`` for any other master.
    """

    uri: str
    source: str
    agent: Path | None = None

    def unreachable(self) -> UnreachableError:
        """The error for a master that does not answer."""
        return UnreachableError("ROS master", f"{self.uri} ({self.source})", _REMEDY)

    def no_agent(self) -> UnreachableError:
        """The error for a question about peers at a master that is not an agent's core."""
        remedy = "name the agent with --agent, or run `rmpa up`: only an agent knows peers"
        return UnreachableError("agent", f"{self.uri} ({self.source})", remedy)

    def snapshot(
        self,
        *,
        topics: tuple[str, ...] | None = None,
        services: tuple[str, ...] | bool | None = None,
        peers: bool = True,
    ) -> Snapshot | None:
        """The snapshot of the master's agent; ``None`` without an agent, or if it does not answer.

        Args:
            topics: Only these topics are in it; ``None``: all, which takes the agent longer.
            services: Only these are in it; ``True``: all; ``None``: all if all topics are in it, else none.
            peers: Whether peers are in it.
        """
        if self.agent is not None:
            with contextlib.suppress(RmpaError), ControlClient(self.agent) as client:
                return client.call("snapshot", Snapshot, topics=topics, services=services, peers=peers)
        return None


def choose_master(master: str | None, agent: str | None, environ: Mapping[str, str]) -> Master:
    """Choose the master, in the order that this module's docstring gives.

    Raises:
        UnreachableError: The named agent does not answer.
        RmpaError: Several agents run, and none is named.
        ConfigError: ``--master`` is no URI.
    """
    if master is not None:
        if not re.fullmatch(r"http://[^\s/:]+:[0-9]{1,5}/?", master):
            raise ConfigError("--master", f"{master!r} is not a master's URI", f"one looks like {DEFAULT_MASTER_URI}")
        return _with_agent(master, "--master", environ)
    uri = environ.get("ROS_MASTER_URI", "")
    if not agent and not environ.get("RMPA_AGENT"):
        if uri:
            return _with_agent(uri, "ROS_MASTER_URI", environ)
        if not find_agents(environ):
            return Master(DEFAULT_MASTER_URI, "no agent runs")
    found = choose_agent(environ, agent)
    with ControlClient(found.path) as client:
        return Master(client.agent().core_uri, f"the core of agent {found.name}", found.path)


def _with_agent(uri: str, source: str, environ: Mapping[str, str]) -> Master:
    """A master given by its URI; with its agent if the URI is that of an agent's core."""
    for found in find_agents(environ):
        with contextlib.suppress(RmpaError), ControlClient(found.path) as client:
            if same_core(client.agent().core_uri, uri):
                return Master(uri, source, found.path)
    others = ", ".join(found.name for found in find_agents(environ))
    # The classic mistake: a shell that still points to yesterday's robot.
    return Master(uri, f"{source}; not the core of {others}: unset it, or say --agent" if others else source)


# The graph of a ROS master: topics, services and nodes, and the names that users write for them.


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
