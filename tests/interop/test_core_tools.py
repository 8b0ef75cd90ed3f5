"""The stock tools print the same with our core as with a real roscore."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from lab.bed.processes import Process, eventually
from tests.interop.conftest import ShellFactory
from tests.interop.ros import PYTHON, Ros, free_port

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]

RUN: Final = "from rmpa.cli.core import core; core()"
# A core that does not look by itself whether its nodes live.
RUN_WITHOUT_CHECKS: Final = f"from rmpa.ros import limits; limits.NODE_CHECK_INTERVAL = 1e6; {RUN}"
DEADLINE: Final = 40.0
LAUNCH: Final = """<launch>
  <param name="speed" value="1.5"/>
  <rosparam>{gains: {p: 1, i: 0.5}, names: [a, b], enabled: true}</rosparam>
  <group ns="left">
    <node pkg="two_nodes" type="node.py" name="node"><param name="side" value="left"/></node>
  </group>
  <group ns="right">
    <node pkg="two_nodes" type="node.py" name="node"/>
  </group>
</launch>
"""
PACKAGE: Final = """<package><name>two_nodes</name><version>1.0.0</version><description>x</description>
<maintainer email="x@example.org">x</maintainer><license>x</license></package>
"""
NODE: Final = """#!/usr/bin/python3
import rospy
rospy.init_node("node")
rospy.get_param("~side", "")
rospy.spin()
"""


def start_ours(ros: Ros, program: str = RUN) -> Process:
    process = ros.start(sys.executable, "-c", program, "-p", str(ros.port), name="rmpa core")
    process.wait_for("started core service", DEADLINE)
    return process


def start_real(ros: Ros) -> Process:
    process = ros.roscore()
    eventually(lambda: "/rosout_agg" in ros.tool("rostopic", "list"), what="/rosout")
    return process


def normal(text: str) -> list[str]:
    """A tool's lines, without the parts that differ from run to run."""
    text = re.sub(r"\(\d+ - [^)]*\) \[\d+\]", "#", text)
    text = re.sub(r"127\.0\.0\.1:\d+|localhost:\d+", "HOST:PORT", text)
    text = re.sub(r"(?i)pid: \d+|\bport \d+|\[[^ ]*:\d+\]|time=[\d.]+ms|average: [\d.]+ms", "#", text)
    text = re.sub(r"[0-9a-f]{8}-[0-9a-f-]{27}|_\d+_\d+\b|\d{10}\.\d+|(n?secs): \d+", "#", text)
    return [line.rstrip() for line in text.splitlines() if line.strip()]


def both(
    shell: ShellFactory,
    scenario: Callable[[Ros], dict[str, str]],
    start_ours: Callable[[Ros], Process] = start_ours,
) -> None:
    """Play a scenario beside the real core and beside ours; every output must be the same."""
    outputs = []
    for start in (start_real, start_ours):
        with shell(port=free_port()) as ros:
            start(ros)
            outputs.append(scenario(ros))
    theirs, ours = outputs
    assert ours.keys() == theirs.keys()
    for what, text in theirs.items():
        assert normal(ours[what]) == normal(text), what


def test_topics_nodes_and_services(shell: ShellFactory) -> None:
    def scenario(ros: Ros) -> dict[str, str]:
        listener = ros.roscpp("listener", "__name:=listener", topic="/chatter", count=5)
        listener.wait_event("up", DEADLINE)
        talker = ros.rospy("talker", "__name:=talker", topic="/chatter", rate=100, count=5, wait=1)
        listener.wait_event("done", DEADLINE)
        found = {
            " ".join(words): ros.tool(*words, timeout=DEADLINE)
            for words in (
                ("rosnode", "list"),
                ("rosnode", "ping", "-c", "1", "/talker"),
                ("rosnode", "ping", "-c", "1", "/listener"),
                ("rosnode", "machine", "127.0.0.1"),
                ("rostopic", "list"),
                ("rostopic", "list", "-v"),
                ("rostopic", "info", "/chatter"),
                ("rostopic", "type", "/chatter"),
                ("rostopic", "find", "std_msgs/Header"),
                ("rosservice", "list"),
                ("rosservice", "info", "/rosout/get_loggers"),
                ("rosservice", "call", "/rosout/set_logger_level", "ros", "info"),
            )
        }
        # Which others there are is the program's own matter.
        loggers = ros.tool("rosservice", "call", "/rosout/get_loggers")
        found["/rosout's logger"] = re.search(r'name: "ros"\n +level: "\w+"', loggers).group()  # type: ignore[union-attr]
        for node in ("/talker", "/listener"):
            info = ros.tool("rosnode", "info", node)
            found[f"info {node}"] = "\n".join(sorted(info.splitlines()))
        listener.kill()
        talker.terminate()
        eventually(lambda: "/talker" not in ros.tool("rosnode", "list"), what="/talker to unregister")
        return found

    both(shell, scenario)


