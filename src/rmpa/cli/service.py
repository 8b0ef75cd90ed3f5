"""``rmpa service``: lists services, shows one and what of it crosses the mesh, and calls it."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import click

from rmpa.cli.graph import CALLER_ID, Graph, GraphName, Master, marked, origin_json, origin_text, peers_of, read_name
from rmpa.cli.options import (
    FiniteRange,
    Options,
    Selection,
    argument,
    by_module,
    flag,
    graph_verb,
    option,
    selection_options,
    services,
)
from rmpa.cli.output import Table, Text, duration, fill_stamps, print_json, printable, read_values, to_text, warn
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.http.rpc import call_api
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.find import find_service_type

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rmpa.core.facts import ServiceInfo
    from rmpa.ros.types.messages import MessageType
    from rmpa.ros.wire.tcpros import ServiceDescription

# Servers that are asked at the same time.
_AT_ONCE: Final = 16
# Seconds between two questions to the master whether the service is there.
_LOOK: Final = 0.1


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

    def says(self, name: str) -> ServiceDescription:
        """What the server says.

        Raises:
            RmpaError: It does not answer.
        """
        if self.description is None:
            raise RmpaError(f"{name} does not say what it is: {self.problem}", code="no-server")
        return self.description


async def _lookup(master: Master, name: str) -> str:
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
        problem = f"no service {name} is registered at {master.uri}; `rmpa service list` shows all"
        raise RmpaError(problem, code="unknown-name")
    return str(reply.value)


def probe(master: Master, names: Iterable[str]) -> dict[str, Probed]:
    """Ask the servers of services for their types, several at once; an error of a server is in its answer.

    Raises:
        UnreachableError: The master does not answer.
    """
    from rmpa.ros.node.service_client import ServiceConnection

    async def one(name: str) -> Probed:
        uri = ""
        async with turns:
            try:
                uri = await _lookup(master, name)
                found = await ServiceConnection.probe(uri, name, CALLER_ID, limits.SERVICE_OPEN_TIMEOUT)
                return Probed(uri, found.description)
            except RmpaError as error:
                return Probed(uri, None, str(error))

    async def each() -> dict[str, Probed]:
        wanted = list(names)
        return dict(zip(wanted, await asyncio.gather(*map(one, wanted)), strict=True))

    turns = asyncio.Semaphore(_AT_ONCE)
    return asyncio.run(each())


def _of_agent(master: Master, services: tuple[str, ...] | bool) -> Sequence[ServiceInfo]:
    """What the master's agent knows of services that cross the mesh; empty without an agent."""
    snapshot = master.snapshot(topics=(), services=services, peers=False)
    return snapshot.services if snapshot is not None else ()


def _crossing(infos: Sequence[ServiceInfo]) -> Iterator[str]:
    """Whether a service may cross, each peer that offers it, and how its calls went."""
    for info in infos:
        over_there = f", {info.wire} there" if info.wire else ""
        state = f"not here: {info.hidden}" if info.hidden else info.state
        headline = f"from {info.peer}: {info.node}{over_there}, {state}"
        if info.direction == "out":
            who = f", open at {', '.join(info.callers)}" if info.callers else ""
            headline = f"{'may cross' if info.crosses else 'does not cross'}: {info.policy}{who}"
        yield f" * {headline}"
        yield from (f"     {label:<10} {text}" for label, text in _facts(info))
        if info.problem:
            warn(f"{info.peer or info.node}: {info.problem}", "service-failed")


def _facts(info: ServiceInfo) -> Iterator[tuple[str, str]]:
    if info.direct_callers:
        yield "transport", f"direct for {', '.join(info.direct_callers)}"
    elif info.transport == "direct":
        yield "transport", f"direct, at {info.address}, {info.lookups} lookups answered so"
    elif info.transport and info.wanted != "relay":
        why = f" ({info.condition}): {info.relayed_because}" if info.condition else "; its module is being asked"
        yield "transport", f"relayed{why}"
    if info.calls or info.active:
        under_way = f", {info.active} under way" if info.active else ""
        yield "calls", f"{info.calls}, {info.failed} failed{under_way}"
    if (spread := info.latency) is not None:
        text = f"p50 {duration(spread.p50)}, p99 {duration(spread.p99)}, max {duration(spread.max)}"
        yield ("latency" if info.direction == "in" else "server"), text


