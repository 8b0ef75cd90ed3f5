"""The life of the Debian package on machines that systemd has booted, from its installation to its purge."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import CommandFailed
from tests.packages.machines import Machine, why_no_systemd
from tests.packages.ways import USER, package

pytestmark = [pytest.mark.packages, pytest.mark.timeout(900)]
RATE: Final = 100
# Messages that may be missing after an upgrade: those of a second.
MISSING: Final = RATE
# The agent is as fast as on a machine where nothing else runs: beside other tests its start would take seconds.
ALONE: Final = "[Service]\nCPUSchedulingPolicy=fifo\nCPUSchedulingPriority=1\n"
FOREIGN: Final = (
    "/home",
    "/proc",
    "/root",
    "/run",
    "/srv",
    "/sys",
    "/tmp",
    "/var/cache",
    "/var/lib/dpkg",
    "/var/log",
)


@pytest.fixture(scope="module", params=["bullseye", "bookworm", "trixie"])
def machines(request: pytest.FixtureRequest) -> Iterator[tuple[Machine, Machine]]:
    """A machine to change, and one that listens."""
    if reason := why_no_systemd():
        pytest.skip(reason)
    if package() is None:
        pytest.skip("no package in dist: make deb")
    with Lab() as lab:
        robot, other = lab.hosts("robot", "other")
        with Machine(robot, request.param, systemd=True) as first, Machine(other, "bookworm") as second:
            yield first, second


@pytest.fixture(scope="module")
def newer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package with a higher version."""
    folder = tmp_path_factory.mktemp("newer")
    given = package()
    assert given is not None
    subprocess.run(["ar", "x", given], cwd=folder, check=True)
    members = sorted(path.name for path in folder.iterdir())
    subprocess.run(["dpkg-deb", "--control", given, "control"], cwd=folder, check=True)
    control = folder / "control/control"
    control.write_text(re.sub(r"^Version: .*", r"\g<0>+newer", control.read_text(), flags=re.MULTILINE))
    subprocess.run(["tar", "-C", "control", "-cJf", "control.tar.xz", "."], cwd=folder, check=True)
    target = folder / "newer.deb"
    subprocess.run(["ar", "rcS", target, "debian-binary", *members[:-1]], cwd=folder, check=True)
    return target


def files(machine: Machine) -> set[str]:
    """All files but those of other programs' caches and logs, and of the test itself."""
    found = machine.run("find", "/", "-xdev", timeout=60.0).splitlines()
    return {path for path in found if not path.startswith(FOREIGN) and ("rmpa" in path or "__pycache__" not in path)}


def dpkg(machine: Machine, *words: str) -> str:
    return machine.run("env", "DEBIAN_FRONTEND=noninteractive", "dpkg", *words, timeout=120.0)


def state(machine: Machine, what: str) -> str:
    return machine.run("systemctl", "show", "--value", "-p", what, "rmpa.service").strip()


def test_it_lives_from_installation_to_purge(machines: tuple[Machine, Machine], newer: Path) -> None:
    robot, other = machines
    given = package()
    assert given is not None
    before = files(robot)

    # Nothing starts by itself, and users need no rights to start an agent of their own.
    assert "not started" in dpkg(robot, "-i", robot.put(given))
    assert state(robot, "ActiveState") == "inactive"
    dpkg(other, "-i", other.put(given))
    listening = other.start("rmpa", "up", user=USER)

    # The service; members of its group ask it, others do not.
    drop_in = robot.root / "etc/systemd/system/rmpa.service.d/alone.conf"
    drop_in.parent.mkdir()
    drop_in.write_text(ALONE)
    robot.run("rmpa", "service", "install", "--name", "robot", timeout=60.0)
    listening.wait_for("= robot .*: linked", 60.0)
    with pytest.raises(CommandFailed, match="group rmpa"):
        robot.run("rmpa", "peer", "list", user=USER)
    robot.run("adduser", "--quiet", USER, "rmpa")
    assert "other" in robot.run("rmpa", "peer", "list", user=USER)

    # An upgrade restarts it once: nodes keep running, and are heard again at once.
    robot.run("sh", "-c", "echo '# mine' >>/etc/rmpa/rmpa.toml")
    listener = other.node("rospy", "listener", topic="/count")
    robot.node("rospy", "talker", topic="/count", rate=RATE, count=10**6, size=100, wait=1)
    listener.wait_event("first", 60.0)
    process, listened = state(robot, "MainPID"), len(listener.events("report"))
    dpkg(robot, "-i", robot.put(newer))
    assert state(robot, "ActiveState") == "active"
    assert state(robot, "MainPID") != process
    assert state(robot, "NRestarts") == "0"
    report = listener.wait_event("report", 60.0, since=listener.mark())
    assert len(listener.events("report")) > listened
    print(f"{robot.suite}: {report['gaps']} messages of {RATE} a second are missing after the upgrade")
    assert isinstance(missing := report["gaps"], int)
    assert missing < MISSING

    # A version that refuses the settings does not end the agent that runs.
    process = state(robot, "MainPID")
    robot.run("sed", "-i", "1i port = 1", "/etc/rmpa/rmpa.toml")
    assert "runs on" in dpkg(robot, "-i", robot.put(newer))
    assert state(robot, "MainPID") == process

    # Removal keeps what is the user's, purge does not.
    dpkg(robot, "-r", "rmpa")
    assert state(robot, "ActiveState") == "inactive"
    assert robot.run("tail", "-n", "1", "/etc/rmpa/rmpa.toml").strip() == "# mine"
    assert robot.run("cat", "/var/lib/rmpa/module-name").strip() == "robot"
    dpkg(robot, "-P", "rmpa")
    assert files(robot) - before == set()
    assert "rmpa" not in robot.run("getent", "passwd") + robot.run("getent", "group")
    assert robot.run("find", "/run", "/var/lib", "/etc", "-xdev", "-name", "*rmpa*") == ""


def test_the_service_of_a_bundle_outlives_the_package(machines: tuple[Machine, Machine]) -> None:
    robot, _ = machines
    given = package()
    assert given is not None
    dpkg(robot, "-i", robot.put(given))
    unit = robot.root / "etc/systemd/system/rmpa.service"
    unit.write_text("[Service]\nExecStart=/bin/sleep infinity\nUser=rmpa\nStateDirectory=rmpa\n")
    robot.run("systemctl", "daemon-reload")
    robot.run("systemctl", "start", "rmpa")
    robot.run("sh", "-c", "echo '# mine' >>/etc/rmpa/rmpa.toml")
    assert "is not the package's" in dpkg(robot, "-P", "rmpa")
    assert state(robot, "ActiveState") == "active"
    assert robot.run("tail", "-n", "1", "/etc/rmpa/rmpa.toml").strip() == "# mine"
    assert robot.run("stat", "-c", "%U", "/var/lib/rmpa").strip() == "rmpa"
