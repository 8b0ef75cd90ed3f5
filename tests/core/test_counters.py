"""Counting refusals, and logging them without flooding."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from rmpa.core import limits
from rmpa.core.counters import LOG_INTERVAL, Counters, RefusalLog

if TYPE_CHECKING:
    import pytest


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
