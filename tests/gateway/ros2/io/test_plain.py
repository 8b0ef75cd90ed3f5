"""A plain Zenoh program beside the neighbour ROS 2: the keys and bytes are what docs say."""

from __future__ import annotations

import asyncio
import sys

import pytest

from tests.gateway.ros2.io.ros2_bed import STRING, string
from tests.gateway.ros2.io.test_sdk import gateway
from tests.gateway.zenoh_bed import bed, until

pytest.importorskip("zenoh")


async def test_a_plain_program_is_heard_and_hears() -> None:
    async with bed() as net, gateway(net) as (graph, _):
        source = graph.publisher("/chatter", STRING)
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "tests.gateway.ros2.io.plain_program", str(net.port), "plain_talk", "chatter",
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        assert process.stdout is not None
        try:
            async with asyncio.timeout(60):
                assert await process.stdout.readline() == b"ready\n"
            await until(lambda: ("/plain_talk", "/plain") in graph.topics and graph.taps, 60)
            graph.topics["/plain_talk", "/plain"].on_demand(True)
            graph.send(source, string("hello"))
            async with asyncio.timeout(60):
                heard = bytes.fromhex((await process.stdout.readline()).decode())
            assert heard == b"\0\1\0\0\x06\0\0\0hello\0"
            messages = graph.topics["/plain_talk", "/plain"].messages
            await until(lambda: len(messages) >= 20, 60)
            assert messages[:20] == [string(str(number)) for number in range(20)]
        finally:
            process.kill()
            await process.wait()


async def test_the_topics_of_a_killed_program_are_gone() -> None:
    async with bed() as net, gateway(net) as (graph, _):
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "tests.gateway.ros2.io.plain_program", str(net.port), "plain_talk", "chatter",
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.DEVNULL,
        )  # fmt: skip
        try:
            await until(lambda: graph.topics, 60)
        finally:
            process.kill()
            await process.wait()
        await until(lambda: not graph.topics, 60)
