from __future__ import annotations

import logging
import os
import time
from typing import TYPE_CHECKING

import pytest

from rmpa.core.log import configure_logging
from rmpa.runtime import limits
from rmpa.runtime.log_writer import LogWriter

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

DEADLINE = 10.0


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    out, into = os.pipe()
    os.set_blocking(out, False)
    yield out, into
    os.close(out)
    os.close(into)


@pytest.fixture(autouse=True)
def restore_logging() -> Iterator[None]:
    root = logging.getLogger()
    before, level, raising = root.handlers[:], root.level, logging.raiseExceptions
    yield
    root.handlers[:] = before
    root.setLevel(level)
    logging.raiseExceptions = raising


def read(out: int, enough: Callable[[bytes], bool]) -> bytes:
    got = b""
    deadline = time.monotonic() + DEADLINE
    while not enough(got) and time.monotonic() < deadline:
        try:
            got += os.read(out, 1 << 20)
        except BlockingIOError:
            time.sleep(0.005)
    return got


def test_lines_arrive_in_order_and_all_of_them_before_the_end(pipe: tuple[int, int]) -> None:
    out, into = pipe
    writer = LogWriter(into)
    configure_logging("info", writer, as_json=False)
    for number in range(200):
        logging.getLogger("rmpa.test").info("line %d", number)
    writer.close()
    lines = read(out, lambda got: got.count(b"\n") == 200).splitlines()
    assert [line.split()[-1] for line in lines] == [str(number).encode() for number in range(200)]


def test_nobody_waits_for_a_reader_who_has_stopped(pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "LOG_WAITING", 1000)
    out, into = pipe
    writer = LogWriter(into)
    configure_logging("info", writer, as_json=False)
    log = logging.getLogger("rmpa.test")
    begin = time.monotonic()
    for _ in range(5000):
        log.info("x" * 200)
    assert time.monotonic() - begin < DEADLINE / 2
    assert writer.lost > 1000
    said = read(out, lambda got: b"were lost" in got)
    assert b"log lines were lost" in said
    assert writer.lost == 0
    log.info("and on")
    assert b"and on" in read(out, lambda got: b"and on" in got)
    writer.close()


def test_the_end_does_not_wait_for_ever(pipe: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "DRAIN_TIMEOUT", 0.05)
    out, into = pipe
    writer = LogWriter(into)
    writer.write("x" * (1 << 20))
    begin = time.monotonic()
    writer.close()
    assert time.monotonic() - begin < DEADLINE / 2
    monkeypatch.undo()
    assert len(read(out, lambda got: len(got) == 1 << 20)) == 1 << 20
    writer._thread.join(DEADLINE)
    assert not writer._thread.is_alive()


def test_a_pipe_that_is_gone_is_no_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    out, into = os.pipe()
    os.close(out)
    writer = LogWriter(into)
    writer.write("nobody reads this\n")
    writer.close()
    os.close(into)
    assert not writer._thread.is_alive()
