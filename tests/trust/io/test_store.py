"""The files of a module, and an agent that must not start as an open one."""

from __future__ import annotations

import os
import pwd
import stat
from typing import TYPE_CHECKING

import pytest

from rmpa.config.module_name import note_state_dir
from rmpa.config.settings import TrustSettings
from rmpa.core.errors import StartError
from rmpa.trust import limits, store
from rmpa.trust.store import MemberFiles, TrustStore, check_open
from rmpa.trust.tokens import Invitation

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

FILES = MemberFiles(b"a private key", b"certificate", b"ca", b'{"keys": 1}', b'{"deny": 1}')


@pytest.fixture
def trust(tmp_path: Path) -> TrustStore:
    return TrustStore(tmp_path / "state", "arm")


def test_what_is_saved_is_loaded(trust: TrustStore) -> None:
    on = [trust.exists]
    trust.save(FILES)
    assert [*on, trust.exists] == [False, True]
    assert not trust.is_authority
    assert trust.load() == FILES
    again = MemberFiles(b"another key", b"new", b"ca", b"keys", b"deny")
    trust.save(again)
    assert trust.load() == again


def test_no_file_is_for_others_whatever_the_umask(trust: TrustStore) -> None:
    before = os.umask(0)
    try:
        trust.save(FILES)
        trust.write(store.CA_KEY, b"key")
    finally:
        os.umask(before)
    assert stat.S_IMODE(trust.folder.stat().st_mode) == 0o700
    names = sorted(path.name for path in trust.folder.iterdir())
    assert names == sorted([store.KEY, store.CERTIFICATE, store.CA, store.KEYS, store.DENY, store.CA_KEY])
    assert {stat.S_IMODE(path.stat().st_mode) for path in trust.folder.iterdir()} == {0o600}
    assert trust.is_authority


@pytest.mark.parametrize("name", [store.KEY, store.CERTIFICATE, store.CA, store.KEYS])
def test_a_missing_or_empty_file_is_named_with_a_remedy(trust: TrustStore, name: str) -> None:
    trust.save(FILES)
    trust.path(name).unlink()
    with pytest.raises(StartError, match=rf"{name}: is missing; join again: rmpa trust invite"):
        trust.load()
    assert trust.exists
    trust.write(name, b"")
    with pytest.raises(StartError, match="is broken: 0 bytes"):
        trust.load()


def test_a_broken_certificate_is_named(trust: TrustStore) -> None:
    trust.save(FILES)
    trust.write(store.CERTIFICATE, b"\xff nonsense")
    with pytest.raises(StartError, match=r"module.crt: is broken: not a certificate"):
        trust.load()


def test_a_file_that_others_may_read_is_refused(trust: TrustStore) -> None:
    trust.save(FILES)
    trust.path(store.KEY).chmod(0o644)
    with pytest.raises(StartError, match=r"can be read by others \(mode 644\).*chmod 600"):
        trust.load()


def test_links_and_pipes_are_not_followed(trust: TrustStore) -> None:
    trust.save(FILES)
    path = trust.path(store.KEYS)
    path.rename(path.with_name("elsewhere"))
    path.symlink_to(path.with_name("elsewhere"))
    with pytest.raises(StartError, match="cannot be read"):
        trust.load()
    path.unlink()
    os.mkfifo(path, 0o600)
    with pytest.raises(StartError, match="is not a file"):
        trust.load()


def test_a_folder_that_cannot_be_entered_never_turns_trust_off(trust: TrustStore) -> None:
    trust.save(FILES)
    hidden = trust.folder.rename(trust.folder.with_name("hidden"))
    trust.folder.symlink_to(trust.folder)  # an error also for root, who may enter every folder
    with pytest.raises(StartError, match=r"trust: cannot be searched: Too many levels"):
        _ = trust.exists
    assert trust.is_authority
    for read in (trust.load, trust.load_ca_key, trust.load_tokens):
        with pytest.raises(StartError, match="cannot be read"):
            read()
    trust.folder.unlink()
    assert not trust.exists
    trust.folder.write_bytes(b"")
    with pytest.raises(StartError, match=r"trust: is not a folder, so whether .* is not known; remove it"):
        _ = trust.exists
    trust.folder.unlink()
    hidden.rename(trust.folder)
    trust.path(store.DENY).unlink()
    trust.path(store.DENY).symlink_to(store.DENY)
    with pytest.raises(StartError, match=r"deny\.json: cannot be read"):
        trust.load()


