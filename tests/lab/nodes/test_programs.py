"""The nodes as programs, in both client libraries, on one host with one master: they do and say the same."""

from __future__ import annotations

import time
from array import array
from functools import partial
from typing import TYPE_CHECKING, get_args

import pytest

from lab.bed.plan import Client, Plan
from lab.bed.processes import eventually
from lab.bed.stage import make_stage
from lab.experiments import flow

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from lab.bed.processes import Event, Process
    from lab.bed.system import System

pytestmark = [pytest.mark.timeout(120), pytest.mark.ros, pytest.mark.netns]
TOPICS = ["/cmd", "/vel"]
MILLISECOND = 1_000_000


@pytest.fixture(params=get_args(Client))
def client(request: pytest.FixtureRequest) -> Client:
    made: Client = request.param
    return made


@pytest.fixture
def robot(client: Client) -> Iterator[System]:
    """One host is enough: what nodes do is none of the hosts' business."""
    plan = Plan(clients=(client,), link="")
    with make_stage(plan) as stage, stage.system("classic", ["pc"]) as made:
        yield made


def _flowing(robot: System, client: Client, scratch: Path) -> tuple[Process, Process]:
    """A source and a sink with a velocity node between, through which messages come."""
    sink = robot.node("pc", "sink", client, nodelay=True)
    robot.node("pc", "velocity", client, nodelay=True)
    source = robot.node("pc", "source", client)
    flow.wait_connected(source, 2)
    flow.wait_flowing(source, sink, TOPICS, scratch)
    return source, sink


def test_round_arrives_whole_with_the_heads_it_was_sent_with(robot: System, client: Client, tmp_path: Path) -> None:
    source, sink = _flowing(robot, client, tmp_path)
    begun = flow.begin(source, tmp_path, size=300, rate=200, count=50)
    sent = flow.sent(begun)
    said = source.wait_event("sent", where=lambda event: event["round"] == begun.number)
    start = int(str(said["start_ns"]))
    assert said["count"] == 50
    assert sent["sequence"].tolist() == list(range(50))
    came = flow.noted(sink, TOPICS, tmp_path, begun.number)
    for topic in TOPICS:
        rows = [row for row in came.itertuples(index=False, name=None) if row[0] == topic]
        assert [row[1] for row in rows] == list(range(50))
        assert [row[2] for row in rows] == [start + 5 * MILLISECOND * number for number in range(50)]
        late = [_int(row[3]) - _int(row[2]) for row in rows]
        assert all(there > left for there, left in zip(late, map(_int, sent["late_ns"].tolist()), strict=True))


def test_polled_velocity_takes_the_newest_command_each_period(robot: System, client: Client, tmp_path: Path) -> None:
    sink = robot.node("pc", "sink", client, topics="/vel")
    robot.node("pc", "velocity", client, mode="polled", rate=20)
    source = robot.node("pc", "source", client, phase=5)  # of the source's own 100 Hz: 5 ms before each tick
    flow.wait_connected(source)
    eventually(lambda: _velocities(source, sink, tmp_path), what="velocities")
    start = int(str(source.events("sent")[0]["start_ns"]))
    assert abs(start % (10 * MILLISECOND) - 5 * MILLISECOND) < 1000  # its phase
    rows = _velocities(source, sink, tmp_path, count=100)
    assert 10 <= len(rows) <= 21  # 20 in a second of 100 commands, and fewer where the machine holds it up
    assert [row[1] for row in rows] == sorted({_int(row[1]) for row in rows})
    assert sum(_int(row[3]) % (50 * MILLISECOND) < 25 * MILLISECOND for row in rows) > len(rows) / 2  # behind a tick


def test_polled_velocity_repeats_nothing(robot: System, client: Client, tmp_path: Path) -> None:
    sink = robot.node("pc", "sink", client, topics="/vel")
    robot.node("pc", "velocity", client, mode="polled", rate=100)
    source = robot.node("pc", "source", client)
    flow.wait_connected(source)
    eventually(lambda: _velocities(source, sink, tmp_path), what="velocities")
    rows = _velocities(source, sink, tmp_path, rate=20.0, count=10)
    assert [row[1] for row in rows] == list(range(10))


def _velocities(
    source: Process, sink: Process, scratch: Path, *, rate: float = 100.0, count: int = 10
) -> list[tuple[object, ...]]:
    begun = flow.begin(source, scratch, size=64, rate=rate, count=count)
    flow.sent(begun)
    return list(flow.noted(sink, ["/vel"], scratch, begun.number).itertuples(index=False, name=None))


def test_sink_gives_rounds_once_says_what_comes_again_and_files_are_of_native_numbers(
    robot: System, client: Client, tmp_path: Path
) -> None:
    source, sink = _flowing(robot, client, tmp_path)
    assert {event["topic"] for event in sink.events("first")} == set(TOPICS)
    rounds = [flow.begin(source, tmp_path, size=64, rate=200, count=count) for count in (3, 4)]
    for begun in rounds:
        flow.sent(begun)
    everything = flow.noted(sink, TOPICS, tmp_path)
    assert len(everything) == 2 * (3 + 4)
    assert flow.noted(sink, TOPICS, tmp_path).empty
    begun = flow.begin(source, tmp_path, size=64, rate=200, count=5)
    flow.sent(begun)
    assert flow.noted(sink, TOPICS, tmp_path, rounds[0].number).empty
    assert flow.noted(sink, TOPICS, tmp_path, begun.number).empty  # the question for another forgot these, too
    before = time.monotonic_ns()
    time.sleep(0.6)  # the pause itself
    mark = sink.mark_events()
    source.tell(f"4000000000 64 100 2 {tmp_path / 'late'}")
    source.wait_event("sent", where=lambda event: event["round"] == 4_000_000_000)
    for topic in TOPICS:
        event = sink.wait_event("again", where=partial(_of, topic), since=mark)
        assert int(str(event["gap_ns"])) > 500 * MILLISECOND
        assert int(str(event["came_ns"])) > before
    sink.tell(f"4000000000 {tmp_path / 'came'} 0.3")
    assert sink.wait_event("noted", since=mark) == {"event": "noted", "round": 4_000_000_000, "count": 4}
    late, came = array("Q"), array("Q")
    late.frombytes((tmp_path / "late").read_bytes())
    came.frombytes((tmp_path / "came").read_bytes())
    assert len(late) == 2
    assert sorted(zip(came[::4], came[1::4], strict=True)) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert came[3] > came[2] > 0


def _of(topic: str, event: Event) -> bool:
    return event["topic"] == topic


def _int(value: object) -> int:
    assert isinstance(value, int)
    return value
