"""What ``rmpa doctor --fix`` may do, by what is found."""

from __future__ import annotations

import fcntl
import os
import socket
import subprocess
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rmpa.config.settings import ResourceSettings, Settings
from rmpa.observe.check import Check
from rmpa.observe.doctor.machine import DoctorInput
from rmpa.observe.doctor.repairs import Repair, directories, of_directories, of_group, of_leavings, of_mode, of_unit

if TYPE_CHECKING:
    from collections.abc import Callable

as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file to another user")
UNIT = {"LoadState": "loaded", "ActiveState": "active", "UnitFileState": "enabled"}


def do(repair: Repair | Check) -> None:
    """What ``--fix`` does for a repair in this user's directories."""
    assert isinstance(repair, Repair)
    assert repair.do
    repair.do()


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
    place = tmp_path / "a dir/rmpa"
    place.mkdir(parents=True)
    for way in ("command", "do") if after is not None else ():
        place.chmod(mode)
        (repair,) = of_mode(place, 0o027, "g-w,o-rwx")
        assert isinstance(repair, Repair)
        do(repair) if way == "do" else subprocess.run(repair.words, check=True)
        assert place.stat().st_mode & 0o777 == after
        subprocess.run(repair.undo, shell=True, check=True)
        assert place.stat().st_mode & 0o777 == mode
    place.chmod(after or mode)
    assert [*of_mode(place, 0o027, "g-w,o-rwx")] == []


@pytest.mark.parametrize(("name", "mode", "words"), [("rmpa", 0o1777, "other users share"), ("home", 0o755, "0755")])
def test_the_mode_of_a_directory_that_others_may_use_is_for_the_user_to_change(
    tmp_path: Path, name: str, mode: int, words: str
) -> None:
    place = tmp_path / name
    place.mkdir()
    place.chmod(mode)
    (check,) = of_mode(place, 0o027, "g-w,o-rwx")
    assert isinstance(check, Check)
    assert words in check.text
    given = DoctorInput({"RMPA_RUNTIME_DIR": str(place)}, Settings(), (), {}, ())
    assert "--fix" not in next(iter(directories(given))).remedy


def test_a_folder_of_resources_that_others_may_write_is_told(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    given = DoctorInput({}, Settings(resources=ResourceSettings(str(tmp_path))), (), {}, ())
    assert any(check.where == str(tmp_path) and "0777" in check.text for check in directories(given))
    tmp_path.chmod(0o755)
    assert not any(check.where == str(tmp_path) for check in directories(given))


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
    do(repair)
    assert [path.name for path in leavings.iterdir()] == ["other.txt"]


@pytest.mark.parametrize("by_command", [True, False])
def test_what_many_killed_agents_have_left_is_one_line(tmp_path: Path, by_command: bool) -> None:
    names = [f"robot_{number:02}" for number in range(18)]
    for name in names:
        with socket.socket(socket.AF_UNIX) as sock:
            sock.bind(str(tmp_path / f"{name}.sock"))
        (tmp_path / f"{name}.lock").touch()
    with (tmp_path / "robot_17.lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        (repair,) = of_leavings(tmp_path)
        assert repair.text.startswith("17 agents were killed")
        if by_command:
            subprocess.run(repair.words, check=True)
        else:
            do(repair)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["robot_17.lock", "robot_17.sock"]


def test_a_lock_that_is_held_stays_also_if_it_was_taken_since(leavings: Path) -> None:
    (repair,) = of_leavings(leavings)
    with (leavings / "base.lock").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert [*of_leavings(leavings)] == []
        assert subprocess.run(repair.words, check=False).returncode == 1
        with pytest.raises(BlockingIOError):
            do(repair)
    assert (leavings / "base.sock").exists()


def link(place: Path) -> None:
    (place / "base.lock").unlink()
    (place / "base.lock").symlink_to(place / "made")


def fifo(place: Path) -> None:
    (place / "base.lock").unlink()
    os.mkfifo(place / "base.lock")


@pytest.mark.parametrize(
    "change",
    [
        link,
        fifo,
        lambda place: (place / "base.lock").unlink(),
        lambda place: (place / "base.sock").unlink(),
        lambda place: (place / "base.sock").replace(place / "other.sock"),
        lambda place: [(place / f"base.{end}").replace(place / f".X0-{end}.{end}") for end in ("sock", "lock")],
        lambda place: place.chmod(0o1777),
        pytest.param(lambda place: os.chown(place, 12345, -1), marks=as_root),
        pytest.param(lambda place: os.lchown(place / "base.lock", 12345, -1), marks=as_root),
        pytest.param(lambda place: os.lchown(place / "base.sock", 12345, -1), marks=as_root),
    ],
)
def test_what_may_be_another_programs_or_users_stays_also_if_it_came_since(
    leavings: Path, change: Callable[[Path], object]
) -> None:
    (repair,) = of_leavings(leavings)
    change(leavings)
    before = sorted(leavings.iterdir())
    assert [*of_leavings(leavings)] == []
    with pytest.raises(OSError, match=r"."):
        do(repair)
    assert sorted(leavings.iterdir()) == before


def test_a_socket_that_is_listened_at_stays(tmp_path: Path) -> None:
    with closing(socket.socket(socket.AF_UNIX)) as sock:
        sock.bind(str(tmp_path / "base.sock"))
        sock.listen()
        (tmp_path / "base.lock").touch()
        assert [*of_leavings(tmp_path)] == []


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The home of this user, who is not root; what is made in it is root's."""
    os.chown(tmp_path, 12345, -1)
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    return tmp_path


def places(home: Path, state: str = "") -> DoctorInput:
    said = {"HOME": str(home), "RMPA_RUNTIME_DIR": str(home / "run"), "RMPA_STATE_DIR": state}
    return DoctorInput(said, Settings(), (), {}, ())


@as_root
def test_the_state_directory_that_is_roots_is_given_back(home: Path) -> None:
    state = home / ".local/state/rmpa"
    state.mkdir(parents=True)
    (repair,) = of_directories(places(home))
    assert isinstance(repair, Repair)
    assert repair.command == ("chown", "-h", "-R", "12345:", str(state))
    assert repair.undo == f"sudo chown -h -R 0 {state}"
    os.chown(state, 12345, -1)
    (check,) = directories(places(home))
    assert check.level == "ok"


@as_root
def test_a_folder_above_the_state_directory_is_for_the_user_to_give_back(home: Path) -> None:
    (home / ".local/state").mkdir(parents=True)
    (check,) = of_directories(places(home))
    assert isinstance(check, Check)
    assert check.remedy == f"sudo chown -h 12345: {home}/.local/state"


@as_root
@pytest.mark.parametrize("state", ["/var/lib/rmpa", "HOME/../elsewhere/rmpa", "HOME/link/rmpa", "HOME/theirs/rmpa"])
def test_no_directory_elsewhere_is_given_to_the_user(home: Path, state: str) -> None:
    inner = home / "inner"
    for place in (home / "elsewhere/rmpa", inner / "theirs/rmpa"):
        place.mkdir(parents=True)
    (inner / "link").symlink_to(home / "elsewhere")
    os.chown(inner, 12345, -1)
    os.chown(inner / "theirs", 23456, -1)
    assert [*of_directories(places(inner, state.replace("HOME", str(inner))))] == []
    assert [*of_directories(places(Path("/")))] == [], "a home that is root's"
