"""The program run as a user runs it, beside a fake agent and our own core."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import os
import re
import shlex
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar
from unittest import mock

import msgspec
import pytest

from rmpa.cli.main import main
from rmpa.observe.control_server import ControlServer, Handler
from rmpa.observe.snapshot import PingReply, Snapshot
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.environment import RosEnvironment
from rmpa.ros.node.node import Node
from tests.observe.samples import SNAPSHOT

DEADLINE = 30.0
GOLDEN = Path(__file__).with_name("golden")
_T = TypeVar("_T")


def compare(name: str, said: str) -> None:
    """Compare with a golden file; ``WRITE_GOLDEN=1 make tests ARGS=tests/cli`` writes all anew, after a change."""
    file = GOLDEN / f"{name}.txt"
    if os.environ.get("WRITE_GOLDEN"):
        file.parent.mkdir(exist_ok=True)
        file.write_text(said, encoding="utf-8")
    assert said == file.read_text(encoding="utf-8")


def settled(said: str, place: Path | None = None) -> str:
    """A transcript without what differs from run to run: ports, process ids, times, the folder."""
    said = re.sub(r"(//[\w.-]+):\d{4,5}\b", r"\1:PORT", said)
    said = re.sub(rf'(?i)(pid"?[:=]\s?){os.getpid()}\b', r"\1PID", said)
    said = re.sub(r"time=[\d.]+ (µs|ms|s)\b", "time=TIME", said)
    return said.replace(str(place), "PLACE") if place is not None else said


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
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=self.environ,
            cwd=self.path,
            start_new_session=True,  # without a terminal of the test's own, whose /dev/tty would be asked
        )

    @contextlib.contextmanager
    def shell(self) -> Iterator[None]:
        """Variables and folder of a shell here, for this process."""
        with mock.patch.dict(os.environ, self.environ, clear=True), contextlib.chdir(self.path):
            yield

    def run(self, *arguments: str, stdin: str = "") -> tuple[int, str, str]:
        """Run a command within this process, as a shell here would: exit code, output, errors."""
        out, err = io.StringIO(), io.StringIO()
        with (
            self.shell(),
            mock.patch.object(sys, "stdin", io.StringIO(stdin)),
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
        ):
            code = main(arguments)
        return code, out.getvalue(), err.getvalue()

    def run_apart(self, *arguments: str) -> tuple[int, str, str]:
        """The same by a process of its own."""
        with self.start(*arguments) as process:
            out, err = process.communicate(timeout=DEADLINE)
        return process.returncode, out, err

    def transcript(self, *lines: str, group: str = "") -> str:
        """What a shell shows of command lines of ``rmpa``, or of one of its groups, and their exit codes."""
        said = ""
        for line in lines:
            code, out, err = self.run(*shlex.split(f"{group} {line}"))
            said += f"$ rmpa {f'{group} {line}'.strip()}\n{out}{err}exit code {code}\n\n"
        return said

    def json(self, *arguments: str) -> list[dict[str, Any]]:
        code, out, err = self.run(*arguments)
        assert code == 0, err
        return [json.loads(line) for line in out.splitlines()]


def shell_of(path: Path) -> dict[str, str]:
    """The variables of a shell that has no setting but where its files are."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("ROS_", "RMPA_", "XDG_"))}
    return kept | {"RMPA_RUNTIME_DIR": str(path), "HOME": str(path), "NO_COLOR": "1"}


@pytest.fixture
def place() -> Iterator[Place]:
    # Not pytest's folder: the path of a control socket has at most 107 bytes.
    with tempfile.TemporaryDirectory(prefix="rmpa-test-") as name:
        yield Place(Path(name), shell_of(Path(name)))


