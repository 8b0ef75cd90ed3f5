"""Agents, nodes, cables and hosts that fail, rest, restart or hang, as docs/guides/running.md says."""

from __future__ import annotations

import json
import time

import pytest

from lab.bed.processes import Process, eventually
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module, flows

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(300)]


def test_a_killed_agent_is_retracted_and_a_restarted_one_serves_new_nodes_and_its_peer(
    modules: ModuleFactory,
) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", "__name:=before", topic="/chatter", rate=100)
    at_home = a.ros.roscpp("listener", topic="/chatter")
    abroad = b.ros.roscpp("listener", topic="/chatter")
    flows(abroad)
    flows(at_home)
    a.agent.kill()
    b.agent.wait_no_peer("a")
    _wait_no_publisher(b, "/chatter")
    report = flows(at_home, 50)
    assert (report["gaps"], report["doubled"]) == (0, 0)
    a.agent.restart()
    a.agent.wait_peer("b")
    a.ros.roscpp("talker", "__name:=after", topic="/chatter", rate=100, source=2)
    report = abroad.wait_event("report", where=lambda event: "2" in event["sources"])  # type: ignore[operator]
    assert report["bad"] == 0
    assert len([row for row in b.agent.peers() if row == "a"]) == 1


def test_killed_listener_ends_the_demand_and_the_next_one_is_served(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    heard = b.ros.roscpp("listener", topic="/chatter")
    flows(heard)
    assert "Subscribers: None" not in a.ros.tool("rostopic", "info", "/chatter")
    heard.kill()
    eventually(
        lambda: "Subscribers: None" in a.ros.tool("rostopic", "info", "/chatter"), what="the talker has no listener"
    )
    assert flows(b.ros.rospy("listener", topic="/chatter"))["bad"] == 0


def test_a_cable_out_and_in_and_an_interface_off_and_on(modules: ModuleFactory) -> None:
    a, b, c = modules("a", "b", "c")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    b.ros.roscpp("talker", topic="/local", rate=100)
    at_home = b.ros.roscpp("listener", "__name:=home", topic="/local")
    abroad = b.ros.roscpp("listener", "__name:=abroad", topic="/chatter")
    others = c.ros.roscpp("listener", topic="/chatter")
    for heard in (abroad, at_home, others):
        flows(heard)
    b.host.cut()
    b.agent.wait_no_peer("a")
    a.agent.wait_no_peer("b")
    _wait_no_publisher(b, "/chatter")
    b.host.restore()
    report = flows(abroad)
    assert (report["bad"], report["doubled"]) == (0, 0)
    b.host.switch_off()
    b.agent.wait_no_peer("a")
    b.host.switch_on()
    assert flows(abroad)["bad"] == 0
    for one, other in ((a, "b"), (c, "b"), (b, "a"), (b, "c")):
        one.agent.wait_peer(other)
    for unhurt in (at_home, others):
        report = flows(unhurt)
        assert (report["gaps"], report["doubled"]) == (0, 0)


@pytest.mark.trap(18)
def test_frozen_agent_is_retracted_and_comes_back(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    abroad = b.ros.roscpp("listener", topic="/chatter")
    flows(abroad)
    a.agent.freeze()
    b.agent.wait_no_peer("a")
    a.agent.thaw()
    a.agent.wait_peer("b")
    assert flows(abroad)["bad"] == 0


def test_a_peer_that_ends_in_order_leaves_nothing(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    b.wait_topic("/chatter")
    assert a.agent.sockets()
    assert a.agent.terminate() == 0
    assert a.agent.sockets() == []
    b.wait_no_topic("/chatter", 3.0)


def _wait_no_publisher(module: Module, topic: str) -> None:
    """Wait until a topic has no publisher in a module's graph (a listener there may keep its name alive)."""

    def gone() -> bool:
        with module.ros.start("rostopic", "info", topic) as info:
            info.wait()
            return "Publishers: None" in info.output or "Unknown topic" in info.output

    eventually(gone, what=f"no publisher of {topic} at {module.name}")


KINDS = ("rospy", "roscpp")


def _nodes(module: Module) -> set[str]:
    return {name for name in module.ros.tool("rosnode", "list").split() if not name.startswith("/rmpa")}


def _calls(caller: Process) -> None:
    since = caller.mark_events()
    caller.tell("echo 0 1000 3 once")
    done = caller.wait_event("done", 20, since=since)
    assert (done["ok"], done["same"]) == (3, 3), done


def _run_id(module: Module) -> str:
    return module.ros.tool("rosparam", "get", "/run_id").strip()


@pytest.mark.trap(14)
def test_a_killed_agent_has_its_nodes_back_and_they_each_other(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.start("rostopic", "pub", "-r", "10", "/tk", "std_msgs/String", "a")
    echo = b.ros.start("rostopic", "echo", "/tk")
    a.ros.roscpp("talker", "__name:=out", topic="/out", rate=50)
    b.ros.rospy("talker", name="in", topic="/in", rate=50)
    dying = a.ros.roscpp("talker", "__name:=dying", topic="/dying", rate=10)
    for kind in KINDS:
        a.ros.node(kind, "worker", name=f"{kind}_worker", service=f"/{kind}/work", quiet=True).wait_event("up")
    at_home = [a.ros.node(kind, "listener", f"__name:=home_{kind}", topic="/out") for kind in KINDS]
    abroad = [b.ros.node(kind, "listener", f"__name:=abroad_{kind}", topic="/out") for kind in KINDS]
    coming = [a.ros.node(kind, "listener", f"__name:=coming_{kind}", topic="/in") for kind in KINDS]
    callers = [b.ros.node(kind, "caller", service=f"/{kind}/work", wait=True, commands=True) for kind in KINDS]
    for listener in [*at_home, *abroad, *coming]:
        flows(listener)
    for caller in callers:
        caller.wait_event("there")
        _calls(caller)
    a.ros.tool("rosparam", "set", "/robot", "{speed: 0.5, names: [left, right]}")
    nodes, run_id = _nodes(a), _run_id(a)

    a.agent.kill()
    dying.kill()
    a.agent.restart()
    a.agent.wait_peer("b")
    for listener in [*coming, *abroad, *at_home]:
        flows(listener, 20)
    for listener in at_home:
        report = flows(listener)
        assert (report["gaps"], report["doubled"], report["bad"]) == (0, 0, 0), "what stood at home stays"
    _echoes(echo)
    for caller in callers:
        _calls(caller)
    eventually(lambda: _nodes(a) == nodes - {"/dying"}, what="all nodes of a but the one that was killed")
    assert "/dying" not in a.topics()
    assert _run_id(a) == run_id
    assert a.ros.tool("rosparam", "get", "/robot/names").split() == ["-", "left", "-", "right"]
    code, told = a.agent.rmpa("doctor", "--json")
    (memory,) = [finding for finding in json.loads(told) if finding["check"] == "core memory"]
    assert "nodes of the last run are restored, 1 is gone" in memory["text"], (code, memory)

    b.agent.kill()
    b.agent.restart()
    for listener in [*abroad, *coming]:
        flows(listener, 20)
    _echoes(echo)

    a.agent.kill()
    a.agent.flags = ["--keep", "never"]
    a.agent.restart()
    assert "/robot" not in a.ros.tool("rosparam", "list")
    assert _run_id(a) != run_id
    assert not _nodes(a) & nodes - {"/rosout"}


def _echoes(echo: Process) -> None:
    """Wait until an echo has printed more."""
    before = echo.output.count("data:")
    eventually(lambda: echo.output.count("data:") > before + 5, what="rostopic echo goes on")


# Seconds for which an agent is stopped: less than the lease of a link at rest, and more.
PAUSE, HANG = 5.0, 30.0
# Seconds in which links rest, on a busy machine too; the protocol takes 5 to 10.
SOON = 60.0
# Seconds in which the silence of a link at rest is noticed, on a busy machine too; the protocol takes 11 to 16.
NOTICED = 30.0


def links(module: Module) -> dict[str, tuple[bool, float]]:
    """The links of a module by the name of the peer: whether it is at rest, and when it came up."""
    now = time.monotonic()
    peers = module.agent.snapshot().peers
    return {peer.name: (peer.link.rests, now - peer.link.up_ago) for peer in peers if peer.link is not None}


def wait_rest(*modules: Module) -> None:
    """Wait until all of these are linked with each other, and all links are at rest."""

    def rests() -> bool:
        found = [links(module) for module in modules]
        return all(len(one) == len(modules) - 1 and all(rest for rest, _ in one.values()) for one in found)

    eventually(rests, SOON, what="every link is at rest", every=0.5)


def wait_lost(module: Module, within: float, *peers: str) -> None:
    """Wait until a module has no link with any of these peers."""
    eventually(lambda: not links(module).keys() & {*peers}, within, what=f"{module.name} without {peers}", every=0.1)


@pytest.mark.long
def test_a_pause_a_hang_and_a_cut_at_rest(modules: ModuleFactory) -> None:
    a, b, c = modules("a", "b", "c")
    for module in (a, b, c):
        module.ros.roscpp("talker", topic=f"/of_{module.name}", rate=10)
    for module in (a, b, c):
        for other in (a, b, c):
            module.wait_topic(f"/of_{other.name}")
    wait_rest(a, b, c)

    before = links(a)
    b.agent.freeze()
    time.sleep(PAUSE)
    b.agent.thaw()
    code, answer = a.agent.rmpa("peer", "ping", "b", "-c", "1")
    assert code == 0, answer
    assert links(a)["b"][1] == pytest.approx(before["b"][1], abs=1.0), "a pause ends no link at rest"
    wait_rest(a, b, c)

    b.agent.freeze()
    c.host.cut()
    begun = time.monotonic()
    wait_lost(a, NOTICED, "b", "c")
    a.wait_no_topic("/of_b")
    a.wait_no_topic("/of_c")
    time.sleep(max(0.0, begun + HANG - time.monotonic()))
    b.agent.thaw()
    c.host.restore()
    for module in (a, b, c):
        for other in (a, b, c):
            module.wait_topic(f"/of_{other.name}")
    flows(a.ros.roscpp("listener", topic="/of_b"))
    flows(b.ros.roscpp("listener", topic="/of_c"))
