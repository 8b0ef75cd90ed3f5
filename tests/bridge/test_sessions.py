from __future__ import annotations

import asyncio
import errno
import re
import socket
from collections.abc import Callable, Coroutine, Iterable, Sequence
from types import SimpleNamespace
from typing import Any, cast

import psutil
import pytest

from rmpa.bridge import limits
from rmpa.bridge.graph_part import GraphPart
from rmpa.bridge.messages import Advertise, Source, TopicOffer, decode, encode
from rmpa.bridge.offers import PeerState
from rmpa.bridge.policy import PermissionGate
from rmpa.bridge.proxies import PeerProxies, ProxyNodes
from rmpa.bridge.sessions import AWAY_GRACE, Part, PeerSession, PeerSessions
from rmpa.bridge.topics.exports import Exports, LocalSource
from rmpa.bridge.topics.imports import Imports
from rmpa.config.settings import TrustSettings
from rmpa.core.identity import Guid, Identity
from rmpa.core.statistics import Counters
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.io.link import PeerLink
from rmpa.ros.core.external import Core
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node import listeners as shared_listener
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.trust.permissions import Permissions
from tests.bridge.io.virtual import VirtualLoop, run
from tests.bridge.recorder import context

# When a session begins, waits for its peer, goes on and ends.


GRACE = mesh_limits.SILENT_GRACE


class Keeper(Part):
    """Notes what it is told, and keeps something for each of these seconds."""

    def __init__(self, *outages: float) -> None:
        self.outages = outages
        self.told: list[str] = []

    def link_up(self, session: PeerSession) -> None:
        self.told.append(f"up {session.peer}")

    def link_down(self, session: PeerSession) -> None:
        self.told.append("down")

    def grace_over(self, session: PeerSession) -> bool:
        self.told.append("grace over")
        return bool(self.outages)

    def outlasted(self, session: PeerSession, seconds: float) -> float | None:
        return min((outage for outage in self.outages if outage > seconds), default=None)

    def gone(self, session: PeerSession) -> None:
        self.told.append("gone")


class Link:
    """What a session needs of a link to a run of the peer."""

    name = "far"
    resumed_at = 0.0

    def __init__(self, run_number: int, *, silent: bool, crashed: bool = False, host: str = "10.0.0.1") -> None:
        self.identity = Identity(Guid.of(host, 1000), bytes([run_number]) * 16, self.name)
        self.guid = self.identity.guid
        self.routes: dict[int, object] = {}
        self.silent = silent
        self.crashed = crashed
        self.closed = ""

    def close(self, reason: str) -> None:
        self.closed = reason


class Scene:
    """The sessions of one bridge with one part."""

    def __init__(self, *outages: float, before: Sequence[Part] = ()) -> None:
        self.part = Keeper(*outages)
        nodes = cast("Any", SimpleNamespace())
        self.gate = PermissionGate()
        self.sessions = PeerSessions([*before, self.part], nodes, self.gate)

    def link(self, run_number: int = 1, *, silent: bool = True, **more: Any) -> PeerLink:
        link = cast("PeerLink", Link(run_number, silent=silent, **more))
        self.sessions.link_up(link)
        return link

    def states(self) -> list[PeerState]:
        return [session.state for session in self.sessions]


def play(scene: Callable[[Scene], Coroutine[object, object, None]], *outages: float) -> list[str]:
    """Play a scene; return what the part was told."""
    loop, told = VirtualLoop(), []

    async def main() -> None:
        made = Scene(*outages)
        await scene(made)
        told.extend(made.part.told)
        await made.sessions.close()
        assert made.states() == []

    run(main(), loop)
    return told


class Broken(Part):
    """A part that fails whatever it is told."""

    def link_up(self, session: PeerSession) -> None:
        raise ZeroDivisionError

    link_down = gone = lane_lost = link_up

    def grace_over(self, session: PeerSession) -> bool:
        raise ZeroDivisionError


