from __future__ import annotations

import errno
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

from rmpa.config.settings import RealtimeSettings
from rmpa.runtime import realtime
from rmpa.runtime.realtime import SchedulingRequest, refused

if TYPE_CHECKING:
    from collections.abc import Sequence

INFINITY: Final = resource.RLIM_INFINITY
NOBODY: Final = 65534

CHILD: Final = """
import dataclasses, json, os, resource, sys, threading
from rmpa.runtime import realtime
from rmpa.config.settings import RealtimeSettings

def who(tid=0):
    return os.sched_getscheduler(tid) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(tid).sched_priority

before = set(os.sched_getaffinity(0))
wishes = realtime.apply(RealtimeSettings(**json.loads(sys.argv[1])))
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
    "wishes": [dataclasses.asdict(wish) for wish in wishes],
    "locked": int(status["VmLck"].split()[0]), "resident": int(status["VmRSS"].split()[0]),
    "loop": who(), "thread": others[0], "worker": worker, "child": os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]),
    "limit": resource.getrlimit(resource.RLIMIT_MEMLOCK),
    "before": sorted(before), "cpus": sorted(os.sched_getaffinity(0)),
    "files": [os.path.realpath(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd")],
    "alive": bytes(bytearray(50_000_000))[:1].hex(),
}))
"""


def run_child(prefix: Sequence[str] = (), **settings: object) -> dict[str, object]:
    """What a process of its own gets, and whether it runs on."""
    asked = json.dumps({"enabled": True, **settings})
    argv = [*prefix, sys.executable, "-c", CHILD, asked]
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=50, check=False, cwd="/")
    if prefix and ended.returncode and "setpriv" in ended.stderr:
        pytest.skip(f"setpriv cannot do it here: {ended.stderr.strip()}")
    assert ended.returncode == 0, ended.stderr
    answer = json.loads(ended.stdout)
    assert isinstance(answer, dict)
    assert answer["alive"] == "00"
    return answer


def wish(answer: dict[str, object], name: str) -> dict[str, object]:
    wishes = answer["wishes"]
    assert isinstance(wishes, list)
    return next(w for w in wishes if w["name"] == name)


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


def test_nothing_is_asked_unless_it_is_enabled() -> None:
    answer = run_child(enabled=False)
    assert answer["wishes"] == []
    assert answer["locked"] == 0
    assert answer["loop"] == [os.SCHED_OTHER, 0]


@needs_nice
def test_workers_get_one_priority_less_and_children_none() -> None:
    answer = run_child(priority=42, lock_memory=False)
    assert wish(answer, "SCHED_FIFO") == {
        "name": "SCHED_FIFO",
        "granted": True,
        "text": "priority 42",
        "remedy": "",
    }
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
def test_an_impossible_priority_is_told() -> None:
    answer = run_child(priority=100, lock_memory=False)
    assert not wish(answer, "SCHED_FIFO")["granted"]
    assert wish(answer, "SCHED_FIFO")["remedy"] == "priorities are 1 to 99"


@pytest.mark.skipif(not os.access("/dev/cpu_dma_latency", os.W_OK), reason="takes /dev/cpu_dma_latency")
def test_the_cpus_are_kept_awake_while_the_process_lives() -> None:
    answer = run_child(lock_memory=False, keep_awake=True)
    assert wish(answer, "wakefulness")["granted"]
    assert "/dev/cpu_dma_latency" in str(answer["files"])
    assert "/dev/cpu_dma_latency" not in str(run_child(lock_memory=False)["files"])


@needs_setpriv
def test_a_refusal_to_keep_awake_says_what_would_grant_it() -> None:
    refused = wish(run_child(unprivileged(), lock_memory=False, keep_awake=True), "wakefulness")
    assert not refused["granted"]
    assert "cpu_dma_latency" in str(refused["text"]) + str(refused["remedy"])


@needs_lock
def test_memory_is_locked_and_does_not_balloon() -> None:
    plain = run_child(lock_memory=False)
    answer = run_child()
    locked = wish(answer, "memory lock")
    assert locked["granted"]
    assert int(str(answer["locked"])) > 10_000
    assert int(str(answer["resident"])) < int(str(plain["resident"])) + 12_000
    assert answer["limit"] in ([*resource.getrlimit(resource.RLIMIT_MEMLOCK)], [INFINITY, INFINITY])


