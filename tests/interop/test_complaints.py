"""What users of other bridges complain about does not happen here: cases that no other test has.

docs/design/complaints.md has the rows, by the numbers of the marks, and the tests of each, here and elsewhere.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest

from lab.bed.namespaces import Host, Lab
from lab.bed.processes import CommandFailed, eventually
from rmpa.mesh.limits import SILENT_GRACE
from tests.interop.conftest import AgentFactory, ModuleFactory, ShellFactory
from tests.interop.modules import Module, flows
from tests.interop.ros import PYTHON

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

ROBOTS: Final = 7
# Seconds over which the processor time of agents at rest is counted.
REST: Final = 4.0


@contextmanager
def names_known_at_home_only(hosts: Sequence[Host]) -> Iterator[None]:
    """Let each host, and only itself, know its own name (``ip netns exec`` lays such files over /etc)."""
    folders = [Path("/etc/netns") / host.namespace for host in hosts]
    made = not folders[0].parent.exists()
    try:
        for host, folder in zip(hosts, folders, strict=True):
            folder.mkdir(parents=True)
            (folder / "hosts").write_text(f"127.0.0.1 localhost\n{host.address} {host.name}-robot\n")
        yield
    finally:
        for folder in folders:
            shutil.rmtree(folder, ignore_errors=True)
        if made:
            folders[0].parent.rmdir()


READ_BAG = """
import sys, rosbag
from std_msgs.msg import UInt8MultiArray
with rosbag.Bag(sys.argv[1]) as bag:
    (connection,) = bag._get_connections()
    print("definition", connection.msg_def == UInt8MultiArray._full_text, connection.datatype, connection.md5sum)
    print("sequences", [int.from_bytes(message.data[4:8], "little") for _, message, _ in bag.read_messages()])
"""


@pytest.mark.complaint(1, 19, 20)
def test_local_host_names_work_and_a_bag_has_the_first_message(
    lab: Lab, agent: AgentFactory, shell: ShellFactory
) -> None:
    hosts = lab.hosts("a", "b")
    with names_known_at_home_only(hosts):
        a, b = (Module(host, agent(host, name=host.name), shell(host)) for host in hosts)
        for module in (a, b):  # as Debian's users have it: no ROS_IP, but the machine's own name
            del module.ros.env["ROS_IP"]
            module.ros.env["ROS_HOSTNAME"] = f"{module.host.name}-robot"
        a.agent.wait_peer("b")
        with pytest.raises(CommandFailed):
            b.ros.tool("getent", "hosts", "a-robot")
        bag = b.ros.home / "it.bag"
        record = b.ros.start("rosbag", "record", "-O", bag, "-l", "30", "/chatter", name="record")
        b.wait_topic("/chatter")  # the recorder listens
        a.ros.rospy("talker", topic="/chatter", rate=100, wait=1)
        assert record.wait(30.0) == 0, record.output
        said = b.ros.tool(PYTHON, "-c", READ_BAG, str(bag))
    assert "definition True std_msgs/UInt8MultiArray 82373f1612381bb6ee473b5cd6f5d89c" in said
    assert f"sequences {list(range(1, 31))}" in said


@pytest.mark.complaint(7)
def test_a_bad_link_keeps_the_peer_and_a_lost_one_comes_back(modules: ModuleFactory) -> None:
    a, b = modules("a", "b")
    a.ros.roscpp("talker", topic="/chatter", rate=100)
    heard = b.ros.rospy("listener", topic="/chatter")
    flows(heard)
    for _ in range(5):
        b.host.shape("8bit", burst="100", latency="1ms")  # nothing that b sends arrives
        time.sleep(0.4)
        b.host.unshape()
        flows(heard, 30)
    assert b.agent.peers()["a"]["state"] == "linked"
    assert "= - publisher /chatter" not in b.agent.process.output, "it came and went"
    for _ in range(2):
        b.host.outage(SILENT_GRACE + 3.0)
        flows(heard, 30)  # by the same listener: nothing was restarted
    assert "= - publisher /chatter" in b.agent.process.output
    assert list(b.agent.peers()) == ["a"]


@pytest.mark.complaint(10, 13, 14)
def test_seven_identical_robots_share_topics_and_idle_cheaply(modules: ModuleFactory) -> None:
    robots = modules(*(f"r{number}" for number in range(1, ROBOTS + 1)), linked=False, log_level="info")
    for robot in robots:
        _linked_with_all(robot)
    # At rest: with nothing to do, an agent does nothing.
    before = [_cpu(robot) for robot in robots]
    time.sleep(REST)
    used = [(_cpu(robot) - earlier) / REST for robot, earlier in zip(robots, before, strict=True)]
    assert max(used) < 0.05, used

    # Every robot has the same two nodes, and all speak on one topic.
    ears = [robot.ros.roscpp("listener", "__name:=ears", topic="/tf") for robot in robots]
    mouths = [
        robot.ros.roscpp("talker", "__name:=mouth", topic="/tf", rate=20, source=number)
        for number, robot in enumerate(robots, start=1)
    ]
    everybody = {str(number) for number in range(1, ROBOTS + 1)}
    for ear in ears:
        report = ear.wait_event("report", where=lambda event: _least(event["sources"], everybody) >= 20)
        assert (report["bad"], report["gaps"], report["doubled"]) == (0, 0, 0)
    assert all(node.returncode is None for node in (*ears, *mouths)), "nodes of one name pushed each other out"
    nodes = robots[0].ros.tool("rosnode", "list").split()
    assert {"/mouth", *(f"/rmpa/{robot.name}/mouth" for robot in robots[1:])} <= set(nodes)
    # One copy for each peer: a second listener on a robot changes nothing for the speaker.
    more = robots[1].ros.roscpp("listener", "__name:=more", topic="/tf")
    more.wait_event("report", where=lambda event: _least(event["sources"], everybody) >= 20)

    def connections() -> int:
        return len(re.findall(r"topic: /tf\n\s+\* to: ", robots[0].ros.tool("rosnode", "info", "/mouth")))

    # Its own robot's listener, and its agent: a joining subscriber has a connection of its own for a short time.
    eventually(lambda: connections() == 2, what="one copy for each peer")


def _linked_with_all(robot: Module) -> None:
    """Wait until a robot has a link to each other one."""

    def linked() -> bool:
        return sum(row["state"] == "linked" for row in robot.agent.peers().values()) == ROBOTS - 1

    eventually(linked, what=f"{robot.name} linked with all")


def _cpu(robot: Module) -> float:
    """Seconds of processor time that a robot's agent has used."""
    fields = Path(f"/proc/{robot.agent.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _least(sources: object, wanted: set[str]) -> int:
    """The fewest messages that came of any of these."""
    assert isinstance(sources, dict)
    return min((int(sources[one]["count"]) if one in sources else 0) for one in wanted)
