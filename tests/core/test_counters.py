"""Counters, refusals in the log and how its lines look; back-off, timers and bounded rates; figures."""

from __future__ import annotations

import io
import json
import logging
import math
import random
import re
import statistics
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core import limits
from rmpa.core.log import LOG_INTERVAL, RefusalLog, _room_of, configure_logging
from rmpa.core.statistics import Counters, SampleSpread, percentile
from rmpa.core.timers import Backoff, TimerQueue, TokenBucket

if TYPE_CHECKING:
    from collections.abc import Iterator


def test_counters() -> None:
    counters = Counters()
    counters.add("b")
    counters.add("a", 3)
    counters.add("b")
    assert counters.as_dict() == {"a": 3, "b": 2}
    assert list(counters.as_dict()) == ["a", "b"]
    assert (counters["a"], counters["none"]) == (3, 0)
    assert "none" not in counters.as_dict()


def test_one_line_a_kind_and_interval(caplog: pytest.LogCaptureFixture) -> None:
    counters = Counters()
    log = RefusalLog(logging.getLogger("rmpa.test"), counters)
    for now in (0.0, 1.0, 2.0):
        log.refuse(now, "beacon.malformed", "10.0.0.1", "text")
    log.refuse(2.0, "beacon.malformed", "10.0.0.2", "other address")
    log.refuse(2.0, "beacon.version", "10.0.0.1", "other kind")
    log.refuse(LOG_INTERVAL, "beacon.malformed", "10.0.0.1", "again")
    assert [r.getMessage() for r in caplog.records] == [
        "! text [protocol-error]",
        "! other address [protocol-error]",
        "! other kind [other-release]",
        "! again (2 more like this since the last line) [protocol-error]",
    ]
    assert counters.as_dict() == {"beacon.malformed": 5, "beacon.version": 1}


def test_forged_addresses_do_not_flood_the_log(caplog: pytest.LogCaptureFixture) -> None:
    counters = Counters()
    log = RefusalLog(logging.getLogger("rmpa.test"), counters)
    for number in range(5000):
        log.refuse(number * 1e-4, "beacon.malformed", f"10.0.{number >> 8}.{number & 255}", "text")
    assert len(caplog.records) == limits.LOG_LINES_MAX
    log.refuse(0.5, "beacon.version", "10.0.0.1", "another name has lines of its own")
    log.refuse(LOG_INTERVAL, "beacon.malformed", "10.9.9.9", "later")
    assert [record.getMessage() for record in caplog.records[-2:]] == [
        "! another name has lines of its own [other-release]",
        f"! later ({5000 - limits.LOG_LINES_MAX} more like this since the last line) [protocol-error]",
    ]
    assert counters["beacon.malformed"] == 5001


def test_memory_is_bounded() -> None:
    log = RefusalLog(logging.getLogger("rmpa.silent"), Counters())
    logging.getLogger("rmpa.silent").setLevel(logging.CRITICAL)
    for number in range(limits.LOG_KINDS_MAX + 100):
        log.refuse(float(number), "x", str(number), "text")
    assert len(log._last) == limits.LOG_KINDS_MAX


@pytest.fixture
def stream() -> Iterator[io.StringIO]:
    root = logging.getLogger()
    before, level, raising = root.handlers[:], root.level, logging.raiseExceptions
    yield io.StringIO()
    root.handlers[:] = before
    root.setLevel(level)
    logging.raiseExceptions = raising


def test_rooms() -> None:
    assert [_room_of(n) for n in ("rmpa.mesh.io.mesh", "rmpa", "asyncio")] == ["mesh", "rmpa", "asyncio"]


def test_text(stream: io.StringIO) -> None:
    configure_logging("info", stream, as_json=False)
    logging.getLogger("rmpa.mesh.io.mesh").warning("! %s", "it\nis \x1b[31m")
    logging.getLogger("rmpa.mesh").debug("hidden")
    assert re.fullmatch(r"\d\d:\d\d:\d\d\.\d{3} warning mesh      ! it\\nis \\x1b\[31m\n", stream.getvalue())


def test_a_journal_gets_priorities_and_no_time(stream: io.StringIO) -> None:
    configure_logging("debug", stream, as_json=False, in_journal=True)
    log = logging.getLogger("rmpa.mesh.io.lane")
    log.debug("> a")
    log.warning("! b")
    try:
        int("x")
    except ValueError:
        log.exception("! c")
    first, second, third, *trace = stream.getvalue().splitlines()
    assert (first, second) == ("<7>debug   mesh      > a", "<4>warning mesh      ! b")
    assert third == "<3>error   mesh      ! c [internal-error]"
    assert {line[:3] for line in trace} == {"<3>"}


