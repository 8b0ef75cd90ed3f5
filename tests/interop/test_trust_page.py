"""The commands of docs/guides/trust.md, typed on machines of their own, say what the page says."""

from __future__ import annotations

import os
import re
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

pytest.importorskip("cryptography")

from lab.bed.agents import RMPA
from lab.bed.processes import Process, eventually

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.namespaces import Host, Lab

pytestmark = [pytest.mark.netns, pytest.mark.timeout(180)]

MARK: Final = "<!-- tested: tests/interop/test_trust_page.py -->\n```console\n"
PAGE: Final = (Path(__file__).parents[2] / "docs/guides/trust.md").read_text(encoding="utf-8")
SETTINGS: Final = {"arm": '[trust]\ndefault = "allow"\n'}


def steps() -> Iterator[tuple[str, str, list[str]]]:
    """Each command of the page: its host, the command, the lines that it says."""
    for block in PAGE.split(MARK)[1:]:
        for host, command, said in re.findall(
            r"(?m)^(\w+)\$ (.*)\n((?:(?!\w+\$ |```).*\n)*)", block.partition("```")[0]
        ):
            yield host, command, said.splitlines()


def pattern(line: str) -> str:
    """A line of the page as a regular expression: words with digits, and those that are cut by "…", may be any."""
    words = (r"\S+" if re.search(r"\d|…|^/home/", word) else re.escape(word) for word in line.split())
    return " ".join(words)


def says(line: str, output: str) -> bool:
    return any(re.search(pattern(line), " ".join(found.split())) for found in output.splitlines())


class Machine:
    """A host with a shell of its own, as a user has one; files stand in a directory that all share, as on a stick."""

    def __init__(self, host: Host, home: Path, stack: ExitStack) -> None:
        self.host, self.stack, self.shared = host, stack, home
        self.home = home / host.name
        settings = self.home / ".config" / "rmpa" / "rmpa.toml"
        settings.parent.mkdir(parents=True)
        settings.write_text(SETTINGS.get(host.name, ""), encoding="utf-8")

    def start(self, command: str) -> Process:
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "RMPA_", "XDG_"))}
        own = {"HOME": str(self.home), "XDG_RUNTIME_DIR": str(self.home), "RMPA_NAME": self.host.name}
        path = f"{Path(RMPA).parent}:{kept['PATH']}"
        typed = f"cd {self.shared} && echo y | {command}"
        argv = self.host.command(["sh", "-c", typed])
        return self.stack.enter_context(Process(argv, env={**kept, **own, "PATH": path}, name=command))

    def say(self, command: str) -> str:
        with self.start(command) as process:
            process.wait()
            return process.output


def test_the_commands_of_the_page(lab: Lab, tmp_path: Path) -> None:
    known = {"rmpa1-ae4vq2k…": "", "4f2a91c0…": ""}
    with ExitStack() as stack:
        machines = {host.name: Machine(host, tmp_path, stack) for host in lab.hosts("base", "arm", "hand")}
        for name, typed, lines in steps():
            command, _, comment = typed.partition(" # ")
            for shown, real in known.items():
                assert real or shown not in command, "the page uses it before it shows it"
                command = command.replace(shown, real)
            if "rmpa why arm:" in command:  # the page tells of what is published meanwhile, and refused
                machines["arm"].start("rmpa topic pub -r 10 /spam std_msgs/String 'data: x'")
                eventually(lambda: says(lines[0], machines["base"].say("rmpa why arm:/spam")), what=lines[0])  # noqa: B023
            process = machines[name].start(command)
            if command == "rmpa up":
                process.wait_for("control socket")
            elif command == "rmpa trust invite":
                known["rmpa1-ae4vq2k…"] = process.wait_for(r"rmpa1-\w+").group()
                process.wait_for(pattern(lines[0]))
            else:
                assert (process.wait() != 0) == comment.strip().startswith("fails"), process.output
                for line in lines:
                    assert says(line, process.output), f"{name}$ {command}\n{line}\n{process.output}"
            if match := re.search(r"--ca (\w+)", process.output):
                known["4f2a91c0…"] = match.group(1)
    assert all(known.values())
