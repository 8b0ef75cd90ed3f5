"""Types that this machine does not know, or that only a workspace has."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, Final

import pytest

from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.resource_node import ResourceNode, run_all
from rmpa.ros import limits
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import SEPARATOR, DefinitionError, UnknownTypeError
from rmpa.ros.types.installed import packages_below
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import TopicDescription
from tests.ros.types.workspaces import package

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

NAME: Final = "my_msgs/Foo"
_HEADER: Final = f"{SEPARATOR}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
FOO: Final = MessageType.learn(NAME, f"Header header\nint32 a\n\n{_HEADER}")


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(limits, "TYPE_LOOK", 0.05)
    FOO.deserialize(FOO.serialize(FOO.make()))
    yield
    packages_below.cache_clear()


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


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
        member = ResourceNode(one, core.uri, window=0.1)
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
def of_a_workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Resource, list[int], asyncio.Event]:
    package(tmp_path / "stack" / "my_msgs", msg_Foo="Header header\nint32 a\n")
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    return made()


async def test_types_of_a_workspace(core: RosCore, of_a_workspace: tuple[Resource, list[int], asyncio.Event]) -> None:
    assert of_a_workspace[0].outputs["/out"].type.make().header.seq == 0  # known before it runs
    await run(core, *of_a_workspace)


@pytest.fixture
def of_nowhere() -> tuple[Resource, list[int], asyncio.Event]:
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
def ear() -> Resource:
    one = Resource("ear", role="sensing")
    one.input("/in", NAME)
    one.profile(offers={}, name="only")(lambda: None)
    return one


async def test_unusable_definition_is_reported_once(
    core: RosCore, ear: Resource, caplog: pytest.LogCaptureFixture
) -> None:
    async with Node("liar", master_uri=core.uri) as node, asyncio.timeout(30):
        publisher = await node.advertise("/in", TopicDescription(NAME, "0" * 32, "int32 a"))
        member = ResourceNode(ear, core.uri, window=0.1)
        await member.start()
        await publisher.wait_for_subscriber()
        for _ in range(5):
            publisher.publish_raw(bytes(4))
        while "messages are dropped" not in caplog.text:
            await asyncio.sleep(0.01)
        await publisher.drained()
        await member.close()
    assert caplog.text.count("its messages are dropped; this is said once") == 1
    assert ear.inputs["/in"].kind.known is None


def test_what_cannot_be_learnt_is_refused_where_it_is_written() -> None:
    one = Resource("eye", role="sensing")
    with pytest.raises(DefinitionError, match=r"did you mean sensor_msgs/Image\?"):
        one.output("sight", "sensor_msgs/Imagge")
    with pytest.raises(DefinitionError, match="is not a type's name; write it like std_msgs/String"):
        one.input("sight", "sensor_msgs/msg/Image")
    assert (one.outputs, one.inputs) == ({}, {})
