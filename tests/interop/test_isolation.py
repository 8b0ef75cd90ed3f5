"""A launch of fifty nodes beside a stream at 1 kHz between real nodes: the stream does not notice.

That is completeness, and a latency that no node would notice. What the machine itself was late in the same seconds is
measured with it, by the publisher that wants to wake up each millisecond, and allowed for: the machine may be shared.
"""

from __future__ import annotations

from array import array
from pathlib import Path
from typing import Final

import pytest

from lab.bed.processes import Event, Process
from lab.bed.ros import NODES
from tests.interop.conftest import ModuleFactory

pytestmark = [pytest.mark.alone, pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

RATE: Final = 1000
SECONDS: Final = 8
QUEUE: Final = 5000
# Milliseconds, on a machine that wakes everybody in time.
P99: Final = 20.0


def of_round(number: int) -> dict[str, object]:
    return {"where": lambda event: event["round"] == number}


def percentile(values: list[float], share: float) -> float:
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def launch(process: Process, word: str, event: str) -> Event:
    mark = process.mark_events()
    process.tell(word)
    return process.wait_event(event, 60.0, since=mark)


@pytest.mark.long
def test_fifty_nodes_that_start_do_not_disturb_a_stream(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", log_level="info")
    source = a.ros.roscpp("source", nodes=NODES, commands=True, topic="/command", queue=QUEUE)
    target = b.ros.roscpp("sink", nodes=NODES, commands=True, topics="/command", queue=QUEUE, nodelay=True)
    source.wait_event("connected")
    source.tell(f"1 64 {RATE} {RATE // 2} {tmp_path / 'warm'}")  # until every connection is as it will be
    source.wait_event("sent", **of_round(1))  # type: ignore[arg-type]
    launches = [module.ros.rospy("launch", commands=True, count=50, topics=10) for module in (a, b)]
    for process in launches:
        process.wait_event("up")
    source.tell(f"2 64 {RATE} {SECONDS * RATE} {tmp_path / 'late'}")
    for process in launches:
        calls = launch(process, "launch", "launched")["calls"]
        assert int(str(calls)) > 1000
    b.wait_topic("/launch/node_7/some/topic_3")
    for process in launches:
        launch(process, "end", "ended")
    source.wait_event("sent", 2.0 * SECONDS + 20.0, **of_round(2))  # type: ignore[arg-type]
    target.tell(f"2 {tmp_path / 'came'} 0.5")
    target.wait_event("noted", 30.0, **of_round(2))  # type: ignore[arg-type]
    rows = array("Q", (tmp_path / "came").read_bytes())
    sequence, due, came = rows[1::4], rows[2::4], rows[3::4]
    assert list(sequence) == list(range(SECONDS * RATE))  # none lost, none doubled, none moved
    late = [by / 1e6 for by in array("Q", (tmp_path / "late").read_bytes())]
    latency = [(there - meant) / 1e6 - by for there, meant, by in zip(came, due, late, strict=True)]
    machine = percentile(late, 0.99)
    assert percentile(latency, 0.99) < P99 + 5 * machine, f"ms; the machine itself was {machine:.1f} late"
