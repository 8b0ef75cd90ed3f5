from __future__ import annotations

import json
import logging
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest

from rmpa.runtime import realtime

if TYPE_CHECKING:
    from collections.abc import Sequence

NOBODY: Final = 65534

CHILD: Final = """
import json, os, resource, sys, threading
from rmpa.runtime import realtime

def who(tid=0):
    return os.sched_getscheduler(tid) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(tid).sched_priority

outcomes = realtime.apply(**json.loads(sys.argv[1]))
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
others = []
thread = threading.Thread(target=lambda: others.append(who()))
thread.start()
thread.join()
with realtime.worker_pool() as pool:
    worker = pool.submit(who).result()
child = os.fork()
if child == 0:
    os._exit(os.sched_getscheduler(0) or os.sched_getparam(0).sched_priority)
print(json.dumps({
    "outcomes": outcomes,
    "locked": int(status["VmLck"].split()[0]), "resident": int(status["VmRSS"].split()[0]),
    "loop": who(), "thread": others[0], "worker": worker, "child": os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]),
    "limit": resource.getrlimit(resource.RLIMIT_MEMLOCK),
    "alive": bytes(bytearray(50_000_000))[:1].hex(),
}))
"""


def run_child(prefix: Sequence[str] = (), **settings: object) -> dict[str, object]:
    """What a process of its own gets, and whether it runs on."""
    asked = json.dumps({"priority": 50, "lock_memory": True, **settings})
    argv = [*prefix, sys.executable, "-c", CHILD, asked]
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=50, check=False, cwd="/")
    if prefix and ended.returncode and "setpriv" in ended.stderr:
        pytest.skip(f"setpriv cannot do it here: {ended.stderr.strip()}")
    assert ended.returncode == 0, ended.stderr
    answer = json.loads(ended.stdout)
    assert isinstance(answer, dict)
    assert answer["alive"] == "00"
    return answer


def unprivileged() -> list[str]:
    """A prefix that takes every privilege away."""
    if os.geteuid() != 0:
        return []
    if shutil.which("setpriv") is None:
        pytest.skip("no setpriv here")
    if not can_run_as_nobody():
        pytest.skip("nobody but root can run this Python here")
    return ["setpriv", "--reuid", str(NOBODY), "--regid", str(NOBODY), "--clear-groups"]


def can_run_as_nobody() -> bool:
    argv = ["setpriv", "--reuid", str(NOBODY), "--regid", str(NOBODY), "--clear-groups", sys.executable]
    return subprocess.run([*argv, "-c", "import rmpa"], capture_output=True, check=False, cwd="/").returncode == 0


def may(capability: int) -> bool:
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    line = next(line for line in status.splitlines() if line.startswith("CapEff:"))
    return bool(int(line.split()[1], 16) >> capability & 1)


needs_nice = pytest.mark.skipif(not may(23), reason="real-time scheduling takes CAP_SYS_NICE")
needs_lock = pytest.mark.skipif(not may(14), reason="locking memory takes CAP_IPC_LOCK")
needs_setpriv = pytest.mark.skipif(not may(8) or not shutil.which("setpriv"), reason="takes root and setpriv")


# --- real processes --------------------------------------------------------------------------------------------


@needs_nice
def test_workers_get_one_priority_less_and_children_none() -> None:
    answer = run_child(priority=42, lock_memory=False)
    assert answer["outcomes"] == ["SCHED_FIFO, priority 42"]
    assert answer["loop"] == [os.SCHED_FIFO, 42]
    assert answer["worker"] == [os.SCHED_FIFO, 41]
    assert answer["thread"] == [os.SCHED_OTHER, 0]
    assert answer["child"] == 0
    assert answer["locked"] == 0


@needs_nice
def test_priority_1_leaves_nothing_below_for_the_workers() -> None:
    answer = run_child(priority=1, lock_memory=False)
    assert answer["loop"] == answer["worker"] == [os.SCHED_FIFO, 1]


@needs_nice
def test_a_limit_that_would_kill_the_agent_is_no_real_time() -> None:
    if shutil.which("prlimit") is None:
        pytest.skip("no prlimit here")
    rights = ["setpriv", "--bounding-set=-sys_resource"]
    soft = run_child(["prlimit", "--rttime=200000:unlimited", *rights], lock_memory=False)
    assert soft["outcomes"] == ["SCHED_FIFO, priority 50"], "a soft limit is lifted"
    hard = run_child(["prlimit", "--rttime=200000:200000", *rights], lock_memory=False)
    assert hard["outcomes"] == ["no SCHED_FIFO, priority 50: LimitRTTIME= is set"]
    assert hard["loop"] == [os.SCHED_OTHER, 0]


@needs_lock
def test_memory_is_locked_and_does_not_balloon() -> None:
    plain = run_child(lock_memory=False)
    answer = run_child()
    assert "memory lock" in list(answer["outcomes"])  # type: ignore[call-overload] # of JSON
    assert int(str(answer["locked"])) > 10_000
    assert int(str(answer["resident"])) < int(str(plain["resident"])) + 12_000


@needs_setpriv
def test_memory_is_not_locked_within_a_limit_unless_by_the_capability() -> None:
    limited = ["prlimit", "--memlock=65536:65536", "setpriv"]
    answer = run_child([*limited, "--bounding-set=-ipc_lock,-sys_resource"])
    assert "no memory lock: " in str(answer["outcomes"])
    assert answer["locked"] == 0
    assert answer["limit"] in ([65536, 65536], [0, 65536])
    answer = run_child([*limited, "--bounding-set=-sys_resource"])
    assert "no memory lock" not in str(answer["outcomes"])
    assert answer["limit"] in ([65536, 65536], [0, 65536])


def test_an_unprivileged_process_runs_on() -> None:
    answer = run_child(unprivileged())
    outcomes = answer["outcomes"]
    assert isinstance(outcomes, list)
    if not all(outcome.startswith("no ") for outcome in outcomes):
        pytest.skip("this machine lets everybody have real time")
    assert [outcome.partition(":")[0] for outcome in outcomes] == ["no SCHED_FIFO, priority 50", "no memory lock"]
    assert answer["locked"] == 0
    assert answer["limit"] == [*resource.getrlimit(resource.RLIMIT_MEMLOCK)]
    assert answer["loop"] == answer["worker"] == [os.SCHED_OTHER, 0]


def test_a_refusal_is_logged_with_what_grants_it(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(realtime, "_schedule", lambda _: "Operation not permitted")
    monkeypatch.setattr(realtime, "_lock_memory", lambda: "")
    with caplog.at_level(logging.INFO):
        realtime.apply(50, lock_memory=True)
    lines = [(record.levelname, record.getMessage()) for record in caplog.records]
    refusal = (
        "! realtime: no SCHED_FIFO, priority 50: Operation not permitted; to get it: systemd: sudo rmpa service "
    )
    assert [level for level, _ in lines] == ["WARNING", "INFO"]
    assert lines[0][1].startswith(refusal)
