"""``rmpa service list|info|type|find``: the services of the graph."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import click

from rmpa.cli.graph import origin_json, origin_text, peers_of, print_names, read_name, read_namespace, require_peer
from rmpa.cli.options import GraphOptions, completes, graph_options
from rmpa.cli.output import Column, print_json, print_line, print_table, warn
from rmpa.cli.selection import Selection, selection_options, summary
from rmpa.cli.service_crossing import crossing, print_crossing, transport_json, transport_text, transports
from rmpa.cli.service_probe import known_type, probe, probe_all
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from rmpa.cli.graph import Graph, GraphName
    from rmpa.cli.master import Master
    from rmpa.cli.service_probe import Probed
    from rmpa.observe.snapshot import ServiceInfo
    from rmpa.ros.types.messages import MessageType


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
