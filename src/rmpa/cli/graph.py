"""The graph that verbs show: the master that is asked, its topics, services and nodes, and how users name them."""

from __future__ import annotations

import contextlib
import re
import signal
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, TypeAlias, TypeVar

import msgspec

from rmpa.cli.output import Painted, paint, printable, warn
from rmpa.config.values import did_you_mean
from rmpa.core.errors import ConfigError, RmpaError, UnreachableError
from rmpa.core.identity import is_legal_name, is_meant, proxied_node, proxied_peer
from rmpa.observe.control_client import ControlClient, choose_agent, find_agents, same_core
from rmpa.observe.limits import CONTROL_CALL_TIMEOUT
from rmpa.ros.environment import DEFAULT_MASTER_URI, NodeFacts

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from rmpa.core.facts import RouteInfo
    from rmpa.observe.snapshot import PeerInfo, Snapshot
    from rmpa.ros.node.node import Node, Received

# Seconds between two lines of figures, as rostopic has it.
TICK: Final = 1.0
_T = TypeVar("_T")
_Table: TypeAlias = list[tuple[str, list[str]]]
# The node that verbs are, as masters and nodes log it.
CALLER_ID: Final = "/rmpa_node"
_REMEDY: Final = "start one with `rmpa up` or `rmpa core`, or name it with --master"


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


