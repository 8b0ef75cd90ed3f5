"""Types: definitions of all kinds, and releases that differ."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Final

import pytest

from lab.bed.agents import RMPA
from lab.bed.processes import Process, eventually, run
from rmpa.ros.types.definitions import known_text
from rmpa.ros.types.find import find_message_type, find_service_type
from tests.interop.conftest import ModuleFactory
from tests.interop.modules import Module, flows
from tests.interop.ros import NODES, PYTHON, lacks
from tests.ros.types.genmsg_cases import MESSAGES, SERVICES, VALUES, VALUES_OF
from tests.ros.types.workspaces import package

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
LONG: Final = 40.0
PACKAGES: Final = "/usr/lib/python3/dist-packages"
GENPY: Final = "/usr/lib/genpy/genmsg_py.py"
TWICE: Final = """\
from rmpa.resource import Resource
twice = Resource("twice", role="controlling")
path = twice.input("/path", "my_msgs/Path")
answer = twice.output("/answer", "my_msgs/Path", latch=True)
@twice.profile(offers={"rate": 1})
def plain(): pass
@twice.task(on=path)
def repeat(message):
    answer.publish(poses=[{"x": 2 * pose.x, "name": pose.name} for pose in message.poses])
"""


def workspace(folder: Path) -> dict[str, str]:
    """A package with nested types, and what genpy makes of it; the environment that a user sources."""
    made = package(
        folder / "src" / "stack" / "my_msgs",
        msg_Path="# Where to.\nHeader header\nmy_msgs/Pose[] poses\n",
        msg_Pose="float64 x  # m\nstring name\nuint8 FAST=1\nstring SAID= # not a comment\n",
    )
    header = known_text("std_msgs/Header")
    assert header is not None
    std = package(folder / "std_msgs", msg_Header=header)  # Debian has its package without the definitions
    python = folder / "devel" / "python"
    for command in (["Path.msg", "Pose.msg"], []):
        target = python / "my_msgs" / "msg"
        files = [str(made / "msg" / name) for name in command] or ["--initpy"]
        include = [f"-Imy_msgs:{made / 'msg'}", f"-Istd_msgs:{std / 'msg'}"]
        run([PYTHON, GENPY, "-p", "my_msgs", "-o", str(target), *include, *files], timeout=LONG)
    (python / "my_msgs" / "__init__.py").touch()
    return {"PYTHONPATH": str(python), "ROS_PACKAGE_PATH": str(folder / "src")}


def hears(module: Module, topic: str, text: str, env: dict[str, str]) -> None:
    """The stock ``rostopic echo`` hears a message of the user's type."""
    echo = module.ros.start("rostopic", "echo", "-n", "1", topic, env=env)
    assert echo.wait(LONG) == 0, echo.output
    assert re.search(text, echo.output), echo.output


def test_all_installed_definitions_and_the_hard_ones_are_read_as_by_genmsg() -> None:
    asked = {
        "messages": list(MESSAGES),
        "services": list(SERVICES),
        "values_of": VALUES_OF,
        "values": [values for values, _ in VALUES],
    }
    script = [PYTHON, str(NODES / "genmsg_answers.py")]
    done = subprocess.run(script, input=json.dumps(asked), capture_output=True, text=True, check=True, timeout=LONG)
    answers = json.loads(done.stdout)
    assert answers["messages"] == MESSAGES
    assert answers["services"] == {text: list(answer) for text, answer in SERVICES.items()}
    assert answers["values"] == [raw for _, raw in VALUES]

    installed: dict[str, list[str]] = answers["installed"]
    services = {name for name in installed if f"{name}Request" in installed}
    halves = {f"{name}{half}" for name in services for half in ("Request", "Response")}
    assert len(installed) > 100
    for environ in ({}, {"PYTHONPATH": PACKAGES}):  # as they come with rmpa, and as they are read here
        ours: dict[str, list[str]] = {}
        for name in installed.keys() - services - halves:
            message = find_message_type(name, environ=environ)
            ours[name] = [message.md5sum, message.definition]
        for name in services:
            service = find_service_type(name, environ=environ)
            ours[name] = [service.md5sum, ""]
            for part in (service.request, service.response):
                ours[part.name] = [part.md5sum, part.definition]
        assert ours == installed


