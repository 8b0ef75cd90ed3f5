"""Settings files that another user may write are refused, wherever on their way that is."""

from __future__ import annotations

import grp
import os
import pwd
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rmpa.config.read import INSECURE, load_settings
from rmpa.config.toml_file import other_writer
from rmpa.core.errors import ConfigError
from rmpa.gateway.ros2.pairs import TypeMapping

STRANGER = 12345
root = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files to another user")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A settings file in a folder of its own."""
    (tmp_path / "home").mkdir(mode=0o755)
    path = tmp_path / "home/rmpa.toml"
    path.write_text("domain = 7\n")
    path.chmod(0o644)
    return path


@pytest.fixture(autouse=True)
def private_group(monkeypatch: pytest.MonkeyPatch) -> dict[int, list[str]]:
    """The members of each group; those of this user's own are none."""
    members: dict[int, list[str]] = {os.getegid(): [], 500: ["other"]}
    users = [SimpleNamespace(pw_name="me", pw_uid=os.geteuid(), pw_gid=os.getegid())]
    users.append(SimpleNamespace(pw_name="other", pw_uid=STRANGER, pw_gid=500))
    monkeypatch.setattr(grp, "getgrgid", lambda group: SimpleNamespace(gr_mem=members[group]))
    monkeypatch.setattr(pwd, "getpwall", lambda: users)
    monkeypatch.setattr(pwd, "getpwnam", {each.pw_name: each for each in users}.__getitem__)
    return members


def refused(file: Path, environ: dict[str, str] | None = None) -> str:
    """What is said of the file; empty: it is obeyed."""
    found = other_writer(file, environ or {})
    return "; ".join(found) if found is not None else ""


def _other_owner(file: Path) -> Path:
    os.chown(file, STRANGER, -1)
    return file


def _other_folder(file: Path) -> Path:
    os.chown(file.parent, STRANGER, -1)
    return file.parent


def _all_may_write(file: Path) -> Path:
    file.chmod(0o646)
    return file


def _all_may_write_the_folder(file: Path) -> Path:
    file.parent.chmod(0o777)
    return file.parent


def _all_may_write_above(file: Path) -> Path:
    file.parents[1].chmod(0o777)
    return file.parents[1]


def _group_of_others(file: Path) -> Path:
    os.chown(file, -1, 500)
    file.chmod(0o664)
    return file


def _unknown_group(file: Path) -> Path:
    os.chown(file, -1, 501)
    file.chmod(0o664)
    return file


@root
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_other_owner, "belongs to user 12345; chown 0"),
        (_other_folder, "belongs to user 12345; chown 0"),
        (_all_may_write, "(mode 646); chmod o-w"),
        (_all_may_write_the_folder, "(mode 777); chmod o-w"),
        (_all_may_write_above, "(mode 777); chmod o-w"),
        (_group_of_others, "users of group 500 may write"),
        (_unknown_group, "users of group 501 may write"),
    ],
)
def test_a_file_that_another_user_may_write_is_not_obeyed(
    file: Path, tmp_path: Path, change: Callable[[Path], Path], says: str
) -> None:
    assert refused(file) == ""
    part = change(file)
    said = refused(file)
    assert says in said
    assert str(part) in said
    with pytest.raises(ConfigError, match="is not obeyed") as error:
        load_settings({"config": str(file)}, {}, host_name="h", cwd=tmp_path)
    assert (error.value.code, str(error.value.remedy).endswith(str(part)) or ":ro" in str(error.value)) == (
        "settings-exposed",
        True,
    )
    with pytest.raises(ConfigError, match="is not obeyed"):  # found in the folder where root stands
        load_settings({}, {}, host_name="h", cwd=file.parent)
    with pytest.raises(ConfigError, match=r"ros2\.mapping: is not obeyed"):  # a file that the settings name
        TypeMapping().read(file)


@root
def test_the_user_who_called_sudo_may_have_written_it(file: Path) -> None:
    os.chown(file, STRANGER, STRANGER)
    assert "belongs to user" in refused(file)
    assert refused(file, {"SUDO_UID": str(STRANGER)}) == ""
    assert "belongs to user" in refused(file, {"SUDO_UID": "999"})