def _json(graph: Graph, name: str, found: Probed | None = None) -> dict[str, object]:
    about: dict[str, object] = {"name": name, **origin_json(graph.server(name))}
    if found is not None:
        said = found.description
        about |= {"uri": found.uri or None, "type": said and said.type, "md5": said and said.md5sum}
        if found.problem:
            about["problem"] = found.problem
    return about


@graph_verb(
    argument("namespace", services, default=""),
    flag("-v --verbose", "Types and nodes too; each server is asked."),
    selection_options,
)
def service_list(namespace: str, verbose: bool, selection: Selection, options: Options) -> None:
    """List services, all or those of a NAMESPACE.

    A service that a peer offers has its name behind it: /add  [base]. With -v or --json it has its transport, too.

    ---

    Examples:
      rmpa service list
      rmpa service list -v /arm
      rmpa service list base:/
    """
    wanted = read_name(namespace or "/", "service")
    master, graph = options.graph(wanted)
    peers = {name: peers_of(nodes) for name, nodes in sorted(graph.services.items())}
    every = [name for name, of in peers.items() if wanted.contains(name, of) and selection.wants(name, of)]
    shown = selection.first(every, lambda name: (bool(peers[name]), name))
    found = probe(master, shown) if verbose else {}
    mesh = {}
    if verbose or options.as_json:
        mesh = {info.name: info for info in _of_agent(master, services=True) if info.transport}

    def text() -> Iterator[Text]:
        about = by_module("services", [bool(peers[name]) for name in every])
        lines: Text = marked(shown, graph.services)
        if verbose:
            titles = "SERVICE, TYPE, NODE, TRANSPORT" if mesh else "SERVICE, TYPE, NODE"
            lines = Table(titles, [row(name)[: titles.count(",") + 1] for name in shown])
        filters = "rmpa service list MODULE:/, /NAMESPACE, --match '*/start'"
        yield selection.framed(every, "services", about, filters, lines)

    def row(name: str) -> list[str]:
        said, node = found[name].description, graph.server(name)
        kind = said.type if said is not None else "does not answer"
        transport = ""
        if (info := mesh.get(name)) is not None:
            why = f" ({info.condition})" if info.condition and info.wanted != "relay" else ""
            transport = "direct" if info.transport == "direct" else f"relayed{why}"
        return [name, kind, origin_text(node or "unknown"), transport]

    def value(name: str) -> dict[str, object]:
        about, info = _json(graph, name, found.get(name)), mesh.get(name)
        if info is not None:
            about["transport"] = info.transport
            if info.condition:
                about["condition"] = info.condition
        return about

    options.show([value(name) for name in shown] if options.as_json else None, text())


def _find(text: str, options: Options) -> tuple[GraphName, Master, Graph]:
    """The service that a user names, the master, and its graph; where another module serves it, a line says so."""
    wanted = read_name(text, "service")
    master, graph = options.graph()
    if wanted.name not in graph.services:
        master.require_peer(graph, wanted)
    return wanted, master, graph


@graph_verb(argument("service", services))
def service_info(service: str, options: Options) -> None:
    """Show a service's node, address, type and arguments, and what crosses the mesh.

    ---

    Examples:
      rmpa service info /add_two_ints
      rmpa service info base:/arm/enable --json
    """
    wanted, master, graph = _find(service, options)
    infos = _of_agent(master, (wanted.name,))
    mesh = [info for info in infos if info.name == wanted.name and wanted.peer in (None, info.peer)]
    if mesh and all(each.hidden for each in mesh):
        # It is not in the graph because it is hidden: the lines say why.
        options.show({"name": wanted.name, "mesh": mesh}, _crossing(mesh))
        return
    graph.require_service(wanted)
    found = probe(master, (wanted.name,))[wanted.name]
    halves: dict[str, MessageType] = {}
    unknown = ""
    if found.description is not None:
        try:
            kind = find_service_type(found.description.type, found.description.md5sum)
            halves = {"request": kind.request, "response": kind.response}
        except RmpaError as error:
            unknown = str(error)
    names = {
        half: [field.name for field in halves[half].fields] if halves else None for half in ("request", "response")
    }

    def text() -> Iterator[Text]:
        yield f"Node: {origin_text(graph.server(wanted.name) or 'unknown')}"
        yield f"URI: {found.uri}"
        if said := found.description:
            yield f"Type: {said.type}"
            yield f"MD5: {said.md5sum}"
            if unknown:
                warn(unknown, "unknown-type")
            else:
                yield f"Args: {' '.join(names['request'] or ())}"
            for title, half in halves.items():
                yield f"{title.title()}:" + ("" if half.fields else " nothing")
                yield from (f"  {field} {field.name}" for field in half.fields)
        if mesh:
            yield from ("", "Mesh:", *_crossing(mesh))
        found.says(wanted.name)

    options.show(_json(graph, wanted.name, found) | names | {"mesh": mesh}, text())


