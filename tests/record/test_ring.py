"""The ring on the disk: bounded, kept by links, and whole after a crash, a full disk, and a clock that is set."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from rmpa.bridge.kept import Kept, find_kept, read_kept, remove_kept
from rmpa.core.errors import RmpaError
from rmpa.record import limits
from rmpa.record.format import EVENTS, SegmentReader, SegmentWriter, read_event
from rmpa.record.merge import Timeline
from rmpa.record.ring import RingThread
from rmpa.record.story import tell
from tests.record.conftest import SECOND, HandClock, read_any, source, text

ODOM = source("/odom")
REPOSITORY = Path(__file__).parents[2]
HOUR = 3600.0
Make = Callable[..., "HandRing"]


class HandRing(RingThread):
    """A ring with a clock that is set by hand; its segments end where a test says so."""

    clock: HandClock

    def fill(self, first: int, count: int, size: int = 10, *, finish: bool = True) -> None:
        """Put numbered messages, one a second, and end the segment."""
        for number in range(first, first + count):
            self.clock.seconds = 1000.0 + number
            self.say(number, size)
        if finish:
            self.call(self._finish).result(20)

    def say(self, number: int, size: int = 10) -> None:
        at = self.clock.wall()
        assert self.put(ODOM, at, at, text(f"{number}".ljust(size)))

    def settle(self) -> None:
        """Wait until all is written."""
        self.call(lambda: None).result(20)

    def keep_from(self, name: str, since: float, until: float, /, **about: Any) -> Kept | None:
        """Keep the seconds from ... to ... of what ``fill`` has put."""
        kept = Kept(id=name, why="it fell", **about)
        made: Kept | None = self.call(self.keep, kept, 1000.0 + since, 1000.0 + until).result(20)
        return made


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Makes rings of one folder; they end with the test."""
    made: list[RingThread] = []
    monkeypatch.setattr(limits, "SEGMENT", 1e6)
    clock = HandClock()

    def one(begin: Callable[[SegmentWriter, int], None] = lambda _writer, _now: None, **bounds: Any) -> HandRing:
        given: dict[str, Any] = {"most_bytes": 10**9, "most_seconds": 3600.0, "fsync": None, "kept_bytes": 0}
        ring = HandRing(tmp_path, begin, **given | bounds, clock=clock.now, wall=clock.wall)
        ring.clock = clock
        made.append(ring)
        ring.start()
        return ring

    yield one
    for ring in made:
        if ring.is_alive():
            ring.end()


def said(folder: Path) -> list[int]:
    """The numbers in a folder, in the order of its files."""
    paths = sorted(folder.glob("*.mcap"))
    found = [message for path in paths for message in SegmentReader(path).messages()]
    return [int(message.data[4:]) for message in found if message.source.topic != EVENTS]


