"""Two whole bridges in made-up time: real plans, flows, lanes and publications; nodes and sockets are doubles."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from types import MappingProxyType, SimpleNamespace
from typing import Final, Self, cast
from unittest import mock

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge.bridge import Bridge
from rmpa.bridge.sessions import PeerSession
from rmpa.config.settings import Settings
from rmpa.core import limits as core_limits
from rmpa.core.contract import ContractRule
from rmpa.core.identity import Guid, Identity
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.io.link import PeerLink
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.publication import Publication
from tests.bridge.io.links import LinkEnd
from tests.bridge.io.nodes import Core, Listener, Node, PublisherConnection, Speaker, stages
from tests.bridge.io.virtual import VirtualLoop, run

SMALL_LIMITS: Final = MappingProxyType(
    {
        "EXPRESS_MESSAGE_MAX": 100,
        "EXPRESS_AGAIN_MESSAGES": 4,
        "EXPRESS_AGAIN_AFTER": 0.05,
        "FRAGMENT_BYTES": 128,
        "CUT_THROUGH_BYTES": 300,
        "COMMIT_BYTES": 256,
        "RELIABLE_WINDOW_MESSAGES": 8,
        "RELIABLE_WINDOW_BYTES": 3000,
        "ACK_MESSAGES": 4,
        "ACK_BYTES": 1500,
        "ADVERTISED_AT_ONCE": 2,
        "APPLIED_AT_ONCE": 2,
    }
)
"""What makes a message of some hundred bytes a large one, and a few of them many."""


class Side:
    """One module: its core, its bridge, its nodes.

    Args:
        name: The peer's name.
        number: 1 or 2.
        rules: Its contracts.
    """

    def __init__(self, name: str, number: int, rules: Iterable[ContractRule], rng: random.Random) -> None:
        self.name = name
        self._number = number
        self._rules = tuple(rules)
        self._rng = rng
        self._runs = 0
        self.begin()
        self.speakers: dict[tuple[str, str], Speaker] = {}
        self.listeners: list[Listener] = []
        self.link: LinkEnd | None = None

    def begin(self) -> None:
        """A new run of its agent, with a core that knows nobody."""
        self._runs += 1
        instance = bytes([self._number, self._runs]) * 8
        self.identity = Identity(Guid.of(f"10.0.0.{self._number}", 1000), instance, self.name)
        self.core = Core(self)
        settings = Settings(contracts=self._rules)
        self.bridge = Bridge(cast("RosCore", self.core), settings, rng=self._rng.random)

    @property
    def attached(self) -> Iterator[PeerSession]:
        """The other side, as far as this one knows it."""
        return iter(self.bridge.sessions)

    def publications(self, topic: str) -> Iterator[Publication]:
        """What local nodes can connect to."""
        for entry in self.bridge.topics.imports:
            publication = entry.publication
            if publication is None or publication.topic != topic or entry.route is None:
                continue
            if not entry.route.is_missing({topic: self.core.publishers(topic)}):
                yield publication

    def named(self, topic: str) -> None:
        """The master has named a topic's publishers."""
        for listener in self.listeners:
            if listener.topic == topic:
                asyncio.get_running_loop().call_later(0.002, self._connect, listener)

    def _connect(self, listener: Listener) -> None:
        if listener in self.listeners:
            listener.connect()


