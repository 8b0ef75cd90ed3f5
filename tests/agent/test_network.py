"""An agent and its network: its core, its address, twins (docs/guides/names.md), and peers out of reach."""

from __future__ import annotations

import asyncio
import errno
import socket
from contextlib import asynccontextmanager
from dataclasses import replace
from ipaddress import IPv4Address, IPv4Interface
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.agent import agent
from rmpa.agent import agent as core_choice
from rmpa.agent.agent import JOIN_RETRY, Agent, Network, is_displaced
from rmpa.bridge import limits
from rmpa.bridge import limits as bridge_limits
from rmpa.config.peer_rules import PeerRule
from rmpa.config.settings import Settings
from rmpa.core.errors import ConfigError, StartError, UnreachableError
from rmpa.discovery.network import Interface
from rmpa.ros import limits as ros_limits
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.core.external import ExternalCore
from rmpa.ros.http import rpc as client
from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import TopicDescription
from tests.agent.test_agent import Sink, node, running, until
from tests.bridge.io.virtual import VirtualLoop, run

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.observe.why.diagnosis import Diagnosis
    from rmpa.ros.node.endpoints import Publisher

LO = Interface("lo", (IPv4Interface("127.0.0.1/8"),), 1, up=True, multicast=False, loopback=True)


def card(name: str, *addresses: str, up: bool = True) -> Interface:
    found = tuple(map(IPv4Interface, addresses))
    return Interface(name, found, int(name[-1]) + 2, up=up, multicast=True, loopback=False)


@pytest.mark.parametrize(
    ("ours", "there", "displaced"),
    [
        ("127.0.0.1", [LO], False),
        ("127.0.0.1", [LO, card("eth0", "10.0.0.1", up=False)], False),
        ("127.0.0.1", [LO, card("eth0", "10.0.0.1")], True),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.1")], False),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.1", up=False)], False),
        ("10.0.0.1", [LO, card("eth0")], False),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.2")], True),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.2", "10.0.0.1")], False),
        ("10.0.0.1", [LO, card("eth0", "10.0.0.1", up=False), card("eth1", "10.1.0.1")], False),
        ("10.0.0.1", [LO, card("eth0"), card("eth1", "10.1.0.1")], True),
    ],
)
def test_only_an_address_that_was_replaced_displaces_us(ours: str, there: list[Interface], displaced: bool) -> None:
    assert is_displaced(IPv4Address(ours), tuple(there), ()) is displaced


def test_interfaces_that_the_user_did_not_choose_do_not_count() -> None:
    there = (LO, card("eth0", "10.0.0.1"), card("eth1", "10.1.0.1"))
    assert not is_displaced(IPv4Address("127.0.0.1"), there, ("lo",))
    assert is_displaced(IPv4Address("10.0.0.1"), there, ("eth1",))


class Endpoint:
    """A place in the network; those that fail cannot be started, or not even be made."""

    failing = 0
    unlisted = 0

    def __init__(self, network: Network, port: int) -> None:
        if Endpoint.unlisted:
            Endpoint.unlisted -= 1
            raise OSError(errno.EMFILE, "the interfaces cannot be listed")
        self.port = port
        self.displaced = network.move
        self.started = self.closed = self.moves = False
        made.append(self)

    async def start(self) -> None:
        if Endpoint.failing:
            Endpoint.failing -= 1
            raise (
                OSError(errno.EMFILE, "too many open files") if Endpoint.failing else StartError("mesh port", "taken")
            )
        await asyncio.sleep(1.0)
        self.started = True

    async def close(self, *, moves: bool = False) -> None:
        self.moves = moves
        await asyncio.sleep(1.0)
        self.closed = True


made: list[Endpoint] = []


@pytest.fixture
def joined(monkeypatch: pytest.MonkeyPatch) -> Callable[[], Network]:
    made.clear()
    monkeypatch.setattr(agent, "NetworkEndpoint", Endpoint)
    monkeypatch.setattr(Endpoint, "failing", 0)
    monkeypatch.setattr(Endpoint, "unlisted", 0)
    return lambda: Network(Settings(), cast("Any", None), trust=cast("Any", SimpleNamespace()))


def test_a_move_goes_on_until_the_agent_is_in_the_network_again(joined: Callable[[], Network]) -> None:
    async def main() -> None:
        sut = joined()
        await sut.start()
        Endpoint.failing, Endpoint.unlisted = 2, 1
        made[0].displaced()
        await asyncio.sleep(3 * JOIN_RETRY + 10.0)
        assert [one.closed for one in made] == [True, True, True, False]
        assert made[0].moves
        assert sut.endpoint is not None
        assert made[-1].started
        await sut.close()

    run(main(), VirtualLoop())


