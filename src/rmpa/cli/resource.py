"""``rmpa resource list``, and how commands find Smart Resources and listen to them.

Finds the Smart Resources of the graph, of this module and of others, and reads what they publish.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import signal
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import click
import msgspec

from rmpa.bridge.policy import OUTSIDE_GUID
from rmpa.cli.options import GraphOptions, graph_options
from rmpa.cli.output import Column, GraphName, print_json, print_table, printable, read_graph, read_name, warn
from rmpa.config.rules import ROS2
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, UnreachableError
from rmpa.core.identity import proxied_node, proxied_peer
from rmpa.resource.descriptor import TOPIC, Descriptor
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping, Sequence

    from rmpa.cli.output import Graph, Master
    from rmpa.ros.node.endpoints import Received
    from rmpa.ros.node.node import Node
    from rmpa.ros.node.node import Received as NodeReceived


# Runs commands that end at Ctrl-C, at a count, or with their master: one anonymous ROS node, closed cleanly.


class Enough(Exception):  # noqa: N818 - not an error
    """``--count`` is reached: raised by a command's callback, caught around ``watch_topic``."""


class StreamWatch:
    """The end of a running command, and the error that its callbacks report."""

    def __init__(self) -> None:
        self._end = asyncio.Event()
        self._error: BaseException | None = None

    def finish(self, error: BaseException | None = None) -> None:
        """End the command; it fails with the first error that is given."""
        self._error = self._error or error
        self._end.set()

    async def finished(self, seconds: float | None = None) -> bool:
        """Wait for the end, or for so many seconds; return whether the command ends.

        Raises:
            BaseException: The error that ``finish`` was given.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._end.wait()
        if self._error is not None:
            raise self._error
        return self._end.is_set()


def run_stream(body: Callable[[], Coroutine[object, object, None]]) -> None:
    """Run a coroutine to its end; Ctrl-C and SIGTERM cancel it, and its own clean-up runs."""
    from rmpa.runtime.accept import raise_file_limit

    async def run() -> None:
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 - it is this one
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
        await body()

    with contextlib.suppress(KeyboardInterrupt, asyncio.CancelledError):
        raise_file_limit()
        asyncio.run(run())


async def with_node(master: Master, name: str, body: Callable[[Node], Awaitable[None]]) -> None:
    """Run ``body`` with a node of a unique name at a master.

    Raises:
        UnreachableError: The master does not answer.
    """
    from rmpa.ros.node.node import Node

    node = Node(name, master_uri=master.uri, anonymous=True)
    try:
        await node.__aenter__()
    except UnreachableError:
        raise master.unreachable() from None
    try:
        await body(node)
    finally:
        await node.close()


async def watch_topic(
    master: Master,
    wanted: GraphName,
    on_message: Callable[[NodeReceived], None],
    body: Callable[[StreamWatch], Awaitable[None]],
) -> None:
    """Subscribe to a topic and run ``body``.

    Args:
        master: The master to ask.
        wanted: The topic; with a peer only messages of that peer's nodes count.
        on_message: Called for each message; an exception ends the command and is raised by ``watch.finished``.
        body: Runs until the watch is finished.
    """
    watch = StreamWatch()

    def take(received: NodeReceived) -> None:
        if not wanted.matches(received.caller_id):
            return
        try:
            on_message(received)
        except BaseException as error:  # noqa: BLE001 - carried over to the command, which fails with it
            watch.finish(error)

    async def listen(node: Node) -> None:
        subscriber = await node.subscribe(wanted.name, None, take)
        stopped = asyncio.get_running_loop().create_task(_end_with(node, watch))
        try:
            await body(watch)
        finally:
            stopped.cancel()
            for refusal in subscriber.refusals.values():
                warn(refusal)

    await with_node(master, "rmpa_topic", listen)


async def _end_with(node: Node, watch: StreamWatch) -> None:
    await node.stopped.wait()
    watch.finish()


TEXT: Final = "std_msgs/String"
_ANSWER: Final = 3.0
"""Seconds for a latched message: the route of another module's topic has to open first."""
_NODE: Final = "rmpa_resource"


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
        if text is None:
            own = [each for each in self.seen if each.peer is None] or list(self.seen)
            return _only(own, "say which resource is meant")
        wanted = read_name(text, "resource")
        found = [s for s in self.seen if s.path == wanted.name and wanted.matches(s.caller)]
        if not found:
            near = did_you_mean(str(wanted), map(str, self.seen))
            remedy = f"did you mean {printable(near)}?" if near else "`rmpa resource list` shows all"
            raise RmpaError(f"no resource {printable(str(wanted))}; {remedy}")
        return _only([each for each in found if each.peer is None] or found, "say whose is meant")

    async def hear(
        self,
        each: Iterable[SeenResource],
        name: str,
        kind: str = TEXT,
        timeout: float = _ANSWER,  # noqa: ASYNC109
    ) -> dict[SeenResource, Any]:
        """The first message of a topic of each resource; without those that send none in time.

        Args:
            each: Which resources.
            name: The topic below them.
            kind: Its type.
            timeout: Seconds.
        """
        found: dict[SeenResource, Any] = {}
        callers: dict[str, dict[str, SeenResource]] = {}
        for one in each:
            callers.setdefault(f"{one.path}/{name}", {})[one.caller] = one
        messages = await first_messages(self.node, {t: set(c) for t, c in callers.items()}, kind, timeout)
        for (topic, caller), received in messages.items():
            found[callers[topic][caller]] = received.message
        return found

    async def texts(self, each: Sequence[SeenResource], *names: str) -> list[dict[SeenResource, str]]:
        """The texts of ``std_msgs/String`` topics: by topic, then by resource."""
        heard = await asyncio.gather(*(self.hear(each, name) for name in names))
        return [{one: str(message.data) for one, message in found.items()} for found in heard]

    async def configuration(self, one: SeenResource) -> dict[str, bool | int | float | str]:
        """The values of a resource's parameters."""
        from rmpa.resource.reconfigure import CONFIG_TYPE, read_config

        message = (await self.hear([one], "parameter_updates", CONFIG_TYPE)).get(one)
        return read_config(message) if message is not None else {}

    async def configure(self, one: SeenResource, values: Mapping[str, str]) -> None:
        """Set text parameters of a resource.

        Raises:
            RmpaError: It cannot be reached, or refuses; then nothing has changed.
        """
        from rmpa.resource.reconfigure import SERVICE_TYPE
        from rmpa.ros.types.installed import ServiceType

        service = GraphName(f"{one.path}/set_parameters", one.peer)
        server = self.graph.require_service(service)
        if one.peer is None and proxied_peer(server) is not None:
            raise RmpaError(f"service {service} is another module's; {one} does not offer it")
        pairs: Any = [{"name": name, "value": value} for name, value in values.items()]
        kind = ServiceType(SERVICE_TYPE)
        try:
            await self.node.call_service(service.name, kind, {"config": {"strs": pairs}})
        except PeerRefused as error:
            raise RmpaError(printable(f"{one}: {error.reason}")) from None


