"""``rmpa service``: lists services, shows one, and calls it.

``rmpa service call``: one call, with a request in YAML or JSON.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.messages import fill_stamps, read_values, to_text
from rmpa.cli.options import (
    FiniteRange,
    GraphOptions,
    Selection,
    completes,
    graph_options,
    selection_options,
    summary,
)
from rmpa.cli.output import (
    Column,
    duration,
    origin_json,
    origin_text,
    peers_of,
    print_json,
    print_line,
    print_names,
    print_table,
    printable,
    read_graph,
    read_name,
    read_namespace,
    require_peer,
    warn,
)
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.http.rpc import call_api
from rmpa.ros.types.find import find_service_type

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.cli.output import Graph, GraphName, Master
    from rmpa.observe.snapshot import ServiceInfo
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.types.messages import MessageType, Plain
    from rmpa.ros.wire.tcpros import ServiceDescription


# Finds the server of a service at the master, and asks it for the service's type.


CALLER_ID: Final = "/rmpa_service"
_AT_ONCE: Final = 16
"""Servers that are asked at the same time."""


@dataclass(frozen=True, slots=True)
class Probed:
    """The answer of a service's server.

    Args:
        uri: Its address; empty if the master does not know it.
        description: The service's type and MD5 sum; ``None`` if the server does not answer.
        problem: Why it does not answer.
    """

    uri: str = ""
    description: ServiceDescription | None = None
    problem: str = ""


async def lookup(master: Master, name: str) -> str:
    """The address of a service's server, ``rosrpc://host:port``.

    Raises:
        UnreachableError: The master does not answer.
        RmpaError: It knows no such service.
    """
    try:
        reply = await call_api(master.uri, "lookupService", CALLER_ID, name)
    except UnreachableError:
        raise master.unreachable() from None
    if reply.code != 1:
        raise RmpaError(f"no service {name} is registered at {master.uri}; `rmpa service list` shows all")
    return str(reply.value)


async def probe(master: Master, name: str) -> Probed:
    """Ask a service's server for its type; an error of the server is in the answer.

    Raises:
        UnreachableError: The master does not answer.
    """
    from rmpa.ros.node.endpoints import probe as ask

    uri = ""
    try:
        uri = await lookup(master, name)
        return Probed(uri, (await ask(uri, name, CALLER_ID, limits.SERVICE_OPEN_TIMEOUT)).description)
    except RmpaError as error:
        return Probed(uri, None, str(error))


async def probe_all(master: Master, names: Iterable[str]) -> dict[str, Probed]:
    """Ask the servers of several services at once."""
    turns = asyncio.Semaphore(_AT_ONCE)

    async def one(name: str) -> tuple[str, Probed]:
        async with turns:
            return name, await probe(master, name)

    return dict(await asyncio.gather(*map(one, names)))


def known_type(description: ServiceDescription) -> ServiceType:
    """The definition of the type that a server names, from this machine's packages or from rmpa's own.

    Raises:
        DefinitionError: It is not known here, or only in another version.
    """
    return find_service_type(description.type, description.md5sum)


# What the agent knows of the services that cross the mesh, as ``rmpa service`` shows it.


def crossing(master: Master, wanted: GraphName) -> tuple[ServiceInfo, ...]:
    """What the master's agent knows of a service, at all peers or the named one; empty without an agent."""
    snapshot = master.snapshot(topics=(), services=(wanted.name,), peers=False)
    return tuple(
        info
        for info in (snapshot.services if snapshot is not None else ())
        if info.name == wanted.name and wanted.peer in (None, info.peer)
    )


def transports(master: Master) -> dict[str, ServiceInfo]:
    """The peers' services in the master's graph, by name; empty without an agent."""
    snapshot = master.snapshot(topics=(), services=True, peers=False)
    return {info.name: info for info in (snapshot.services if snapshot is not None else ()) if info.transport}


def transport_json(info: ServiceInfo | None) -> dict[str, str]:
    """The transport of a peer's service, and the condition by which it is relayed; empty for others."""
    if info is None:
        return {}
    return {"transport": info.transport} | ({"condition": info.condition} if info.condition else {})


