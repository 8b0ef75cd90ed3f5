"""One timeline of several modules."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader

from rmpa.core.errors import RmpaError
from rmpa.record.bag import write_bag
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
from rmpa.record.merge import Offset, Timeline
from tests.record.conftest import SECOND, START, TEXT, Record, read_any, source, text

SCAN, CMD = source("/scan", "/laser"), source("/cmd_vel", "/joy")


def merged(tmp_path: Path, *paths: Path, reference: str = "", name: str = "all.mcap") -> tuple[Path, Timeline]:
    path, timeline = tmp_path / name, Timeline(paths, reference)
    with path.open("wb") as file:
        timeline.write(file)
    return path, timeline


def lines(path: Path) -> list[tuple[float, str, str]]:
    return [((m.log_time - START) / SECOND, m.source.module, m.data[4:].decode()) for m in read_any(path)]


def notes_of(path: Path) -> list[str]:
    return Timeline([path]).notes


def test_times_are_put_on_one_clock(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a1"), (2.0, "a2")]}, {"base": (10.0, 0.002)})
    base = recording("base", {CMD: [(11.5, "b1"), (12.5, "b2")]})
    path, result = merged(tmp_path, arm, base)
    assert lines(path) == [(1.0, "arm", "a1"), (1.5, "base", "b1"), (2.0, "arm", "a2"), (2.5, "base", "b2")]
    assert result.offsets == {"arm": Offset(0.0, 0.0), "base": Offset(10.0, 0.002)}
    assert "2.00 ms may have happened in the other order" in " ".join(notes_of(path))


def test_a_clock_that_only_the_other_one_knows_is_used(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a")]}, {"base": (10.0, 0.002)})
    base = recording("base", {CMD: [(11.5, "b")]})
    path, _ = merged(tmp_path, arm, base, reference="base")
    assert lines(path) == [(11.0, "arm", "a"), (11.5, "base", "b")]


def test_what_is_not_known_of_a_clock_is_said_and_not_guessed(tmp_path: Path, recording: Record) -> None:
    arm, base = recording("arm", {SCAN: [(1.0, "a")]}), recording("base", {CMD: [(0.5, "b")]})
    path, result = merged(tmp_path, arm, base)
    assert result.offsets["base"] == Offset(0.0, None)
    assert lines(path) == [(0.5, "base", "b"), (1.0, "arm", "a")]
    assert "The clock of base is not known" in " ".join(notes_of(path))


def test_a_clock_is_known_through_a_third_module(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a")]}, {"base": (10.0, 0.002)})
    base = recording("base", {CMD: [(11.5, "b")]})
    leg = recording("leg", {CMD: [(7.75, "l")]}, {"base": (4.0, 0.003)})
    path, result = merged(tmp_path, arm, base, leg, reference="arm")
    assert lines(path) == [(1.0, "arm", "a"), (1.5, "base", "b"), (1.75, "leg", "l")]
    assert result.offsets["leg"] == Offset(6.0, 0.005)
    assert "7.00 ms may have happened in the other order" in " ".join(result.notes)


def test_a_clock_that_drifts_is_followed(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(0.0, "a")]}, {"base": (1.0, 0.002)})
    recording("arm", {SCAN: [(10.0, "b")]}, {"base": (1.004, 0.002)}, name="00000002.mcap", at=10.0)
    base = recording("base", {CMD: [(1.0, "0"), (6.002, "5"), (11.004, "10"), (21.004, "20")]})
    path, _ = merged(tmp_path, arm.parent, base)
    assert [at for at, module, _ in lines(path) if module == "base"] == pytest.approx([0.0, 5.0, 10.0, 20.0])


def test_what_contradicts_is_said_and_the_bound_grows(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a")]}, {"base": (10.0, 0.002)})
    base = recording("base", {CMD: [(11.5, "b")]}, {"arm": (-12.0, 0.002)})
    path, result = merged(tmp_path, arm, base, reference="arm")
    assert result.offsets["base"] == Offset(10.0, 2.0)
    assert "What base knew of the clock of arm contradicts the others by 2.000 s" in " ".join(notes_of(path))


@pytest.mark.parametrize("known_by", ["arm", "base"])
def test_a_clock_that_was_set_while_it_recorded(tmp_path: Path, recording: Record, known_by: str) -> None:
    """The clock of base was two seconds ahead, and set right after two seconds: its times are there twice."""
    by_base: list[dict[str, tuple[float, float | None]]] = [{"arm": (-2.0, 0.002)}, {"arm": (0.0, 0.002)}]
    by_arm: list[dict[str, tuple[float, float | None]]] = [{"base": (2.0, 0.002)}, {"base": (0.0, 0.002)}]
    nothing: list[dict[str, tuple[float, float | None]]] = [{}, {}]
    own, others = (by_base, nothing) if known_by == "base" else (nothing, by_arm)
    base = recording("base", {CMD: [(2.5, "1"), (3.5, "2")]}, own[0], at=2.0, epoch=2.0)
    recording("base", {CMD: [(2.5, "3"), (3.6, "4")]}, own[1], name="00000002.mcap", at=2.1, epoch=0.0)
    arm = recording("arm", {SCAN: [(n / 2 + 0.25, f"{n}") for n in range(4)]}, others[0])
    recording("arm", {SCAN: [(2.25, "5")]}, others[1], name="00000002.mcap", at=2.1)
    path, result = merged(tmp_path, arm.parent, base.parent, reference="arm")
    found = lines(path)
    assert [(at, data) for at, module, data in found if module == "base"] == [
        (0.5, "1"), (1.5, "2"), (2.5, "3"), (3.6, "4"),
    ]  # fmt: skip
    assert [at for at, *_ in found] == sorted(at for at, *_ in found)
    assert "The clock of base was set 2.000 s back while it recorded" in " ".join(result.notes)
    assert "contradicts" not in " ".join(result.notes)


def test_copies_of_proxies_are_left_out_where_the_source_was_recorded(tmp_path: Path, recording: Record) -> None:
    copy, stranger = source("/scan", "/rmpa/arm/laser"), source("/odd", "/rmpa/lost/node")
    arm = recording("arm", {SCAN: [(1.0, "a"), (2.0, "b")]})
    said = [(0.1, "before"), (1.1, "a"), (2.01, "b"), (9.0, "after")]
    base = recording("base", {copy: said, stranger: [(1.2, "s")]})
    path, result = merged(tmp_path, arm, base)
    assert [each[1:] for each in lines(path)] == [
        ("base", "before"), ("arm", "a"), ("base", "s"), ("arm", "b"), ("base", "after"),
    ]  # fmt: skip
    assert result.doubles == 2


def test_what_segments_repeat_is_there_once(tmp_path: Path) -> None:
    """A segment may repeat a message before the one before it has it; in the ring's first one it is all there is."""
    chart = source("/map", latching=True)
    for number, said in enumerate([[(1.5, 1.0)], [(3.0, 2.0), (2.0, 2.0)], [(4.0, 2.0)]]):
        with (tmp_path / f"{number}.mcap").open("wb") as file:
            writer = SegmentWriter(file, ModuleRecord(name="arm"))
            for log_time, publish_time in said:
                writer.write(chart, START + round(log_time * SECOND), START + round(publish_time * SECOND), text("m"))
                writer.flush()
            writer.finish()
    found = [((m.log_time - START) / SECOND, m.repeated) for m in read_any(tmp_path)]
    assert found == [(1.5, True), (2.0, False)]


