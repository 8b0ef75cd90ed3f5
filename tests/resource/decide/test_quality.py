from __future__ import annotations

import struct

import pytest

from rmpa.resource.decide.quality import ObservedQuality, TopicQuality
from rmpa.resource.declare.attributes import Attribute, Direction, Scale

WALL = 1_700_000_000 * 1_000_000_000


def stamped(sequence: int, at: float) -> bytes:
    ns = WALL + round(at * 1e9)
    return struct.pack("<III", sequence, ns // 10**9, ns % 10**9) + b"\0" * 4


def feed(quality: TopicQuality, times: list[float], *, late: float = 0.0, first: int = 0) -> None:
    for number, now in enumerate(times):
        quality.message(stamped(first + number, now - late), now, WALL + round(now * 1e9))


def test_a_steady_stream() -> None:
    quality = TopicQuality(0.0, stamped=True, numbered=True, deadline=0.15)
    feed(quality, [0.1 * n for n in range(1, 11)], late=0.02)
    assert quality.window(1.0) == {
        "bandwidth": pytest.approx(160.0),
        "rate": pytest.approx(10.0),
        "period_sd": pytest.approx(0.0, abs=1e-6),
        "latency": pytest.approx(0.02),
        "age": pytest.approx(0.02),
        "deadline_misses": 0.0,
        "loss": 0.0,
    }


def test_the_deviation_of_the_period() -> None:
    quality = TopicQuality(0.0)
    feed(quality, [0.0, 0.1, 0.3, 0.4, 0.6])
    assert quality.window(0.6)["period_sd"] == pytest.approx(0.05)


def test_a_period_reaches_over_the_border_of_two_windows() -> None:
    quality = TopicQuality(0.0)
    feed(quality, [0.9])
    quality.window(1.0)
    feed(quality, [1.4])
    assert quality.window(1.5)["rate"] == pytest.approx(2.0)


def test_rate_falls_as_soon_as_messages_stop() -> None:
    quality = TopicQuality(0.0, deadline=0.15)
    feed(quality, [0.1, 0.2, 0.3])
    assert quality.window(1.3)["rate"] == pytest.approx(1.0)
    empty = quality.window(2.3)
    assert empty["rate"] == pytest.approx(0.5)
    assert empty["deadline_misses"] == 1.0
    assert empty["age"] == pytest.approx(2.0)
    assert "period_sd" not in empty


def test_a_stream_that_never_began_has_no_rate() -> None:
    assert TopicQuality(0.0, stamped=True, deadline=1.0).window(1.0) == {"bandwidth": 0.0, "rate": 0.0}


def test_gaps_in_the_numbers_are_losses_and_a_restart_is_none() -> None:
    quality = TopicQuality(0.0, stamped=True, numbered=True)
    feed(quality, [0.1, 0.2], first=5)
    feed(quality, [0.3, 0.4], first=9)
    assert quality.window(1.0)["loss"] == pytest.approx(2 / 6)
    feed(quality, [1.1, 1.2], first=0)
    assert quality.window(2.0)["loss"] == 0.0


def test_each_publisher_has_its_own_numbers() -> None:
    quality = TopicQuality(0.0, stamped=True, numbered=True)
    for number in range(5):
        for source, first in (("/left", 10), ("/right", 5000)):
            quality.message(stamped(first + number, 0.0), 0.1 * number, WALL, source)
    assert quality.window(1.0)["loss"] == 0.0


def test_under_another_profile_everything_begins_anew() -> None:
    quality = TopicQuality(0.0, deadline=0.15)
    feed(quality, [0.1, 0.4, 0.8])
    quality.restart(2.0)
    feed(quality, [2.1, 2.2, 2.3])
    found = quality.window(2.3)
    assert found["rate"] == pytest.approx(10.0)
    assert found["deadline_misses"] == 0.0
    accuracy = ObservedQuality(Attribute("accuracy", Direction.MIN, "m"))
    accuracy.observe(5.0)
    accuracy.restart()
    assert accuracy.window() is None


def test_numbers_go_round() -> None:
    quality = TopicQuality(0.0, stamped=True, numbered=True)
    feed(quality, [0.1], first=(1 << 32) - 1)
    feed(quality, [0.2], first=0)
    assert quality.window(1.0)["loss"] == 0.0


def test_misses_are_a_share() -> None:
    quality = TopicQuality(0.0, deadline=0.15)
    feed(quality, [0.1, 0.2, 0.4, 0.5, 0.6])
    assert quality.window(0.6)["deadline_misses"] == pytest.approx(1 / 4)


def test_what_has_no_stamp_has_no_latency() -> None:
    quality = TopicQuality(0.0, stamped=True)
    quality.message(struct.pack("<III", 1, 0, 0), 0.1, WALL)
    quality.message(b"short", 0.2, WALL)
    assert "latency" not in quality.window(1.0)


def test_observations_are_averaged_and_stand_until_the_next() -> None:
    accuracy = ObservedQuality(Attribute("accuracy", Direction.MIN, "m"))
    assert accuracy.window() is None
    for value in (1.0, 2.0, 3.0):
        accuracy.observe(value)
    assert accuracy.window() == 2.0
    assert accuracy.window() == 2.0
    accuracy.observe(8.0)
    assert accuracy.window() == 8.0
    frame = ObservedQuality(Attribute("frame", Direction.EXACT, scale=Scale.NOMINAL, words=("map", "odom")))
    frame.observe("map")
    frame.observe("odom")
    assert frame.window() == "odom"
