"""The commands of docs/guides: trust.md, web.md, monitor.md and sites.md, typed on machines of their own."""

from __future__ import annotations

import os
import re
import shutil
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import pytest

pytest.importorskip("cryptography")
pytest.importorskip("aiohttp")

from collections.abc import Iterator

from lab.bed.agents import RMPA
from lab.bed.namespaces import Host, Lab, why_no_nat
from lab.bed.processes import Process, eventually

pytestmark = [pytest.mark.netns, pytest.mark.timeout(180)]

GUIDES: Final = Path(__file__).parents[2] / "docs/guides"
MARK: Final = "<!-- tested: tests/interop/test_guides.py -->\n```console\n"
TOML: Final = re.compile(r"(?s)```toml\n(.*?)```")
STEP: Final = re.compile(r"(?m)^(\w+)\$ (.*)\n((?:(?!\w+\$ |```).*\n)*)")


def read(page: str) -> str:
    return (GUIDES / page).read_text(encoding="utf-8")


def steps(page: str) -> Iterator[tuple[str, str, list[str]]]:
    """Each command of the page: its host, the command, the lines that it says."""
    for block in read(page).split(MARK)[1:]:
        for host, command, said in STEP.findall(block.partition("```")[0]):
            yield host, command, said.splitlines()


def pattern(line: str) -> str:
    """A line of a page as a regular expression: what has a digit, and words that are cut by "…", may be another."""
    return " ".join(
        r"\S+"
        if re.search(r"…|^/home/", word)
        else r"[\w.:]+".join(map(re.escape, re.split(r"[\w.:]*\d[\w.:]*", word)))
        for word in line.split()
    )


def says(line: str, output: str) -> bool:
    return any(re.search(pattern(line), " ".join(found.split())) for found in output.splitlines())


class Machine:
    """A host with a shell of its own, as a user has one; files stand in a directory that all share, as on a stick."""

    def __init__(self, host: Host, home: Path, stack: ExitStack, settings: str = "") -> None:
        self.host, self.stack, self.shared = host, stack, home
        self.variables = {"RMPA_NAME": host.name}
        self.home = home / host.name
        self.runtime = stack.enter_context(TemporaryDirectory(prefix="rmpa-test-"))  # short, for sockets
        file = self.home / ".config" / "rmpa" / "rmpa.toml"
        file.parent.mkdir(parents=True)
        file.write_text(settings, encoding="utf-8")

    def start(self, command: str) -> Process:
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("ROS_", "RMPA_", "XDG_"))}
        own = {"HOME": str(self.home), "XDG_RUNTIME_DIR": self.runtime, **self.variables}
        path = f"{Path(RMPA).parent}:{kept['PATH']}"
        argv = self.host.command(["sh", "-c", f"cd {self.shared} && echo y | {command}"])
        return self.stack.enter_context(Process(argv, env={**kept, **own, "PATH": path}, name=command))

    def start_agent(self, command: str = "rmpa up") -> None:
        self.start(command).wait_for("control socket" if command.startswith("rmpa up") else "zenoh session")

    def say(self, command: str) -> str:
        with self.start(command) as process:
            process.wait()
            return process.output

    def check(self, typed: str, lines: list[str]) -> str:
        """Run a command of a page to its end: its status and its lines are those of the page."""
        command, _, comment = typed.partition(" # ")
        with self.start(command) as process:
            assert (process.wait() != 0) == comment.strip().startswith("fails"), process.output
            for line in lines:
                assert says(line, process.output), f"{self.host.name}$ {command}\n{line}\n{process.output}"
            return process.output