def read_name(text: str, what: str = "topic") -> GraphName:
    """Read ``NAME`` or ``PEER:NAME``; a relative name is one of the root namespace, ``PEER:/`` all of a peer.

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


def suggestion(word: str, known: Iterable[str], otherwise: str) -> str:
    """The remedy for a misspelt word: the nearest one that is known, or what else helps."""
    near = did_you_mean(word, known)
    return f"did you mean {printable(near)}?" if near else otherwise


def find_peer(snapshot: Snapshot, wanted: str) -> PeerInfo:
    """The peer of that name or GUID.

    Raises:
        RmpaError: There is none; the text offers the nearest name.
    """
    for info in (*snapshot.peers, *snapshot.strangers):
        if is_meant(wanted, info.name, info.guid):
            return info
    names = [info.name for info in snapshot.peers]
    known = f"known are {', '.join(names)}" if names else "no peer is known yet"
    problem = f"{snapshot.agent.name} knows no peer {wanted!r}; {suggestion(wanted, names, known)}"
    raise RmpaError(problem, code="unknown-name")


def origin_json(node: str) -> dict[str, str]:
    """A node for JSON: a proxy with the peer and the node that it stands for."""
    proxy = proxied_node(node)
    return {"node": node} if proxy is None else {"node": node, "peer": proxy[0], "remote_node": proxy[1]}


def origin_text(node: str) -> str:
    """A node in words: a proxy with the peer and the node that it stands for."""
    proxy = proxied_node(node)
    return node if proxy is None else f"{proxy[1]} of peer {proxy[0]}, by its proxy {node}"


def marked(names: Iterable[str], nodes: Mapping[str, Sequence[str]]) -> Iterator[Painted]:
    """Names of topics or services, each with the peers of the nodes that offer it behind it."""
    for name in names:
        yield Painted(printable(name) + peers_mark(nodes.get(name, ())))


def peers_mark(nodes: Iterable[str]) -> str:
    """The peers of some nodes behind a name, ``  [joystick]``; empty where there are none."""
    peers = ", ".join(peers_of(nodes))
    return paint(f"  [{peers}]", "cyan") if peers else ""


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
    return RmpaError(
        f"no {what} {name}; {suggestion(name, known, f'`rmpa {what} list` shows all')}", code="unknown-name"
    )


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

    def server(self, service: str) -> str:
        """The node that serves a service; empty: none is known."""
        return next(iter(self.services.get(service, ())), "")

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
            raise RmpaError(f"{served}, not by peer {wanted.peer}; {remedy}", code="unknown-name")
        return self.server(wanted.name)


class Enough(Exception):  # noqa: N818 - not an error
    """``--count`` is reached: raised by the callback of ``Master.watch``, which then returns."""


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
        with contextlib.suppress(RmpaError), self.client() as client:
            return client.snapshot(topics=topics, services=services, peers=peers)
        return None

    def client(self, timeout: float = CONTROL_CALL_TIMEOUT) -> ControlClient:
        """A connection to the master's agent.

        Raises:
            UnreachableError: This is not an agent's core, or its agent does not answer.
        """
        if self.agent is None:
            raise self.no_agent()
        return ControlClient(self.agent, timeout)

    async def graph(self) -> Graph:
        """Its graph.

        Raises:
            UnreachableError: It does not answer.
            RmpaError: It answers with something else.
        """
        from rmpa.ros.http.rpc import call_api

        try:
            state = (await call_api(self.uri, "getSystemState", CALLER_ID)).value
            types = (await call_api(self.uri, "getTopicTypes", CALLER_ID)).value
        except UnreachableError:
            raise self.unreachable() from None
        try:
            tables = msgspec.convert(state, list[object])[:3]
            publishers, subscribers, services = msgspec.convert(tables, tuple[_Table, _Table, _Table])
            known = {name: kind for name, kind in msgspec.convert(types, list[tuple[str, str]]) if kind != "*"}
        except msgspec.ValidationError:
            problem = f"{self.uri} answers getSystemState with something else; is it a ROS master?"
            raise RmpaError(problem, code="protocol-error") from None
        names = [{name: sorted(nodes) for name, nodes in table} for table in (publishers, subscribers, services)]
        return Graph(names[0], names[1], known, names[2])

    def require_peer(self, graph: Graph, wanted: GraphName) -> None:
        """Check that the peer of a name is known here: a node of it stands in the graph, or the agent knows the peer.

        Raises:
            UnreachableError: This is not an agent's core, and so knows no peers.
            RmpaError: There is no such peer; the text offers the nearest name.
        """
        if wanted.peer is None or any(wanted.matches(node) for node in graph.nodes):
            return
        snapshot = self.snapshot(topics=())
        if snapshot is None:
            raise self.no_agent()
        known = {peer.name for peer in snapshot.peers}
        if wanted.peer == snapshot.agent.name and wanted.peer not in known:
            problem = f"{wanted.peer} is this module itself: leave it out and write {wanted.name}"
            raise RmpaError(problem, code="invalid-value")
        # Of a module of another site, SITE/MODULE, the agent knows the site.
        peer = find_peer(snapshot, wanted.peer.partition("/")[0])
        if peer.name not in wanted.peer:
            problem = f"{wanted.peer} is the GUID of {peer.name}: write {peer.name}:{wanted.name}"
            raise RmpaError(problem, code="invalid-value")

    def warn_unpublished(self, graph: Graph, wanted: GraphName) -> None:
        """Say on stderr that no node publishes a topic yet, if that is so: a command waits for its messages.

        Args:
            graph: The graph.
            wanted: The topic; with a peer only that peer's publishers count.
        """
        if any(map(wanted.matches, graph.publishers.get(wanted.name, ()))):
            return
        why = f"`rmpa why {wanted}` says why" if self.agent is not None else ""
        hint = why if wanted.name in graph.publishers else suggestion(wanted.name, graph.publishers, why)
        warn(f"{wanted} is not published yet; waiting" + (f" ({hint})" if hint else ""), "no-publisher")

    async def node_uri(self, graph: Graph, name: str) -> str:
        """The URI of the slave API of a node.

        Raises:
            RmpaError: There is no such node; the text offers the nearest one.
        """
        from rmpa.ros.http.rpc import call_api

        reply = await call_api(self.uri, "lookupNode", CALLER_ID, name)
        if reply.code == 1 and isinstance(reply.value, str):
            return reply.value
        raise unknown_name("node", name, [node for node in graph.nodes if proxied_peer(node) is None])

    async def node_facts(self, graph: Graph, name: str) -> NodeFacts:
        """The registrations of a node, and its process id, or why it does not answer; a proxy is not asked.

        Raises:
            RmpaError: There is no such node.
        """
        from rmpa.ros.environment import describe_node
        from rmpa.ros.node.ask import ping_node

        uri = await self.node_uri(graph, name)
        facts = describe_node(name, uri, graph.publishers, graph.subscribers, graph.services, graph.types)
        if proxied_node(name) is not None:
            return facts
        try:
            return msgspec.structs.replace(facts, pid=(await ping_node(name, uri, CALLER_ID)).pid)
        except RmpaError as error:
            return msgspec.structs.replace(facts, problem=str(error))

    async def with_node(self, name: str, body: Callable[[Node], Awaitable[_T]]) -> _T:
        """What ``body`` returns, run with a node of a unique name.

        Raises:
            UnreachableError: It does not answer.
        """
        from rmpa.ros.node.node import Node

        node = Node(name, master_uri=self.uri, anonymous=True)
        try:
            await node.__aenter__()
        except UnreachableError:
            raise self.unreachable() from None
        try:
            return await body(node)
        finally:
            await node.close()

    async def watch(
        self, wanted: GraphName, take: Callable[[Received], None], tick: Callable[[], Awaitable[None]] | None = None
    ) -> None:
        """Subscribe to a topic until the callback raises, or the master ends this node.

        Args:
            wanted: The topic; with a peer only messages of that peer's nodes count.
            take: Called for each message; what it raises is raised here, but ``Enough``.
            tick: Called when there is the subscription, each second, and at the end.
        """
        import asyncio

        from rmpa.runtime.tasks import start_task

        ended: asyncio.Future[None] = asyncio.get_running_loop().create_future()

        def on_message(received: Received) -> None:
            if ended.done() or not wanted.matches(received.caller_id):
                return
            try:
                take(received)
            except Enough:
                ended.set_result(None)
            except BaseException as error:  # noqa: BLE001 - carried over to the command, which fails with it
                ended.set_exception(error)

        async def listen(node: Node) -> None:
            subscriber = await node.subscribe(wanted.name, None, on_message)
            stopped = start_task(node.stopped.wait(), "wait for the node's end")
            try:
                ends: set[asyncio.Future[Any]] = {ended, stopped}
                done: set[asyncio.Future[Any]] = set()
                while not done:
                    if tick is not None:
                        await tick()
                    timeout = TICK if tick is not None else None
                    done, _ = await asyncio.wait(ends, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
                if ended.done():
                    ended.result()
            finally:
                stopped.cancel()
                for refusal in subscriber.refusals.values():
                    warn(refusal, "refused")
            if tick is not None:
                await tick()

        await self.with_node("rmpa_topic", listen)


def choose_master(master: str | None, agent: str | None, environ: Mapping[str, str]) -> Master:
    """Choose the master: ``--master``; ``ROS_MASTER_URI``, unless an agent is named; the core of the agent that runs.

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


def run_stream(body: Callable[[], Coroutine[object, object, None]]) -> None:
    """Run a coroutine to its end; Ctrl-C and SIGTERM cancel it, and its own clean-up runs."""
    import asyncio  # it takes 35 ms, which verbs that ask only the agent do without

    from rmpa.runtime.accept import raise_file_limit

    async def run() -> None:
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 - it is this one
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
        await body()

    with contextlib.suppress(KeyboardInterrupt, asyncio.CancelledError):
        raise_file_limit()
        asyncio.run(run())


def shown_state(route: RouteInfo) -> str:
    """The state of a route, where its messages pass the agents or not: ``open``, ``direct``, ``open and direct``."""
    if route.transport == "direct":
        return "direct"
    return f"{route.state} and direct" if route.transport == "both" else route.state
