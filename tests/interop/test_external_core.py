"""A real roscore in place of the embedded core: ``rmpa up --core external`` (docs/guides/running.md)."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import pytest

from lab.bed.agents import Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually
from tests.interop.conftest import AgentFactory, ShellFactory
from tests.interop.modules import Module, flows
from tests.interop.sites import nodes
from tests.interop.test_log import clerk, heard, lines, say

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

EXTERNAL: Final = ("--core", "external")
Joined = tuple[Module, Module, "Process"]


@pytest.fixture
def joined(lab: Lab, shell: ShellFactory, agent: AgentFactory) -> Callable[..., Joined]:
    """Make two linked modules, ``a`` with a real master and ``b`` with the embedded core; and that master.

    ``whole=True`` makes a ``roscore`` of it, with ``/rosout`` and ``/run_id``.
    """

    def make(*, whole: bool = False) -> Joined:
        first, second = lab.hosts("a", "b")
        ros = shell(first)
        master = ros.roscore() if whole else ros.master()
        a = Module(first, agent(first, name="a", flags=EXTERNAL), ros)
        b = Module(second, agent(second, name="b"), shell(second))
        a.agent.wait_peer("b")
        return a, b, master

    return make


def notes(agent: Agent) -> str:
    """What the agent wants its user to know."""
    code, output = agent.rmpa("peer", "list")
    assert code == 0, output
    return output


def test_roscore_and_embedded_core_exchange_topics(
    joined: Callable[..., Joined],
) -> None:
    a, b, _ = joined()
    there = b.ros.rospy("listener", topic="/from_a")
    here = a.ros.roscpp("listener", topic="/from_b")
    talker = a.ros.rospy("talker", "__name:=speaker", topic="/from_a", rate=50)
    b.ros.roscpp("talker", "__name:=speaker", topic="/from_b", rate=50)
    flows(there)
    flows(here)
    assert {"/speaker", "/rmpa", "/rmpa/b/speaker"} <= nodes(a)
    assert "/rmpa/a/speaker" in nodes(b)
    assert "std_msgs/UInt8MultiArray" in a.ros.tool("rostopic", "info", "/from_b")
    assert "data: " in a.ros.tool("rostopic", "echo", "-n", "1", "/from_b")

    code, output = a.agent.rmpa("topic", "list")
    assert (code, "/from_b" in output) == (0, True), "our own tools ask the same master"

    # The same name at another address: rosmaster's state is the same as before.
    talker.kill()
    a.ros.rospy("talker", "__name:=speaker", topic="/from_a", rate=50, source=2)
    there.wait_event("report", where=lambda event: "2" in event["sources"])  # type: ignore[operator]

    begin = time.monotonic()
    assert a.agent.terminate() == 0
    assert time.monotonic() - begin < 5.0
    assert not [name for name in nodes(a) if name.startswith("/rmpa")]
    assert "/from_b" not in a.ros.tool("rostopic", "list", "-p").split()


def test_a_new_node_is_seen_within_a_second_and_a_dead_one_hidden(joined: Callable[..., Joined]) -> None:
    a, b, _ = joined()
    talker = a.ros.roscpp("talker", topic="/chatter", rate=100)
    eventually(lambda: "/chatter" in a.ros.graph_topics(), what="/chatter at a", every=0.01)
    begin = time.monotonic()
    eventually(lambda: "/chatter" in b.ros.graph_topics(), what="/chatter at b", every=0.01)
    assert time.monotonic() - begin < 5.0, "a second, and what a busy machine takes"
    assert "/chatter" in b.topics()
    flows(b.ros.roscpp("listener", topic="/chatter"))
    talker.kill()
    # The listener's subscription to the proxy goes with the proxy: only then is the topic's last name gone there.
    eventually(lambda: "/rmpa/a/talker" not in b.ros.tool("rostopic", "info", "/chatter"), what="no proxy at b")
    assert "/chatter" in a.topics(), "rosmaster keeps registrations, and these are not the agent's"


def test_flows_outlive_the_roscore_and_the_next_one_gets_our_nodes(joined: Callable[..., Joined]) -> None:
    a, b, master = joined(whole=True)
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    b.ros.roscpp("talker", "__name:=other", topic="/from_b", rate=10)
    abroad = b.ros.roscpp("listener", topic="/chatter")
    flows(abroad)
    run_id = a.ros.tool("rosparam", "get", "/run_id")
    master.interrupt()
    eventually(lambda: "does not answer" in notes(a.agent), what="the note")
    flows(abroad, 50)
    a.ros.roscore()
    assert a.ros.tool("rosparam", "get", "/run_id") != run_id
    eventually(lambda: "does not answer" not in notes(a.agent), what="no note")
    eventually(lambda: {"/rmpa", "/rmpa/b/other"} <= nodes(a), what="our nodes at the new master")
    a.ros.roscpp("talker", "__name:=fresh", topic="/fresh", rate=100)
    flows(b.ros.rospy("listener", topic="/fresh"))
    flows(a.ros.rospy("listener", topic="/from_b"))
    report = flows(abroad, 50)
    assert (report["gaps"], report["doubled"]) == (0, 0)


def test_a_local_provider_has_precedence(joined: Callable[..., Joined]) -> None:
    a, b, _ = joined()
    a.ros.rospy("worker", "__name:=at_a", service="/work").wait_event("up")
    b.ros.roscpp("worker", "__name:=at_b", service="/far").wait_event("up")
    for module, service in ((a, "/far"), (b, "/work")):
        with_wait = module.ros.rospy("caller", service=service, wait=True, commands=True)
        with_wait.wait_event("there")
        with_wait.tell("echo 0 1000 3 once")
        done = with_wait.wait_event("done")
        assert (done["ok"], done["same"]) == (3, 3), done
        assert module.ros.tool("rosservice", "type", service).strip() == "rmpa_test/Work"
    assert a.ros.tool("rosservice", "node", "/far").strip() == "/rmpa/b/at_b"
    local = a.ros.roscpp("worker", "__name:=local", service="/far")
    local.wait_event("up")
    assert a.ros.tool("rosservice", "node", "/far").strip() == "/local"
    local.terminate()
    eventually(lambda: "/rmpa/b/at_b" in a.ros.tool("rosservice", "list", "-n"), what="the one of b again")

    a.ros.tool("rosparam", "set", "/gain", "{p: 1.5, names: [x, y]}")
    code, output = b.agent.rmpa("param", "get", "/gain", "--peer", "a")
    assert code == 0, output
    assert "p: 1.5" in output
    code, output = b.agent.rmpa("param", "set", "/gain/p", "2.5", "--peer", "a")
    assert code == 0, output
    assert a.ros.tool("rosparam", "get", "/gain/p").strip() == "2.5"


def test_a_killed_agent_is_replaced_and_a_second_one_is_named(
    joined: Callable[..., Joined], agent: AgentFactory
) -> None:
    a, b, _ = joined()
    b.ros.roscpp("talker", "__name:=speaker", topic="/chatter", rate=50)
    listener = a.ros.roscpp("listener", topic="/chatter")
    flows(listener)
    a.agent.kill()
    assert "/rmpa/b/speaker" in nodes(a), "the roscore keeps what is dead"
    a.agent.restart()
    flows(listener, 20)
    flows(a.ros.rospy("listener", topic="/chatter"))

    agent(a.host, name="rival", flags=EXTERNAL)
    eventually(lambda: "another agent (its node at http://" in a.agent.rmpa("doctor")[1], what="it is named")


def test_a_graph_over_two_machines_is_one_module(lab: Lab, shell: ShellFactory, agent: AgentFactory) -> None:
    """Its roscore is elsewhere, so our proxies are where that machine's nodes reach them."""
    arm, base, other = lab.hosts("arm", "base", "other")
    ros = shell(arm)
    ros.env.update(ROS_IP=str(arm.address), ROS_MASTER_URI=f"http://{arm.address}:11311/")
    ros.master()
    a = agent(base, name="robot", flags=(*EXTERNAL, "--master", ros.uri))
    b = Module(other, agent(other, name="other"), shell(other))
    a.wait_peer("other")
    b.ros.roscpp("talker", topic="/from_other", rate=50)
    flows(ros.rospy("listener", topic="/from_other"))
    ros.roscpp("talker", topic="/from_arm", rate=50)
    flows(b.ros.roscpp("listener", topic="/from_arm"))
    assert f"http://{base.address}:" in ros.tool("rostopic", "info", "/from_other")


def test_the_log_of_a_roscore_is_read_from_another_module_also_after_its_restart(
    joined: Callable[..., Joined],
) -> None:
    a, b, roscore = joined(whole=True)
    here = clerk(a, "here")
    say(here, "by a roscore")
    assert heard(b.agent, "by a roscore")["node"] == "/here"
    roscore.terminate()
    a.ros.roscore()
    another = clerk(a, "another")

    def again() -> bool:
        say(another, "after its restart")
        return any(line["text"] == "after its restart" for line in lines(b.agent))

    eventually(again, what="the log of the new roscore")
