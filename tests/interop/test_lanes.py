"""A command is not late because of an image: two lanes on a cable of 100 Mbit/s, between real nodes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from tests.interop.modules import flows
from tests.interop.recordings import connected, in_order, recorded, wait_last

if TYPE_CHECKING:
    from pathlib import Path

    from tests.interop.conftest import ModuleFactory
    from tests.interop.modules import Module

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(120)]

MBIT = 100
IMAGE = 1 << 20
COMMANDS = 400
"""At 100 Hz."""
RULES = """
[[contract]]
topics = ["/urgent"]
priority = "high"
[[contract]]
topics = ["/later"]
priority = "low"
"""


def lanes(module: Module, topic: str) -> list[str]:
    """The lane of each route of a topic, as ``rmpa topic info --json`` says."""
    code, output = module.agent.rmpa("topic", "info", topic, "--json")
    assert code == 0, output
    return [str(route["lane"]) for route in json.loads(output)["mesh"]["routes"]]


def test_commands_cross_a_cable_that_images_fill(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b", config=RULES)
    for module in (a, b):
        module.host.shape(f"{MBIT}mbit", bands=True)
    images = b.ros.roscpp("listener", "__name:=eye", topic="/image", queue=2)
    # The same commands on the lane of the images: what the express lane spares them, whatever else the machine does.
    topics = ("/command", "/later")
    recorders = [b.ros.roscpp("recorder", topic=topic, nodelay=True, commands=True) for topic in topics]
    # More than the cable carries, so that an image is always waiting.
    a.ros.roscpp("talker", "__name:=camera", topic="/image", size=IMAGE, rate=15, queue=2, wait=1)
    flows(images, 3)
    tellers = [a.ros.roscpp("teller", topic=topic, nodelay=True, wait=1, commands=True) for topic in topics]
    for teller in tellers:
        teller.wait_event("connected")
    for teller in tellers:
        teller.tell(f"64 {COMMANDS} 100")
    for teller, recorder in zip(tellers, recorders, strict=True):
        teller.wait_event("told")
        wait_last(recorder, COMMANDS)
    after = images.events("report")[-1]
    rows, behind = (recorded(recorder, tmp_path) for recorder in recorders)
    in_order(rows, COMMANDS)
    # Behind one image in one queue a command waits for up to 84 ms, and for 42 ms on the average.
    ages, late = (sorted(row.age for row in each) for each in (rows, behind))
    assert late[len(late) // 2] > 0.02, "the cable is full"
    assert ages[COMMANDS // 2] < late[len(late) // 2] / 2
    assert ages[COMMANDS * 9 // 10] < late[len(late) * 9 // 10]
    assert after["bad"] == 0
    for module in (a, b):
        assert lanes(module, "/command") == ["express"]
        assert lanes(module, "/image") == lanes(module, "/later") == ["bulk"]


def test_a_topic_of_small_and_large_messages_keeps_its_order(modules: ModuleFactory, tmp_path: Path) -> None:
    a, b = modules("a", "b")
    for module in (a, b):
        module.host.shape(f"{MBIT}mbit", bands=True)
    recorders = [
        b.ros.node(kind, "recorder", topic="/mixed", nodelay=True, commands=True) for kind in ("rospy", "roscpp")
    ]
    teller = a.ros.roscpp("teller", topic="/mixed", nodelay=True, wait=1, commands=True)
    teller.wait_event("connected")
    first = told = connected(teller, recorders)
    assert lanes(b, "/mixed") == ["express"]
    for recorder in recorders:
        recorded(recorder, tmp_path)  # one may have missed what was sent before it was connected
    # 200 KB at 100 Hz would be 160 Mbit/s; each fifth are 32 Mbit/s, still under way when small ones follow. A row
    # of small ones takes the topic back to the express lane, 5 s after the last large one.
    for sizes, count, rate, lane in (
        ("100,100,204800,100,100", 200, 100, "bulk"),
        ("100", 1200, 200, "express"),
        ("100,204800,100,100,100", 200, 100, "bulk"),
    ):
        since = teller.mark_events()
        teller.tell(f"{sizes} {count} {rate}")
        teller.wait_event("told", since=since)
        told += count
        for recorder in recorders:
            wait_last(recorder, told)
        assert lanes(a, "/mixed") == [lane]
    for recorder in recorders:
        in_order(recorded(recorder, tmp_path), told, after=first)


def test_a_contract_decides_the_lane(modules: ModuleFactory) -> None:
    a, b = modules("a", "b", config=RULES)
    for topic, size, lane in (("/urgent", 200_000, "express"), ("/later", 64, "bulk")):
        heard = b.ros.roscpp("listener", topic=topic)
        a.ros.roscpp("talker", topic=topic, size=size, rate=20, wait=1)
        assert flows(heard, 20)["bad"] == 0
        assert lanes(a, topic) == lanes(b, topic) == [lane]
