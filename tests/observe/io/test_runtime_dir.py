"""Where control sockets live, and the lock on an agent's name."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rmpa.core.errors import StartError
from rmpa.observe import control_client as module
from rmpa.observe.control_client import runtime_dir, runtime_dirs
from rmpa.observe.control_server import NameLock, make_runtime_dir

HOLD = """
import sys, signal
from pathlib import Path
from rmpa.observe.control_server import NameLock
lock = NameLock(Path(sys.argv[1]), "base")
print("held", flush=True)
sys.stdin.read()
"""


def test_the_order_of_places(monkeypatch: pytest.MonkeyPatch) -> None:
    both = {"RMPA_RUNTIME_DIR": "/a", "XDG_RUNTIME_DIR": "/run/user/1"}
    assert runtime_dir(both) == Path("/a")
    assert runtime_dir(both, "/setting") == Path("/setting")
    assert runtime_dir({"XDG_RUNTIME_DIR": "/run/user/1"}) == Path("/run/user/1/rmpa")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(os, "access", lambda *_: True)
    monkeypatch.setattr(module, "_is_a_units", lambda: False)
    assert runtime_dir({}) == Path("/run/rmpa")
    monkeypatch.setattr(os, "geteuid", lambda: 1234)
    assert runtime_dir({}) == Path("/tmp/rmpa-1234")


def test_the_directory_is_ours_alone(place: Path) -> None:
    make_runtime_dir(place / "deep" / "er")
    assert (place / "deep" / "er").stat().st_mode & 0o777 == 0o700
    open_one = place / "open"
    open_one.mkdir()
    open_one.chmod(0o755)
    make_runtime_dir(open_one)
    assert open_one.stat().st_mode & 0o777 == 0o700


def test_a_link_or_file_in_its_place_is_refused(place: Path) -> None:
    (place / "real").mkdir()
    (place / "link").symlink_to(place / "real")
    (place / "file").touch()
    for name in ("link", "file"):
        with pytest.raises(StartError, match="set RMPA_RUNTIME_DIR"):
            make_runtime_dir(place / name)
    assert runtime_dirs({"RMPA_RUNTIME_DIR": str(place / "link")}) == []


def test_a_directory_that_all_users_share_stays_as_it_is(place: Path) -> None:
    shared = place / "tmp"
    shared.mkdir()
    shared.chmod(0o1777)
    with pytest.raises(StartError, match="is shared by all users; set RMPA_RUNTIME_DIR"):
        make_runtime_dir(shared)
    assert shared.stat().st_mode & 0o7777 == 0o1777


def test_somebody_elses_directory_is_refused(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 4321)
    with pytest.raises(StartError, match=r"belongs to user \d+"):
        make_runtime_dir(place)


def test_root_finds_the_agent_of_a_services_user(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if os.geteuid() == 0:
        os.chown(place, 1234, -1)
    monkeypatch.setattr(os, "geteuid", lambda: 4321)  # and so the directory is somebody else's
    assert place not in runtime_dirs({})
    monkeypatch.setattr(module, "_SYSTEM", place)
    assert place in runtime_dirs({})


def test_an_agent_of_root_beside_the_service_has_a_directory_of_its_own(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(module, "_SYSTEM", place / "none")
    assert runtime_dir({}) == place / "none"
    monkeypatch.setattr(module, "_SYSTEM", place)
    monkeypatch.setattr(module, "_is_a_units", lambda: True)
    assert runtime_dir({}) == Path("/tmp/rmpa-0")
    assert place in runtime_dirs({})


def test_a_client_with_rmpa_runtime_dir_looks_only_there(place: Path) -> None:
    assert runtime_dirs({"RMPA_RUNTIME_DIR": str(place)}) == [place]
    assert runtime_dirs({"RMPA_RUNTIME_DIR": str(place / "none")}) == []


def test_a_name_is_held_once(place: Path) -> None:
    first = NameLock(place, "base")
    with pytest.raises(StartError) as info:
        NameLock(place, "base")
    assert f"an agent named 'base' already runs on this machine (pid {os.getpid()})" in str(info.value)
    assert "--name" in str(info.value)
    NameLock(place, "other").release()
    first.release()
    first.release()
    assert list(place.iterdir()) == []
    NameLock(place, "base").release()


def test_a_killed_holder_lets_go(place: Path) -> None:
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(place)], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True
    )
    with holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(StartError, match=f"pid {holder.pid}"):
            NameLock(place, "base")
        holder.send_signal(signal.SIGKILL)
        holder.wait(10)
    assert (place / "base.lock").exists()
    NameLock(place, "base").release()


def test_a_full_disk_does_not_keep_an_agent_from_starting(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        lock = NameLock(place, "base")
    with pytest.raises(StartError, match="already runs on this machine"):
        NameLock(place, "base")
    lock.release()
