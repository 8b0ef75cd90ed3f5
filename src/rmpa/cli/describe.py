"""``rmpa resource describe``, ``check`` and ``schema``: files in TOML that make a Smart Resource of nodes."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click
import msgspec

from rmpa.cli.completion import nodes
from rmpa.cli.graph import Graph, GraphName, read_graph, read_name, unknown_name, with_node
from rmpa.cli.main import verb
from rmpa.cli.options import FiniteRange, Options, argument, flag, graph_verb
from rmpa.cli.output import printable
from rmpa.core.errors import RmpaError, StartError
from rmpa.core.identity import proxied_node
from rmpa.ros.core.liveness import ping_node
from rmpa.ros.environment import NodeFacts, describe_node
from rmpa.ros.http.rpc import call_api

if TYPE_CHECKING:
    from rmpa.resource.checking import Misfit
    from rmpa.resource.describing import Found
    from rmpa.resource.resource import Resource
    from rmpa.ros.node.node import Node

_CALLER_ID: Final = "/rmpa_resource"
_seconds = click.option(
    "--seconds", type=FiniteRange(0.5, 60.0), default=3.0, show_default=True, help="How long it looks at the node."
)


@graph_verb(
    argument("node", nodes),
    click.option("-o", "--output", type=click.Path(path_type=Path), metavar="FILE", help="Write it there."),
    flag("--force", help="Replace the file that is there."),
    _seconds,
)
def resource_describe(node: str, output: Path | None, force: bool, seconds: float, options: Options) -> None:
    """Write a first description of a Smart Resource from a live NODE: topics, rates, parameters, diagnostics.

    What is active in it can be run at once, by `rmpa run FILE`; what else was found stands in comments.

    ---
    It subscribes to what the node publishes while it measures. A node of a peer is written PEER:/node; what it
    offers here is told.

    Examples:
      rmpa resource describe /usb_cam
      rmpa resource describe /usb_cam -o camera.resource.toml
    """
    from rmpa.resource.description import SUFFIX

    if output is not None and output.exists() and not force:
        raise StartError(str(output), "is there already", "--force replaces it")
    wanted = read_name(node, "node")
    click.echo(f"looking at {printable(str(wanted))} for {seconds:g} s ...", err=True)
    found = asyncio.run(_found(options, wanted, seconds))
    from rmpa.resource.describing import describe

    title = output.name.removesuffix(SUFFIX).removesuffix(".toml") if output is not None else ""
    text = describe(found, title)
    if output is None:
        options.show({"node": str(wanted), "text": text}, *text.splitlines())
        return
    try:
        output.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StartError(str(output), f"cannot be written: {error.strerror}") from None
    active = sum(bool(line) and not line.startswith("#") for line in text.splitlines())
    said = f"{output} is written, {active} lines without comments. Next: rmpa resource check {output}"
    options.show({"node": str(wanted), "file": str(output)}, said)


@graph_verb(
    argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path)),
    flag("--offline", help="The file alone, without a graph."),
    _seconds,
)
def resource_check(file: Path, offline: bool, seconds: float, options: Options) -> int:
    """Compare the description of a resource, FILE, with the live graph: what does not fit is told with its line.

    An error is what cannot work; a warning is what may be right, or become so: a topic without a publisher yet.

    ---
    Exit codes: 0 it fits, perhaps with warnings; 1 it does not fit the graph; 2 the file itself is wrong.

    Examples:
      rmpa resource check camera.resource.toml
      rmpa resource check camera.resource.toml --offline    before the robot is there
    """
    from rmpa.resource.checking import Misfit
    from rmpa.resource.description import description_mistakes, read_description

    data = file.read_bytes()
    wrong = [Misfit(one.line or 1, one.source, one.problem, one.remedy) for one in description_mistakes(data, file)]
    found = wrong
    if not wrong and not offline:
        click.echo(f"looking at the graph for {seconds:g} s ...", err=True)
        resource = read_description(data, file)
        found = asyncio.run(_misfits(options, resource, data.decode("utf-8-sig"), file, seconds))
    errors = sum(one.error for one in found)
    lines = [
        f"{file}:{one.line}: {'error' if one.error else 'warning'}: {one.where}: {one.problem}"
        + (f"; {one.remedy}" if one.remedy else "")
        for one in found
    ]
    counts = ((errors, "error"), (len(found) - errors, "warning"))
    told_of = ", ".join(f"{count} {what}{'' if count == 1 else 's'}" for count, what in counts)
    summary = f"{file}: {told_of if found else 'it fits'}"
    told = [{**asdict(one), "error": one.error} for one in found]
    options.show({"file": str(file), "errors": errors, "found": told}, *map(printable, lines), printable(summary))
    return 2 if wrong else int(errors > 0)


@verb()
def resource_schema() -> None:
    """Print the JSON Schema of descriptions of resources.

    ---
    Editors check and complete a file whose first line is `#:schema ./resource.schema.json`.

    Examples:
      rmpa resource schema > resource.schema.json
    """
    from rmpa.resource.description import schema_text

    click.echo(schema_text(), nl=False)


async def _misfits(options: Options, resource: Resource, text: str, file: Path, seconds: float) -> list[Misfit]:
    from rmpa.resource.checking import GraphCheck
    from rmpa.resource.describing import DESCRIPTIONS, LiveGraph, look

    master = options.master()
    graph = await read_graph(master)
    names = {node.name for node in resource.nodes.values()} & set(graph.nodes)
    servers = {node.server or node.name for node in resource.nodes.values()}
    sources = [source for _, each in resource.expressions() for source in each.sources.values()]

    async def body(node: Node) -> LiveGraph:
        return await look(
            node,
            topics=[topic for topic in resource.outputs if topic in graph.publishers],
            servers=[name for name in servers if f"{name}{DESCRIPTIONS}" in graph.publishers],
            owners=sorted(names),
            diagnostics=any(source.function == "diagnostics" for source in sources),
            seconds=seconds,
        )

    seen = await with_node(master, "rmpa_resource", body)
    return GraphCheck(resource, text, file, graph.publishers, graph.types, graph.nodes, seen).misfits()


async def _found(options: Options, wanted: GraphName, seconds: float) -> Found:
    """Look at the node."""
    from rmpa.resource.describing import DESCRIPTIONS, DIAGNOSTICS, UPDATES, Found, LiveGraph, look, started_by

    master = options.master()
    graph = await read_graph(master)
    name = next((each for each in graph.nodes if _is(wanted, each)), None)
    if name is None:
        raise unknown_name("node", str(wanted), graph.nodes)
    facts = await _facts(graph, master.uri, name)
    ends = [t.removesuffix(DESCRIPTIONS) for t in facts.publications if t.endswith(DESCRIPTIONS)]
    server = name if name in ends else min(ends, key=len, default="")
    measured = [t for t in facts.publications if not t.endswith((DESCRIPTIONS, UPDATES, "/rosout"))]

    async def body(node: Node) -> LiveGraph:
        return await look(
            node,
            topics=measured,
            servers=[server] if server else [],
            owners=[name],
            diagnostics=DIAGNOSTICS in facts.publications,
            seconds=seconds,
        )

    seen = await with_node(master, "rmpa_resource", body)
    started = started_by(facts.pid) if facts.pid else {}
    return Found(str(wanted), facts, seen, server, started, seconds)


def _is(wanted: GraphName, node: str) -> bool:
    proxy = proxied_node(node)
    if wanted.peer is None:
        return node == wanted.name
    return proxy is not None and wanted.matches(node) and proxy[1] == wanted.name


async def _facts(graph: Graph, master_uri: str, name: str) -> NodeFacts:
    """The registrations of a node, and the process id of one that answers on this machine."""
    reply = await call_api(master_uri, "lookupNode", _CALLER_ID, name)
    uri = str(reply.value) if reply.code == 1 else ""
    facts = describe_node(name, uri, graph.publishers, graph.subscribers, graph.services, graph.types)
    if proxied_node(name) is not None:
        return facts
    try:
        return msgspec.structs.replace(facts, pid=(await ping_node(name, uri, _CALLER_ID)).pid)
    except RmpaError as error:
        return msgspec.structs.replace(facts, problem=str(error))
