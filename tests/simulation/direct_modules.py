"""Modules that negotiate direct transport in made-up time: the real drivers of both sides, and models of their nodes.

What the drivers ask of nodes and of the kernel (``bridge.topics.direct``) is answered by ``Network``.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final, cast

from rmpa.bridge.direct import grants
from rmpa.bridge.direct.grants import TopicGrants
from rmpa.bridge.direct.paths import Condition, Grant, Unmet
from rmpa.bridge.messages import Source
from rmpa.bridge.policy import OPEN_GATE
from rmpa.bridge.topics import direct as direct_importer
from rmpa.bridge.topics.direct import TopicPaths
from rmpa.core.contract import Contracts, Transport
from rmpa.core.errors import UnreachableError
from rmpa.core.statistics import Counters
from rmpa.ros.master.parameters import RegistrationKind
from tests.simulation.network import Trace

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine, Iterator
    from unittest.mock import _patch

TYPE: Final = "std_msgs/String"


class World(Trace):
    """Chance, the tasks of nodes, and the trace; the time is the loop's."""

    def __init__(self, seed: int, *, keep: bool = False) -> None:
        super().__init__(seed, keep=keep)
        self.tasks: set[asyncio.Task[Any]] = set()

    @property
    def now(self) -> float:  # type: ignore[override] # of a running loop
        """Seconds."""
        return asyncio.get_running_loop().time()

    async def pause(self, most: float) -> None:
        """A random while."""
        await asyncio.sleep(most * self.rng.random())

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Let something happen beside the rest."""
        task = asyncio.create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)


class Channel:
    """One link, both ways: in order, each message after a random delay, none behind the link's end."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._last = [0.0, 0.0]
        self.up = True

    def send(self, way: int, deliver: Callable[[], None]) -> None:
        """Deliver a message in the direction ``way``, 0 or 1."""
        loop = asyncio.get_running_loop()
        when = loop.time() + self._world.rng.choice([0.0005, 0.005, 0.05]) * self._world.rng.random()
        self._last[way] = when = max(when, self._last[way] + 1e-9)
        loop.call_at(when, lambda: deliver() if self.up else None)


class Rpc:
    """One end of the requests between two agents."""

    def __init__(self, way: int) -> None:
        self.way = way
        self.handlers: dict[str, Any] = {}
        self.routes: dict[int, tuple[Channel, Rpc, Any]] = {}
        """By peer: the link, the other end, and the session there."""
        self._answering: set[asyncio.Task[None]] = set()

    def on_request(self, what: str, handler: object, _needs: object) -> None:
        self.handlers[what] = handler

    on_notification = on_request

    def notify(self, session: Any, what: str, args: dict[str, Any]) -> None:
        channel, other, there = self.routes[session.peer]
        channel.send(self.way, lambda: other.handlers[what](there, args))

    async def request(self, session: Any, what: str, args: dict[str, Any], _timeout: float) -> Any:
        channel, other, there = self.routes[session.peer]
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

        async def answer() -> None:
            value = await other.handlers[what](there, args)
            channel.send(other.way, lambda: None if future.done() else future.set_result(value))

        channel.send(self.way, lambda: self._start(answer()))
        while not future.done():
            if not channel.up:
                raise UnreachableError("agent", session.link.name)
            await asyncio.wait([future], timeout=0.05)
        return future.result()

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._answering.add(task)
        task.add_done_callback(self._answering.discard)


@dataclass
class Talker:
    """A publisher's node."""

    source: Source
    port: int
    up: bool = True
    reachable: bool = True
    network: bool = True
    """Whether it listens for other machines."""
    latched: bool = False

    @property
    def uri(self) -> str:
        return f"http://t:{self.port}/"


@dataclass
class Listener:
    """A subscriber's node: its connections to each source are ``"relay"`` or a port."""

    name: str
    leaves: bool
    """Whether it hangs up on publishers that the master does not name, as roscpp does."""
    paths: dict[Source, list[str | int]] = field(default_factory=dict)
    asking: set[tuple[Source, int]] = field(default_factory=set)
    """Sources whose proxy is asked, each with the proxy's number: a new proxy is asked anew."""


class Proxies:
    """The proxies of a peer's nodes."""

    def get(self, node: str) -> Any:
        return SimpleNamespace(name=node, uri=f"http://proxy{node}/", address_of=lambda _: None)


def session(peer: int, name: str, address: str) -> Any:
    """The double of one run of a peer."""
    link, proxies = SimpleNamespace(name=name, crashed=False), Proxies()
    facts = {"peer": peer, "linked": True, "silent": True, "same_machine": False, "address": address}
    return SimpleNamespace(link=link, proxies=proxies, **facts)


