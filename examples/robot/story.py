"""A robot of three modules adapts: a line gets thin, a battery falls, a laser dies.

In a clone, as root, beside Debian's ROS: ``.venv/bin/python examples/robot/story.py``. Each module is a network
namespace, and has one of the files beside this one; the drivers know nothing of RMPA.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final, Self

sys.path.insert(0, str(Path(__file__).parents[2]))

from lab.bed.agents import RMPA, Agent
from lab.bed.namespaces import Lab
from lab.bed.processes import Closing, Process, eventually

if TYPE_CHECKING:
    from collections.abc import Iterator

HERE: Final = Path(__file__).parent
# By the module's name: its file.
FILES: Final = {"eyes": "camera", "base": "base", "head": "pilot"}
# Seconds for windows, cool-downs and routes on a shared machine.
LONG: Final = 60.0


class Robot(Closing):
    """The three modules, running.

    Args:
        home: A folder for all that they write.
    """

    def __init__(self, home: Path) -> None:
        self._stack = ExitStack()
        lab = self._stack.enter_context(Lab())
        self.agents = {host.name: Agent(host, home, name=host.name) for host in lab.hosts(*FILES)}
        self.resources: dict[str, Process] = {}
        for name, agent in self.agents.items():
            argv: list[str | Path] = [RMPA, "run", HERE / f"{FILES[name]}.resource.toml", "--name", name]
            process = Process(agent.host.command(argv), env=agent.env, name=name)
            self._stack.callback(process.end)
            self.resources[name] = process
        for process in self.resources.values():
            process.wait_for("active on", LONG)

    def __enter__(self) -> Self:
        return self

    def close(self) -> None:
        """End all of it."""
        self._stack.close()

    def rmpa(self, module: str, *words: str) -> str:
        """What a command says at a module."""
        return self.agents[module].rmpa(*words)[1]

    def runs(self, module: str, profile: str) -> None:
        """Wait until the resource of a module runs a profile."""
        eventually(lambda: self.rmpa(module, "profile", "get").split()[-1:] == [profile], LONG, what=profile)

    def pid(self, node: str) -> int:
        """The process of a node of the head."""
        return int(self.rmpa("head", "node", "info", node).partition("Pid: ")[2].split()[0])

    def story(self) -> Iterator[tuple[str, str]]:
        """Each chapter when it has happened: what, and what a seat at the head is told."""
        for module, profile in (("eyes", "large"), ("base", "quick"), ("head", "by_laser")):
            self.runs(module, profile)
        yield "all is well: large pictures, quick, by the laser", self.rmpa("head", "resource", "list")

        eyes = self.agents["eyes"].host
        eyes.shape("8mbit", latency="400ms")
        self.runs("eyes", "small")
        explained = self.rmpa("head", "profile", "explain", "eyes:/camera")
        yield "the line gets thin: pictures come late at the head, so the camera sends small ones", explained
        eyes.unshape()

        self.rmpa("base", "param", "set", "/charge", "0.2")
        self.runs("base", "slow")
        yield "the battery falls: the base slows down", self.rmpa("head", "profile", "explain", "base:/base")

        os.kill(self.pid("/laser"), signal.SIGKILL)
        self.runs("head", "by_camera")
        yield "the laser dies: the controller drives by the camera", self.rmpa("head", "profile", "explain", "/pilot")


def main() -> None:
    """Tell it."""
    with tempfile.TemporaryDirectory(prefix="rmpa-robot-") as home, Robot(Path(home)) as robot:
        for what, said in robot.story():
            print(f"\n== {what}\n{said}", flush=True)


if __name__ == "__main__":
    main()
