"""Smart Resources of nodes that exist: Debian's rospy with its dynamic_reconfigure, unchanged."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from lab.bed.processes import Event, Process
from rmpa.resource import limits
from rmpa.resource.description import read_description
from rmpa.resource.node import ResourceNode
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from tests.interop.ros import Ros
from tests.resource.rig import ARRAY, DEADLINE, pairs, status
from tests.waiting import until

pytestmark = [pytest.mark.ros, pytest.mark.timeout(120)]

CAMERA: Final = """
role = "sensing"
[node.driver]
name = "/usb_cam"
[output.image]
topic = "/usb_cam/image"
type = "sensor_msgs/CompressedImage"
[parameter.fps]
dynamic = "int_"
default = 5
low = 1
high = 100
[parameter.gain]
dynamic = "double_"
default = 1.0
[profile.full]
set = { fps = 10, gain = 2 }
offers = { rate = "10 Hz" }
cost = 2
[profile.small]
set = { fps = 5, gain = 1 }
offers = { rate = "5 Hz" }
[profile.wild]
set = { gain = 3, fps = 60 }
offers = { rate = "60 Hz" }
cost = 9
[adaptation]
window = "500 ms"
settle = "500 ms"
"""


@asynccontextmanager
async def camera(core: RosCore, node: Node) -> AsyncIterator[tuple[ResourceNode, Any]]:
    """The resource, and what it says of its quality."""
    one = ResourceNode(read_description(CAMERA.encode(), Path("camera.resource.toml")), core.uri)
    quality = await node.subscribe("/camera/quality", ARRAY)
    await one.start()
    try:
        yield one, quality
    finally:
        await one.close()


async def driver(ros: Ros, **options: Any) -> Process:
    made = ros.rospy("tunable", name="usb_cam", **options)
    await made.expect_event("up")
    return made


async def configured(process: Process, fps: int, gain: float, since: int = 0) -> Event:
    return await process.expect_event("config", where=lambda e: (e["int_"], e["double_"]) == (fps, gain), since=since)


async def test_a_drivers_values_are_set_read_back_and_respected(core: RosCore, ros: Ros, node: Node) -> None:
    process = await driver(ros)
    async with camera(core, node) as (one, quality):
        assert one.adapter.adaptation.profile == "small"
        await configured(process, 5, 1.0)
        await one.configuration.set({"profile": "full"})
        await configured(process, 10, 2.0)
        seen = await status(quality, lambda s: 9 < float(pairs(s).get("rate", "0").split()[0]) < 11)
        assert float(pairs(seen)["latency"].split()[0]) < 1
        assert pairs(seen)["loss"] == "0"

        since = process.mark_events()
        with pytest.raises(Exception, match=r"node /usb_cam refused: fps: wanted 60, got 10"):
            await one.configuration.set({"profile": "wild"})  # the server clips to 10
        await configured(process, 10, 2.0, since)  # undone
        assert one.adapter.adaptation.profile == "full"

        operator = ros.rospy("configurer", name="rqt", server="/usb_cam", commands=True)
        await operator.expect_event("up")
        operator.tell(json.dumps({"int_": 7}))
        await until(lambda: one.adapter.decision()["by_hand"] == {"fps": 7})
        await one.configuration.set({"gain": 1.5})
        await configured(process, 7, 1.5)

        process.kill()
        await until(lambda: "node /usb_cam does not run" in one.runtime.problems()[0])
        again = await driver(ros)
        await configured(again, 7, 1.5)
        await one.configuration.set({"profile": ""})
        await configured(again, 5, 1.0)


@pytest.mark.long
async def test_large_images_are_counted_by_the_driver(core: RosCore, ros: Ros, node: Node) -> None:
    await driver(ros, size=2 * limits.MEASURED_BYTES)
    viewer = ros.start("rostopic", "hz", "/usb_cam/image")
    async with camera(core, node) as (_, quality):
        seen = await status(quality, lambda s: "image.measured" in pairs(s) and "rate" in pairs(s))
        assert pairs(seen)["image.measured"] == "by its node's counters"
        await until(lambda: "/camera" not in core.state().subscribers.get("/usb_cam/image", ()), within=DEADLINE)
        await status(quality, lambda s: 4 < float(pairs(s).get("rate", "0").split()[0]) < 6)
    viewer.end()