class Entry(SimpleNamespace):
    """The double of a source as the publishers' module offers it."""

    @property
    def publication(self) -> Any:
        return self.module.publication(self.wire)


def sessions(of: dict[int, Any]) -> Any:
    """The double of ``PeerSessions``."""
    return SimpleNamespace(get=of.get, linked=lambda: [one for one in of.values() if one.linked])


class Rules:
    """The double of the rules of a module, whose owner changes whether it allows direct transport."""

    gate = OPEN_GATE

    def __init__(self, owner: PublisherModule | SubscriberModule) -> None:
        self._owner = owner

    @property
    def contracts(self) -> Contracts:
        return Contracts((), Transport.AUTO if self._owner.allowed else Transport.RELAY)


class PublisherModule:
    """The module of the talkers: what it grants, its local subscribers and its rules."""

    def __init__(self, world: World, talkers: tuple[Talker, ...]) -> None:
        self.world = world
        self.talkers = {one.source: one for one in talkers}
        self.local: set[str] = set()
        self.offered = {source: SimpleNamespace(type=TYPE, origin=None) for source in self.talkers}
        self.allowed = True
        self.start()

    def start(self) -> None:
        """A new run of its agent."""
        self.peers: dict[int, Any] = {}
        self.modules: dict[int, SubscriberModule] = {}
        self.rpc = Rpc(1)
        core = SimpleNamespace(
            publishers=lambda topic: {
                one.source.node: one.uri for one in self.talkers.values() if one.up and one.source.topic == topic
            },
            subscribers=lambda _: dict.fromkeys(self.local, "http://local/"),
            suspect=lambda _: None,
            state=lambda: SimpleNamespace(services={}),
        )
        exports = SimpleNamespace(
            offered=self.offered, local=lambda _, source: source if source in self.offered else None
        )
        shared = SimpleNamespace(
            core=core, sessions=sessions(self.peers), rpc=self.rpc, counters=Counters(), context=Rules(self)
        )
        self.exporter = TopicGrants(cast("Any", shared), cast("Any", exports))
        self.exporter.ports = cast("Any", SimpleNamespace(find=self._port, forget=lambda _: None))

    async def _port(self, node: str, _uri: str, topic: str) -> int | Unmet:
        talker = self.talkers[Source(topic, node)]
        found: int | Unmet = talker.port if talker.network else Unmet(Condition.LISTENING, "loopback")
        await self.world.pause(0.02)
        return found

    def changed(self, kind: RegistrationKind, topic: str, node: str, *, added: bool) -> None:
        """A registration came or went."""
        self.exporter.graph_changed(
            cast("Any", SimpleNamespace(kind=kind, name=topic, node=node, api="", added=added))
        )

    def advertise(self) -> None:
        """Compare what is offered with the registrations, a little later than these."""
        now = {source for source, one in self.talkers.items() if one.up}
        for source in sorted(now ^ set(self.offered)):
            if source in now:
                self.offered[source] = SimpleNamespace(type=TYPE, origin=None)
            else:
                del self.offered[source]
            for module in self.modules.values():
                module.told(source, shown=source in now)
        self.exporter.judge_again(refused=False)


