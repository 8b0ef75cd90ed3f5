"""docs/start/two-robots.md, followed to the letter and timed: on two hosts of this machine, and on new Debians."""

from __future__ import annotations

import json
import os
import re
import ssl
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from http.client import HTTPSConnection
from pathlib import Path
from typing import Final, Protocol

import pytest

from lab.bed.namespaces import Host, Lab
from lab.bed.processes import CommandFailed, Process, eventually, run
from tests.packages import machines
from tests.packages.machines import CLONE, Machine
from tests.packages.tutorial import COPYING, Step, reading_minutes, shows, steps
from tests.packages.ways import USER, package, wheel

PAGE: Final = (CLONE / "docs/start/two-robots.md").read_text(encoding="utf-8")
ROBOTS: Final = ("robot1", "robot2")
# That the page promises, for reading, typing and what the machines take.
MINUTES: Final = 15.0
# Commands that keep their terminal until Ctrl-C.
_STAYS: Final = re.compile(r"rmpa (up|trust invite|topic (pub|echo))\b")
# In a terminal an invitation is a whole command, in a pipe the token alone.
_SECRET: Final = re.compile(r"(?:rmpa trust join )?rmpa1-\w+|\?token=\S+")
_ONLINE: Final = re.compile(r"sudo apt |sudo /opt/rmpa/bin/pip ")
_OF_PACKAGE: Final = re.compile(r"sudo apt install \./rmpa_")
_OF_PIP: Final = re.compile(r"sudo apt install python3-venv|.* /opt/rmpa\b")


class Robot(Protocol):
    """A computer of the page, with as many terminals as are needed."""

    @property
    def host(self) -> Host:
        """Its network."""

    def words(self, command: str) -> list[str] | None:
        """The command line for a command of the page; ``None`` where it is not for this one."""

    def environment(self) -> dict[str, str] | None:
        """Of its commands."""


class Bare:
    """A host that has this clone's ``rmpa`` as a user's, and neither systemd nor a file system of its own."""

    def __init__(self, host: Host, home: Path) -> None:
        self.host, self.home = host, home / host.name
        self.home.mkdir()

    def words(self, command: str) -> list[str] | None:
        if _OF_PACKAGE.match(command) or _OF_PIP.match(command):
            return None
        if re.match(r"sudo usermod|sudo journalctl|rmpa service status", command):
            return None
        command = re.sub(r"\bsudo ", "", command).replace("/etc/rmpa", f"{self.home}/.config/rmpa")
        command = re.sub(r"rmpa service install(.*)", r"rmpa up\1", command)  # what the units run
        named = f"hostname {self.host.name} && cd {self.home} && {command}"
        return self.host.command(["unshare", "--uts", "sh", "-c", named])

    def environment(self) -> dict[str, str]:
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "RMPA_", "XDG_"))}
        path = f"{Path(sys.executable).parent}:{kept['PATH']}"
        return kept | {"HOME": str(self.home), "PATH": path, "RMPA_RUNTIME_DIR": str(self.home)}


class New:
    """A Debian of a release with systemd and the files of a release in the home of its user."""

    def __init__(self, machine: Machine, product: Path, other: re.Pattern[str]) -> None:
        self.machine, self.host, self._other = machine, machine.host, other
        machine.put(product, USER)

    def words(self, command: str) -> list[str] | None:
        if self._other.match(command):
            return None
        online = _ONLINE.match(command) is not None
        command = command.replace("apt install", "apt install -y")  # there is nobody to ask
        return self.machine.command("bash", "-c", command, user=USER, env={"USER": USER}, online=online)

    def environment(self) -> None:
        return None


