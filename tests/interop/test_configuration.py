"""A resource of one module, configured from another: by dynamic_reconfigure's own tools, and by rmpa's."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pytest

from lab.bed.agents import RMPA
from lab.bed.processes import Process, eventually
from tests.interop.ros import PYTHON, lacks

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.processes import Event
    from tests.interop.conftest import ModuleFactory
    from tests.interop.modules import Module

pytestmark = [
    pytest.mark.ros,
    pytest.mark.netns,
    pytest.mark.timeout(120),
    pytest.mark.skipif(bool(lacks("dynamic_reconfigure")), reason=lacks("dynamic_reconfigure") or "it is there"),
]
LAMP: Final = Path(__file__).parent / "resources" / "lamp.py"
DYNPARAM: Final = "/usr/lib/dynamic_reconfigure/dynparam"
LONG: Final = 40.0


@pytest.fixture
def pair(modules: ModuleFactory) -> Iterator[list[Module]]:
    """The lamp's module, where it runs, and another one."""
    both = modules("robot", "pc")
    argv = both[0].host.command([RMPA, "run", LAMP, "--name", both[0].name])
    with Process(argv, env=both[0].agent.env, name="lamp.py") as process:
        process.wait_for("active on", LONG)
        both[1].wait_topic("/lamp/parameter_descriptions")
        yield both


def change(client: Process, **values: object) -> Event:
    since = client.mark_events()
    client.tell(json.dumps(values))
    return client.wait_event("configured", LONG, since=since)


def rmpa(module: Module, *words: str) -> str:
    code, out = module.agent.rmpa(*words)
    assert code == 0, out
    return out


def test_dynamic_reconfigure_works_from_another_module(pair: list[Module]) -> None:
    robot, pc = pair
    client = pc.ros.rospy("configurer", name="far", commands=True)
    up = client.wait_event("up", LONG)
    assert up["servers"] == ["/lamp"]
    first = {"level": 1.0, "steps": 3, "on": True, "colour": "white", "profile": "", "context": ""}
    assert up["config"] == first
    described: Any = {each["name"]: each for each in up["descriptions"]}  # type: ignore[attr-defined] # JSON
    assert (described["level"]["min"], described["level"]["max"], described["level"]["type"]) == (0.0, 10.0, "double")
    assert described["level"]["description"] == "of the supply [V]"
    assert "'value': 'blue'" in described["colour"]["edit_method"]
    for name, each in described.items():  # what rqt_reconfigure's editors look up when they are opened
        if each["edit_method"]:
            values = [item["value"] for item in ast.literal_eval(each["edit_method"])["enum"]]
            assert each["default"] in values, name
            assert first[name] in values, name
        elif each["type"] == "int":  # a slider's ends have 32 bits
            assert -(2**31) <= int(each["min"]) < int(each["max"]) < 2**31, name

    since = client.mark_events()
    done = change(client, level=99, steps="7", on="false", colour="BLUE", profile="fast")
    now = {"level": 10.0, "steps": 7, "on": False, "colour": "blue", "profile": "fast", "context": ""}
    assert done["answer"] == now, done
    update = client.wait_event("update", LONG, since=since)
    assert update["config"] == now  # all of it at once
    eventually(lambda: robot.ros.tool("rosparam", "get", "/lamp/colour").strip() == "blue", what="the mirror")
    assert robot.ros.tool("rostopic", "echo", "-n1", "/lamp/profile").splitlines()[0] == 'data: "fast"'

    for wrong in ({"profile": "fsat"}, {"colour": "pink"}, {"profile": "broken", "level": 1}, {"context": "home"}):
        refused = change(client, **wrong)
        assert "service call failed" in str(refused["error"]), wrong
    assert change(client)["answer"] == now
    assert change(client, profile="automatic", context="away")["answer"] == now | {"profile": "", "context": "away"}
    client.end()

    for module in pair:  # the command-line tool, near and far
        module.ros.tool(PYTHON, DYNPARAM, "set", "/lamp", "level", "2.5")
        assert "'level': 2.5" in module.ros.tool(PYTHON, DYNPARAM, "get", "/lamp")
        module.ros.tool(PYTHON, DYNPARAM, "set", "/lamp", "{'level': 3, 'colour': 'white'}")
    said = pc.ros.tool("rosservice", "call", "/lamp/set_parameters", "config: {doubles: [{name: level, value: 4}]}")
    assert "value: 4.0" in said


def test_rmpa_sees_and_sets_it_from_another_module(pair: list[Module]) -> None:
    robot, pc = pair
    far = f"{robot.name}:/lamp"
    (listed,) = json.loads(rmpa(pc, "resource", "list", "--json"))
    assert (listed["name"], listed["peer"], listed["profile"]) == ("/lamp", robot.name, "slow")
    info = rmpa(pc, "resource", "info", far)
    assert f"Node: /lamp of peer {robot.name}" in info
    assert "Health: OK: profile slow" in info
    assert rmpa(pc, "profile", "set", far, "fast") == ""
    assert rmpa(robot, "profile", "get").strip() == rmpa(pc, "profile", "get", "/lamp").strip() == "fast"
    code, out = pc.agent.rmpa("profile", "set", far, "broken")
    assert code == 1
    assert "profile broken: it could not be applied: OSError: no such bulb; what was chosen before stays" in out
    code, out = pc.agent.rmpa("context", "set", far, "hoem")
    assert code == 2
    rmpa(pc, "profile", "set", far, "--auto")

    # A rule over a topic of another module and a parameter.
    rmpa(pc, "context", "set", far, "away")
    assert rmpa(robot, "context", "get").strip() == "away"
    rmpa(pc, "context", "set", far, "--auto")
    pc.ros.start("rostopic", "pub", "-l", "/battery/charging", "std_msgs/Bool", "true")
    robot.ros.tool(PYTHON, DYNPARAM, "set", "/lamp", "level", "5")
    eventually(lambda: rmpa(robot, "context", "get").strip() == "docked", LONG, what="the rule to hold")
    assert "context docked" in rmpa(pc, "profile", "explain", far)
    assert rmpa(pc, "profile", "get", far).strip() == "fast"
    alarms = json.loads(rmpa(pc, "alarm", "list", "--all", "--json"))
    assert [(one["resource"], one["peer"]) for one in alarms] == [("/lamp", robot.name)]
    code, out = pc.agent.rmpa("resource", "info", f"{robot.name}:/lmap")
    assert code == 1
    assert f"did you mean {far}?" in out