@pytest.mark.parametrize("after", [0.5, 1.5])
def test_an_agent_that_ends_while_it_moves_leaves_nothing_behind(joined: Callable[[], Network], after: float) -> None:
    async def main() -> None:
        sut = joined()
        await sut.start()
        made[0].displaced()
        await asyncio.sleep(after)  # while it leaves, or while it joins
        await sut.close()
        assert all(one.closed for one in made)
        assert sut.endpoint is None

    run(main(), VirtualLoop())


EVERYWHERE = "0.0.0.0"
HERE = "127.0.0.1"


@pytest.fixture(autouse=True)
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """One with an address of its own, and no variables of ROS."""
    for variable in ("ROS_IP", "ROS_HOSTNAME"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setattr(core_choice, "local_addresses", lambda: ["10.0.0.7", HERE])


def test_the_embedded_core_is_the_default() -> None:
    made = core_choice.make_core(Settings(name="a"))
    assert isinstance(made, RosCore)
    assert (made.node_host, made.node_address) == (HERE, HERE)


@pytest.mark.parametrize(
    ("master", "environ", "listens", "told"),
    [
        ("", {}, HERE, HERE),
        ("http://localhost:11311/", {}, HERE, HERE),
        ("http://10.0.0.9:11311/", {}, EVERYWHERE, "10.0.0.7"),
        ("http://OURS:11311/", {}, EVERYWHERE, "OURS"),
        ("http://localhost:11311/", {"ROS_IP": "10.0.0.7"}, EVERYWHERE, "10.0.0.7"),
        ("http://10.0.0.9:11311/", {"ROS_HOSTNAME": "robot", "ROS_IP": "10.0.0.7"}, EVERYWHERE, "robot"),
        ("http://10.0.0.9:11311/", {"ROS_IP": HERE}, HERE, HERE),
    ],
)
def test_proxies_are_where_other_nodes_of_that_graph_would_be(
    monkeypatch: pytest.MonkeyPatch, master: str, environ: dict[str, str], listens: str, told: str
) -> None:
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    ours = socket.gethostname()
    made = core_choice.make_core(Settings(name="a", core_mode="external", core_master=master.replace("OURS", ours)))
    assert isinstance(made, ExternalCore)
    assert made.uri == (master.replace("OURS", ours) or "http://localhost:11311")
    assert (made.node_host, made.node_address) == (listens, told.replace("OURS", ours))


def test_a_variable_that_cannot_be_used_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_IP", "http://10.0.0.7")
    with pytest.raises(ConfigError, match="ROS_IP"):
        core_choice.make_core(Settings(name="a", core_mode="external"))


KIND = "std_msgs/String"


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look for twins more often."""
    monkeypatch.setattr(limits, "RECONCILE_INTERVAL", 0.1)


@asynccontextmanager
async def robot(agent: Agent) -> AsyncIterator[tuple[Publisher, Sink]]:
    """The nodes of one robot; its command, and what its wheels heard."""
    heard = Sink()
    async with node("base", agent) as base, node("stick", agent) as stick:
        for topic in ("/odom", "/scan", "/diagnostics"):
            await base.advertise(topic, KIND)
        await base.subscribe("/cmd_vel", KIND, heard)
        yield await stick.advertise("/cmd_vel", KIND), heard


def problems(agent: Agent) -> list[str]:
    return [text for peer in agent.snapshots.build().peers for text in peer.conflicts]


async def test_identical_robots_are_told_and_parted(
    settings: Callable[..., Settings], caplog: pytest.LogCaptureFixture
) -> None:
    async with (
        running(settings("r1"), settings("r2")) as (r1, r2),
        robot(r1) as (drive, own),
        robot(r2) as (_, other),
    ):
        await until(lambda: problems(r1) and problems(r2))
        for agent, peer in ((r1, "r2"), (r2, "r1")):
            (text,) = problems(agent)
            assert "offer and take the same names as ours (/cmd_vel, /odom, /scan)" in text
            assert "rmpa up --prefix-peers" in text
            assert f'name = "{peer}" and prefix = "/{{peer}}"' in text
        await until(lambda: drive.subscribers == 2)
        drive.publish(drive.make({"data": "both"}))
        await until(lambda: own.heard and other.heard)
        told = [record.getMessage() for record in caplog.records if "offer and take" in record.getMessage()]
        assert sorted(text[:4] for text in told) == ["! r1", "! r2"], "once at each end"
        for agent, name in ((r1, "r1"), (r2, "r2")):
            agent.apply_settings(replace(settings(name), prefix_peers=True))
        await until(lambda: not problems(r1) and not problems(r2) and drive.subscribers == 1)
        drive.publish(drive.make({"data": "mine"}))
        await until(lambda: own.heard == ["both", "mine"])
        assert other.heard == ["both"]
        assert "/r1/cmd_vel" in r2.core.state().publishers


async def test_a_peer_about_which_the_user_has_decided_is_no_twin(settings: Callable[..., Settings]) -> None:
    decided = replace(settings("r1"), peers=(PeerRule("r2"),))
    async with running(decided, settings("r2")) as (r1, r2), robot(r1), robot(r2):
        await until(lambda: problems(r2))
        assert not problems(r1)


NAME = "nosuchhost.invalid"
MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


class Resolver:
    """A name server that does not know the node's machine, until it does."""

    def __init__(self) -> None:
        self.knows = False
        self.asked = 0

    async def __call__(self, host: str, port: int) -> list[tuple[str, int]]:
        if host != NAME:
            return [(host, port)]
        self.asked += 1
        if not self.knows:
            raise UnreachableError("machine", host, "the name does not resolve here (as asked)")
        return [("127.0.0.1", port)]


@pytest.fixture
def resolver(monkeypatch: pytest.MonkeyPatch) -> Resolver:
    made = Resolver()
    monkeypatch.setattr(client, "_resolve", made)
    monkeypatch.setattr(ros_limits, "NODE_CHECK_INTERVAL", 0.05)
    monkeypatch.setattr(ros_limits, "NODE_UNREACHABLE_AFTER", 0.3)
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.1)
    return made