def test_a_merged_recording_can_be_merged_again(tmp_path: Path, recording: Record) -> None:
    arm, _ = merged(tmp_path, recording("arm", {SCAN: [(1.0, "a")]}, {"base": (10.0, 0.002)}), name="one.mcap")
    base, _ = merged(tmp_path, recording("base", {CMD: [(11.5, "b")]}), name="other.mcap")
    both, result = merged(tmp_path, arm, base)
    assert lines(both) == [(1.0, "arm", "a"), (1.5, "base", "b")]
    assert result.offsets == {"arm": Offset(0.0, 0.0), "base": Offset(10.0, 0.002)}
    again, once_more = merged(tmp_path, both, name="again.mcap")
    assert lines(again) == lines(both)
    assert once_more.offsets == result.offsets


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
    assert max(abs(one.ahead) for one in result.offsets.values()) == pytest.approx(0.01)
    way = "forward" if step > 0 else "back"
    assert f"The clock of arm was set 3600.000 s {way} while it recorded" in " ".join(notes_of(path))


def test_a_latched_message_of_before_a_step_is_there_once(tmp_path: Path, recording: Record) -> None:
    latched = source("/map", "/map_server", latching=True)
    recording("arm", {latched: [(0.0, "map")]}, epoch=0)
    with (tmp_path / "arm/00000002.mcap").open("wb") as file:
        writer = SegmentWriter(file, ModuleRecord(name="arm"))
        writer.metadata(TIME, {"boot": "1", "epoch": f"{START + 3600 * SECOND}"})
        writer.write(latched, START + 3605 * SECOND, START, text("map"))
        writer.finish()
    path, result = merged(tmp_path, tmp_path / "arm")
    assert lines(path) == [(3600.0, "arm", "map")]
    assert result.doubles == 1


