"""docs/start/one-pc.md, word for word: four terminals of one host with two cores, and the stock rostopic."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Final

import pytest

from lab.bed.namespaces import Lab
from lab.bed.processes import Process, eventually
from lab.bed.ros import environment
from tests.packages.tutorial import shows, steps

PAGE: Final = (Path(__file__).parents[2] / "docs/start/one-pc.md").read_text(encoding="utf-8")
TERMINALS: Final = ("one", "two", "three", "four")


@pytest.mark.netns
@pytest.mark.ros
@pytest.mark.timeout(180)
def test_the_page(lab: Lab, tmp_path: Path) -> None:
    pc = lab.host("pc")
    env = environment(tmp_path, 11311)
    env = {name: value for name, value in env.items() if name not in {"ROS_MASTER_URI", "ROS_IP"}}
    env["PATH"] = f"{Path(sys.executable).parent}:{env['PATH']}"
    env |= {"RMPA_RUNTIME_DIR": str(tmp_path), "PYTHONUNBUFFERED": "1"}
    running: list[tuple[str, Process]] = []

    def start(command: str) -> Process:
        return Process(pc.command(["sh", "-c", command]), env=env, name=command)

    def prints(command: str, shown: str) -> bool:
        with start(command) as process:
            return process.wait() == 0 and shows(process.output, shown)

    def has_shown(process: Process, shown: str) -> bool:
        return shows(process.output, shown)

    try:
        for step in steps(PAGE, TERMINALS):
            if step.hand:
                for command, process in running:
                    if command.startswith(step.shown):
                        process.interrupt()
            elif " list" in step.command:
                eventually(partial(prints, step.command, step.shown), what=step.command, every=0.3)
            else:
                running.append((step.command, process := start(step.command)))
                if "rmpa up" in step.command:
                    process.wait_for("ROS_MASTER_URI=")
                eventually(partial(has_shown, process, step.shown), what=step.command)
    finally:
        for _, process in reversed(running):
            process.end()
