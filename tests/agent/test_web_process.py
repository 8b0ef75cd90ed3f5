"""The agent starts rmpa web again, without depending on it."""

from __future__ import annotations

import errno
import os
import signal
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from rmpa.agent import process as limits
from rmpa.agent.process import ChildProcess
from rmpa.config.settings import Settings, WebSettings
from tests.waiting import until

if TYPE_CHECKING:
    from pathlib import Path

WAITS = "import signal; signal.pause()"
PAUSES = "[signal.pause() for _ in iter(int, 1)]"


def touch(file: Path) -> str:
    return f"pathlib.Path({str(file)!r}).touch()"


class Child(ChildProcess):
    """A child of an agent, which runs a program."""

    def __init__(self, folder: Path, command: list[str]) -> None:
        super().__init__("web", "web-stopped", Settings(name="base", runtime_dir=str(folder)), lambda: 1.0)
        self.command = command

    @property
    def pid(self) -> int | None:
        """Its process, while it runs."""
        return self.mark.pid if self.mark is not None and self.runs else None


Make = Callable[[str], Child]


@pytest.fixture
def child(tmp_path: Path) -> Make:
    """Make a child that runs a program; several are of agents one after the other."""
    return lambda program: Child(tmp_path, [sys.executable, "-c", program])


async def kill_agent(child: Child) -> int:
    """Start a child, and leave it as an agent that is killed then; return its process."""
    await child.start()
    assert child._keeper is not None
    child._keeper.cancel()
    assert child.pid is not None
    return child.pid


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "CHILD_RESTART_FIRST", 0.01)


@pytest.mark.usefixtures("quick")
async def test_a_child_that_is_killed_is_started_again(child: Make) -> None:
    web = child(WAITS)
    web.begin()
    await until(lambda: web.pid)
    first = web.pid
    assert first is not None
    os.kill(first, signal.SIGKILL)
    await until(lambda: web.pid not in (None, first))
    await web.stop()
    assert web.pid is None


async def test_the_child_ends_with_the_agent(child: Make, tmp_path: Path) -> None:
    ready, file = tmp_path / "ready", tmp_path / "ended"
    asked = "import pathlib, signal; signal.signal(signal.SIGINT, lambda *_: None)"
    web = child(f"{asked}; {touch(ready)}; signal.pause(); {touch(file)}")
    web.begin()
    await until(ready.exists)
    await web.stop()
    assert file.exists()  # it was asked to end, not killed
    assert not (tmp_path / "base.web").exists()


async def test_a_child_that_does_not_end_is_killed(
    child: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(limits, "CHILD_END", 0.1)
    ready = tmp_path / "ready"
    deaf = "[signal.signal(each, signal.SIG_IGN) for each in (signal.SIGINT, signal.SIGTERM)]"
    web = child(f"import pathlib, signal; {deaf}; {touch(ready)}; {PAUSES}")
    web.begin()
    await until(ready.exists)
    pid = web.pid
    assert pid is not None
    await web.stop()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


@pytest.mark.usefixtures("quick")
async def test_a_child_that_cannot_be_waited_for_is_found_again_and_no_second_one_starts(
    child: Make, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
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
        web.begin()
        await until(lambda: "cannot be started" in caplog.text)
    await until(lambda: web.pid == children[0])
    assert runs.read_text() == "x"
    await web.stop()


@pytest.mark.usefixtures("quick")
async def test_a_usage_error_is_not_tried_again(
    child: Make, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    web = child(f"import sys; open({str(tmp_path / 'runs')!r}, 'a').write('x'); sys.exit(2)")
    web.begin()
    await until(lambda: "not started again" in caplog.text)
    await web.stop()
    assert (tmp_path / "runs").read_text() == "x"


@pytest.mark.usefixtures("quick")
async def test_a_program_that_is_not_there_costs_the_agent_nothing(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    web = Child(tmp_path, ["/nonexistent/program"])
    web.begin()
    await until(lambda: caplog.text.count("cannot be started") >= 2)
    await web.stop()


@pytest.mark.usefixtures("quick")
async def test_that_of_an_agent_before_is_taken_over(child: Make, tmp_path: Path) -> None:
    ready = tmp_path / "ready"
    program = f"import pathlib, signal; signal.signal(signal.SIGHUP, lambda *_: None);{touch(ready)}; {PAUSES}"
    former, web = child(program), child(program)
    pid = await kill_agent(former)
    await until(ready.exists)
    web.begin()
    await until(lambda: web.pid)
    assert web.pid == pid
    await web.stop()
    assert former._child is not None
    assert former._child.wait() == -signal.SIGINT


async def test_one_of_another_program_is_replaced(child: Make) -> None:
    former, web = child(WAITS), child(f"{WAITS}  # other settings")
    pid = await kill_agent(former)
    web.begin()
    await until(lambda: web.pid)
    assert former._child is not None
    assert former._child.poll() is not None
    assert web.pid != pid
    await web.stop()


async def test_one_that_is_not_wanted_any_more_is_ended(child: Make) -> None:
    former = child(WAITS)
    await kill_agent(former)
    await child(WAITS).stop()
    assert former._child is not None
    assert former._child.poll() is not None


def test_its_command_and_environment_have_what_the_agent_was_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RMPA_LOG_LEVEL", "error")
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/systemd/notify")
    monkeypatch.setenv("WATCHDOG_USEC", "10000000")
    settings = Settings(
        name="base",
        web=WebSettings(enabled=True, port=9000, listen="0.0.0.0", token_file="t"),
        config_file=tmp_path / "rmpa.toml",
        runtime_dir=str(tmp_path),
        log_level="debug",
        log_json=True,
    )
    web = ChildProcess.web(settings, lambda: 1.0)
    for part in ("--agent base", "--port 9000", "--listen 0.0.0.0", "--token-file t", "--config"):
        assert part in " ".join(web.command)
    assert (web.environ["RMPA_LOG_LEVEL"], web.environ["RMPA_LOG_JSON"]) == ("debug", "true")
    assert web.environ.keys().isdisjoint({"NOTIFY_SOCKET", "WATCHDOG_USEC"})
