from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

import pytest

from rmpa.resource import limits
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.adapter import HungError
from rmpa.resource.run.resource_node import ResourceNode
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node

if TYPE_CHECKING:
    from collections.abc import AsyncIterator


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


class Arm:
    """A resource with profiles and a context that hang; its last message brings the actor to a stop."""

    def __init__(self) -> None:
        self.resource = Resource("arm", role="acting")
        self.speed = self.resource.output("speed", "std_msgs/String")
        self.goes_on = threading.Event()
        self.resource.profile(offers={}, name="slow")(lambda: None)
        self.resource.profile(offers={}, name="thread")(self.hang)
        self.resource.profile(offers={}, name="coroutine")(self.sleep)
        self.resource.context("docked", enter=self.hang)
        self.resource.adaptation(window="100 ms", apply_timeout="200 ms", dwell=0)
        self.resource.on("deactivate")(lambda: self.speed.publish(data="stop"))

    def hang(self) -> None:
        self.speed.publish(data="go")
        self.goes_on.wait(30)

    async def sleep(self) -> None:
        self.speed.publish(data="go")
        await asyncio.sleep(30)


@pytest.mark.parametrize(("what", "name"), [("profile", "thread"), ("profile", "coroutine"), ("context", "docked")])
async def test_a_function_that_hangs_ends_the_resource_with_an_alarm(
    core: RosCore, monkeypatch: pytest.MonkeyPatch, what: str, name: str
) -> None:
    monkeypatch.setattr(limits, "CONTEXT_ENTER_TIMEOUT", 0.2)
    arm, hung = Arm(), asyncio.Event()
    member = ResourceNode(arm.resource, core.uri, on_hung=hung.set)
    await member.start()
    async with asyncio.timeout(30), Node("client", master_uri=core.uri) as node:
        speeds = await node.subscribe("/arm/speed", "std_msgs/String")
        alarms = await node.subscribe("/arm/alarms", "diagnostic_msgs/DiagnosticArray")
        while not (speeds.publishers and alarms.publishers):
            await asyncio.sleep(0.01)
        if what == "profile":
            member.adapter.pin(name)
            await member.adapter.settled()
        else:
            with pytest.raises(HungError):
                await member.contexts.choose(name)
        await hung.wait()
        text = f"the function of {what} {name} has not returned within 0.2 s; the resource ends"
        alarm = (await anext(aiter(alarms))).message.status[0]
        assert alarm.level == 2
        assert alarm.message.startswith(text)
        await member.close()
        # What the function published before it hung is not sent; ``deactivate`` still reaches the actor.
        assert (await anext(aiter(speeds))).message.data == "stop"
    arm.goes_on.set()


async def test_a_first_profile_that_hangs_ends_the_start(core: RosCore) -> None:
    arm = Arm()
    member = ResourceNode(arm.resource, core.uri)
    member.adapter.preset("thread")
    with pytest.raises(HungError, match="profile thread has not returned within"):
        await member.start()
    assert member.ended.is_set()
    arm.goes_on.set()
