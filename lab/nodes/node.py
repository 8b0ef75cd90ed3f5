"""What every node in Python has, rospy's and our own: options, lines, one clock, rounds; ``node.hpp`` is it in C++.

Only the standard library: rospy nodes run with the system's Python.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import math
import struct
import sys
import threading
import time
from array import array
from typing import TYPE_CHECKING, Final, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

T = TypeVar("T")
# The first bytes of a measured message: round, sequence from 0, and the ns at which it was due at its source.
HEAD: Final = struct.Struct("=IIQ")
# Nanoseconds from the command to the first message of a round.
LEAD: Final = 20_000_000
# Nanoseconds without a message after which the next one comes ``again``.
_PAUSE: Final = 500_000_000
# Seconds of waiting for silence at the most.
_PATIENCE: Final = 10.0
_LOOK: Final = 0.02
_PHASE: Final = "ms from a whole multiple of the period on CLOCK_MONOTONIC to each due moment; default: any"
_PR_SET_TIMERSLACK: Final = 29
_TIMER_ABSTIME: Final = 1

_libc = ctypes.CDLL(None, use_errno=True)
_lock = threading.Lock()


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


def sleep_until(ns: int) -> None:
    """Sleep until a moment of CLOCK_MONOTONIC; other threads run meanwhile."""
    due = _Timespec(*divmod(ns, 1_000_000_000))
    while _libc.clock_nanosleep(time.CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(due), None):
        pass  # a signal


def sleep_sharply() -> None:
    """Take the kernel's 50 µs of slack from this thread's sleeps: they are not the path's."""
    _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


def say(event: str, **fields: object) -> None:
    """Write one machine-readable line."""
    with _lock:
        sys.stdout.write("@ " + json.dumps({"event": event, **fields}) + "\n")
        sys.stdout.flush()


def parser(description: str | None) -> argparse.ArgumentParser:
    """The options that every node has."""
    made = argparse.ArgumentParser(description=description, allow_abbrev=False)
    made.add_argument("--name", default="", help="node name; default: the program's, anonymous")
    made.add_argument("--nodelay", action="store_true", help="ask the publisher for TCP_NODELAY")
    return made


def source_options(description: str | None) -> argparse.ArgumentParser:
    """Those of ``source``."""
    made = parser(description)
    made.add_argument("--topic", default="/cmd")
    made.add_argument("--queue", type=int, default=100)
    made.add_argument("--phase", type=float, default=None, help=_PHASE)
    return made


def velocity_options(description: str | None) -> argparse.ArgumentParser:
    """Those of ``velocity``."""
    made = parser(description)
    made.add_argument("--cmd", default="/cmd")
    made.add_argument("--vel", default="/vel")
    made.add_argument("--queue", type=int, default=100)
    made.add_argument("--mode", choices=["event", "polled"], default="event")
    made.add_argument("--rate", type=float, default=10.0, help="of the polled mode, Hz")
    return made


def sink_options(description: str | None) -> argparse.ArgumentParser:
    """Those of ``sink``."""
    made = parser(description)
    made.add_argument("--topics", type=lambda text: text.split(","), default=["/cmd", "/vel"])
    made.add_argument("--queue", type=int, default=1000)
    return made


def commands() -> Iterator[list[str]]:
    """The words of each line that is written to us."""
    # Not sys.stdin: a thread that waits for it would stand in the way of the interpreter's end.
    with open(0, encoding="utf-8", closefd=False) as lines:
        for line in lines:
            yield line.split()


class Subscribers:
    """Says ``connected`` with the number of a topic's subscribers whenever that changes."""

    def __init__(self) -> None:
        self._count = 0

    def changed(self, count: int) -> None:
        """Note how many there are now."""
        if count != self._count:
            self._count = count
            say("connected", subscribers=count)


def first_due(now: int, period: float, phase: float | None) -> int:
    """When the first message of a round is due, in ns: after its lead, and at its phase.

    Args:
        now: The moment of the command, ns.
        period: Between messages, ns.
        phase: Milliseconds from a whole multiple of the period; ``None`` for any.
    """
    start = now + LEAD
    if phase is None:
        return start
    behind = start - phase * 1e6
    return start + int(math.ceil(behind / period) * period - behind)