class Reader:
    """Does what the page says, and looks at what it shows."""

    def __init__(self, robots: dict[str, Robot], laptop: Host) -> None:
        self.robots, self.laptop = robots, laptop
        self.running: list[tuple[str, str, Process]] = []
        self.token, self.page, self.typed = "", "", 0

    def follow(self, all_steps: list[Step]) -> float:
        """Follow all steps; return the seconds that the machines took."""
        begun = time.monotonic()
        for step in all_steps:
            since = time.monotonic()
            if step.hand:
                getattr(self, step.command.replace("-", "_"))(step.shown)
            for name in step.machines:
                self.type(name, step.command, step.shown)
            print(f"{time.monotonic() - since:6.1f} s  {', '.join(step.machines)}  {step.command}", flush=True)
        return time.monotonic() - begun

    def type(self, name: str, command: str, shown: str) -> None:
        robot = self.robots[name]
        if "journalctl" in command and isinstance(robot, Bare):
            return self._see(lambda: self._said(name, "rmpa up"), command, shown)
        words = robot.words(re.sub(r"rmpa1-\S+", self.token, command))
        if words is None:
            return None
        self.typed += 1
        if (boot := isinstance(robot, Bare) and "service install" in command) or _STAYS.match(command):
            command = "rmpa up" if boot else command
            process = Process(words, env=robot.environment(), name=f"{command}@{name}")
            self.running.append((name, command, process))
            if command.startswith("rmpa up"):
                eventually(lambda: self._answers(robot), what=f"the agent of {name}")
            return self._see(lambda: self._said(name, command), command, shown)
        if not shown:
            print(run(words, env=robot.environment(), timeout=300.0))
            return None
        return self._see(lambda: self._output(robot, words), command, shown)

    def ctrl_c(self, beginning: str) -> None:
        """Press it in the terminals of commands that begin so."""
        for entry in [entry for entry in reversed(self.running) if entry[1].startswith(beginning)]:
            self.running.remove(entry)
            entry[2].interrupt()

    def cable(self, what: str) -> None:
        """Pull a cable out, or put it in."""
        name, way = what.split()
        host = self.robots[name].host
        host.cut() if way == "out" else host.restore()

    def browser(self, _: str) -> None:
        """Open the page from the laptop."""
        host, _, path = self.page.removeprefix("https://").partition("/")
        name, _, port = host.partition(":")
        address = self.robots[name].host.address if name in self.robots else name
        wire = self.laptop.open_socket()
        wire.settimeout(20.0)
        wire.connect((address, int(port)))
        connection = HTTPSConnection(address, int(port))
        connection.sock = ssl._create_unverified_context().wrap_socket(wire)
        connection.request("GET", f"/{path}")
        answer = connection.getresponse()
        answer.read()
        cookie = (answer.headers["Set-Cookie"] or "").partition(";")[0]
        connection.request("GET", "/api/v1/peers", headers={"Cookie": cookie})
        peers = json.load(connection.getresponse())
        assert [(peer["name"], peer["state"]) for peer in peers] == [("robot2", "linked")]
        connection.close()

    def close(self) -> None:
        while self.running:
            self.running.pop()[2].end()

    def _said(self, name: str, command: str) -> str:
        return next(process.output for *what, process in reversed(self.running) if what == [name, command])

    @staticmethod
    def _output(robot: Robot, words: list[str]) -> str:
        with Process(words, env=robot.environment()) as process:
            process.wait()
            return process.output

    def _answers(self, robot: Robot) -> bool:
        words = robot.words("rmpa peer list")
        assert words is not None
        try:
            run(words, env=robot.environment())
        except CommandFailed:
            return False
        return True

    def _see(self, output: Callable[[], str], command: str, shown: str) -> None:
        seen = ""

        def looks() -> bool:
            nonlocal seen
            seen = output()
            return shows(_SECRET.sub(lambda found: self._keep(found[0], seen), seen), shown)

        try:
            eventually(looks, every=0.3)
        except Exception:
            print(f"{command}\n--- is to show\n{shown}--- has shown\n{seen}")
            raise

    def _keep(self, secret: str, line: str) -> str:
        """Keep a secret that is shown, as the reader copies it; return what the page has in its place."""
        if "rmpa1-" in secret:
            self.token = secret.rpartition(" ")[2]
            return "rmpa trust join rmpa1-afvqqypub"
        self.page = next(word for word in line.split() if word.endswith(secret))
        return "?token=kH0"


def follow(robots: dict[str, Robot], laptop: Host) -> None:
    """Follow the page with all that belongs to it; fail if it takes longer than it promises."""
    reader = Reader(robots, laptop)
    try:
        machine = reader.follow(steps(PAGE, ROBOTS)) / 60
    finally:
        reader.close()
    reading, copying = reading_minutes(PAGE), reader.typed * COPYING / 60
    print(f"minutes: {machine:.1f} the machines, {reading:.1f} reading, {copying:.1f} for {reader.typed} commands")
    assert machine + reading + copying <= MINUTES


@pytest.mark.netns
@pytest.mark.timeout(240)
def test_the_page_on_two_hosts(tmp_path: Path) -> None:
    with Lab() as lab:
        robots: dict[str, Robot] = {name: Bare(lab.host(name, 0), tmp_path) for name in ROBOTS}
        follow(robots, lab.host("laptop", 0))


@pytest.mark.packages
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("suite", "product", "other"),
    [("bullseye", package, _OF_PIP), ("bookworm", wheel, _OF_PACKAGE)],
    ids=["package-debian-11", "pip-debian-12"],
)
def test_the_page_on_new_machines(suite: str, product: Callable[[], Path | None], other: re.Pattern[str]) -> None:
    if (file := product()) is None:
        pytest.skip("nothing in dist to install: make deb, make wheel")
    if reason := machines.why_no_systemd():
        pytest.skip(reason)
    with ExitStack() as stack:
        lab = stack.enter_context(Lab())
        hosts = lab.hosts(*ROBOTS)
        new = [stack.enter_context(Machine(host, suite, systemd=True)) for host in hosts]
        robots: dict[str, Robot] = {one.host.name: New(one, file, other) for one in new}
        follow(robots, lab.host("laptop", 0))
