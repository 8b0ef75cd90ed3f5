"""The ring on the disk: bounded, kept by links, and whole after a crash or on a full disk."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rmpa.bridge.kept import Kept, find_kept, read_kept, remove_kept
from rmpa.core.errors import RmpaError
from rmpa.record import limits
from rmpa.record.format import SegmentReader, SegmentWriter
from rmpa.record.ring import RingThread
from tests.record.conftest import SECOND, START, source, text

ODOM = source("/odom")
Make = Callable[..., RingThread]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    """Makes rings of one folder; they end with the test."""
    made: list[RingThread] = []

    def one(begin: Callable[[SegmentWriter, int], None] = lambda _writer, _now: None, **bounds: Any) -> RingThread:
        given: dict[str, Any] = {"most_bytes": 10**9, "most_seconds": 3600.0, "fsync": None, "kept_bytes": 0}
        ring = RingThread(tmp_path, begin, **given | bounds)
        made.append(ring)
        ring.start()
        return ring

    yield one
    for ring in made:
        if ring.is_alive():
            ring.end()


def fill(ring: RingThread, first: int, count: int, size: int = 10) -> None:
    for number in range(first, first + count):
        assert ring.put(ODOM, START + number * SECOND, START + number * SECOND, text(f"{number}".ljust(size)))
    ring.call(ring._finish).result(20)


def said(folder: Path) -> list[int]:
    paths = sorted(folder.glob("*.mcap"))
    return [int(message.data[4:]) for path in paths for message in SegmentReader(path).messages()]


def test_the_oldest_segments_give_way(make: Make, tmp_path: Path) -> None:
    ring = make(most_seconds=25.0)
    for first in range(0, 60, 10):
        fill(ring, first, 10)
    assert said(tmp_path / "ring") == list(range(30, 60))
    ring.end()
    small = make(most_bytes=1)
    fill(small, 60, 10)
    assert said(tmp_path / "ring") == list(range(60, 70))


def test_what_is_kept_stays_when_the_ring_goes_on(make: Make, tmp_path: Path) -> None:
    ring = make(most_seconds=10.0)
    fill(ring, 0, 10)
    fill(ring, 10, 10)
    kept = Kept(id="fall", why="it fell", since=START + 12 * SECOND, until=START + 15 * SECOND)
    made = ring.call(ring.keep, kept).result(20)
    for first in range(20, 60, 10):
        fill(ring, first, 10)
    assert said(tmp_path / "kept/fall") == list(range(10, 20))
    assert made == find_kept(tmp_path / "kept", "fall")
    assert made.files
    assert made.size == sum(path.stat().st_size for path in (tmp_path / "kept/fall").glob("*.mcap"))
    late = Kept(id="late", since=START, until=START + SECOND)
    assert ring.call(ring.keep, late).result(20) is None, "nothing of that time is there"
    assert remove_kept(tmp_path / "kept", "fall").id == "fall"
    assert not list(read_kept(tmp_path / "kept"))


def test_recordings_that_no_person_asked_for_give_way(make: Make, tmp_path: Path) -> None:
    ring = make(kept_bytes=1)
    for number, hand in enumerate((True, False, False)):
        fill(ring, 10 * number, 10)
        at = START + 10 * number * SECOND
        ring.call(ring.keep, Kept(id=f"k{number}", since=at, until=at + 9 * SECOND, by_hand=hand)).result(20)
    assert [one.id for one in read_kept(tmp_path / "kept")] == ["k0", "k2"]


def test_each_segment_has_its_beginning(make: Make, tmp_path: Path) -> None:
    latched = source("/map", latching=True)
    ring = make(lambda writer, now: writer.write(latched, now, START, text("999")))
    fill(ring, 0, 2)
    fill(ring, 2, 2)
    assert sorted(said(tmp_path / "ring")) == [0, 1, 2, 3, 999, 999]


def test_a_run_that_was_killed_is_taken_over(make: Make, tmp_path: Path) -> None:
    folder = tmp_path / "ring"
    folder.mkdir()
    with (folder / "00000007.mcap.part").open("wb") as file:
        writer = SegmentWriter(file, None)
        writer.write(ODOM, START, START, text("1"))
        writer.flush()
    (folder / "00000008.mcap.part").write_bytes(b"")
    ring = make()
    fill(ring, 2, 1)
    assert said(folder) == [1, 2]
    assert not list(folder.glob("*.part"))


def test_a_full_disk_is_said_and_gets_over(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "RETRY", 0.05)
    full = [True]
    write = SegmentWriter.write

    def refused(self: SegmentWriter, *args: Any) -> None:
        if full[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(self, *args)

    monkeypatch.setattr(SegmentWriter, "write", refused)
    ring = make()
    ring.put(ODOM, START, START, text("1"))
    wait(lambda: "No space left" in ring.problem)
    assert ring.lost["/odom"] == 1
    full[0] = False

    def written() -> bool:
        ring.put(ODOM, START, START, text("2"))
        return not ring.problem

    wait(written)


def wait(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_what_the_disk_does_not_take_in_time_is_lost_and_counted(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "QUEUE_BYTES", 100)
    ring = make()
    assert not ring.put(ODOM, START, START, b"x" * 101)
    assert ring.lost == {"/odom": 1}


@pytest.mark.parametrize("name", ["", "../x", "a/b", ".hidden", "a\0b", "x" * 200])
def test_no_path_is_the_name_of_a_recording(tmp_path: Path, name: str) -> None:
    with pytest.raises(RmpaError, match="not the name of a recording"):
        remove_kept(tmp_path, name)
