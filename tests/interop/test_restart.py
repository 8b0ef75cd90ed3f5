"""An agent is killed and started again: its nodes are back, here and at its peers, and none of them was restarted.

The commands of docs/guides/running.md are among them.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import flows

if TYPE_CHECKING:
    from lab.bed.processes import Process
    from tests.interop.conftest import ModuleFactory
    from tests.interop.modules import Module

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

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