@dataclass
class Machine(Place):
    """A machine whose agents and servers write into logs in its folder, and end with the test."""

    stack: ExitStack = field(default_factory=ExitStack)
    agent: subprocess.Popen[str] | None = None

    @property
    def state(self) -> Path:
        return self.path / ".local/state/rmpa"

    def serve(self, *arguments: str, **environ: str) -> subprocess.Popen[str]:
        with (self.path / f"{arguments[0]}.log").open("a") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "rmpa.cli.main", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                text=True,
                env=self.environ | environ,
                cwd=self.path,
                start_new_session=True,
            )
        self.stack.callback(end, process)
        return process

    def says(self, *arguments: str, code: int = 0, stdin: str = "", **environ: str) -> str:
        """What a command says that ends; one that writes its log to a file descriptor is a process of its own."""
        with mock.patch.dict(self.environ, environ):
            apart = arguments[0] in {"up", "gateway"}
            found, out, err = self.run_apart(*arguments) if apart else self.run(*arguments, stdin=stdin)
        assert found == code, out + err
        return out + err

    def log(self, command: str = "up") -> str:
        return (self.path / f"{command}.log").read_text()

    def agents(self) -> set[str]:
        return {path.stem for path in self.path.glob("*.sock")}

    def up(self, *arguments: str, **environ: str) -> subprocess.Popen[str]:
        """Start an agent on loopback, and wait until its control socket can be connected to."""
        net: tuple[str, ...] = ("--multicast", f"239.255.117.117:{20000 + os.getpid() % 20000}", "--interface", "lo")
        if "--core-port" not in arguments:
            net = (*net, "--core-port", str(free_port()))
        known = self.agents()
        process = self.agent = self.serve("up", *net, *arguments, **environ)

        def answers() -> bool:
            assert process.poll() is None, self.log()
            new = self.agents() - known
            with socket.socket(socket.AF_UNIX) as client:
                return bool(new) and client.connect_ex(str(self.path / f"{new.pop()}.sock")) == 0

        until(answers)
        return process

    def down(self) -> None:
        """End the agent that was started last."""
        assert self.agent is not None
        self.agent.terminate()
        self.agent.wait(DEADLINE)

    def status(self, *more: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.says("trust", "status", "--json", *more))
        return found


@pytest.fixture
def machines() -> Iterator[Callable[[str], Machine]]:
    """Makes machines, of modules with these names; empty: nothing says a name."""
    with tempfile.TemporaryDirectory(prefix="rmpa-test-") as folder, ExitStack() as stack:

        def make(name: str) -> Machine:
            path = Path(folder) / (name or "one")
            path.mkdir(mode=0o700)
            if name:
                (path / "rmpa.toml").write_text(f'name = "{name}"\n')
            return Machine(path, shell_of(path), stack)

        yield make


class Background:
    """An event loop in a thread of its own, for what commands talk to."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self.loop.run_forever)
        self._thread.start()

    def do(self, work: Coroutine[object, object, _T]) -> _T:
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(DEADLINE)

    def call(self, function: Callable[..., _T], *args: object) -> _T:
        async def work() -> _T:
            return function(*args)

        return self.do(work())

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
        others.setdefault("agent", lambda _: snapshot.agent.for_peers())
        answer = ping or (lambda _: PingReply(times=(next(times),), remote="10.0.0.2:40002"))
        server = ControlServer(place.path, name, {"snapshot": lambda _: snapshot, "ping": answer, **others})
        background.do(server.start())
        servers.append(server)

    yield start
    for server in servers:
        background.do(server.close())


@pytest.fixture
def core(background: Background) -> Iterator[RosCore]:
    core = RosCore("127.0.0.1", 0)
    background.do(core.start())
    yield core
    background.do(core.close())


@pytest.fixture
def node(core: RosCore, background: Background) -> Iterator[Callable[..., Node]]:
    """Starts nodes at the core."""
    nodes: list[Node] = []

    def start(name: str, **more: Any) -> Node:
        nodes.append(Node(name, master_uri=core.uri, environment=RosEnvironment(), **more))
        return background.do(nodes[-1].__aenter__())

    yield start
    for each in nodes:
        background.do(each.close())


@pytest.fixture
def listening() -> Iterator[str]:
    """A slave API for nodes that are only registered: something listens there, or the core takes them for dead."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"http://127.0.0.1:{server.getsockname()[1]}/"


Rmpa = Callable[..., tuple[int, str, str]]


@pytest.fixture
def rmpa(core: RosCore, place: Place, request: pytest.FixtureRequest) -> Rmpa:
    """Runs a verb of the test file's ``GROUP`` at the core: exit code, output, errors."""
    for name in ("ROS_PACKAGE_PATH", "PYTHONPATH", "CMAKE_PREFIX_PATH"):
        place.environ.pop(name, None)
    place.environ["ROS_MASTER_URI"] = core.uri
    return lambda *words: place.run(*request.module.GROUP, *words)


def with_core(uri: str) -> Snapshot:
    """The sample of an agent whose core is at ``uri``."""
    return msgspec.structs.replace(SNAPSHOT, agent=msgspec.structs.replace(SNAPSHOT.agent, core_uri=uri))
