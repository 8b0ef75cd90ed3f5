"""What happened in a recording, in plain words."""

from __future__ import annotations

from pathlib import Path

import pytest

from rmpa.record.format import EVENT_SOURCE, Event, ModuleRecord, RecordedSource, SegmentWriter, event_bytes
from rmpa.record.story import render, tell
from rmpa.ros.types.messages import MessageType
from tests.record.conftest import SECOND, START, Record, read_any, source

SCAN = source("/scan", "/laser")
LOG = MessageType("rosgraph_msgs/Log")


def written(path: Path, *messages: tuple[RecordedSource, float, bytes]) -> Path:
    """A recording of the module arm."""
    with path.open("wb") as file:
        writer = SegmentWriter(file, ModuleRecord(name="arm"))
        for one, at, data in messages:
            writer.write(one, START + round(at * SECOND), START + round(at * SECOND), data)
        writer.finish()
    return path


def log(at: float, level: int, text: str, topic: str = "/rosout") -> tuple[RecordedSource, float, bytes]:
    """A line of a node's log."""
    one = RecordedSource(topic, LOG.name, LOG.md5sum, LOG.definition, "/motor", module="arm")
    values = {"header": {"stamp": at}, "level": level, "name": "/motor", "msg": text, "file": "motor.py", "line": 7}
    return one, at, LOG.serialize(LOG.given(None, values))


def told(path: Path) -> list[tuple[float, str, str, str]]:
    return [(line.after, line.level, line.text, line.evidence) for line in tell(read_any(path), "fall").lines]


def test_events_are_told_in_order_with_their_evidence(tmp_path: Path) -> None:
    kinds = [
        ("alarm", "warn"), ("peer_lost", "error"), ("node_died", "error"), ("contract", "warn"), ("stop", "error"),
        ("clock_step", "warn"), ("topic_came", ""), ("peer_linked", ""),
    ]  # fmt: skip
    events = [(EVENT_SOURCE, 10.0 - n, event_bytes(Event(kind, f"{kind}!"))) for n, (kind, _) in enumerate(kinds)]
    first = (SCAN, 0.0, b"")
    path = written(tmp_path / "a.mcap", first, *events)
    assert told(path) == [
        (10.0 - n, level, f"{kind}!", "/rmpa/events")
        for n, (kind, level) in reversed(list(enumerate(kinds)))
        if level
    ]


def test_a_topic_that_is_silent_has_a_gap_also_to_the_end(recording: Record) -> None:
    steady = [n / 10 for n in range(30)] + [6.0 + n / 10 for n in range(10)]
    path = recording(
        "arm",
        {
            SCAN: [(at, "s") for at in steady],
            source("/joy", "/joystick"): [(n * n / 50, "j") for n in range(24)],  # rarer and rarer
            source("/odom", "/base"): [(n / 5, "o") for n in range(60)],
        },
    )
    assert told(path) == [
        (2.9, "warn", "/scan of /laser was silent for 3.10 s; usual are 0.1 s", "/scan"),
        (6.9, "warn", "/scan of /laser was silent for 4.90 s, to the end; usual are 0.1 s", "/scan"),
    ]


def test_errors_of_logs_are_told_once_and_a_flood_is_counted(tmp_path: Path) -> None:
    lines = [log(n, 8, f"hot {n}", topic) for n in range(8) for topic in ("/rosout_agg", "/rosout")]
    path = written(tmp_path / "a.mcap", (SCAN, 0.0, b""), log(0.5, 4, "warm"), *lines, log(20.0, 16, "burnt"))
    assert [text for _, _, text, _ in told(path)] == [
        "/motor logs error: hot 0",
        "/motor logs error: hot 1",
        "/motor logs error: hot 2",
        "/motor logs error: hot 3 (and 4 more within 10 s)",
        "/motor logs fatal: burnt",
    ]
    assert told(path)[-1] == (20.0, "error", "/motor logs fatal: burnt", "/rosout motor.py:7")


def test_a_resource_of_each_module_has_its_own_profile(recording: Record) -> None:
    def profile(module: str) -> RecordedSource:
        return source("/camera/profile", "/camera", latching=True, module=module)

    said = {profile("arm"): [(0.0, ""), (4.0, "full"), (5.0, "small")], profile("leg"): [(4.5, "small")]}
    assert [(at, text) for at, _, text, _ in told(recording("arm", said))] == [
        (4.0, "/camera runs full in place of none"),
        (5.0, "/camera runs small in place of full"),
    ]


def test_what_was_left_out_is_said(tmp_path: Path) -> None:
    event = Event("left_out", "left out: 7 of /image", facts={"/image": 7})
    story = tell(read_any(written(tmp_path / "a.mcap", (EVENT_SOURCE, 0.0, event_bytes(event)))), "fall")
    assert story.notes == ("Left out, for the budgets of [record] or the disk: 7 messages of /image.",)


@pytest.mark.parametrize("kind", ["md", "html"])
def test_nothing_of_a_recording_is_markup(tmp_path: Path, kind: str) -> None:
    text = "<script>alert(1)</script> | a`b\n# c\x1b[31m"
    path = written(tmp_path / "a.mcap", (SCAN, 0.0, b""), log(1.0, 8, text))
    page = render(tell(read_any(path), "<img src=x>", ["<b>"]), kind)
    assert not any(tag in page for tag in ("<script", "<img", "<b>", "\x1b"))
    assert "1.00 s" in page
    if kind == "html":
        assert "http" not in page.replace("http-equiv", ""), "it needs nothing else"
        assert page.count('href="#line1"') == page.count('id="line1"') == 1
    else:
        row = next(line for line in page.splitlines() if "alert" in line)
        assert row.count("|") - row.count("\\|") == 7


def test_only_what_happened_around_a_time(tmp_path: Path) -> None:
    story = tell(read_any(written(tmp_path / "a.mcap", *(log(n, 8, f"{n}") for n in (0.0, 30.0, 60.0)))), "fall")
    some = story.around(35.0)
    assert [line.after for line in some.lines] == [30.0]
    assert some.notes == ("Only what happened within 15 s of 35.0 s: 1 of 3 lines.",)
    assert "Nothing went wrong here" in render(story.around(99.0), "md")
