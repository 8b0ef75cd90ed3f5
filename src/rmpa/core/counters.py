"""What all rooms count and time with: counters, logs, rings of figures, timers, back-off, token buckets.

Counters of refused and dropped things, and a log of refusals that is limited in rate.
"""

from __future__ import annotations

import codecs
import json
import logging
import math
from array import array
from collections import Counter, OrderedDict
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from heapq import heapify, heappop, heappush
from typing import TYPE_CHECKING, Final, Generic, Protocol, Self, TypeVar

from rmpa.core import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from _typeshed import SupportsWrite


class Counters:
    """Named counters of one room, shown in snapshots (``beacon.malformed``, ``link.refused.version``)."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()

    def add(self, name: str, amount: int = 1) -> None:
        """Add to a count; a new name starts at 0."""
        self._counts[name] += amount

    def __getitem__(self, name: str) -> int:
        return self._counts[name]

    def as_dict(self) -> dict[str, int]:
        """All counts, by name in order."""
        return dict(sorted(self._counts.items()))


class _RefusalMemory:
    """When a refusal of each kind was logged last, and the lines of each name."""

    __slots__ = ("last", "lines")

    def __init__(self) -> None:
        self.last: OrderedDict[tuple[str, str], tuple[float, int]] = OrderedDict()
        # By name: the start of the interval, the lines written in it, and the lines suppressed in it.
        self.lines: dict[str, tuple[float, int, int]] = {}


class RefusalLog:
    """Counts each refusal, and logs each kind (name and address) at most once in ``limits.LOG_INTERVAL`` seconds.

    At most ``limits.LOG_LINES_MAX`` lines of one name are written in that time, over all addresses.

    Args:
        logger: Gets the lines, at WARNING.
        counters: Counts every refusal, logged or not.
    """

    __slots__ = ("_counters", "_logger", "_memory")

    def __init__(self, logger: logging.Logger, counters: Counters) -> None:
        self._logger = logger
        self._counters = counters
        self._memory: _RefusalMemory | None = None

    def count(self, name: str) -> None:
        """Count ``name`` without a line in the log."""
        self._counters.add(name)

    def refuse(self, now: float, name: str, who: str, text: str) -> None:
        """Count ``name``, and log ``text`` within the limits.

        Args:
            now: Monotonic seconds.
            name: The counter's name; with ``who`` it makes the kind.
            who: The source address of the refused item, without the port (a port scanner has many).
            text: What happened and what to do, for the user.
        """
        self._counters.add(name)
        if self._memory is None:  # most logs of an agent with thousands of proxies never have a line
            self._memory = _RefusalMemory()
        memory, kind = self._memory, (name, who)
        last, suppressed = memory.last.get(kind, (float("-inf"), 0))
        if now - last < limits.LOG_INTERVAL:
            memory.last[kind] = (last, suppressed + 1)
            return
        since, lines, hidden = memory.lines.get(name, (now, 0, 0))
        if now - since >= limits.LOG_INTERVAL:
            since, lines = now, 0
        if lines >= limits.LOG_LINES_MAX:
            memory.lines[name] = (since, lines, hidden + 1)
            return
        memory.lines[name] = (since, lines + 1, 0)
        suppressed += hidden
        memory.last[kind] = (now, 0)
        memory.last.move_to_end(kind)
        if len(memory.last) > limits.LOG_KINDS_MAX:
            memory.last.popitem(last=False)
        if suppressed:
            self._logger.warning("! %s (%d more like this since the last line)", text, suppressed)
        else:
            self._logger.warning("! %s", text)


# The formats of log records: one line of text, or one JSON object a line; and failures that are only logged.


# Looked up at import: without a free file descriptor the codec's file could not be opened to log the shortage.
_ESCAPE: Final = codecs.getencoder("unicode_escape")


def room_of(logger: str) -> str:
    """The room that a logger belongs to: ``rmpa.mesh.io.mesh`` gives ``mesh``."""
    parts = logger.split(".")
    return parts[1] if parts[0] == "rmpa" and len(parts) > 1 else parts[0]


@contextmanager
def logged_failure(log: logging.Logger, text: str, *args: object) -> Iterator[None]:
    """Log an exception of the block, and go on behind it.

    For one of several that are called in turn: the failure of one must not keep the others from being called.

    Args:
        log: The caller's logger.
        text: What failed, as a format of ``logging``.
        args: For ``text``.
    """
    try:
        yield
    except Exception:
        log.exception("! " + text, *args)  # noqa: G003 - the mark in front of the caller's own format


def _one_line(text: str) -> str:
    """The text with control characters escaped: a peer's text must not forge lines or move the terminal's cursor."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\t" else _ESCAPE(c)[0].decode("ascii") for c in text)


