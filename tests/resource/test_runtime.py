from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from rmpa.resource.declare import DeclaredTopic
from rmpa.resource.node import ResourceNode, run_all
from rmpa.resource.resource import Resource
from rmpa.resource.runtime import Runtime
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import SEPARATOR, UnknownTypeError
from rmpa.ros.types.installed import packages_below
from rmpa.ros.types.messages import MessageError, MessageType
from rmpa.ros.wire.tcpros import TopicDescription
from tests.ros.types.workspaces import package


@pytest.fixture
def speaker() -> Resource:
    one = Resource("speaker", role="acting")
    one.output("words", "std_msgs/String")
    one.input("/orders", "std_msgs/String")
    one.attribute("volume", better="max", unit="W")
    return one


class Ear:
    """Keeps the outputs on which was published, and the first bytes of each message."""

    def __init__(self, runtime: Runtime) -> None:
        self.heard: list[tuple[str, int]] = []
        runtime.listeners.append(self._hear)

    def _hear(self, topic: DeclaredTopic, raw: bytes, *_: object) -> None:
        self.heard.append((topic.name, int.from_bytes(raw[:4], "little")))


@pytest.fixture
async def running(core: RosCore, speaker: Resource) -> AsyncIterator[tuple[Runtime, Ear]]:
    runtime = Runtime(speaker, Node("speaker", master_uri=core.uri))
    await runtime.start()
    yield runtime, Ear(runtime)
    await runtime.close()


@pytest.mark.usefixtures("running")
async def test_publish_refuses_a_message_of_another_type(speaker: Resource) -> None:
    words = speaker.outputs["words"]
    with pytest.raises(MessageError, match="date"):
        words.publish(date="x")
    with pytest.raises(MessageError, match="words: data: is a string, not <object"):
        words.publish(object())
    with pytest.raises(MessageError, match="words: std_msgs/String: a message and fields"):
        words.publish(words.type.make({"data": "x"}), data="y")