@graph_verb(argument("service", services))
def service_type(service: str, options: Options) -> None:
    """Print a service's type.

    ---

    Examples:
      rmpa service type /add_two_ints
    """
    wanted, master, graph = _find(service, options)
    graph.require_service(wanted)
    said = probe(master, (wanted.name,))[wanted.name].says(wanted.name)
    options.show({"name": wanted.name, "type": said.type, "md5": said.md5sum}, said.type)


@graph_verb(argument("kind", metavar="TYPE"))
def service_find(kind: str, options: Options) -> None:
    """Print the services of a TYPE; each server is asked, and one that does not answer is named on stderr.

    ---

    Examples:
      rmpa service find std_srvs/Trigger
    """
    master, graph = options.graph()
    found = []
    for name, each in probe(master, sorted(graph.services)).items():
        if each.description is None:
            warn(f"{name}: {each.problem}", "no-server")
        elif each.description.type == kind:
            found.append(name)
    options.show(found, marked(found, graph.services))


@graph_verb(
    argument("service", services),
    argument("values", nargs=-1),
    flag("-w --wait", "Wait until the service exists, at most --timeout."),
    option("-t --timeout", help="Seconds for the answer.", type=FiniteRange(0.001), default=60.0, show_default=True),
    context_settings={"ignore_unknown_options": True},
)
def service_call(service: str, values: tuple[str, ...], wait: bool, timeout: float, options: Options) -> None:
    """Call a SERVICE with VALUES, in YAML or JSON, and print its response.

    An error of the server goes to stderr in its own words, and the exit code is 1.

    ---
    The request is one YAML value, or one for each field in order; what is not given is 0, empty or false.
    Its type is the server's; its definition comes with rmpa, or from this machine's ROS packages (PYTHONPATH,
    ROS_PACKAGE_PATH, CMAKE_PREFIX_PATH). Put -- before values that look like options.

    Examples:
      rmpa service call /add_two_ints 20 22
      rmpa service call /arm/enable '{data: true}'
      rmpa service call base:/plan '{start: {header: auto}}' --timeout 120
      rmpa service call /static_map --wait --json | jq .response.map.info
    """
    from rmpa.ros.node.service_client import ServiceConnection

    wanted = read_name(service, "service")
    plain = read_values(values)
    master = options.master()

    async def ask() -> None:
        if wait:
            await _wait(master, wanted, timeout)
        graph = await master.graph()
        master.require_peer(graph, wanted)
        graph.require_service(wanted)
        uri = await _lookup(master, wanted.name)
        connection = await ServiceConnection.open(uri, wanted.name, CALLER_ID, timeout=timeout)
        try:
            kind = find_service_type(connection.description.type, connection.description.md5sum)
            request = kind.request.serialize(fill_stamps(plain, time.time_ns()))
            ok, body = await connection.call(request, timeout)
        finally:
            connection.close()
        if not ok:
            text = printable(str(bytes(body), "utf-8", "replace")) or "it gave no reason"
            raise PeerRefused(f"service {wanted.name}", text, code="service-failed")
        response = codec_for(kind.response).plain_values(memoryview(body))
        if options.as_json:
            print_json({"service": wanted.name, "response": response, "took": time.monotonic() - began})
        elif response:
            click.echo(to_text(response))

    began = time.monotonic()
    asyncio.run(ask())


async def _wait(master: Master, wanted: GraphName, timeout: float) -> None:  # noqa: ASYNC109 - the user's
    """Wait until a service is registered, by the peer if one is named.

    Raises:
        UnreachableError: It is not in time.
    """
    last: RmpaError | None = None
    try:
        async with asyncio.timeout(timeout):
            while True:
                try:
                    (await master.graph()).require_service(wanted)
                except RmpaError as error:
                    last = error
                else:
                    return
                await asyncio.sleep(_LOOK)
    except TimeoutError:
        remedy = str(last) if last is not None else ""
        raise UnreachableError(f"service {wanted}", f"{master.uri} within {timeout:g} s", remedy) from None