class TextFormatter(logging.Formatter):
    """``12:00:01.250 warning mesh       ! text``; local time, a traceback on the following lines."""

    def format(self, record: logging.LogRecord) -> str:
        """One record."""
        when = datetime.fromtimestamp(record.created).astimezone()
        clock = f"{when:%H:%M:%S}.{int(record.msecs):03d}"
        line = f"{clock} {record.levelname.lower():<7} {room_of(record.name):<9} {_one_line(record.getMessage())}"
        if record.exc_info:
            line += "\n" + self.formatException(record.exc_info)
        return line


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time (ISO 8601, UTC), level, room, logger, text, and traceback if there is one."""

    def format(self, record: logging.LogRecord) -> str:
        """One record."""
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "room": room_of(record.name),
            "logger": record.name,
            "text": record.getMessage(),
        }
        if record.exc_info:
            fields["traceback"] = self.formatException(record.exc_info)
        return json.dumps(fields, ensure_ascii=False)


def configure_logging(level: str, stream: SupportsWrite[str], *, as_json: bool) -> None:
    """Send every record of ``level`` and above to ``stream``, replacing the earlier configuration.

    Args:
        level: As in ``Settings.log_level``.
        stream: Usually stderr, for an agent through ``runtime.process``; stdout is for a command's result.
        as_json: JSON lines instead of text.
    """
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonFormatter() if as_json else TextFormatter())
    root = logging.getLogger()
    for old in root.handlers[:]:
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level.upper())
    # A lost log line (the reader of a pipe is gone) must not print a traceback for every further line.
    logging.raiseExceptions = False


# Statistics over rings of fixed size: periods, latencies, rates. Plain Python: numpy would cost the agent 15 MB.


@dataclass(frozen=True, slots=True)
class SampleSummary:
    """The statistics of a set of samples, in the samples' unit; ``nan`` where there are too few samples."""

    count: int
    mean: float
    sd: float
    minimum: float
    maximum: float
    p50: float
    p95: float
    p99: float

    @classmethod
    def of(cls, samples: Iterable[float]) -> SampleSummary:
        """The summary of some samples; the standard deviation is the population's, as in ``rostopic hz``."""
        data = sorted(samples)
        if not data:
            return cls(0, *[math.nan] * 7)
        mean = math.fsum(data) / len(data)
        # Computed as the distance between two points: ``math.dist`` sums in C, ten times as fast as a loop.
        sd = math.dist(data, [mean] * len(data)) / math.sqrt(len(data))
        return cls(
            len(data),
            mean,
            sd,
            data[0],
            data[-1],
            percentile(data, 50),
            percentile(data, 95),
            percentile(data, 99),
        )


def percentile(ordered: list[float], percent: float) -> float:
    """The percentile of ascending samples, linear between neighbours; ``nan`` of none."""
    if not ordered:
        return math.nan
    position = (len(ordered) - 1) * percent / 100
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (position - low)


class SampleRing:
    """The last ``size`` samples; adding one takes constant time.

    Args:
        size: How many samples are kept, at least 1.

    Raises:
        ValueError: ``size`` is below 1.
    """

    def __init__(self, size: int) -> None:
        if size < 1:
            raise ValueError(f"a ring holds at least one sample, not {size}")
        self._data = array("d", bytes(8 * size))
        self._next = 0
        self.total = 0
        """The number of samples ever added."""

    def add(self, sample: float) -> None:
        """Add one sample; it replaces the oldest when the ring is full."""
        self._data[self._next] = sample
        self._next = (self._next + 1) % len(self._data)
        self.total += 1

    def clear(self) -> None:
        """Forget all samples."""
        self._next = 0
        self.total = 0

    def __len__(self) -> int:
        return min(self.total, len(self._data))

    def __iter__(self) -> Iterator[float]:
        """Oldest first."""
        if self.total >= len(self._data):
            yield from self._data[self._next :]
        yield from self._data[: self._next]

    def summary(self) -> SampleSummary:
        """The summary of the samples in the ring."""
        return SampleSummary.of(self)


