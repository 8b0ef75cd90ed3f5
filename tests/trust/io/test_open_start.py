"""A start without trust beside keys of this user's other modules: refused, with what to do."""

from __future__ import annotations

import os
import pwd
from typing import TYPE_CHECKING

import pytest

from rmpa.config.module_name import note_state_dir
from rmpa.config.settings import TrustSettings
from rmpa.core.errors import StartError
from rmpa.trust.store import TrustStore, check_open

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def _keys(state: Path, module: str = "sec", file: str = "module.crt") -> None:
    (state / module / "trust").mkdir(parents=True)
    (state / module / "trust" / file).write_text("something")


def _only_the_authority(state: Path) -> None:
    _keys(state, file="authority.json")


def _dangling_module(state: Path) -> None:
    state.mkdir()
    (state / "sec").symlink_to(state / "not mounted")


def _dangling_trust(state: Path) -> None:
    (state / "sec").mkdir(parents=True)
    (state / "sec" / "trust").symlink_to(state / "not mounted")


def _dangling_state(state: Path) -> None:
    state.symlink_to(state.parent / "not mounted")


def _file_for_folder(state: Path) -> None:
    (state / "sec").mkdir(parents=True)
    (state / "sec" / "trust").write_text("")


@pytest.mark.parametrize("module", ["sec", "other"])
@pytest.mark.parametrize(
    "made", [_keys, _only_the_authority, _dangling_module, _dangling_trust, _dangling_state, _file_for_folder]
)
def test_what_may_be_a_secured_module_never_counts_as_an_open_one(
    tmp_path: Path, made: Callable[[Path], None], module: str
) -> None:
    state = tmp_path / "state"
    made(state)
    try:
        secured = TrustStore(state, module).exists
        if not secured:
            check_open(TrustSettings(), state, module, {"HOME": str(tmp_path)})
    except StartError as error:
        assert error.remedy  # noqa: PT017 - either is right: secured, or an error
    else:
        assert secured, "an open start"


def test_keys_of_another_name_are_named_with_what_to_do(tmp_path: Path) -> None:
    home = {"HOME": str(tmp_path)}
    check_open(TrustSettings(), tmp_path, "other", home)
    _keys(tmp_path)
    (tmp_path / "plain").mkdir()
    with pytest.raises(StartError) as error:
        check_open(TrustSettings(), tmp_path, "other", home)
    text = str(error.value)
    assert "the module other: has no keys" in text
    assert f"beside keys of sec here in {tmp_path}" in text
    for remedy in ("start as sec: --name sec", "rmpa trust join TOKEN --name other", "--insecure"):
        assert remedy in text


def test_another_or_a_forgotten_state_directory_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = {"HOME": str(tmp_path)}
    usual, data = tmp_path / ".local/state/rmpa", tmp_path / "data"
    _keys(data)
    monkeypatch.setenv("TEST_HOME", str(tmp_path))
    assert note_state_dir(data) == ""
    for used in (usual, tmp_path / "third"):  # forgotten; and another one
        with pytest.raises(StartError, match=f"in {data}; start with RMPA_STATE_DIR={data} --name sec; or"):
            check_open(TrustSettings(), used, "sec", home)
    with pytest.raises(StartError, match=f"RMPA_STATE_DIR={data} --name sec"):
        check_open(TrustSettings(), usual, "other", home)
    _keys(usual)
    with pytest.raises(StartError, match=f"keys of sec in {usual}"):
        check_open(TrustSettings(), tmp_path / "third", "sec", home)
    _keys(data, "arm")
    with pytest.raises(StartError, match=f"RMPA_STATE_DIR={data} --agent arm"):  # where its own keys are
        check_open(TrustSettings(), tmp_path / "third", "arm", home, "--agent")


@pytest.mark.parametrize("environ", [{}, {"HOME": "/nonexistent", "SUDO_UID": str(os.geteuid())}])
def test_keys_in_the_home_directory_are_noticed_without_home_and_under_sudo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environ: dict[str, str]
) -> None:
    user = pwd.struct_passwd(("me", "x", os.geteuid(), 0, "", str(tmp_path), "/bin/sh"))
    monkeypatch.setattr(pwd, "getpwuid", {os.geteuid(): user}.__getitem__)
    check_open(TrustSettings(), None, "other", environ)
    _keys(tmp_path / ".local/state/rmpa")
    with pytest.raises(StartError, match="keys of sec in "):
        check_open(TrustSettings(), None, "other", environ)


def test_a_directory_that_is_not_in_use_and_belongs_to_another_user_does_not_matter(tmp_path: Path) -> None:
    (tmp_path / "rmpa").write_text("")
    check_open(TrustSettings(), tmp_path / "own", "m", {"XDG_STATE_HOME": str(tmp_path)})


def test_a_gateway_is_not_told_to_start_as_the_module(tmp_path: Path) -> None:
    _keys(tmp_path)
    with pytest.raises(StartError) as error:
        check_open(TrustSettings(), tmp_path, "sec_gateway", {"HOME": str(tmp_path)})
    assert "; let sec_gateway join: rmpa trust join TOKEN --name sec_gateway; or" in str(error.value)
    assert "--name sec;" not in str(error.value)