@root
def test_a_folder_such_as_tmp_holds_files_of_each_user(file: Path) -> None:
    file.parent.chmod(0o1777)
    assert refused(file) == ""
    os.chown(file, STRANGER, -1)
    assert "belongs to user" in refused(file)


def test_the_group_of_a_user_alone_may_write(file: Path, private_group: dict[int, list[str]]) -> None:
    file.chmod(0o664)
    file.parent.chmod(0o775)
    assert refused(file) == ""
    private_group[os.getegid()] += ["me"]
    assert refused(file) == ""
    private_group[os.getegid()] += ["other"]
    assert f"users of group {os.getegid()} may write" in refused(file)


def test_a_list_of_further_users_counts_as_others(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "listxattr", lambda _: ["system.posix_acl_access"])
    assert refused(file) == ""
    file.chmod(0o664)
    assert "may write" in refused(file)


@root
def test_links_count_on_their_way_and_where_they_lead(file: Path, tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    link = tmp_path / "etc/rmpa.toml"
    link.symlink_to("../home/rmpa.toml")
    assert refused(link) == ""
    os.lchown(link, STRANGER, -1)
    assert str(link) in refused(link)
    os.lchown(link, 0, -1)
    file.parent.chmod(0o777)
    assert str(file.parent) in refused(link)
    file.parent.chmod(0o755)
    (tmp_path / "etc").chmod(0o777)
    assert str(tmp_path / "etc") in refused(link)


@root
def test_what_is_mounted_read_only_is_written_by_nobody_here(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.chown(file, STRANGER, -1)
    real: Any = os.statvfs
    monkeypatch.setattr(
        os, "statvfs", lambda part: SimpleNamespace(f_flag=os.ST_RDONLY) if part == file else real(part)
    )
    assert refused(file) == ""


@pytest.mark.parametrize("name", INSECURE)
def test_what_turns_a_protection_off_is_said_wherever_it_stands(file: Path, name: str) -> None:
    table, _, key = name.rpartition(".")
    gateway = {"RMPA_GATEWAY_LISTEN": "tcp/0.0.0.0:7447"}

    def said(options: dict[str, object], environ: dict[str, str]) -> list[str]:
        loaded = load_settings(options, environ | gateway, host_name="h", cwd=file.parents[1])
        return [note for note in loaded.notes if INSECURE[name] in note]

    file.write_text(f"[{table}]\n{key} = true\n")
    variable = f"RMPA_{table.upper()}_INSECURE"
    for options, environ, where in (
        ({"config": str(file)}, {}, f"{file}:2"),
        ({}, {variable: "1"}, variable),
        ({"insecure": True}, {}, "--insecure"),
    ):
        (line,) = said(dict(options), environ)
        assert where in line
    file.write_text(f"[{table}]\n{key} = false\n")
    assert said({"config": str(file)}, {}) == []
    gateway.clear()
    assert len(said({"insecure": True}, {})) == (name == "trust.insecure"), "no endpoint, so no plain one"


def test_a_variable_that_outweighs_a_protection_of_the_file_is_said(file: Path) -> None:
    file.write_text('[trust]\nrequire = true\ndefault = "deny"\ndirect = false\n')
    weaker = {"RMPA_TRUST_REQUIRE": "0", "RMPA_TRUST_DEFAULT": "allow", "RMPA_TRUST_DIRECT": "1"}
    notes = load_settings({"config": str(file)}, weaker, host_name="h", cwd=file.parents[1]).notes
    assert notes == tuple(
        f"{variable}: less secure than {file}:{line}, which it outweighs" for line, variable in enumerate(weaker, 2)
    )
    same = {"RMPA_TRUST_REQUIRE": "1", "RMPA_TRUST_DEFAULT": "deny", "RMPA_TRUST_DIRECT": "0"}
    assert load_settings({"config": str(file)}, same, host_name="h", cwd=file.parents[1]).notes == ()