@asynccontextmanager
async def registered_by_name(agent: Agent) -> AsyncIterator[None]:
    """A node that publishes and serves, and tells the core a host name that nobody knows."""
    cam = SlaveNode("/cam", "127.0.0.1", agent.core.uri, advertised_host=NAME)
    await cam.start()
    cam.add_publication(Publication("/image", "/cam", TopicDescription("std_msgs/String", MD5, "string data\n")))
    call, shoot = agent.core.call, cam.service_uri
    call("registerPublisher", "/cam", "/image", "std_msgs/String", cam.uri)
    call("registerService", "/cam", "/shoot", shoot, cam.uri)
    try:
        yield
    finally:
        call("unregisterPublisher", "/cam", "/image", cam.uri)
        call("unregisterService", "/cam", "/shoot", shoot)
        await cam.close()


async def why(agent: Agent, peer: str, name: str) -> Diagnosis:
    (found,) = await agent.why.answer({"name": name, "peer": peer})
    return found


async def test_it_is_told_withdrawn_and_back_when_it_can_be_reached(
    settings: Callable[..., Settings], resolver: Resolver
) -> None:
    async with running(settings("a"), settings("b")) as (a, b), registered_by_name(a):
        await until(lambda: "/cam" in a.core.unreachable())
        (info,) = a.snapshots.build().unreachable
        assert str(info).startswith(f"/cam cannot be reached at http://{NAME}:")
        await until(lambda: a.core.unreachable()["/cam"].withdrawn)
        await until(lambda: "/image" not in b.core.state().publishers and "/shoot" not in b.core.state().services)
        assert "/image" in a.core.state().publishers, "the registration stays, as at roscore"

        at = a.core.unreachable()["/cam"].api
        text = (
            f"/cam cannot be reached at {at} (the name does not resolve here (as asked)), so peers are not offered it"
        )
        (topic,) = [topic for topic in a.snapshots.build().topics if topic.name == "/image"]
        assert topic.unreachable == (text,)
        failed = (await why(b, "a", "/image")).failed
        assert failed is not None
        assert failed.name == "reachable"
        assert "/cam is registered on a, but cannot be reached at http://nosuchhost.invalid:" in failed.text
        assert "ROS_IP=127.0.0.1" in failed.remedy
        failed = (await why(b, "a", "/shoot")).failed
        assert failed is not None
        assert failed.name == "server"
        assert "cannot be reached at http://nosuchhost.invalid:" in failed.text

        resolver.knows = True
        await until(lambda: "/image" in b.core.state().publishers and "/shoot" in b.core.state().services)
        assert not a.core.unreachable()
        assert (await why(b, "a", "/image")).unasked, "all is well but for a reader"


async def test_what_flows_is_not_withdrawn(settings: Callable[..., Settings], resolver: Resolver) -> None:
    """Its network may be gone for new connections, and still carry those that stand."""
    resolver.knows = True
    async with running(settings("a"), settings("b")) as (a, b), registered_by_name(a), node("hearer", b) as hearer:
        subscriber = await hearer.subscribe("/image", "std_msgs/String")
        await until(lambda: subscriber.publishers)
        await until(lambda: any(flow.flowing for flow in a.bridge.topics.exports.flows.values()))
        resolver.knows = False
        await until(lambda: a.core.unreachable() and a.core.unreachable()["/cam"].withdrawn)
        before = resolver.asked
        await until(lambda: resolver.asked > before + 5)
        assert "/image" in b.core.state().publishers
        assert subscriber.publishers == 1
        await subscriber.close()
        await until(lambda: "/image" not in b.core.state().publishers)
