"""Every server of an agent, and a whole one, when the process has no file descriptors left."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
from http.client import HTTPConnection
from typing import TYPE_CHECKING

import psutil
import pytest

from rmpa.bridge import limits as bridge_limits
from rmpa.bridge import proxies as proxy_nodes
from rmpa.core.errors import StartError, UnreachableError
from rmpa.core.log import RefusalLog
from rmpa.observe.control_client import ControlClient
from rmpa.ros import limits as ros_limits
from rmpa.ros.core import liveness
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.listeners import SharedListener
from rmpa.ros.node.subscription import PublisherConnection
from rmpa.ros.wire.tcpros import encode_header, subscriber_header
from rmpa.runtime import accept as descriptors
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.accept import DESCRIPTORS
from tests.agent.test_agent import node, running, until
from tests.ros.documents import serialize_call
from tests.runtime.descriptors_left import descriptors_left

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings
    from rmpa.core.facts import FilesInfo, RouteInfo
    from rmpa.observe.snapshot import Snapshot

HARD = 64
NODES = 40


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short pauses, a log that has told nothing yet, and no thread that opens and closes a socket meanwhile."""
    monkeypatch.setattr(runtime_limits, "ACCEPT_PAUSE", 0.01)
    monkeypatch.setattr(runtime_limits, "DESCRIPTORS_TOLD", 0.05)
    monkeypatch.setattr(DESCRIPTORS, "_refusals", RefusalLog(logging.getLogger("rmpa"), DESCRIPTORS.counters))
    monkeypatch.setattr(liveness, "ask_listening_ports", lambda: None)


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What is logged of the shortage; that trust is off is said once by each agent, at its start."""
    texts = [r.getMessage() for r in caplog.records if r.levelno > logging.INFO or "descriptors" in r.getMessage()]
    return [text for text in texts if "trust is off" not in text]


@pytest.mark.usefixtures("fresh")
async def test_a_failed_dial_is_logged_and_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.ros.node.subscription.TCPROS_RETRY_FIRST", 0.01)
    monkeypatch.setattr("rmpa.ros.node.subscription.TCPROS_RETRY_MAX", 0.02)
    core = RosCore("127.0.0.1", 0)
    await core.start()
    lost: list[str] = []
    link = PublisherConnection("/t", core.uri, "/s", on_message=lambda _: None, on_lost=lost.append)
    try:
        with descriptors_left(0):
            with pytest.raises(UnreachableError, match="no file descriptor is left for a connection"):
                await call_api(core.uri, "getPid", "/test")
            link.start()
            await until(lambda: len(lost) >= 3)
            assert all("no file descriptor left" in reason for reason in lost)
            lost.clear()
        await until(lambda: any("requestTopic" in reason for reason in lost))  # a core has none: it was asked
    finally:
        link.close()
        await core.close()


@pytest.mark.usefixtures("fresh")
async def test_without_descriptors_no_node_is_taken_for_dead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_limits, "NODE_UNREACHABLE_AFTER", 0.0)
    core = RosCore("127.0.0.1", 0)
    await core.start()
    try:
        core.call("registerPublisher", "/alive", "/t", "std_msgs/String", core.uri)
        with descriptors_left(0):
            for _ in range(3):
                core.suspect("/alive")
                await until(lambda: not core.liveness._checks)
            assert not core.liveness.unreachable
        assert "/alive" in core.state().nodes
    finally:
        await core.close()


@pytest.mark.usefixtures("fresh")
async def test_a_topic_without_a_proxy_says_why_and_comes_later(
    settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """What stands for remote nodes, by sockets of its own, leaves room for those who connect to it."""
    monkeypatch.setattr(proxy_nodes, "is_loopback", lambda _: False)
    monkeypatch.setattr(bridge_limits, "RECONCILE_INTERVAL", 0.2)

    async def start(_: SharedListener) -> None:
        raise StartError("one listening socket for all proxies", "the test wants sockets for each")

    monkeypatch.setattr(SharedListener, "start", start)
    has_room = DESCRIPTORS.has_room
    async with running(settings("a"), settings("b")) as (a, b), node("talker", a) as talker:
        with (
            descriptors_left(2 * runtime_limits.DESCRIPTORS_RESERVED - 1) as first,
            monkeypatch.context() as shortage,
        ):
            # A connection from before that is closed meanwhile would leave room for a proxy.
            shortage.setattr(DESCRIPTORS, "has_room", lambda use, fd: has_room(use, max(fd, first)))
            for number in range(5):
                await talker.advertise(f"/t{number}", "std_msgs/String")
            await until(lambda: any(at.proxies.problems for at in b.bridge.sessions.linked()))
            await until(lambda: len(routes(b)) == 5)
            assert all("no file descriptor is left for its proxy" in route.problem for route in routes(b))
            (found,) = await b.why.answer({"peer": "a", "name": "/t1"})
            assert found.failed is not None
            assert found.failed.name == "graph"
            assert "LimitNOFILE=" in found.failed.remedy
            assert not b.core.publishers("/t1")
        await until(lambda: all(b.core.publishers(f"/t{number}") for number in range(5)))
        assert not any(route.problem for route in routes(b))
        await until(lambda: not DESCRIPTORS.problem)
    assert len(lines(caplog)) <= 2


@pytest.mark.usefixtures("fresh")
async def test_proxies_at_shared_sockets_need_no_descriptor(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, b), node("talker", a) as talker:
        with descriptors_left(2 * runtime_limits.DESCRIPTORS_RESERVED - 1):
            await talker.advertise("/t", "std_msgs/String")
            await until(lambda: b.core.publishers("/t"))
            assert not any(route.problem for route in routes(b))


def routes(agent: Agent) -> list[RouteInfo]:
    topics = [topic for topic in agent.snapshots.build().topics if topic.name.startswith("/t")]
    return [route for topic in topics for route in topic.routes if route.direction == "in"]


def test_the_soft_limit_is_raised_to_the_hard_one() -> None:
    program = (
        "import resource\nfrom rmpa.runtime.accept import raise_file_limit\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (100, 200))\n"
        "print(raise_file_limit(), resource.getrlimit(resource.RLIMIT_NOFILE))"
    )
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=30)
    assert told.stdout.split("\n")[0] == "200 (200, 200)"


def test_counting_does_not_need_a_descriptor() -> None:
    with descriptors_left(1):
        count = descriptors._count_open(DESCRIPTORS.limit)
        assert count <= DESCRIPTORS.limit
        extra = os.dup(0)
        assert descriptors._count_open(DESCRIPTORS.limit) <= DESCRIPTORS.limit
        os.close(extra)


# --- a whole agent ------------------------------------------------------------------------------------------------


class LowAgent:
    """``rmpa up`` with a hard limit of open files."""

    def __init__(self, place: Path, port: int) -> None:
        self.log = place / "log"
        self.environ = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "RMPA_", "XDG_"))}
        self.environ |= {"RMPA_RUNTIME_DIR": str(place), "HOME": str(place), "NO_COLOR": "1"}
        options = ["--name", "low", "--domain", "191", "--multicast", "off", "--core-port", str(port)]
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                ["/bin/sh", "-c", f'ulimit -n {HARD}; exec "$@"', "sh", *self.command("up", *options)],
                stderr=log,
                stdout=log,
                env=self.environ,
                cwd=place,
            )
        self.socket = place / "low.sock"

    @staticmethod
    def command(*arguments: str) -> list[str]:
        return [sys.executable, "-m", "rmpa.cli.main", *arguments]

    def snapshot(self) -> Snapshot:
        with ControlClient(self.socket) as client:
            return client.snapshot()

    def files(self) -> FilesInfo:
        files = self.snapshot().agent.files
        assert files is not None
        return files

    def doctor(self) -> str:
        done = subprocess.run(
            self.command("doctor"), capture_output=True, text=True, env=self.environ, timeout=60, check=False
        )
        return done.stdout

    def cpu(self) -> float:
        times = psutil.Process(self.process.pid).cpu_times()
        return times.user + times.system

    def close(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(30)


@pytest.fixture
def low(tmp_path: Path) -> Iterator[LowAgent]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    agent = LowAgent(tmp_path, port)
    yield agent
    agent.close()


def wait(condition: Callable[[], object]) -> None:
    ended = threading.Event()
    for _ in range(600):
        with contextlib.suppress(UnreachableError, OSError):
            if condition():
                return
        ended.wait(0.05)
    raise TimeoutError


def subscribe(uri: str, count: int) -> list[socket.socket]:
    """Connections of subscribers of /rosout_agg; the kernel takes them, whether the agent can accept them or not."""
    slave = asyncio.run(call_api(uri, "lookupNode", "/test", "/rosout")).value
    reply = asyncio.run(call_api(str(slave), "requestTopic", "/test", "/rosout_agg", [["TCPROS"]])).value
    assert isinstance(reply, list)
    address = (str(reply[1]), int(str(reply[2])))
    made = [socket.create_connection(address) for _ in range(count)]
    for number, sock in enumerate(made):
        sock.sendall(encode_header(subscriber_header("/rosout_agg", f"/s{number}")))
    return made


def register(uri: str, number: int) -> HTTPConnection:
    """Register a publisher as rospy does, whose connection to the core stays open."""
    client = HTTPConnection("127.0.0.1", int(uri.rstrip("/").rpartition(":")[2]), timeout=30)
    client.request("POST", "/", serialize_call("registerPublisher", [f"/n{number}", f"/t{number}", "*", uri]))
    assert client.getresponse().read().startswith(b"<?xml")
    return client


@pytest.mark.timeout(120)
def test_an_agent_without_descriptors_is_quiet_answers_and_recovers(low: LowAgent) -> None:
    """Before: 100 % CPU, a line of log for each place of each backlog in each round, and a core that is silent."""
    wait(lambda: "ROS_MASTER_URI=" in low.log.read_text())
    assert resource.prlimit(low.process.pid, resource.RLIMIT_NOFILE) == (HARD, HARD)
    uri = low.snapshot().agent.core_uri
    cpu, log = low.cpu(), low.log.stat().st_size
    open_ones: list[socket.socket | HTTPConnection] = [*subscribe(uri, HARD)]
    try:
        wait(lambda: low.files().problem)
        open_ones += [register(uri, number) for number in range(NODES)]
        listed = asyncio.run(call_api(uri, "getPublishedTopics", "/test", "")).value
        assert isinstance(listed, list)
        assert {f"/t{number}" for number in range(NODES)} <= {topic for topic, _ in listed}
        shown = low.snapshot()
        assert low.files().limit == HARD
        assert low.files().open < HARD
        assert "LimitNOFILE=" in low.files().problem
        assert low.files().problem in shown.notes
        assert shown.counters["http.evicted"] > 0
        doctor = low.doctor()
        assert "fail     files low" in doctor
        assert f"prlimit --pid {low.process.pid}" in doctor
        assert low.cpu() - cpu < 3.0  # of some 8 s, for 40 registrations and a doctor
        assert low.log.stat().st_size - log < 16_384  # a line for each registration
    finally:
        for one in open_ones:
            one.close()
    wait(lambda: not low.files().problem)
    (again,) = subscribe(uri, 1)
    again.settimeout(10)
    assert again.recv(4)
    again.close()
    text = low.log.read_text()
    assert 1 <= text.count("no file descriptors left") <= 3  # for data, the core, the links
    assert "Traceback" not in text
