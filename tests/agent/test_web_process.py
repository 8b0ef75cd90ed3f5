"""The agent starts rmpa web again, without depending on it."""

from __future__ import annotations

import asyncio
import errno
import os
import signal
import sys
from typing import TYPE_CHECKING

import pytest

from rmpa.agent import process as limits
from rmpa.agent.process import WebProcess, web_command, web_environment
from rmpa.config.settings import Settings, WebSettings

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

DEADLINE = 30.0


def child(program: str) -> WebProcess:
    return WebProcess([sys.executable, "-c", program], lambda: 1.0)


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(DEADLINE):
        while not condition():
            await asyncio.sleep(0.01)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "WEB_RESTART_FIRST", 0.01)


@pytest.mark.usefixtures("quick")
async def test_a_child_that_is_killed_is_started_again() -> None:
    web = child("import sys; sys.stdin.read()")
    web.start()
    await until(lambda: web.pid)
    first = web.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    await until(lambda: web.pid not in (None, first))
    await web.close()
    assert web.pid is None


async def test_the_child_ends_with_the_agent(tmp_path: Path) -> None:
    file = tmp_path / "ended"
    web = child(f"import sys; sys.stdin.read(); open({str(file)!r}, 'w').close()")
    web.start()
    await until(lambda: web.pid)
    await web.close()
    assert file.exists()  # by the end of its input: not killed


async def test_a_child_that_does_not_end_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "WEB_END_TIMEOUT", 0.1)
    web = child("import time; time.sleep(1000)")
    web.start()
    await until(lambda: web.pid)
    pid = web.pid
    assert pid is not None
    await web.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.usefixtures("quick")
async def test_a_child_that_cannot_be_waited_for_ends_before_the_next_one(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    children: list[int] = []

    def no_descriptor(pid: int) -> int:
        children.append(pid)
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    with monkeypatch.context() as patch:
        patch.setattr(os, "pidfd_open", no_descriptor)
        web = child("import time; time.sleep(1000)")
        web.start()
        await until(lambda: "cannot be started" in caplog.text)
    with pytest.raises(ProcessLookupError):
        os.kill(children[0], 0)
    await until(lambda: web.pid)
    monkeypatch.setattr(limits, "WEB_END_TIMEOUT", 0.1)
    await web.close()


@pytest.mark.usefixtures("quick")
async def test_a_usage_error_is_not_tried_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    web = child(f"import sys; open({str(tmp_path / 'runs')!r}, 'a').write('x'); sys.exit(2)")
    web.start()
    await until(lambda: "not started again" in caplog.text)
    await web.close()
    assert (tmp_path / "runs").read_text() == "x"


@pytest.mark.usefixtures("quick")
async def test_a_program_that_is_not_there_costs_the_agent_nothing(caplog: pytest.LogCaptureFixture) -> None:
    web = WebProcess(["/nonexistent/program"], lambda: 1.0)
    web.start()
    await until(lambda: caplog.text.count("cannot be started") >= 2)
    await web.close()


def test_its_command_and_environment_have_what_the_agent_was_told(tmp_path: Path) -> None:
    settings = Settings(
        name="base",
        web=WebSettings(enabled=True, port=9000, listen="0.0.0.0", token_file="t"),
        config_file=tmp_path / "rmpa.toml",
    )
    command = " ".join(web_command(settings))
    for part in ("--agent base", "--port 9000", "--listen 0.0.0.0", "--token-file t", "--config", "--with-agent"):
        assert part in command
    settings = Settings(log_level="debug", log_json=True)
    of_systemd = {"NOTIFY_SOCKET": "/run/systemd/notify", "WATCHDOG_USEC": "10000000"}
    environ = web_environment(settings, {"RMPA_RUNTIME_DIR": "x", "RMPA_LOG_LEVEL": "error", **of_systemd})
    assert environ == {"RMPA_RUNTIME_DIR": "x", "RMPA_LOG_LEVEL": "debug", "RMPA_LOG_JSON": "true"}
