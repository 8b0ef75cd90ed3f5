from __future__ import annotations

import asyncio
import os
import struct
import time
from pathlib import Path
from typing import Any

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.description import read_description
from rmpa.resource.measuring import QualityMeasurement, TopicCounters, TopicQuality, count_missing
from rmpa.resource.quality import Bound, Requirement, Value
from rmpa.resource.resource import Resource
from rmpa.resource.saved import Clients
from rmpa.resource.values import read_zones
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import ARRAY_TYPE
from tests.resource.rig import ARRAY, ERROR, OK, STALE, listen, pairs, status
from tests.resource.test_actuation import running
from tests.waiting import until

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


# --- what other nodes publish

KIND = "sensor_msgs/CompressedImage"
HEAD = """
role = "sensing"
[node.cam]
[adaptation]
window = "100 ms"
settle = 0
[profile.only]
offers = { rate = "50 Hz" }
"""


def described(text: str) -> Any:
    return read_description((HEAD + text).encode(), Path("camera.resource.toml"))


async def talk(node: Node, topic: str, hertz: float, size: int = 0) -> asyncio.Task[None]:
    """Publish stamped messages at a rate."""
    publisher = await node.advertise(topic, KIND)
    data = bytes(size)

    async def run() -> None:
        async for _ in node.rate(hertz):
            seconds, nanoseconds = divmod(time.time_ns(), 10**9)
            publisher.publish(header={"stamp": {"sec": seconds, "nanosec": nanoseconds}}, data=data)

    return asyncio.create_task(run())


IMAGE = f'[output.image]\ntopic = "/cam/image"\ntype = "{KIND}"\n'


async def test_another_nodes_output_is_measured_and_missed(core: RosCore, node: Node) -> None:
    quality = await node.subscribe("/camera/quality", ARRAY)
    async with running(core, described(IMAGE)):
        missing = await status(quality, lambda s: s.level == STALE)
        assert missing.message.startswith("node /cam does not run; no node publishes /cam/image")
        async with Node("cam", master_uri=core.uri) as cam:
            talking = await talk(cam, "/cam/image", 50, 100)
            one = await status(quality, lambda s: s.level == OK and "latency" in pairs(s) and "period_sd" in pairs(s))
            assert 10 < float(pairs(one)["rate"].split()[0]) < 100
            assert pairs(one)["loss"] == "0"
            talking.cancel()
        gone = await status(quality, lambda s: s.level == STALE)
        assert "no node publishes /cam/image" in gone.message
        assert core.state().publishers.get("/cam/image") is None


async def test_much_data_is_counted_by_its_node(core: RosCore, node: Node) -> None:
    quality = await node.subscribe("/camera/quality", ARRAY)
    async with Node("cam", master_uri=core.uri) as cam, running(core, described(IMAGE)) as one:
        talking = await talk(cam, "/cam/image", 50, limits.MEASURED_BYTES)
        said = await status(quality, lambda s: "image.measured" in pairs(s))
        assert pairs(said)["image.measured"] == "by its node's counters"
        await until(lambda: "/camera" not in core.state().subscribers.get("/cam/image", ()))
        await status(quality, lambda s: "image.measured" in pairs(s) and "rate" not in pairs(s))  # no subscriber
        await listen(node, "/cam/image", KIND)
        counted = await status(quality, lambda s: "rate" in pairs(s) and "image.measured" in pairs(s))
        rate, size = (float(pairs(counted)[key].split()[0]) for key in ("rate", "bandwidth"))
        assert 5 < rate < 100
        assert size > rate * limits.MEASURED_BYTES
        await until(lambda: one.runtime.problems() == ([], []))
        talking.cancel()


async def test_a_required_input_is_looked_for_without_a_subscription(core: RosCore, node: Node) -> None:
    text = '[input.scan]\ntopic = "/scan"\ntype = "sensor_msgs/LaserScan"\n'
    async with running(core, described(IMAGE + text)) as one:
        await until(lambda: "no node publishes /scan" in one.runtime.problems()[0])
        await node.advertise("/scan", "sensor_msgs/LaserScan")
        await until(lambda: "no node publishes /scan" not in one.runtime.problems()[0])
        assert "/scan" not in core.state().subscribers


async def test_an_unknown_type_is_learnt_and_another_one_said(core: RosCore, node: Node) -> None:
    strange = await asyncio.to_thread(described, IMAGE.replace(KIND, "cam_msgs/Strange"))
    async with running(core, strange):  # it starts without the type
        pass
    async with running(core, described(IMAGE)) as one:
        publisher = await node.advertise("/cam/image", "std_msgs/String")
        await until(lambda: any("/cam/image: " in text for text in one.runtime.problems()[1]))
        await publisher.close()


