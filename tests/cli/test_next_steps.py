"""What ``rmpa up`` says on a terminal about the next step."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from typing import Any

import msgspec
import pytest

from rmpa.cli.agent import advises, next_steps
from rmpa.config.settings import Settings, WebSettings
from rmpa.config.values import Multicast
from rmpa.ros.environment import DEFAULT_MASTER_URI
from rmpa.trust.permissions import TrustStatus
from tests.cli.conftest import DEADLINE, Place, free_port
from tests.observe.samples import SNAPSHOT

JOYSTICK, PC = SNAPSHOT.peers
CORE = SNAPSHOT.agent.core_uri.rstrip("/")
GUID = SNAPSHOT.agent.guid.partition("#")[0]
FIT = Settings(name="base")


def steps(settings: Settings = FIT, master: str = CORE, **changes: Any) -> list[str]:
    agent = msgspec.structs.replace(SNAPSHOT.agent, **changes.pop("agent", {}))
    alone = {"peers": (), "strangers": ()} | changes
    return next_steps(settings, msgspec.structs.replace(SNAPSHOT, agent=agent, **alone), master)


@pytest.mark.parametrize(
    ("settings", "changes", "words"),
    [
        (FIT, {}, "on the other machine: rmpa up --name OTHER"),
        (Settings(name="base", domain=7), {}, "rmpa up --name OTHER --domain 7"),
        (Settings(name="base", multicast=Multicast(enabled=False)), {}, f"--seed {GUID}"),
        (Settings(name="base", interfaces=("lo",)), {}, "here: rmpa up --name OTHER --core-port 11312"),
        (FIT, {"agent": {"addresses": ()}}, "no network"),
        (FIT, {"trust": TrustStatus(on=True, module="base")}, "rmpa trust invite here"),
        (FIT, {"peers": (JOYSTICK, PC)}, "linked with joystick; if a topic does not arrive: rmpa why NAME"),
        (FIT, {"peers": (JOYSTICK, JOYSTICK)}, "linked with joystick and 1 more"),
        (FIT, {"peers": (PC,)}, "pc was found but is not linked: rmpa why --module pc"),
        (FIT, {"strangers": (PC,)}, "pc is not of this mesh"),
    ],
)
def test_the_first_line_says_what_the_facts_ask_for(settings: Settings, changes: dict[str, Any], words: str) -> None:
    first, *rest = steps(settings, **changes)
    assert words in first
    assert len(rest) == 2
    assert all(len(line) <= 74 for line in (first, *rest))


def test_a_wrong_master_of_this_shell_is_named_with_the_right_one() -> None:
    assert "ROS_MASTER_URI" not in steps()[2]
    wrong = "http://10.9.9.9:11311"
    assert steps(master=wrong)[2] == f"wrong: export ROS_MASTER_URI={DEFAULT_MASTER_URI}, also in ~/.bashrc"
    second = {"core_uri": "http://127.0.0.1:11312/"}
    there = "export ROS_MASTER_URI=http://localhost:11312"
    assert steps(master=wrong, agent=second)[2] == f"ROS_MASTER_URI is wrong: {there}"
    assert steps(master="", agent=second)[2].endswith("needs: export ROS_MASTER_URI=http://localhost:11312")
    assert "in a browser: http://localhost:9000/" in steps(Settings(web=WebSettings(enabled=True, port=9000)))[1]


def test_no_line_is_too_long_and_no_command_is_cut() -> None:
    long, far = "m" * 40, {"guid": "255.255.255.255:65535#1", "core_uri": "http://a.rather.long.name.example:65535/"}
    known = tuple(msgspec.structs.replace(peer, name=long) for peer in (JOYSTICK, PC))
    settings = Settings(domain=232, multicast=Multicast(enabled=False), web=WebSettings(enabled=True, port=65535))
    every = [
        steps(settings, "http://x:1", agent=far, **{key: peers})
        for key, peers in (("peers", known[:1]), ("peers", known[1:]), ("strangers", known[1:]), ("peers", ()))
    ]
    assert all(len(line) <= 74 for lines in every for line in lines)
    assert every[1][0].endswith(f"rmpa why --module {long}")
    assert every[3][0] == "there: rmpa up --name OTHER --domain 232 --seed 255.255.255.255:65535"
    assert every[0][2] == "export ROS_MASTER_URI=http://a.rather.long.name.example:65535"


def test_programs_get_no_advice() -> None:
    assert advises(FIT, {}, quiet=False)
    assert not advises(FIT, {}, quiet=True)
    assert not advises(Settings(log_json=True), {}, quiet=False)
    assert not advises(FIT, {"NOTIFY_SOCKET": "/run/x"}, quiet=False)


@pytest.mark.pty
def test_a_terminal_gets_three_lines_and_a_log_none(place: Place) -> None:
    ours, its = pty.openpty()
    words = ["--name", "base", "--interface", "lo", "--multicast", f"239.255.82.77:{20000 + os.getpid() % 20000}"]
    command = [sys.executable, "-m", "rmpa.cli.main", "up", *words, "--core-port", str(free_port())]
    with subprocess.Popen(command, stdin=its, stdout=its, stderr=its, env=place.environ, cwd=place.path) as process:
        os.close(its)
        try:
            seen = b""
            while seen.count(b"\n", max(seen.find(b"Next:"), 0)) < 3 or b"Next:" not in seen:
                seen += os.read(ours, 65536)
        finally:
            process.terminate()
            process.wait(DEADLINE)
            os.close(ours)
    said = seen.decode().replace("\r\n", "\n")
    lines = said[said.index("Next:") :].splitlines()[:3]
    assert lines[0].startswith("Next: no peer yet; a second module here: rmpa up --name OTHER --core-port ")
    assert "rmpa peer list" in lines[1]
    assert re.search(r"export ROS_MASTER_URI=http://[\w.]+:\d{4,5}$", lines[2]), "it is another port than ROS's own"
    assert all(len(line) <= 80 for line in lines)