async def test_messages_are_held_while_a_profile_is_applied(
    running: tuple[Runtime, Ear], speaker: Resource, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.resource.limits.RESOURCE_HELD_MAX", 40)
    runtime, ear = running
    words = speaker.outputs["words"]
    runtime.hold()
    words.publish(data="1")
    assert ear.heard == []
    runtime.release()
    assert ear.heard == [("words", 1)]
    runtime.hold()
    words.publish(data="of a profile that failed")
    runtime.release(drop=True)
    assert len(ear.heard) == 1
    runtime.hold()
    for _ in range(10):
        words.publish(data="0123456789")  # 14 bytes: the oldest are dropped
    runtime.release()
    assert ear.heard == [("words", 1), ("words", 10), ("words", 10)]


async def test_messages_are_numbered_so_that_losses_are_seen(core: RosCore) -> None:
    nose = Resource("nose", role="sensing")
    smells = nose.output("smells", "sensor_msgs/Range")
    runtime = Runtime(nose, Node("nose", master_uri=core.uri))
    ear = Ear(runtime)
    await runtime.start()
    try:
        again = smells.type.make({"range": 1.0})
        smells.publish(range=1.0)
        smells.publish(again)
        smells.publish(again)
        assert ear.heard == [("smells", 1), ("smells", 2), ("smells", 3)]
    finally:
        await runtime.close()


# --- types that this machine does not know, or that only a workspace has


NAME: Final = "my_msgs/Foo"
_HEADER: Final = f"{SEPARATOR}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
FOO: Final = MessageType.learn(NAME, f"Header header\nint32 a\n\n{_HEADER}")


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("rmpa.resource.node.TYPE_LOOK", 0.05)
    FOO.deserialize(FOO.serialize(FOO.make()))
    yield
    packages_below.cache_clear()


def made() -> tuple[Resource, list[int], asyncio.Event]:
    """Repeats what it hears on /in, twice as much, on /out."""
    one = Resource("twice", role="controlling")
    heard, change = list[int](), asyncio.Event()
    source = one.input("/in", NAME)
    said = one.output("/out", NAME, latch=True)

    @one.profile(offers={"rate": 1})
    def plain() -> None: ...

    @one.task(on=source)
    async def repeat(message: Any) -> None:
        heard.append(message.a)
        change.set()
        said.publish(a=2 * message.a)

    return one, heard, change


async def run(core: RosCore, one: Resource, heard: list[int], change: asyncio.Event) -> None:
    """Hear a message, and what becomes of it, once the resource is active."""
    async with Node("around", master_uri=core.uri) as node:
        publisher = await node.advertise("/in", FOO)
        results = await node.subscribe("/out", FOO)
        member = ResourceNode(one, core.uri)
        await member.start()
        async with asyncio.timeout(30):
            await publisher.wait_for_subscriber()
            publisher.publish(publisher.make({"a": 21}))
            await change.wait()
            assert heard == [21]
            assert (await anext(aiter(results))).message.a == 42
        assert one.inputs["/in"].type.md5sum == one.outputs["/out"].type.md5sum == FOO.md5sum
        await member.close()


@pytest.fixture
def of_a_workspace(
    quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[Resource, list[int], asyncio.Event]:
    package(tmp_path / "stack" / "my_msgs", msg_Foo="Header header\nint32 a\n")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    return made()


async def test_types_of_a_workspace(core: RosCore, of_a_workspace: tuple[Resource, list[int], asyncio.Event]) -> None:
    assert of_a_workspace[0].outputs["/out"].type.make().header.seq == 0  # known before it runs
    await run(core, *of_a_workspace)


@pytest.fixture
def of_nowhere(quick: None) -> tuple[Resource, list[int], asyncio.Event]:
    return made()


async def test_types_are_learnt_from_a_publisher(
    core: RosCore, of_nowhere: tuple[Resource, list[int], asyncio.Event]
) -> None:
    one = of_nowhere[0]
    with pytest.raises(UnknownTypeError, match="looked in ROS_PACKAGE_PATH"):
        one.outputs["/out"].type.make()
    await run(core, *of_nowhere)


async def test_it_waits_for_a_publisher_and_holds_up_no_other(
    core: RosCore, of_nowhere: tuple[Resource, list[int], asyncio.Event], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    other = Resource("other", role="acting")
    active, ready, stop = asyncio.Event(), asyncio.Event(), asyncio.Event()
    other.profile(offers={}, name="only")(lambda: None)
    loop = asyncio.get_running_loop()

    @other.on("activate")
    def activated() -> None:
        loop.call_soon_threadsafe(active.set)

    running = asyncio.create_task(run_all([of_nowhere[0], other], core.uri, stop, ready.set))
    async with asyncio.timeout(30), Node("camera", master_uri=core.uri) as camera:
        await active.wait()
        while "waits for the type" not in caplog.text:
            await asyncio.sleep(0.01)
        assert not ready.is_set()
        await camera.advertise("/elsewhere", FOO)
        await ready.wait()
        stop.set()
        await running
    assert (
        caplog.text.count("! /twice waits for the type of output /out: message type my_msgs/Foo: is not known") == 1
    )
    assert "= /twice: my_msgs/Foo is learnt from /camera, which publishes /elsewhere" in caplog.text


async def test_it_ends_while_it_waits(
    core: RosCore, of_nowhere: tuple[Resource, list[int], asyncio.Event], caplog: pytest.LogCaptureFixture
) -> None:
    stop = asyncio.Event()
    running = asyncio.create_task(run_all([of_nowhere[0]], core.uri, stop, lambda: None))
    async with asyncio.timeout(30):
        while "waits for the type" not in caplog.text:
            await asyncio.sleep(0.01)
        stop.set()
        await running
    assert "/twice" not in str(core.state())


@pytest.fixture
def ear(quick: None) -> Resource:
    one = Resource("ear", role="sensing")
    one.input("/in", NAME)
    one.profile(offers={}, name="only")(lambda: None)
    return one


async def test_unusable_definition_is_reported_once(
    core: RosCore, ear: Resource, caplog: pytest.LogCaptureFixture
) -> None:
    async with Node("liar", master_uri=core.uri) as node, asyncio.timeout(30):
        publisher = await node.advertise("/in", TopicDescription(NAME, "0" * 32, "int32 a"))
        member = ResourceNode(ear, core.uri)
        await member.start()
        await publisher.wait_for_subscriber()
        for _ in range(5):
            publisher.publish_raw(bytes(4))
        while "messages are dropped" not in caplog.text:
            await asyncio.sleep(0.01)
        await publisher.drained()
        await member.close()
    assert caplog.text.count("its messages are dropped; this is said once") == 1
    assert ear.inputs["/in"].known is None
