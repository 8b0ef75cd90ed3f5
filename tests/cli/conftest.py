"""The program run as a user runs it, beside a fake agent and our own core."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import pytest

from rmpa.cli.main import main
from rmpa.observe.control_server import ControlServer, Handler
from rmpa.observe.snapshot import PingReply, Snapshot
from rmpa.ros.core.embedded import RosCore
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterator
    from types import TracebackType

DEADLINE = 30.0


def free_port() -> int:
    """A TCP port that is free at present."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


def end(process: subprocess.Popen[str]) -> None:
    """Kill a process that still runs, and read what it said."""
    if process.poll() is None:
        process.kill()
    process.communicate()


def until(condition: Callable[[], object]) -> None:
    """Wait until something holds."""
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


class Command(subprocess.Popen[str]):
    """A running command; a test that fails meanwhile ends it, instead of waiting for its end."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            self.kill()
        super().__exit__(kind, error, trace)


@dataclass
class Place:
    """One machine's runtime directory, and the environment that commands see."""

    path: Path
    environ: dict[str, str] = field(default_factory=dict)

    def start(self, *arguments: str) -> Command:
        return Command(
            [sys.executable, "-m", "rmpa.cli.main", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=self.environ,
            cwd=self.path,
        )

    def run(self, *arguments: str) -> tuple[int, str, str]:
        with self.start(*arguments) as process:
            out, err = process.communicate(timeout=DEADLINE)
        return process.returncode, out, err

    def json(self, *arguments: str) -> list[dict[str, object]]:
        code, out, err = self.run(*arguments)
        assert code == 0, err
        return [json.loads(line) for line in out.splitlines()]


@pytest.fixture
def place() -> Iterator[Place]:
    with tempfile.TemporaryDirectory(prefix="rmpa-test-") as name:
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "RMPA_", "XDG_"))}
        yield Place(Path(name), kept | {"RMPA_RUNTIME_DIR": name, "HOME": name, "NO_COLOR": "1"})


class Background:
    """An event loop in a thread of its own, for what commands talk to."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()

    def do(self, work: Coroutine[object, object, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self.loop).result(DEADLINE)

    def close(self) -> None:
        self.loop.call_soon_threadsafe(self.loop.stop)
        self._thread.join(DEADLINE)
        self.loop.close()


@pytest.fixture
def background() -> Iterator[Background]:
    background = Background()
    yield background
    background.close()


@pytest.fixture
def agent(place: Place, background: Background) -> Iterator[Callable[..., None]]:
    """Starts fake agents: by name, what they show, and how they answer a ping."""
    servers: list[ControlServer] = []

    def start(
        name: str = "base", snapshot: Snapshot = SNAPSHOT, ping: Handler | None = None, **others: Handler
    ) -> None:
        times = iter([0.0004, None, 0.0006] * 100)
        answer = ping or (lambda _: PingReply(times=(next(times),), remote="10.0.0.2:40002"))
        server = ControlServer(place.path, name, {"snapshot": lambda _: snapshot, "ping": answer, **others})
        background.do(server.start())
        servers.append(server)

    yield start
    for server in servers:
        background.do(server.close())


@pytest.fixture
def core(background: Background) -> Iterator[RosCore]:
    core: RosCore | None = None

    async def start() -> None:
        nonlocal core
        core = RosCore("127.0.0.1", 0)
        await core.start()

    background.do(start())
    assert core is not None
    yield core
    background.do(core.close())


Rmpa = Callable[..., tuple[int, str, str]]


@pytest.fixture
def rmpa(
    core: RosCore,
    place: Place,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
) -> Rmpa:
    """Runs a verb of the test file's ``GROUP`` within this process, at the core: exit code, output, errors."""
    for name in ("ROS_PACKAGE_PATH", "PYTHONPATH", "CMAKE_PREFIX_PATH", "RMPA_AGENT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in (("ROS_MASTER_URI", core.uri), ("RMPA_RUNTIME_DIR", str(place.path)), ("NO_COLOR", "1")):
        monkeypatch.setenv(name, value)

    def run(*words: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = main((*request.module.GROUP, *words))
        return code, *capsys.readouterr()

    return run


def with_core(uri: str) -> Snapshot:
    """The sample of an agent whose core is at ``uri``."""
    return msgspec.structs.replace(SNAPSHOT, agent=msgspec.structs.replace(SNAPSHOT.agent, core_uri=uri))
