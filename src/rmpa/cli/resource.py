"""How verbs find Smart Resources and listen to them; ``rmpa resource list`` and ``rmpa alarm``."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import time
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from rmpa.bridge.launched import LaunchedResource, ModuleResources
from rmpa.cli.graph import Graph, GraphName, Master, read_name, run_stream, suggestion
from rmpa.cli.options import Options, argument, count_option, flag, graph_of, graph_verb, of_peer
from rmpa.cli.output import Painted, Table, paint, print_json, print_text, printable, size, warn
from rmpa.config.rules import ROS2
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.core.identity import OUTSIDE_GUID, proxied_node, proxied_peer
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel
from rmpa.ros.types.descriptor import CONFIG_TYPE, SERVICE_TYPE, TOPIC, Descriptor
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence

    import click

    from rmpa.ros.node.endpoints import Received
    from rmpa.ros.node.node import Node

_T = TypeVar("_T")
_TEXT: Final = "std_msgs/String"
# Seconds for a latched message: the route of another module's topic has to open first.
_ANSWER: Final = 3.0
# Seconds between two searches for new resources.
_LOOK: Final = 1.0
# By state, or by level of an alarm.
_COLOURS: Final = {
    **dict.fromkeys(("active", "OK"), "green"),
    **dict.fromkeys(("inactive", "unconfigured", "WARN"), "yellow"),
    **dict.fromkeys(("finalized", "failed", "refused", "ERROR"), "red"),
    "STALE": "magenta",
}


@dataclass(frozen=True, slots=True, eq=False)
class SeenResource:
    """A resource of the graph.

    Args:
        path: The name of its node, below which this module's graph has its topics: ``/sonar``.
        peer: The peer that it runs at, ``site/module`` for a module of another site; ``None``: this module.
        caller: The node that publishes its topics in this graph: its own, or a proxy.
        descriptor: Its published description.
    """

    path: str
    peer: str | None
    caller: str
    descriptor: Descriptor

    def __str__(self) -> str:
        """As a user writes it."""
        return str(GraphName(self.path, self.peer))

    @property
    def named(self) -> dict[str, str | None]:
        """The resource of an answer, for JSON."""
        return {"resource": self.path, "peer": self.peer}


@dataclass(frozen=True, slots=True)
class ResourceGraph:
    """The resources of a graph, and a node to ask them by.

    Args:
        node: This command's own node.
        graph: The master's graph.
        seen: All resources in it.
    """

    node: Node
    graph: Graph
    seen: tuple[SeenResource, ...]

    def pick(self, text: str | None) -> SeenResource:
        """The resource that a user names: ``sonar``, ``/sonar``, ``base:/sonar``; ``None``: the only one.

        Raises:
            ConfigError: It is no name.
            RmpaError: There is none, or there are several.
        """
        found, remedy = self.seen, "say which resource is meant"
        if text is not None:
            wanted, remedy = read_name(text, "resource"), "say whose is meant"
            found = tuple(s for s in self.seen if s.path == wanted.name and wanted.matches(s.caller))
            if not found:
                hint = suggestion(str(wanted), map(str, self.seen), "`rmpa resource list` shows all")
                raise RmpaError(f"no resource {printable(str(wanted))}; {hint}", code="unknown-name")
        found = tuple(each for each in found if each.peer is None) or found
        if not found:
            problem = "there is no resource; `rmpa run` runs one, `rmpa resource list` shows all"
            raise RmpaError(problem, code="unknown-name")
        if len(found) > 1:
            problem = f"there are {', '.join(printable(str(each)) for each in found)}; {remedy}"
            raise RmpaError(problem, code="several-fit")
        return found[0]

    async def hear(self, each: Iterable[SeenResource], name: str, kind: str = _TEXT) -> dict[SeenResource, Any]:
        """The first message of a topic below each resource; without those that send none in time.

        Args:
            each: Which resources.
            name: The topic below them.
            kind: Its type.
        """
        wanted = {(f"{one.path}/{name}", one.caller): one for one in each}
        messages = await _first_messages(self.node, wanted, kind)
        return {wanted[key]: message for key, message in messages.items()}

    async def texts(self, each: Sequence[SeenResource], *names: str) -> list[dict[SeenResource, str]]:
        """The texts of ``std_msgs/String`` topics: by topic, then by resource."""
        heard = await asyncio.gather(*(self.hear(each, name) for name in names))
        return [{one: str(message.data) for one, message in found.items()} for found in heard]

    async def configuration(self, one: SeenResource) -> dict[str, bool | int | float | str]:
        """The values of a resource's parameters."""
        from rmpa.resource.actuation import read_config

        message = (await self.hear([one], "parameter_updates", CONFIG_TYPE)).get(one)
        return read_config(message) if message is not None else {}

    async def configure(self, one: SeenResource, values: Mapping[str, str]) -> None:
        """Set text parameters of a resource.

        Raises:
            RmpaError: It cannot be reached, or refuses; then nothing has changed.
        """
        from rmpa.ros.types.installed import ServiceType

        service = GraphName(f"{one.path}/set_parameters", one.peer)
        server = self.graph.require_service(service)
        if one.peer is None and proxied_peer(server) is not None:
            problem = f"service {service} is another module's; {one} does not offer it"
            raise RmpaError(problem, code="resource-trouble")
        pairs: Any = [{"name": name, "value": value} for name, value in values.items()]
        try:
            await self.node.call_service(service.name, ServiceType(SERVICE_TYPE), {"config": {"strs": pairs}})
        except PeerRefused as error:
            raise RmpaError(printable(f"{one}: {error.reason}"), code=error.code) from None


