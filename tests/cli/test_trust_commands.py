"""``rmpa trust init|invite|join|status|renew|revoke|leave`` as a user meets them, with real agents on loopback."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

pytest.importorskip("cryptography")

from tests.cli.conftest import DEADLINE, Place, end, free_port, until

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


class Machine:
    """One machine of a test: a place of its own, and perhaps its agent."""

    def __init__(self, folder: Path, name: str, stack: ExitStack) -> None:
        folder.mkdir()
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "RMPA_", "XDG_"))}
        own = {"RMPA_RUNTIME_DIR": str(folder / "run"), "HOME": str(folder), "NO_COLOR": "1"}
        self.name, self.folder, self._stack = name, folder, stack
        self.place = Place(folder, kept | own)
        port = 20000 + os.getpid() % 20000
        (folder / "rmpa.toml").write_text(f'name = "{name}"\n')
        self._up = (
            "up",
            "--multicast",
            f"239.255.116.116:{port}",
            "--core-port",
            str(free_port()),
            "--interface",
            "lo",
        )
        self.agent: subprocess.Popen[str] | None = None

    def run(self, *arguments: str, stdin: str = "") -> tuple[int, str, str]:
        process = self.start(*arguments)
        out, err = process.communicate(stdin, timeout=DEADLINE)
        return process.returncode, out, err

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "rmpa.cli.main", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=self.place.environ,
            cwd=self.folder,
            start_new_session=True,  # without a terminal of the test's own, whose /dev/tty would be asked
        )
        self._stack.callback(end, process)
        return process

    def trust(self, *arguments: str, stdin: str = "") -> str:
        """A command that succeeds; its standard output."""
        code, out, err = self.run("trust", *arguments, stdin=stdin)
        assert code == 0, err
        return out

    def refused(self, *arguments: str, stdin: str = "", code: int = 1) -> str:
        """A command that fails; what the user reads."""
        found, _, err = self.run("trust", *arguments, stdin=stdin)
        assert found == code, err
        return err

    def up(self) -> None:
        """Start the agent, and wait until it answers."""
        log = (self.folder / "log").open("a")
        self.agent = subprocess.Popen(
            [sys.executable, "-m", "rmpa.cli.main", *self._up],
            stdout=log,
            stderr=log,
            env=self.place.environ,
            cwd=self.folder,
            text=True,
        )
        log.close()
        self._stack.callback(self.down)
        until(self._answers)

    def _answers(self) -> bool:
        assert self.agent is not None
        assert self.agent.poll() is None, self.log
        return (self.folder / "run" / f"{self.name}.sock").exists()

    def down(self) -> None:
        if self.agent is not None:
            self.agent.terminate()
            self.agent.wait(DEADLINE)
            self.agent = None

    @property
    def log(self) -> str:
        return (self.folder / "log").read_text()

    def status(self) -> dict[str, object]:
        found: dict[str, object] = json.loads(self.trust("status", "--json"))
        return found

    def peers(self) -> dict[str, str]:
        return {peer["name"]: peer["state"] for peer in json.loads(self.run("peer", "list", "--json")[1])}


@pytest.fixture
def machine() -> Iterator[Callable[[str], Machine]]:
    # Not pytest's folder: the path of a control socket has at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="rmpa-test-") as folder, ExitStack() as stack:
        yield lambda name: Machine(Path(folder) / name, name, stack)


def _line(process: subprocess.Popen[str], words: str) -> str:
    """The next line on standard error that has these words."""
    assert process.stderr is not None
    for line in process.stderr:
        if words in line:
            return line
    raise AssertionError(f"no line with {words!r}")


def test_from_init_to_a_linked_mesh_and_to_a_revocation(machine: Callable[[str], Machine]) -> None:
    base, arm = machine("base"), machine("arm")
    out = base.trust("init", "--label", "lab")
    assert "base is the authority of a new mesh" in out
    assert "Keep a copy of that folder" in out
    assert "is a member of a secured mesh already; rmpa trust status shows it" in base.refused("init")
    assert "the agent base: does not run, so no module can join; start it: rmpa up" in base.refused("invite")
    base.up()
    assert "trust is off" not in base.log

    inviting = base.start("trust", "invite")
    assert inviting.stdout is not None
    token = inviting.stdout.readline().strip()
    _line(inviting, "waiting for the module")
    assert "arm has joined; its certificate ends" in arm.trust("join", "-", stdin=token + "\n")
    assert "arm has joined" in _line(inviting, "has joined")

    arm.up()
    until(lambda: arm.peers().get("base") == "linked" and base.peers().get("arm") == "linked")
    shown = base.status()
    assert (shown["is_authority"], shown["agent"], shown["problems"]) == (True, "secured", [])
    assert [(m["name"], m["linked"]) for m in shown["members"]] == [("arm", True), ("base", True)]  # type: ignore[attr-defined]
    assert arm.status()["authority"] == "base"
    assert "certificate: valid until" in base.trust("status")
    assert "arm has a new certificate until" in arm.trust("renew")
    assert "group key 2 is made" in base.trust("renew", "--group-key")
    assert "is not the authority of its mesh; do it at base" in arm.refused("revoke", "base")
    assert "did you mean arm?" in base.refused("revoke", "amr")
    assert "arm is revoked (deny list 1); there is a new group key" in base.trust("revoke", "arm")
    until(lambda: base.peers().get("arm") != "linked")
    assert base.status()["revoked"] == ["arm"]
    # It comes back: leave, join with a token from standard input, start again.
    arm.down()
    assert "arm has left its mesh" in arm.trust("leave", "--yes")
    token = base.trust("invite", "--no-wait").strip()
    arm.trust("join", "-", stdin=token + "\n")
    arm.up()
    until(lambda: arm.peers().get("base") == "linked")
    for secret in (token, token.removeprefix("rmpa1-")):
        assert secret not in base.log + arm.log


def test_a_token_that_cannot_be_used(machine: Callable[[str], Machine]) -> None:
    base, arm, gripper = machine("base"), machine("arm"), machine("gripper")
    base.trust("init")
    base.up()
    token = base.trust("invite", "--no-wait", "--module", "gripper").strip()
    assert "the token is mistyped" in arm.refused("join", token[:-2] + "aa", code=2)
    assert "it is not whole" in arm.refused("join", token[:-9], code=2)
    assert "does not begin with rmpa1-" in arm.refused("join", "-", stdin="\n", code=2)
    assert token not in arm.refused("join", token[:-2] + "aa", code=2)
    assert "join with the --name that it is for" in arm.refused("join", token)
    assert arm.status()["on"] is False  # nothing is left behind
    gripper.trust("join", token)
    err = arm.refused("join", "--name", "gripper", token)
    assert "gripper cannot join: the token was used (used)" in err
    assert "each token lets one module join; ask for a new one: rmpa trust invite" in err
    assert "No such option: --yes; leave it out: nothing is asked" in arm.refused("join", "--yes", token, code=2)
    token = base.trust("invite", "--no-wait").strip()
    base.down()
    assert "no authority answers at" in arm.refused("join", token)


def test_errors_of_json_and_of_options(machine: Callable[[str], Machine]) -> None:
    arm = machine("arm")
    assert arm.status()["on"] is False
    assert "trust is off: arm (name in rmpa.toml) has joined no secured mesh" in arm.trust("status")
    for words, arguments, code in (
        ("needs a TOKEN, --request or --accept", ("join",), 2),
        ("is not a time up to 30 d", ("invite", "--for", "1y"), 2),
        ("'x' is no port", ("invite", "--address", "10.0.0.1:x"), 2),
        ("has joined no secured mesh; make a mesh: rmpa trust init", ("invite",), 1),
        ("has joined no secured mesh", ("revoke", "base"), 1),
        ("has joined no secured mesh", ("renew",), 1),
        ("there is nothing to remove", ("leave", "--yes"), 1),
        ("not a ROS base name", ("status", "--name", "my arm"), 2),
    ):
        found, out, err = arm.run("trust", *arguments, "--json")
        assert (found, words in err) == (code, True), err
        assert words in json.loads(out)["error"]
    arm.trust("init")
    assert "nothing was removed" in arm.refused("leave", stdin="n\n", code=2)
    assert "add --yes" in arm.refused("leave", code=2)
    store = arm.folder / ".local/state/rmpa/arm/trust"
    (store / "keys.json").unlink()
    for command in ("status", "renew"):
        assert "keys.json: is missing; join again" in arm.refused(command)
    code, _, err = arm.run("up")
    assert (code, "keys.json: is missing; join again" in err) == (1, True), err
    arm.trust("leave", "--yes")


def test_a_join_by_files(machine: Callable[[str], Machine]) -> None:
    base, arm = machine("base"), machine("arm")
    base.trust("init")
    csr = arm.folder / "arm.csr"
    out = arm.trust("join", "--request", str(csr))
    shown = re.search(r"with the key ([0-9a-f ]+);", out)
    assert shown is not None
    code, out, err = base.run("trust", "invite", "--sign", str(csr), stdin="y\n")
    assert code == 0, err
    assert f"arm asks with the key {shown[1]}" in err
    ca = re.search(r"--ca ([0-9a-f]+) --name arm$", out, re.MULTILINE)
    assert ca is not None
    answer = Path(f"{csr}.answer")
    assert answer.stat().st_mode & 0o077 == 0
    assert "exists already" in base.refused("invite", "--yes", "--sign", str(csr), code=2)
    assert "does not have the fingerprint of --ca" in arm.refused(
        "join", "--accept", str(answer), "--ca", "0" * 32, code=2
    )
    assert "is not 32 hexadecimal digits" in arm.refused("join", "--accept", str(answer), code=2)
    assert "is no answer of rmpa trust invite" in arm.refused("join", "--accept", str(csr), "--ca", ca[1], code=2)
    arm.trust("join", "--accept", str(answer), "--ca", ca[1])
    assert arm.status()["on"] is True
    assert not (arm.folder / ".local/state/rmpa/arm/trust/request.key").exists()
    assert "is no request" in base.refused("invite", "--sign", str(answer), code=2)
    base.up()
    arm.up()
    until(lambda: arm.peers().get("base") == "linked")


def test_an_agent_without_trust_warns_and_says_that_it_must_be_started_again(
    machine: Callable[[str], Machine],
) -> None:
    base = machine("base")
    base.up()
    until(lambda: "peers can find it" in base.log and "trust is off" in base.log)
    assert base.log.count("trust is off: every program that reaches port") == 1
    out = base.run("trust", "init")
    assert "the agent base runs without its keys; restart it: end it (Ctrl-C), then rmpa up" in out[2]
    shown = base.status()
    assert (shown["on"], shown["agent"]) == (True, "plain")
    assert "restart it: end it" in str(shown["problems"])
    assert "runs without its keys, so no module can join; restart it: end it" in base.refused("invite")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_ctrl_c_or_a_closed_terminal_withdraws_the_token(
    machine: Callable[[str], Machine], number: signal.Signals
) -> None:
    base, arm = machine("base"), machine("arm")
    base.trust("init")
    base.up()
    inviting = base.start("trust", "invite", "--json")
    assert inviting.stdout is not None
    token = json.loads(inviting.stdout.readline())["token"]
    inviting.send_signal(number)
    _, err = inviting.communicate(timeout=DEADLINE)
    assert (inviting.returncode, "the token is withdrawn" in err) == (130, True), err
    assert "arm cannot join: the token is unknown here (token)" in arm.refused("join", token)
