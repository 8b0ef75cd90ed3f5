"""A ring in a process that is killed, or on a disk that is full or read-only: ``ring_process.py WHAT FOLDER [...]``.

It ends with 0 if all was as it should be, else with a traceback.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from mcap.reader import make_reader

from rmpa.record import limits
from rmpa.record.format import RecordedSource, SegmentReader
from rmpa.record.ring import RingThread
from tests.record.conftest import source

ODOM: Final = source("/odom")
_NUMBER: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<d")
# The most messages of one run, and the longest run before a kill, seconds.
_MOST: Final = 1 << 18
_LONGEST: Final = 1.6


def numbered(number: int) -> bytes:
    """A message that can be checked: its number, and bytes that follow from it."""
    return _NUMBER.pack(number) + random.Random(number).randbytes(100 + 37 * number % 3000)


def ring_in(folder: Path, **bounds: Any) -> RingThread:
    given: dict[str, Any] = {"most_bytes": 10**9, "most_seconds": 3600.0, "fsync": None, "kept_bytes": 0}
    ring = RingThread(folder, lambda _writer, _now: None, **given | bounds)
    ring.start()
    return ring


def put(ring: RingThread, number: int, what: RecordedSource = ODOM) -> bool:
    now = time.time_ns()
    return ring.put(what, now, now, numbered(number))


def numbers(folder: Path) -> list[int]:
    """The numbers in all segments, each with the right bytes; by our reader and by the library's, which agree."""
    found: list[int] = []
    for path in sorted((folder / "ring").glob("*.mcap")):
        own = [message.data for message in SegmentReader(path).messages() if message.source.topic == ODOM.topic]
        with path.open("rb") as file:
            theirs = [message.data for _, channel, message in make_reader(file).iter_messages([ODOM.topic])]
        assert own == theirs, path
        found += [_NUMBER.unpack_from(data)[0] for data in own]
        assert all(data == numbered(_NUMBER.unpack_from(data)[0]) for data in own), path
    return found


def until(holds: Callable[[], bool], what: str, seconds: float = 30.0) -> None:
    deadline = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < deadline, what
        time.sleep(0.005)


def kill(folder: Path, rounds: int, seed: int) -> None:
    """Kill a process at random moments while it writes; then nothing is missing that was put a second before."""
    limits.SEGMENT = 0.4  # type: ignore[misc] # so that kills meet ends of segments, too
    chance, times = random.Random(seed), mmap.mmap(-1, _TIME.size * _MOST)
    for turn in range(rounds):
        place, moment = folder / str(turn), chance.uniform(0.0, _LONGEST)
        times.seek(0)
        times.write(bytes(_TIME.size * _MOST))
        if (child := os.fork()) == 0:
            ring = ring_in(place, fsync=chance.choice((None, 0.0, 0.2)))
            for number in range(_MOST):
                put(ring, number)
                _TIME.pack_into(times, _TIME.size * number, time.monotonic())
                time.sleep(0.0005)
            os._exit(1)
        until(lambda: times[0:8] != bytes(8), "the first message")
        time.sleep(moment)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        killed = time.monotonic()
        ring_in(place).end()
        found = numbers(place)
        assert not list((place / "ring").glob("*.part")), turn
        assert found == list(range(len(found))), f"round {turn}, after {moment:.3f} s: a gap"
        at = [one for (one,) in _TIME.iter_unpack(times) if one]
        safe = sum(one <= killed - 1.0 for one in at)
        assert len(found) >= safe, f"round {turn}, after {moment:.3f} s: {len(found)} of {safe}, {len(at)} put"
        shutil.rmtree(place)
    print(f"{rounds} kills, seed {seed}")


def full(folder: Path) -> None:
    """A disk of 3 MB: the ring fills it, then something else does, and then that is gone."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", folder], check=True)
    limits.RETRY, limits.SEGMENT = 0.1, 0.1  # type: ignore[misc]
    ring, number = ring_in(folder), 0

    def putting(enough: Callable[[], bool], what: str) -> None:
        def one() -> bool:
            nonlocal number
            for _ in range(20):
                number += put(ring, number)
            return enough()

        until(one, what)

    putting(lambda: "No space left on device" in ring.problem, "a full disk")
    first = number
    putting(lambda: max(ring.call(numbers, folder).result(20), default=0) > first, "old segments gave way")
    other = folder / "other"
    with other.open("wb", buffering=0) as file:
        putting(lambda: fill(file) and len(ring.segments) == 1 and bool(ring.problem), "no room at all")
    lost = ring.lost[ODOM.topic]
    putting(lambda: ring.lost[ODOM.topic] > lost, "what is not written is counted")
    other.unlink()
    last = number
    putting(lambda: not ring.problem, "room again")
    putting(lambda: number > last + 200, "more")
    ring.end()
    found = numbers(folder)
    assert found == sorted(set(found))
    assert found[-1] == number - 1
    assert number - found[0] - len(found) <= ring.lost[ODOM.topic], "what is missing was counted"
    left = {path.name: path.stat().st_size for path in (folder / "ring").iterdir() if path.suffix != ".mcap"}
    assert not left, (left, ring.problem, os.statvfs(folder))


def fill(file: Any) -> bool:
    """Take all room that there is."""
    with contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))
    return True


def read_only(folder: Path) -> None:
    """A disk that is read-only for a while: what is there stays, and it goes on by itself."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", folder], check=True)
    limits.RETRY = 0.1  # type: ignore[misc]
    ring = ring_in(folder)
    for number in range(400):
        put(ring, number)
        if number % 100 == 99:
            ring.call(ring._finish).result(20)
    before = [one.path for one in ring.segments]

    def remount(how: str) -> None:
        ring._finish()  # while a file is open for writing it cannot be
        subprocess.run(["mount", "-o", f"remount,{how}", folder], check=True)

    ring.call(remount, "ro").result(20)
    number = 400

    def another() -> bool:
        nonlocal number
        number += put(ring, number)
        return "Read-only file system" in ring.problem and ring.lost[ODOM.topic] > 0

    until(another, "a read-only disk")
    assert [one.path for one in ring.segments] == before
    assert numbers(folder) == list(range(400)), "what is there stays"
    subprocess.run(["mount", "-o", "remount,rw", folder], check=True)

    def written() -> bool:
        nonlocal number
        number += put(ring, number)
        return not ring.problem

    until(written, "it writes again")
    ring.end()
    found = numbers(folder)
    assert (found[:400], found[-1]) == (list(range(400)), number - 1)
    assert number - len(found) == ring.lost[ODOM.topic]


if __name__ == "__main__":
    what, place = sys.argv[1], Path(sys.argv[2])
    if what == "kill":
        kill(place, int(sys.argv[3]), int(sys.argv[4]))
    else:
        {"full": full, "read_only": read_only}[what](place)