def run_with_resources(options: Options, body: Callable[[ResourceGraph], Awaitable[_T]]) -> _T:
    """What ``body`` returns, run with all resources of the graph that the options name."""
    return asyncio.run(with_resources(options.master(), body))


async def with_resources(master: Master, body: Callable[[ResourceGraph], Awaitable[_T]]) -> _T:
    """What ``body`` returns, run with all resources of a master's graph."""
    graph = await master.graph()
    snapshot = await asyncio.to_thread(master.snapshot, topics=())
    peers = snapshot.peers if snapshot is not None else ()
    sites = {peer.name for peer in peers if peer.guid == OUTSIDE_GUID} - {ROS2}  # other sites that a gateway joins

    async def within(node: Node) -> _T:
        return await body(ResourceGraph(node, graph, await find_resources(node, graph, sites)))

    return await master.with_node("rmpa_resource", within)


async def find_resources(node: Node, graph: Graph, sites: Iterable[str] = ()) -> tuple[SeenResource, ...]:
    """All resources that publish a descriptor, this module's first.

    Args:
        node: This command's own node.
        graph: The master's graph.
        sites: The names of other sites, whose modules are written ``site/module``.
    """
    ending = f"/{TOPIC}"
    wanted = [
        (topic, caller)
        for topic, nodes in graph.publishers.items()
        for caller in nodes
        if topic.endswith(ending) and graph.types.get(topic) == _TEXT
    ]
    found = []
    for (topic, caller), message in (await _first_messages(node, wanted, _TEXT)).items():
        try:
            descriptor = Descriptor.parse(str(message.data))
        except RmpaError:
            continue  # another program's topic of that name
        peer, name = proxied_node(caller) or (None, "")
        if peer is not None and peer in sites:
            peer = f"{peer}/{name.split('/')[1]}"
        found.append(SeenResource(topic.removesuffix(ending), peer, caller, descriptor))
    return tuple(sorted(found, key=lambda each: (each.peer or "", each.path)))


async def _first_messages(node: Node, wanted: Iterable[tuple[str, str]], kind: str) -> dict[tuple[str, str], Any]:
    """The first message of each publisher, by topic and publisher; without those that send none in time."""
    found: dict[tuple[str, str], Any] = {}
    missing = set(wanted)
    topics = {topic for topic, _ in missing}
    complete = asyncio.Event()

    def take(topic: str, received: Received) -> None:
        key = topic, received.caller_id
        if key in missing:
            missing.discard(key)
            found[key] = received.message
            if not missing:
                complete.set()

    type_ = MessageType(kind)
    subscribers = [await node.subscribe(topic, type_, functools.partial(take, topic)) for topic in topics]
    try:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_ANSWER):
                if missing:
                    await complete.wait()
    finally:
        for subscriber in subscribers:
            await subscriber.close()
    return found


def resource_names(ctx: click.Context, _: str) -> Iterable[str]:
    """Resources of the graph, for ``options.completes``."""
    ending = f"/{TOPIC}"
    for topic, nodes in graph_of(ctx).publishers.items():
        if topic.endswith(ending):
            yield from (of_peer(topic.removesuffix(ending), node) for node in nodes)


