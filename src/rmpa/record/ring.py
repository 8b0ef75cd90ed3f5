"""The disk's side of the recorder: a thread that writes segments, keeps the last minutes, and links what is kept.

Finished segments of the ring are ``ring/NUMBER.mcap``, at most so many bytes and seconds of them. A recording that is
kept is a folder of hard links to segments, ``kept/ID/NUMBER.mcap``, with ``recording.json`` (``bridge.kept``):
keeping copies nothing, and the ring goes on. A full or read-only disk drops messages and says so, until it is usable
again; nothing of it reaches the event loop.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import threading
import time
from collections import Counter, deque
from concurrent.futures import Future
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

from rmpa.bridge.kept import Kept, write_kept
from rmpa.record import limits
from rmpa.record.format import (
    SUFFIX,
    UNFINISHED,
    DamagedError,
    RecordedSource,
    SegmentReader,
    SegmentWriter,
    finish_file,
)

if TYPE_CHECKING:
    from collections.abc import Callable

_log = logging.getLogger(__name__)
_SECOND: Final = 1_000_000_000
# Options of mallopt(3), and the largest value of the second that it takes.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
_MMAP_MAX: Final = 32 * 1024 * 1024


class SegmentInfo:
    """A finished segment of the ring: its file, and the log times of its first and last message."""

    __slots__ = ("first", "last", "path", "size")

    def __init__(self, path: Path, first: int, last: int) -> None:
        self.path = path
        self.first = first
        self.last = last
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
    ) -> None:
        super().__init__(name="recorder", daemon=True)
        self._folder, self._ring = folder, folder / "ring"
        self._begin = begin
        self._most_bytes, self._most_ns = most_bytes, most_seconds * _SECOND  # infinite: all
        self._fsync = fsync
        self._kept_bytes = kept_bytes
        self._lock = threading.Condition()
        self._waiting: deque[tuple[RecordedSource, int, int, bytes]] = deque()
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
        self._number = 0
        self._file: IO[bytes] | None = None
        self._writer: SegmentWriter | None = None
        self._began = self._flushed = self._synced = self._retry = 0.0

    def put(self, source: RecordedSource, log_time: int, publish_time: int, data: bytes) -> bool:
        """Queue a message; false: too much waits, and it is lost."""
        with self._lock:
            if self._waiting_bytes + len(data) > limits.QUEUE_BYTES:
                self.lost[source.topic] += 1
                return False
            self._waiting.append((source, log_time, publish_time, data))
            self._waiting_bytes += len(data)
            if (
                self._waiting_bytes > limits.CHUNK
            ):  # else the thread looks by itself: waking it costs more than writing
                self._lock.notify()
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
                self._waiting_bytes, ended = 0, self._ended
            for message in batch:
                self._write(message)
            for function, args, future in jobs:
                try:
                    future.set_result(function(*args))
                except Exception as error:  # noqa: BLE001 - the caller gets it
                    future.set_exception(error)
            self._tend(time.monotonic())
            if ended and not batch:
                self._finish()
                return

    def keep(self, kept: Kept) -> Kept | None:
        """Keep the segments from ``kept.since`` to ``kept.until``; called in the thread.

        Returns:
            What is kept; ``None``: the ring has nothing of that time any more, or it is kept already.

        Raises:
            OSError: It cannot be written.
        """
        self._finish()
        wanted = [one for one in self.segments if one.last >= kept.since and one.first <= kept.until]
        folder = self._folder / "kept" / kept.id
        if not wanted:
            return None
        folder.mkdir(parents=True, exist_ok=True)
        for one in wanted:
            with contextlib.suppress(FileExistsError):
                os.link(one.path, folder / one.path.name)
        return write_kept(folder, kept, limit=self._kept_bytes)

    def _take_over(self) -> None:
        """Finish the segment of a run that crashed, and count those that are there."""
        try:
            self._ring.mkdir(parents=True, exist_ok=True)
            for path in sorted(self._ring.glob(f"*{SUFFIX}{UNFINISHED}")):
                try:
                    finish_file(path)
                except DamagedError:
                    path.unlink()  # the crash came before its first message
            for path in sorted(self._ring.glob(f"*{SUFFIX}")):
                times = [message.log_time for message in SegmentReader(path).messages()]
                if times:
                    self.segments.append(SegmentInfo(path, min(times), max(times)))
                self._number = max(self._number, int(path.name.removesuffix(SUFFIX)))
        except (OSError, DamagedError, ValueError) as error:
            self._fail(error)

    def _write(self, message: tuple[RecordedSource, int, int, bytes]) -> None:
        if self._writer is None and not self._open(time.monotonic()):
            self.lost[message[0].topic] += 1
            return
        try:
            assert self._writer is not None  # noqa: S101 - it is open
            self._writer.write(*message)
        except Exception as error:  # noqa: BLE001 - no message may end the recorder
            self.lost[message[0].topic] += 1
            self._fail(error)

    def _open(self, now: float) -> bool:
        if now < self._retry:
            return False
        self._number += 1
        try:
            self._file = (self._ring / f"{self._number:08}{SUFFIX}{UNFINISHED}").open("wb")
            self._writer = SegmentWriter(self._file, None)
            self._begin(self._writer, time.time_ns())
            self._writer.flush()
        except OSError as error:
            self._fail(error)
            return False
        self._began = self._flushed = self._synced = now
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
        except OSError as error:
            self._fail(error)
            return
        if now - self._began >= limits.SEGMENT or self._file.tell() * 8 > self._most_bytes:
            self._finish()

    def _finish(self) -> None:
        """End the segment, and drop what the ring has no room for."""
        writer, file, self._writer, self._file = self._writer, self._file, None, None
        if writer is None or file is None:
            return
        try:
            with file:
                writer.finish()
                file.flush()
                if self._fsync is not None:
                    os.fsync(file.fileno())
            path = Path(file.name)
            done = path.with_name(path.name.removesuffix(UNFINISHED))
            path.rename(done)
            one = SegmentInfo(done, writer.first, writer.last)
            self.written += one.size
            self.segments.append(one)
            self._prune()
        except OSError as error:
            self._fail(error)

    def _prune(self) -> None:
        """Drop the oldest segments above the bounds; the newest one stays."""
        total, newest = sum(one.size for one in self.segments), self.segments[-1].last
        while len(self.segments) > 1:
            oldest = self.segments[0]
            if total <= self._most_bytes and newest - oldest.last <= self._most_ns:
                break
            total -= oldest.size
            oldest.path.unlink(missing_ok=True)
            del self.segments[0]

    def _give_up(self, file: IO[bytes]) -> None:
        """Close a segment that the disk did not take, and save what is in it."""
        path = Path(file.name)
        with contextlib.suppress(OSError):  # what was in memory is lost
            file.close()
        try:
            done = finish_file(path)
            times = [message.log_time for message in SegmentReader(done).messages()]
            self.segments.append(SegmentInfo(done, min(times), max(times)))
        except (DamagedError, ValueError):
            path.unlink(missing_ok=True)  # nothing of it can be read
        except OSError:
            pass  # the next run does it

    def _fail(self, error: Exception) -> None:
        """The disk does not take it: give up the segment, make room in the ring, try again later."""
        text = f"{self._ring}: {getattr(error, 'strerror', None) or error}"
        if text != self.problem:
            _log.warning("! the recorder cannot write: %s; it tries again [recording-stopped]", text)
        self.problem = text
        self._retry = time.monotonic() + limits.RETRY
        file, self._writer, self._file = self._file, None, None
        if file is not None:
            self._give_up(file)
        for one in self.segments[: len(self.segments) // 2]:  # a full disk has room again
            with contextlib.suppress(OSError):
                one.path.unlink(missing_ok=True)
        self.segments = self.segments[len(self.segments) // 2 :]