def _find(ros: Ros, *wanted: str) -> str:
    """Those of the wanted services that ``rosservice find`` finds; empty while one is missing."""
    names = ros.tool("rosservice", "find", "roscpp/SetLoggerLevel").split()
    return "\n".join(wanted) if set(wanted) <= set(names) else ""


@pytest.mark.trap(23, 26)
@pytest.mark.parametrize("library", ["rospy", "roscpp"])
def test_services(shell: ShellFactory, library: str) -> None:
    def scenario(ros: Ros) -> dict[str, str]:
        node = ros.node(library, "listener", "__name:=server", topic="/chatter")
        node.wait_event("up", DEADLINE)
        logger = "ros" if library == "roscpp" else "rosout"
        wait = "import sys, rospy; rospy.wait_for_service(sys.argv[1], 10); print('there')"
        found = {
            " ".join(words[1:]): ros.tool(*words, timeout=DEADLINE)
            for words in (
                ("rosservice", "info", "/server/get_loggers"),
                ("rosservice", "type", "/server/get_loggers"),
                ("rosservice", "args", "/server/set_logger_level"),
                ("rosservice", "node", "/server/set_logger_level"),
                ("rosservice", "uri", "/server/set_logger_level"),
                ("rosservice", "call", "/server/get_loggers"),
                (PYTHON, "-c", wait, "/server/get_loggers"),
                ("rosservice", "call", "/server/set_logger_level", logger, "warn"),
            )
            # roscpp now and then hangs itself when its level is set: it logs what its logging does.
            if library == "rospy" or words[2] != "/server/set_logger_level" or words[1] != "call"
        }
        # Which others there are depends on what roscpp has logged until then.
        loggers = re.findall(r'name: "?([\w.]+)"?', found["call /server/get_loggers"])
        found["call /server/get_loggers"] = f"{logger} among them: {logger in loggers}"
        # It leaves out a service whose server does not answer its probe at once, and a busy roscpp may not.
        wanted = ["/rosout/set_logger_level", *(["/server/set_logger_level"] if library == "rospy" else [])]
        found["find"] = eventually(lambda: _find(ros, *wanted), what="the services among those found")
        node.terminate()
        gone = ros.start("rosservice", "call", "/nobody/get_loggers", name="rosservice call")
        found["unknown"] = f"{gone.wait(DEADLINE)} {gone.output}"
        return found

    both(shell, scenario)


def test_cleanup_of_a_node_that_was_killed(shell: ShellFactory) -> None:
    def scenario(ros: Ros) -> dict[str, str]:
        victim = ros.rospy("talker", "__name:=victim", topic="/chatter", rate=10, count=0)
        ros.roscpp("listener", "__name:=listener", topic="/chatter").wait_event("first", DEADLINE)
        victim.kill()
        before = ros.tool("rosnode", "list")
        cleanup = ros.start("rosnode", "cleanup", name="cleanup", commands=True)
        cleanup.tell("y")
        assert cleanup.wait(DEADLINE) == 0
        after = {words: ros.tool(*words.split()) for words in ("rosnode list", "rostopic info /chatter")}
        return {"before": before, "cleanup": cleanup.output, **after}

    both(shell, scenario, lambda ros: start_ours(ros, RUN_WITHOUT_CHECKS))


