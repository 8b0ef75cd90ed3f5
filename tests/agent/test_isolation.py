"""Control work gives way to data: how long the loop of two agents keeps its eyes off the sockets of the data path.

Time is that which the loop's thread had the processor, so that a busy machine does not count, in units of what some
work takes the interpreter there, so that a slow one does not. What happens once may still be the machine's; what a
kind of work does each time is ours. docs/design/isolation.md has the figures.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import os
import socket
import sys
import threading
import time
import xmlrpc.client
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import replace
from ipaddress import IPv4Address
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import pytest

from rmpa.agent.agent import Agent
from rmpa.config import limits as config_limits
from rmpa.config.peer_rules import PeerRule, PolicySettings
from rmpa.config.settings import Settings
from rmpa.config.values import Multicast
from rmpa.core.identity import Guid, Identity
from rmpa.discovery import limits as discovery_limits
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.discovery.membership import HEARTBEAT_INTERVAL
from rmpa.observe.control_client import ControlClient
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.external import ExternalCore
from rmpa.runtime import loop as loop_module
from rmpa.runtime.loop import AgentLoop, DirectSelector, yield_to_data

if TYPE_CHECKING:
    from pathlib import Path
    from types import FrameType

DEADLINE: Final = 60.0


def piece_of_work() -> float:
    """Seconds of CPU that the interpreter takes for some work: 1.6 ms on the machine of docs/design/isolation.md."""
    begin, seen = time.thread_time(), {}
    for number in range(20_000):
        seen[number & 255] = str(number)
    return time.thread_time() - begin


BOUND: Final = 4 * sorted(piece_of_work() for _ in range(31))[15]
"""Seconds of CPU that no work may take without a look; most of it takes a tenth of that."""
STRAYS: Final = 2
"""Longer ones in a phase that are blamed on the machine; each phase does its work more often than that."""
TOPICS: Final = 1000
NODES: Final = 50
TYPE: Final = "sensor_msgs/PointCloud2"

pytestmark = [pytest.mark.alone, pytest.mark.timeout(240)]


class Watched(DirectSelector):
    """Notes how long nobody looked at the sockets of the data path, and who did not."""

    holds: list[tuple[float, str]]
    looks = 0
    last: str = ""
    """The callback of the loop that ran last."""

    def __init__(self) -> None:
        super().__init__()
        Watched.holds = []
        self._thread = threading.get_ident()
        self._looked = time.thread_time()

    def poll_data(self) -> None:
        self._note()
        super().poll_data()
        self._looked = time.thread_time()

    def select(self, timeout: float | None = None) -> list[tuple[object, int]]:  # type: ignore[override]
        self._note()
        try:
            return super().select(timeout)  # type: ignore[return-value]
        finally:
            self._looked = time.thread_time()

    def _call(self, happened: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """The readers themselves: what one does, the others wait for too."""
        begin = time.thread_time()
        try:
            return super()._call(happened)
        finally:
            self._count(time.thread_time() - begin)

    def _note(self) -> None:
        Watched.looks += 1
        self._count(time.thread_time() - self._looked)

    def _count(self, hold: float) -> None:
        if hold > BOUND:
            Watched.holds.append((hold, _where()))


def _where() -> str:
    """Return the innermost functions of the package that took the time."""
    frame: FrameType | None = sys._getframe(3)
    names: list[str] = []
    while frame is not None and len(names) < 4:
        path = frame.f_code.co_filename
        if "rmpa" in path and not path.endswith(("runtime/loop.py", "test_isolation.py")):
            names.append(f"{path.rpartition('rmpa/')[2]}:{frame.f_lineno} {frame.f_code.co_name}")
        frame = frame.f_back
    return " < ".join(names) or Watched.last


@pytest.fixture(autouse=True)
def watched(monkeypatch: pytest.MonkeyPatch) -> None:
    run = asyncio.Handle._run

    def remember(handle: asyncio.Handle) -> None:
        Watched.last = f"before it: {handle!r}"[:300]
        run(handle)

    monkeypatch.setattr(asyncio.Handle, "_run", remember)
    monkeypatch.setattr(loop_module, "DirectSelector", Watched)


class World:
    """Two linked agents in one loop, and threads that are their nodes and tools."""

    def __init__(
        self, near: Agent, far: Agent, threads: ThreadPoolExecutor, api: str, group: tuple[str, int]
    ) -> None:
        self.near, self.far, self.api, self.group = near, far, api, group
        self._threads = threads
        self._phase = ""

    async def beside(self, *works: Callable[[], object]) -> None:
        """Do blocking work in threads, all at once."""
        loop = asyncio.get_running_loop()
        async with asyncio.timeout(DEADLINE):
            await asyncio.gather(*(loop.run_in_executor(self._threads, work) for work in works))

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(DEADLINE):
            while not condition():
                await asyncio.sleep(0.01)

    def shown(self, namespace: str = "/fleet/") -> int:
        """Topics of the far module that the near one's graph has."""
        return sum(topic.startswith(namespace) for topic in self.near.core.state().publishers)

    def linked(self) -> bool:
        return all(len(list(agent.bridge.sessions.linked())) == 1 for agent in (self.near, self.far))


