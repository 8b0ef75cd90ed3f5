"""Writes an agent's log lines in a thread, so that a log that is not read does not block the agent."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque

from rmpa.runtime import limits

_log = logging.getLogger(__name__)


class LogWriter:
    """The text stream of a log handler.

    A pipe that is not read (a stopped pager, a hanging journal) blocks its writer. The queue of lines is bounded:
    when it is full, new lines are lost, and their number is logged once the pipe is read again.

    Args:
        fd: The file descriptor for the lines; not closed here.
    """

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._waiting: deque[str] = deque()
        self._wake = threading.Event()
        self._closed = False
        # The number of lost lines that is not logged yet.
        self.lost = 0
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def write(self, text: str) -> int:
        """Queue one or more lines; never blocks."""
        if len(self._waiting) >= limits.LOG_WAITING:
            self.lost += 1
        else:
            self._waiting.append(text)
            self._wake.set()
        return len(text)

    def flush(self) -> None:
        """Do nothing: the thread writes as soon as it can."""

    def close(self) -> None:
        """Wait until all lines are written, but no longer than ``limits.DRAIN_TIMEOUT``."""
        self._closed = True
        self._wake.set()
        self._thread.join(limits.DRAIN_TIMEOUT)

    def _work(self) -> None:
        while not self._closed or self._waiting:
            self._wake.wait()
            if not self._closed:
                time.sleep(limits.LOG_GATHER)  # so that the lines of a burst are written in one call
            self._wake.clear()
            while self._waiting:
                self._write()
            if self.lost:
                lost, self.lost = self.lost, 0
                _log.warning(
                    "! %d log lines were lost: the program that reads the log had stopped [log-lines-lost]", lost
                )

    def _write(self) -> None:
        lines = [self._waiting.popleft() for _ in range(min(len(self._waiting), limits.LOG_BATCH))]
        rest = memoryview("".join(lines).encode(errors="backslashreplace"))
        while rest:
            try:
                rest = rest[os.write(self._fd, rest) :]
            except BlockingIOError:
                time.sleep(limits.LOG_GATHER)  # the pipe is full, and another process has made it non-blocking
            except OSError:
                return  # the pipe is closed
