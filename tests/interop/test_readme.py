"""The README's two robots in five lines, word for word, on two hosts; ``make demo`` is run by ``tests/examples``."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from lab.bed.agents import RMPA, Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import Process
from tests.interop.conftest import AgentFactory, ShellFactory
from tests.packages.tutorial import steps

ROOT: Final = Path(__file__).parents[2]
README: Final = (ROOT / "README.md").read_text(encoding="utf-8")
ROBOTS: Final = ("robot1", "robot2")
LINES: Final = steps(README.partition("## Two robots in five lines")[2].partition("\n## ")[0], ROBOTS)


@pytest.fixture
def robots(lab: Lab, agent: AgentFactory) -> dict[str, Agent]:
    """The two robots, as the first two lines start them."""
    assert [(step.machines, step.command) for step in LINES[:2]] == [
        ((name,), f"rmpa up --name {name}") for name in ROBOTS
    ]
    both = {host.name: agent(host, name=host.name) for host in lab.hosts(*ROBOTS)}
    both["robot1"].wait_peer("robot2")
    return both


@pytest.mark.netns
@pytest.mark.timeout(120)
def test_the_five_lines(robots: dict[str, Agent]) -> None:
    assert len(LINES) == 5
    look, talk, hear = (
        Process(
            robots[step.machines[0]].host.command(["sh", "-c", f"exec {RMPA.parent}/{step.command}"]),
            env=robots[step.machines[0]].env,
        )
        for step in LINES[2:]
    )
    with look, talk, hear:
        look.wait_for("robot2 +linked")
        hear.wait_for('data: "hello"')


@pytest.mark.ros
@pytest.mark.netns
@pytest.mark.timeout(120)
def test_rostopic_does_the_same(robots: dict[str, Agent], shell: ShellFactory) -> None:
    shell(robots["robot1"].host).start("rostopic", "pub", "-r", "10", "/chatter", "std_msgs/String", "hello")
    shell(robots["robot2"].host).start("rostopic", "echo", "/chatter").wait_for('data: "hello"')


def test_it_is_short_and_its_figure_is_that_of_the_committed_numbers() -> None:
    assert len(README.splitlines()) <= 120
    assert len(README.split()) <= 1000
    subprocess.run([sys.executable, ROOT / "scripts/draw-measured", "--check"], check=True)
