"""Resources of a folder, started from another module: real nodes, kill -9 of agent and resource; attacks."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any, Final

import pytest

from lab.bed.agents import RMPA, Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually
from lab.bed.ros import NODES as COMMON
from rmpa.bridge.launched import LaunchedResource, ModuleResources
from rmpa.observe.control_client import ControlClient, choose_agent
from rmpa.runtime.programs import figures
from tests.interop.conftest import ModuleFactory
from tests.interop.ros import NODES, PYTHON
from tests.interop.secured import SecuredMesh

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(240)]

LONG: Final = 60.0
PATHS: Final = f"{NODES}:{COMMON}"
CAMERA: Final = """
role = "sensing"

[node.driver]
name = "/driver"
run = "seat talker"
args = ["--name", "driver", "--topic", "/frames", "--type", "String"]
env = { ROS_PACKAGE_PATH = "PACKAGES" }

[node.second]
name = "/far/second"
launch = "second.launch"
env = { ROS_PACKAGE_PATH = "PACKAGES:/usr/share" }

[output.frames]
topic = "/frames"
type = "std_msgs/String"

[profile.full]
offers = { rate = "10 Hz" }
"""
LAUNCH: Final = """
<launch>
  <group ns="far"><node name="second" pkg="seat" type="talker" args="--topic /second --type String"/></group>
</launch>
"""
TALKER: Final = f"""#!/bin/sh
PYTHONPATH={PATHS}:$PYTHONPATH exec {PYTHON} {NODES}/talker.py "$@"
"""


def folder(home: Path) -> Path:
    """A folder with the camera, which is the same for all modules of a test, and a package of its nodes."""
    (made := home / "resources").mkdir()
    (made / "camera.resource.toml").write_text(CAMERA.replace("PACKAGES", str(home / "packages")))
    (made / "second.launch").write_text(LAUNCH)
    (package := home / "packages" / "seat").mkdir(parents=True)
    (package / "package.xml").write_text("<package><name>seat</name></package>")
    (package / "talker").write_text(TALKER)
    (package / "talker").chmod(0o755)
    return made


def listed(agent: Agent, module: str = "b") -> dict[str, Any]:
    """What ``rmpa resource list`` at an agent shows of the camera of a module."""
    code, output = agent.rmpa("resource", "list", "--json", timeout=LONG)
    assert code == 0, output
    wanted = None if module == agent.name else module
    found: list[dict[str, Any]] = json.loads(output[output.index("[") :])
    return next((one for one in found if one["name"] == "/camera" and one["peer"] == wanted), {})


def camera(agent: Agent, module: str = "b") -> LaunchedResource | None:
    """What an agent tells of the camera of a module."""
    with ControlClient(choose_agent(agent.env, agent.name).path, LONG) as client:
        told = client.call("launch", tuple[ModuleResources, ...], what="list")
    return next((one for each in told if each.module == module for one in each.resources), None)


def state(agent: Agent, module: str = "b") -> str:
    """The state of the camera of a module; empty: it is not told."""
    one = camera(agent, module)
    return one.state if one is not None else ""


def nodes(agent: Agent) -> dict[str, int]:
    """The processes of the camera's nodes, by name, once all of them run."""

    def find() -> dict[str, int]:
        its = one.processes if (one := camera(agent)) is not None else ()
        found = {each.node: each.pid for each in its if each.pid is not None and each.own}
        return found if len(found) == 2 else {}

    return eventually(find, LONG, what="the nodes run")


def ends(pid: int) -> None:
    """Wait until a process has ended."""
    eventually(lambda: figures(pid) is None, LONG, what=f"process {pid} ends")


