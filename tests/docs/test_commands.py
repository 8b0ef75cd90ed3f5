"""Every block of commands of the user pages is run here, is run by a test that it names, or says why it is not run.

A block of commands is a fence of ``console`` whose commands follow ``$ ``, or ``HOST$ `` where two machines matter.
On the line before it stands one of these, or nothing:

    <!-- tested: tests/path/test_x.py -->    that test runs it: it reads the page, or has its name and the same words
    <!-- not run: REASON -->                 as a second machine, root, a camera

Without a mark its commands run here, one after the other in a shell of their own for each block and machine, in one
scratch folder for each page, on the machine ``base`` beside the peer ``joystick`` (tests/docs/joystick.py says what
it has). Each must end with status 0; one whose comment says ``fails`` with another. A command whose comment says
``Ctrl-C`` must print something, and is then interrupted.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil
import pytest

from lab.bed.agents import Agent
from lab.bed.namespaces import MACHINE
from lab.bed.processes import Process, eventually
from tests.docs.pages import ROOT, USER_PAGES, Block, blocks, name_of
from tests.interop import ros

if TYPE_CHECKING:
    from collections.abc import Iterator

DEADLINE: Final = 40.0
_COMMAND: Final = re.compile(r"^(\w*)\$ ((?:.*\\\n)*.*)$", re.MULTILINE)
_STOCK: Final = re.compile(r"\b(?:ros(?:topic|node|service|param|run|launch|core)|catkin_make)\b")
_BLOCKS: Final = [block for page in USER_PAGES for block in blocks(page)]
_CONSOLE: Final = [block for block in _BLOCKS if block.language == "console"]
_RUN: Final = [block for block in _CONSOLE if not block.mark]


@pytest.mark.parametrize("block", _BLOCKS, ids=str)
def test_commands_are_in_blocks_that_are_checked(block: Block) -> None:
    if block.language == "console":
        assert _COMMAND.match(block.text), "a block of commands begins with a command, after `$ `"
    else:
        assert not re.search(r"^\s*\w*\$ ", block.text, re.MULTILINE), "commands are in fences of `console`"
        assert block.language not in {"sh", "bash", "shell"} or block.text.startswith("#!"), (
            "commands are in fences of `console`, scripts in ones of `sh` with a `#!`"
        )


@pytest.mark.parametrize("block", [block for block in _CONSOLE if block.mark], ids=str)
def test_what_is_not_run_here_says_why_or_where(block: Block) -> None:
    kind, _, text = block.mark.partition(": ")
    assert kind in {"tested", "not run"}, block.mark
    assert text.strip(), block.mark
    if kind == "tested":
        assert text.startswith("tests/"), block.mark
        assert block.page.name in (ROOT / text).read_text(encoding="utf-8"), f"{text} does not name {block.page.name}"


@dataclass
class Machines:
    """The machine ``base``, the peer beside it, and the folder of a page."""

    agents: dict[str, Agent]
    place: Path

    def env(self, machine: str) -> dict[str, str]:
        """What a terminal of a machine has."""
        agent = self.agents[machine or "base"]
        return {
            **agent.env,
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "HOME": str(self.place),
            "ROS_MASTER_URI": f"http://127.0.0.1:{agent.core_port}",
            "RMPA_MULTICAST": agent.multicast,
            "NO_COLOR": "1",
        }

    def run(self, machine: str, commands: list[str], folder: Path) -> str:
        """Run commands in one shell, and end what it leaves; return what is wrong."""
        script = "\n".join(
            f"{typed(command)} || {{ echo {shlex.quote(command)} failed; exit 1; }}" for command in commands
        )
        with tempfile.TemporaryFile("w+") as said:
            shell = subprocess.Popen(
                ["bash", "-c", f"set -m\n{script}"],
                cwd=folder,
                env=self.env(machine),
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
            try:
                code = str(shell.wait(DEADLINE))
            except subprocess.TimeoutExpired:
                code = f"runs for {DEADLINE:g} s"
            finally:
                for process in psutil.process_iter():
                    with contextlib.suppress(ProcessLookupError):
                        if os.getsid(process.pid) == shell.pid:
                            os.kill(process.pid, signal.SIGKILL)
                shell.wait()
            said.seek(0)
            return "" if code == "0" else f"status: {code}\n{said.read()}"


def typed(command: str) -> str:
    """A command as the shell is to run it, with the status that its comment wants."""
    words, _, comment = command.partition(" #")
    if "Ctrl-C" in comment:
        return (
            f"{{ {words} >said & }}; until [ -s said ]; do sleep 0.1; done; cat said; rm said; kill -INT -- -$!;"
            " wait $! || [ $? = 130 ]"
        )
    return f"! {{ {words}\n}}" if "fails" in comment else f"{{ {words}\n}}"


@pytest.fixture(scope="module")
def machines(state_home: Path) -> Iterator[Machines]:
    """Two machines that are linked."""
    del state_home
    with ExitStack() as stack:
        homes = [Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rmpa-test-"))) for _ in range(2)]
        agents = {}
        for name, home in zip(("base", "joystick"), homes, strict=True):
            agents[name] = stack.enter_context(Agent(MACHINE, home, name=name, runtime_dir=home))
            agents[name].start()
            agents[name].wait_ready()
        agents["base"].wait_peer("joystick")
        place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rmpa-test-")))
        uri = f"http://127.0.0.1:{agents['joystick'].core_port}"
        peer = Process([sys.executable, Path(__file__).with_name("joystick.py"), uri], env=agents["joystick"].env)
        stack.enter_context(peer).wait_for("publishing")
        one = Machines(agents, place)
        eventually(
            lambda: "/arm/enable" in one.agents["base"].rmpa("service", "list")[1],
            DEADLINE,
            what="base offers what the joystick has",
        )
        yield one


@pytest.mark.timeout(300)
@pytest.mark.parametrize("page", list(dict.fromkeys(block.page for block in _RUN)), ids=name_of)
def test_commands_of_a_page_do_what_they_are_for(machines: Machines, page: Path) -> None:
    folder = machines.place / page.stem
    folder.mkdir()
    shutil.copytree(ROOT / "examples", folder / "examples")
    for block in _RUN:
        if block.page == page and not (_STOCK.search(block.text) and ros.why_not()):
            for machine, commands in groupby(_COMMAND.findall(block.text), lambda each: each[0]):
                wrong = machines.run(machine, [command for _, command in commands], folder)
                assert not wrong, f"{block}\n{wrong}"
