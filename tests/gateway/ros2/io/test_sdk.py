"""Topics between modules and programs of zenoh-ros2-sdk, by a real router: both must write the same format."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.config.rules import GatewaySettings
from rmpa.gateway.ros2.ros2 import Ros2Neighbour
from rmpa.ros.types.messages import MessageType
from tests.gateway.memory_graph import MemoryGraph
from tests.gateway.ros2.io.ros2_bed import STRING, find_none, string
from tests.gateway.zenoh_bed import bed, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from tests.gateway.zenoh_bed import ZenohBed

pytest.importorskip("zenoh_ros2_sdk")

pytestmark = pytest.mark.timeout(180)

GRIP = MessageType.learn("arm_msgs/Grip", "float64 width\nstring[] fingers")


class SdkProgram:
    """The program, in a process of its own."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self.heard: list[tuple[str, dict[str, Any]]] = []
        self._answers: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        self._reader = asyncio.ensure_future(self._read())

    async def _read(self) -> None:
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            if line.startswith(b"{"):
                answer = json.loads(line)
                if "heard" in answer:
                    self.heard.append((answer["heard"], answer["message"]))
                else:
                    self._answers.put_nowait(answer)

    async def do(self, what: str, **order: Any) -> dict[str, Any]:
        assert self._process.stdin is not None
        if what:
            self._process.stdin.write(json.dumps({"do": what} | order).encode() + b"\n")
            await self._process.stdin.drain()
        async with asyncio.timeout(60):
            return await self._answers.get()

    async def end(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            async with asyncio.timeout(20):
                await self._process.wait()
        except TimeoutError:
            self._process.kill()
            await self._process.wait()
        await self._reader


@contextlib.asynccontextmanager
async def program(net: ZenohBed) -> AsyncIterator[SdkProgram]:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "tests.gateway.ros2.io.sdk_program",
        str(net.port),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    made = SdkProgram(process)
    try:
        await made.do("")
        yield made
    finally:
        await made.end()


@contextlib.asynccontextmanager
async def gateway(net: ZenohBed) -> AsyncIterator[tuple[MemoryGraph, Ros2Neighbour]]:
    graph = MemoryGraph()
    neighbour = Ros2Neighbour(cast("Any", graph), await net.session(), GatewaySettings(), find=find_none)
    neighbour.start()
    try:
        yield graph, neighbour
    finally:
        await neighbour.close()


async def test_an_sdk_program_lists_and_hears_the_topics_of_modules() -> None:
    async with bed() as net, gateway(net) as (graph, _), program(net) as ros2:
        chatter, grip = graph.publisher("/chatter", STRING), graph.publisher("/grip", GRIP)
        topics: dict[str, Any] = {}
        while not {"/chatter", "/grip"} <= topics.keys():
            topics = (await ros2.do("list"))["topics"]
        assert topics["/chatter"] == ["std_msgs/msg/String"]
        assert topics["/grip"] == ["arm_msgs/msg/Grip"]
        info = (await ros2.do("info", topic="/chatter"))["info"]
        assert "talker" in info
        assert "/rmpa/arm" in info
        await ros2.do("listen", topic="/chatter")
        await ros2.do("listen", topic="/grip", type="arm_msgs/msg/Grip")
        await until(lambda: len(graph.taps) == 2, 60)
        for number in range(500):
            graph.send(chatter, string(f"message {number}"))
        graph.send(grip, GRIP.serialize(GRIP.make({"width": 0.25, "fingers": ["left", "right"]})))
        await until(lambda: len(ros2.heard) == 501, 60)
        texts = [message["data"] for topic, message in ros2.heard if topic == "/chatter"]
        assert texts == [f"message {number}" for number in range(500)]
        assert ("/grip", {"width": 0.25, "fingers": ["left", "right"]}) in ros2.heard


async def test_a_late_sdk_program_gets_the_latched_message_and_the_publisher_goes_on() -> None:
    async with bed() as net, gateway(net) as (graph, _), program(net) as ros2:
        source = graph.publisher("/map", STRING, latching=True)
        await ros2.do("listen", topic="/map", latched=True)
        await until(lambda: graph.taps, 60)
        graph.send(source, string("first"))
        await until(lambda: ("/map", {"data": "first"}) in ros2.heard, 60)
        async with program(net) as late:
            await late.do("listen", topic="/map", latched=True)
            await until(lambda: late.heard, 60)
            assert late.heard[0] == ("/map", {"data": "first"})
            for number in range(200):  # ros2/rmw_zenoh#710: a history that is replayed must not stop the publisher
                graph.send(source, string(f"{number}"))
            last = ("/map", {"data": "199"})
            await until(lambda: ros2.heard[-1] == late.heard[-1] == last, 60)
            assert len(ros2.heard) == len(late.heard) == 201


async def test_a_topic_of_an_sdk_program_is_heard_here() -> None:
    async with bed() as net, gateway(net) as (graph, neighbour), program(net) as ros2:
        await ros2.do("talk", topic="/from_ros2", node="talker", messages=[])
        await until(lambda: ("/from_ros2", "/talker") in graph.topics, 60)
        topic = graph.topics["/from_ros2", "/talker"]
        assert topic.source.type == "std_msgs/String"
        topic.on_demand(True)
        (imported,) = neighbour.topics.imports.values()
        assert imported.problem == ""
        # The subscription reaches the program some milliseconds later: a volatile topic promises nothing before.
        number = 0
        while not topic.messages:
            await ros2.do("talk", topic="/from_ros2", node="talker", messages=[{"data": f"try {number}"}])
            number += 1
        await ros2.do("talk", topic="/from_ros2", node="talker", messages=[{"data": f"{i}"} for i in range(500)])
        await until(lambda: topic.messages[-1] == string("499"), 60)  # tries may still come before them
        assert topic.messages[-500:] == [string(f"{i}") for i in range(500)]


async def test_a_type_of_an_sdk_program_that_a_module_publishes_too_is_known() -> None:
    async with bed() as net, gateway(net) as (graph, _), program(net) as ros2:
        graph.publisher("/grip", GRIP)
        await ros2.do("talk", topic="/grip2", type="arm_msgs/msg/Grip", node="gripper", messages=[])
        await until(lambda: ("/grip2", "/gripper") in graph.topics, 60)
        topic = graph.topics["/grip2", "/gripper"]
        await until(lambda: topic.description, 60)
        assert topic.description == GRIP.describe()