def test_counters_give_a_rate_over_enough_messages() -> None:
    one = TopicCounters()
    assert one.window(0.0) == {}
    for second in range(6):  # one message of 100 bytes and its length each second, the second one late
        one.counted({"/a": {1: (second - (second == 2), 104 * (second - (second == 2)))}}, float(second))
    assert one.window(5.0) == {"rate": 1.0, "bandwidth": 100.0}
    one.restart(5.0)
    assert one.window(5.0) == {}
    one.counted({"/a": {1: (10, 1040)}}, 6.0)
    assert one.window(6.0) == {}  # it spans two profiles
    one.counted({"/a": {1: (14, 1456)}, "/b": {3: (1, 5)}}, 7.0)
    one.counted({"/a": {1: (16, 1664)}, "/b": {3: (4, 317)}}, 8.0)
    assert one.window(8.0) == {"rate": 9 / 2, "bandwidth": (400 + 200 + 300) / 2}
    one.counted({"/a": {}}, 9.0)
    assert one.window(9.0) == {}


async def test_figures_of_a_process_and_diagnostics_are_attributes(core: RosCore, node: Node) -> None:
    text = """
    role = "sensing"
    [node.cam]
    [adaptation]
    window = "100 ms"
    [profile.only]
    offers = {}
    [attribute.busy]
    better = "min"
    value = "cpu()"
    [attribute.held]
    better = "min"
    unit = "MB"
    value = "memory('cam') / 1000000"
    [attribute.heat]
    better = "min"
    unit = "°C"
    value = "diagnostics('cam: sensor', 'Temperature')"
    [attribute.level]
    better = "min"
    value = "diagnostics('cam: sensor')"
    [attribute.up]
    better = "max"
    value = "running('cam')"
    """
    quality = await node.subscribe("/camera/quality", ARRAY)
    async with running(core, read_description(text.encode(), Path("camera.resource.toml"))):
        said = await status(quality, lambda s: pairs(s).get("up") == "0")
        assert not {"busy", "held", "heat", "level"} & pairs(said).keys()
        async with Node("cam", master_uri=core.uri) as cam:
            diagnostics = await cam.advertise("/diagnostics", ARRAY_TYPE, latch=True)
            values = [{"key": "Temperature", "value": "61.5 C (case)"}]
            diagnostics.publish(status=[{"name": "cam: sensor", "level": 1, "values": values}])
            said = await status(quality, lambda s: {"busy", "held", "heat", "up"} <= pairs(s).keys())
            assert (pairs(said)["heat"], pairs(said)["level"], pairs(said)["up"]) == ("61.5 °C", "1", "1")
            held = float(pairs(said)["held"].split()[0]) * 1e6
            resident = int(Path(f"/proc/{os.getpid()}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
            assert 0.5 < held / resident < 2


def test_the_hottest_zone_of_a_type_counts(tmp_path: Path) -> None:
    for number, (kind, value) in enumerate([("cpu", "41000"), ("cpu", "55500"), ("gpu", "30000"), ("off", "")]):
        zone = tmp_path / f"thermal_zone{number}"
        zone.mkdir()
        (zone / "type").write_text(f"{kind}\n")
        (zone / "temp").write_text(f"{value}\n")
    assert read_zones(tmp_path) == {"cpu": 55.5, "gpu": 30.0}


async def test_a_rule_raises_an_alarm_and_bars_a_profile(core: RosCore, node: Node) -> None:
    text = """
    role = "acting"
    [adaptation]
    window = "100 ms"
    dwell = 0
    [profile.fast]
    offers = {}
    needs = "/battery/percentage > 0.5"
    [profile.slow]
    offers = {}
    cost = 1
    [alarm.low]
    when = "/battery/percentage < 0.2"
    level = "error"
    text = "the battery is nearly empty"
    """
    alarms = await node.subscribe("/base/alarms", ARRAY)
    quality = await node.subscribe("/base/quality", ARRAY)
    async with running(core, read_description(text.encode(), Path("base.resource.toml"))) as one:
        assert one.adapter.adaptation.profile == "fast"  # nothing is known yet
        battery = await node.advertise("/battery", "sensor_msgs/BatteryState", latch=True)
        battery.publish(percentage=0.1)
        raised = await status(alarms, lambda s: s.level == ERROR)
        assert raised.message == "the battery is nearly empty"
        assert pairs(raised) == {"alarm": "low", "rule": "/battery/percentage < 0.2", "cleared": "false"}
        await status(quality, lambda s: s.level == ERROR and s.message == "the battery is nearly empty")
        await until(lambda: one.adapter.adaptation.profile == "slow")
        assert one.adapter.decision()["scores"][0]["excluded"] == "its rule does not hold: /battery/percentage > 0.5"
        battery.publish(percentage=0.9)
        over = await status(alarms, lambda s: s.level == OK)
        assert over.message == "over: the battery is nearly empty"
        await until(lambda: not one.adapter.decision()["scores"][0]["excluded"])
        await status(quality, lambda s: s.level == OK)