def test_a_module_that_is_missing_is_named(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a")]}, {"base": (0.0, 0.001), "leg": (0.0, 0.001)})
    base = recording("base", {CMD: [(1.5, "b")]}, {"head": (0.0, 0.001)})
    path, _ = merged(tmp_path, arm, base)
    assert "Nothing of head, leg is here, which was linked" in " ".join(notes_of(path))
    again, _ = merged(tmp_path, path, recording("leg", {CMD: [(1.5, "l")]}), name="again.mcap")
    assert "Nothing of head is here, which was linked" in " ".join(notes_of(again))


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
        Timeline([arm.parent], "", ("/cmd*", "/t?")).write(file)
    assert [m.source.topic for m in read_any(tmp_path / "some.mcap")] == [EVENTS, "/cmd_vel", "/tf"]


def test_two_merges_of_one_run_are_the_same_bytes(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(n / 10, f"{n}") for n in range(50)]}, {"base": (0.25, 0.001)})
    recording("arm", {SCAN: [(5 + n / 10, f"{n}") for n in range(50)]}, {"base": (0.25, 0.001)}, name="00000002.mcap")
    base = recording("base", {CMD: [(n / 7, f"{n}") for n in range(50)]}, {"arm": (-0.25, 0.001)})
    again = tmp_path / "z" / "again.mcap"
    again.parent.mkdir()
    again.write_bytes(arm.read_bytes())
    orders = [(arm.parent, base), (base, *sorted(arm.parent.iterdir(), reverse=True)), (arm, arm.parent, again, base)]
    first, *others = (merged(tmp_path, *paths, name=f"{n}.mcap")[0].read_bytes() for n, paths in enumerate(orders))
    assert others == [first, first]


def test_more_files_than_a_process_may_open(tmp_path: Path, recording: Record) -> None:
    arm = [recording("arm", {SCAN: [(float(n), f"{n}")]}, name=f"{n:08}.mcap") for n in range(30)]
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    opened = len(list(Path("/proc/self/fd").iterdir()))
    resource.setrlimit(resource.RLIMIT_NOFILE, (opened + 10, hard))
    try:
        found = [m.data for m in read_any(arm[0].parent)]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert found == [text(f"{number}") for number in range(30)]


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, recording: Record) -> None:
    arm, bad = recording("arm", {SCAN: [(1.0, "a")]}), tmp_path / "bad.mcap"
    bad.write_bytes(b"no recording")
    path, result = merged(tmp_path, arm, bad)
    assert len(lines(path)) == 1
    assert "bad.mcap" in "".join(result.damaged.values())
    with pytest.raises(RmpaError, match=r"no recording by the clock of leg; there are arm"):
        merged(tmp_path, arm, reference="leg")
    with pytest.raises(RmpaError, match="nothing can be read"):
        merged(tmp_path, bad)


def test_what_is_not_whole_is_said_and_the_rest_is_read(tmp_path: Path) -> None:
    path = tmp_path / "arm.mcap"
    with path.open("wb") as file:
        writer, ends = SegmentWriter(file, ModuleRecord(name="arm"), compress=False), []
        for number in range(3):
            writer.write(SCAN, START + number * SECOND, START + number * SECOND, text(f"{number}" * 40))
            writer.flush()
            ends.append(file.tell())
        writer.finish()
    data = path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: ends[1]])
    path.write_bytes(data.replace(b"1" * 40, b"1" * 39 + b"7"))
    whole, result = merged(tmp_path, path)
    assert [data[0] for *_, data in lines(whole)] == ["0", "2"]
    assert "arm.mcap: 1 parts cannot be read" in "".join(result.damaged.values())
    assert "1 parts cannot be read" in " ".join(notes_of(whole))
    short, result = merged(tmp_path, tmp_path / "cut.mcap", name="short.mcap")
    assert [data[0] for *_, data in lines(short)] == ["0", "1"]
    assert "cut.mcap: its end is missing" in "".join(result.damaged.values())


def test_a_bag_has_the_same_messages(tmp_path: Path, recording: Record) -> None:
    arm = recording("arm", {SCAN: [(1.0, "a"), (2.0, "b")], source("/map", "/m", latching=True): [(0.5, "map")]})
    bag = tmp_path / "arm.bag"
    assert write_bag(SegmentReader(arm).messages(), bag) == 3
    with Reader(bag) as others:
        assert {one.ext.callerid for one in others.connections} == {"/rmpa/arm/m", "/rmpa/arm/laser"}  # type: ignore[union-attr] # of a bag of ROS 1
    assert list(read_any(bag)) == list(read_any(arm))
    with pytest.raises(RmpaError, match="exists"):
        write_bag([], bag)