def test_a_file_of_another_user_names_the_remedy(trust: TrustStore, monkeypatch: pytest.MonkeyPatch) -> None:
    trust.save(FILES)

    def refuse(path: Path, *_args: object, **_options: object) -> int:
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", refuse)
        patch.setattr(os, "lstat", refuse)
        assert trust.exists
        with pytest.raises(StartError, match="cannot be read: Permission denied; run it as the user of the agent"):
            trust.load()
    with monkeypatch.context() as patch:
        patch.setattr(os, "stat", refuse)
        with pytest.raises(StartError, match=r"cannot be searched: Permission denied, .*RMPA_STATE_DIR"):
            _ = trust.exists


def test_a_huge_file_is_not_read(trust: TrustStore) -> None:
    trust.save(FILES)
    trust.write(store.KEYS, bytes(limits.DOCUMENT_MAX + 1))
    with pytest.raises(StartError, match="is broken"):
        trust.load()


def test_a_failed_write_leaves_the_old_file(trust: TrustStore, monkeypatch: pytest.MonkeyPatch) -> None:
    trust.save(FILES)

    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StartError, match="No space left"):
        trust.write(store.KEY, b"new")
    monkeypatch.undo()
    assert trust.load() == FILES
    assert not [path for path in trust.folder.iterdir() if path.name.startswith(".")]


def test_tokens_survive(trust: TrustStore) -> None:
    invitation = Invitation(b"tokenid8", b"k" * 32, 1_790_000_000, "arm")
    assert trust.load_tokens() == []
    trust.save_tokens([invitation])
    assert trust.load_tokens() == [invitation]
    trust.write(store.TOKENS, b"{}")
    with pytest.raises(StartError, match=r"tokens.json: is broken: .*; remove it"):
        trust.load_tokens()


def test_a_lost_ca_key_has_a_remedy_of_its_own(trust: TrustStore) -> None:
    with pytest.raises(StartError, match=r"ca.key: is missing; only a copy brings it back"):
        trust.load_ca_key()
    trust.write(store.CA_KEY, b"key")
    assert trust.load_ca_key() == b"key"


def test_leaving_removes_everything(trust: TrustStore) -> None:
    trust.save(FILES)
    assert set(trust.remove()) == {store.KEY, store.CERTIFICATE, store.CA, store.KEYS, store.DENY}
    assert not trust.exists
    assert not trust.folder.exists()
    assert trust.remove() == []


def test_secrets_are_never_shown() -> None:
    assert "private" not in repr(FILES)
    assert "keys" not in repr(FILES).replace("keys=", "")


@pytest.mark.skipif(os.geteuid() != 0, reason="only root writes for another user")
def test_what_root_writes_belongs_to_the_owner_of_the_state_directory(tmp_path: Path) -> None:
    state = tmp_path / "state"
    state.mkdir()
    os.chown(state, 4321, 4321)
    trust = TrustStore(state, "arm")
    trust.save(FILES)
    assert {path.stat().st_uid for path in (trust.folder, *trust.folder.iterdir(), trust.folder.parent)} == {4321}
    assert trust.load() == FILES  # as the agent of that user would
    os.chown(trust.path(store.KEY), 1234, 1234)
    with pytest.raises(StartError, match="belongs to user 1234"):
        trust.load()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root writes for another user")
def test_a_link_of_the_owner_leads_root_to_nothing_of_others(tmp_path: Path) -> None:
    state, other = tmp_path / "state", tmp_path / "other"
    state.mkdir()
    (other / store.FOLDER).mkdir(parents=True)
    (other / store.FOLDER / store.CA).write_text("root's")
    before = [(path, path.stat()) for path in (other, other / store.FOLDER, other / store.FOLDER / store.CA)]
    os.chown(state, 4321, 4321)
    (state / "arm").symlink_to(other)
    trust = TrustStore(state, "arm")
    with pytest.raises(StartError, match=r"cannot be written: .*; run it as the user of the agent"):
        trust.save(FILES)
    with pytest.raises(StartError, match="cannot be removed"):
        trust.remove()
    trust.forget(store.CA)
    assert [(path, path.stat()) for path, _ in before] == before


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