def test_a_run_at_another_address_goes_on_before_the_end_of_its_old_link_is_noticed() -> None:
    async def scene(made: Scene) -> None:
        old = made.link(silent=False)
        made.link(host="10.0.0.2")
        assert made.states() == [PeerState.LINKED]
        assert cast("Link", old).closed == "far has another address"
        made.sessions.link_down(old)
        assert made.states() == [PeerState.LINKED]

    assert play(scene, 30.0)[:3] == ["up 1", "down", "up 1"]


def test_a_part_that_fails_does_not_keep_the_next_ones_from_being_told(caplog: pytest.LogCaptureFixture) -> None:
    made: list[Scene] = []

    async def main() -> None:
        made.append(Scene(before=[Broken()]))
        made[0].sessions.link_down(made[0].link())
        await asyncio.sleep(GRACE * 2)
        await made[0].sessions.close()

    run(main(), VirtualLoop())
    assert made[0].part.told == ["up 1", "down", "grace over", "gone"]
    assert "Broken failed" in caplog.text


def test_another_module_that_claims_a_run_does_not_get_its_session() -> None:
    """Instances are no secret: each member hears them in beacons. In a secured mesh the name alone is proved."""

    async def scene(made: Scene) -> None:
        made.sessions.link_down(made.link())
        thief = Link(1, silent=True)
        thief.name = "thief"
        thief.identity = Identity(thief.guid, thief.identity.instance, "thief")
        made.sessions.link_up(cast("PeerLink", thief))
        assert [(session.peer, session.link.name) for session in made.sessions] == [(2, "thief")]

    assert play(scene) == ["up 1", "down", "gone", "up 2"]


@pytest.mark.parametrize("secured", [True, False])
def test_a_module_at_the_address_of_another_ends_its_session_in_a_plain_mesh_alone(*, secured: bool) -> None:
    """In a secured mesh the address is a claim, and the name is proved. In a plain one the module was renamed."""

    async def scene(made: Scene) -> None:
        made.gate.permissions = Permissions(TrustSettings()) if secured else None
        made.sessions.link_down(made.link())
        other = Link(2, silent=True)
        other.name = "other"
        other.identity = Identity(other.guid, other.identity.instance, "other")
        made.sessions.link_up(cast("PeerLink", other))
        assert [session.link.name for session in made.sessions] == (["far"] if secured else []) + ["other"]

    assert play(scene) == ["up 1", "down", *([] if secured else ["gone"]), "up 2"]


@pytest.mark.parametrize(
    ("silent", "crashed", "outages", "grace"),
    [
        (True, False, (), GRACE), (True, True, (), AWAY_GRACE), (False, False, (), 0.0),
        (True, False, (3.0, 9.0), 9.0),
    ],
)  # fmt: skip
def test_a_session_ends_with_its_grace_or_what_is_kept(
    silent: bool, crashed: bool, outages: tuple[float, ...], grace: float
) -> None:
    async def scene(made: Scene) -> None:
        link = made.link(silent=silent, crashed=crashed)
        made.sessions.link_down(link)
        if grace:
            await asyncio.sleep(grace - 0.1)
            assert made.states() == [PeerState.AWAY if outages else PeerState.SILENT]
            await asyncio.sleep(0.2)
        assert made.states() == []
        made.link()

    assert play(scene, *outages) == ["up 1", "down", "grace over", "gone", "up 2"]


# Proxies are there while something holds them.


class Nodes:
    """Makes nodes without sockets, or fails."""

    def __init__(self) -> None:
        self.problem: Exception | None = None
        self.open: list[str] = []

    def make(self, name: str) -> SlaveNode:
        async def start() -> None:
            await asyncio.sleep(0)
            if self.problem is not None:
                raise self.problem
            self.open.append(name)

        async def close() -> None:
            self.open.remove(name)

        return cast("SlaveNode", SimpleNamespace(name=name, start=start, close=close))


