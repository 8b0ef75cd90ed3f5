from __future__ import annotations

import struct
from typing import Any

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource.measuring import QualityMeasurement, TopicQuality, count_missing
from rmpa.resource.quality import Bound, Requirement, Value
from rmpa.resource.resource import Resource
from rmpa.resource.saved import Clients

WALL = 1_700_000_000 * 1_000_000_000


def stamped(sequence: int, at: float) -> bytes:
    ns = WALL + round(at * 1e9)
    return struct.pack("<III", sequence, ns // 10**9, ns % 10**9) + b"\0" * 4


def feed(quality: TopicQuality, times: list[float], *, late: float = 0.0, first: int = 0) -> None:
    for number, now in enumerate(times):
        quality.message(stamped(first + number, now - late), now, WALL + round(now * 1e9))


TIMED: dict[str, Any] = {"deadline": 0.15}
NUMBERED: dict[str, Any] = {"stamped": True, "numbered": True}
Feed = tuple[list[float], int]


@pytest.mark.parametrize(
    ("options", "feeds", "windows"),
    [
        # Streams with the number of their first message, each up to a window; the window's end, and what it has.
        ({}, [([0.0, 0.1, 0.3, 0.4, 0.6], 0)], {0.6: {"period_sd": 0.05}}),
        ({}, [([0.9], 0), ([1.4], 0)], {1.0: {}, 1.5: {"rate": 2.0}}),  # a period reaches over the border of two
        (
            TIMED,  # the rate falls as soon as messages stop
            [([0.1, 0.2, 0.3], 0), ([], 0)],
            {1.3: {"rate": 1.0}, 2.3: {"rate": 0.5, "deadline_misses": 1.0, "age": 2.0, "period_sd": None}},
        ),
        (TIMED, [([0.1, 0.2, 0.4, 0.5, 0.6], 0)], {0.6: {"deadline_misses": 0.25}}),
        # Gaps in the numbers are losses, a restart is none, and numbers go round.
        (
            NUMBERED,
            [([0.1, 0.2, 0.3], 5), ([0.4], 11), ([1.1, 1.2], 0)],
            {0.35: {}, 1.0: {"loss": 0.75}, 2.0: {"loss": 0.0}},
        ),
        (NUMBERED, [([0.1], (1 << 32) - 1), ([0.2], 0)], {0.15: {}, 1.0: {"loss": 0.0}}),
    ],
)
def test_what_a_window_has(
    options: dict[str, Any], feeds: list[Feed], windows: dict[float, dict[str, float | None]]
) -> None:
    quality = TopicQuality(0.0, **options)
    for (times, first), (end, wanted) in zip(feeds, windows.items(), strict=True):
        feed(quality, times, first=first)
        found = quality.window(end)
        assert {name: found.get(name) for name in wanted} == pytest.approx(wanted)


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
    quality.restart(2.0)  # under another profile everything begins anew
    feed(quality, [2.1, 2.2, 2.3])
    found = quality.window(2.3)
    assert found["rate"] == pytest.approx(10.0)
    assert found["deadline_misses"] == 0.0
    assert TopicQuality(0.0, stamped=True, deadline=1.0).window(1.0) == {"bandwidth": 0.0, "rate": 0.0}


def test_each_publisher_has_its_own_numbers() -> None:
    quality = TopicQuality(0.0, stamped=True, numbered=True)
    for number in range(5):
        for source, first in (("/left", 10), ("/right", 5000)):
            quality.message(stamped(first + number, 0.0), 0.1 * number, WALL, source)
    assert quality.window(1.0)["loss"] == 0.0


def test_what_has_no_stamp_has_no_latency() -> None:
    quality = TopicQuality(0.0, stamped=True)
    quality.message(struct.pack("<III", 1, 0, 0), 0.1, WALL)
    quality.message(b"short", 0.2, WALL)
    assert "latency" not in quality.window(1.0)


def sonar() -> Resource:
    one = Resource("sonar", role="sensing")
    one.output("ranges", "std_msgs/Header")
    one.output("words", "std_msgs/String")
    one.input("/robot/scan", "std_msgs/String")
    one.attribute("noise", better="min", unit="m")
    one.attribute("frame", better="exact", scale="nominal", words=("map", "odom"))
    return one


def test_each_topic_is_measured_the_first_output_twice() -> None:
    one = QualityMeasurement(sonar(), 0.0)
    raw = struct.pack("<IIII", 1, 0, 0, 0)
    for number in range(1, 11):
        one.message("ranges", raw, number / 10, 0)
        one.message("/robot/scan", b"\0\0\0\0", number / 10, 0, "/laser")
    one.observe("noise", 0.02)
    one.observe("smell", 1.0)  # nobody declared it
    one.message("other", raw, 0.5, 0)
    found = one.window(1.0)
    assert found["rate"] == found["ranges.rate"] == 10.0
    assert found["scan.rate"] == 10.0
    assert found["words.rate"] == 0.0
    assert found["noise"] == 0.02
    shown = one.format(found)
    assert (shown["rate"], shown["scan.rate"], shown["noise"]) == ("10 Hz", "10 Hz", "0.02 m")
    assert not any(name.startswith("ranges.") for name in shown)


def test_another_profile_begins_another_window() -> None:
    one = QualityMeasurement(sonar(), 0.0)
    for number in range(1, 6):
        one.message("words", b"\0\0\0\0", number / 10, 0)
    one.observe("noise", 0.5)
    one.restart(0.5)
    assert "noise" not in one.window(1.5)


def test_a_resource_without_outputs_is_measured_by_its_inputs() -> None:
    ear = Resource("ear", role="controlling")
    ear.input("/scan", "std_msgs/String")
    one = QualityMeasurement(ear, 0.0)
    for number in range(1, 11):
        one.message("/scan", b"\0\0\0\0", number / 10, 0)
    found = one.window(1.0)
    assert "rate" not in found
    assert one.format(found)["scan.rate"] == "10 Hz"


def test_observations_are_averaged_and_stand_until_the_next() -> None:
    one = QualityMeasurement(sonar(), 0.0)
    assert "noise" not in one.window(1.0)
    for value in (1.0, 2.0, 3.0):
        one.observe("noise", value)
    one.observe("frame", "map")
    one.observe("frame", "odom")
    for now in (2.0, 3.0):
        found = one.window(now)
        assert (found["noise"], found["frame"]) == (2.0, "odom")
    one.observe("noise", 8.0)
    assert one.window(4.0)["noise"] == 8.0
    one.observe("noise", 5.0)
    one.restart(5.0)
    assert not {"noise", "frame"} & one.window(6.0).keys()


def camera() -> Resource:
    one = Resource("camera", role="sensing")
    one.output("frames", "std_msgs/String")
    one.attribute("light", better="exact", scale="nominal", words=("day", "night"))
    return one


@pytest.fixture
def observed() -> Clients:
    return Clients("camera", camera().attributes, 3.0)


def asks(client: str) -> dict[str, Requirement]:
    return {client: Requirement(client, {"rate": Bound()})}


def judged(observed: Clients, measured: dict[str, Value], client: str, now: float = 0.0) -> dict[str, Value]:
    return observed.worst(measured, asks(client), now)


def test_worse_of_measured_and_observed_counts(observed: Clients) -> None:
    observed.report("/viewer", [("rate", "4 Hz"), ("latency", "300 ms"), ("light", "night")], 0.0)
    sent: dict[str, Value] = {"rate": 20.0, "latency": 0.001, "loss": 0.0}
    assert judged(observed, dict(sent), "/viewer") == {"rate": 4.0, "latency": 0.3, "loss": 0.0, "light": "night"}
    assert judged(observed, {"rate": 3.0}, "/viewer")["rate"] == 3.0
    assert (observed["/viewer"].observed["rate"], observed["/other"].observed) == (4.0, {})


def test_reports_count_for_clients_and_expire(observed: Clients) -> None:
    observed.report("/viewer", [("rate", "4 Hz")], 0.0)
    assert judged(observed, {"rate": 20.0}, "/driver") == {"rate": 20.0}
    assert judged(observed, {"rate": 20.0}, "/viewer", 3.0) == {"rate": 4.0}
    assert judged(observed, {"rate": 20.0}, "/viewer", 3.1) == {"rate": 20.0}
    observed.report("/viewer", [("rate", "4 Hz")], 5.0)
    observed.forget_reports()
    assert judged(observed, {"rate": 20.0}, "/viewer", 5.0) == {"rate": 20.0}


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([("rat", "4 Hz")], "did you mean rate"),
        ([("rate", "4 m")], "unit of length"),
        ([("rate", "nan")], "rate"),
        ([("light", "dusk")], "day, night"),
        ([("rate", "4 Hz")] * 300, "more than 256"),
    ],
)
def test_invalid_report_keeps_the_previous_one(observed: Clients, values: list[tuple[str, str]], said: str) -> None:
    observed.report("/viewer", [("rate", "4 Hz")], 0.0)
    with pytest.raises(ConfigError, match=said):
        observed.report("/viewer", values, 1.0)
    assert observed["/viewer"].observed == {"rate": 4.0}


def test_missing_input_is_reported_once() -> None:
    windows: dict[str, int] = {}
    news = [count_missing(windows, texts) for texts in (["a"], [], ["a"], ["a", "b"], ["a", "b"], ["b"], [])]
    assert news == [[], [], [], [("a", True)], [("b", True)], [("a", False)], [("b", False)]]