def resource_verb(*parameters: Any) -> Callable[[Callable[..., Awaitable[None]]], click.Command]:
    """A ``graph_verb`` about one resource: its function gets the graph, the resource, the options, and parameters."""

    def decorate(function: Callable[..., Awaitable[None]]) -> click.Command:
        @functools.wraps(function)
        def command(resource: str | None, options: Options, **given: Any) -> None:
            run_with_resources(options, lambda graph: function(graph, graph.pick(resource), options, **given))

        return graph_verb(argument("resource", resource_names, required=False), *parameters)(command)

    return decorate


@graph_verb()
def resource_list(options: Options) -> None:
    """List the resources of this module, and those of peers with the peers' names; also those that can be started.

    PROCESSES are the nodes of one that its agent has started: processor time, memory, restarts.

    ---

    Examples:
      rmpa resource list
      rmpa resource list --json | jq -r '.[].name'
    """
    master = options.master()

    async def body(graph: ResourceGraph) -> None:
        launched = await asyncio.to_thread(_launched, master)
        for path, count in Counter(one.path for one in graph.seen).items():
            if count > 1:
                text = "a request to that name reaches all of them; docs/guides/names.md shows how to separate them"
                warn(f"{count} modules have a resource {path}: {text}", "same-names")
        states, profiles, contexts = await graph.texts(graph.seen, "state", "profile", "context")
        found: list[tuple[dict[str, Any], LaunchedResource | None]] = []
        for one in graph.seen:
            said = one.descriptor
            about = {"name": one.path, "peer": one.peer, "role": said.role, "physical": said.physical}
            about |= {"description": said.description, "state": states.get(one)}
            about |= {"profile": profiles.get(one), "context": contexts.get(one)}
            found.append((about, launched.pop((one.peer, one.path), None)))
        for (peer, path), its in launched.items():
            empty = dict.fromkeys(("role", "physical", "profile", "context"))
            found.append(({"name": path, "peer": peer, **empty, "description": its.why, "state": its.state}, its))
        rows = [_row(*each) for each in found]
        colours = [_COLOURS.get(about["state"], "") for about, _ in found]
        titles = "RESOURCE, STATE, ROLE, KIND, PROFILE, CONTEXT, PROCESSES, DESCRIPTION"
        if not any(row[6] for row in rows):
            titles, rows = titles.replace("PROCESSES, ", ""), [[*row[:6], row[7]] for row in rows]
        options.show([about | _started(its) for about, its in found], Table(titles, rows, colours))

    asyncio.run(with_resources(master, body))


def _row(about: dict[str, Any], its: LaunchedResource | None) -> list[str]:
    kind = {None: "-", True: "device", False: "simulated"}[about["physical"]]
    ends = [about["profile"] or "-", about["context"] or "-", _processes(its), about["description"]]
    state = about["state"] or "does not answer"
    return [str(GraphName(about["name"], about["peer"])), state, about["role"] or "-", kind, *ends]


def _launched(master: Master) -> dict[tuple[str | None, str], LaunchedResource]:
    """What agents can start, by peer and by the name of the resource's node; nothing where they do not tell."""
    with contextlib.suppress(RmpaError), master.client() as client:
        told = client.call("launch", tuple[ModuleResources, ...], what="list")
        own = told[0].module if told else ""
        return {
            (None if each.module == own else each.module, f"/{one.name}"): one
            for each in told
            for one in each.resources
        }
    return {}


def _started(its: LaunchedResource | None) -> dict[str, Any]:
    """What JSON has of a resource that its agent starts: its file, its process and its nodes."""
    about = msgspec.to_builtins(its) if its is not None else {}
    return {key: about.get(key) for key in ("file", "pid", "since", "restarts", "boot", "processes")}


def _processes(its: LaunchedResource | None) -> str:
    """What the nodes of a resource cost: ``2: 13 %, 85 MB, 1 restart``."""
    run = [each for each in its.processes if each.pid is not None] if its is not None else []
    if its is None or not run:
        return ""
    restarts = its.restarts + sum(each.restarts for each in its.processes)
    more = f", {restarts} restart{'s' if restarts > 1 else ''}" if restarts else ""
    return f"{len(run)}: {100 * sum(each.cpu for each in run):.0f} %, {size(sum(each.rss for each in run))}{more}"


