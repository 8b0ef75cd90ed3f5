from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import LocalProtocolError
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.descriptor import Descriptor
from rmpa.resource.run.runtime import Runtime, RuntimePart
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.messages import MessageError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.resource.declare.parameters import Input, Output
    from rmpa.ros.node.endpoints import Received


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


@pytest.fixture
def one() -> Resource:
    one = Resource("speaker", role="acting")
    one.output("words", "std_msgs/String")
    one.input("/orders", "std_msgs/String")
    one.attribute("volume", better="max", unit="W")
    return one


class Ear(RuntimePart):
    def __init__(self) -> None:
        self.heard: list[tuple[str, object]] = []
        self.change = asyncio.Event()

    def note(self, kind: str, what: object) -> None:
        self.heard.append((kind, what))
        self.change.set()

    async def until(self, *kinds: str) -> None:
        async with asyncio.timeout(20):
            while [kind for kind, _ in self.heard] != list(kinds):
                self.change.clear()
                await self.change.wait()

    def published(self, output: Output, raw: bytes, now_ns: int) -> None:
        self.note("published", output.name)

    def received(self, item: Input, message: Received) -> None:
        self.note("received", message.message.data)

    def observed(self, attribute: str, value: object) -> None:
        self.note("observed", value)


async def test_a_resource_is_an_ordinary_node_of_its_core(core: RosCore, one: Resource) -> None:
    runtime = Runtime(one, Node("speaker", master_uri=core.uri))
    ear = Ear()
    await runtime.start([ear])
    async with Node("listener", master_uri=core.uri) as node, asyncio.timeout(20):
        words = await node.subscribe("/speaker/words", "std_msgs/String")
        described = await node.subscribe("/speaker/descriptor", "std_msgs/String")
        async for received in described:
            assert Descriptor.parse(received.message.data) == runtime.descriptor
            break
        while not runtime._publishers["words"].subscribers:
            await runtime._publishers["words"].wait_for_subscriber()
        one.outputs["words"].publish(data="from the loop")
        await asyncio.to_thread(one.outputs["words"].publish, data="from a thread")
        said = []
        async for received in words:
            said.append(received.message.data)
            if len(said) == 2:
                break
        assert said == ["from the loop", "from a thread"]
        orders = await node.advertise("/orders", "std_msgs/String")
        await orders.wait_for_subscriber()
        orders.publish(orders.make({"data": "louder"}))
        one.declared_attributes["volume"].observe(3.0)
        await ear.until("published", "published", "observed", "received")
    await runtime.close()
    assert "/speaker" not in core.state().nodes
    with pytest.raises(LocalProtocolError, match="does not run"):
        one.outputs["words"].publish(data="too late")


async def test_publish_refuses_a_message_of_another_type(core: RosCore, one: Resource) -> None:
    runtime = Runtime(one, Node("speaker", master_uri=core.uri))
    await runtime.start()
    words = one.outputs["words"]
    try:
        with pytest.raises(MessageError, match="date"):
            words.publish(date="x")
        with pytest.raises(MessageError, match="words: data is a string, not <object"):
            words.publish(object())
        with pytest.raises(MessageError, match="words: std_msgs/String: a message and fields"):
            words.publish(words.type.make({"data": "x"}), data="y")
    finally:
        await runtime.close()


async def test_messages_are_held_while_a_profile_is_applied(core: RosCore, one: Resource) -> None:
    runtime = Runtime(one, Node("speaker", master_uri=core.uri))
    ear = Ear()
    await runtime.start([ear])
    words = one.outputs["words"]
    try:
        runtime.hold()
        words.publish(data="1")
        assert ear.heard == []
        runtime.release()
        assert ear.heard == [("published", "words")]
        runtime.hold()
        words.publish(data="of a profile that failed")
        runtime.release(drop=True)
        assert len(ear.heard) == 1
    finally:
        await runtime.close()


async def test_held_messages_are_bounded_drop_oldest(
    core: RosCore, one: Resource, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.resource.limits.RESOURCE_HELD_MAX", 40)
    runtime = Runtime(one, Node("speaker", master_uri=core.uri))
    ear = Ear()
    await runtime.start([ear])
    try:
        runtime.hold()
        for _ in range(10):
            one.outputs["words"].publish(data="0123456789")  # 14 bytes
        runtime.release()
        assert ear.heard == [("published", "words")] * 2
    finally:
        await runtime.close()


async def test_messages_are_numbered_so_that_losses_are_seen(core: RosCore) -> None:
    nose = Resource("nose", role="sensing")
    smells = nose.output("smells", "sensor_msgs/Range")
    runtime = Runtime(nose, Node("nose", master_uri=core.uri))
    sent: list[int] = []

    class Eye(RuntimePart):
        def published(self, output: Output, raw: bytes, now_ns: int) -> None:
            sent.append(int.from_bytes(raw[:4], "little"))

    await runtime.start([Eye()])
    try:
        again = smells.type.make({"range": 1.0})
        smells.publish(range=1.0)
        smells.publish(again)
        smells.publish(again)
        assert sent == [1, 2, 3]
    finally:
        await runtime.close()
