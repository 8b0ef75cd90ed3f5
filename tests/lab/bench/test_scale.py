"""A message's cost is what it adds, and a ladder is compared with its own first step."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from array import array
from typing import TYPE_CHECKING, Any
from xmlrpc.client import ServerProxy
from xmlrpc.server import SimpleXMLRPCServer

import pytest

from lab.bed.ros import NODES
from lab.bench.scale import ScaleStep, _of_copy, _panels, _targets, copies, per_message
from lab.usage import Usage

if TYPE_CHECKING:
    from collections.abc import Iterator


def test_the_idle_cost_is_taken_off_for_as_long_as_the_stream_ran() -> None:
    idle = Usage(0.1, 10.0, 0)  # 1 % of a core
    assert per_message(Usage(0.42, 2.0, 0), idle, 10_000) == pytest.approx(40.0)
    assert per_message(Usage(0.42, 2.0, 0), Usage(0.0, 0.0, 0), 10_000) == pytest.approx(42.0)


def step(latency: float, one: float, two: float) -> ScaleStep:
    made = ScaleStep(array("d", [latency] * 10), control=array("d", [1.0] * 10))
    made.note("agent 1", one)
    made.note("agent 2", two)
    made.note("direct", 5.0)
    return made


def test_the_median_of_rounds_counts() -> None:
    made = step(100.0, 40.0, 10.0)
    made.note("agent 1", 60.0)
    made.note("agent 1", 1000.0)
    assert made.cpu_of("agent 1") == 60.0
    assert made.both == 70.0
    assert made.cpu_of("others") is None


def test_a_copy_costs_less_than_a_message_that_goes_to_many() -> None:
    assert [copies("peers", 16), copies("topics", 1000), copies("subscribers", 16)] == [1, 1, 15]
    assert _of_copy("subscribers", 16, step(1.0, 150.0, 1.0)) == 10.0


def test_targets_compare_the_last_step_with_the_first() -> None:
    ladder = {2: step(100.0, 40.0, 40.0), 4: step(1.0, 1.0, 1.0), 16: step(105.0, 50.0, 46.0)}
    linked = list(_targets({"peers": ladder}))
    assert [(one.value, one.reached) for one in linked] == [(1.05, True), (1.2, False)]
    assert [one.value for one in _targets({"subscribers": ladder})] == [pytest.approx(50 / 15 / 40, abs=1e-3)]


def test_the_picture_begins_at_one() -> None:
    lines = _panels({"topics": {10: step(100.0, 40.0, 20.0), 1000: step(150.0, 40.0, 30.0)}})["topics"]
    assert lines["latency p50"] == [(10, 1.0), (1000, 1.5)]
    assert lines["CPU a message, receiver"] == [(10, 1.0), (1000, 1.5)]


@pytest.fixture
def master() -> Iterator[tuple[str, list[tuple[str, ...]]]]:
    """A master that takes every publisher, and its calls."""
    calls: list[tuple[str, ...]] = []
    server = SimpleXMLRPCServer(("127.0.0.1", 0), logRequests=False)

    def register(*words: str) -> list[object]:
        calls.append(words)
        return [1, "", []]

    server.register_function(register, "registerPublisher")
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}/", calls
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_crowd_registers_its_publishers_and_answers_for_them(
    master: tuple[str, list[tuple[str, ...]]],
) -> None:
    uri, calls = master
    argv = [sys.executable, str(NODES / "crowd.py"), "--per-node", "2"]
    with subprocess.Popen(
        argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={"ROS_MASTER_URI": uri}, text=True
    ) as crowd:
        assert crowd.stdin
        assert crowd.stdout

        def say() -> dict[str, object]:
            assert crowd.stdout
            event: dict[str, object] = json.loads(crowd.stdout.readline().removeprefix("@ "))
            return event

        assert say() == {"event": "up"}
        for count in (3, 5):
            before = time.monotonic_ns()
            crowd.stdin.write(f"{count}\n")
            crowd.stdin.flush()
            told = say()
            assert before < int(str(told.pop("at_ns"))) < time.monotonic_ns()
            assert told == {"event": "registered", "count": count}
        assert [call[:2] for call in calls] == [(f"/crowd{n // 2}", f"/crowd/topic{n}") for n in range(5)]
        with ServerProxy(calls[0][3]) as slave:
            answer: Any = slave.requestTopic("/me", "/crowd/topic0", [["TCPROS"]])
            assert answer[2][0] == "TCPROS"
            assert slave.getPid("/me") == [1, "", crowd.pid]
        crowd.stdin.close()
        assert crowd.wait(5) == 0