def transport_text(info: ServiceInfo | None) -> str:
    """The transport of a peer's service in a few words; empty for others."""
    if info is None:
        return ""
    if info.transport == "direct":
        return "direct"
    return f"relayed ({info.condition})" if info.condition and info.wanted != "relay" else "relayed"


def print_crossing(infos: tuple[ServiceInfo, ...]) -> None:
    """Print whether a service may cross, each peer that offers it, and how its calls went."""
    for info in infos:
        print_line(f" * {_headline(info)}")
        for label, text in _facts(info):
            print_line(f"     {label:<10} {text}")
        if info.problem:
            warn(f"{info.peer or info.node}: {info.problem}")


def _headline(info: ServiceInfo) -> str:
    if info.direction == "out":
        who = f", open at {', '.join(info.callers)}" if info.callers else ""
        return f"{'may cross' if info.crosses else 'stays home'}: {info.policy}{who}"
    over_there = f", {info.wire} over there" if info.wire else ""
    state = f"not here: {info.hidden}" if info.hidden else info.state
    return f"from {info.peer}: {info.node}{over_there}, {state}"


def _transport(info: ServiceInfo) -> list[tuple[str, str]]:
    if info.direct_callers:
        return [("transport", f"direct for {', '.join(info.direct_callers)}")]
    if info.transport == "direct":
        return [("transport", f"direct, at {info.address}, {info.lookups} lookups answered so")]
    if info.transport and info.wanted != "relay":
        why = f" ({info.condition}): {info.relayed_because}" if info.condition else "; its module is being asked"
        return [("transport", f"relayed{why}")]
    return []


def _facts(info: ServiceInfo) -> list[tuple[str, str]]:
    facts = _transport(info)
    if info.calls or info.active:
        under_way = f", {info.active} under way" if info.active else ""
        facts.append(("calls", f"{info.calls}, {info.failed} failed{under_way}"))
    if info.latency is not None:
        spread = info.latency
        label = "latency" if info.direction == "in" else "server"
        facts.append((label, f"p50 {duration(spread.p50)}, p99 {duration(spread.p99)}, max {duration(spread.max)}"))
    return facts


_LOOK: Final = 0.1
"""Seconds between two questions to the master whether the service is there."""


@click.command(
    context_settings={"ignore_unknown_options": True},
    epilog="""\
\b
The request is one YAML value, or one for each field in order; what is not given is 0, empty or false.
Its type is the server's; its definition comes with rmpa, or from this machine's ROS packages (PYTHONPATH,
ROS_PACKAGE_PATH, CMAKE_PREFIX_PATH).

\b
Examples:
  rmpa service call /add_two_ints 20 22
  rmpa service call /arm/enable '{data: true}'
  rmpa service call base:/plan '{start: {header: auto}}' --timeout 120
  rmpa service call /map_server/static_map --wait --json | jq .response.map.info
""",
)
@click.argument("service", shell_complete=completes("service"))
@click.argument("values", nargs=-1)
@click.option("-w", "--wait", is_flag=True, help="Wait until the service is there, for as long as --timeout says.")
@click.option(
    "-t", "--timeout", type=FiniteRange(0.001), default=60.0, show_default=True, help="Seconds for the answer."
)
@graph_options
def call(service: str, values: tuple[str, ...], wait: bool, timeout: float, options: GraphOptions) -> None:
    """Call a SERVICE with VALUES, in YAML or JSON, and print its response.

    An error of the server goes to stderr in its own words, and the exit code is 1.
    """
    wanted = read_name(service, "service")
    plain = read_values(values)
    master = options.master()
    began = time.monotonic()
    response = asyncio.run(_call(master, wanted, plain, timeout, wait=wait))
    if options.as_json:
        print_json({"service": wanted.name, "response": response, "took": time.monotonic() - began})
    elif response:
        click.echo(to_text(response))


