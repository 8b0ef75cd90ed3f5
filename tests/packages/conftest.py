"""Machines with RMPA installed by one of the ways, and the table of how long each way took."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import pytest

from lab import results
from lab.bed import namespaces
from lab.bed.namespaces import Lab
from tests.packages import machines
from tests.packages.machines import Machine
from tests.packages.ways import USER, WAYS, Way

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.processes import Process

LINKED: Final = r"= {} .*: linked"
"""What an agent says of a peer that it has a link to."""
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
            terminalreporter.line(f"{name:8}" + "".join(f"{what} {took:6.1f}   " for what, took in row.items()))
        terminalreporter.line(f"written: {results.write('packages', {}, {'seconds': rows})}")


@dataclass(frozen=True)
class Team:
    """Machines of different releases with RMPA installed by one way, linked, of which a message has come."""

    way: Way
    machines: list[Machine]
    program: str
    agents: list[Process]
    seconds: float

    def rmpa(self, machine: Machine, *words: str) -> str:
        """What a command of rmpa says on a machine."""
        return machine.run(self.program, *words, user=USER, env=self.way.env)


@pytest.fixture(scope="module", params=WAYS, ids=lambda way: way.name)
def team(request: pytest.FixtureRequest) -> Iterator[Team]:
    """A team; the clock runs from the first command that installs to the first message at the other machine."""
    way: Way = request.param
    if (product := way.product()) is None:
        pytest.skip(f"nothing in dist to install by this way: {way.made_by}")
    namespaces.remove_stale()
    with ExitStack() as stack:
        lab = stack.enter_context(Lab())
        hosts = lab.hosts(*way.suites)
        made = [stack.enter_context(Machine(host, suite)) for host, suite in zip(hosts, way.suites, strict=True)]
        files = [machine.put(product, "root" if way.name == "deb" else USER) for machine in made]
        took = {}
        begun = last = time.monotonic()
        program = ""
        for machine, file in zip(made[:2], files, strict=False):
            program = way.install(machine, file)
            took[machine.suite], last = time.monotonic() - last, time.monotonic()
        agents = [machine.start(program, "up", user=USER, env=way.env) for machine in made[:2]]
        for agent in agents:
            agent.wait_for("ROS_MASTER_URI=", _UP)
        made[0].start("rostopic", "pub", "-r", "10", "/hello", "std_msgs/String", "hello", user=USER)
        made[1].start("rostopic", "echo", "/hello", user=USER).wait_for("data: .*hello", _UP)
        seconds = time.monotonic() - begun
        request.config.stash[_seconds][way.name] = {**took, "message": time.monotonic() - last, "all": seconds}
        for machine, file in zip(made[2:], files[2:], strict=True):
            way.install(machine, file)
            agents.append(machine.start(program, "up", user=USER, env=way.env))
            agents[-1].wait_for("ROS_MASTER_URI=", _UP)
        for agent in agents:
            for other in hosts:
                if agent.name != f"rmpa@{other.name}":
                    agent.wait_for(LINKED.format(other.name), _UP)
        yield Team(way, made, program, agents, seconds)


def around(team: Team) -> list[tuple[Machine, Machine]]:
    """Each machine with the next one, and the last with the first."""
    return [*pairwise(team.machines), (team.machines[-1], team.machines[0])]