class SubscriberModule:
    """A module with listeners: the decisions of its agent, and the calls that carry them out."""

    def __init__(self, world: World, name: str, there: PublisherModule) -> None:
        self.world = world
        self.name = name
        self.address = f"10.0.{ord(name)}.1"
        """The publishers' machine, as it is seen from here."""
        self.there = there
        self.listeners: dict[str, Listener] = {}
        self.allowed = True
        self.channel: Channel | None = None
        self.peers: dict[int, Any] = {}
        self.shown: dict[Source, Any] = {}
        self.here = self.there_number = 0
        self.start()

    def start(self) -> None:
        """A new run of its agent."""
        self.rpc = Rpc(0)
        core = SimpleNamespace(
            publishers=lambda topic: {
                f"/rmpa{one.node}": f"http://proxy{one.node}/" for one in self.shown if one.topic == topic
            },
            subscribers=lambda _: {name: f"http://{self.name}{name}/" for name in self.listeners},
            suspect=lambda _: None,
            node_host="127.0.0.1",
        )
        shared = SimpleNamespace(
            core=core, sessions=sessions(self.peers), rpc=self.rpc, counters=Counters(), context=Rules(self)
        )
        self.importer = TopicPaths(cast("Any", shared), lambda *_: None, cast("Any", self))

    # --- as Imports, and as a publication -------------------------------------------------------------------------

    def __iter__(self) -> Iterator[Any]:
        return iter(list(self.shown.values()))

    def get(self, _peer: int, source: Source) -> Any:
        return self.shown.get(source)

    def at(self, topic: str) -> list[Any]:
        return [self.shown[source] for source in sorted(self.shown) if source.topic == topic]

    def publication(self, source: Source) -> Any:
        """That of a source at its proxy; ``None`` if it is not shown."""
        callers = frozenset(name for name in self.listeners if "relay" in self.paths(source, name))

        def hang_up(name: str) -> bool:
            paths = self.paths(source, name)
            left = "relay" in paths
            paths[:] = [one for one in paths if one != "relay"]
            self.importer.listeners_changed(self.here, source)
            return left

        return SimpleNamespace(callers=callers, hang_up=hang_up) if source in self.shown else None

    def paths(self, source: Source, name: str) -> list[str | int]:
        """The connections of a listener to a source."""
        return self.listeners[name].paths.setdefault(source, []) if name in self.listeners else []

    def told(self, source: Source, *, shown: bool) -> None:
        """The advertisement of the publisher's agent, over the present link."""
        if self.channel is not None:
            self.channel.send(1, lambda: self.advertised(source, shown=shown))

    # --- what happens ----------------------------------------------------------------------------------------------

    def subscribe(self, name: str, *, leaves: bool) -> None:
        """A node starts; it asks each proxy that it is named."""
        self.listeners[name] = Listener(name, leaves)
        for source in sorted(self.shown):
            self._register(source, name, added=True)
            self.ask(source, name)

    def unsubscribe(self, name: str) -> None:
        """A node ends, and its connections with it."""
        del self.listeners[name]
        for source in sorted(self.shown):
            self._register(source, name, added=False)

    def _register(self, source: Source, name: str, *, added: bool) -> None:
        kind, uri = RegistrationKind.SUBSCRIBER, f"http://{self.name}{name}/"
        change = SimpleNamespace(kind=kind, name=source.topic, node=name, api=uri, added=added)
        self.importer.graph_changed(cast("Any", change))

    def reload(self) -> None:
        """Other rules."""
        self.importer.reload()

    def advertised(self, source: Source, *, shown: bool) -> None:
        """A source appears in the graph here, or leaves it."""
        if shown and source not in self.shown:
            latched = SimpleNamespace(latching=self.there.talkers[source].latched)
            entry = self.shown[source] = Entry(
                module=self,
                peer=self.here,
                wire=source,
                name=source.topic,
                node=source.node,
                type=TYPE,
                shown=True,
                origin=None,
                description=latched,
                direct=False,
            )
            self.importer.shown(cast("Any", entry))
            for name in list(self.listeners):
                self.ask(source, name, anew=True)
        elif not shown and source in self.shown:
            self.importer.hidden(self.shown[source])
            self.leave(source)

    def leave(self, source: Source) -> None:
        """The proxy of a source is gone, and with it the relayed connections."""
        del self.shown[source]
        for name, listener in self.listeners.items():
            paths = self.paths(source, name)
            paths[:] = [one for one in paths if one != "relay" and not listener.leaves]

    def ask(self, source: Source, name: str, *, anew: bool = False) -> None:
        """The node calls ``requestTopic`` at a new proxy, or at one to which it has no connection."""
        listener, entry = self.listeners.get(name), self.shown.get(source)
        key = source, id(entry)
        if listener is not None and (anew or not (self.paths(source, name) or key in listener.asking)):
            listener.asking.add(key)
            self.world.spawn(self._ask(source, listener, entry))

    async def _ask(self, source: Source, listener: Listener, entry: object) -> None:
        await self.world.pause(0.005)
        answer: Awaitable[Any] | None = None
        if entry is not None and self.shown.get(source) is entry and self.listeners.get(listener.name) is listener:
            answer = self.importer.request(self.here, source, listener.name)
        reply = await answer if answer is not None else None
        listener.asking.discard((source, id(entry)))
        await self.world.pause(0.005)
        if entry is None or self.shown.get(source) is not entry or self.listeners.get(listener.name) is not listener:
            return
        if reply is None:
            self.paths(source, listener.name).append("relay")
            self.importer.listeners_changed(self.here, source)
        elif reply.code == 1:
            talker = self.there.talkers[source]
            if talker.up and talker.reachable and talker.port == reply.value[2]:
                self.paths(source, listener.name).append(talker.port)

    def end_all(self, port: int) -> None:
        """The connections from this module to a port end."""
        for listener in self.listeners.values():
            for paths in listener.paths.values():
                if port in paths:
                    paths.remove(port)

    # --- links -----------------------------------------------------------------------------------------------------

    def link_up(self, channel: Channel, number: int, there_number: int) -> None:
        """A link; with other numbers it is one of another run."""
        there = self.there
        if number != self.here:
            self.peers[number] = session(number, "a", self.address)
            there.peers[there_number] = session(there_number, self.name, self.address)
        self.here, self.there_number, self.channel = number, there_number, channel
        mine, theirs = self.peers[number], there.peers[there_number]
        there.modules[there_number] = self
        self.rpc.routes[number] = (channel, there.rpc, theirs)
        there.rpc.routes[there_number] = (channel, self.rpc, mine)
        for one in (mine, theirs):
            one.linked = True
        self.importer.link_up(mine)
        there.exporter.link_up(theirs)

    def link_down(self, *, crashed: bool) -> None:
        """The link ends."""
        mine, theirs = self.peers[self.here], self.there.peers[self.there_number]
        assert self.channel is not None
        self.channel.up, self.channel = False, None
        for one in (mine, theirs):
            one.linked = False
            one.link.crashed = crashed
        self.importer.link_down(mine)
        self.there.exporter.link_down(theirs)

    def gone(self) -> None:
        """The session of the last link ends."""
        self.importer.gone(self.peers.pop(self.here))
        theirs = self.there.peers.pop(self.there_number)
        self.there.exporter.gone(theirs)
        self.there.modules.pop(self.there_number)
        for source in list(self.shown):
            self.leave(source)
        self.here = 0


