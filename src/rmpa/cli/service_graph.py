"""``rmpa service list|info|type|find``: what the graph offers."""

from __future__ import annotations

import asyncio
import os
from typing import TYPE_CHECKING

import click

from rmpa.bridge.proxy_names import proxied_node
from rmpa.cli.master import Graph, Master, choose_master, read_graph, read_topic
from rmpa.cli.options import agent_option, json_option, master_option
from rmpa.cli.output import Column, coloured, print_json, print_table, printable, warn
from rmpa.cli.service_ends import known_type, probe, probe_all, require_service, service_peers
from rmpa.cli.service_mesh import crossing, print_crossing
from rmpa.core.errors import RmpaError

if TYPE_CHECKING:
    from rmpa.cli.service_ends import Probed
    from rmpa.observe.snapshot import ServiceInfo
    from rmpa.ros.types.messages import MessageType


def _graph(master: str | None, agent: str | None) -> tuple[Master, Graph]:
    chosen = choose_master(master, agent, os.environ)
    return chosen, asyncio.run(read_graph(chosen))


def _service_json(graph: Graph, name: str, found: Probed | None = None) -> dict[str, object]:
    node = next(iter(graph.services.get(name, ())), "")
    proxy = proxied_node(node)
    about: dict[str, object] = {"name": name, "node": node}
    if proxy is not None:
        about |= {"peer": proxy[0], "remote_node": proxy[1]}
    if found is not None:
        said = found.description
        about |= {"uri": found.uri or None, "type": said and said.type, "md5": said and said.md5sum}
        if found.problem:
            about["problem"] = found.problem
    return about


def _mark(graph: Graph, name: str) -> str:
    peers = service_peers(graph, name)
    text = printable(f"  [{', '.join(peers)}]") if peers else ""
    return click.style(text, fg="cyan") if text and coloured() else text


@click.command(
    "list", epilog="\b\nExamples:\n  rmpa service list\n  rmpa service list -v /arm\n  rmpa service list base:/\n"
)
@click.argument("namespace", default="")
@click.option("-v", "--verbose", is_flag=True, help="Types and nodes too; each server is asked.")
@json_option
@agent_option
@master_option
def list_(namespace: str, verbose: bool, as_json: bool, agent: str | None, master: str | None) -> None:
    """List services, all or those of a NAMESPACE.

    A service that a peer offers has its name behind it: /add  [base].
    """
    chosen, graph = _graph(master, agent)
    wanted = read_topic(namespace, "service") if namespace else None
    names = [
        name
        for name in sorted(graph.services)
        if (wanted is None or wanted.topic == "/" or f"{name}/".startswith(f"{wanted.topic}/"))
        and (wanted is None or wanted.peer is None or wanted.peer in service_peers(graph, name))
    ]
    found = asyncio.run(probe_all(chosen, names)) if verbose else {}
    if as_json:
        print_json([_service_json(graph, name, found.get(name)) for name in names])
    elif verbose:
        rows = [(printable(name), printable(_type_of(found[name])), printable(_whose(graph, name))) for name in names]
        print_table((Column("SERVICE"), Column("TYPE"), Column("NODE")), rows)
    else:
        for name in names:
            click.echo(printable(name) + _mark(graph, name))


def _type_of(found: Probed) -> str:
    return found.description.type if found.description is not None else "does not answer"


def _whose(graph: Graph, name: str) -> str:
    node = next(iter(graph.services.get(name, ())), "unknown")
    proxy = proxied_node(node)
    return node if proxy is None else f"{proxy[1]} of peer {proxy[0]}, by its proxy {node}"


@click.command(
    epilog="\b\nExamples:\n  rmpa service info /add_two_ints\n  rmpa service info base:/arm/enable --json\n"
)
@click.argument("service")
@json_option
@agent_option
@master_option
def info(service: str, as_json: bool, agent: str | None, master: str | None) -> None:
    """Show a service's node, address, type and arguments, and what of it crosses."""
    wanted = read_topic(service, "service")
    chosen, graph = _graph(master, agent)
    mesh = crossing(chosen, wanted)
    if any(each.hidden for each in mesh) and all(each.hidden for each in mesh):
        # Not in the graph, and that is what the user wants to know.
        if as_json:
            print_json({"name": wanted.topic, "mesh": mesh})
        else:
            print_crossing(mesh)
        return
    require_service(graph, wanted)
    found = asyncio.run(probe(chosen, wanted.topic))
    request, response, unknown = _halves(found)
    if as_json:
        about = _service_json(graph, wanted.topic, found)
        about |= {"request": request and _fields(request), "response": response and _fields(response)}
        print_json(about | {"mesh": mesh})
        return
    click.echo(f"Node: {printable(_whose(graph, wanted.topic))}")
    click.echo(f"URI: {printable(found.uri)}")
    if found.description is None:
        _print_mesh(mesh)
        raise RmpaError(f"{wanted.topic} does not say what it is: {found.problem}")
    click.echo(f"Type: {printable(found.description.type)}")
    click.echo(f"MD5: {printable(found.description.md5sum)}")
    if request is None or response is None:
        warn(printable(unknown))
    else:
        click.echo(f"Args: {' '.join(_fields(request))}")
        for title, half in (("Request", request), ("Response", response)):
            click.echo(f"{title}:" + ("" if half.fields else " nothing"))
            for field in half.fields:
                click.echo(f"  {field} {field.name}")
    _print_mesh(mesh)


def _print_mesh(mesh: tuple[ServiceInfo, ...]) -> None:
    if mesh:
        click.echo("\nMesh:")
        print_crossing(mesh)


def _halves(found: Probed) -> tuple[MessageType | None, MessageType | None, str]:
    """The request's and the response's types, or why they are not known here."""
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
@click.argument("service")
@json_option
@agent_option
@master_option
def type_(service: str, as_json: bool, agent: str | None, master: str | None) -> None:
    """Print a service's type."""
    wanted = read_topic(service, "service")
    chosen, graph = _graph(master, agent)
    require_service(graph, wanted)
    found = asyncio.run(probe(chosen, wanted.topic))
    if found.description is None:
        raise RmpaError(f"{wanted.topic} does not say what it is: {found.problem}")
    if as_json:
        print_json({"name": wanted.topic, "type": found.description.type, "md5": found.description.md5sum})
    else:
        click.echo(printable(found.description.type))


@click.command(epilog="\b\nExamples:\n  rmpa service find std_srvs/Trigger\n")
@click.argument("kind", metavar="TYPE")
@json_option
@agent_option
@master_option
def find(kind: str, as_json: bool, agent: str | None, master: str | None) -> None:
    """Print the services of a TYPE; each server is asked, and one that does not answer is named on stderr."""
    chosen, graph = _graph(master, agent)
    probed = asyncio.run(probe_all(chosen, sorted(graph.services)))
    found = [name for name, each in probed.items() if each.description is not None and each.description.type == kind]
    for name, each in probed.items():
        if each.description is None:
            warn(printable(f"{name}: {each.problem}"))
    if as_json:
        print_json(found)
    else:
        for name in found:
            click.echo(printable(name) + _mark(graph, name))