class ArrivalStats:
    """Arrivals of one stream of messages: their periods and bytes, over the last ``window`` messages.

    Args:
        window: How many periods are kept.
    """

    def __init__(self, window: int = 1000) -> None:
        self._periods = SampleRing(window)
        self._sizes = SampleRing(window)
        self._last: float | None = None
        self.messages = 0
        """Messages ever seen."""
        self.bytes = 0
        """Bytes ever seen."""

    def arrived(self, now: float, size: int) -> None:
        """Count one message of ``size`` bytes at ``now`` (monotonic seconds)."""
        if self._last is not None:
            self._periods.add(now - self._last)
            self._sizes.add(size)
        self._last = now
        self.messages += 1
        self.bytes += size

    @property
    def last(self) -> float | None:
        """When the last message arrived, in monotonic seconds; ``None`` before the first."""
        return self._last

    def periods(self) -> SampleSummary:
        """Seconds between messages."""
        return self._periods.summary()

    def rate(self) -> float:
        """Messages per second over the window; ``nan`` before the second message."""
        summary = self.periods()
        return 1 / summary.mean if summary.count and summary.mean > 0 else math.nan

    def bandwidth(self) -> float:
        """Bytes per second over the window; ``nan`` before the second message."""
        elapsed = math.fsum(self._periods)
        return math.fsum(self._sizes) / elapsed if elapsed > 0 else math.nan


# Many timers of one protocol machine in a heap.


_SPARE: Final = 64
"""The heap, which also holds moved and cancelled entries, is rebuilt above this plus twice the live entries."""


class _Key(Protocol):
    """Hashable and ordered: of keys that are due at the same time the lower one comes first."""

    def __hash__(self) -> int: ...

    def __lt__(self, other: Self, /) -> bool: ...


_K = TypeVar("_K", bound=_Key)


class TimerQueue(Generic[_K]):
    """When each of many keys is due: a machine with hundreds of peers must not scan all of them for one event.

    ``set`` and ``pop`` cost O(log n) on average, ``next`` O(1). Times are seconds on the machine's clock.
    """

    def __init__(self) -> None:
        self._at: dict[_K, float] = {}
        # Entries that were moved or cancelled stay in it until they reach the top, or until it is rebuilt.
        self._heap: list[tuple[float, _K]] = []

    def __len__(self) -> int:
        return len(self._at)

    def set(self, key: _K, at: float | None) -> None:
        """Set the due time of ``key`` to ``at``, in place of any former time; ``None``: never."""
        if at is None:
            self._at.pop(key, None)
        elif self._at.get(key) != at:
            self._at[key] = at
            heappush(self._heap, (at, key))
        if len(self._heap) > 2 * len(self._at) + _SPARE:
            self._heap = [(at, key) for key, at in self._at.items()]
            heapify(self._heap)

    def next(self) -> float | None:
        """When the first key is due; ``None``: no key is."""
        heap = self._heap
        while heap and self._at.get(heap[0][1]) != heap[0][0]:
            heappop(heap)
        return heap[0][0] if heap else None

    def pop(self, now: float) -> _K | None:
        """Remove and return the first key that is due at ``now``; ``None`` if none is."""
        at = self.next()
        if at is None or at > now:
            return None
        _, key = heappop(self._heap)
        del self._at[key]
        return key

    def take(self, now: float) -> list[_K]:
        """Remove and return all keys that are due at ``now``, earliest first."""
        due = []
        while (key := self.pop(now)) is not None:
            due.append(key)
        return due


# Exponential back-off with a cap and jitter: retries go on forever, and not in step with those of other agents.


