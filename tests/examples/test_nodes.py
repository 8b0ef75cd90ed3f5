"""The nodes of ``examples/nodes``, each beside a real agent, and what others see of them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

import rmpa
from lab.bed.processes import DEADLINE, Process, eventually
from tests.interop.ros import PYTHON, environment, free_port

ROOT: Final = Path(__file__).parents[2]
NODES: Final = ROOT / "examples" / "nodes"
# Debian has no rospy_tutorials: the same two ends with a type that it has.
ROSPY_SERVER: Final = """
import rospy
from std_srvs.srv import SetBool
rospy.init_node("rospy_switch")
rospy.Service("/switch", SetBool, lambda request: (request.data, "of rospy"))
rospy.spin()
"""
OUR_SERVER: Final = """
import rmpa
with rmpa.connect("our_switch") as node:
    node.advertise_service("/switch", "std_srvs/SetBool", lambda asked: {"success": asked.data, "message": "ours"})
    node.spin()
"""
OUR_CLIENT: Final = """
import rmpa
with rmpa.connect("hand") as node:
    node.wait_for_service("/switch", 30)
    print(node.call_service("/switch", "std_srvs/SetBool", [True]).message)
"""


PAGE: Final = (ROOT / "docs/start/first-node.md").read_text(encoding="utf-8")


class Machine:
    """A module: its agent, what runs beside it, and its user's environment."""

    def __init__(self, home: Path, name: str, group: str) -> None:
        self.home, self.name, self.port = home, name, free_port()
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "RMPA_", "XDG_"))}
        self.environ = kept | {
            "HOME": str(home),
            "RMPA_RUNTIME_DIR": str(home),
            "RMPA_AGENT": name,
            "RMPA_MULTICAST": group,
            "ROS_MASTER_URI": f"http://127.0.0.1:{self.port}",
            "NO_COLOR": "1",
        }
        self.processes: list[Process] = []
        self.agent = self.start(
            *(sys.executable, "-m", "rmpa.cli.main", "up", "--name", name),
            *("--interface", "lo", "--core-port", str(self.port)),
        )
        eventually(lambda: self.rmpa("node", "list"), DEADLINE, what=f"the agent {name}", every=0.2)

    def start(self, *argv: str | Path) -> Process:
        process = Process(argv, env=self.environ)
        self.processes.append(process)
        return process

    def example(self, name: str, *argv: str) -> Process:
        """Run one of the examples."""
        return self.start(sys.executable, "-u", NODES / name, *argv)

    def rmpa(self, *words: str) -> str:
        """Run a command to its end; its output, empty where it fails."""
        command = [sys.executable, "-m", "rmpa.cli.main", *words]
        done = subprocess.run(command, env=self.environ, stdout=subprocess.PIPE, text=True, timeout=40, check=False)
        return done.stdout if done.returncode == 0 else ""

    def ros(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run one of ROS's own tools."""
        env = environment(self.home, self.port)
        return subprocess.run(words, env=env, capture_output=True, text=True, timeout=40, check=False)

    def close(self) -> None:
        while self.processes:
            self.processes.pop().end()


@pytest.fixture(scope="module")
def group() -> str:
    return f"239.255.82.78:{20000 + os.getpid() % 12000}"


@pytest.fixture(scope="module")
def machine(group: str) -> Iterator[Machine]:
    with tempfile.TemporaryDirectory(prefix="rmpa-test-") as home:
        one = Machine(Path(home), "base", group)
        yield one
        one.close()


def test_the_code_of_the_page_is_that_of_the_examples() -> None:
    shown = re.findall(r"`(\w+\.py)`:\n\n```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert sorted(name for name, _ in shown) == sorted({path.name for path in NODES.glob("*.py")} - {"watch_mesh.py"})
    for name, text in shown:
        assert (NODES / name).read_text(encoding="utf-8") == text, name


def test_what_the_page_names_is_there() -> None:
    names = set(re.findall(r"\bnode\.(\w+)", PAGE))
    assert {"rate", "timer", "stopped", "call_service"} <= names
    assert not [name for name in names if not hasattr(rmpa.SyncNode, name)]


def test_the_commands_of_the_page_show_what_it_says(machine: Machine) -> None:
    running = []
    blocks = re.findall(r"^```console\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    steps = [step for block in blocks for step in re.findall(r"^\$ python3 (.*)\n(.*)$", block, re.MULTILINE)]
    assert len(steps) == sum(block.count("$ ") for block in blocks) == 4
    for command, shown in steps:
        running.append((machine.example(*command.split()), shown))
    for process, shown in running:
        process.wait_for(f"^{re.sub(r'[0-9]+', '[0-9]+', re.escape(shown))}$")
    for process, _ in running:
        if process.returncode is None:
            assert process.interrupt() == 0


def test_the_talker_the_listener_and_the_tools(machine: Machine) -> None:
    talker = machine.example("talker.py")
    listener = machine.example("listener.py")
    listener.wait_for(r"^heard: hello \d+$")
    assert 'data: "hello ' in machine.rmpa("topic", "echo", "/chatter", "-n", "1")
    assert "/talker" in machine.rmpa("topic", "info", "/chatter")
    assert "said hello" in machine.rmpa("topic", "echo", "/rosout_agg", "-n", "1")
    for process in (listener, talker):
        assert process.interrupt() == 0
        assert "Traceback" not in process.output
    talker.wait_for(r"^\[INFO\] \[\d+\.\d+\]: said hello 1 times$")
    assert "/chatter" not in machine.rmpa("topic", "list")


def test_the_service_and_its_client(machine: Machine) -> None:
    client = machine.example("add_two_ints_client.py", "2", "3")  # which waits for the service
    server = machine.example("add_two_ints_server.py")
    client.wait_for(r"^2 \+ 3 = 5$")
    assert client.wait() == 0
    server.wait_for(r"^\[INFO\] \[\d+\.\d+\]: 2 \+ 3$")
    assert "sum: 42" in machine.rmpa("service", "call", "/add_two_ints", "{a: 40, b: 2}")
    os.kill(server.pid, signal.SIGTERM)
    assert server.wait() == 0
    assert "/add_two_ints" not in machine.rmpa("service", "list")


@pytest.mark.parametrize("name", ["talker.py", "add_two_ints_server.py"])
def test_without_a_master_the_last_line_says_what_to_do(machine: Machine, name: str) -> None:
    done = subprocess.run(
        [sys.executable, NODES / name],
        env={**machine.environ, "ROS_MASTER_URI": "http://127.0.0.1:1"},
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        timeout=DEADLINE,
    )
    assert done.returncode == 1
    (said,) = re.findall(r"^rmpa\.core\.errors\.UnreachableError: .*$", PAGE, re.MULTILINE)
    assert len(done.stderr.splitlines()) < 25
    assert done.stderr.splitlines()[-1] == said.replace("localhost:11311", "127.0.0.1:1")


@pytest.mark.ros
def test_rospys_nodes_hear_them_and_are_heard(machine: Machine) -> None:
    talker = machine.example("talker.py")
    talker.wait_for("said hello")
    heard = machine.ros("rostopic", "echo", "-n1", "/chatter")
    assert heard.stdout.startswith('data: "hello '), heard
    assert 'name: "/talker"' in machine.ros("rostopic", "echo", "-n1", "/rosout_agg").stdout
    assert "/talker" in machine.ros("rosnode", "list").stdout
    listener = machine.example("listener.py")
    listener.wait_for("^heard: ")
    killed = machine.ros("rosnode", "kill", "/talker")
    assert "killed" in killed.stdout, killed
    assert talker.wait() == 0
    rospy = machine.start("rostopic", "pub", "-r", "20", "/chatter", "std_msgs/String", "data: of rospy")
    listener.wait_for("^heard: of rospy$")
    rospy.end()
    assert listener.interrupt() == 0


@pytest.mark.ros
def test_rospys_clients_and_servers_know_them(machine: Machine) -> None:
    ours = machine.start(sys.executable, "-c", OUR_SERVER)
    eventually(lambda: "/switch" in machine.rmpa("service", "list"), DEADLINE, what="the service", every=0.2)
    called = machine.ros("rosservice", "call", "/switch", "true")
    assert called.stdout == 'success: True\nmessage: "ours"\n', called
    assert ours.interrupt() == 0
    with Process([PYTHON, "-c", ROSPY_SERVER], env=environment(machine.home, machine.port)):
        client = machine.start(sys.executable, "-c", OUR_CLIENT)
        client.wait_for("^of rospy$")
        assert client.wait() == 0


def test_the_watcher_shows_who_comes_and_goes(machine: Machine, group: str) -> None:
    watcher = machine.example("watch_mesh.py")
    with tempfile.TemporaryDirectory(prefix="rmpa-test-") as home:
        arm = Machine(Path(home), "arm", group)
        try:
            watcher.wait_for(r"^\+ module arm$")
            talker = arm.example("talker.py")
            watcher.wait_for(r"^\+ topic /chatter std_msgs/String$")
            listener = machine.example("listener.py")
            listener.wait_for("^heard: hello ")  # as the page says: of another module
            assert listener.interrupt() == 0
            assert talker.interrupt() == 0
            watcher.wait_for("^- topic /chatter$")
        finally:
            arm.close()
    watcher.wait_for("^- module arm ")
    assert watcher.interrupt() == 0
    assert "Traceback" not in watcher.output
