"""One timeline of several modules."""

from __future__ import annotations

from pathlib import Path

import pytest

from rmpa.core.errors import RmpaError
from rmpa.record.bag import read_any, read_bag, write_bag
from rmpa.record.diff import compare
from rmpa.record.format import (
    EVENT_SOURCE,
    EVENTS,
    TIME,
    Event,
    ModuleRecord,
    SegmentReader,
    SegmentWriter,
    event_bytes,
)
from rmpa.record.merge import Offset, merge, notes_of
from rmpa.record.story import render, tell
from tests.record.conftest import SECOND, START, TEXT, Record, source, text

SCAN, CMD = source("/scan", "/laser"), source("/cmd_vel", "/joy")


def merged(tmp_path: Path, *paths: Path, reference: str = "", name: str = "all.mcap") -> tuple[Path, object]:
    path = tmp_path / name
    with path.open("wb") as file:
        return path, merge(paths, file, reference)


def lines(path: Path) -> list[tuple[float, str, str]]:
    return [((m.log_time - START) / SECOND, m.source.module, m.data[4:].decode()) for m in read_any(path)]


def test_times_are_put_on_one_clock(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a1"), (2.0, "a2")]}, {"base": (10.0, 0.002)})
    base = recording("base", {CMD: [(11.5, "b1"), (12.5, "b2")]})
    path, result = merged(tmp_path, arm, base)
    assert lines(path) == [(1.0, "arm", "a1"), (1.5, "base", "b1"), (2.0, "arm", "a2"), (2.5, "base", "b2")]
    assert result.offsets == {"arm": Offset(0.0, 0.0), "base": Offset(10.0, 0.002)}  # type: ignore[attr-defined]
    assert "4.00 ms may have happened in the other order" in " ".join(notes_of(path))


def test_a_clock_that_only_the_other_one_knows_is_used(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a")]}, {"base": (10.0, 0.002)})
    base = recording("base", {CMD: [(11.5, "b")]})
    path, _ = merged(tmp_path, arm, base, reference="base")
    assert lines(path) == [(11.0, "arm", "a"), (11.5, "base", "b")]


def test_what_is_not_known_of_a_clock_is_said_and_not_guessed(tmp_path: Path, recording: Record) -> None:
    arm, base = recording("arm", {SCAN: [(1.0, "a")]}), recording("base", {CMD: [(0.5, "b")]})
    path, result = merged(tmp_path, arm, base)
    assert result.offsets["base"] == Offset(0.0, None)  # type: ignore[attr-defined]
    assert lines(path) == [(0.5, "base", "b"), (1.0, "arm", "a")]
    assert "The clock of base is not known" in " ".join(notes_of(path))


def test_copies_of_proxies_and_repeated_messages_are_left_out(tmp_path: Path, recording: Record) -> None:
    copy = source("/scan", "/rmpa/arm/laser")
    stranger = source("/odd", "/rmpa/lost/node")
    arm = recording("arm", {SCAN: [(1.0, "a")]})
    base = recording("base", {copy: [(1.1, "a")], stranger: [(1.2, "s")]})
    path, result = merged(tmp_path, arm, base)
    assert [each[1:] for each in lines(path)] == [("arm", "a"), ("base", "s")]
    assert result.doubles == 1  # type: ignore[attr-defined]


@pytest.mark.parametrize("reference", ["arm", "base"])
@pytest.mark.parametrize("step", [3600.0, -3600.0])
def test_a_clock_that_is_set_moves_nothing(tmp_path: Path, recording: Record, reference: str, step: float) -> None:
    """The arm's clock is set by an hour; what both know of each other's is true each time."""
    late, early = {"arm": (-0.01, 0.001)}, {"arm": (-0.01 - step, 0.001)}
    arm = recording("arm", {SCAN: [(n - step, f"a{n}") for n in range(20)]}, {"base": (0.01 + step, 0.001)}, epoch=0)
    last = {SCAN: [(n, f"a{n}") for n in range(20, 40)]}
    recording("arm", last, {"base": (0.01, 0.001)}, name="00000002.mcap", epoch=step)
    base = recording("base", {CMD: [(n + 0.5, f"b{n}") for n in range(20)]}, early, epoch=5)
    recording("base", {CMD: [(n + 0.5, f"b{n}") for n in range(20, 40)]}, late, name="00000002.mcap", epoch=5)
    path, result = merged(tmp_path, arm.parent, base.parent, reference=reference)
    assert [said for _, _, said in lines(path)] == [f"{module}{n}" for n in range(40) for module in "ab"]
    assert max(abs(one.ahead) for one in result.offsets.values()) == pytest.approx(0.01)  # type: ignore[attr-defined]
    assert f"The clock of arm was set meanwhile ({step:+.3f} s)" in " ".join(notes_of(path))


def test_a_latched_message_of_before_a_step_is_there_once(tmp_path: Path, recording: Record) -> None:
    latched = source("/map", "/map_server", latching=True)
    recording("arm", {latched: [(0.0, "map")]}, epoch=0)
    with (tmp_path / "arm/00000002.mcap").open("wb") as file:
        writer = SegmentWriter(file, ModuleRecord(name="arm"))
        writer.metadata(TIME, {"boot": "arm", "epoch": f"{3600 * SECOND}"})
        writer.write(latched, START + 3605 * SECOND, START, text("map"))
        writer.finish()
    path, result = merged(tmp_path, tmp_path / "arm")
    assert lines(path) == [(3600.0, "arm", "map")]
    assert result.doubles == 1  # type: ignore[attr-defined]


def test_a_module_that_is_missing_is_named(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a")]}, {"base": (0.0, 0.001), "leg": (0.0, 0.001)})
    path, _ = merged(tmp_path, arm, recording("base", {CMD: [(1.5, "b")]}))
    assert "Nothing of leg is here, which was linked" in " ".join(notes_of(path))


def test_a_topic_that_changes_its_type_is_all_there(tmp_path: Path, recording: Record) -> None:
    """Also a type that only its publisher knew."""
    odd = SCAN._replace(type="odd_msgs/Odd", md5sum="f" * 32, definition="string data  # 90\udcb0\n")
    arm = recording("arm", {SCAN: [(0.0, "a")], odd: [(1.0, "o"), (2.0, "p")]})
    path, _ = merged(tmp_path, arm)
    bag = tmp_path / "all.bag"
    write_bag(read_any(path), bag)
    for one in (path, bag):
        found = [(m.source.type, m.source.md5sum, m.source.definition[:11], m.data[4:]) for m in read_any(one)]
        first, then = (TEXT.name, TEXT.md5sum, TEXT.definition[:11]), (odd.type, odd.md5sum, "string data")
        assert found == [(*first, b"a"), (*then, b"o"), (*then, b"p")]
    assert odd.definition in {m.source.definition for m in read_any(path)}


def test_only_topics_that_are_wanted_and_events(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "s")], CMD: [(2.0, "c")], source("/tf"): [(3.0, "t")]})
    with arm.with_name("00000002.mcap").open("wb") as file:
        writer = SegmentWriter(file, ModuleRecord(name="arm"))
        writer.write(EVENT_SOURCE, START, START, event_bytes(Event("note", "n")))
        writer.finish()
    with (tmp_path / "some.mcap").open("wb") as file:
        merge([arm.parent], file, "", ("/cmd*", "/t?"))
    assert [m.source.topic for m in read_any(tmp_path / "some.mcap")] == [EVENTS, "/cmd_vel", "/tf"]


