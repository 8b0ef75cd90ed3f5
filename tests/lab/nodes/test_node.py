from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING

import pytest

from lab.nodes.node import (
    HEAD,
    LEAD,
    Newest,
    Notes,
    first_due,
    sink_options,
    sleep_until,
    source_options,
    velocity_options,
)

if TYPE_CHECKING:
    from collections.abc import Callable

SECOND = 1_000_000_000


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Callable[[], list[dict[str, object]]]:
    return lambda: [json.loads(line[2:]) for line in capsys.readouterr().out.splitlines() if line.startswith("@ ")]


@pytest.mark.parametrize("now", [0, 12_345, 7 * SECOND + 1, 13_000 * SECOND + 999_999_999])
@pytest.mark.parametrize("phase", [0.0, 30.0, 99.9, 250.0])
def test_the_first_message_is_due_at_its_phase(now: int, phase: float) -> None:
    period = 1e8
    due = first_due(now, period, phase)
    assert now + LEAD - 10 <= due < now + LEAD + period + 10  # a float of such a size is a few ns off
    off = (due - phase * 1e6 + period / 2) % period - period / 2
    assert abs(off) < 100


def test_sleep_ends_at_the_moment_and_not_before() -> None:
    due = time.monotonic_ns() + 20_000_000
    sleep_until(due)
    assert time.monotonic_ns() >= due
    sleep_until(due)  # it is over: no sleep at all
    assert time.monotonic_ns() >= due


def test_newest_command_is_taken_once() -> None:
    newest: Newest[str] = Newest()
    assert newest.take() is None
    newest.put("first")
    newest.put("second")
    assert newest.take() == "second"
    assert newest.take() is None


def test_first_message_of_each_topic_is_said_and_the_first_after_a_pause(
    said: Callable[[], list[dict[str, object]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 5 * SECOND
    monkeypatch.setattr(time, "monotonic_ns", lambda: now)
    notes = Notes(["/cmd", "/vel"])
    data = HEAD.pack(1, 0, 0)
    notes.note(0, data)
    now += SECOND // 2
    notes.note(0, data)  # half a second is no pause yet
    notes.note(1, data)
    now += SECOND
    notes.note(0, data)
    assert said() == [
        {"event": "first", "topic": "/cmd", "came_ns": 5 * SECOND},
        {"event": "first", "topic": "/vel", "came_ns": 5 * SECOND + SECOND // 2},
        {"event": "again", "topic": "/cmd", "came_ns": now, "gap_ns": SECOND},
    ]


def test_options_have_the_defaults_of_the_nodes_in_cpp() -> None:
    source, velocity, sink = (made("").parse_args([]) for made in (source_options, velocity_options, sink_options))
    assert (source.topic, source.queue, source.phase) == ("/cmd", 100, None)
    assert (velocity.cmd, velocity.vel, velocity.mode, velocity.rate) == ("/cmd", "/vel", "event", 10.0)
    assert (sink.topics, sink.queue, sink.nodelay) == (["/cmd", "/vel"], 1000, False)
