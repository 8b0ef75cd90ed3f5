"""What all rooms count and time with: counters, logs, figures, timers, back-off, token buckets.

Protocol machines get ``now`` and never read a clock: seconds (float) of a monotonic clock with an arbitrary zero.
Stamps on the wire are nanoseconds (int) of the sender's wall clock.
"""

from __future__ import annotations

import codecs
import json
import logging
import math
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from heapq import heapify, heappop, heappush
from typing import TYPE_CHECKING, Final, Generic, Protocol, TypeVar

from rmpa.core import codes, limits
from rmpa.core.errors import with_places

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from _typeshed import SupportsWrite

# A refusal of one kind from one address is logged at most once in this time; the rest are counted.
LOG_INTERVAL: Final = 5.0

# The limit of open files that users are advised to set: enough for some ten thousand nodes.
_OPEN_FILES_ADVICE: Final = 65_536


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


class RefusalLog:
    """Counts each refusal, and logs each kind (name and address) at most once in ``LOG_INTERVAL`` seconds.

    At most ``limits.LOG_LINES_MAX`` lines of one name are written in that time, over all addresses.

    Args:
        logger: Gets the lines, at WARNING.
        counters: Counts every refusal, logged or not.
    """

    __slots__ = ("_counters", "_last", "_lines", "_logger")

    def __init__(self, logger: logging.Logger, counters: Counters) -> None:
        self._logger = logger
        self._counters = counters
        # By kind: when it was logged last, and how many are suppressed since then; the oldest line first.
        self._last: dict[tuple[str, str], tuple[float, int]] = {}
        # By name: the start of the interval, the lines written in it, and the lines suppressed in it.
        self._lines: dict[str, tuple[float, int, int]] = {}

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
        kind = name, who
        last, suppressed = self._last.get(kind, (float("-inf"), 0))
        if now - last < LOG_INTERVAL:
            self._last[kind] = (last, suppressed + 1)
            return
        since, lines, hidden = self._lines.get(name, (now, 0, 0))
        if now - since >= LOG_INTERVAL:
            since, lines = now, 0
        if lines >= limits.LOG_LINES_MAX:
            self._lines[name] = (since, lines, hidden + 1)
            return
        self._lines[name] = (since, lines + 1, 0)
        self._last.pop(kind, None)
        self._last[kind] = (now, 0)
        if len(self._last) > limits.LOG_KINDS_MAX:
            del self._last[next(iter(self._last))]
        more = f" ({suppressed + hidden} more like this since the last line)" if suppressed + hidden else ""
        self._logger.warning("! %s%s [%s]", text, more, codes.of_counter(name))


# --- The formats of log records -------------------------------------------------------------------------------------
#
# One line of text, or one JSON object a line; and failures that are only logged.


# Looked up at import: without a free file descriptor the codec's file could not be opened to log the shortage.
_ESCAPE: Final = codecs.getencoder("unicode_escape")


def _room_of(logger: str) -> str:
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


# By the level's number, the greatest that fits: the priority of a line in a journal (sd-daemon(3)).
_PRIORITIES: Final = {logging.CRITICAL: 2, logging.ERROR: 3, logging.WARNING: 4, logging.INFO: 6, logging.NOTSET: 7}


class _Formatter(logging.Formatter):
    """One record as text, or as one JSON object a line; ``configure_logging`` says which."""

    as_json = False
    in_journal = False

    def format(self, record: logging.LogRecord) -> str:
        """``12:00:01.250 warning mesh       ! text``; local time, a traceback on the following lines.

        In a journal, which has the time itself: ``<4>warning mesh       ! text``, each line with its priority.
        In JSON: time (ISO 8601, UTC), level, room, logger, text, and code and traceback if there is one.
        A line with a traceback and without a code tells of a fault in RMPA.
        """
        level, room = record.levelname.lower(), _room_of(record.name)
        trace = self.formatException(record.exc_info) if record.exc_info else ""
        text = with_places(record.getMessage())
        if not (code := codes.of_line(text)) and trace and record.levelno >= logging.WARNING:
            code = "internal-error"
            text += f" [{code}]"
        if not self.as_json:
            line = f"{level:<7} {room:<9} {_one_line(text)}"
            lines = f"{line}\n{trace}" if trace else line
            if self.in_journal:
                priority = next(word for number, word in _PRIORITIES.items() if number <= record.levelno)
                return "\n".join(f"<{priority}>{each}" for each in lines.split("\n"))
            clock = f"{datetime.fromtimestamp(record.created).astimezone():%H:%M:%S}.{int(record.msecs):03d}"
            return f"{clock} {lines}"
        fields = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": level,
            "room": room,
            "logger": record.name,
            "text": text,
        } | ({"code": code} if code else {})
        return json.dumps(fields | {"traceback": trace} if trace else fields, ensure_ascii=False)