def _only(found: Sequence[SeenResource], remedy: str) -> SeenResource:
    if len(found) == 1:
        return found[0]
    if not found:
        raise RmpaError("there is no resource; `rmpa run` runs one, `rmpa resource list` shows all")
    raise RmpaError(f"there are {', '.join(printable(str(each)) for each in found)}; {remedy}")


def run_with_resources(options: GraphOptions, body: Callable[[ResourceGraph], Awaitable[None]]) -> None:
    """Find all resources of the graph that the options name, and run ``body`` with them."""
    asyncio.run(with_resources(options.master(), body))


async def with_resources(master: Master, body: Callable[[ResourceGraph], Awaitable[None]]) -> None:
    """Find all resources of a master's graph, and run ``body`` with them."""
    graph = await read_graph(master)
    sites = await asyncio.to_thread(_sites, master)

    async def within(node: Node) -> None:
        await body(ResourceGraph(node, graph, await find_resources(node, graph, sites)))

    await with_node(master, _NODE, within)


def _sites(master: Master) -> frozenset[str]:
    """The names of the other sites that a gateway joins, as the master's agent knows them."""
    snapshot = master.snapshot(topics=())
    peers = snapshot.peers if snapshot is not None else ()
    return frozenset(peer.name for peer in peers if peer.guid == OUTSIDE_GUID) - {ROS2}


async def find_resources(node: Node, graph: Graph, sites: frozenset[str] = frozenset()) -> tuple[SeenResource, ...]:
    """All resources that publish a descriptor, this module's first.

    Args:
        node: This command's own node.
        graph: The master's graph.
        sites: The names of other sites, whose modules are told apart.
    """
    ending = f"/{TOPIC}"
    topics = {
        topic: set(nodes)
        for topic, nodes in graph.publishers.items()
        if topic.endswith(ending) and graph.types.get(topic) == TEXT
    }
    found = []
    for (topic, caller), received in (await first_messages(node, topics, TEXT, _ANSWER)).items():
        try:
            descriptor = Descriptor.parse(str(received.message.data))
        except RmpaError:
            continue  # another program's topic of that name
        found.append(SeenResource(topic.removesuffix(ending), _peer(caller, sites), caller, descriptor))
    return tuple(sorted(found, key=lambda each: (each.peer or "", each.path)))