@pytest.mark.netns
def test_types_of_the_robot_work_without_its_package(modules: ModuleFactory, tmp_path: Path) -> None:
    robot, pc = modules("robot", "pc")
    env = workspace(tmp_path / "ws")
    said = "{header: auto, poses: [{x: 1.5, name: dock}]}"
    code, output = pc.agent.rmpa("topic", "pub", "-1", "/goal", "my_msgs/Path", said)
    assert code == 1
    assert "message type my_msgs/Path: is not known here; looked in ROS_PACKAGE_PATH (not set)" in output

    # A file on the computer waits until a node, here or at a peer, publishes the type.
    file = tmp_path / "twice.py"
    file.write_text(TWICE)
    resource = pc.ros.start(RMPA, "run", file, "--master", pc.ros.uri, "--no-state", env=pc.agent.env)
    resource.wait_for("/twice waits for the type of output /answer", LONG)
    robot.ros.start("rostopic", "pub", "-r", "10", "/path", "my_msgs/Path", said, env=env)
    resource.wait_for("active on", LONG)
    hears(robot, "/answer", "x: 3.0\n +name: .dock", env)

    code, output = pc.agent.rmpa("topic", "echo", "robot:/path/poses", "-n", "1", timeout=LONG)
    assert (code, 'name: "dock"' in output) == (0, True), output
    goal = pc.ros.start(RMPA, "topic", "pub", "/goal", "my_msgs/Path", said, env=pc.agent.env)
    hears(robot, "/goal", "x: 1.5\n +name: .dock", env)
    assert "md5" not in goal.output

    # On the robot its workspace is enough, built or not.
    for known in env:
        topic = f"/{known.lower()}"
        argv = (RMPA, "topic", "pub", topic, "my_msgs/Path", said, "--master", robot.ros.uri)
        robot.ros.start(*argv, env=robot.agent.env | {known: env[known]})
        hears(robot, topic, "x: 1.5\n +name: .dock", env)


TOPIC = "/mixed"


def loud(module: Module, diagnostics: Process, wanted: str) -> None:
    """Fail unless a module says it in its log, in ``rmpa topic info`` and in /diagnostics."""
    module.agent.process.wait_for(rf"(?i)(warning|error).*{TOPIC}.*{wanted}")
    eventually(lambda: mismatches(module), what=f"a mismatch of {TOPIC} at {module.name}")
    assert wanted in " ".join(mismatches(module))
    code, shown = module.agent.rmpa("topic", "info", TOPIC)
    assert code == 0
    assert wanted in shown
    diagnostics.wait_for(rf"message: .*{wanted}", since=max(0, diagnostics.mark() - 1))


def mismatches(module: Module) -> list[str]:
    """What ``rmpa topic info`` says does not fit."""
    code, output = module.agent.rmpa("topic", "info", TOPIC, "--json")
    assert code == 0, output
    found: list[str] = json.loads(output)["mesh"]["mismatches"]
    return found


def mended(module: Module) -> None:
    """Wait until the mismatch is no longer reported."""
    eventually(lambda: not mismatches(module), what=f"nothing wrong at {module.name}")


def diagnostics(module: Module) -> Process:
    """/diagnostics as the stock tool prints it."""
    return module.ros.start("rostopic", "echo", "/diagnostics", name="diagnostics")


@pytest.mark.netns
@pytest.mark.skipif(bool(lacks("diagnostic_msgs")), reason=lacks("diagnostic_msgs"))
@pytest.mark.trap(1)
@pytest.mark.parametrize("kind", ["rospy", "roscpp"])
def test_another_md5_is_refused_at_both_ends(modules: ModuleFactory, kind: str) -> None:
    a, b = modules("a", "b")
    steady = b.ros.roscpp("listener", topic="/steady")
    a.ros.roscpp("talker", topic="/steady", rate=100, wait=1)
    a.ros.rospy("talker", topic=TOPIC, rate=50, another_md5=True, name="speaker")
    tells = [diagnostics(module) for module in (a, b)]
    b.wait_topic(TOPIC)
    heard = b.ros.node(kind, "listener", topic=TOPIC, name="wrong")
    heard.wait_event("up")
    for module, told in zip((a, b), tells, strict=True):
        loud(module, told, "md5sum")
    assert heard.events("first") == []
    # The listener leaves: nothing is wrong any more, at either end, and no other topic has noticed.
    heard.interrupt()
    for module in (a, b):
        mended(module)
    report = flows(steady, 50)
    assert (report["gaps"], report["doubled"], report["bad"]) == (0, 0, 0)


@pytest.mark.netns
@pytest.mark.skipif(bool(lacks("diagnostic_msgs")), reason=lacks("diagnostic_msgs"))
def test_another_type_is_refused_at_both_ends(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    steady = b.ros.roscpp("listener", topic="/steady")
    a.ros.roscpp("talker", topic="/steady", rate=100, wait=1)
    at_home = b.ros.rospy("talker", topic=TOPIC, rate=50, type="String", name="texts")
    heard = b.ros.rospy("listener", topic=TOPIC, type="String")
    heard.wait_event("text")
    a.ros.roscpp("talker", topic=TOPIC, rate=50, name="bytes")
    tells = [diagnostics(module) for module in (a, b)]
    for module, told in zip((a, b), tells, strict=True):
        loud(module, told, "std_msgs/String")
    # The local topic is what it was: its type, its publishers, its messages.
    assert b.ros.tool("rostopic", "type", TOPIC).strip() == "std_msgs/String"
    assert "/rmpa/a/bytes" not in b.ros.tool("rostopic", "info", TOPIC)
    heard.wait_event("text", since=heard.mark_events())
    # The local publisher leaves: the remote one takes its place, and nothing is wrong any more.
    heard.interrupt()
    at_home.interrupt()
    eventually(lambda: "/rmpa/a/bytes" in b.ros.tool("rostopic", "info", TOPIC), what="the remote publisher")
    flows(b.ros.roscpp("listener", topic=TOPIC), 5)
    for module in (a, b):
        mended(module)
    report = flows(steady, 50)
    assert (report["gaps"], report["doubled"], report["bad"]) == (0, 0, 0)