def configure_logging(level: str, stream: SupportsWrite[str], *, as_json: bool, in_journal: bool = False) -> None:
    """Send every record of ``level`` and above to ``stream``, replacing the earlier configuration.

    Args:
        level: As in ``Settings.log_level``.
        stream: Usually stderr, for an agent through ``runtime.process``; stdout is for a command's result.
        as_json: JSON lines instead of text.
        in_journal: Whether ``stream`` leads to systemd's journal: text then has priorities, and no time of its own.
    """
    handler = logging.StreamHandler(stream)
    formatter = _Formatter()
    formatter.as_json, formatter.in_journal = as_json, in_journal
    handler.setFormatter(formatter)
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    # A lost log line (the reader of a pipe is gone) must not print a traceback for every further line.
    logging.raiseExceptions = False


# --- Statistics of periods and latencies ----------------------------------------------------------------------------
#
# Plain Python: numpy would cost the agent 15 MB.


@dataclass(frozen=True, slots=True)
class SampleSummary:
    """The statistics of a set of samples, in the samples' unit; ``nan`` where there are too few samples."""

    count: int
    mean: float
    sd: float
    minimum: float
    maximum: float
    p50: float
    p99: float

    @classmethod
    def of(cls, samples: Iterable[float]) -> SampleSummary:
        """The summary of some samples; the standard deviation is the population's, as in ``rostopic hz``."""
        data = sorted(samples)
        if not data:
            return cls(0, *[math.nan] * 6)
        mean = math.fsum(data) / len(data)
        # Computed as the distance between two points: ``math.dist`` sums in C, ten times as fast as a loop.
        sd = math.dist(data, [mean] * len(data)) / math.sqrt(len(data))
        return cls(len(data), mean, sd, data[0], data[-1], *(percentile(data, percent) for percent in (50, 99)))


def percentile(ordered: list[float], percent: float) -> float:
    """The percentile of ascending samples, linear between neighbours; ``nan`` of none."""
    if not ordered:
        return math.nan
    position = (len(ordered) - 1) * percent / 100
    low = math.floor(position)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (position - low)


# --- Many timers of one protocol machine in a heap ------------------------------------------------------------------


# The heap, which also holds moved and cancelled entries, is rebuilt above this plus twice the live entries.
_SPARE: Final = 64


_K = TypeVar("_K")


class TimerQueue(Generic[_K]):
    """When each of many keys is due: a machine with hundreds of peers must not scan all of them for one event.

    ``set`` and ``pop`` cost O(log n) on average, ``next`` O(1). Times are seconds on the machine's clock. Keys are
    ordered: of those that are due at the same time the lower one comes first.
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


# --- Exponential back-off with a cap and jitter ---------------------------------------------------------------------
#
# Retries go on forever, and not in step with those of other agents.


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


def earliest(*timers: float | None) -> float | None:
    """The first of several timers; ``None`` means never."""
    return min((timer for timer in timers if timer is not None), default=None)


# --- A token bucket -------------------------------------------------------------------------------------------------
#
# Limits the rate of an action.


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


# --- Lets long computations yield to pending data without importing the event loop ----------------------------------


_T = TypeVar("_T")


class Yielder(Protocol):
    """Iterates over items; between two of them data may be handled (``runtime.loop.yielding_to_data``).

    ``iter`` is a yielder that handles nothing. The items must not change meanwhile: pass a copy, or a collection that
    nothing else changes. The caller's own data must be consistent during the iteration.
    """

    def __call__(self, items: Iterable[_T], /) -> Iterable[_T]:
        """The same items."""
        ...


# --- The advice for a user whose limit of open files (file descriptors) is too low ----------------------------------


def remedy(pid: int | None = None) -> str:
    """How to raise the limit permanently; with a process id also how to raise it for that process at once."""
    enough = _OPEN_FILES_ADVICE
    text = (
        f"raise it: LimitNOFILE={enough} of a systemd unit, "
        f"`ulimit -n {enough}` as root in the shell that starts the agent"
    )
    if pid is not None:
        text += f", or at once, as root: prlimit --pid {pid} --nofile={enough}:{enough}"
    return text