async def _call(
    master: Master,
    wanted: GraphName,
    plain: Plain,
    timeout: float,  # noqa: ASYNC109 - the user's
    *,
    wait: bool,
) -> dict[str, Plain]:
    from rmpa.ros.node.service_client import ServiceConnection

    if wait:
        await _wait(master, wanted, timeout)
    graph = await read_graph(master)
    require_peer(master, graph, wanted)
    graph.require_service(wanted)
    uri = await lookup(master, wanted.name)
    connection = await ServiceConnection.open(uri, wanted.name, CALLER_ID, timeout=timeout)
    try:
        kind = known_type(connection.description)
        request = kind.request.serialize(kind.request.make(fill_stamps(plain, time.time_ns())))
        ok, body = await connection.call(request, timeout)
    finally:
        connection.close()
    if not ok:
        text = printable(str(bytes(body), "utf-8", "replace")) or "it gave no reason"
        raise PeerRefused(f"service {wanted.name}", text)
    return kind.response.to_plain(kind.response.deserialize(body))


async def _wait(master: Master, wanted: GraphName, timeout: float) -> None:  # noqa: ASYNC109 - likewise
    """Wait until a service is registered, by the peer if one is named.

    Raises:
        UnreachableError: It is not in time.
    """
    last: RmpaError | None = None
    try:
        async with asyncio.timeout(timeout):
            while True:
                try:
                    (await read_graph(master)).require_service(wanted)
                except RmpaError as error:
                    last = error
                else:
                    return
                await asyncio.sleep(_LOOK)
    except TimeoutError:
        remedy = str(last) if last is not None else ""
        raise UnreachableError(f"service {wanted}", f"{master.uri} within {timeout:g} s", remedy) from None


# ``rmpa service list|info|type|find``: the services of the graph.


def _node(graph: Graph, name: str, unknown: str = "") -> str:
    """The node that serves a service."""
    return next(iter(graph.services.get(name, ())), unknown)


def _service_json(graph: Graph, name: str, found: Probed | None = None) -> dict[str, object]:
    about: dict[str, object] = {"name": name, **origin_json(_node(graph, name))}
    if found is not None:
        said = found.description
        about |= {"uri": found.uri or None, "type": said and said.type, "md5": said and said.md5sum}
        if found.problem:
            about["problem"] = found.problem
    return about


@click.command(
    "list", epilog="\b\nExamples:\n  rmpa service list\n  rmpa service list -v /arm\n  rmpa service list base:/\n"
)
@click.argument("namespace", default="", shell_complete=completes("service"))
@click.option("-v", "--verbose", is_flag=True, help="Types and nodes too; each server is asked.")
@selection_options
@graph_options
def list_(namespace: str, verbose: bool, selection: Selection, options: GraphOptions) -> None:
    """List services, all or those of a NAMESPACE.

    A service that a peer offers has its name behind it: /add  [base]. With -v or --json it has its transport, too.
    """
    master, graph = options.graph()
    wanted = read_namespace(namespace, "service")
    require_peer(master, graph, wanted)
    names = [name for name in sorted(graph.services) if wanted.contains(name, peers_of(graph.services[name]))]
    names = every = selection.with_peers(names, lambda name: peers_of(graph.services[name]))
    if not options.as_json and selection.is_long(names):
        names.sort(key=lambda name: (bool(peers_of(graph.services[name])), name))
        owners = ("remote" if peers_of(graph.services[name]) else "of this module" for name in names)
        click.echo(summary(len(names), "services", owners) + "\n")
        names = [*selection.shown(names)]
    found = asyncio.run(probe_all(master, names)) if verbose else {}
    if options.as_json:
        mesh = transports(master)
        print_json([_service_json(graph, name, found.get(name)) | transport_json(mesh.get(name)) for name in names])
    elif verbose:
        mesh = transports(master)
        rows = [
            (name, _type_of(found[name]), origin_text(_node(graph, name, "unknown")), transport_text(mesh.get(name)))
            for name in names
        ]
        columns = (Column("SERVICE"), Column("TYPE"), Column("NODE"), Column("TRANSPORT"))
        shown = len(columns) if mesh else len(columns) - 1
        print_table(columns[:shown], [row[:shown] for row in rows])
    else:
        print_names(names, graph.services)
    if not options.as_json:
        selection.print_rest(every, "services", "rmpa service list MODULE:/, /NAMESPACE, --match '*/start'")