def test_parameters(shell: ShellFactory, tmp_path: Path) -> None:
    source = tmp_path / "in.yaml"
    source.write_text("a: {b: 1, c: [1, two, 3.5], d: {}}\nt: 'text <&> ü'\n", encoding="utf-8")

    def scenario(ros: Ros) -> dict[str, str]:
        def param(*words: str) -> str:
            return ros.tool("rosparam", *words)

        found = {
            "set": param("set", "/x/y", "{z: 1.5, w: true}"),
            "get": param("get", "/x"),
            "load": param("load", str(source), "/loaded"),
            "get loaded": param("get", "/loaded"),
            "list": param("list", "/loaded"),
            "delete": param("delete", "/x/y/z"),
            "dump": param("dump", str(ros.home / "dump.yaml"), "/"),
        }
        found["dumped"] = (ros.home / "dump.yaml").read_text("utf-8")
        variable = r"(?s)^roslaunch:.*?(?=^\w)|^run_id:.*?\n|^ros(?:distro|version): .*?'\n"
        found["dumped"] = re.sub(variable, "", found["dumped"], flags=re.MULTILINE)
        return found

    both(shell, scenario)


def test_launch(shell: ShellFactory, tmp_path: Path) -> None:
    package = tmp_path / "two_nodes"
    package.mkdir()
    (package / "package.xml").write_text(PACKAGE)
    (package / "node.py").write_text(NODE)
    (package / "node.py").chmod(0o755)
    (package / "two.launch").write_text(LAUNCH)
    env = {"ROS_PACKAGE_PATH": f"{tmp_path}:/usr/share"}

    def scenario(ros: Ros) -> dict[str, str]:
        process = ros.start("roslaunch", "two_nodes", "two.launch", name="roslaunch", env=env)
        process.wait_for(r"process\[right/node", DEADLINE)
        eventually(
            lambda: {"/left/node", "/right/node"} <= set(ros.tool("rosnode", "list").split()), DEADLINE, what="nodes"
        )
        found = {
            "nodes": ros.tool("rosnode", "list"),
            "gains": ros.tool("rosparam", "get", "/gains"),
            "private": ros.tool("rosparam", "get", "/left/node/side"),
        }
        process.interrupt(DEADLINE)
        eventually(lambda: "/node" not in ros.tool("rosnode", "list"), DEADLINE, what="the nodes' end")
        assert "started core service" not in process.output, "it must take our /rosout for the real one"
        return found

    both(shell, scenario)


def test_pub_echo_and_bag(shell: ShellFactory) -> None:
    def scenario(ros: Ros) -> dict[str, str]:
        words = ("record", "-l", "3", "-O", str(ros.home / "b.bag"), "/t", "__name:=record")
        record = ros.start("rosbag", *words, name="rosbag")  # it ends when it has three messages
        eventually(lambda: "/record" in ros.tool("rosnode", "list"), DEADLINE, what="rosbag")
        echo = ros.start("rostopic", "echo", "-n", "1", "/t", name="echo")
        pub = ros.start("rostopic", "pub", "-r", "20", "/t", "std_msgs/String", "data: hello", name="pub")
        assert echo.wait(DEADLINE) == 0
        assert record.wait(DEADLINE) == 0
        pub.interrupt(DEADLINE)
        info = ros.tool("rosbag", "info", "-y", "-k", "topics", str(ros.home / "b.bag"))
        heard = "\n".join(line for line in echo.output.splitlines() if not line.startswith("WARNING"))
        return {"echo": heard, "bag": re.sub(r"(messages|frequency): [\d.]+", "", info)}

    both(shell, scenario)


def test_wtf_finds_nothing_about_the_core(shell: ShellFactory) -> None:
    with shell(port=free_port()) as ros:
        start_ours(ros)
        talker = ros.roscpp("talker", topic="/chatter", rate=10, count=0)
        eventually(lambda: "/chatter" in ros.tool("rostopic", "list"), DEADLINE, what="the talker")
        output = ros.tool("roswtf", timeout=DEADLINE)
        talker.terminate()
    assert "No errors or warnings" in output.partition("Online checks summary")[2], output