def test_unprivileged_agent_runs_on_and_logs_remedies() -> None:
    answer = run_child(unprivileged())
    fifo, memory = wish(answer, "SCHED_FIFO"), wish(answer, "memory lock")
    if fifo["granted"] or memory["granted"]:
        pytest.skip("this machine lets everybody have real time")
    user = "nobody" if os.geteuid() == 0 else ""
    for needed in ("LimitRTPRIO=50", f"'{user}", "rtprio 50'", "limits.d", "setcap cap_sys_nice+ep /"):
        assert needed in str(fifo["remedy"])
    for needed in ("LimitMEMLOCK=infinity", "memlock unlimited'", "limits.d", "setcap cap_ipc_lock+ep /"):
        assert needed in str(memory["remedy"])
    assert "ulimit -l" in str(memory["text"])
    assert answer["locked"] == 0
    assert answer["limit"] == [*resource.getrlimit(resource.RLIMIT_MEMLOCK)]
    assert answer["loop"] == answer["worker"] == [os.SCHED_OTHER, 0]
    assert wish(answer, "timer slack")["text"] == "1 ns"


@needs_setpriv
def test_root_without_the_capabilities_is_told_as_well() -> None:
    answer = run_child(["setpriv", "--bounding-set=-sys_nice,-ipc_lock,-sys_resource"])
    assert not wish(answer, "SCHED_FIFO")["granted"]
    assert "'root - rtprio 50'" in str(wish(answer, "SCHED_FIFO")["remedy"])
    assert not wish(answer, "memory lock")["granted"]


def test_it_runs_on_the_cpus_that_it_is_told() -> None:
    one = max(os.sched_getaffinity(0))
    answer = run_child(unprivileged(), cpus=[one], lock_memory=False)
    assert wish(answer, "CPU affinity") == {
        "name": "CPU affinity",
        "granted": True,
        "text": f"CPU {one}",
        "remedy": "",
    }
    assert answer["cpus"] == [one]


def test_cpus_that_are_not_there_are_told() -> None:
    one = max(os.sched_getaffinity(0))
    answer = run_child(cpus=[one, 1000], lock_memory=False)
    assert wish(answer, "CPU affinity")["text"] == f"CPU {one} only, in place of CPU {one}, 1000"
    answer = run_child(cpus=[1000], lock_memory=False)
    assert not wish(answer, "CPU affinity")["granted"]
    assert "--cpuset-cpus" in str(wish(answer, "CPU affinity")["remedy"])
    assert answer["cpus"] == answer["before"]


# --- what a kernel may say -------------------------------------------------------------------------------------


