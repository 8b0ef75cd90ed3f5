from __future__ import annotations

import asyncio
import os
import time
from pathlib import Path
from typing import Any

from rmpa.resource import limits
from rmpa.resource.description import read_description
from rmpa.resource.measuring import TopicCounters
from rmpa.resource.values import read_zones
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import ARRAY_TYPE
from tests.resource.rig import ARRAY, ERROR, OK, STALE, listen, pairs, status
from tests.resource.test_actuation import running
from tests.waiting import until

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
