"""The process: real time, its log, its service manager, and the interpreter of other programs."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import pytest

from rmpa.core.log import configure_logging
from rmpa.runtime import limits, loop
from rmpa.runtime.loop import make_realtime
from rmpa.runtime.programs import set_aside
from rmpa.runtime.systemd import LogWriter, restart_text, watchdog_period

NOBODY: Final = 65534

CHILD: Final = """
import json, os, resource, sys, threading
from rmpa.runtime.loop import make_realtime, worker_pool

def who(tid=0):
    return os.sched_getscheduler(tid) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(tid).sched_priority

outcomes = make_realtime(**json.loads(sys.argv[1]))
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
others = []
thread = threading.Thread(target=lambda: others.append(who()))
thread.start()
thread.join()
with worker_pool() as pool:
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
    monkeypatch.setattr(loop, "_schedule", lambda _: "Operation not permitted")
    monkeypatch.setattr(loop, "_lock_memory", lambda: "")
    with caplog.at_level(logging.INFO):
        make_realtime(50, lock_memory=True)
    lines = [(record.levelname, record.getMessage()) for record in caplog.records]
    refusal = (
        "! realtime: no SCHED_FIFO, priority 50: Operation not permitted; to get it: systemd: sudo rmpa service "
    )
    assert [level for level, _ in lines] == ["WARNING", "INFO"]
    assert lines[0][1].startswith(refusal)


DEADLINE = 10.0


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    out, into = os.pipe()
    os.set_blocking(out, False)
    yield out, into
    os.close(out)
    os.close(into)


@pytest.fixture(autouse=True)
def restore_logging() -> Iterator[None]:
    root = logging.getLogger()
    before, level, raising = root.handlers[:], root.level, logging.raiseExceptions
    yield
    root.handlers[:] = before
    root.setLevel(level)
    logging.raiseExceptions = raising


def read(out: int, enough: Callable[[bytes], bool]) -> bytes:
    got = b""
    deadline = time.monotonic() + DEADLINE
    while not enough(got) and time.monotonic() < deadline:
        try:
            got += os.read(out, 1 << 20)
        except BlockingIOError:
            time.sleep(0.005)
    return got


def test_lines_arrive_in_order_and_all_of_them_before_the_end(pipe: tuple[int, int]) -> None:
    out, into = pipe
    writer = LogWriter(into)
    configure_logging("info", writer, as_json=False)
    for number in range(200):
        logging.getLogger("rmpa.test").info("line %d", number)
    writer.close()
    lines = read(out, lambda got: got.count(b"\n") == 200).splitlines()
    assert [line.split()[-1] for line in lines] == [str(number).encode() for number in range(200)]


def test_nobody_waits_for_a_reader_who_has_stopped(pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "LOG_WAITING", 1000)
    out, into = pipe
    writer = LogWriter(into)
    configure_logging("info", writer, as_json=False)
    log = logging.getLogger("rmpa.test")
    begin = time.monotonic()
    for _ in range(5000):
        log.info("x" * 200)
    assert time.monotonic() - begin < DEADLINE / 2
    assert writer.lost > 1000
    said = read(out, lambda got: b"were lost" in got)
    assert b"log lines were lost" in said
    assert writer.lost == 0
    log.info("and on")
    assert b"and on" in read(out, lambda got: b"and on" in got)
    writer.close()


def test_the_end_does_not_wait_for_ever(pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "DRAIN_TIMEOUT", 0.05)
    out, into = pipe
    writer = LogWriter(into)
    writer.write("x" * (1 << 20))
    begin = time.monotonic()
    writer.close()
    assert time.monotonic() - begin < DEADLINE / 2
    monkeypatch.undo()
    assert len(read(out, lambda got: len(got) == 1 << 20)) == 1 << 20
    writer._thread.join(DEADLINE)
    assert not writer._thread.is_alive()


def test_a_pipe_that_is_gone_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    out, into = os.pipe()
    os.close(out)
    writer = LogWriter(into)
    writer.write("nobody reads this\n")
    writer.close()
    os.close(into)
    assert not writer._thread.is_alive()


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


PROGRAM = "from rmpa.runtime.interpreter import own_command; print(*own_command('web', '--port', '1'))"


@pytest.mark.parametrize(("given", "flag"), [("-I", "-I"), ("-P", "-P"), ("-B", "-P")])
def test_another_program_is_as_deaf(given: str, flag: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, given, "-c", PROGRAM], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [sys.executable, flag, "-m", "rmpa", "web", "--port", "1"]


def test_what_python_path_names_is_found_after_all_else(tmp_path: Path) -> None:
    for name in ("json", "mine"):
        (tmp_path / f"{name}.py").write_text(f"print({name!r}, 'of PYTHONPATH')\n")
    program = "import rmpa.cli, json, os, mine; print(os.environ['PYTHONPATH'])"
    environ = {"PYTHONPATH": f"{tmp_path}:"}
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, cwd="/", env=environ, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["mine of PYTHONPATH", f"{tmp_path}:"]


def test_of_files_set_aside_the_first_ones_stay_and_they_are_nine_at_most(tmp_path: Path) -> None:
    for number in range(12):
        path = tmp_path / "sonar.json"
        path.write_text(str(number))
        set_aside(path, "before")
    names = ["sonar.json.before", *(f"sonar.json.before-{number}" for number in range(2, 10))]
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == dict(
        zip(names, "01234567", strict=False)
    ) | {names[-1]: "11"}
