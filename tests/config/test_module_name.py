"""Which module a command is about, and the name that is kept for the commands to come."""

from __future__ import annotations

import os
import pwd
from pathlib import Path
from typing import Any

import pytest

from rmpa.config import module_name
from rmpa.config.module_name import (
    NAME_FILE,
    ModuleName,
    NameSource,
    as_owner,
    choose_name,
    keep_name,
    kept_name,
    note_state_dir,
    other_state_dirs,
    usual_state_dirs,
)
from rmpa.config.read import load_settings
from rmpa.core.errors import ConfigError, RmpaError


@pytest.mark.parametrize(
    ("names", "running", "name", "source"),
    [
        ({"default": "host"}, {}, "host", NameSource.DEFAULT),
        ({"kept": "first", "default": "host"}, {}, "first", NameSource.KEPT),
        ({"kept": "first"}, {"running": ("a",)}, "a", NameSource.RUNNING),
        ({"kept": "first"}, {"running": ("a", "first")}, "first", NameSource.RUNNING),
        ({"kept": "a"}, {"running": ("a", "b"), "of_master": "b"}, "b", NameSource.RUNNING),
        ({}, {"running": ("a", "a_gateway"), "gateways": ("a_gateway",)}, "a", NameSource.RUNNING),
        ({}, {"running": ("a_gateway",), "gateways": ("a_gateway",)}, "a_gateway", NameSource.RUNNING),
        ({"file": "said", "kept": "first"}, {"running": ("a",)}, "said", NameSource.FILE),
        ({"variable": "v", "file": "said"}, {"running": ("a", "b")}, "v", NameSource.VARIABLE),
        ({"agent_variable": "r", "variable": "v", "file": "said"}, {}, "r", NameSource.AGENT_VARIABLE),
        ({"option": "o", "agent_variable": "r"}, {"running": ("a",)}, "o", NameSource.OPTION),
    ],
)
def test_what_is_said_wins_then_what_runs_then_what_is_kept(
    names: dict[str, str], running: dict[str, Any], name: str, source: NameSource
) -> None:
    assert choose_name(_named(names), **running) == ModuleName(name, source)


def _named(names: dict[str, str]) -> dict[NameSource, str]:
    return {NameSource[source.upper()]: name for source, name in names.items()}


def test_of_several_agents_none_is_guessed() -> None:
    with pytest.raises(RmpaError, match=r"several agents run on this machine: a, b; name one with --agent"):
        choose_name(_named({"kept": "c", "default": "host"}), ("a", "b"))


def test_the_first_name_is_kept_and_holds_where_none_is_said(tmp_path: Path) -> None:
    environ = {"RMPA_STATE_DIR": str(tmp_path / "state")}

    def name(**options: object) -> str:
        return load_settings(options, environ, host_name="my-robot", cwd=tmp_path).settings.name

    assert name() == "my_robot"
    assert keep_name(tmp_path / "state", "arm")
    assert not keep_name(tmp_path / "state", "base"), "the first one stays"
    assert name() == "arm"
    assert name(name="base") == "base"
    (tmp_path / "rmpa.toml").write_text('name = "said"\n')
    assert name() == "said"
    assert keep_name(tmp_path / "state", "base", instead=True)
    assert kept_name(tmp_path / "state") == "base"


def test_a_broken_file_of_the_name_is_an_error_and_not_another_module(tmp_path: Path) -> None:
    (tmp_path / NAME_FILE).write_text("my arm\n")
    with pytest.raises(ConfigError, match="'my arm' is not a ROS base name") as error:
        load_settings({}, {"RMPA_STATE_DIR": str(tmp_path)}, host_name="h", cwd=tmp_path)
    assert str(tmp_path / NAME_FILE) in str(error.value)
    assert "remove the file" in str(error.value)


def test_a_pipe_in_place_of_the_name_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / NAME_FILE)
    assert not kept_name(tmp_path)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root writes for another user")
