"""The README's five minutes, word for word, on two hosts; ``make demo`` is run by ``tests/examples``."""

from __future__ import annotations

import re
import shlex
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from lab.bed.agents import RMPA
from lab.bed.processes import Process

if TYPE_CHECKING:
    from lab.bed.agents import Agent
    from lab.bed.namespaces import Lab
    from tests.interop.conftest import AgentFactory, ShellFactory

pytestmark = [pytest.mark.netns, pytest.mark.timeout(120)]

README: Final = Path(__file__).parents[2] / "README.md"
GUIDE: Final = README.read_text(encoding="utf-8").partition("## Five minutes")[2].partition("\n## ")[0]


def commands(program: str) -> list[list[str]]:
    """The commands of the guide that begin with a word, without prompts and comments."""
    spans = re.findall(rf"`({program} [^`]+)`", GUIDE) + re.findall(rf"^\s*\$ ({program} .*)$", GUIDE, re.MULTILINE)
    return [shlex.split(span, comments=True) for span in spans]


def starts(program: str, *words: str) -> list[str]:
    """The arguments of the guide's first command that begins with these words."""
    return next(command[1:] for command in commands(program) if command[1 : len(words) + 1] == list(words))


@pytest.fixture
def two(lab: Lab, agent: AgentFactory) -> tuple[Agent, Agent]:
    """The guide's two machines, as ``rmpa up`` makes them, with the names that the guide uses."""
    first, second = lab.hosts("joystick", "base")
    agents = agent(first, name="joystick"), agent(second, name="base")
    agents[0].wait_peer("base")
    agents[1].wait_peer("joystick")
    return agents


def test_the_guide_without_ros(two: tuple[Agent, Agent]) -> None:
    first, second = two
    with ExitStack() as stack:
        talk = [str(RMPA), *starts("rmpa", "topic", "pub")]
        stack.enter_context(Process(first.host.command(talk), env=first.env))
        hear = [str(RMPA), *starts("rmpa", "topic", "echo")]
        stack.enter_context(Process(second.host.command(hear), env=second.env)).wait_for('data: "hello"')
        watch = [str(RMPA), *starts("rmpa", "topic", "hz")]
        stack.enter_context(Process(second.host.command(watch), env=second.env)).wait_for("average rate: (9|10)")
        shown = {}
        for words in (["peer", "list"], ["topic", "list"], ["topic", "info"]):
            command = starts("rmpa", *words)
            code, shown[" ".join(words)] = second.rmpa(*command)
            assert code == 0, command
    assert re.search(r"joystick +linked", shown["peer list"])
    assert re.search(r"/chatter.*joystick", shown["topic list"])
    assert "std_msgs/String" in shown["topic info"]


@pytest.mark.ros
def test_the_guide_with_the_stock_tools(two: tuple[Agent, Agent], shell: ShellFactory) -> None:
    first, second = two
    shell(first.host).start("rostopic", *starts("rostopic", "pub"))
    shell(second.host).start("rostopic", *starts("rostopic", "echo")).wait_for('data: "hello"')


def test_the_guide_names_every_command_that_it_shows() -> None:
    assert {tuple(command[:2]) for command in commands("rmpa")} == {
        ("rmpa", "up"),
        ("rmpa", "topic"),
        ("rmpa", "peer"),
    }