def status_of(status: Any) -> dict[str, Any]:
    """A ``DiagnosticStatus``, for JSON."""
    return {
        "level": DiagnosticLevel(int(status.level) & 3).name,
        "message": str(status.message),
        "values": {str(pair.key): str(pair.value) for pair in status.values},
    }


@graph_verb(flag("-a --all everything", "Also those without a problem."))
def alarm_list(everything: bool, options: Options) -> None:
    """List the resources that have a problem, here and at peers.

    WARN: adaptation, or a task that fails; ERROR: non-adaptable; STALE: an input that it needs has no publisher.

    ---

    Examples:
      rmpa alarm list
      rmpa alarm list --all
    """

    async def body(graph: ResourceGraph) -> None:
        heard = await graph.hear(graph.seen, "quality", ARRAY_TYPE)
        found = []
        for one in graph.seen:
            statuses = heard[one].status if one in heard else ()
            message = "it has sent no quality while we listened"
            silent: dict[str, Any] = {"level": "STALE", "message": message, "values": {}}
            health = status_of(statuses[0]) if statuses else silent
            if everything or health["level"] != "OK":
                found.append((one, health))
        rows = [(str(one), health["level"], health["message"]) for one, health in found]
        table = Table("RESOURCE, LEVEL, MESSAGE", rows, [_COLOURS[health["level"]] for _, health in found])
        options.show([{**one.named, **health} for one, health in found], table)

    run_with_resources(options, body)


@graph_verb(argument("resource", resource_names, required=False), count_option("alarms"))
def alarm_echo(resource: str | None, count: int | None, options: Options) -> None:
    """Print alarms as they are raised and cleared, of all resources or of one RESOURCE, until Ctrl-C.

    ---

    Examples:
      rmpa alarm echo                   of all resources, also of those that start later
      rmpa alarm echo base:/sonar -n 1  wait for one
      rmpa alarm echo --json | jq -r .message
    """
    master = options.master()
    run_stream(lambda: _echo(master, resource, count, as_json=options.as_json))


async def _echo(master: Master, resource: str | None, count: int | None, *, as_json: bool) -> None:
    async def pick(graph: ResourceGraph) -> SeenResource:
        return graph.pick(resource)

    only = await with_resources(master, pick) if resource is not None else None
    printed = 0
    enough = asyncio.get_running_loop().create_future()

    def take(path: str, received: Received) -> None:
        nonlocal printed
        if only is not None and received.caller_id != only.caller:
            return
        for status in received.message.status:
            if enough.done():
                return
            _print_alarm(path, received, status_of(status), as_json=as_json)
            printed += 1
            if printed == count:
                enough.set_result(None)

    async def look(node: Node) -> None:
        """Subscribe to the alarms of all resources, those that start later included."""
        known: set[str] = set()
        warned = False
        while not enough.done():
            with contextlib.suppress(RmpaError):
                graph = await master.graph()
                for topic in graph.publishers.keys() - known:
                    path = topic.removesuffix("/alarms")
                    found = path != topic and graph.types.get(topic) == ARRAY_TYPE
                    if (
                        found
                        and f"{path}/{TOPIC}" in graph.publishers
                        and path == (only.path if only is not None else path)
                    ):
                        known.add(topic)
                        await node.subscribe(topic, MessageType(ARRAY_TYPE), functools.partial(take, path))
            if not known and not warned:
                warned = True
                warn("there is no resource yet; waiting", "unknown-name")
            await asyncio.wait((enough,), timeout=_LOOK)

    await master.with_node("rmpa_alarm", look)


def _print_alarm(path: str, received: Received, alarm: dict[str, Any], *, as_json: bool) -> None:
    peer = proxied_peer(received.caller_id)
    seconds = received.stamp_ns / 1e9
    if as_json:
        print_json({"resource": path, "peer": peer, "at": seconds, **alarm})
        return
    at, level = time.strftime("%H:%M:%S", time.localtime(seconds)), paint(alarm["level"], _COLOURS[alarm["level"]])
    print_text(Painted(f"{at} {level} {printable(str(GraphName(path, peer)))}: {printable(alarm['message'])}"))
    for key, value in alarm["values"].items():
        if value.startswith("wanted "):
            print_text(f"    {key}: {value}")