def test_a_name_that_root_keeps_belongs_to_the_user_of_the_agent_wherever_links_of_that_user_lead(
    tmp_path: Path,
) -> None:
    state, other = tmp_path / "state", tmp_path / "other"
    state.mkdir()
    other.write_text("root's")
    os.chown(state, 65534, 65534)
    (state / f".{NAME_FILE}.{os.getpid()}").symlink_to(other)
    rights = (os.geteuid(), os.getegid(), os.getgroups(), Path.cwd())
    with as_owner(state) as here, pytest.raises(PermissionError):
        (here / f".{NAME_FILE}.{os.getpid()}").write_bytes(b"arm")
    assert keep_name(state, "arm")
    assert (other.read_text(), other.stat().st_uid) == ("root's", 0)
    assert ((state / NAME_FILE).stat().st_uid, kept_name(state)) == (65534, "arm")
    assert (os.geteuid(), os.getegid(), os.getgroups(), Path.cwd()) == rights


@pytest.fixture
def users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[int, Path]:
    """The home directory of each user, as the password database of a test has it."""
    homes = {os.geteuid(): tmp_path / "home"}
    homes[os.geteuid()].mkdir()

    def getpwuid(user: int) -> pwd.struct_passwd:
        return pwd.struct_passwd((str(user), "x", user, 0, "", str(homes[user]), "/bin/sh"))

    monkeypatch.setattr(pwd, "getpwuid", getpwuid)
    return homes


def test_a_state_directory_is_noted_where_no_variable_leads_and_found_by_every_start(
    tmp_path: Path, users: dict[int, Path]
) -> None:
    (data := tmp_path / "data").mkdir()
    usual = tmp_path / "home/.local/state/rmpa"
    for _ in range(2):
        assert note_state_dir(data) == ""
    assert (usual / "state-directories").read_text() == f"{data}\n"
    starts: list[dict[str, str]] = [
        {},
        {"HOME": str(tmp_path / "elsewhere")},
        {"XDG_STATE_HOME": str(tmp_path / "xdg"), "HOME": str(tmp_path / "home")},
        {"RMPA_STATE_DIR": str(tmp_path / "third"), "HOME": "/nonexistent", "SUDO_UID": "99999999999999999999"},
    ]
    for environ in starts:
        assert {usual, data} <= set(other_state_dirs(environ, tmp_path / "third")), environ
        assert usual not in other_state_dirs(environ, usual)
        assert usual_state_dirs(environ)[-1] == usual
    for known in (usual, Path("/var/lib/rmpa")):  # every start looks there
        assert note_state_dir(known) == ""
    assert (usual / "state-directories").read_text() == f"{data}\n"


def test_a_note_of_an_earlier_release_is_found_where_the_variables_still_lead(
    tmp_path: Path, users: dict[int, Path]
) -> None:
    (tmp_path / "xdg/rmpa").mkdir(parents=True)
    (tmp_path / "xdg/rmpa/state-directories").write_text("/data\n")
    assert Path("/data") in other_state_dirs({"XDG_STATE_HOME": str(tmp_path / "xdg")}, None)


def test_why_a_state_directory_cannot_be_noted_is_said(
    tmp_path: Path, users: dict[int, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "home/.local").write_text("")
    assert "state-directories: Not a directory" in note_state_dir(tmp_path)
    (tmp_path / "home/.local").unlink()
    assert note_state_dir(tmp_path) == ""
    monkeypatch.setattr(module_name, "_READ_MAX", 70)
    (tmp_path / ("a" * 60)).mkdir()
    assert note_state_dir(tmp_path / ("a" * 60)).endswith("state-directories is full")
    users.clear()
    assert note_state_dir(tmp_path) == f"user {os.geteuid()} has no home directory in the password database"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root writes for another user")
def test_root_notes_a_directory_of_another_user_for_that_one_too_with_its_rights(
    tmp_path: Path, users: dict[int, Path]
) -> None:
    (data := tmp_path / "data").mkdir()
    os.chown(data, 65534, 65534)
    users[65534] = tmp_path / "nobody"
    users[65534].mkdir()
    assert note_state_dir(data) == f"{users[65534]} does not belong to user 65534"
    os.chown(users[65534], 65534, 65534)
    for folder in (tmp_path, *tmp_path.parents):
        if folder.stat().st_uid == 0 and folder != Path("/"):
            folder.chmod(folder.stat().st_mode | 0o011)
    assert note_state_dir(data) == ""
    for home, owner in ((users[0], 0), (users[65534], 65534)):
        note = home / ".local/state/rmpa/state-directories"
        assert (note.read_text(), note.stat().st_uid) == (f"{data}\n", owner)