class World:
    """The proxies of one peer, and what happened at them."""

    def __init__(self) -> None:
        self.nodes = Nodes()
        self.proxies = PeerProxies("/rmpa/far", cast("Any", self.nodes))
        self.happened: list[str] = []

    def hold(self, node: str, key: str) -> None:
        self.proxies.hold(
            node,
            key,
            lambda proxy: self.happened.append(f"{key} at {proxy.name}"),
            lambda proxy: self.happened.append(f"{key} left"),
        )

    async def settled(self) -> list[str]:
        for _ in range(10):
            await asyncio.sleep(0)
        happened, self.happened = self.happened, []
        return happened


async def test_a_proxy_is_there_while_something_holds_it() -> None:
    world = World()
    world.hold("/n", "topic /a")
    world.hold("/n", "service /b")
    assert await world.settled() == ["topic /a at /rmpa/far/n", "service /b at /rmpa/far/n"]
    assert (len(world.proxies), world.nodes.open) == (1, ["/rmpa/far/n"])
    world.proxies.release("/n", "topic /a")
    assert await world.settled() == ["topic /a left"]
    assert world.proxies.get("/n") is not None
    world.proxies.release("/n", "service /b")
    assert await world.settled() == ["service /b left"]
    assert (world.proxies.get("/n"), world.nodes.open) == (None, [])
    await world.proxies.close()


async def test_a_proxy_that_cannot_be_made_is_tried_again() -> None:
    world = World()
    world.nodes.problem = OSError("no address is left")
    world.hold("/n", "topic /a")
    assert await world.settled() == []
    assert world.proxies.problems == {"/n": "no address is left"}
    world.nodes.problem = None
    world.proxies.reconcile()
    assert await world.settled() == ["topic /a at /rmpa/far/n"]
    assert world.proxies.problems == {}
    world.proxies.reconcile()
    assert await world.settled() == []
    await world.proxies.close()
    assert world.happened == ["topic /a left"]
    assert world.nodes.open == []


# How proxies listen: together where nodes of this machine alone reach them, and apart where that cannot be.


def core(host: str = "127.0.0.1", address: str = "127.0.0.1") -> Core:
    """As much of a core as proxies ask for."""
    return cast("Core", SimpleNamespace(uri="http://127.0.0.1:11311/", node_host=host, node_address=address))


def listening() -> int:
    """How many sockets of this process listen."""
    return sum(found.status == psutil.CONN_LISTEN for found in psutil.Process().net_connections("tcp"))


async def proxies(nodes: ProxyNodes, count: int = 3) -> list[str]:
    """Make some proxies, see that each answers, and close them; their hosts."""
    made = [nodes.make(f"/rmpa/base/n{number}") for number in range(count)]
    for proxy in made:
        await proxy.start()
        uri = f"http://127.0.0.1:{proxy.uri.rsplit(':')[-1]}" if "robot" in proxy.uri else proxy.uri
        assert (await call_api(uri, "getName", "/c")).value == proxy.name
    hosts = [proxy.uri.split("/")[2].split(":")[0] for proxy in made]
    for proxy in made:
        await proxy.close()
    return hosts


async def test_on_loopback_they_share_two_sockets() -> None:
    before = listening()
    nodes = ProxyNodes(core())
    await nodes.start()
    assert nodes.sockets(1000) == 2
    assert re.fullmatch(r"two for all, ports \d+ and \d+, and an address 127.a.b.c for each", nodes.listening)
    hosts = await proxies(nodes)
    assert len(set(hosts)) == 3
    assert "127.0.0.1" not in hosts
    assert listening() == before + 2
    await nodes.close()
    assert listening() == before


class Forbidden(socket.socket):
    """A socket of a process that may not choose the device."""

    def setsockopt(self, level: int, option: int, value: int | bytes) -> None:  # type: ignore[override]
        if option == socket.SO_BINDTODEVICE:
            raise PermissionError(errno.EPERM, "Operation not permitted")
        super().setsockopt(level, option, value)


async def _refuse(*_: object) -> None:
    raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")


