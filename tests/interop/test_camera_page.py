"""The tutorial docs/start/camera.md, word for word: a camera with dynamic_reconfigure becomes a Smart Resource."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import pytest

from lab.bed.agents import RMPA, Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually
from rmpa.resource.description import read_description
from tests.examples.test_tutorial import COMMAND, plain
from tests.interop.conftest import ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(180)]

PAGE: Final = (Path(__file__).parents[2] / "docs/start/camera.md").read_text(encoding="utf-8")
BLOCK: Final = re.compile(r"^(?:<!-- tested: .*? -->\n)```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TYPED: Final = re.compile(r"^(robot[12])(\$ .*\n(?:(?!robot).*\n)*)", re.MULTILINE)


class Robots:
    """The two robots of the page, with a terminal in a folder of each."""

    def __init__(self, home: Path, agents: dict[str, Agent], stack: ExitStack) -> None:
        self.agents = agents
        self.folders = {name: home / f"folder-{name}" for name in agents}
        self._stack = stack
        for folder in self.folders.values():
            folder.mkdir()

    def type(self, robot: str, command: str, shown: str) -> None:
        """Type a command, and see what is shown."""
        agent, folder = self.agents[robot], self.folders[robot]
        words = ["bash", "-c", f"cd {shlex.quote(str(folder))} && PATH={RMPA.parent}:$PATH {command}"]
        if command.startswith("rmpa run"):
            process = self._stack.enter_context(Process(agent.host.command(words), env=agent.env, name=command))
            process.wait_for("active on")
            return
        env = {**agent.env, "NO_COLOR": "1"}

        def prints() -> bool:
            with Process(agent.host.command(words), env=env, name=command) as process:
                code = process.wait(40)
            said = "\n".join(line for line in process.lines if not line.startswith("looking at"))
            print(f"{robot}$ {command}\n{said}")
            return (code != 0) is ("# fails" in command) and plain(said) == plain(shown)

        eventually(prints, 60, what=f"what is shown of {command}", every=0.3)


@pytest.fixture
def robots(lab: Lab, shell: ShellFactory, tmp_path: Path) -> Iterator[Robots]:
    """Linked, with the driver on robot1."""
    with ExitStack() as stack:
        agents = {}
        for host in lab.hosts("robot1", "robot2"):
            agents[host.name] = stack.enter_context(Agent(host, tmp_path, name=host.name))
            agents[host.name].start()
        for one in agents.values():
            one.wait_ready()
        driver = shell(agents["robot1"].host).rospy("usb_cam", name="usb_cam")
        driver.wait_event("up")
        agents["robot1"].wait_peer("robot2")
        yield Robots(tmp_path, agents, stack)


@pytest.mark.long
def test_its_commands_do_what_it_says(robots: Robots) -> None:
    described, viewer, _ = re.findall(r"^```toml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    (robots.folders["robot2"] / "viewer.resource.toml").write_text(viewer, encoding="utf-8")
    typed = 0
    for block in BLOCK.findall(PAGE):
        for robot, text in TYPED.findall(block):
            for command, shown in COMMAND.findall(text):
                robots.type(robot, command, shown)
                typed += 1
    assert typed == 8
    written = (robots.folders["robot1"] / "camera.resource.toml").read_text(encoding="utf-8")
    assert [line for line in described.splitlines() if line and "Hz" not in line] == [
        line for line in written.splitlines() if line in described.splitlines() and line and "Hz" not in line
    ]


def test_the_viewer_is_a_description() -> None:
    _, viewer, _ = re.findall(r"^```toml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert read_description(viewer.encode(), Path("viewer.resource.toml")).demands