def _peer(caller: str, sites: frozenset[str]) -> str | None:
    """The peer whose node a proxy stands for; ``site/module`` if it is of another site."""
    proxy = proxied_node(caller)
    if proxy is None or proxy[0] not in sites:
        return proxy[0] if proxy is not None else None
    return f"{proxy[0]}/{proxy[1].split('/')[1]}"


async def first_messages(
    node: Node,
    callers: Mapping[str, set[str]],
    kind: str,
    timeout: float,  # noqa: ASYNC109 - a time-out is no error here
) -> dict[tuple[str, str], Received]:
    """The first message of each publisher, by topic and publisher; without those that send none in time."""
    found: dict[tuple[str, str], Received] = {}
    missing = {(topic, caller) for topic, names in callers.items() for caller in names}
    change = asyncio.Event()

    def take(topic: str, received: Received) -> None:
        key = topic, received.caller_id
        if key in missing:
            missing.discard(key)
            found[key] = received
            if not missing:
                change.set()

    type_ = MessageType(kind)
    subscribers = [await node.subscribe(topic, type_, functools.partial(take, topic)) for topic in callers]
    try:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                while missing:
                    await change.wait()
    finally:
        for subscriber in subscribers:
            await subscriber.close()
    return found


def decision_of(text: str) -> dict[str, Any]:
    """Parse a resource's account of its last decision, a JSON object.

    Raises:
        RmpaError: It is none.
    """
    try:
        found = msgspec.json.decode(text)
    except msgspec.DecodeError as error:
        raise RmpaError(f"it says something strange about its decision: {error}") from None
    if not isinstance(found, dict):
        raise RmpaError("it says something strange about its decision")
    return found


def known_name(what: str, text: str, known: Iterable[str]) -> str:
    """Check that a resource has a profile or context of that name; return the name.

    Raises:
        ConfigError: It has none.
    """
    names = list(known)
    if text not in names:
        near = did_you_mean(text, names)
        remedy = f"did you mean {printable(near)}?" if near else f"there are {printable(', '.join(names)) or 'none'}"
        raise ConfigError(what.upper(), f"there is no {what} {text!r}", remedy)
    return text


# ``rmpa resource list``: the resources of the graph.


_COLOURS: Final = {"active": "green", "inactive": "yellow", "unconfigured": "yellow", "finalized": "red"}
_TITLES: Final = ("RESOURCE", "STATE", "ROLE", "KIND", "PROFILE", "CONTEXT", "DESCRIPTION")
_EXAMPLES: Final = """\
\b
Examples:
  rmpa resource list
  rmpa resource list --json | jq -r '.[].name'
"""


@click.command("list", epilog=_EXAMPLES)
@graph_options
def list_(options: GraphOptions) -> None:
    """List the resources of this module, and those of peers with the peers' names."""

    async def body(graph: ResourceGraph) -> None:
        for path, count in Counter(one.path for one in graph.seen).items():
            if count > 1:
                text = "what is asked of that name is heard by all of them; docs/names.md tells them apart"
                warn(f"{count} modules have a resource {path}: {text}")
        states, profiles, contexts = await graph.texts(graph.seen, "state", "profile", "context")
        found: list[dict[str, Any]] = [
            {
                "name": one.path,
                "peer": one.peer,
                "role": one.descriptor.role,
                "physical": one.descriptor.physical,
                "description": one.descriptor.description,
                "state": states.get(one),
                "profile": profiles.get(one),
                "context": contexts.get(one),
            }
            for one in graph.seen
        ]
        if options.as_json:
            print_json(found)
        else:
            rows = [_row(str(one), each) for one, each in zip(graph.seen, found, strict=True)]
            colours = [_COLOURS.get(each["state"], "") for each in found]
            print_table(tuple(map(Column, _TITLES)), rows, colours=colours)

    run_with_resources(options, body)


def _row(name: str, each: dict[str, Any]) -> list[str]:
    kind = "device" if each["physical"] else "simulated"
    ends = [each["profile"] or "-", each["context"] or "-", each["description"]]
    return [name, each["state"] or "does not answer", each["role"], kind, *ends]
