"""What differs between two runs."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from rmpa.record.diff import TopicDifference, compare
from rmpa.record.format import ModuleRecord, RecordedSource, SegmentWriter
from rmpa.record.merge import Timeline
from rmpa.ros.types.messages import MessageType
from tests.record.conftest import SECOND, START, Record, source

SCAN, CMD = source("/scan", "/laser"), source("/cmd_vel", "/joy")


def compared(one: Path, two: Path) -> dict[str, TopicDifference]:
    return {each.topic: each for each in compare(Timeline([one]), Timeline([two]))}


def test_the_first_difference_of_two_runs_is_named(recording: Record) -> None:
    one = recording("one", {SCAN: [(0.0, "a"), (1.0, "b"), (2.0, "c")], CMD: [(0.0, "x")]})
    two = recording("two", {SCAN: [(0.0, "a"), (1.0, "B"), (3.5, "c")], CMD: [(0.0, "x")]})
    found = compared(one, two)
    assert found["/cmd_vel"].difference == ""
    assert found["/scan"].difference == "message 2 at 1.00 s: data is b, then B"
    assert (found["/scan"].first.rate, found["/scan"].second.gap) == (1.0, 2.5)


@pytest.mark.parametrize(
    ("first", "second", "difference"),
    [
        ("abcdef", "abdef", "message 3 is only in the first"),
        ("abdef", "abcdef", "message 3 is only in the second"),
        ("abc", "abcde", "2 more at the end of the second"),
        ("abc", "", "only in the first"),
        ("", "abc", "only in the second"),
    ],
)
def test_messages_of_one_run_alone(recording: Record, first: str, second: str, difference: str) -> None:
    runs = ({SCAN: [(n / 10, each) for n, each in enumerate(said)], CMD: [(0.0, "x")]} for said in (first, second))
    one, two = (recording(f"run{n}", run) for n, run in enumerate(runs))
    assert compared(one, two)["/scan"].difference == difference


def test_nodes_that_share_a_topic_are_compared_each_with_itself(recording: Record) -> None:
    """In which order the messages of two nodes come is another one in each run."""
    left, right = source("/tf", "/left"), source("/tf", "/right")
    one = recording("one", {left: [(0.0, "l"), (1.0, "l")], right: [(0.5, "r")]})
    two = recording("two", {left: [(0.0, "l"), (0.1, "l")], right: [(0.5, "R")]})
    assert set(compared(one, two)) == {"/tf"}, "nodes of other modules: by the topic"
    same = recording("one", {left: [(0.0, "l"), (0.1, "l")], right: [(0.05, "R")]}, name="same.mcap")
    assert {topic: each.difference for topic, each in compared(one, same).items()} == {
        "/tf of one/left": "",
        "/tf of one/right": "message 1 at 0.50 s: data is r, then R",
    }


def stamped(path: Path, kind: MessageType, values: Iterable[Any]) -> Path:
    """A recording of messages, each with its time in its header."""
    with path.open("wb") as file:
        writer = SegmentWriter(file, ModuleRecord(name="arm"))
        one = RecordedSource("/topic", kind.name, kind.md5sum, kind.definition, "/node")
        for number, value in enumerate(values):
            at = START + number * SECOND
            writer.write(one, at, at, kind.serialize(kind.given(None, value)))
        writer.finish()
    return path


def test_stamps_of_headers_do_not_count_at_any_depth(tmp_path: Path) -> None:
    kind = MessageType("tf2_msgs/TFMessage")

    def run(name: str, begin: float, x: float) -> Path:
        values = [
            {"transforms": [{"header": {"stamp": begin + n, "seq": n}, "transform": {"translation": {"x": at}}}]}
            for n, at in enumerate((0.0, x))
        ]
        return stamped(tmp_path / name, kind, values)

    one, two, three = run("1.mcap", 100.0, 1.5), run("2.mcap", 200.0, 1.5), run("3.mcap", 100.0, 2.5)
    assert compared(one, two)["/topic"].difference == ""
    difference = compared(one, three)["/topic"].difference
    assert difference == "message 2 at 1.00 s: transforms[0].transform.translation.x is 1.5, then 2.5"


def test_ages_are_from_the_stamp_to_the_recording(tmp_path: Path) -> None:
    kind = MessageType("sensor_msgs/Temperature")
    begin = START / SECOND
    values = [{"header": {"stamp": begin + n - 0.25 - (n == 7)}, "temperature": 20.0} for n in range(10)]
    path = stamped(tmp_path / "a.mcap", kind, values)
    run = compared(path, path)["/topic"].first
    assert run.age == pytest.approx(0.25, abs=1e-3)
    assert run.age_p99 == pytest.approx(1.25, abs=1e-3)


def test_a_type_that_changed_is_named(recording: Record) -> None:
    other = SCAN._replace(type="std_msgs/Int8", md5sum="27ffa0c9c4b8fb8492252bcad9e5c57b")
    one, two = recording("one", {SCAN: [(0.0, "a")]}), recording("two", {other: [(0.0, "b")]})
    assert (
        compared(one, two)["/scan"].difference
        == "message 1 at 0.00 s: the type is std_msgs/String, then std_msgs/Int8"
    )