def wait(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_the_oldest_segments_give_way(make: Make, tmp_path: Path) -> None:
    ring = make(most_seconds=25.0)
    for first in range(0, 60, 10):
        ring.fill(first, 10)
    assert said(tmp_path / "ring") == list(range(30, 60))
    ring.end()
    small = make(most_bytes=1)
    small.fill(60, 10)
    assert said(tmp_path / "ring") == list(range(60, 70))


def test_what_is_kept_stays_when_the_ring_goes_on(make: Make, tmp_path: Path) -> None:
    ring = make(most_seconds=10.0)
    ring.fill(0, 10)
    ring.fill(10, 10)
    made = ring.keep_from("fall", 12, 15)
    for first in range(20, 60, 10):
        ring.fill(first, 10)
    assert said(tmp_path / "kept/fall") == list(range(10, 20))
    assert made is not None
    assert made == find_kept(tmp_path / "kept", "fall")
    assert made.size == sum(path.stat().st_size for path in (tmp_path / "kept/fall").glob("*.mcap"))
    assert ring.keep_from("late", 0, 1) is None, "nothing of that time is there"
    assert ring.keep_from("fall", 12, 15) == made, "asked again, it is there"
    assert remove_kept(tmp_path / "kept", "fall").id == "fall"
    assert not list(read_kept(tmp_path / "kept"))


def test_recordings_that_no_person_asked_for_give_way(make: Make, tmp_path: Path) -> None:
    ring = make(kept_bytes=1)
    for number, hand in enumerate((True, False, False)):
        ring.fill(10 * number, 10)
        # The clock is set back each time: the oldest is not the one with the earliest time.
        ring.keep_from(f"k{number}", 10 * number, 10 * number + 9, by_hand=hand, since=-number)
    assert [one.id for one in read_kept(tmp_path / "kept")] == ["k0", "k2"]


def test_each_segment_has_its_beginning(make: Make, tmp_path: Path) -> None:
    latched = source("/map", latching=True)
    ring = make(lambda writer, now: writer.write(latched, now, 1, text("999")))
    ring.fill(0, 2)
    ring.fill(2, 2)
    assert sorted(said(tmp_path / "ring")) == [0, 1, 2, 3, 999, 999]


def test_a_run_that_was_killed_is_taken_over(make: Make, tmp_path: Path) -> None:
    folder = tmp_path / "ring"
    folder.mkdir()
    (folder / "00000006.mcap").write_bytes(b"a file that a bad disk has damaged")
    with (folder / "00000007.mcap.part").open("wb") as file:
        writer = SegmentWriter(file, None)
        writer.attachment("parameters.json", "application/json", b"{}", 1)
        writer.write(ODOM, 1, 1, text("1"))
        writer.flush()
    (folder / "00000008.mcap.part").write_bytes(b"")
    (folder / "notes.mcap").write_bytes(b"of a person")
    half = tmp_path / "kept/half"
    half.mkdir(parents=True)
    ring = make()
    ring.fill(2, 1)
    assert [one.path.name for one in ring.segments] == ["00000006.mcap", "00000007.mcap", "00000009.mcap"]
    (folder / "00000006.mcap").unlink()
    (folder / "notes.mcap").unlink()
    assert said(folder) == [1, 2]
    with (folder / "00000007.mcap").open("rb") as file:
        began = [one.data for one in make_reader(file).iter_attachments()]
    assert began == [b"{}"], "what it began with is still there"
    assert not half.exists(), "a recording that was not made to its end takes no room"


@pytest.mark.parametrize(("age", "there"), [(50.0, True), (-2 * HOUR, True), (2 * HOUR, False)])
def test_segments_of_an_earlier_run_are_as_old_as_their_files(
    make: Make, tmp_path: Path, age: float, there: bool
) -> None:
    ring = make()
    ring.fill(0, 2)
    ring.end()
    path = ring.segments[0].path
    os.utime(path, (0, ring.clock.wall() / SECOND - age))  # of a clock that was set back since: not older than now
    again = make(most_seconds=HOUR)
    again.fill(100, 2)
    assert (0 in said(tmp_path / "ring")) is there


def fails(error: Exception, times: int = 1) -> Callable[..., None]:
    """In the place of ``SegmentWriter.write``: it fails so often, and then writes."""
    write, left = SegmentWriter.write, [times]

    def refused(self: SegmentWriter, *args: Any) -> None:
        if left[0]:
            left[0] -= 1
            raise error
        write(self, *args)

    return refused


@pytest.mark.parametrize(("number", "rest"), [(errno.ENOSPC, 2), (errno.EDQUOT, 2), (errno.EROFS, 4), (errno.EIO, 4)])
def test_only_a_full_disk_makes_old_segments_give_way(
    make: Make, monkeypatch: pytest.MonkeyPatch, number: int, rest: int
) -> None:
    ring = make()
    for first in range(4):
        ring.fill(first, 1)
    monkeypatch.setattr(SegmentWriter, "write", fails(OSError(number, os.strerror(number))))
    ring.say(4)
    ring.settle()
    assert len(ring.segments) == rest
    assert os.strerror(number) in ring.problem
    assert ring.lost == {"/odom": 1}
    ring.fill(4 + round(limits.RETRY), 1)
    assert (ring.problem, ring.lost["/odom"]) == ("", 1)


def test_a_disk_that_fails_costs_only_what_it_did_not_take(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ring = make()
    ring.fill(0, 1)
    ring.fill(1, 3, finish=False)
    ring.settle()
    ring.clock.seconds += limits.FLUSH
    ring.call(ring._tend, ring.clock.seconds).result(20)
    ring.say(4)  # in memory when the disk fails
    ring.settle()
    monkeypatch.setattr(SegmentWriter, "write", fails(OSError(errno.EIO, "bad")))
    ring.say(5)
    ring.settle()
    assert said(tmp_path / "ring") == [0, 1, 2, 3]
    assert ring.lost == {"/odom": 2}
    assert len(ring.segments) == 2


@pytest.mark.parametrize("bad", ["name", "time", "codec"])
def test_a_bad_message_costs_no_other_one(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad: str
) -> None:
    ring = make()
    ring.fill(0, 1)
    ring.fill(1, 2, finish=False)
    ring.settle()
    at = ring.clock.wall()
    if bad == "name":
        ring.put(source("/odom", "/n\udcffde"), at, at, text("0"))
    elif bad == "time":
        ring.put(ODOM, -at, at, text("0"))
    else:
        monkeypatch.setattr(SegmentWriter, "write", fails(RuntimeError("no codec")))
        ring.say(0)
    ring.say(3)
    ring.settle()
    assert ring.lost == {"/odom": 1}
    assert not ring.problem
    ring.call(ring._finish).result(20)
    assert said(tmp_path / "ring") == [0, 1, 2, 3]
    assert len(ring.segments) == 2, "its segment goes on"


def test_a_definition_has_any_bytes(make: Make, tmp_path: Path) -> None:
    """Comments of definitions are of all encodings."""
    ring, definition = make(), ODOM.definition + "# 90\udcb0\n"
    ring.put(ODOM._replace(definition=definition), 1, 1, text("0"))
    ring.call(ring._finish).result(20)
    assert [m.source.definition for m in read_any(tmp_path / "ring")] == [definition]
    assert not ring.lost


def test_a_segment_that_cannot_begin_well_is_written_all_the_same(make: Make, tmp_path: Path) -> None:
    def begin(_writer: SegmentWriter, _now: int) -> None:
        raise RuntimeError("a bad latched message")

    ring = make(begin)
    ring.fill(0, 2)
    assert said(tmp_path / "ring") == [0, 1]


def test_who_asked_may_be_gone(make: Make) -> None:
    """A call that was cancelled does not end the thread."""
    ring = make()
    with ring._lock:
        future = ring.call(lambda: None)
        future.cancel()
    ring.fill(0, 1)
    assert ring.is_alive()


def test_what_is_not_kept_leaves_nothing_and_a_full_disk_makes_room_for_it(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ring, link, errors = make(), os.link, [errno.EIO, errno.ENOSPC]

    def refused(*args: Any) -> None:
        if errors:
            raise OSError(errors.pop(0), "no link")
        link(*args)

    for first in range(4):
        ring.fill(first, 1)
    monkeypatch.setattr(os, "link", refused)
    with pytest.raises(OSError, match="no link"):
        ring.keep_from("fall", 3, 3)
    assert not list((tmp_path / "kept").iterdir())
    assert len(ring.segments) == 4
    assert ring.keep_from("fall", 3, 3) is not None
    assert len(ring.segments) == 2


@pytest.mark.parametrize("step", [HOUR, -HOUR])
def test_a_clock_that_is_set_changes_neither_what_is_there_nor_what_is_kept(
    make: Make, tmp_path: Path, step: float
) -> None:
    ring = make(most_seconds=60.0)
    ring.fill(0, 20)
    ring.fill(20, 10, finish=False)
    ring.settle()
    ring.clock.epoch += round(step * SECOND)
    ring.fill(30, 20)
    assert said(tmp_path / "ring") == list(range(50)), "nothing gives way"
    assert ring.keep_from("step", 22, 40) is not None
    assert said(tmp_path / "kept/step") == list(range(20, 50)), "from before it, too"
    ring.fill(85, 1)
    assert said(tmp_path / "ring") == [*range(20, 50), 85], "what is old gives way"

    way = "forward" if step > 0 else "back"
    told = tell(read_any(tmp_path / "kept/step"), "step")
    assert [(one.kind, one.text) for one in told.lines] == [("clock_step", f"the clock was set 3600.000 s {way}")]
    assert (told.end - told.begin) / SECOND == pytest.approx(29.0)
    numbers = [m.data[4:].strip() for m in read_any(tmp_path / "kept/step") if m.source.topic != EVENTS]
    assert numbers == [f"{number}".encode() for number in range(20, 50)], "in the order in which they came"
    whole, result = tmp_path / "whole.mcap", Timeline([tmp_path / "kept/step"])
    with whole.open("wb") as file:
        result.write(file)
    assert f"set 3600.000 s {way} while it recorded" in " ".join(result.notes)
    assert Timeline([whole]).notes == result.notes
    times = [m.log_time for m in read_any(whole)]
    assert times == sorted(times)
    events = [read_event(m.data) for m in read_any(whole) if m.source.topic == EVENTS]
    assert [one.facts for one in events if one is not None] == [{"seconds": step}]


def test_messages_of_both_sides_of_a_step_are_in_their_segments(make: Make) -> None:
    ring = make()
    ring.fill(0, 1, finish=False)
    ring.settle()
    with ring._lock:  # so that the thread takes all at once
        for number in range(1, 6):
            if number == 3:
                ring.clock.epoch += round(HOUR * SECOND)
            ring.say(number)
    ring.call(ring._finish).result(20)
    assert [len(list(SegmentReader(one.path).messages())) for one in ring.segments] == [3, 4]  # and the event


def test_what_the_disk_does_not_take_in_time_is_lost_and_counted(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "QUEUE_BYTES", 100)
    ring = make()
    assert not ring.put(ODOM, 1, 1, b"x" * 101)
    assert ring.lost == {"/odom": 1}


def process(*words: str, prefix: tuple[str, ...] = ()) -> None:
    """Run ``ring_process.py`` to its good end."""
    command = [*prefix, sys.executable, "-m", "tests.record.ring_process", *words]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=1200)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("rounds", [5, pytest.param(200, marks=[pytest.mark.long, pytest.mark.timeout(1300)])])
def test_a_recorder_that_is_killed_at_any_moment_has_lost_less_than_a_second(tmp_path: Path, rounds: int) -> None:
    process("kill", str(tmp_path), str(rounds), str(rounds))


@pytest.mark.parametrize("what", ["full", "read_only"])
def test_a_disk_that_takes_nothing_for_a_while(tmp_path: Path, what: str) -> None:
    own = ("unshare", "--mount")
    if shutil.which("unshare") is None or subprocess.run([*own, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no mount namespaces here: they need root")
    process(what, str(tmp_path / "disk"), prefix=own)


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "a\0b", "x" * 200])
def test_no_path_is_the_name_of_a_recording(tmp_path: Path, name: str) -> None:
    with pytest.raises(RmpaError, match="not the name of a recording"):
        remove_kept(tmp_path, name)
