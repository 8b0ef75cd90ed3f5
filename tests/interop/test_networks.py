"""Networks behind routers, paths that change (docs/guides/networks.md), and packets that are too large."""

from __future__ import annotations

import random
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final

import pytest

from lab.bed.namespaces import Host, Lab
from lab.bed.processes import Event, eventually
from lab.bed.ros import PYTHON
from rmpa.observe.control_client import ControlClient
from tests.interop.conftest import AgentFactory, ShellFactory
from tests.interop.modules import Module, flows
from tests.interop.ros import lacks

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(900)]


def full_mesh(*modules: Module) -> None:
    """Wait until each of these is linked with all others."""
    for module in modules:
        names = {other.name for other in modules if other is not module}
        eventually(partial(all_linked, module, names), what=f"{module.name} linked with {names}", every=0.2)


def all_linked(module: Module, names: set[str]) -> bool:
    """Whether a module has a link to each of these."""
    return names <= linked(module)


def linked(module: Module) -> set[str]:
    """The peers that a module has live links to; asked by its socket, for many looks are needed."""
    with ControlClient(module.agent.sockets()[0]) as client:
        return {peer.name for peer in client.snapshot().peers if peer.state == "linked"}


def test_one_seed_and_gossip_join_two_networks_behind_a_router(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """Only ``a`` knows one address of the other side; when that one is gone, new agents are still found by all."""
    router = lab.router(0, 1)
    hosts = {name: lab.host(name, network) for name, network in (("a", 0), ("b", 0), ("c", 1), ("d", 1))}
    for host in hosts.values():
        lab.route(host, router)
    flags = {"a": ["--seed", f"{hosts['c'].address}:45000"], "c": ["--port", "45000"]}
    a, b, c, d = (
        Module(host, agent(host, name=name, flags=flags.get(name, [])), shell(host)) for name, host in hosts.items()
    )
    full_mesh(a, b, c, d)
    heard = d.ros.roscpp("listener", topic="/chatter")
    b.ros.roscpp("talker", "__name:=talker", topic="/chatter", rate=100)
    flows(heard)
    assert "/rmpa/b/talker" in d.ros.tool("rosnode", "list")

    c.agent.kill()
    b.agent.restart()
    full_mesh(a, b, d)
    steady = d.ros.roscpp("listener", "__name:=steady", topic="/steady")
    a.ros.roscpp("talker", "__name:=steady_talker", topic="/steady", rate=100)
    flows(steady)
    c.agent.restart()
    full_mesh(a, b, c, d)
    report = flows(steady)
    assert (report["gaps"], report["doubled"]) == (0, 0)


def test_a_peer_is_reached_by_its_remaining_cable(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """Two modules share two networks; each cable in turn is out, and reliable topics lose nothing."""
    config = '[[contract]]\ntopics = ["/chatter"]\nreliability = "reliable"\ndepth = 2000\n'
    hosts = [lab.host(name, 0, 1) for name in ("a", "b")]
    a, b = (Module(host, agent(host, name=host.name, config=config), shell(host)) for host in hosts)
    full_mesh(a, b)
    heard = b.ros.roscpp("listener", topic="/chatter")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    flows(heard)
    for cable in (0, 1, 0):
        for module in (a, b):
            module.host.cut(cable)
        began = time.monotonic()
        report = flows(heard, 50)
        assert time.monotonic() - began < 10.0
        assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
        for module in (a, b):
            module.host.restore(cable)
    assert "/chatter" in b.topics()


def test_a_module_is_found_by_its_second_cable(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """The GUID of each is of a network that the other cannot reach."""
    hosts = [lab.host("a", 2, 0), lab.host("b", 3, 0)]
    a, b = (Module(host, agent(host, name=host.name), shell(host)) for host in hosts)
    full_mesh(a, b)
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    flows(b.ros.roscpp("listener", topic="/chatter"))


def test_gossip_across_a_router_says_where_peers_are_heard(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    """The first cables of two modules, whose addresses are in their GUIDs, lead to networks of their own."""
    router = lab.router(0, 1)
    hosts = [lab.host("a", 2, 0), lab.host("b", 1), lab.host("c", 3, 1)]
    for host in hosts:
        lab.route(host, router)
    flags = {"a": ["--seed", f"{hosts[1].address}:45000"], "b": ["--port", "45000"]}
    full_mesh(*(Module(h, agent(h, name=h.name, flags=flags.get(h.name, [])), shell(h)) for h in hosts))


RELAY = "[relay]\nenabled = true\n"


def test_relays_join_two_networks_without_a_router(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """Two relays stand between two networks; one of them is chosen, and the other takes over when it is gone."""
    hosts = [lab.host("a", 0), lab.host("b", 1), lab.host("r", 0, 1), lab.host("s", 0, 1)]
    a, b, r, s = (
        Module(host, agent(host, name=host.name, config=RELAY if host.name in "rs" else ""), shell(host))
        for host in hosts
    )
    for relay in (r, s):
        full_mesh(a, relay)
        full_mesh(b, relay)
    heard = {kind: b.ros.node(kind, "listener", f"__name:={kind}", topic="/chatter") for kind in ("rospy", "roscpp")}
    a.ros.roscpp("talker", "__name:=talker", topic="/chatter", rate=100, latch=True)
    b.ros.roscpp("talker", "__name:=back", topic="/back", rate=100)
    for listener in heard.values():
        report = flows(listener)
        assert (report["bad"], report["doubled"]) == (0, 0), "one relay alone passes it on"

    # Each sees the other as if it were linked, under the other's own name; and nothing comes back.
    assert "/rmpa/a/talker" in b.ros.tool("rosnode", "list").split()
    assert "/rmpa/b/back" in a.ros.tool("rosnode", "list").split()
    assert not [node for node in a.ros.tool("rosnode", "list").split() if node.startswith("/rmpa/a/")]
    for relay in (r, s):
        nodes = relay.ros.tool("rosnode", "list").split()
        assert len(nodes) == len(set(nodes))
        assert {"/rmpa/a/talker", "/rmpa/b/back"} <= set(nodes)
        assert not [node for node in nodes if node.startswith(("/rmpa/r/", "/rmpa/s/"))]
    info = b.agent.peers()["a"]
    assert (info["state"], info["via"] in {"r", "s"}) == ("relayed", True)
    chosen, other = (r, s) if info["via"] == "r" else (s, r)

    chosen.agent.kill()
    for listener in heard.values():
        report = flows(listener)
        assert (report["bad"], report["doubled"]) == (0, 0)
    eventually(lambda: b.agent.peers()["a"]["via"] == other.name, what="the other relay")
    other.agent.terminate()
    eventually(lambda: "a" not in b.agent.peers(), what="no way to a")
    b.wait_no_topic("/rmpa/a/talker", 1.0)
    assert "/rmpa/a/talker" not in b.ros.tool("rosnode", "list")


def test_services_and_actions_go_by_a_relay_too(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    hosts = [lab.host("a", 0), lab.host("b", 1), lab.host("r", 0, 1)]
    a, b, r = (Module(h, agent(h, name=h.name, config=RELAY if h.name == "r" else ""), shell(h)) for h in hosts)
    full_mesh(a, r)
    full_mesh(b, r)
    a.ros.rospy("worker", service="/work", name="worker").wait_event("up")
    caller = b.ros.rospy("caller", service="/work", wait=True, commands=True)
    caller.wait_event("there")
    for line, ok, errors in (
        ("echo 0 200000 3 once", 3, []),
        ("echo 0 64 20 persistent", 20, []),
        ("fail 0 0 1 once", 0, ["the gripper is jammed"]),
    ):
        since = caller.mark_events()
        caller.tell(line)
        done = caller.wait_event("done", since=since)
        assert (done["ok"], len(done["errors"])) == (ok, len(errors)), done  # type: ignore[arg-type]
        assert all(text in str(done["errors"]) for text in errors), done
    assert b.ros.tool("rosservice", "node", "/work").strip() == "/rmpa/a/worker"
    assert "/work" in r.ros.tool("rosservice", "list").split()
    a.ros.rospy("listener", "__name:=motors", topic="/cmd_vel")
    b.wait_topic("/cmd_vel")
    assert "/rmpa/a/motors" in b.ros.tool("rostopic", "info", "/cmd_vel")
    r.agent.terminate()
    b.wait_no_topic("/cmd_vel")
    r.agent.restart()
    b.wait_topic("/cmd_vel")

    if not lacks("actionlib"):
        server = a.ros.rospy("action_server", name="server")
        client = b.ros.roscpp("action_client", name="client", commands=True)
        client.tell("server 30")
        assert client.wait_event("server", 40.0)["found"] is True
        since = client.mark_events()
        client.tell("send 20")
        done = client.wait_event("done", since=since)
        assert (done["state"], done["result"]) == ("SUCCEEDED", 20)
        server.kill()


SURE: Final = '[[contract]]\ntopics = ["/sure", "/map"]\nreliability = "reliable"\ndepth = 5000\n'
# The cable of m1 and m4, and those of the relays m2 and m3 with both: their networks are 1 and 2, and 3 and 4.
DIRECT, FIRST, SECOND = 0, 1, 2


class Triangle:
    """Two modules, a cable between them, and two relays; those that are left out begin without their cables."""

    def __init__(
        self, lab: Lab, agent: AgentFactory, shell: ShellFactory, *, unplugged: tuple[int, ...] = ()
    ) -> None:
        def module(name: str, *networks: int) -> Module:
            host = lab.host(name, *networks)
            self.cables[name] = {network: place for place, network in enumerate(networks)}
            for network in networks:
                if self.way(network) in unplugged:
                    host.cut(self.cables[name][network])
            return Module(
                host, agent(host, name=name, config=SURE + (RELAY if name in {"m2", "m3"} else "")), shell(host)
            )

        self.cables: dict[str, dict[int, int]] = {}
        self.m1, self.m4 = module("m1", 0, 1, 3), module("m4", 0, 2, 4)
        self.m2, self.m3 = module("m2", 1, 2), module("m3", 3, 4)
        for way, relay in ((FIRST, self.m2), (SECOND, self.m3)):
            if way not in unplugged:
                full_mesh(relay, self.m1)
                full_mesh(relay, self.m4)
        if DIRECT not in unplugged:
            full_mesh(self.m1, self.m4)
        self.heard = {topic: self.m4.ros.roscpp("listener", f"__name:={topic[1:]}", topic=topic) for topic in TOPICS}
        for topic, options in TOPICS.items():
            self.m1.ros.roscpp("talker", f"__name:={topic[1:]}_talker", topic=topic, **options)
        flows(self.heard["/sure"], 50)
        eventually(lambda: self.heard["/map"].events("report"), what="the map")

    @staticmethod
    def way(network: int) -> int:
        return (network + 1) // 2

    def _each(self, way: int) -> list[tuple[Module, int]]:
        modules = (self.m1, self.m2, self.m3, self.m4)
        return [(m, place) for m in modules for net, place in self.cables[m.name].items() if self.way(net) == way]

    def cut(self, way: int) -> None:
        for module, place in self._each(way):
            module.host.cut(place)

    def restore(self, way: int) -> None:
        for module, place in self._each(way):
            module.host.restore(place)

    def via(self) -> str:
        """By which relay the source comes, or nothing for its own cable."""
        return str(self.m4.agent.peers().get("m1", {}).get("via", ""))

    def after(self, act: Callable[[], object], more: int = 150) -> tuple[Event, float]:
        """What the listener says after something has happened, and for how long it got nothing at most."""
        sure = self.heard["/sure"]
        since = sure.mark_events()
        began = time.monotonic()
        act()
        report = flows(sure, more)
        assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0), report
        maps = self.heard["/map"].events("report")[-1]
        assert (maps["count"], maps["doubled"]) == (1, 0), maps
        took = time.monotonic() - began
        print(f"{took:.1f} s for {more} messages; best effort {self.heard['/plain'].events('report')[-1]}", since)
        return report, took


TOPICS: Final[dict[str, dict[str, Any]]] = {
    "/sure": {"rate": 50},
    "/plain": {"rate": 50},
    "/map": {"rate": 50, "count": 1, "latch": True},
}


def readdress(host: Host, place: int, last: int, before: float = 0.0) -> None:
    """Give a host another address on one cable; the new one may be there for a while before the old one goes."""
    cable = host.cables[place]
    old, new = cable.address, f"{cable.address.rpartition('.')[0]}.{last}"
    # Else the kernel takes the second address of a network away with the first one.
    keep = f"net.ipv4.conf.{cable.interface}.promote_secondaries=1"
    subprocess.run(host.command(["sysctl", "-qw", keep]), check=True)
    if not before:
        host.ip("address", "del", f"{old}/24", "dev", cable.interface)
    host.ip("address", "add", f"{new}/24", "dev", cable.interface)
    if before:
        time.sleep(before)
        host.ip("address", "del", f"{old}/24", "dev", cable.interface)
    host.cables[place] = replace(cable, address=new)


def test_a_relay_takes_over_at_once_when_a_cable_is_pulled(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    triangle = Triangle(lab, agent, shell, unplugged=(SECOND,))
    assert triangle.via() == ""
    _, took = triangle.after(lambda: triangle.cut(DIRECT))
    assert took < 20.0, "without an outage's 30 s"
    assert triangle.via() == "m2"
    triangle.after(lambda: triangle.restore(DIRECT), 300)
    eventually(lambda: triangle.via() == "", what="the cable is used again")
    triangle.after(lambda: None)


@pytest.mark.long
def test_a_way_that_joins_is_taken_without_a_break(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    triangle = Triangle(lab, agent, shell, unplugged=(DIRECT, SECOND))
    assert triangle.via() == "m2"
    triangle.after(lambda: triangle.restore(SECOND), 300)
    triangle.after(lambda: triangle.restore(DIRECT), 300)
    eventually(lambda: triangle.via() == "", what="the cable is used")
    triangle.after(lambda: None)


def test_a_relay_that_leaves_takes_nothing_along(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    triangle = Triangle(lab, agent, shell, unplugged=(DIRECT,))
    used, other = (triangle.m2, "m3") if triangle.via() == "m2" else (triangle.m3, "m2")
    triangle.after(used.agent.terminate, 300)
    assert triangle.via() == other


@pytest.mark.parametrize(("who", "before"), [("m1", 0.0), pytest.param("m4", 3.0, marks=pytest.mark.long)])
def test_an_address_that_changes_loses_nothing(
    lab: Lab, agent: AgentFactory, shell: ShellFactory, who: str, before: float
) -> None:
    """As DHCP does it; also when the new address is there before the old one goes."""
    triangle = Triangle(lab, agent, shell, unplugged=(FIRST, SECOND))
    module = triangle.m1 if who == "m1" else triangle.m4
    triangle.after(lambda: readdress(module.host, 0, 77, before), 300)


@pytest.mark.long
def test_cables_relays_and_addresses_change_at_random(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """A way is left at any time, so nothing may be lost."""
    seconds = 600.0
    triangle, rng = Triangle(lab, agent, shell), random.Random(seconds)
    out: set[int] = set()
    addresses, until = 100, time.monotonic() + seconds
    while time.monotonic() < until:
        relay = rng.choice([triangle.m2, triangle.m3])
        way = rng.choice([DIRECT, FIRST, SECOND])
        match rng.randrange(5):
            case 0:
                addresses += 1
                module = rng.choice([triangle.m1, triangle.m4])
                triangle.after(partial(readdress, module.host, rng.randrange(3), addresses), 50)
            case 1 if not out:
                triangle.after(relay.agent.terminate, 150)
                relay.agent.restart()
            case _ if way in out:
                out.remove(way)
                triangle.after(partial(triangle.restore, way), rng.choice([10, 100, 300]))
            case _ if len(out) < 2:
                out.add(way)
                triangle.after(partial(triangle.cut, way), rng.choice([10, 100, 300]))
    for way in out:
        triangle.restore(way)
    triangle.after(lambda: None, 300)


IMAGE = 300_000
# Whose advertisement is larger than a packet.
MTU_TOPICS = 60
CROWD = """
import rospy, std_msgs.msg
rospy.init_node("crowd")
names = ["/crowd/a_topic_with_a_name_%d" % number for number in range({count})]
kept = [rospy.Publisher(name, std_msgs.msg.String, queue_size=1) for name in names]
rospy.spin()
"""
SOON = 15.0


def narrow(router: Host, mtu: int = 1200) -> None:
    """Give the router's cables this MTU, and keep it from telling the hosts."""
    for cable in router.cables:
        router.ip("link", "set", cable.interface, "mtu", str(mtu))
    chain = "add chain ip hole told { type filter hook output priority 0; }"
    rules = f"add table ip hole; {chain}; add rule ip hole told ip protocol icmp drop"
    subprocess.run(router.command(["nft", rules]), check=True, capture_output=True, timeout=20)


@pytest.mark.skipif(shutil.which("nft") is None, reason="no nftables here (apt install nftables)")
def test_all_arrives_from_the_first_packet_on(lab: Lab, agent: AgentFactory, shell: ShellFactory) -> None:
    """Both ways: graphs, whose exchange is larger than a packet, commands and images."""
    hosts = [lab.host("a", 0), lab.host("b", 1)]
    router = lab.router(0, 1)
    narrow(router)
    for host in hosts:
        lab.route(host, router)
    first = agent(hosts[0], name="a", flags=["--seed", hosts[1].address])
    a, b = (
        Module(host, made, shell(host)) for host, made in zip(hosts, (first, agent(hosts[1], name="b")), strict=True)
    )
    a.agent.wait_peer("b")
    a.ros.start(PYTHON, "-c", CROWD.format(count=MTU_TOPICS), name="crowd")

    def known() -> bool:
        return sum(topic.startswith("/crowd/") for topic in b.ros.graph_topics()) >= MTU_TOPICS

    eventually(known, SOON, what="a's graph at b")
    eyes = [to.ros.roscpp("listener", "__name:=eye", topic=f"/{of.name}/image") for of, to in ((a, b), (b, a))]
    hand = b.ros.roscpp("listener", "__name:=hand", topic="/command", nodelay=True)
    a.ros.roscpp("talker", "__name:=teller", topic="/command", size=64, rate=50)
    for module in (a, b):
        module.ros.roscpp("talker", "__name:=camera", topic=f"/{module.name}/image", size=IMAGE, rate=10)
    for listener in (*eyes, hand):
        assert flows(listener, 10, SOON)["bad"] == 0
    assert a.agent.snapshot().counters.get("link.down", 0) == 0