@asynccontextmanager
async def worlds(tmp_path: Path, master: str = "") -> AsyncIterator[World]:
    group = (config_limits.MULTICAST_GROUP, 20000 + (os.getpid() + 7919) % 20000)
    settings = Settings(
        core_port=0, interfaces=("lo",), multicast=Multicast(port=group[1]), runtime_dir=str(tmp_path)
    )
    near = replace(settings, name="near")
    if master:
        near = replace(near, core_mode="external", core_master=master)
    agents = [Agent(near), Agent(replace(settings, name="far"))]
    with socket.create_server(("127.0.0.1", 0)) as listening, ThreadPoolExecutor(16) as threads:
        api = f"http://127.0.0.1:{listening.getsockname()[1]}/"
        started: list[Agent] = []
        try:
            for agent in agents:
                await agent.start()
                started.append(agent)
            world = World(agents[0], agents[1], threads, api, group)
            await world.until(world.linked)
            yield world
        finally:
            for agent in reversed(started):
                await agent.close()


def calls(agent: Agent, bodies: Iterable[bytes]) -> Callable[[], None]:
    """Calls of a node or tool on one connection, one after the other; made there, not in the loop."""

    def work() -> None:
        connection = http.client.HTTPConnection(urlsplit(agent.core.uri).netloc, timeout=DEADLINE)
        for body in bodies:
            connection.request("POST", "/RPC2", body, {"Content-Type": "text/xml"})
            answer = connection.getresponse()
            assert answer.status == 200
            answer.read()
        connection.close()

    return work


def call(method: str, *params: object) -> bytes:
    return xmlrpc.client.dumps(params, method).encode()  # type: ignore[arg-type]


def fleet(method: str, node: int, *further: str) -> Iterator[bytes]:
    """The (un)registrations of one node."""
    for topic in range(node, TOPICS, NODES):
        yield call(method, f"/fleet/node_{node}", f"/fleet/some/namespace/topic_{topic}", *further)


# --- the phases ------------------------------------------------------------------------------------------------


async def a_fleet_registers(world: World) -> None:
    nodes = [fleet("registerPublisher", node, TYPE, world.api) for node in range(NODES)]
    await world.beside(*(calls(world.far, bodies) for bodies in nodes))
    await world.until(lambda: world.shown() == TOPICS)


async def tools_ask_the_master(world: World) -> None:
    methods = ("getSystemState", "getTopicTypes", "getParamNames", "getUri")
    bodies = [call(method, "/tool") for method in methods] + [call("getPublishedTopics", "/tool", "")]
    await world.beside(*(calls(agent, bodies * 8) for agent in (world.near, world.far)))


async def parameters_are_large(world: World) -> None:
    def bodies() -> Iterator[bytes]:
        yield call("subscribeParam", "/tool", world.api, "/large/k1")
        maps = [{f"k{i}": {"gains": [1.5] * 20, "frame": "base_link"} for i in range(count)} for count in (50, 500)]
        texts = ["<link name='a'>\n  <visual/>\n</link>\n" * count for count in (100, 20_000)]
        for value in (*maps, *texts):
            for _ in range(3):
                yield call("setParam", "/tool", "/large", value)
                yield call("getParam", "/tool", "/large")

    await world.beside(calls(world.near, bodies()))