class Kernel:
    """Limits and answers in place of the kernel's."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.limits = {
            resource.RLIMIT_RTPRIO: (0, 0),
            resource.RLIMIT_RTTIME: (INFINITY, INFINITY),
            resource.RLIMIT_MEMLOCK: (65536, 65536),
        }
        self.privileged = False
        self.filtered = False
        self.priority = 0
        self.slack = 50_000
        self.locked: list[int] = []
        self.lock_error = 0
        monkeypatch.setattr(resource, "getrlimit", self.limits.__getitem__)
        monkeypatch.setattr(resource, "setrlimit", self._set_limit)
        monkeypatch.setattr(os, "sched_setscheduler", self._schedule)
        monkeypatch.setattr(realtime, "_libc", lambda: self)
        monkeypatch.setattr(realtime, "_errno", lambda: self.lock_error)
        monkeypatch.setattr(realtime, "_has_capability", lambda _: False)
        monkeypatch.setattr(realtime, "_in_container", lambda: False)

    def _set_limit(self, kind: int, wanted: tuple[int, int]) -> None:
        hard = self.limits[kind][1]
        if hard != INFINITY and (wanted[1] == INFINITY or wanted[1] > hard) and not self.privileged:
            raise ValueError("not allowed to raise maximum limit")
        self.limits[kind] = wanted

    def _schedule(self, _: int, policy: int, param: os.sched_param) -> None:
        assert policy == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
        allowed = self.limits[resource.RLIMIT_RTPRIO][0]
        too_high = allowed != INFINITY and param.sched_priority > allowed
        if self.filtered or (too_high and not self.privileged):
            raise PermissionError(errno.EPERM, "Operation not permitted")
        self.priority = param.sched_priority

    def prctl(self, what: int, value: int = 0) -> int:
        if what == 29:
            self.slack = value
            return 0
        return self.slack

    def mlockall(self, flags: int) -> int:
        limited = self.limits[resource.RLIMIT_MEMLOCK][0] != INFINITY
        if self.filtered or (limited and not self.privileged):
            self.lock_error = errno.EPERM
            return -1
        self.locked.append(flags)
        return 0

    def munlockall(self) -> int:
        self.locked.clear()
        return 0


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> Kernel:
    return Kernel(monkeypatch)


def ask(**settings: object) -> dict[str, SchedulingRequest]:
    wishes = realtime.apply(RealtimeSettings(enabled=True, **settings))  # type: ignore[arg-type]
    return {wish.name: wish for wish in wishes}


def test_a_limit_of_priority_is_used_up(kernel: Kernel) -> None:
    kernel.limits[resource.RLIMIT_RTPRIO] = (0, 20)
    wish = ask()["SCHED_FIFO"]
    assert wish.granted
    assert str(wish) == "SCHED_FIFO: priority 20, the limit, in place of 50"
    assert "LimitRTPRIO=50" in wish.remedy
    assert kernel.priority == 20


@pytest.mark.parametrize("hard", [99, INFINITY])
def test_a_hard_limit_above_the_soft_one_is_enough(kernel: Kernel, hard: int) -> None:
    kernel.limits[resource.RLIMIT_RTPRIO] = (0, hard)
    assert ask()["SCHED_FIFO"] == SchedulingRequest("SCHED_FIFO", True, "priority 50")
    assert kernel.priority == 50


def test_a_limit_that_would_kill_the_agent_is_no_real_time(kernel: Kernel) -> None:
    kernel.limits[resource.RLIMIT_RTPRIO] = (99, 99)
    kernel.limits[resource.RLIMIT_RTTIME] = (200_000, 200_000)
    wish = ask()["SCHED_FIFO"]
    assert not wish.granted
    assert "200 ms" in wish.text
    assert "LimitRTTIME=infinity" in wish.remedy
    assert kernel.priority == 0


def test_a_soft_limit_that_would_kill_the_agent_is_lifted(kernel: Kernel) -> None:
    kernel.limits[resource.RLIMIT_RTPRIO] = (99, 99)
    kernel.limits[resource.RLIMIT_RTTIME] = (200_000, INFINITY)
    assert ask()["SCHED_FIFO"].granted
    assert kernel.limits[resource.RLIMIT_RTTIME] == (INFINITY, INFINITY)


@pytest.mark.parametrize(("runtime", "needed"), [("0\n", "sched_rt_runtime_us"), ("950000\n", "cpu.rt_runtime_us")])
def test_a_control_group_without_real_time_is_told(
    kernel: Kernel, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, runtime: str, needed: str
) -> None:
    path = tmp_path / "sched_rt_runtime_us"
    path.write_text(runtime)
    monkeypatch.setattr(realtime, "_RT_RUNTIME", path)
    monkeypatch.setattr(realtime, "_has_capability", lambda number: number == 23)
    wish = ask()["SCHED_FIFO"]
    assert not wish.granted
    assert needed in wish.remedy


def test_a_filter_is_suspected_where_the_limits_allow_it(kernel: Kernel) -> None:
    kernel.filtered = True
    kernel.limits[resource.RLIMIT_RTPRIO] = (99, 99)
    kernel.limits[resource.RLIMIT_MEMLOCK] = (INFINITY, INFINITY)
    wishes = ask()
    assert "although" in wishes["SCHED_FIFO"].text
    assert "RestrictRealtime=no" in wishes["SCHED_FIFO"].remedy
    assert "although" in wishes["memory lock"].text


def test_memory_is_locked_only_without_a_limit(kernel: Kernel) -> None:
    kernel.limits[resource.RLIMIT_MEMLOCK] = (65536, INFINITY)
    assert ask()["memory lock"].granted
    assert kernel.locked == [1, 2 | 4]
    assert kernel.limits[resource.RLIMIT_MEMLOCK] == (INFINITY, INFINITY)


def test_memory_is_not_locked_within_a_limit(kernel: Kernel) -> None:
    kernel.limits[resource.RLIMIT_MEMLOCK] = (1 << 33, 1 << 34)
    wish = ask()["memory lock"]
    assert not wish.granted
    assert kernel.locked == []
    assert kernel.limits[resource.RLIMIT_MEMLOCK] == (1 << 33, 1 << 34)
    assert "8388608 KiB" in wish.text


def test_in_a_container_its_own_way_comes_first(kernel: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(realtime, "_in_container", lambda: True)
    wishes = ask()
    assert wishes["SCHED_FIFO"].remedy.startswith("start the container with --cap-add SYS_NICE")
    assert wishes["memory lock"].remedy.startswith("start the container with --ulimit memlock=-1")


def test_each_wish_is_said_once(kernel: Kernel, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        wishes = tuple(ask(cpus=tuple(os.sched_getaffinity(0))).values())
    lines = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert len(lines) == len(wishes) == 4
    assert [level for level, _ in lines] == ["WARNING", "INFO", "WARNING", "INFO"]
    assert lines[0][1].startswith(
        "! realtime: no SCHED_FIFO: Operation not permitted. To have it: put LimitRTPRIO=50"
    )
    assert lines[1][1] == "= realtime: timer slack: 1 ns"
    assert refused(wishes).startswith("realtime: no SCHED_FIFO, no memory lock;")


def test_nothing_refused_is_nothing_to_say() -> None:
    assert refused(()) == ""
    assert refused((SchedulingRequest("SCHED_FIFO", True, "priority 50"),)) == ""