class World:
    """Two bridges and whatever happens to them.

    Args:
        seed: Of all chance.
        rules: Contracts, of both sides.
        clocks: Whether the sides know each other's clock.
    """

    def __init__(self, seed: int, rules: Iterable[ContractRule] = (), *, clocks: bool = False) -> None:
        self.rng = random.Random(seed)
        self.sides: Sequence[Side] = self.make_sides(rules)
        self.clocks = clocks
        self.speakers: dict[int, Speaker] = {}
        self.kept: set[str] = set()
        """Topics whose messages may come again, because some contract keeps them."""
        self._ends: tuple[LinkEnd, ...] = ()
        self._bulk_lost: set[LinkEnd] = set()

    def make_sides(self, rules: Iterable[ContractRule]) -> Sequence[Side]:
        """The modules."""
        return Side("a", 1, rules, self.rng), Side("b", 2, rules, self.rng)

    def connect(self, a: Side, b: Side, *, clocks: bool = False) -> tuple[LinkEnd, LinkEnd]:
        """The ends of a new link, which both sides take."""
        one, other = LinkEnd(a, b), LinkEnd(b, a)
        one.far, other.far = other, one
        for end in (one, other):
            end.attach("express")
            end.attach("bulk")
            if clocks:
                end.clock_offset, end.clock_error = 0.0, 0.001
            end.side.link = end
        for end in self.rng.sample((one, other), 2):
            end.side.bridge.sessions.link_up(cast("PeerLink", end))
            end.side.bridge.sessions.clock(cast("PeerLink", end))
        return one, other

    async def __aenter__(self) -> Self:
        stages.append(self)
        for side in self.sides:
            await side.bridge.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        for side in self.sides:
            await side.bridge.close()
        stages.pop()

    def speaker_at(self, uri: str) -> Speaker | None:
        """Who has this address."""
        return next((s for side in self.sides for s in side.speakers.values() if s.uri == uri), None)

    def keeps(self, speaker: int) -> bool:
        """Whether messages of a speaker may come again over a new route."""
        known = self.speakers[speaker]
        return known.latching or known.topic in self.kept

    # --- the link -------------------------------------------------------------------------------------------

    @property
    def linked(self) -> bool:
        """Whether both sides have a link."""
        return bool(self._ends) and not any(end.gone for end in self._ends)

    def link(self) -> None:
        """A new link stands; a side that has not noticed the end of the last one does so now."""
        for side in self.sides:
            if side.link is not None:
                side.link.end(silent=True)
        self._bulk_lost.clear()
        self._ends = self.connect(*self.sides, clocks=self.clocks)

    def cut(self) -> None:
        """The cable is out: nothing arrives any more; nobody has noticed yet."""
        for end in self._ends:
            for wire in end.wires.values():
                wire.lost = True

    def notice(self, index: int, *, silent: bool) -> None:
        """One side notices that the link is gone."""
        if self._ends:
            self.cut()
            self._ends[index].end(silent=silent)

    async def outage(self, seconds: float) -> None:
        """No link for a while; each side notices at once, by the lease, or when the next link stands."""
        if self.rng.random() < 0.5:
            self.cut()
        began = asyncio.get_running_loop().time()
        for index in self.rng.sample((0, 1), 2):
            if self.rng.random() < 0.8:
                await asyncio.sleep(min(seconds, mesh_limits.EXPRESS_LEASE) * self.rng.random() / 2)
                self.notice(index, silent=self.rng.random() < 0.6)
        self.cut()
        await asyncio.sleep(
            max(0.0, began + min(seconds, mesh_limits.EXPRESS_LEASE) - asyncio.get_running_loop().time())
        )
        if seconds > mesh_limits.EXPRESS_LEASE:
            for index in (0, 1):
                self.notice(index, silent=True)
        await asyncio.sleep(max(0.0, began + seconds - asyncio.get_running_loop().time()))
        self.link()

    def cut_bulk(self) -> None:
        """The bulk connection is gone; nobody has noticed yet."""
        for end in self._ends:
            if not end.gone:
                end.wires["bulk"].lost = True
                self._bulk_lost.add(end)

    def notice_bulk(self, index: int) -> None:
        """One side notices that the bulk connection is gone."""
        end = self._ends[index] if self._ends else None
        if end is not None and end in self._bulk_lost and not end.gone:
            self._bulk_lost.remove(end)
            end.bulk.disconnect()
            end.side.bridge.sessions.lane_lost(cast("PeerLink", end))

    def mend_bulk(self) -> None:
        """There is a new bulk connection; who had not noticed the end of the last one does so now."""
        if any(end.wires["bulk"].lost for end in self._ends) and self.linked:
            for index in (0, 1):
                self.notice_bulk(index)
            for end in self._ends:
                end.attach("bulk")

    def carry(self, index: int, lane: str, count: int, *, arrive: bool = True) -> int:
        """Let bytes go one way on one lane."""
        end = self._ends[index] if self._ends else None
        if end is None or end.gone:
            return 0
        return end.wires[lane].carry(count, arrive=arrive)

    # --- nodes ----------------------------------------------------------------------------------------------

    def speak(self, side: Side, topic: str, node: str, *, latching: bool = False) -> Speaker:
        """A node begins to publish, or comes back."""
        self.hush(side, topic, node)
        number = len(self.speakers) + 1
        speaker = self.speakers[number] = Speaker(side, number, topic, node, latching, f"http://speaker-{number}/")
        side.speakers[topic, node] = speaker
        side.core.call("registerPublisher", node, topic, "a/B", speaker.uri)
        return speaker

    def hush(self, side: Side, topic: str, node: str) -> None:
        """A node is killed: its connections break, and the master hears of it soon."""
        speaker = side.speakers.pop((topic, node), None)
        if speaker is not None:
            for connection in list(speaker.connections):
                connection.lose("it died")
            side.core.call("unregisterPublisher", node, topic, speaker.uri)

    def listen(self, side: Side, topic: str) -> Listener:
        """A node begins to listen."""
        listener = Listener(side, topic)
        side.listeners.append(listener)
        side._connect(listener)
        return listener

    def leave(self, listener: Listener) -> None:
        """It listens no more."""
        listener.side.listeners.remove(listener)
        listener.leave()

    async def restart(self, side: Side) -> None:
        """An agent without a link ends, and another run of it begins; its nodes register anew."""
        assert side.link is None or side.link.gone
        await side.bridge.close()
        side.begin()
        await side.bridge.start()
        for (topic, node), speaker in side.speakers.items():
            side.core.call("registerPublisher", node, topic, "a/B", speaker.uri)

    # --- rest -----------------------------------------------------------------------------------------------

    async def wait(self, seconds: float) -> None:
        """Let time go on; a link that nothing came over for as long as a lease would be no link."""
        while seconds > 0:
            await asyncio.sleep(min(seconds, mesh_limits.EXPRESS_LEASE / 2))
            seconds -= mesh_limits.EXPRESS_LEASE / 2
            if seconds > 0:
                self._carry_all()

    async def rest(self, seconds: float, *, step: float = 0.01) -> None:
        """Let time go on, and everything arrive that can."""
        loop = asyncio.get_running_loop()
        until = loop.time() + seconds
        while loop.time() < until:
            self._carry_all()
            await asyncio.sleep(step)

    def _carry_all(self) -> None:
        """Every wire in any order, and each of them a little or all that it has."""
        for index, lane in self.rng.sample([(i, lane) for i in (0, 1) for lane in ("express", "bulk")], 4):
            self.carry(index, lane, self.rng.choice([100, 1000, 1 << 20]))

    def check_nothing_is_left(self) -> None:
        """Nobody listens: nothing is connected, nothing flows, nothing is remembered of it."""
        for side in self.sides:
            bridge = side.bridge
            assert not bridge.topics.exports.flows
            assert not any(told.routes for told in bridge.topics.exports.peers.values())
            assert not bridge.topics.exports._parked
            assert not bridge.topics.imports.flowing
            assert not any(entry.flow for entry in bridge.topics.imports)
            for attached in side.attached:
                assert not any(attached.link.routes), "but route 0, which every link has"
        for end in self._ends:
            for lane in (end.express, end.bulk):
                assert lane.outbox.pending_bytes == 0
                assert not lane._open
                assert not any(lane.outbox._own_bounds), "likewise"


