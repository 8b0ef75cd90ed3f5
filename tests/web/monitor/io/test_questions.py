"""The search for names that the state of a large graph leaves out."""

from __future__ import annotations

from typing import Any

from rmpa.ros.wire.tcpros import TopicDescription
from rmpa.web.monitor.io.questions import Answers
from rmpa.web.monitor.io.resource_watch import ResourceWatch
from rmpa.web.monitor.io.values import MessageValues
from rmpa.web.monitor.session import Question
from tests.ros.node.peers import until
from tests.web.hub.client import local_core, node, running_hub


async def test_a_search_finds_topics_and_services_by_all_words_in_name_and_type() -> None:
    async with local_core() as core, running_hub(core) as hub, node(core, "robot") as robot:
        await robot.advertise("/arm/odom", TopicDescription("nav_msgs/Odometry", "0" * 32, ""))
        await robot.advertise("/base/odom_raw", TopicDescription("nav_msgs/Odometry", "0" * 32, ""))
        await until(lambda: {"/arm/odom", "/base/odom_raw"} <= hub.graph.topics.keys() and hub.graph.services)
        answers = Answers(hub, ResourceWatch(hub, MessageValues(hub)), {}, lambda: "")

        async def find(text: str) -> list[Any]:
            found: list[Any] = (await answers.answer(Question(1, "find", {"text": text})))["found"]
            return found

        arm = {"kind": "topic", "name": "/arm/odom", "type": "nav_msgs/Odometry"}
        raw = {"kind": "topic", "name": "/base/odom_raw", "type": "nav_msgs/Odometry"}
        assert await find("odom") == [arm, raw]
        assert await find("Odometry base") == [raw]
        service = next(name for name in hub.graph.services if name.endswith("/get_loggers"))
        assert {"kind": "service", "name": service} in [
            {"kind": each["kind"], "name": each["name"]} for each in await find(f"service {service}")
        ]
        assert await find("none") == await find(" ") == []
        answers.close()
