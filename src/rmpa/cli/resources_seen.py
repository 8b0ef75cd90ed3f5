"""Which Smart Resources the graph holds, of this module and of others, and what they say of themselves."""

from __future__ import annotations

import asyncio
import functools
import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge.proxy_names import proxied_node
from rmpa.cli.master import TopicName, choose_master, read_graph, read_topic
from rmpa.cli.output import printable
from rmpa.cli.service_ends import require_service
from rmpa.cli.stream import with_node
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError
from rmpa.resource.run.descriptor import TOPIC, Descriptor
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence

    from rmpa.cli.master import Graph, Master
    from rmpa.ros.node.node import Node
    from rmpa.ros.node.topics import Received

TEXT: Final = "std_msgs/String"
_ANSWER: Final = 3.0
"""Seconds for what is latched: for a resource of another module its route has to open first."""
_NODE: Final = "rmpa_resource"


@dataclass(frozen=True, slots=True, eq=False)
class SeenResource:
    """One resource.

    Args:
        path: Its node's name as this module's graph has its topics: ``/sonar``.
        peer: Whose it is; ``None``: this module's own.
        caller: The node that publishes for it here: itself, or its proxy.
        descriptor: What it says of itself.
    """

    path: str
    peer: str | None
    caller: str
    descriptor: Descriptor

    def __str__(self) -> str:
        """As a user writes it."""
        return str(TopicName(self.path, self.peer))


@dataclass(frozen=True, slots=True)
class Room:
    """Where a command looks around.

    Args:
        node: A node of our own.
        graph: What the master knows.
        seen: All resources.
    """

    node: Node
    graph: Graph
    seen: tuple[SeenResource, ...]

    def pick(self, text: str | None) -> SeenResource:
        """The resource that a user means: ``sonar``, ``/sonar``, ``base:/sonar``; ``None``: the only one.

        Raises:
            ConfigError: It is no name.
            RmpaError: There is none, or several and nothing tells which is meant.
        """
        if text is None:
            own = [each for each in self.seen if each.peer is None] or list(self.seen)
            return _only(own, "say which resource is meant")
        wanted = read_topic(text, "resource")
        found = [s for s in self.seen if s.path == wanted.topic and (wanted.peer is None or s.peer == wanted.peer)]
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
        """The first message of each resource's topic, as far as they come in time.

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
        """What several topics ``std_msgs/String`` of resources say."""
        heard = await asyncio.gather(*(self.hear(each, name) for name in names))
        return [{one: str(message.data) for one, message in found.items()} for found in heard]

    async def configuration(self, one: SeenResource) -> dict[str, bool | int | float | str]:
        """The values of a resource's parameters."""
        from rmpa.resource.run.dynamic_reconfigure import CONFIG_TYPE, read_config

        message = (await self.hear([one], "parameter_updates", CONFIG_TYPE)).get(one)
        return read_config(message) if message is not None else {}

    async def configure(self, one: SeenResource, values: Mapping[str, str]) -> None:
        """Set texts among a resource's parameters.

        Raises:
            RmpaError: It cannot be reached, or refuses; nothing has changed then.
        """
        from rmpa.resource.run.dynamic_reconfigure import SERVICE_TYPE
        from rmpa.ros.types.service_types import ServiceType

        service = TopicName(f"{one.path}/set_parameters", one.peer)
        server = require_service(self.graph, service)
        if one.peer is None and proxied_node(server) is not None:
            raise RmpaError(f"service {service} is another module's; {one} does not offer it")
        pairs: Any = [{"name": name, "value": value} for name, value in values.items()]
        kind = ServiceType(SERVICE_TYPE)
        try:
            await self.node.call_service(service.topic, kind, {"config": {"strs": pairs}})
        except PeerRefused as error:
            raise RmpaError(printable(f"{one}: {error.reason}")) from None


def _only(found: Sequence[SeenResource], remedy: str) -> SeenResource:
    if len(found) == 1:
        return found[0]
    if not found:
        raise RmpaError("there is no resource; `rmpa run` runs one, `rmpa resource list` shows all")
    raise RmpaError(f"there are {', '.join(printable(str(each)) for each in found)}; {remedy}")


def run_around(master: str | None, agent: str | None, body: Callable[[Room], Awaitable[None]]) -> None:
    """Find all resources of the graph that is meant, as ``choose_master`` has it, and let ``body`` deal with them."""
    asyncio.run(look_around(choose_master(master, agent, os.environ), body))


async def look_around(master: Master, body: Callable[[Room], Awaitable[None]]) -> None:
    """Find all resources, and let ``body`` deal with them."""
    graph = await read_graph(master)

    async def within(node: Node) -> None:
        await body(Room(node, graph, await find_resources(node, graph)))

    await with_node(master, _NODE, within)


async def find_resources(node: Node, graph: Graph) -> tuple[SeenResource, ...]:
    """All resources that say what they are, this module's first."""
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
            continue  # somebody else's topic of that name
        proxy = proxied_node(caller)
        found.append(
            SeenResource(topic.removesuffix(ending), proxy[0] if proxy is not None else None, caller, descriptor)
        )
    return tuple(sorted(found, key=lambda each: (each.peer or "", each.path)))


async def first_messages(
    node: Node,
    callers: Mapping[str, set[str]],
    kind: str,
    timeout: float,  # noqa: ASYNC109 - what has come by then is the result
) -> dict[tuple[str, str], Received]:
    """The first message of each publisher of topics, by topic and publisher; those that do not come are not in it."""
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
        async with asyncio.timeout(timeout):
            while missing:
                await change.wait()
    except TimeoutError:
        pass
    finally:
        for subscriber in subscribers:
            await subscriber.close()
    return found


def decision_of(text: str) -> dict[str, Any]:
    """What a resource says about its last decision.

    Raises:
        RmpaError: It is no such thing.
    """
    try:
        found = msgspec.json.decode(text)
    except msgspec.DecodeError as error:
        raise RmpaError(f"it says something strange about its decision: {error}") from None
    if not isinstance(found, dict):
        raise RmpaError("it says something strange about its decision")
    return found


def known_name(what: str, text: str, known: Iterable[str]) -> str:
    """A profile or context that a resource has.

    Raises:
        ConfigError: It has none of that name.
    """
    names = list(known)
    if text not in names:
        near = did_you_mean(text, names)
        remedy = f"did you mean {printable(near)}?" if near else f"there are {printable(', '.join(names)) or 'none'}"
        raise ConfigError(what.upper(), f"there is no {what} {text!r}", remedy)
    return text
