"""A subscriber that is stuck hurts itself alone: no other subscriber, topic or peer feels it; memory is bounded."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from lab.bed.processes import eventually
from tests.interop.modules import flows
from tests.interop.recordings import recorded, wait_last

if TYPE_CHECKING:
    from lab.bed.processes import Process
    from tests.interop.conftest import ModuleFactory
    from tests.interop.modules import Module

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

MB = 1 << 20
GROWTH = 80 * MB
"""What an agent may grow by: 32 MiB wait for a stuck subscriber at the most, and buffers for large messages."""


def rss(module: Module) -> int:
    """Bytes of memory that a module's agent has."""
    status = Path(f"/proc/{module.agent.pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) * 1024


def last(listener: Process) -> int:
    """The number of the last message that a listener has."""
    return int(str(listener.events("report")[-1]["last"]))


def total(listener: Process) -> tuple[object, ...]:
    """What a listener has seen of missing, doubled and damaged messages."""
    report = listener.events("report")[-1]
    return report["gaps"], report["doubled"], report["bad"]


@pytest.mark.parametrize(("size", "rate"), [(MB, 30), (64, 1000)], ids=["images", "commands"])
def test_a_stopped_subscriber_is_its_own_affair(modules: ModuleFactory, tmp_path: Path, size: int, rate: int) -> None:
    a, b, c = modules("a", "b", "c")
    stuck = b.ros.node("rospy" if size == 64 else "roscpp", "listener", "__name:=stuck", topic="/data")
    beside = [
        b.ros.roscpp("listener", "__name:=beside_1", topic="/data"),
        b.ros.roscpp("listener", "__name:=beside_2", topic="/data"),
        c.ros.roscpp("listener", "__name:=elsewhere", topic="/data"),
    ]
    other = b.ros.roscpp("recorder", topic="/other", nodelay=True, commands=True)
    a.ros.roscpp("talker", "__name:=busy", topic="/data", size=size, rate=rate, wait=1, nodelay=True)
    a.ros.roscpp("talker", "__name:=other", topic="/other", rate=100, wait=1, nodelay=True)
    for listener in (stuck, *beside, other):
        flows(listener, 2)
    recorded(other, tmp_path)
    sizes = {module.name: rss(module) for module in (a, b, c)}
    before = [total(listener) for listener in beside]
    stuck.freeze()
    goals = [last(listener) + 5 * rate for listener in beside]
    for listener, goal in zip(beside, goals, strict=True):
        wait_last(listener, goal)
    flows(other, 50)
    assert [total(listener) for listener in beside] == before
    rows = recorded(other, tmp_path)
    sequences = [row.sequence for row in rows]
    assert sequences == list(range(sequences[0], sequences[-1] + 1))
    assert sorted(row.age for row in rows)[len(rows) // 2] < 0.05
    for module in (a, b, c):
        assert rss(module) - sizes[module.name] < GROWTH
    present = last(beside[0])
    assert present - last(stuck) > 3 * rate
    stuck.thaw()
    wait_last(stuck, present + 1)
    assert total(stuck)[1:] == (0, 0)
    # Old messages fill its socket and, of large ones, no more than its queue; the others gave way to newer ones.
    eventually(lambda: last(beside[0]) - last(stuck) < rate, what="the stuck subscriber has caught up")