async def somebody_looks_at_everything(world: World) -> None:
    def work() -> None:
        path = next(world.near.control.path.parent.glob("near.sock"))
        with ControlClient(path, timeout=DEADLINE) as client:
            for _ in range(6):
                assert len(client.snapshot().topics) > TOPICS

    await world.beside(work)


async def somebody_asks_why(world: World) -> None:
    """Of topics that nobody listens to and of one with no such name: both agents look at all that they have."""
    topic = next(iter(world.near.bridge.topics.imports.offered_by(next(world.near.bridge.sessions.linked()).peer)))

    def work() -> None:
        path = next(world.near.control.path.parent.glob("near.sock"))
        with ControlClient(path, timeout=DEADLINE) as client:
            for name, peer in ((topic, "far"), (topic, None), (topic + "x", "far"), (topic + "x", None)) * 2:
                (found,) = client.call("why", tuple[Diagnosis, ...], name=name, peer=peer)
                assert found.failed is not None or found.unasked

    await world.beside(work)


async def plans_are_reconciled(world: World) -> None:
    for _ in range(6):
        for agent in (world.near, world.far):
            assert agent.bridge._reconciler is not None
            agent.bridge._reconciler.cancel()
            agent.bridge._reconcile()
        await world.until(lambda: not (world.near.bridge.topics._changed or world.far.bridge.topics._changed))


async def other_rules_hold(world: World) -> None:
    """Every topic gets another name here, and is kept home over there; and back."""
    for rules in ((PeerRule("far", "/moved"),), ()) * 3:
        world.near.apply_settings(replace(world.near.settings, peers=rules))
        await world.until(lambda rules=rules: world.shown() == (0 if rules else TOPICS))  # type: ignore[misc]
        await world.until(lambda rules=rules: world.shown("/moved/fleet/") == (TOPICS if rules else 0))  # type: ignore[misc]
    for policy in (PolicySettings(deny=("/fleet/**",)), PolicySettings()) * 3:
        world.far.apply_settings(replace(world.far.settings, policy=policy))
        await world.until(lambda policy=policy: world.shown() == (0 if policy.deny else TOPICS))  # type: ignore[misc]


async def the_link_falls_and_comes_back(world: World) -> None:
    for _ in range(4):
        attached = next(iter(world.near.bridge.sessions.linked()))
        attached.link.abort("pulled")
        await world.until(lambda attached=attached: attached.linked and world.linked())  # type: ignore[misc]
        await world.until(lambda: world.shown() == TOPICS)


async def many_peers_shout(world: World) -> None:
    def work() -> None:
        here = IPv4Address("127.0.0.1")
        peers = [Identity(Guid.of(here, 1 + i, 7), os.urandom(16), f"ghost{i}") for i in range(50)]
        everybody = tuple(peer.guid for peer in peers)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
            for turn in range(6):
                kind = BeaconKind.ANNOUNCE if turn < 3 else BeaconKind.HEARTBEAT
                for peer in peers:
                    out.sendto(Beacon(kind, peer, 16_000, turn, everybody).serialize(), world.group)
                time.sleep(0.2)

    await world.beside(work)
    assert world.near.network.endpoint is not None
    assert len(world.near.network.endpoint.discovery.membership.endpoints.views()) > 25


async def thousands_of_peers_are_invented(world: World) -> None:
    """From sixty addresses, so that what one may send is no bound; then whatever has to be done about them."""

    def work() -> None:
        senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(60)]
        for number, out in enumerate(senders):
            out.bind((f"127.0.0.{2 + number}", 0))
            out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        for number in range(3000):
            guid = Guid.of(f"127.1.{number // 250}.{1 + number % 250}", 4000)
            gossip = tuple(Guid.of(f"127.2.{number // 250}.{n}", 4000) for n in range(1, 9))
            identity = Identity(guid, os.urandom(16), f"invented{number}")
            beacon = Beacon(BeaconKind.ANNOUNCE, identity, 120_000, 1, gossip)
            senders[number % 60].sendto(beacon.serialize(), world.group)
            if number % 20 == 19:
                time.sleep(0.02)
        for out in senders:
            out.close()
        path = next(world.near.control.path.parent.glob("near.sock"))
        with ControlClient(path, timeout=DEADLINE) as client:
            for _ in range(4):
                client.snapshot()
                time.sleep(2 * HEARTBEAT_INTERVAL / 4)

    await world.beside(work)
    assert world.near.network.endpoint is not None
    discovery = world.near.network.endpoint.discovery
    assert len(discovery.membership.endpoints.views()) > discovery_limits.STRANGERS_MAX / 2
    assert discovery.counters["roster.full"] > 0
    assert world.linked()


