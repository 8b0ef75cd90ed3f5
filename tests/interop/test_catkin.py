"""``packaging/ros/rmpa_ros``: the agent started by roslaunch, as from a catkin workspace."""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from lab.bed.agents import RMPA
from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually, run
from tests.interop.conftest import ShellFactory
from tests.interop.ros import Ros, environment, free_port

pytestmark = [pytest.mark.ros, pytest.mark.timeout(150)]

PACKAGE: Final = Path(__file__).parents[2] / "packaging/ros/rmpa_ros"
BRINGUP: Final = """
<launch>
  <include file="$(find rmpa_ros)/launch/up.launch"/>
  <node name="talker" pkg="rostopic" type="rostopic" args="pub -r 20 /chatter std_msgs/String hello"/>
</launch>
"""


@pytest.fixture
def users(lab: Lab, shell: ShellFactory) -> Iterator[list[Ros]]:
    """Shells on two hosts of one network that find the package."""
    with tempfile.TemporaryDirectory(prefix="rmpa-catkin-") as sockets:
        made = [shell(host) for host in lab.hosts("a", "b")]
        for ros in made:
            ros.env |= {"ROS_PACKAGE_PATH": str(PACKAGE), "RMPA_RUNTIME_DIR": f"{sockets}/{ros.host.name}"}
        yield made


def agents(ros: Ros) -> set[str]:
    """Process ids of the agents on a host."""
    found = set()
    for pid in run(["ip", "netns", "pids", ros.host.namespace]).split():
        with contextlib.suppress(OSError):  # it has ended
            if b"/rmpa\0up\0" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.add(pid)
    return found


def end(roslaunch: Process, ros: Ros) -> None:
    """Ctrl-C; the agent ends with it, at the first signal."""
    assert roslaunch.interrupt() == 0, roslaunch.output
    assert "escalating" not in roslaunch.output
    assert not agents(ros)


@pytest.mark.netns
def test_agents_of_roslaunch_beside_a_roscore_and_in_its_place_are_a_mesh(users: list[Ros], tmp_path: Path) -> None:
    a, b = users
    bringup = tmp_path / "bringup.launch"
    bringup.write_text(BRINGUP)
    beside = a.start("roslaunch", "rmpa_ros", "up.launch", f"rmpa:={RMPA}", "name:=arm", "prefix_peers:=true")
    found = {"PATH": f"{b.env['PATH']}:{RMPA.parent}", "RMPA_NAME": "base", "RMPA_LOG_LEVEL": "debug"}
    in_place = b.start(PACKAGE / "scripts/launch", f"--program={RMPA.parents[1]}", bringup, env=found)
    in_place.wait_for("this core has an agent already", 40.0)
    beside.wait_for("base .*linked", 40.0)
    eventually(lambda: "/base/chatter" in a.graph_topics(), 40.0, what="the talker of b at a")
    assert "hello" in a.tool("rostopic", "echo", "-n", "1", "/base/chatter")

    before, mark = agents(a), beside.mark()
    assert len(before) == len(agents(b)) == 1
    run(["kill", "-KILL", *before])
    eventually(lambda: agents(a) - before, what="another agent at a")
    beside.wait_for("base .*linked", since=mark)
    end(beside, a)
    end(in_place, b)
    assert "- publisher /chatter of /talker" in in_place.output, "nodes that end still have their core"


def test_in_roscores_place_no_agent_starts_where_a_core_answers(shell: ShellFactory) -> None:
    ros = shell()
    ros.master()
    launch = ros.start(PACKAGE / "scripts/launch", "--program=/nowhere", "bringup.launch")
    assert launch.wait() == 1
    assert len(launch.lines) == 1
    assert f"a core answers at {ros.uri} already: use it by plain roslaunch" in launch.output


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_launch_that_is_ended_before_its_core_answers_ends_its_agent(
    shell: ShellFactory, tmp_path: Path, number: signal.Signals
) -> None:
    program = tmp_path / "rmpa"
    program.write_text(
        "#!/bin/sh\ntrap 'echo ended; exit' TERM\necho started\nwhile kill -0 $PPID 2>/dev/null; do sleep 0.1; done\n"
    )
    program.chmod(0o755)
    launch = shell().start(PACKAGE / "scripts/launch", f"--program={tmp_path}", "bringup.launch")
    launch.wait_for("started")
    launch.send(number)
    assert launch.wait() == 128 + number
    assert launch.lines == ["started", "ended"]


def test_arguments_of_roslaunch_and_empty_ones_of_a_launch_file_are_left_out(tmp_path: Path) -> None:
    program = tmp_path / "rmpa"
    program.write_text('#!/bin/sh\nprintf "<%s>" "$PYTHONPATH" "$@"\n')
    program.chmod(0o755)
    env = environment(tmp_path, free_port()) | {"PYTHONPATH": "/ros"}
    words = ["up", "--name=", "--web=false", "--prefix-peers=true", "--seed", "a: b:=1", "__name:=rmpa", "/x:=/y"]
    script = PACKAGE / "scripts/rmpa"
    assert run([script, f"--program={tmp_path}", *words], env=env) == "</ros><up><--prefix-peers><--seed><a: b:=1>"
    missing = subprocess.run([script, "--program=/nowhere", "up"], capture_output=True, text=True, check=False)
    assert (missing.returncode, missing.stderr.count("\n")) == (127, 1)
    assert "rmpa_ros: no rmpa at /nowhere" in missing.stderr


def test_a_workspace_with_it_builds_and_installs(tmp_path: Path) -> None:
    if shutil.which("catkin_make_isolated", path=environment(tmp_path, 0)["PATH"]) is None:
        pytest.skip("no catkin here (scripts/install-ros installs Debian's)")
    env = environment(tmp_path, free_port())
    (tmp_path / "src").mkdir()
    shutil.copytree(PACKAGE, tmp_path / "src/rmpa_ros")
    run(
        ["sh", "-c", 'cd "$HOME" && catkin_make_isolated --install && rm -r src build_isolated'],
        env=env,
        timeout=100.0,
    )
    command = '. "$HOME/install_isolated/setup.sh" && roslaunch --args /rmpa rmpa_ros up.launch web:=true'
    assert f"{tmp_path}/install_isolated/lib/rmpa_ros/rmpa" in run(["sh", "-c", command], env=env)
    assert (tmp_path / "install_isolated/include/rmpa_ros/rmpa_ros.h").exists()
    imports = '. "$HOME/install_isolated/setup.sh" && python3 -c "import rmpa_ros; print(rmpa_ros.__file__)"'
    assert run(["sh", "-c", imports], env=env).startswith(f"{tmp_path}/install_isolated/")
