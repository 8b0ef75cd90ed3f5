"""The disk's side of the recorder: a thread that writes segments, keeps the last minutes, and links what is kept.

Finished segments of the ring are ``ring/NUMBER.mcap``, at most so many bytes and seconds of them. A recording that is
kept is a folder of hard links to segments, ``kept/ID/NUMBER.mcap``, with ``recording.json`` (``bridge.kept``):
keeping copies nothing, and the ring goes on. A full or read-only disk drops messages and says so, until it is usable
again; nothing of it reaches the event loop.

What the ring holds and what is kept is decided by the monotonic clock, because the wall clock of a robot is set at
any time, by hours at boot. A segment ends where the wall clock was set, so that the times in it are of one clock.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import logging
import os
import shutil
import threading
import time
from collections import Counter, deque
from concurrent.futures import Future
from itertools import islice, pairwise
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

from rmpa.bridge.kept import ABOUT, KEPT, Kept, find_kept, write_kept
from rmpa.record import limits
from rmpa.record.format import (
    EVENT_SOURCE,
    SUFFIX,
    TIME,
    UNFINISHED,
    DamagedError,
    Event,
    RecordedSource,
    SegmentReader,
    SegmentWriter,
    event_bytes,
    finish_file,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence

_log = logging.getLogger(__name__)
_SECOND: Final = 1_000_000_000
# Options of mallopt(3), and the largest value of the second that it takes.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_MMAP_MAX: Final = 32 * 1024 * 1024


_BOOT: Final = Path("/proc/sys/kernel/random/boot_id")
_Queued = tuple[RecordedSource, int, int, bytes]


class SegmentInfo:
    """A finished segment of the ring: its file, and when it began and ended, in seconds of the ring's clock."""

    __slots__ = ("began", "ended", "path", "size")

    def __init__(self, path: Path, began: float, ended: float) -> None:
        self.path = path
        self.began = began
        self.ended = ended
        self.size = path.stat().st_size


def _keep_memory() -> None:
    """Let the C library keep what is freed.

    Each image takes some megabytes for a moment. To get them from the kernel anew, page by page, was nearly half of
    what recording 30 MB/s of images cost.
    """
    with contextlib.suppress(OSError, AttributeError):  # another C library than glibc
        library = ctypes.CDLL(None)
        for option, most in ((_M_TRIM_THRESHOLD, limits.QUEUE_BYTES), (_M_MMAP_THRESHOLD, _MMAP_MAX)):
            library.mallopt(option, most)


