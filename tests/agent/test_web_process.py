"""The agent starts rmpa web again, without depending on it."""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
import signal
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from rmpa.agent import process as limits
from rmpa.agent.process import ChildProcess, child_environment, web_command
from rmpa.config.settings import Settings, WebSettings

if TYPE_CHECKING:
    from pathlib import Path

DEADLINE = 30.0
WAITS = "import signal; signal.pause()"
PAUSES = "[signal.pause() for _ in iter(int, 1)]"


def touch(file: Path) -> str:
    return f"pathlib.Path({str(file)!r}).touch()"


Child = Callable[[str], ChildProcess]


@pytest.fixture
def child(tmp_path: Path) -> Child:
    """A child of an agent, which runs a program; several are of agents one after the other."""
    return lambda program: ChildProcess(
        "rmpa web", "web-stopped", [sys.executable, "-c", program], lambda: 1.0, tmp_path / "base.web"
    )


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(DEADLINE):
        while not condition():
            await asyncio.sleep(0.01)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "WEB_RESTART_FIRST", 0.01)


@pytest.mark.usefixtures("quick")
async def test_a_child_that_is_killed_is_started_again(child: Child) -> None:
    web = child(WAITS)
    await web.start()
    await until(lambda: web.pid)
    first = web.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    await until(lambda: web.pid not in (None, first))
    await web.close()
    assert web.pid is None


async def test_the_child_ends_with_the_agent(child: Child, tmp_path: Path) -> None:
    ready, file = tmp_path / "ready", tmp_path / "ended"
    asked = "import pathlib, signal; signal.signal(signal.SIGTERM, lambda *_: None)"
    web = child(f"{asked}; {touch(ready)}; signal.pause(); {touch(file)}")
    await web.start()
    await until(ready.exists)
    await web.close()
    assert file.exists()  # it was asked to end, not killed
    assert not (tmp_path / "base.web").exists()


async def test_a_child_that_does_not_end_is_killed(
    child: Child, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(limits, "WEB_END_TIMEOUT", 0.1)
    ready = tmp_path / "ready"
    web = child(f"import pathlib, signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); {touch(ready)}; {PAUSES}")
    await web.start()
    await until(ready.exists)
    pid = web.pid
    assert pid is not None
    await web.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.usefixtures("quick")
async def test_a_child_that_cannot_be_waited_for_is_found_again_and_no_second_one_starts(
    child: Child, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    children: list[int] = []

    def no_descriptor(pid: int) -> int:
        children.append(pid)
        while not runs.exists():  # until then SIGHUP, which the next attempt sends, would end it
            time.sleep(0.01)
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    runs = tmp_path / "runs"
    with monkeypatch.context() as patch:
        patch.setattr(os, "pidfd_open", no_descriptor)
        deaf = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)"
        web = child(f"{deaf}; open({str(runs)!r}, 'a').write('x'); {PAUSES}")
        await web.start()
        await until(lambda: "cannot be started" in caplog.text)
    await until(lambda: web.pid == children[0])
    assert runs.read_text() == "x"
    await web.close()


@pytest.mark.usefixtures("quick")
async def test_a_usage_error_is_not_tried_again(
    child: Child, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    web = child(f"import sys; open({str(tmp_path / 'runs')!r}, 'a').write('x'); sys.exit(2)")
    await web.start()
    await until(lambda: "not started again" in caplog.text)
    await web.close()
    assert (tmp_path / "runs").read_text() == "x"


@pytest.mark.usefixtures("quick")
async def test_a_program_that_is_not_there_costs_the_agent_nothing(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    web = ChildProcess("rmpa web", "web-stopped", ["/nonexistent/program"], lambda: 1.0, tmp_path / "base.web")
    await web.start()
    await until(lambda: caplog.text.count("cannot be started") >= 2)
    await web.close()


@pytest.mark.usefixtures("quick")
async def test_that_of_an_agent_before_is_taken_over(child: Child, tmp_path: Path) -> None:
    ready = tmp_path / "ready"
    program = f"import pathlib, signal; signal.signal(signal.SIGHUP, lambda *_: None);{touch(ready)}; {PAUSES}"
    former, web = child(program), child(program)
    pid = former._take_over_or_start()  # by an agent that is killed then
    await until(ready.exists)
    await web.start()
    await until(lambda: web.pid)
    assert web.pid == pid
    await web.close()
    assert former._process is not None
    assert former._process.wait() == -signal.SIGTERM


async def test_one_of_another_program_is_replaced(child: Child) -> None:
    former, web = child(WAITS), child(f"{WAITS}  # other settings")
    former._take_over_or_start()
    await web.start()
    await until(lambda: web.pid)
    assert former._process is not None
    assert former._process.wait() == -signal.SIGTERM
    assert web.pid != former._process.pid
    await web.close()


@pytest.mark.usefixtures("quick")
async def test_one_that_was_not_noted_is_left_alone(
    child: Child, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with (tmp_path / "base.web").open("wb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        web = child(WAITS)
        await web.start()
        await until(lambda: "its process is not known" in caplog.text)
        assert web.pid is None
    await until(lambda: web.pid)
    await web.close()


def test_its_command_and_environment_have_what_the_agent_was_told(tmp_path: Path) -> None:
    settings = Settings(
        name="base",
        web=WebSettings(enabled=True, port=9000, listen="0.0.0.0", token_file="t"),
        config_file=tmp_path / "rmpa.toml",
    )
    command = " ".join(web_command(settings))
    for part in ("--agent base", "--port 9000", "--listen 0.0.0.0", "--token-file t", "--config"):
        assert part in command
    settings = Settings(log_level="debug", log_json=True)
    of_systemd = {"NOTIFY_SOCKET": "/run/systemd/notify", "WATCHDOG_USEC": "10000000"}
    environ = child_environment(settings, {"RMPA_RUNTIME_DIR": "x", "RMPA_LOG_LEVEL": "error", **of_systemd})
    assert environ == {"RMPA_RUNTIME_DIR": "x", "RMPA_LOG_LEVEL": "debug", "RMPA_LOG_JSON": "true"}