@pytest.mark.parametrize(
    ("owner", "name", "double", "reason"),
    [
        (socket, "socket", Forbidden, "Operation not permitted"),
        (shared_listener.SharedListener, "_test_address", _refuse, "Connection refused"),
    ],
)
async def test_where_they_cannot_share_each_listens_by_itself_and_the_log_says_why(
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    owner: object,
    name: str,
    double: Any,
    reason: str,
) -> None:
    before = listening()
    nodes = ProxyNodes(core())
    with monkeypatch.context() as context, caplog.at_level("INFO"):
        context.setattr(owner, name, double)
        await nodes.start()
    why = f"two for each, at 127.0.0.1: all cannot share two ({reason})"
    assert nodes.listening == why
    assert [r.message for r in caplog.records] == [f"= proxies listen by sockets of their own, {why}"]
    assert await proxies(nodes) == ["127.0.0.1"] * 3
    assert listening() == before
    await nodes.close()


# How the part for topics or services works off what it has to do.


LOCAL = LocalSource("a/B", "http://x:1/")


class ShownImports(Imports):
    """Imports that note what they show."""

    def _publish(self, entry: Any) -> None:
        cast("Any", self._out).shown.append(entry.name)

    def _unpublish(self, entry: Any) -> None:
        """Nothing was made."""


class OnePart(GraphPart):
    """Topics of one linked peer, without a graph."""

    verb = "publishes"
    imports: Imports
    exports: Exports

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.shown: list[str] = []
        self.failing: set[str] = set()
        self.settled = 0
        link = SimpleNamespace(
            name="far", busy=False, remote_endpoint=("x", 1), send_control=lambda data: self.sent.append(decode(data))
        )
        link.abort = self.sent.append
        self.session = PeerSession(peer=1, name="far", link=cast("Any", link), proxies=cast("Any", None))
        shared = SimpleNamespace(counters=Counters(), rng=lambda: 0.5, context=context(), sessions={1: self.session})
        super().__init__(cast("Any", shared), cast("Any", Exports), cast("Any", ShownImports))
        self.imports.link_up(self.session)
        self.exports.link_up(self.session)

    def _look_at(self, name: str) -> None:
        if name in self.failing:
            raise RuntimeError("once")
        self.exports.put(Source(name, "/n"), LOCAL)

    def _names(self) -> Iterable[str]:
        return ()

    def _relayed(self, entry: Any, proxy: str) -> Any:
        raise NotImplementedError

    def _settled(self) -> None:
        self.settled += 1


async def until_settled(part: OnePart) -> None:
    while not part.settled:
        await asyncio.sleep(0)


async def test_names_are_looked_at_and_told_in_slices_and_a_failing_one_holds_up_no_other(
    caplog: pytest.LogCaptureFixture,
) -> None:
    part = OnePart()
    names = [f"/t{number}" for number in range(3 * limits.ADVERTISED_AT_ONCE)]
    part.failing = {names[3]}
    part.look(names)
    assert part._changed
    await until_settled(part)
    told = [offer.topic for message in part.sent for offer in message.added]
    assert told == [name for name in names if name != names[3]]
    assert "once" in caplog.text


async def test_advertisements_are_applied_in_order_and_too_many_bytes_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    part = OnePart()
    names = [f"/t{number}" for number in range(2 * limits.APPLIED_AT_ONCE)]
    for begin in range(0, len(names), 8):
        offers = tuple(TopicOffer(name, "/n", "a/B") for name in names[begin : begin + 8])
        part.advertised(part.session, encode(Advertise(offers)))
    assert not part.shown
    assert part.depends(part.session)
    monkeypatch.setattr(limits, "ADVERTISED_WAITING_BYTES", 0)
    part.advertised(part.session, encode(Advertise(removed=(Source("/t0", "/n"),))))
    assert part.shown == names[: len(part.shown)]
    assert len(part.shown) >= len(names) - 8
    await until_settled(part)
    assert part.shown == names
    assert part.imports.get(1, Source("/t0", "/n")) is None
    assert not part.depends(part.session)


async def test_a_peer_that_sends_nonsense_for_an_advertisement_loses_its_link() -> None:
    part = OnePart()
    part.advertised(part.session, b'{"op": "advertise", "added": 7}')
    await until_settled(part)
    assert "broke the protocol" in part.sent[-1]