class RingThread(threading.Thread):
    """Writes what the recorder takes. All methods but ``run`` may be called in any thread.

    Args:
        folder: The recorder's folder, with ``ring`` and ``kept`` in it.
        begin: Writes the beginning of a segment.
        most_bytes: Of the ring.
        most_seconds: Of the ring.
        fsync: Seconds between two calls of fsync; 0: at the end of each segment; ``None``: never.
        kept_bytes: Of all that is kept; the oldest recordings that were kept by themselves give way.
        clock: Monotonic seconds.
        wall: Unix nanoseconds.
    """

    def __init__(
        self,
        folder: Path,
        begin: Callable[[SegmentWriter, int], None],
        *,
        most_bytes: int,
        most_seconds: float,
        fsync: float | None,
        kept_bytes: int,
        clock: Callable[[], float] = time.monotonic,
        wall: Callable[[], int] = time.time_ns,
    ) -> None:
        super().__init__(name="recorder", daemon=True)
        self._folder, self._ring = folder, folder / "ring"
        self._begin = begin
        self._most_bytes, self._most_seconds = most_bytes, most_seconds
        self._fsync = fsync
        self._kept_bytes = kept_bytes
        self._clock, self._wall = clock, wall
        self._lock = threading.Condition()
        self._waiting: deque[_Queued] = deque()
        self._waiting_bytes = 0
        self._jobs: deque[tuple[Callable[..., Any], tuple[Any, ...], Future[Any]]] = deque()
        self._ended = False
        # Messages that were not written, by topic: too much waited, or the disk was full.
        self.lost: Counter[str] = Counter()
        # Why nothing can be written at present; empty: all is well.
        self.problem = ""
        # Bytes written to the disk so far.
        self.written = 0
        self.segments: list[SegmentInfo] = []
        # Of the last file; below 0: what an earlier run left is not taken over yet.
        self._number = -1
        self._file: IO[bytes] | None = None
        self._writer: SegmentWriter | None = None
        # Messages of the segment, by topic: what of them a disk has not taken is lost.
        self._count: Counter[str] = Counter()
        # What is being written was put after this time.
        self._after = clock()
        self._epoch = wall() - round(self._after * _SECOND)
        self._began = self._flushed = self._synced = 0.0
        self._retry = float("-inf")

    def put(self, source: RecordedSource, log_time: int, publish_time: int, data: bytes) -> bool:
        """Queue a message; false: too much waits, and it is lost."""
        with self._lock:
            if self._waiting_bytes + len(data) > limits.QUEUE_BYTES:
                self.lost[source.topic] += 1
                return False
            self._waiting.append((source, log_time, publish_time, data))
            self._waiting_bytes += len(data)
            if self._waiting_bytes > limits.CHUNK:
                self._lock.notify()  # before, the thread looks by itself: waking it costs more than writing
            return True

    def call(self, function: Callable[..., Any], *args: Any) -> Future[Any]:
        """Call a function in the thread, behind what is queued; the result comes by the future."""
        future: Future[Any] = Future()
        with self._lock:
            self._jobs.append((function, args, future))
            self._lock.notify()
        return future

    def end(self) -> None:
        """Write the rest, finish the segment and end."""
        with self._lock:
            self._ended = True
            self._lock.notify()
        self.join()

    def run(self) -> None:
        """Write until ``end``."""
        _keep_memory()
        self._take_over()
        while True:
            with self._lock:
                if not (self._jobs or self._ended or self._waiting_bytes > limits.CHUNK):
                    self._lock.wait(limits.FLUSH / 2)
                batch, self._waiting = self._waiting, deque()
                jobs, self._jobs = self._jobs, deque()
                self._waiting_bytes, ended, now = 0, self._ended, self._clock()
            self._write_all(batch)
            self._after = now
            for function, args, future in jobs:
                if not future.set_running_or_notify_cancel():
                    continue
                try:
                    future.set_result(function(*args))
                except Exception as error:  # noqa: BLE001 - the caller gets it
                    future.set_exception(error)
            self._tend(self._clock())
            if ended and not batch:
                self._finish()
                return

    def keep(self, kept: Kept, since: float, until: float) -> Kept | None:
        """Keep the segments of a time, in seconds of the ring's clock; called in the thread.

        Returns:
            What is kept, also if it was before; ``None``: the ring has nothing of that time any more.

        Raises:
            OSError: It cannot be written.
        """
        place = self._folder / KEPT
        folder = place / kept.id
        if (folder / ABOUT).exists():
            return find_kept(place, kept.id)
        self._finish()
        wanted = [one for one in self.segments if one.ended >= since and one.began <= until]
        if not wanted:
            return None
        for last in (False, True):
            try:
                folder.mkdir(parents=True, exist_ok=True)
                for one in wanted:
                    os.link(one.path, folder / one.path.name)
                return write_kept(folder, kept, limit=self._kept_bytes)
            except OSError as error:
                shutil.rmtree(folder, ignore_errors=True)  # nothing would find it, and its segments would stay
                if last or not _is_full(error):
                    raise
                self._make_room(wanted)
        return None

    def _take_over(self) -> None:
        """Finish the segment of a run that crashed, and count those that are there."""
        try:
            self._ring.mkdir(parents=True, exist_ok=True)
            names = [path.name.partition(".")[0] for path in self._ring.iterdir()]
            self._mend()
            for about in (self._folder / KEPT).glob("*"):
                if not (about / ABOUT).exists():  # the crash came while it was made
                    shutil.rmtree(about, ignore_errors=True)
            self.segments = [self._found(path) for path in sorted(self._ring.glob(f"[0-9]*{SUFFIX}"))]
            self._number = max((int(name) for name in names if name.isdecimal()), default=0)
        except OSError as error:
            self._fail(error)
        for newer, older in pairwise(reversed(self.segments)):
            older.ended = min(older.ended, newer.ended)

    def _found(self, path: Path) -> SegmentInfo:
        """A segment of an earlier run: its age is by the wall clock, and none if that was set back since."""
        ended = self._clock() - max(0.0, self._wall() / _SECOND - path.stat().st_mtime)
        return SegmentInfo(path, ended - limits.SEGMENT, ended)

    def _mend(self) -> list[SegmentInfo]:
        """Finish the files that a crash or a disk has left unfinished; those that it cannot are left for later."""
        done = []
        for path in sorted(self._ring.glob(f"*{SUFFIX}{UNFINISHED}")):
            try:
                done.append(self._found(finish_file(path)))
            except DamagedError as error:
                if not isinstance(error.__cause__, OSError):
                    with contextlib.suppress(OSError):
                        path.unlink(missing_ok=True)  # it ends before its first message
            except OSError as error:
                _log.debug("! %s is not finished yet: %s", path, error)
        return done

    def _write_all(self, batch: Collection[_Queued]) -> None:
        """Write messages; where the wall clock was set between two of them, a new segment begins."""
        began, now, read = self._clock(), self._wall(), self._clock()
        epoch = now - round(read * _SECOND)
        step = epoch - self._epoch
        if read - began > limits.CLOCK_STEP / 2 or abs(step) < limits.CLOCK_STEP * _SECOND:
            if read - began <= limits.CLOCK_STEP / 2:  # else this thread had no turn between both: it tells nothing
                self._epoch = epoch
            for message in batch:
                self._write(message)
            return
        after = next((n for n, one in enumerate(batch) if abs(one[1] - now) <= abs(one[1] + step - now)), len(batch))
        for message in islice(batch, after):
            self._write(message)
        self._finish()
        self._epoch = epoch
        seconds = step / _SECOND
        text = f"the clock was set {abs(seconds):.3f} s {'forward' if step > 0 else 'back'}"
        _log.info("= %s", text)
        event = Event("clock_step", text, facts={"seconds": seconds})
        self._write((EVENT_SOURCE, now, now, event_bytes(event)))
        for message in islice(batch, after, None):
            self._write(message)

    def _write(self, message: _Queued) -> None:
        topic = message[0].topic
        if self._writer is None and not self._open(self._clock()):
            self._lose({topic: 1})
            return
        try:
            assert self._writer is not None  # noqa: S101 - it is open
            self._writer.write(*message)
            self._count[topic] += 1
        except OSError as error:
            self._lose({topic: 1})
            self._fail(error)
        except Exception as error:  # noqa: BLE001 - no message may end the recorder, nor cost another one
            if not self.lost[topic]:
                _log.warning("! a message of %s is not recorded: %s [recording-stopped]", topic, error)
            self._lose({topic: 1})

    def _lose(self, topics: Mapping[str, int]) -> None:
        with self._lock:
            self.lost.update(topics)

    def _open(self, now: float) -> bool:
        if now < self._retry:
            return False
        if self._number < 0:
            self._take_over()
            if self._number < 0:
                return False
        elif self.problem:
            self._add(*self._mend())
        self._number += 1
        self._count.clear()
        try:
            self._file = (self._ring / f"{self._number:08}{SUFFIX}{UNFINISHED}").open("wb")
            self._writer = SegmentWriter(self._file, None)
            self._writer.metadata(TIME, {"boot": _boot(), "epoch": str(self._epoch)})
            try:
                self._begin(self._writer, self._wall())
            except OSError:
                raise
            except Exception:  # noqa: BLE001 - the rest of the segment is worth as much
                _log.exception("! the beginning of a segment is not whole [recording-stopped]")
            self._writer.flush()
        except Exception as error:  # noqa: BLE001 - the next one has another chance
            self._fail(error)
            return False
        self._began, self._flushed, self._synced = self._after, now, now
        if self.problem:
            _log.info("= the recorder writes again: %s", self.problem)
            self.problem = ""
        return True

    def _tend(self, now: float) -> None:
        """Flush, sync, and end a segment that is long enough."""
        if self._writer is None or self._file is None:
            return
        try:
            if now - self._flushed >= limits.FLUSH:
                self._writer.flush()
                self._flushed = now
            if self._fsync and now - self._synced >= self._fsync:
                os.fsync(self._file.fileno())
                self._synced = now
        except Exception as error:  # noqa: BLE001 - the next segment has another chance
            self._fail(error)
            return
        if now - self._began >= limits.SEGMENT or self._file.tell() * 8 > self._most_bytes:
            self._finish()

    def _finish(self) -> None:
        """End the segment, and drop what the ring has no room for."""
        writer, file = self._writer, self._file
        if writer is None or file is None:
            return
        path = Path(file.name)
        done = path.with_name(path.name.removesuffix(UNFINISHED))
        try:
            writer.finish()
            file.flush()
            if self._fsync is not None:
                os.fsync(file.fileno())
            file.close()
            path.rename(done)
            one = SegmentInfo(done, self._began, self._clock())
        except Exception as error:  # noqa: BLE001 - the next segment has another chance
            self._fail(error)
            return
        self._writer = self._file = None
        self.written += one.size
        self._add(one)

    def _add(self, *segments: SegmentInfo) -> None:
        """Take segments into the ring, and drop the oldest ones above the bounds; the newest one stays."""
        self.segments = sorted([*self.segments, *segments], key=lambda each: each.path.name)
        total, newest = sum(each.size for each in self.segments), max((each.ended for each in segments), default=0.0)
        while len(self.segments) > 1:
            oldest = self.segments[0]
            if total <= self._most_bytes and newest - oldest.ended <= self._most_seconds:
                break
            total -= oldest.size
            self._drop(oldest)

    def _drop(self, one: SegmentInfo) -> None:
        with contextlib.suppress(OSError):  # a disk that is read-only now keeps it
            one.path.unlink(missing_ok=True)
        self.segments.remove(one)

    def _make_room(self, wanted: Sequence[SegmentInfo] = ()) -> None:
        """The disk is full: the older half of the ring gives way."""
        for one in self.segments[: len(self.segments) // 2]:
            if one not in wanted:
                self._drop(one)

    def _fail(self, error: Exception) -> None:
        """The disk does not take it: give up the segment, save what of it is written, and try again later."""
        text = f"{self._ring}: {getattr(error, 'strerror', None) or error}"
        if text != self.problem:
            _log.warning("! the recorder cannot write: %s; it tries again [recording-stopped]", text)
        self.problem = text
        self._retry = self._clock() + limits.RETRY
        if _is_full(error):
            self._make_room()
        file, self._writer, self._file = self._file, None, None
        if file is not None:
            with contextlib.suppress(OSError):  # what is in memory is lost
                file.close()
            with contextlib.suppress(DamagedError):
                self._count -= Counter(one.source.topic for one in SegmentReader(Path(file.name)).messages())
            self._lose(self._count)
            self._add(*self._mend())


def _is_full(error: Exception) -> bool:
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


def _boot() -> str:
    """The machine's run, in which the monotonic clock goes on; empty where it is not known."""
    with contextlib.suppress(OSError):
        return _BOOT.read_text().strip()
    return ""
