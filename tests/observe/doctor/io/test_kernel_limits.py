"""The limits of this machine, read as they are."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from rmpa.observe.doctor.io import kernel_limits
from rmpa.observe.doctor.io.kernel_limits import read_kernel_limits, read_setting
from rmpa.observe.snapshot import FilesInfo, Snapshot
from tests.observe.samples import SNAPSHOT


def shown(pid: int, limit: int) -> Snapshot:
    files = FilesInfo(open=57, limit=limit, hard=limit, reserved=64)
    return msgspec.structs.replace(SNAPSHOT, agent=msgspec.structs.replace(SNAPSHOT.agent, pid=pid, files=files))


def test_settings_are_read_by_their_names() -> None:
    assert read_setting("net.core.somaxconn") == int(Path("/proc/sys/net/core/somaxconn").read_text(encoding="ascii"))
    assert read_setting("net.core.no_such_setting") is None


def test_without_an_agent_the_limits_are_those_of_this_user() -> None:
    found = read_kernel_limits([])
    assert found.pid is None
    assert found.backlog
    assert found.memberships
    assert found.files is None or found.files > 0


def test_of_several_agents_the_one_with_the_fewest_files_counts() -> None:
    own = os.getpid()
    found = read_kernel_limits([shown(own, 4096), shown(own, 1024), shown(own, 2048)])
    assert (found.files, found.pid) == (1024, own)


def test_rmem_max_binds_a_process_without_cap_net_admin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_limits, "read_setting", lambda _: 4711)
    script = "import os, sys; os.geteuid() == 0 and os.setuid(65534); print('ready', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        assert read_kernel_limits([shown(process.pid, 1024)]).receive_buffer == 4711
        assert read_kernel_limits([shown(os.getpid(), 1024), shown(process.pid, 1024)]).receive_buffer == 4711
        process.communicate("")


@pytest.mark.skipif(os.geteuid() != 0, reason="root has CAP_NET_ADMIN")
def test_rmem_max_does_not_bind_root() -> None:
    assert read_kernel_limits([]).receive_buffer is None
    assert read_kernel_limits([shown(os.getpid(), 1024)]).receive_buffer is None