class Backoff:
    """Delays that double from ``first`` to ``cap`` seconds, each spread over 50 % to 100 % of its value.

    Args:
        first: The first delay.
        cap: The longest delay before the spread.
        rng: Uniform numbers in [0, 1); seeded by simulations.
    """

    __slots__ = ("_first", "_next", "_rng", "cap")

    def __init__(self, first: float, cap: float, rng: Callable[[], float]) -> None:
        self._first = first
        self.cap = cap
        """The longest delay, from the next one on."""
        self._rng = rng
        self._next = first

    def delay(self) -> float:
        """The next delay in seconds."""
        base = min(self._next, self.cap)
        self._next = min(self.cap, base * 2)
        return base * (0.5 + 0.5 * self._rng())

    def reset(self) -> None:
        """Start again at ``first``, after a successful attempt."""
        self._next = self._first


# Time is an argument: protocol machines get ``now`` and never read a clock.
#
# ``now`` is seconds (float) of a monotonic clock with an arbitrary zero; stamps on the wire are nanoseconds (int)
# of
# the sender's wall clock.


class Clock(Protocol):
    """A source of time for the I/O parts; tests pass a simulated one."""

    def now(self) -> float:
        """Monotonic seconds."""
        ...

    def wall_ns(self) -> int:
        """Wall clock, in nanoseconds since the epoch."""
        ...


def earliest(*timers: float | None) -> float | None:
    """The first of several timers; ``None`` means never."""
    first = None
    for timer in timers:
        if timer is not None and (first is None or timer < first):
            first = timer
    return first


# A token bucket: limits the rate of an action.


_ROUNDING: Final = 1e-9


class TokenBucket:
    """Allows an action ``rate`` times a second, and ``burst`` times at once after a rest.

    An action may be of several tokens. One of more than ``burst`` is allowed when the bucket is full, and is paid off
    afterwards.

    Args:
        rate: Tokens a second.
        burst: The capacity in tokens, at least 1.
    """

    def __init__(self, rate: float, burst: float) -> None:
        self._rate = rate
        self._burst = burst
        self._level = burst
        self._at = float("-inf")

    def has(self, now: float, amount: float = 1) -> bool:
        """Whether there are enough tokens at ``now`` (monotonic seconds) for an action of ``amount``."""
        self._fill(now)
        return self._level >= min(amount, self._burst) * (1 - _ROUNDING)

    def spend(self, amount: float = 1) -> None:
        """Take tokens that ``has`` has told of."""
        self._level -= amount

    def take(self, now: float) -> bool:
        """Take a token at ``now`` (monotonic seconds); return whether there was one."""
        if not self.has(now):
            return False
        self.spend()
        return True

    def put_back(self) -> None:
        """Return a token that was taken but not used."""
        self._level = min(self._burst, self._level + 1)

    def next(self, now: float, amount: float = 1) -> float:
        """When there are enough tokens for an action of ``amount``, not before ``now``."""
        self._fill(now)
        return now + max(0.0, min(amount, self._burst) - self._level) / self._rate

    def _fill(self, now: float) -> None:
        if now > self._at:
            self._level = min(self._burst, self._level + (now - self._at) * self._rate)
            self._at = now


# Lets long computations yield to pending data without importing the event loop.


_T = TypeVar("_T")


class Yielder(Protocol):
    """Iterates over items; between two of them data may be handled (``runtime.loop.yielding_to_data``).

    ``iter`` is a yielder that handles nothing. The items must not change meanwhile: pass a copy, or a collection that
    nothing else changes. The caller's own data must be consistent during the iteration.
    """

    def __call__(self, items: Iterable[_T], /) -> Iterable[_T]:
        """The same items."""
        ...


# The advice for a user whose limit of open files (file descriptors) is too low.


def remedy(pid: int | None = None) -> str:
    """How to raise the limit permanently; with a process id also how to raise it for that process at once."""
    enough = limits.OPEN_FILES_ADVICE
    text = (
        f"raise it: LimitNOFILE={enough} of a systemd unit, "
        f"`ulimit -n {enough}` as root in the shell that starts the agent"
    )
    if pid is not None:
        text += f", or at once, as root: prlimit --pid {pid} --nofile={enough}:{enough}"
    return text
