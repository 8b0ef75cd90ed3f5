"""``rmpa doctor`` as a user runs it; kept to loopback."""

from __future__ import annotations

import json
import os
import pty
import socket
import subprocess
import sys
from collections.abc import Callable

import pytest

from rmpa.cli.doctor import _run
from rmpa.observe import limits
from rmpa.observe.doctor.checks import CHECKS
from rmpa.observe.doctor.repairs import Repair
from tests.cli.conftest import Place


@pytest.fixture
def loopback(place: Place) -> Place:
    """A shell whose settings keep to this machine, at ports of this test's own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        core = probe.getsockname()[1]
    lines = [f"[core]\nport = {core}", '[discovery]\ninterfaces = ["lo"]']
    lines.append(f'multicast = "239.255.82.77:{20000 + os.getpid() % 20000}"')
    (place.path / "rmpa.toml").write_text("\n".join(lines) + "\n")
    return place


def found(place: Place, *words: str, code: int = 0) -> dict[tuple[object, object], dict[str, object]]:
    ended, out, _ = place.run("doctor", "--json", *words)
    assert ended == code, out
    return {(f["check"], f["subject"]): f for f in json.loads(out)}


def test_every_check_answers(loopback: Place) -> None:
    loopback.environ["ROS_IP"] = "127.0.0.1"
    answers = found(loopback)
    checks = {check for check, _ in answers}
    assert checks == {
        *("settings", "agent", "interface", "multicast", "firewall", "rp_filter", "route", "port", "ROS", "clock"),
        *("radio", "directory"),
        *("realtime", "files", "boot", "exposed nodes"),
    }
    assert set(CHECKS) <= checks
    assert answers["multicast", "lo"]["level"] == "ok"
    assert str(answers["settings", ""]["text"]).startswith("read from rmpa.toml: name ")
    assert {str(f["level"]) for f in answers.values()} <= {"ok", "warn", "skipped"}
    code, out, err = loopback.run("doctor")
    assert (code, err) == (0, "")
    assert "multicast lo: 239.255.82.77:" in out
    assert out.splitlines()[-1].split()[1] == "answers:"


def test_an_agent_and_its_peers_are_looked_at(loopback: Place, agent: Callable[..., None]) -> None:
    agent()
    answers = found(loopback)
    assert answers["agent", "base"]["text"] == "no multicast on eth0", "the last one said of it"
    assert answers["peer", "base-pc"]["text"] == "linking: connection refused"
    assert ("route", "10.0.0.2 (joystick)") in answers
    code, out, _ = loopback.run("doctor", "--quiet")
    assert code == 0
    assert "shares its name" in out
    assert not any(line.startswith("ok") for line in out.splitlines())


def test_invalid_settings_are_reported_and_the_rest_is_checked(loopback: Place) -> None:
    (loopback.path / "bad.toml").write_text('[discovery]\ninterfaces = ["lo"]\n[core]\nprot = 1\n')
    loopback.environ["RMPA_INTERFACES"] = "lo"
    answers = found(loopback, "--config", "bad.toml", code=1)
    assert "bad.toml:4: core.prot: an unknown key" in str(answers["settings", "core.prot"]["text"])
    assert ("clock", "step") in answers


def test_a_core_port_that_somebody_else_has(loopback: Place) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        loopback.environ["RMPA_CORE_PORT"] = str(port)
        taken = found(loopback, code=1)["port", str(port)]
    assert taken["level"] == "fail"
    assert "Address already in use" in str(taken["text"])


def test_the_program_that_shares_the_port_of_beacons_is_named(loopback: Place) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("", 20000 + os.getpid() % 20000))
        (shared,) = [check for check in found(loopback).values() if "beacons" in str(check["text"])]
    assert (shared["level"], f"(pid {os.getpid()})" in str(shared["text"])) == ("ok", True), shared


@pytest.fixture
def killed(loopback: Place) -> Place:
    """A machine on which an agent was killed."""
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(loopback.path / "dead.sock"))
    (loopback.path / "dead.lock").touch()
    return loopback


def test_without_a_terminal_fix_shows_what_it_would_do(killed: Place) -> None:
    code, out, err = killed.run("doctor", "--fix")
    assert code == 1
    lock, sock = killed.path / "dead.lock", killed.path / "dead.sock"
    assert f"    do:   flock --nonblock {lock} rm -f {sock} {lock}\n    undo: nothing: the next agent" in out
    assert "nothing was changed: there is no terminal to ask on; --yes does it" in err
    assert sock.exists()
    code, out, _ = killed.run("doctor", "--fix", "--json")
    told = json.loads(out)
    assert (code, told["done"], [each["check"] for each in told["plan"]]) == (1, [], ["directory"])
    assert sock.exists()


def test_fix_does_it_and_checks_again(killed: Place) -> None:
    assert found(killed)["directory", str(killed.path)]["level"] == "warn"
    code, out, _ = killed.run("doctor", "--fix", "--yes", "--json")
    told = json.loads(out)
    assert told["done"] == [each["command"] for each in told["plan"]]
    levels = {each["check"]: each["level"] for each in told["checks"]}
    assert (levels["directory"], told["failed"]) == ("ok", [])
    assert code == int("fail" in levels.values())
    assert not (killed.path / "dead.sock").exists()
    assert "Nothing here can be repaired" in killed.run("doctor", "--fix")[1]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file to another user")
def test_root_changes_nothing_in_a_directory_of_another_user(loopback: Place) -> None:
    place, made = loopback.path / "rmpa", loopback.path / "made"
    place.mkdir()
    (place / "x.lock").symlink_to(made)
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(place / "x.sock"))
    os.chown(place, 12345, -1)
    del loopback.environ["RMPA_RUNTIME_DIR"]
    loopback.environ["XDG_RUNTIME_DIR"] = str(loopback.path)
    code, out, _ = loopback.run("doctor", "--fix", "--yes", "--json")
    told = json.loads(out)
    assert [each["command"] for each in told["plan"] if str(loopback.path) in each["command"]] == []
    assert not made.exists()
    assert (place / "x.sock").exists()
    assert code == int(bool(told["failed"]) or any(each["level"] == "fail" for each in told["checks"]))


def test_a_command_that_does_not_end_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "DOCTOR_REPAIR", 0.1)
    assert not _run(Repair("boot", "", "text", ("sleep", "60"), "undo"))


def test_what_is_the_users_is_printed_and_not_done(killed: Place) -> None:
    killed.environ["ROS_MASTER_URI"] = "http://203.0.113.7:11311"
    out = killed.run("doctor", "--fix")[1]
    mine, _, by_hand = out.partition("By hand, because you must decide:\n")
    assert "export ROS_MASTER_URI=http://localhost:11311, also in" in by_hand
    assert "ROS_MASTER_URI" not in mine


@pytest.mark.pty
@pytest.mark.parametrize(("answer", "stays"), [("n", True), ("y", False)])
def test_on_a_terminal_fix_asks(killed: Place, answer: str, stays: bool) -> None:
    ours, its = pty.openpty()
    command = [sys.executable, "-m", "rmpa.cli.main", "doctor", "--fix"]
    with subprocess.Popen(command, stdin=its, stdout=its, stderr=its, env=killed.environ, cwd=killed.path) as process:
        os.close(its)
        seen = b""
        while b"Run this command? [y/N] " not in seen:
            seen += os.read(ours, 65536)
        os.write(ours, f"{answer}\n".encode())
        try:
            while read := os.read(ours, 65536):
                seen += read
        except OSError:  # the other end was closed: it has ended
            pass
        os.close(ours)
    assert (killed.path / "dead.sock").exists() is stays
    assert (b"Checked again:" in seen) is not stays
    assert process.returncode == int(stays)