@contextmanager
def made_up(loop: VirtualLoop) -> Iterator[None]:
    """Doubles in place of sockets, small limits, and one clock for all."""
    with ExitStack() as stack:
        for name, value in SMALL_LIMITS.items():
            module = next(room for room in (core_limits, mesh_limits, bridge_limits) if hasattr(room, name))
            stack.enter_context(mock.patch.object(module, name, value))
        for where in ("proxies", "bridge"):
            stack.enter_context(mock.patch(f"rmpa.bridge.{where}.SlaveNode", Node))
        stack.enter_context(mock.patch("rmpa.bridge.proxies.is_loopback", return_value=False))
        stack.enter_context(mock.patch("rmpa.bridge.topics.exports.PublisherConnection", PublisherConnection))
        for flow in ("export", "reception"):
            wall = SimpleNamespace(time_ns=loop.time_ns)
            stack.enter_context(mock.patch(f"rmpa.bridge.data.{flow}.time", wall))
        yield


def play(
    seed: int,
    scene: Callable[[World], Coroutine[object, object, None]],
    rules: Iterable[ContractRule] = (),
    *,
    clocks: bool = False,
    kept: Iterable[str] = (),
) -> None:
    """Play one scene of a world to its end.

    Args:
        seed: Of all chance.
        scene: What happens.
        rules: Contracts, of both sides.
        clocks: Whether the sides know each other's clock.
        kept: Topics whose messages may come again.
    """
    loop = VirtualLoop()

    async def main() -> None:
        async with World(seed, rules, clocks=clocks) as world:
            world.kept.update(kept)
            await scene(world)

    with made_up(loop):
        run(main(), loop)