def test_two_merges_of_one_run_are_the_same_bytes(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(n / 10, f"{n}") for n in range(50)]}, {"base": (0.25, 0.001)})
    base = recording("base", {CMD: [(n / 7, f"{n}") for n in range(50)]}, {"arm": (-0.25, 0.001)})
    one, _ = merged(tmp_path, arm, base)
    other, _ = merged(tmp_path, base, arm, name="other.mcap")
    assert one.read_bytes() == other.read_bytes()


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, recording: Record) -> None:
    arm, bad = recording("arm", {SCAN: [(1.0, "a")]}), tmp_path / "bad.mcap"
    bad.write_bytes(b"no recording")
    path, result = merged(tmp_path, arm, bad)
    assert len(lines(path)) == 1
    assert "bad.mcap" in result.damaged[0]  # type: ignore[attr-defined]
    with pytest.raises(RmpaError, match=r"no recording of leg; there are arm"):
        merged(tmp_path, arm, reference="leg")
    with pytest.raises(RmpaError, match="nothing can be read"):
        merged(tmp_path, bad)


def test_a_bag_has_the_same_messages(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a"), (2.0, "b")], source("/map", "/m", latching=True): [(0.5, "map")]})
    bag = tmp_path / "arm.bag"
    assert write_bag(SegmentReader(arm).messages(), bag) == 3
    found = list(read_bag(bag))
    assert [(m.source.topic, m.source.node, m.source.latching, m.data) for m in found] == [
        ("/map", "/rmpa/arm/m", True, text("map")),
        ("/scan", "/rmpa/arm/laser", False, text("a")),
        ("/scan", "/rmpa/arm/laser", False, text("b")),
    ]
    with pytest.raises(RmpaError, match="exists"):
        write_bag([], bag)


def test_the_first_difference_of_two_runs_is_named(tmp_path: Path, recording: Record) -> None:
    one = recording("one", {SCAN: [(0.0, "a"), (1.0, "b"), (2.0, "c")], CMD: [(0.0, "x")]})
    two = recording("two", {SCAN: [(0.0, "a"), (1.0, "B"), (3.5, "c")], CMD: [(0.0, "x")]})
    command, scan = compare(read_any(one), read_any(two))
    assert command.same
    assert scan.difference == "message 2 at 1.00 s: data is b, then B"
    assert (scan.first.rate, scan.second.gap) == (1.0, 2.5)


def test_a_story_says_what_happened(tmp_path: Path, recording: Record) -> None:
    profile = source("/camera/profile", "/camera", latching=True)
    steady = [(n / 10, "s") for n in range(30)] + [(6.0 + n / 10, "s") for n in range(10)]
    arm = recording("arm", {SCAN: steady, profile: [(0.0, "full"), (4.0, "small")]})
    events = tmp_path / "arm/00000002.mcap"
    with events.open("wb") as file:
        writer = SegmentWriter(file, ModuleRecord(name="arm"))
        at = START + 5 * SECOND
        writer.write(EVENT_SOURCE, at, at, event_bytes(Event("peer_lost", "the link to base is lost", "base")))
        writer.write(EVENT_SOURCE, at, at, event_bytes(Event("topic_came", "/x is there")))
        writer.finish()
    told = tell(read_any(arm.parent), "fall")
    assert [(line.kind, line.text) for line in told.lines] == [
        ("gap", "/scan of /laser was silent for 3.10 s; usual are 0.1 s"),
        ("profile", "/camera runs small in place of full"),
        ("peer_lost", "the link to base is lost"),
    ]
    assert "| error | the link to base is lost |" in render(told, "md")
    page = render(told, "html")
    assert page.count("<circle") == 3
    assert "<script" not in page
    quiet = tell(read_any(recording("leg", {SCAN: [(0.0, "a")]})), "<b>quiet</b>")
    assert "Nothing went wrong" in render(quiet, "html")
    assert "<b>quiet" not in render(quiet, "html")
