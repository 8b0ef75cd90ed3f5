"""Real nodes and stock tools against nodes that share two listening sockets, each at an address of its own."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path

import pytest

from lab.bed.agents import Agent
from lab.bed.namespaces import Host, Lab
from lab.bed.processes import DEADLINE, eventually, run
from rmpa.core.statistics import Counters
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.listeners import SharedListener
from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import frame_message
from tests.interop.conftest import AgentFactory, ShellFactory
from tests.interop.modules import flows
from tests.interop.nodes.payload import Pattern
from tests.interop.ros import PYTHON, Ros

BYTES = "std_msgs/UInt8MultiArray"
HEAD = bytes(8)  # a layout without dimensions, offset 0
CONTROL = ("127.9.9.9", 5555)
LISTEN = """
import socket
with socket.create_server(("127.9.9.9", 5555)) as server:
    print("up", flush=True)
    while True:
        server.accept()[0].close()
"""
DIAL = """
import json, socket, sys
answers = []
for host, port in json.loads(sys.argv[1]):
    try:
        socket.create_connection((host, port), 2).close()
        answers.append("connected")
    except OSError as error:
        answers.append(type(error).__name__)
print(json.dumps(answers))
"""


class Proxy:
    """A node at the listener that publishes /chatter."""

    def __init__(self, core: RosCore, listener: SharedListener) -> None:
        self._core = core
        self.node = SlaveNode("/proxy", "127.0.0.1", core.uri, listener=listener)
        self.publication = Publication("/chatter", "/proxy", MessageType(BYTES).describe())
        self.node.add_publication(self.publication)

    async def appear(self, subscribers: int) -> None:
        """Register in the graph, and wait for subscribers."""
        await self.node.start()
        self._core.call("registerPublisher", "/proxy", "/chatter", BYTES, self.node.uri)
        async with asyncio.timeout(DEADLINE):
            while self.publication.subscribers < subscribers:
                await asyncio.sleep(0.005)

    def say(self, first: int, last: int) -> None:
        """Publish these numbers."""
        for sequence in range(first, last + 1):
            payload = Pattern(64).payload(1, sequence)
            self.publication.publish_framed(frame_message(HEAD + len(payload).to_bytes(4, "little") + payload))


@pytest.mark.ros
@pytest.mark.trap(14, 21)
async def test_real_subscribers_follow_a_node_to_its_next_address(shell: ShellFactory) -> None:
    core, counters = RosCore("127.0.0.1", 0), Counters()
    await core.start()
    listener = SharedListener(core.uri, counters=counters)
    await listener.start()
    ros = shell(port=core.port)
    # The strictest setting: with it rospy and roscpp dial no address that they do not take for this machine's.
    del ros.env["ROS_IP"]
    ros.env["ROS_HOSTNAME"] = "localhost"
    heard = [ros.node(library, "listener", name=library, count=30) for library in ("rospy", "roscpp")]
    first = Proxy(core, listener)
    await first.appear(2)
    first.say(1, 10)
    for process in heard:
        await asyncio.to_thread(process.wait_event, "report", timeout=DEADLINE, where=lambda e: e["count"] == 10)
    # It goes and the master still lists it: what the libraries do then must not be worse than at a closed port.
    await first.node.close()
    core.call("registerPublisher", "/former", "/chatter", BYTES, first.node.uri)
    # roscpp backs off from 0.1 s on: five attempts, and fewer where it misses the end of one, as at a closed port.
    await asyncio.sleep(4.0)  # nothing can be waited for
    assert counters["address.unknown.tcpros"] <= 10, "a reset is to roscpp what a refused connect is"
    assert counters["address.unknown.xmlrpc"] <= 4, "rospy takes no answer for 'try again'"
    core.call("unregisterPublisher", "/former", "/chatter", first.node.uri)
    core.call("unregisterPublisher", "/proxy", "/chatter", first.node.uri)
    second = Proxy(core, listener)
    await second.appear(2)
    assert second.node.uri != first.node.uri
    second.say(11, 30)
    for process in heard:
        report = await asyncio.to_thread(process.wait_event, "done", timeout=DEADLINE)
        assert (report["bad"], report["gaps"], report["doubled"], report["last"]) == (0, 0, 0, 30)
    await second.node.close()
    await listener.close()
    await core.close()


class Unprivileged(Agent):
    """An agent without a single capability, as a user's or a hardened unit's."""

    @property
    def argv(self) -> list[str]:
        """The command line on its host."""
        inside = super().argv
        enter = self.host.command([])
        return [*enter, "setpriv", "--inh-caps=-all", "--bounding-set=-all", *inside[len(enter) :]]


def dial(host: Host, *addresses: tuple[str, int]) -> list[str]:
    """What becomes of a connection from a host to each address."""
    answers: list[str] = json.loads(run(host.command([PYTHON, "-c", DIAL, json.dumps(addresses)])))
    return answers


def listening(agent: Agent) -> int:
    """How many TCP sockets of an agent listen."""
    return run(agent.host.command(["ss", "-tlnpH"])).count(f"pid={agent.pid},")


def addresses(ros: Ros, *nodes: str) -> list[tuple[str, int]]:
    """Where nodes are, by ``rosnode list -a``, once all are there."""

    def found() -> dict[str, tuple[str, int]]:
        rows = re.findall(r"http://([0-9.]+):(\d+)/\s+(\S+)", ros.tool("rosnode", "list", "-a"))
        there = {name: (host, int(port)) for host, port, name in rows}
        return there if there.keys() >= set(nodes) else {}

    there = eventually(found, what=f"{nodes} at {ros.host.name}")
    return [there[node] for node in nodes]


@pytest.mark.ros
@pytest.mark.netns
@pytest.mark.timeout(120)
def test_proxies_share_two_local_sockets(lab: Lab, agent: AgentFactory, shell: ShellFactory, tmp_path: Path) -> None:
    a, b, c = lab.hosts("a", "b", "c")
    c.ip("address", "replace", "127.0.0.1/32", "dev", "lo")
    c.ip("address", "del", "127.0.0.1/8", "dev", "lo")
    agent(a, name="a")
    at_c = agent(c, name="c")
    with Unprivileged(b, tmp_path, name="b") as at_b:
        at_b.start()
        at_b.wait_ready()
        for one in (at_b, at_c):
            one.wait_peer("a")
        before_b, before_c = listening(at_b), listening(at_c)
        # Both libraries publish at a, and both hear them at b, and at c.
        heard = []
        for library, other in (("rospy", "roscpp"), ("roscpp", "rospy")):
            shell(a).node(library, "talker", name=library, topic=f"/{library}", rate=100)
            heard += [shell(host).node(other, "listener", topic=f"/{library}") for host in (b, c)]
        for process in heard:
            report = flows(process, 30)
            assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
        nodes = ("/rmpa/a/rospy", "/rmpa/a/roscpp")
        # b: without a right, and without a further socket.
        (first, port), (second, same) = addresses(shell(b), *nodes)
        assert port == same
        assert first != second
        assert {first.split(".")[0], second.split(".")[0]} == {"127"}
        # The two talkers, and the listeners of the other module, of which nothing crosses.
        shared = "4 nodes of peers, 2 listening sockets: two for all"
        eventually(lambda: shared in at_b.rmpa("doctor")[1], what=shared)
        assert listening(at_b) == before_b
        # c: lo has no such addresses there, so each proxy has sockets of its own.
        assert [host for host, _ in addresses(shell(c), *nodes)] == ["127.0.0.1"] * 2
        own = "4 nodes of peers, 8 listening sockets: two for each, at 127.0.0.1"
        eventually(lambda: own in at_c.rmpa("doctor")[1], what=own)
        assert listening(at_c) == before_c + 8
        # From a, with all that the kernel has against it switched off: a socket at 127.9.9.9 is reached, no proxy.
        for host in (a, b):
            for name in ("all", "eth0"):
                run(host.command(["sysctl", "-qw", f"net.ipv4.conf.{name}.route_localnet=1"]))
                run(host.command(["sysctl", "-qw", f"net.ipv4.conf.{name}.rp_filter=0"]))
        for address in (first, CONTROL[0]):
            a.ip("route", "add", f"{address}/32", "via", b.address, "src", a.address, "table", "local")
        shell(b).start(PYTHON, "-c", LISTEN).wait_for("up")
        assert dial(a, CONTROL, (first, port), (b.address, port)) == ["connected"] + ["ConnectionRefusedError"] * 2
        assert dial(b, CONTROL, (first, port)) == ["connected"] * 2
        assert at_b.terminate() == 0