def test_a_mesh_is_secured_and_a_module_thrown_out(lab: Lab, tmp_path: Path) -> None:
    known = {"rmpa1-ae4vq2k…": "", "4f2a91c0…": ""}
    settings = {"arm": '[trust]\ndefault = "allow"\n'}
    with ExitStack() as stack:
        hosts = lab.hosts("base", "arm", "hand")
        machines = {host.name: Machine(host, tmp_path, stack, settings.get(host.name, "")) for host in hosts}
        for name, typed, lines in steps("trust.md"):
            command = typed
            for shown, real in known.items():
                assert real or shown not in command, "the page uses it before it shows it"
                command = command.replace(shown, real)
            if command.startswith("rmpa why arm:"):  # the page tells of what is published meanwhile, and refused
                machines["arm"].start("rmpa topic pub -r 10 /spam std_msgs/String 'data: x'")
                eventually(lambda: says(lines[0], machines["base"].say("rmpa why arm:/spam")), what=lines[0])  # noqa: B023
            if command == "rmpa up":
                machines[name].start_agent()
            elif command == "rmpa trust invite":
                process = machines[name].start(command)
                process.wait_for(pattern(lines[0]))
                known["rmpa1-ae4vq2k…"] = process.wait_for(r"rmpa1-\w+").group()
            elif match := re.search(r"--ca (\w+)", machines[name].check(command, lines)):
                known["4f2a91c0…"] = match.group(1)
    assert all(known.values())


@pytest.mark.skipif(not all(map(shutil.which, ("curl", "jq", "openssl"))), reason="needs curl, jq and openssl")
def test_the_web_server_answers_as_its_page_says(lab: Lab, tmp_path: Path) -> None:
    with ExitStack() as stack:
        base, joystick = (Machine(host, tmp_path, stack) for host in lab.hosts("base", "joystick"))
        base.start_agent()
        joystick.start_agent()
        joystick.start("rmpa topic pub -r 10 /joy std_msgs/String 'data: x'")
        eventually(lambda: "/joy" in base.say("rmpa topic list"), what="the topic of the joystick")
        served = base.start("rmpa web")
        done = []
        for _, command, lines in (*steps("web.md"), *steps("monitor.md")):
            wanted = command if command.startswith("rmpa web") else "rmpa web" if "curl" in command else served.name
            if served.name != wanted:
                served.interrupt()
                served = base.start(wanted)
            served.wait_for("https?://")
            if command.startswith("rmpa web"):
                for line in lines:
                    served.wait_for(pattern(line))
            else:
                base.check(command, lines)
            done.append(command.split()[0])
        assert done.count("rmpa") > 2 < done.count("curl")


@pytest.mark.skipif(why_no_nat() != "", reason=why_no_nat())
@pytest.mark.parametrize("secured", [False, True])
def test_two_sites_meet_at_a_router(lab: Lab, tmp_path: Path, secured: bool) -> None:
    pytest.importorskip("zenoh")
    with ExitStack() as stack:
        hosts = [lab.host("cloud", 0), lab.host("hall", 1), lab.host("yard", 2)]
        settings = next(part for part in TOML.findall(read("sites.md")) if "relays" in part)
        machines = {host.name: Machine(host, tmp_path, stack, settings if secured else "") for host in hosts}
        for number, host in enumerate(hosts[1:], 1):
            lab.route(host, lab.nat(f"nat{number}", number, 0))
        for machine in machines.values():
            machine.variables.clear()  # the page gives names
        every = list(steps("sites.md"))
        begin = next(number for number, step in enumerate(every) if "trust init" in step[1])
        token = ""
        for name, typed, lines in every[begin:] if secured else every[:begin]:
            command = typed.replace("fleet.example", hosts[0].address).replace("TOKEN", token or "TOKEN")
            if command.startswith(("rmpa up", "rmpa gateway")):
                machines[name].start_agent(command)
            elif " pub " in command:
                machines[name].start(command).wait_for("publishing")
                eventually(lambda: "/chatter" in machines["yard"].say("rmpa topic list --agent pad"), what="/chatter")
            elif found := re.search(r"rmpa1-\w+", machines[name].check(command, lines)):
                token = found.group()
        if secured:
            eventually(
                lambda: says("hall this site", machines["hall"].say("rmpa site list --agent arm")), what="the site"
            )
