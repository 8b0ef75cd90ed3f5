"""``rmpa up --realtime``: the kernel's view of the process, with the rights and without (docs/guides/running.md)."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pytest

from lab.bed.agents import Agent
from lab.bed.namespaces import Host
from lab.bed.processes import eventually
from tests.interop.conftest import AgentFactory

FIFO: Final = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
NOBODY: Final = 65534
AS_NOBODY: Final = (
    "env",
    "HOME=/nonexistent",
    "setpriv",
    "--reuid",
    str(NOBODY),
    "--regid",
    str(NOBODY),
    "--clear-groups",
)
WITHOUT_RIGHTS: Final = ("setpriv", "--bounding-set=-sys_nice,-ipc_lock,-sys_resource")


@dataclass(slots=True)
class Prefixed(Host):
    """This machine, with every command behind a prefix."""

    prefix: Sequence[str] = ()

    def command(self, argv: Sequence[str | Path]) -> list[str]:
        """The command line with the prefix."""
        return [*self.prefix, *map(str, argv)]


def status(pid: int) -> dict[str, int]:
    """The fields of /proc/PID/status that are KB."""
    text = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    pairs = (line.split(":", 1) for line in text.splitlines())
    return {name: int(value.split()[0]) for name, value in pairs if value.endswith(" kB")}


def threads(pid: int) -> dict[int, tuple[int, int]]:
    """Policy and priority of each thread; of those that end meanwhile, none."""
    found = {}
    for path in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(ProcessLookupError):
            tid = int(path.name)
            found[tid] = os.sched_getscheduler(tid), os.sched_getparam(tid).sched_priority
    return found


def may(*capabilities: int) -> bool:
    """Whether this process has them all."""
    text = Path("/proc/self/status").read_text(encoding="utf-8")
    mask = next(int(line.split()[1], 16) for line in text.splitlines() if line.startswith("CapEff:"))
    return all(mask >> number & 1 for number in capabilities)


def runs(prefix: Sequence[str]) -> bool:
    """Whether rmpa can be run behind that prefix here."""
    argv = [*prefix, sys.executable, "-c", "import rmpa.cli.main"]
    return bool(shutil.which("setpriv")) and not subprocess.run(argv, capture_output=True, check=False).returncode


needs_rights = pytest.mark.skipif(not may(23, 14), reason="takes CAP_SYS_NICE and CAP_IPC_LOCK")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to become another user")


@pytest.fixture
def home_of_nobody() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="rmpa-nobody-") as name:
        os.chown(name, NOBODY, NOBODY)
        yield Path(name)


def said(made: Agent, level: str) -> list[str]:
    """The texts of the agent's log lines of one level about real time."""
    lines = [line.split(maxsplit=3) for line in made.process.output.splitlines() if " realtime: " in line]
    return [text for _, found, _, text in lines if found == level]


@needs_rights
def test_an_agent_is_scheduled_and_locked_as_the_kernel_says(agent: AgentFactory) -> None:
    plain = agent()
    made = agent(flags=["--realtime"], prefix=["env"])  # by itself: a fork has more memory
    made.wait_peer(plain.name)
    assert os.sched_getscheduler(made.pid) == FIFO
    assert os.sched_getparam(made.pid).sched_priority == 50
    assert os.sched_getscheduler(plain.pid) == os.SCHED_OTHER
    others = {tid: how for tid, how in threads(made.pid).items() if tid != made.pid}
    assert (FIFO, 49) in others.values(), "the workers that others wait for; the log is written by an ordinary thread"
    assert set(others.values()) <= {(FIFO, 49), (os.SCHED_OTHER, 0)}
    memory = status(made.pid)
    assert memory["VmLck"] > 20_000
    assert status(plain.pid)["VmLck"] == 0
    # What is mapped and never read is in memory too then: 11 to 15 MB, by how the interpreter was built.
    assert memory["VmRSS"] < status(plain.pid)["VmRSS"] + 20_000
    assert said(made, "warning") == []
    assert [text.split(": ")[1].strip() for text in said(made, "info")] == ["SCHED_FIFO, priority 50", "memory lock"]


@needs_rights
def test_the_file_says_how_much_of_it(agent: AgentFactory) -> None:
    made = agent(config="[realtime]\nenabled = true\npriority = 7\nlock_memory = false\n")
    assert threads(made.pid)[made.pid] == (FIFO, 7)
    assert status(made.pid)["VmLck"] == 0


@needs_root
def test_root_without_capabilities_gets_a_warning(agent: AgentFactory) -> None:
    if not runs(WITHOUT_RIGHTS):
        pytest.skip("capabilities cannot be dropped here")
    made = agent(Prefixed("bare", "", prefix=WITHOUT_RIGHTS), flags=["--realtime"])
    told_what_to_do(made)
    made.wait_peer(agent().name)
    # The log says it once; the commands repeat it.
    assert len(said(made, "warning")) == 2
    code, output = made.rmpa("peer", "list")
    assert code == 0
    assert "realtime: no SCHED_FIFO, priority 50: " in output
    assert "the agent's log says what would grant it" in output


@needs_root
def test_any_user_is_told_and_the_agent_runs_on(agent: AgentFactory, home_of_nobody: Path) -> None:
    if not runs(AS_NOBODY):
        pytest.skip("only root can run this rmpa")
    places = (f"{name}={home_of_nobody}/state" for name in ("RMPA_STATE_DIR", "XDG_STATE_HOME"))
    user = Prefixed("user", "", prefix=["env", *places, *AS_NOBODY])  # it may not search the folders of this test
    made = agent(user, ready=False, flags=["--realtime"], runtime_dir=home_of_nobody)
    made.process.wait_for("ROS_MASTER_URI=")  # systemd's socket of this test is root's
    told_what_to_do(made)
    peer = agent()
    eventually(lambda: made.name in peer.peers(), what="the peer sees it")
    assert Path(f"/proc/{made.pid}").stat().st_uid == NOBODY


def told_what_to_do(made: Agent) -> None:
    """Fail unless both refusals are in the log, with what grants each."""
    made.process.wait_for("ROS_MASTER_URI=")  # the log's thread writes a moment after the agent is ready
    fifo, memory = said(made, "warning")
    assert fifo.startswith("! realtime: no SCHED_FIFO, priority 50: ")
    assert memory.startswith("! realtime: no memory lock: ")
    for text in (fifo, memory):
        assert "to get it: systemd: sudo rmpa service install --realtime, or LimitRTPRIO=50" in text
    assert os.sched_getscheduler(made.pid) == os.SCHED_OTHER
    assert status(made.pid)["VmLck"] == 0
    assert "Traceback" not in made.process.output
