"""What systemd hears of a process: its watchdog, by sd_watchdog_enabled(3)."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from rmpa.runtime.systemd import restart_text, watchdog_period

# An event loop that hangs at SIGUSR1.
_PROGRAM = """
import asyncio, signal, time
from rmpa.runtime.systemd import feed_watchdog, notify_service_manager

async def main():
    loop = asyncio.get_running_loop()
    loop.add_signal_handler(signal.SIGUSR1, hang)
    notify_service_manager("READY=1")
    feed_watchdog(loop)
    await asyncio.Event().wait()

def hang():
    time.sleep(60)

asyncio.run(main())
"""

# It has no descriptor left after the first sign of life.
_OUT_OF_DESCRIPTORS = """
import asyncio, resource
from rmpa.runtime.systemd import feed_watchdog

async def main():
    feed_watchdog(asyncio.get_running_loop())
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
    print("fed", flush=True)
    await asyncio.Event().wait()

asyncio.run(main())
"""


@pytest.mark.parametrize(
    ("environ", "period"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "10000000"}, 5),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": str(os.getpid())}, 5),
        ({"WATCHDOG_USEC": "10000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
    ],
)
def test_it_is_asked_for_by_variables(environ: dict[str, str], period: float | None) -> None:
    assert watchdog_period(environ) == period


@pytest.mark.parametrize(
    "command",
    ["up --interface lo --multicast off --core-port {port} --keep never", "web --port {port}"],
    ids=["up", "web"],
)
def test_a_program_of_a_unit_is_ready_and_then_gives_signs_of_life(command: str, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        words = command.format(port=free.getsockname()[1]).split()
        free.close()
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(30)
        environ = {name: value for name, value in os.environ.items() if not name.startswith(("RMPA_", "ROS_"))}
        environ |= {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "200000"}
        environ |= {"RMPA_RUNTIME_DIR": str(tmp_path / "run"), "RMPA_STATE_DIR": str(tmp_path / "state")}
        program = [sys.executable, "-m", "rmpa.cli.main", *words]
        with subprocess.Popen(program, env=environ, cwd=tmp_path, stdout=-1, stderr=-1) as process:
            try:
                assert [manager.recv(64) for _ in range(4)] == [b"READY=1", *[b"WATCHDOG=1"] * 3]
            finally:
                process.kill()


def test_a_loop_that_hangs_sends_nothing_and_the_log_says_where_it_hung(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        environ = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"}
        with subprocess.Popen([sys.executable, "-c", _PROGRAM], env=environ, stderr=subprocess.PIPE) as process:
            try:
                manager.settimeout(30)
                assert [manager.recv(64) for _ in range(4)] == [b"READY=1", *[b"WATCHDOG=1"] * 3]
                process.send_signal(signal.SIGUSR1)
                manager.settimeout(1)  # as WATCHDOG_USEC has it
                with contextlib.suppress(TimeoutError):
                    while manager.recv(64):
                        pass
                process.send_signal(signal.SIGABRT)
                assert process.stderr is not None
                assert b" in hang\n" in process.stderr.read()
                assert process.wait() == -signal.SIGABRT
            finally:
                process.kill()


def test_a_sign_of_life_that_failed_is_sent_soon_also_without_a_free_descriptor(tmp_path: Path) -> None:
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as others,
    ):
        manager.bind(str(tmp_path / "notify"))
        with contextlib.suppress(BlockingIOError):  # until its queue is full
            while others.sendto(b"READY=1", socket.MSG_DONTWAIT, str(tmp_path / "notify")):
                pass
        environ = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "120000000"}
        program = [sys.executable, "-c", _OUT_OF_DESCRIPTORS]
        with subprocess.Popen(program, env=environ, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline() == b"fed\n"
                manager.settimeout(30)  # half of what the next regular one takes
                while manager.recv(64) == b"READY=1":
                    pass
            finally:
                process.kill()
            assert process.stderr is not None
            assert process.stderr.read().count(b"cannot be told WATCHDOG=1") == 1


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("0::/system.slice/rmpa.service", "sudo systemctl restart rmpa"),
        ("5:pids:/system.slice/rmpa-gateway.service\n0::/", "sudo systemctl restart rmpa-gateway"),
        ("0::/user.slice/user-1000.slice/user@1000.service/app.slice/rmpa.service", "end it (Ctrl-C), then rmpa up"),
    ],
)
def test_an_agent_is_restarted_by_its_unit(monkeypatch: pytest.MonkeyPatch, line: str, text: str) -> None:
    monkeypatch.setattr(Path, "read_text", lambda *_: f"{line}\n")
    assert restart_text(7) == text
