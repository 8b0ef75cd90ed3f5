"""What ``rmpa doctor --fix`` may do, by what is found."""

from __future__ import annotations

import fcntl
import os
import socket
import subprocess
from contextlib import closing
from typing import TYPE_CHECKING

import pytest

from rmpa.config.settings import Settings
from rmpa.observe.doctor.machine import DoctorInput
from rmpa.observe.doctor.repairs import Repair, directories, of_directories, of_group, of_leavings, of_mode, of_unit

if TYPE_CHECKING:
    from pathlib import Path

UNIT = {"LoadState": "loaded", "ActiveState": "active", "UnitFileState": "enabled"}


@pytest.mark.parametrize(
    ("changes", "agent_runs", "command"),
    [
        ({}, True, ""),
        ({"ActiveState": "inactive"}, False, "systemctl start rmpa.service"),
        ({"ActiveState": "failed"}, False, "systemctl start rmpa.service"),
        ({"ActiveState": "inactive"}, True, ""),  # the other agent has its ports
        ({"UnitFileState": "disabled"}, True, "systemctl enable rmpa.service"),
        ({"ActiveState": "inactive", "UnitFileState": "disabled"}, False, ""),  # it was switched off
        ({"ActiveState": "inactive", "UnitFileState": "masked"}, False, ""),
        ({"LoadState": "not-found", "ActiveState": "inactive", "UnitFileState": ""}, False, ""),
    ],
)
def test_a_unit_is_started_or_enabled_where_it_is_half_on(
    changes: dict[str, str], agent_runs: bool, command: str
) -> None:
    found = [*of_unit(UNIT | changes, agent_runs=agent_runs)]
    assert " ".join(" ".join(repair.command) for repair in found) == command
    assert all(repair.root and repair.undo.startswith("sudo systemctl ") for repair in found)


def test_a_user_is_added_to_the_group_once() -> None:
    assert [*of_group("", "arm", member=False)] == []
    assert [*of_group("rmpa", "arm", member=True)] == []
    (repair,) = of_group("rmpa", "arm", member=False)
    assert repair.command == ("usermod", "-aG", "rmpa", "arm")
    assert repair.undo == "sudo gpasswd -d arm rmpa"
    assert "after the next log-in it may" in repair.text


def test_who_needs_sudo_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    repair = Repair("boot", "", "text", ("systemctl", "start", "rmpa.service"), "undo", root=True)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert str(repair) == "sudo systemctl start rmpa.service"
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert str(repair) == "systemctl start rmpa.service"


@pytest.mark.parametrize(("mode", "after"), [(0o777, 0o750), (0o600, 0o700), (0o700, None), (0o750, None)])
def test_a_directory_gets_a_mode_that_is_of_use(tmp_path: Path, mode: int, after: int | None) -> None:
    place = tmp_path / "a dir"
    place.mkdir()
    place.chmod(mode)
    found = [*of_mode(place, 0o027, "g-w,o-rwx")]
    assert bool(found) == (after is not None)
    for repair in found:
        subprocess.run(repair.words, check=True)
        assert place.stat().st_mode & 0o777 == after
        subprocess.run(repair.undo, shell=True, check=True)
        assert place.stat().st_mode & 0o777 == mode


@pytest.fixture
def leavings(tmp_path: Path) -> Path:
    """A directory with what a killed agent has left."""
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(tmp_path / "base.sock"))
    (tmp_path / "base.lock").write_text("4711\n")
    return tmp_path


def test_what_a_killed_agent_has_left_is_removed(leavings: Path) -> None:
    (leavings / "other.txt").touch()
    (repair,) = of_leavings(leavings)
    assert "base was killed, and has left base.sock and base.lock" in repair.text
    subprocess.run(repair.words, check=True)
    assert [path.name for path in leavings.iterdir()] == ["other.txt"]


def test_a_lock_that_is_held_stays_also_if_it_was_taken_since(leavings: Path) -> None:
    (repair,) = of_leavings(leavings)
    with (leavings / "base.lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert [*of_leavings(leavings)] == []
        assert subprocess.run(repair.words, check=False).returncode == 1
    assert (leavings / "base.sock").exists()


def test_a_socket_that_is_listened_at_stays(tmp_path: Path) -> None:
    with closing(socket.socket(socket.AF_UNIX)) as sock:
        sock.bind(str(tmp_path / "base.sock"))
        sock.listen()
        assert [*of_leavings(tmp_path)] == []


def test_the_directories_of_another_user_in_this_home_are_given_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = tmp_path / ".local/state/rmpa"
    state.mkdir(parents=True)
    given = DoctorInput({"HOME": str(tmp_path), "RMPA_RUNTIME_DIR": str(tmp_path / "run")}, Settings(), (), {}, ())
    assert [*of_directories(given)] == []
    (check,) = directories(given)
    assert check.level == "ok"
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    (repair,) = of_directories(given)
    assert repair.command == ("chown", "-R", "12345:", str(state))
    assert repair.undo == f"sudo chown -R {os.getuid()} {state}"
    state.rmdir()
    (repair,) = of_directories(given)
    assert repair.command == ("chown", "12345:", str(state.parent)), "the folder above, and nothing else in it"
    elsewhere = DoctorInput({**given.environ, "RMPA_STATE_DIR": "/var/lib/rmpa"}, Settings(), (), {}, ())
    assert [*of_directories(elsewhere)] == [], "it is no directory of this user's home"