def serve_rounds(publish: Callable[[bytearray], None], phase: float | None, alive: Callable[[], bool]) -> None:
    """Send the rounds that are asked for, in this thread: ``ROUND SIZE RATE COUNT FILE``.

    COUNT messages of SIZE bytes at RATE Hz on an absolute schedule: one that leaves late does not move those behind
    it. FILE gets for each how many ns after its due time it was given to ``publish`` (8 bytes, native order).

    Args:
        publish: Gets the data of each message, in a buffer that is used again.
        phase: As of ``first_due``.
        alive: Whether to go on.
    """
    sleep_sharply()
    for words in commands():
        number, size, rate, count, file = int(words[0]), int(words[1]), float(words[2]), int(words[3]), words[4]
        data = bytearray(b"\x07" * max(size, HEAD.size))
        late = array("Q", bytes(8 * count))
        start = first_due(time.monotonic_ns(), 1e9 / rate, phase)
        sent = 0
        while sent < count and alive():
            due = start + int(1e9 / rate * sent)
            HEAD.pack_into(data, 0, number, sent, due)
            sleep_until(due)
            late[sent] = time.monotonic_ns() - due
            publish(data)
            sent += 1
        _write(file, late[:sent])
        say("sent", round=number, count=sent, start_ns=start)


def serve_polls(rate: float, poll: Callable[[], None], alive: Callable[[], bool]) -> None:
    """Call ``poll`` at whole multiples of its period on CLOCK_MONOTONIC, in this thread.

    A source can so be given a phase to it.
    """
    sleep_sharply()
    period = 1e9 / rate
    turn = int(time.monotonic_ns() / period) + 1
    while alive():
        sleep_until(int(period * turn))
        poll()
        turn += 1


class Newest(Generic[T]):
    """The newest command, until it is taken."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._value: T | None = None

    def put(self, value: T) -> None:
        """Replace it."""
        with self._lock:
            self._value = value

    def take(self) -> T | None:
        """Take it away; ``None`` if there is no new one."""
        with self._lock:
            value, self._value = self._value, None
        return value


class Notes:
    """When each measured message came.

    Args:
        topics: Their names; a topic is noted by its index.
    """

    def __init__(self, topics: Sequence[str]) -> None:
        self._topics = topics
        self._lock = threading.Lock()
        self._rows = array("Q")
        self._last = 0
        self._seen = [0] * len(topics)

    def note(self, topic: int, data: bytes, offset: int = 0) -> None:
        """Note a message of which this is the data, from ``offset`` on; shorter ones than a head are none of ours."""
        now = time.monotonic_ns()
        if len(data) < offset + HEAD.size:
            return
        number, sequence, due = HEAD.unpack_from(data, offset)
        with self._lock:
            self._rows.extend((number, topic, sequence, due, now))
            self._last = now
        seen, self._seen[topic] = self._seen[topic], now
        if not seen:
            say("first", topic=self._topics[topic], came_ns=now)
        elif now - seen > _PAUSE:
            say("again", topic=self._topics[topic], came_ns=now, gap_ns=now - seen)

    def serve(self) -> None:
        """Write what came when asked to: ``ROUND FILE SETTLE``.

        Waits until nothing has come for SETTLE seconds (10 at the most), writes what came of that round (0: of every
        round) to FILE as topic's index, sequence, due and arrival (8 bytes each, native order), and forgets all.
        """
        for words in commands():
            number, file, settle = int(words[0]), words[1], float(words[2])
            begun = time.monotonic_ns()
            while time.monotonic_ns() < min(begun + _PATIENCE * 1e9, max(begun, self._last) + settle * 1e9):
                time.sleep(_LOOK)
            with self._lock:
                rows, self._rows = self._rows, array("Q")
            kept = array("Q")
            for at in range(0, len(rows), 5):
                if number in {0, rows[at]}:
                    kept.extend(rows[at + 1 : at + 5])
            _write(file, kept)
            say("noted", round=number, count=len(kept) // 4)


def _write(file: str | Path, rows: array[int]) -> None:
    with open(file, "wb") as out:  # noqa: PTH123 - the shortest way for both interpreters
        rows.tofile(out)
