"""Figures from a node's own counts: wraps at 2**32, restarts, and what a library does not count."""

from __future__ import annotations

import pytest

from rmpa.observe import limits
from rmpa.observe.direct_traffic import TrafficMeter
from rmpa.ros.wire.bus import BusLink, BusTraffic

LINK = BusLink(7, "http://10.0.0.2:1/", True, "/cmd", True, 40000, ("10.0.0.2", 41234))
WRAP = 1 << 32


def meter(*counts: tuple[int, int | None], links: tuple[BusLink, ...] = ()) -> TrafficMeter:
    """A meter with one reading a second; of each the bytes and the messages."""
    made = TrafficMeter()
    for second, (size, messages) in enumerate(counts):
        link = links[second] if links else LINK
        made.take(link, BusTraffic(link.number, "/cmd", True, size, messages, 3), float(second))
    return made


def test_one_reading_gives_counts_and_no_rate() -> None:
    assert TrafficMeter().figures() is None
    made = meter((1000, 10))
    figures = made.figures()
    assert figures is not None
    assert (figures.messages, figures.bytes, figures.dropped, figures.rate, figures.bandwidth) == (
        10,
        1000,
        3,
        None,
        None,
    )
    assert not made.measured


def test_rate_and_bandwidth_are_those_between_the_readings() -> None:
    made = meter((1000, 10), (3000, 30), (5000, 50))
    figures = made.figures()
    assert figures is not None
    assert made.measured
    assert (figures.rate, figures.bandwidth, figures.messages, figures.window) == (20.0, 2000.0, 50, 2.0)


def test_only_the_last_readings_count() -> None:
    silent = [(0, 0)] * limits.DIRECT_SAMPLES
    figures = meter((0, 0), *silent, *((n * 100, n) for n in range(1, limits.DIRECT_SAMPLES))).figures()
    assert figures is not None
    assert (figures.rate, figures.window) == (1.0, limits.DIRECT_SAMPLES - 1)


def test_counts_that_wrap_go_on() -> None:
    figures = meter((WRAP - 1000, WRAP - 10), (1000, 10), (3000, 30)).figures()
    assert figures is not None
    assert (figures.rate, figures.bandwidth) == (20.0, 2000.0)
    assert (figures.messages, figures.bytes) == (WRAP + 30, WRAP + 3000)


@pytest.mark.parametrize(
    ("counts", "links"),
    [
        ([(9000, 90), (1000, 10), (2000, 20)], ()),
        ([(900, None), (100, None), (1100, None)], ()),
        (
            [(500, 5), (1000, 10), (2000, 20)],
            (LINK, *[BusLink(8, LINK.other, True, "/cmd", True, 40001, LINK.remote)] * 2),
        ),
        (
            [(500, 5), (1000, 10), (2000, 20)],
            (LINK, *[BusLink(7, LINK.other, True, "/cmd", True, 40001, LINK.remote)] * 2),
        ),
    ],
    ids=["restarted node", "without messages", "another number", "another port"],
)
def test_a_new_connection_begins_anew(counts: list[tuple[int, int | None]], links: tuple[BusLink, ...]) -> None:
    figures = meter(*counts, links=links).figures()
    assert figures is not None
    assert (figures.bandwidth, figures.window) == (1000.0, 1.0)
    assert figures.rate == (10.0 if counts[0][1] is not None else None)
