"""The tutorial of Smart Resources, word for word: its files, its commands and their output."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest

from lab.bed.processes import Process, eventually
from rmpa.cli.output import read_values
from rmpa.cli.run import load
from rmpa.resource.quality import at_least, parse_requirement
from tests.interop.ros import free_port

ROOT: Final = Path(__file__).parents[2]
FILES: Final = ROOT / "examples" / "resources"
PAGE: Final = (ROOT / "docs/guides/smart-resources.md").read_text(encoding="utf-8")
TUTORIAL: Final = PAGE.partition("\n## Configuration\n")[0]
STEP: Final = re.compile(r"^```console\n(.*?)^```$|^<!-- ctrl-c: (\S+) -->$", re.MULTILINE | re.DOTALL)
COMMAND: Final = re.compile(r"^\$ (.*)\n((?:[^$].*\n)*)", re.MULTILINE)
NUMBER: Final = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")


def test_its_files_are_the_examples() -> None:
    before, *blocks = TUTORIAL.split("\n```python\n")
    for name in ("sonar.py", "keeper.py", "ask.py"):
        text, _, after = blocks.pop(0).partition("```\n")
        assert f"`{name}`" in before.rpartition("\n\n")[0].rpartition("\n\n")[2] + before.rpartition("\n\n")[2]
        whole = (FILES / name).read_text(encoding="utf-8")
        lines = {line.strip() for line in whole.splitlines()}
        assert text == whole or (name != "sonar.py" and {line.strip() for line in text.splitlines()} <= lines), name
        before = after
    assert not blocks


def test_what_a_file_may_declare_can_be_declared() -> None:
    (block,) = re.findall(r"^```python\n(.*?)^```$", PAGE.removeprefix(TUTORIAL), re.MULTILINE | re.DOTALL)
    (sonar,) = load(FILES / "sonar.py")
    exec(block, {"sonar": sonar, "at_least": at_least})
    assert list(sonar.contexts) == ["docked", "quiet"]
    assert "/battery" in sonar.inputs
    (asked,) = re.findall(r"/sonar/requirements \S+ \\\n +'(.*)'$", PAGE, re.MULTILINE)
    array: Any = read_values((asked,))
    values = [(pair["key"], pair["value"]) for pair in array["status"][0]["values"]]
    bounds = parse_requirement("/someone", values, sonar.attributes, "sonar", 0.0).bounds
    assert {name: (bound.hard, bound.weight) for name, bound in bounds.items()} == {
        "rate": (True, 1.0),
        "accuracy": (False, 2.0),
    }


def test_the_keeper_says_how_close_it_keeps() -> None:
    (keeper,) = load(FILES / "keeper.py")
    seen: list[tuple[str, object]] = []
    keeper.declared_attributes["closeness"].on_observation = lambda *said: seen.append(said)
    keeper.outputs["/cmd_vel"].on_publish = lambda _values, _message: None
    for distance in (2.0, 2.05, 1.95):
        keeper.tasks["control"].function(SimpleNamespace(range=distance))
    assert seen == [("closeness", pytest.approx(jump)) for jump in (0.0, 0.05, 0.1)]


class Terminals:
    """A machine's terminals, in the folder of the files; its ports are free ones, its state is empty."""

    def __init__(self, home: str) -> None:
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "RMPA_", "XDG_"))}
        self.ports = {"11322": str(free_port())}
        self.environ = kept | {
            "HOME": home,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "RMPA_RUNTIME_DIR": home,
            "RMPA_CORE_PORT": str(free_port()),
            "RMPA_MULTICAST": f"239.255.82.77:{20000 + os.getpid() % 12000}",
            "NO_COLOR": "1",
        }
        self.running: dict[str, Process] = {}

    def type(self, command: str, shown: str) -> None:
        for port, free in self.ports.items():
            command = command.replace(port, free)
        words = shlex.split(command)
        if words[0] == "export":
            name, _, value = words[1].partition("=")
            self.environ[name] = value
        elif words[:2] == ["rmpa", "run"]:
            words[2] = str(FILES / words[2])
            self.running[Path(words[2]).name] = process = Process(words, env=self.environ, name=words[2])
            process.wait_for(": active on ")
        else:
            eventually(lambda: self._prints(words, shown), 40, what=f"what is shown of {command}", every=0.3)

    def interrupt(self, file: str) -> None:
        assert self.running.pop(file).interrupt() == 0

    def close(self) -> None:
        while self.running:
            _, process = self.running.popitem()
            if process.returncode is None:
                process.interrupt()
            process.end()

    def _prints(self, words: list[str], shown: str) -> bool:
        done = subprocess.run(
            words, env=self.environ, cwd=FILES, stdout=subprocess.PIPE, text=True, timeout=40, check=False
        )
        said = plain(done.stdout)
        print(f"$ {shlex.join(words)}\n{done.stdout}")
        wanted = ".*".join(re.escape(plain(part)) for part in shown.split("…\n"))
        return done.returncode == 0 and re.fullmatch(wanted, said, re.DOTALL) is not None


def plain(text: str) -> str:
    """The text without its variable parts: numbers, how wide columns are, empty lines."""
    lines = [" ".join(line.split()) for line in NUMBER.sub("N", text).splitlines()]
    return "".join(f"{line}\n" for line in lines if line)


@pytest.fixture
def terminals() -> Iterator[Terminals]:
    with tempfile.TemporaryDirectory(prefix="rmpa-test-") as home:
        one = Terminals(home)
        yield one
        one.close()


@pytest.mark.timeout(240)
def test_its_commands_do_what_it_says(terminals: Terminals) -> None:
    typed = 0
    for step in STEP.finditer(TUTORIAL):
        if step[2]:
            terminals.interrupt(step[2])
        for command, shown in COMMAND.findall(step[1] or ""):
            terminals.type(command, shown)
            typed += 1
    assert typed == 17
    assert all("Traceback" not in process.output for process in terminals.running.values())