class Network:
    """What the drivers ask of nodes and of the kernel."""

    def __init__(self, world: World, modules: list[SubscriberModule]) -> None:
        self._world = world
        self._modules = modules
        self._ports: dict[tuple[int, Source, int], int] = {}

    def patches(self, patch: Any) -> list[_patch[Any]]:
        """What stands in place of the driver's functions."""
        names = ("bus_links", "end_link", "publisher_update", "forgotten", "standing")
        more = {"kernel_tells": lambda: True, "probe": self._probe}
        return [
            patch.object(grants, "grant_at", lambda _, node, port, probe: Grant(port, node, probe)),
            *(
                patch.object(direct_importer, name, what)
                for name, what in ({name: getattr(self, f"_{name}") for name in names} | more).items()
            ),
        ]

    def _at(self, uri: str) -> tuple[SubscriberModule, Listener | None]:
        module = next(one for one in self._modules if one.name == uri[7])
        return module, module.listeners.get(uri[8:].rstrip("/"))

    def _port(self, listener: Listener, source: Source, port: int) -> int:
        return self._ports.setdefault((id(listener), source, port), len(self._ports) + 1)

    def _rows(self, module: SubscriberModule) -> list[tuple[Listener, Source, int]]:
        return [
            (listener, source, port)
            for listener in module.listeners.values()
            for source, paths in listener.paths.items()
            for port in paths
            if isinstance(port, int)
        ]

    async def _bus_links(self, uri: str, topic: str) -> list[Any]:
        await self._world.pause(0.01)
        module, listener = self._at(uri)
        return [
            SimpleNamespace(
                inbound=True,
                topic=source.topic,
                connected=True,
                other=f"http://proxy{source.node}/",
                remote=(module.address, port),
                local_port=self._port(one, source, port),
            )
            for one, source, port in self._rows(module)
            if one is listener and source.topic == topic
        ]

    async def _end_link(self, link: Any) -> str:
        await self._world.pause(0.01)
        module = self._module_of(link.remote[0])
        for listener, source, port in self._rows(module):
            if port == link.remote[1] and self._port(listener, source, port) == link.local_port:
                module.paths(source, listener.name).remove(port)
        return ""

    async def _publisher_update(self, uri: str, topic: str, publishers: list[str]) -> bool:
        await self._world.pause(0.01)
        module, listener = self._at(uri)
        for source in sorted(module.shown) if listener is not None else ():
            if source.topic != topic or listener is None:
                continue
            if f"http://proxy{source.node}/" in publishers:
                module.ask(source, listener.name)
            elif listener.leaves:
                left = "relay" in module.paths(source, listener.name)
                module.paths(source, listener.name).clear()
                if left:
                    module.importer.listeners_changed(module.here, source)
        return True

    async def _forgotten(self, *_: object) -> None:
        await self._world.pause(0.01)

    async def _probe(self, address: str, port: int, *_: object, **__: object) -> str:
        await self._world.pause(0.01)
        talkers = self._module_of(address).there.talkers.values()
        return "" if any(one.port == port and one.up and one.reachable for one in talkers) else "no answer"

    def _module_of(self, address: str) -> SubscriberModule:
        return next(module for module in self._modules if module.address == address)

    def _standing(self, address: str, _port: int | None = None) -> dict[int, set[int]]:
        found: dict[int, set[int]] = {}
        for module in self._modules:
            for listener, source, port in self._rows(module) if module.address == address else ():
                found.setdefault(port, set()).add(self._port(listener, source, port))
        return found