def test_nodes_of_another_seat_are_started_read_taken_over_and_ended(tmp_path: Path, modules: ModuleFactory) -> None:
    config = f'[resources]\nfolder = "{folder(tmp_path)}"\nopen = true\n'
    a, b = modules("a", "b", config=config, fresh=True, log_level="info")
    assert listed(a.agent)["state"] == "stopped"
    code, output = a.agent.rmpa("resource", "start", "b:camera", timeout=LONG)
    assert code == 0, output
    assert "b:camera is active" in output
    first = nodes(a.agent)
    assert first.keys() == {"/driver", "/far/second"}
    assert state(a.agent, "a") == "stopped"
    a.wait_topic("/second", LONG)
    command = a.host.command([RMPA, "resource", "log", "b:camera", "-f"])
    with Process(command, env={**a.agent.env, "RMPA_AGENT": "a"}, name="rmpa resource log") as follows:
        follows.wait_for("active on", LONG)
        follows.wait_for("driver: .*up", LONG)
        follows.wait_for("second: .*started with pid", LONG)
    _, output = a.agent.rmpa("top", "b", "--json")
    (told,) = json.loads(output)["modules"]
    started = {one["node"]: one["started_by"] for one in told["nodes"]}
    assert started["/driver"] == started["/far/second"] == "camera"
    assert {one["pid"] for one in told["nodes"]} >= {*first.values()}
    assert all(each["rss"] > 1_000_000 for each in listed(a.agent)["processes"])

    def process() -> int | None:
        return one.pid if (one := camera(a.agent)) is not None else None

    pid = process()
    assert pid is not None
    b.agent.kill()
    b.agent.restart()
    a.agent.wait_peer("b", LONG)
    eventually(lambda: state(a.agent) == "active", LONG, what="the next agent finds it")
    assert process() == pid
    assert nodes(a.agent) == first

    os.kill(pid, signal.SIGKILL)
    eventually(lambda: process() not in (None, pid), LONG, what="it is started again")
    eventually(lambda: state(a.agent) == "active", LONG, what="it is active")
    assert nodes(a.agent) == first
    code, output = a.agent.rmpa("resource", "stop", "b:camera", timeout=LONG)
    assert (code, "b:camera is stopped" in output) == (0, True), output
    for each in first.values():
        ends(each)


@pytest.mark.long
def test_an_agent_that_ends_in_order_ends_what_it_has_started(tmp_path: Path, modules: ModuleFactory) -> None:
    place = folder(tmp_path)
    with (place / "camera.resource.toml").open("a") as file:
        file.write("\n[start]\nboot = true\ndelay = '100 ms'\n")
    (b,) = modules("b", config=f'[resources]\nfolder = "{place}"\n', fresh=True, log_level="info")
    started = nodes(b.agent)
    assert b.agent.terminate(LONG) == 0
    for each in started.values():
        ends(each)


def test_a_member_without_the_permission_and_a_stranger_start_nothing(
    tmp_path: Path, modules: ModuleFactory, lab: Lab
) -> None:
    place = folder(tmp_path)
    SecuredMesh(tmp_path, "a").add("b", "c")
    config = f"""
[trust]
default = "allow"
[[permission]]
modules = ["b"]
launch = ["/camera"]
[resources]
folder = "{place}"
open = true
"""
    a, b, c = modules("a", "b", "c", config=config, log_level="info")
    for what in ("start", "stop", "restart", "log"):
        code, output = c.agent.rmpa("resource", what, "a:camera")
        assert code == 1
        assert "the permissions there do not let c start /camera" in output
        assert "[not-permitted]" in output
    for name in ("../camera", "/etc/passwd", "camera.resource.toml\n", "other"):
        code, output = b.agent.rmpa("resource", "start", f"a:{name}")
        assert code in (1, 2), output
    assert state(a.agent, "a") == "stopped"
    assert camera(c.agent, "a") is None, "it is not named to those that may not"
    assert "c may not start /camera" in a.agent.process.output
    stranger = ["setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups"]
    command = a.host.command([*stranger, RMPA, "resource", "start", "camera"])
    with Process(command, env={**a.agent.env, "RMPA_AGENT": "a"}, name="another user") as other:
        assert other.wait(LONG) != 0
    assert state(a.agent, "a") == "stopped"
    code, output = b.agent.rmpa("resource", "start", "a:camera", timeout=LONG)
    assert (code, "a:camera is active" in output) == (0, True), output
    assert b.agent.rmpa("resource", "stop", "a:camera", timeout=LONG)[0] == 0
