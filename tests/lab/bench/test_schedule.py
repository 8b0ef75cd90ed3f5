"""Streams on a schedule are read as they were sent: from when a message was due, with nothing hidden."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.bench import Bed
from lab.bench import schedule
from lab.bench.schedule import Arrivals, LatencyScore, Way, parse
from lab.frames import frame

if TYPE_CHECKING:
    from collections.abc import Sequence

MS = 1_000_000
COLUMNS = ("topic", "sequence", "due_ns", "came_ns")


def made(came: dict[int, float], *, sent: int = 10, late: Sequence[int] = ()) -> Arrivals:
    """Messages due every 10 ms; ``came`` says by sequence how many ms after that each arrived."""
    due = [10 * MS * sequence for sequence in came]
    there = [at + int(late * MS) for at, late in zip(due, came.values(), strict=True)]
    return Arrivals(sent, list(came), due, there, late or [0] * sent)


def test_the_lead_in_is_left_out_of_everything() -> None:
    rows = [("/t", 0, 100, 190), ("/t", 1, 200, 230), ("/t", 2, 300, 350), ("/t", 3, 400, 470)]
    arrivals = parse(frame(COLUMNS, rows), [5, 6, 7, 8], 2)
    assert (arrivals.sent, list(arrivals.sequence), list(arrivals.late)) == (2, [2, 3], [7, 8])
    assert arrivals.latencies() == [0.05, 0.07]
    assert arrivals.from_send() == pytest.approx([0.043, 0.062])


def test_latency_runs_from_when_a_message_was_due() -> None:
    arrivals = made({0: 1.0, 1: 31.0, 2: 21.0})
    assert arrivals.latencies() == [1000.0, 31_000.0, 21_000.0]


def test_lost_and_doubled_are_counted() -> None:
    arrivals = Arrivals(5, [0, 1, 1, 4], [0, 10, 10, 40], [1, 11, 12, 41], [0] * 5)
    assert (arrivals.lost, arrivals.doubled) == (2, 1)


def test_throughput_counts_what_came_between_two_moments() -> None:
    arrivals = made(dict.fromkeys(range(11), 0.0), sent=11)
    assert arrivals.bytes_per_second(1000, 0, 1000 * MS) == pytest.approx(100_000)
    assert arrivals.bytes_per_second(1000, 15 * MS, 45 * MS) == pytest.approx(100_000)


def test_a_message_that_never_came_is_past_every_deadline() -> None:
    score = LatencyScore()
    score.add(made({0: 0.5, 1: 2.0, 2: 0.5}, sent=4))
    assert score.later_than(1000.0) == 0.5


def test_one_bad_round_does_not_move_the_median_of_rounds() -> None:
    score = LatencyScore()
    for late in (0.3, 0.2, 900.0):
        score.add(made({0: 0.1, 1: late}))
    assert score.median_of_rounds(99.9) == 300.0


@pytest.mark.ros
def test_a_stream_keeps_its_schedule_and_its_numbers() -> None:
    with Bed() as bed:
        shell = bed.shell()
        shell.master()
        stream = Way("direct", "direct", shell, shell).stream(bed, "/paced")
        for size in (64, 100_000):
            arrivals = stream.run(size, 200.0, 0.5)
            assert (arrivals.sent, arrivals.lost, arrivals.doubled) == (100, 0, 0)
            assert min(arrivals.latencies()) > 0
            assert min(arrivals.from_send()) > 0
            assert list(arrivals.usage) == ["publisher", "receiver"]
            assert arrivals.total == 100 + round(200 * schedule.LEAD_IN)
