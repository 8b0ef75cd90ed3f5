"""What of a module's topics is recorded, and what is left out and counted."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from rmpa.config.settings import RecordSettings
from rmpa.core.facts import TopicInfo
from rmpa.record.capture import Capture
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from tests.record.conftest import TEXT

# A message is larger than what a second of such a budget allows: of several at once the first one is within it.
SMALL = 1
FREE: dict[str, Any] = {"topic_rate": None, "thin": None}


@pytest.mark.parametrize(
    ("given", "first", "others"),
    [
        ({}, 5, 5),
        ({"deny": ("/b",)}, 5, 0),
        ({"topic_rate": SMALL}, 1, 1),
        ({"total_rate": SMALL}, 1, 0),
        ({"thin": 0.001, "thin_types": ("std_msgs/*",)}, 1, 1),
        ({"thin": 0.001, "thin_types": ("sensor_msgs/*",)}, 5, 5),
    ],
)
async def test_topics_within_their_budgets(core: RosCore, given: dict[str, Any], first: int, others: int) -> None:
    taken: list[str] = []

    def put(source: Any, *_: object) -> bool:
        taken.append(source.topic)
        return True

    async with Node("talker", master_uri=core.uri) as talker, Node("ears", master_uri=core.uri) as ears:
        capture = Capture(ears, RecordSettings(**FREE | given), put, {})
        for topic, wanted in (("/a", first), ("/b", others)):
            publisher = await talker.advertise(topic, TEXT)
            told = [TopicInfo(name=name, publishers=("/talker",)) for name in ("/a", topic)]
            await capture.update(told)
            if not capture.wanted(topic):
                continue
            await asyncio.wait_for(publisher.wait_for_subscriber(), 30)
            for number in range(5):
                publisher.publish(data=f"{number}")
            async with asyncio.timeout(30):
                while capture.count[topic] + capture.left_out[topic] < 5:
                    await asyncio.sleep(0.01)
            assert (taken.count(topic), capture.count[topic], capture.left_out[topic]) == (wanted, wanted, 5 - wanted)
