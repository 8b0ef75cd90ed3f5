"""The short form, which CI runs: a package made in seconds, on a new machine of this one's release, and a clone.

Its interpreter is the system's own, and it is hardly compressed; ``make test-packages`` has the ones that users get.
"""

from __future__ import annotations

import platform
import shutil
import subprocess
from pathlib import Path

import pytest

from lab.bed.agents import Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import BedError
from tests.interop.modules import whole
from tests.interop.ros import Ros
from tests.packages.machines import Machine, chroot
from tests.packages.ways import DIST, USER, install_package, purge

pytestmark = [pytest.mark.packages, pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(600)]


def why_not() -> str:
    """Why the short form cannot be built here, or an empty string."""
    if platform.freedesktop_os_release()["ID"] != "debian":
        return "the short form needs Debian: its interpreter is the system's"
    if not shutil.which("dpkg-deb"):
        return "there is no dpkg-deb"
    new = ["/usr/bin/python3", "-c", "import sys; sys.exit(sys.version_info < (3, 11))"]
    if not shutil.which(new[0]) or subprocess.run(new, check=False).returncode:
        return "the short form needs a /usr/bin/python3 of 3.11 or later: its interpreter is the system's"
    return ""


def test_a_new_machine_gets_the_package_and_hears_a_clone(tmp_path: Path) -> None:
    if reason := why_not():
        pytest.skip(reason)
    suite = platform.freedesktop_os_release()["VERSION_CODENAME"]
    arch = subprocess.check_output(["dpkg", "--print-architecture"], text=True).strip()
    try:
        chroot(suite, arch, "rospy")
    except BedError as error:
        pytest.skip(str(error))
    package = next((DIST / "short").glob(f"*_{arch}.deb"), None)
    assert package is not None, "make short-package has made none"
    with Lab() as lab, Machine(lab.host("robot", 0), suite, arch, "rospy") as robot:
        desk = lab.host("desk", 0)
        with Agent(desk, tmp_path, name="desk") as agent, Ros(desk, tmp_path) as ros:
            agent.start()
            program = install_package(robot, robot.put(package))
            up = robot.start(program, "up", user=USER)
            agent.wait_ready()
            agent.wait_peer("robot", 60.0)
            heard = [
                robot.node("rospy", "listener", topic="/to_robot", count=50),
                ros.roscpp("listener", topic="/to_desk", count=50),
            ]
            ros.roscpp("talker", topic="/to_robot", rate=50, count=50, wait=1)
            robot.node("rospy", "talker", topic="/to_desk", rate=50, count=50, wait=1)
            for listener in heard:
                whole(listener.wait_event("done", 60.0), 50)
            assert "/to_robot" in robot.run("rostopic", "list").split()
            assert "desk" in robot.run("rmpa", "peer", "list", user=USER)
            up.interrupt()
        assert purge(robot) == []