async def the_fleet_leaves(world: World) -> None:
    nodes = [fleet("unregisterPublisher", node, world.api) for node in range(NODES)]
    await world.beside(*(calls(world.far, bodies) for bodies in nodes))
    await world.until(lambda: world.shown() == 0)


Phase = Callable[[World], Awaitable[None]]
PHASES: Final[tuple[Phase, ...]] = (
    a_fleet_registers,
    tools_ask_the_master,
    parameters_are_large,
    somebody_looks_at_everything,
    somebody_asks_why,
    plans_are_reconciled,
    other_rules_hold,
    the_link_falls_and_comes_back,
    many_peers_shout,
    thousands_of_peers_are_invented,
    the_fleet_leaves,
)


def assert_yields_to_data(tmp_path: Path, *phases: Phase, external: bool = False) -> None:
    """Run the phases in one world, and fail for those that held the loop for too long too often."""
    found: dict[str, list[tuple[float, str]]] = {}

    async def main() -> None:
        async with contextlib.AsyncExitStack() as undo:
            uri = ""
            if external:
                master = RosCore(port=0, rosout=False)
                await master.start()
                undo.push_async_callback(master.close)
                uri = master.uri
            world = await undo.enter_async_context(worlds(tmp_path, uri))
            for phase in phases:
                Watched.holds.clear()
                await phase(world)
                if len(Watched.holds) > STRAYS:
                    found[phase.__name__] = sorted(Watched.holds, reverse=True)[:8]

    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        runner.run(main())
    told = [f"{name}: {1e3 * hold:.1f} ms: {who}" for name, holds in found.items() for hold, who in holds]
    assert not found, "\n".join(told)
    assert Watched.looks > 10_000


def test_work_on_a_thousand_topics_yields_to_data(tmp_path: Path) -> None:
    assert_yields_to_data(tmp_path, *PHASES)


async def an_external_graph_is_followed(world: World) -> None:
    """A fleet of its own comes and goes at the master, which the agent finds by looking."""
    for turn in range(2):
        nodes = [fleet("registerPublisher", node, TYPE, world.api) for node in range(NODES)]
        await world.beside(*(calls(world.near, bodies) for bodies in nodes))
        await world.until(lambda: world.shown() == TOPICS)
        if turn == 0:
            nodes = [fleet("unregisterPublisher", node, world.api) for node in range(NODES)]
            await world.beside(*(calls(world.near, bodies) for bodies in nodes))
            await world.until(lambda: world.shown() == 0)


async def its_master_is_started_anew(world: World) -> None:
    assert isinstance(world.near.core, ExternalCore)
    for _ in range(4):
        world.near.core._drop_writes()
        world.near.core._poll_soon()
        looks = world.near.core.counters.as_dict()["master.looks"]
        await world.until(lambda looks=looks: world.near.core.counters.as_dict()["master.looks"] > looks)  # type: ignore[misc]


def test_reading_an_external_core_yields_to_data(tmp_path: Path) -> None:
    assert_yields_to_data(
        tmp_path,
        a_fleet_registers,
        the_fleet_leaves,
        an_external_graph_is_followed,
        its_master_is_started_anew,
        plans_are_reconciled,
        external=True,
    )


def test_the_watch_sees_work_that_does_not_breathe() -> None:
    def work(breathing: bool) -> None:
        for _ in range(20):
            until = time.thread_time() + BOUND / 4
            while time.thread_time() < until:
                pass
            if breathing:
                yield_to_data()

    async def main() -> None:
        work(breathing=True)
        await asyncio.sleep(0)
        assert len(Watched.holds) <= STRAYS
        for _ in range(STRAYS + 1):
            work(breathing=False)
            await asyncio.sleep(0)
        assert len(Watched.holds) > STRAYS

    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        runner.run(main())
