"""Machines with RMPA installed by one of the ways, and the table of how long each way took."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import pytest

from lab import results
from lab.bed import namespaces
from lab.bed.namespaces import Lab
from lab.bed.processes import Process
from tests.packages import machines
from tests.packages.machines import Machine
from tests.packages.ways import USER, WAYS, Way, install_package

# What an agent says of a peer that it has a link to.
LINKED: Final = r"= {} .*: linked"
_UP: Final = 60.0
_seconds = pytest.StashKey[dict[str, dict[str, float]]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_seconds] = {}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip these tests where there can be no such machines."""
    ours = [item for item in items if item.get_closest_marker("packages")]
    if ours and (reason := machines.why_not()):
        for item in ours:
            item.add_marker(pytest.mark.skip(reason=reason))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Show the seconds of each way, and write them to lab/results."""
    if rows := config.stash[_seconds]:
        terminalreporter.section("seconds from nothing to the first message between two machines", sep="-")
        for name, row in rows.items():
            terminalreporter.line(f"{name:16}" + "".join(f"{what} {took:6.1f}   " for what, took in row.items()))
        terminalreporter.line(f"written: {results.write('packages', {}, {'seconds': rows})}")


@dataclass(frozen=True)
class Team:
    """Machines of different releases with RMPA installed by one way, linked, of which a message has come."""

    way: Way
    machines: list[Machine]
    programs: dict[Machine, str] = field(default_factory=dict)
    # What shows an agent's log: its terminal, or the journal.
    agents: dict[Machine, Process] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def install(self, machine: Machine, file: str) -> None:
        """Install RMPA on a machine."""
        begun = time.monotonic()
        self.programs[machine] = self.way.install(machine, file)
        self.seconds[machine.suite] = time.monotonic() - begun

    def up(self, machine: Machine) -> None:
        """Start its agent."""
        program = self.programs[machine]
        if self.way.boot:
            machine.run("sudo", program, "service", "install", user=USER, env=self.way.env, timeout=_UP)
            machine.run("usermod", "--append", "--groups", "rmpa", USER)
            self.agents[machine] = machine.start("journalctl", "--follow", "--lines=1000", "--unit=rmpa")
        else:
            self.agents[machine] = machine.start(program, "up", user=USER, env=self.way.env)

    def down(self, machine: Machine) -> None:
        """End its agent, in order."""
        if self.way.boot:
            machine.run("systemctl", "stop", "rmpa")
        else:
            self.agents[machine].interrupt()

    def rmpa(self, machine: Machine, *words: str) -> str:
        """What a command of rmpa says on a machine."""
        return machine.run(self.programs[machine], *words, user=USER, env=self.way.env)


@pytest.fixture(scope="module", params=WAYS, ids=lambda way: way.name.replace(" ", "-"))
def team(request: pytest.FixtureRequest) -> Iterator[Team]:
    """A team; the clock runs from the first command that installs to the first message at the other machine."""
    way: Way = request.param
    if (product := way.product()) is None:
        pytest.skip(f"nothing in dist to install by this way: {way.made_by}")
    if way.boot and (reason := machines.why_no_systemd()):
        pytest.skip(reason)
    namespaces.remove_stale()
    with ExitStack() as stack:
        lab = stack.enter_context(Lab())
        hosts = lab.hosts(*way.suites)
        pairs = zip(hosts, way.suites, strict=True)
        made = Team(way, [stack.enter_context(Machine(host, suite, systemd=way.boot)) for host, suite in pairs])
        owner = "root" if way.install is install_package else USER
        files = {machine: machine.put(product, owner) for machine in made.machines}
        begun = time.monotonic()
        first, second = made.machines[:2]
        for machine in (first, second):
            made.install(machine, files[machine])
        installed = time.monotonic()
        for machine in (first, second):
            made.up(machine)
        for machine in (first, second):
            made.agents[machine].wait_for("ROS_MASTER_URI=", _UP)
        first.start("rostopic", "pub", "-r", "10", "/hello", "std_msgs/String", "hello", user=USER)
        second.start("rostopic", "echo", "/hello", user=USER).wait_for("data: .*hello", _UP)
        made.seconds.update(message=time.monotonic() - installed, all=time.monotonic() - begun)
        request.config.stash[_seconds][way.name] = dict(made.seconds)
        for machine in made.machines[2:]:
            made.install(machine, files[machine])
            made.up(machine)
        for machine, agent in made.agents.items():
            for other in made.machines:
                if other is not machine:
                    agent.wait_for(LINKED.format(other.host.name), _UP)
        yield made


def around(team: Team) -> list[tuple[Machine, Machine]]:
    """Each machine with the next one, and the last with the first."""
    return [*pairwise(team.machines), (team.machines[-1], team.machines[0])]