def test_json_with_a_traceback(stream: io.StringIO) -> None:
    configure_logging("debug", stream, as_json=True)
    try:
        int("x")
    except ValueError:
        logging.getLogger("rmpa.bridge").exception("! failed\nat it")
    (line,) = stream.getvalue().splitlines()
    record = json.loads(line)
    assert {k: record[k] for k in ("level", "room", "logger", "text")} == {
        "level": "error",
        "room": "bridge",
        "logger": "rmpa.bridge",
        "text": "! failed\nat it [internal-error]",
    }
    assert "ValueError: invalid literal" in record["traceback"]
    assert record["time"].endswith("+00:00")


def test_a_line_to_escape_is_written_without_file_descriptors() -> None:
    """The codec's module was loaded at its first use: asyncio's line about too many open files never came."""
    script = (
        "import logging, resource, sys\n"
        "from rmpa.core.log import configure_logging\n"
        "configure_logging('info', sys.stderr, as_json=False)\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))\n"
        "logging.error('too many\\nopen files')\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=30)
    assert r"too many\nopen files" in done.stderr


def test_doubles_to_its_cap_and_starts_again() -> None:
    backoff = Backoff(0.1, 1.0, lambda: 1.0)
    assert [round(backoff.delay(), 6) for _ in range(6)] == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]
    backoff.reset()
    assert round(backoff.delay(), 6) == 0.1


def test_spread_between_half_and_all() -> None:
    backoff = Backoff(1.0, 1.0, random.Random(1).random)
    delays = [backoff.delay() for _ in range(1000)]
    assert 0.5 <= min(delays) < 0.51
    assert 0.99 < max(delays) <= 1.0


def test_the_first_is_known_and_what_is_due_comes_in_order() -> None:
    table: TimerQueue[str] = TimerQueue()
    assert table.next() is None
    for key, at in (("late", 9.0), ("b", 2.0), ("a", 2.0), ("first", 1.0)):
        table.set(key, at)
    assert table.next() == 1.0
    assert table.take(0.5) == []
    assert table.take(2.0) == ["first", "a", "b"]
    assert (table.next(), len(table)) == (9.0, 1)


def test_queue_agrees_with_a_list_and_stays_small() -> None:
    rng = random.Random(5)
    table: TimerQueue[int] = TimerQueue()
    plain: dict[int, float] = {}
    for step in range(20_000):
        key, at = rng.randrange(100), rng.choice([None, step + rng.randrange(50)])
        table.set(key, at)
        if at is None:
            plain.pop(key, None)
        else:
            plain[key] = at
        assert table.next() == min(plain.values(), default=None)
        if step % 20 == 0:
            due = sorted((at, key) for key, at in plain.items() if at <= step)
            assert table.take(step) == [key for _, key in due]
            for _, key in due:
                del plain[key]
        assert len(table._heap) <= 2 * len(table) + 65


def test_a_burst_then_the_rate_and_after_a_rest_a_burst_again() -> None:
    bucket = TokenBucket(rate=10, burst=3)
    assert [bucket.take(5.0) for _ in range(4)] == [True, True, True, False]
    assert bucket.next(5.0) == pytest.approx(5.1)
    taken = sum(bucket.take(5.0 + step / 1000) for step in range(1, 2001))
    assert taken == 20
    assert [bucket.take(60.0) for _ in range(4)] == [True, True, True, False]


def test_returned_token_can_be_taken_again_up_to_the_burst() -> None:
    bucket = TokenBucket(rate=1, burst=2)
    assert bucket.take(0.0)
    assert bucket.take(0.0)
    bucket.put_back()
    assert [bucket.take(0.0) for _ in range(2)] == [True, False]
    for _ in range(5):
        bucket.put_back()
    assert [bucket.take(0.0) for _ in range(3)] == [True, True, False]


def test_it_is_let_through_at_the_moment_that_was_named() -> None:
    bucket = TokenBucket(rate=7, burst=1)
    now = 1234.567
    for _ in range(1000):
        assert bucket.take(now)
        assert not bucket.take(now)
        now = bucket.next(now)


def test_a_clock_that_stands_still_gives_nothing() -> None:
    bucket = TokenBucket(rate=10, burst=1)
    assert bucket.take(3.0)
    assert not bucket.take(2.0)
    assert bucket.next(3.0) == pytest.approx(3.1)


SAMPLES = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=50)


@given(SAMPLES)
def test_summary_agrees_with_the_standard_library(samples: list[float]) -> None:
    s = SampleSpread.of(samples)
    assert s.mean == pytest.approx(statistics.fmean(samples), abs=1e-6)
    assert s.sd == pytest.approx(statistics.pstdev(samples), abs=1e-3)
    assert (s.count, s.min, s.max) == (len(samples), min(samples), max(samples))
    assert s.min <= s.p50 <= s.p99 <= s.max


def test_nothing_gives_nan() -> None:
    s = SampleSpread.of([])
    assert s.count == 0
    assert all(math.isnan(x) for x in (s.mean, s.sd, s.min, s.max, s.p50, s.p99, percentile([], 5)))


def test_percentiles_are_linear_between_neighbours() -> None:
    assert [percentile([0.0, 10.0], p) for p in (0, 25, 50, 100)] == [0, 2.5, 5, 10]