def _type_of(found: Probed) -> str:
    return found.description.type if found.description is not None else "does not answer"


@click.command(
    epilog="\b\nExamples:\n  rmpa service info /add_two_ints\n  rmpa service info base:/arm/enable --json\n"
)
@click.argument("service", shell_complete=completes("service"))
@graph_options
def info(service: str, options: GraphOptions) -> None:
    """Show a service's node, address, type and arguments, and what of it crosses."""
    wanted = read_name(service, "service")
    master, graph = options.graph()
    _require_peer(master, graph, wanted)
    mesh = crossing(master, wanted)
    if any(each.hidden for each in mesh) and all(each.hidden for each in mesh):
        # It is not in the graph because it is hidden: the lines say why.
        if options.as_json:
            print_json({"name": wanted.name, "mesh": mesh})
        else:
            print_crossing(mesh)
        return
    graph.require_service(wanted)
    found = asyncio.run(probe(master, wanted.name))
    request, response, unknown = _halves(found)
    if options.as_json:
        about = _service_json(graph, wanted.name, found)
        about |= {"request": request and _fields(request), "response": response and _fields(response)}
        print_json(about | {"mesh": mesh})
        return
    print_line(f"Node: {origin_text(_node(graph, wanted.name, 'unknown'))}")
    print_line(f"URI: {found.uri}")
    if found.description is None:
        _print_mesh(mesh)
        raise RmpaError(f"{wanted.name} does not say what it is: {found.problem}")
    print_line(f"Type: {found.description.type}")
    print_line(f"MD5: {found.description.md5sum}")
    if request is None or response is None:
        warn(unknown)
    else:
        print_line(f"Args: {' '.join(_fields(request))}")
        for title, half in (("Request", request), ("Response", response)):
            print_line(f"{title}:" + ("" if half.fields else " nothing"))
            for field in half.fields:
                print_line(f"  {field} {field.name}")
    _print_mesh(mesh)


def _require_peer(master: Master, graph: Graph, wanted: GraphName) -> None:
    """Check that the peer is known; where another module serves the name, that is told instead."""
    if wanted.name not in graph.services:
        require_peer(master, graph, wanted)


def _print_mesh(mesh: tuple[ServiceInfo, ...]) -> None:
    if mesh:
        click.echo("\nMesh:")
        print_crossing(mesh)


def _halves(found: Probed) -> tuple[MessageType | None, MessageType | None, str]:
    """The types of request and response, or the reason why they are not known here."""
    if found.description is None:
        return None, None, found.problem
    try:
        kind = known_type(found.description)
    except RmpaError as error:
        return None, None, str(error)
    return kind.request, kind.response, ""


def _fields(half: MessageType) -> list[str]:
    return [field.name for field in half.fields]


@click.command("type", epilog="\b\nExamples:\n  rmpa service type /add_two_ints\n")
@click.argument("service", shell_complete=completes("service"))
@graph_options
def type_(service: str, options: GraphOptions) -> None:
    """Print a service's type."""
    wanted = read_name(service, "service")
    master, graph = options.graph()
    _require_peer(master, graph, wanted)
    graph.require_service(wanted)
    found = asyncio.run(probe(master, wanted.name))
    if found.description is None:
        raise RmpaError(f"{wanted.name} does not say what it is: {found.problem}")
    if options.as_json:
        print_json({"name": wanted.name, "type": found.description.type, "md5": found.description.md5sum})
    else:
        print_line(found.description.type)


@click.command(epilog="\b\nExamples:\n  rmpa service find std_srvs/Trigger\n")
@click.argument("kind", metavar="TYPE")
@graph_options
def find(kind: str, options: GraphOptions) -> None:
    """Print the services of a TYPE; each server is asked, and one that does not answer is named on stderr."""
    master, graph = options.graph()
    probed = asyncio.run(probe_all(master, sorted(graph.services)))
    found = [name for name, each in probed.items() if each.description is not None and each.description.type == kind]
    for name, each in probed.items():
        if each.description is None:
            warn(f"{name}: {each.problem}")
    if options.as_json:
        print_json(found)
    else:
        print_names(found, graph.services)
