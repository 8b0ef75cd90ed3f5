"""What perf, strace and py-spy write is read as it comes."""

from __future__ import annotations

import sys

from lab.bench.profile import AgentProfile, _parts, _short, parse_perf, parse_stacks, parse_strace

PERF = """
    59.39%  [kernel.kallsyms]                        [k] finish_task_switch.isra.0                  -      -
    17.39%  libpython3.11.so.1.0                     [.] _PyEval_EvalFrameDefault                   -      -

"""
STRACE = """% time     seconds  usecs/call     calls    errors syscall
------ ----------- ----------- --------- --------- ----------------
 71.53    0.223521        8596        26         2 futex
 10.62    0.033189          14      2258           epoll_wait
------ ----------- ----------- --------- --------- ----------------
100.00    0.312472          46      2284         2 total
"""
STACKS = """\
main (rmpa:1);Loop.run_forever (asyncio/base_events.py:593);Stream._uncork (rmpa/runtime/stream.py:269) 6
main (rmpa:1);Loop.run_forever (asyncio/base_events.py:593);Stream._deliver (rmpa/runtime/stream.py:391) 2
main (rmpa:1);Loop.run_forever (asyncio/base_events.py:593);Link.receive (rmpa/mesh/link.py:258) 2
main (rmpa:1);Loop.run_forever (asyncio/base_events.py:593);DirectSelector.select (rmpa/runtime/event_loop.py:1) 90
Thread._bootstrap (threading.py:1002);_worker (concurrent/futures/thread.py:81) 50
"""


def test_perf() -> None:
    assert parse_perf(PERF) == {
        "[kernel.kallsyms] [k] finish_task_switch.isra.0": 59.39,
        "libpython3.11.so.1.0 [.] _PyEval_EvalFrameDefault": 17.39,
    }
    assert parse_perf("    51.31%  [kernel.kallsyms]    \n") == {"[kernel.kallsyms]": 51.31}
    assert parse_perf("no samples\n") == {}


def test_strace_most_calls_first_and_no_total() -> None:
    assert list(parse_strace(STRACE).items()) == [("epoll_wait", 2258), ("futex", 26)]
    assert parse_strace("strace: attach: Operation not permitted\n") == {}


def test_stacks_without_what_only_waits() -> None:
    functions, modules = parse_stacks(STACKS)
    assert functions["Stream._uncork (rmpa/runtime/stream.py:269)"] == 60.0
    assert modules == {"rmpa/runtime/stream.py": 80.0, "rmpa/mesh/link.py": 20.0}
    assert parse_stacks("") == ({}, {})


def test_the_cost_is_divided_as_the_samples_are() -> None:
    profile = AgentProfile(objects={"kernel": 60.0, "python": 39.5, "vdso": 0.5})
    assert _parts({"agent 1": profile, "agent 2": AgentProfile()}, {"agent 1": 50.0}) == {
        "agent 1": {"kernel": 30.0, "python": 19.75}
    }


def test_paths_are_shortened_to_the_module() -> None:
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    assert _short("/somewhere/src/rmpa/mesh/link.py") == "rmpa/mesh/link.py"
    assert _short(f"/usr/lib/{version}/asyncio/events.py") == "asyncio/events.py"
    assert _short(f"/venv/lib/{version}/site-packages/click/core.py") == "click/core.py"
    assert _short("program.py") == "program.py"
