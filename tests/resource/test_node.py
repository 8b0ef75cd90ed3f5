from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest

from rmpa.core.errors import ConfigError, LocalProtocolError, PeerRefused
from rmpa.resource.node import TRANSITIONS, ResourceNode
from rmpa.resource.quality import at_most
from rmpa.resource.resource import Resource
from rmpa.resource.runtime import LifecycleState
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.endpoints import Subscriber
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import DiagnosticLevel
from rmpa.ros.types.descriptor import Descriptor
from tests.resource.rig import OK, STALE, WARN, status
from tests.waiting import until


def echo(**options: Any) -> Resource:
    one = Resource("echo", role="controlling")
    one.adaptation(window=0.1)
    heard = one.input("/orders", "std_msgs/String")
    said = one.output("said", "std_msgs/String")

    @one.profile(offers={"rate": 1})
    def plain() -> None: ...

    @one.task(on=heard, **options)
    def repeat(message: Any) -> None:
        if message.data == "fail":
            raise ValueError("no voice")
        said.publish(data=message.data)

    return one


async def health(topic: Subscriber, level: int) -> str:
    return str((await status(topic, lambda one: one.name == "echo" and one.level == level)).message)


async def test_a_resource_lives_and_says_what_it_lacks(core: RosCore) -> None:
    events: list[str] = []
    one = echo(on_failure="deactivate")
    for event in ("configure", "activate", "deactivate", "finalize"):
        one.on(event)(lambda event=event: events.append(event))
    member = ResourceNode(one, core.uri)
    await member.start()
    assert events == ["configure", "activate"]
    async with Node("watcher", master_uri=core.uri) as node:
        diagnostics = await node.subscribe("/diagnostics", "diagnostic_msgs/DiagnosticArray")
        said = await node.subscribe("/echo/said", "std_msgs/String")
        assert await health(diagnostics, STALE) == "no node publishes /orders"
        orders = await node.advertise("/orders", "std_msgs/String")
        await orders.wait_for_subscriber()
        assert await health(diagnostics, OK) == "profile plain"
        await until(lambda: member.runtime._publishers["said"].subscribers)
        orders.publish(orders.make({"data": "hello"}))
        async with asyncio.timeout(30):
            async for received in said:
                assert received.message.data == "hello"
                break
        orders.publish(orders.make({"data": "fail"}))
        assert "it is inactive" in await health(diagnostics, WARN)
        await member.activate()
        assert await health(diagnostics, OK) == "profile plain"
        orders.publish(orders.make({"data": "fail"}))  # and again
        assert "it is inactive" in await health(diagnostics, WARN)
        await orders.close()
        assert "no node publishes /orders" in await health(diagnostics, STALE)
    await member.close()
    assert events == ["configure", *("activate", "deactivate") * 2, "finalize"]
    assert core.state().nodes.keys() <= {"/rosout"}


async def test_second_node_of_a_name_is_refused(core: RosCore) -> None:
    member = ResourceNode(echo(), core.uri)
    await member.start()
    with pytest.raises(PeerRefused, match="a node /echo runs there already"):
        await ResourceNode(echo(), core.uri).start()
    assert not member.ended.is_set()
    await member.close()


async def test_configure_runs_between_parameters_and_profile(core: RosCore) -> None:
    events: list[str] = []
    one = Resource("arm", role="acting")
    speed = one.parameter("speed", 1.0)

    @one.on("configure")
    def open_device() -> None:
        time.sleep(0.05)  # a profile would have overtaken it
        events.append(f"configure {speed.value}")

    @one.on("activate")
    async def activate() -> None:
        events.append("activate")

    @one.profile(offers={})
    def only() -> None:
        time.sleep(0.05)  # and the hook this one
        events.append("profile")

    async with Node("launch", master_uri=core.uri) as node:
        await call_api(core.uri, "setParam", node.name, "/arm/speed", 2.5)
    member = ResourceNode(one, core.uri)
    await member.start()
    await member.close()
    assert events == ["configure 2.5", "profile", "activate"]


@pytest.mark.parametrize("event", ["configure", "activate"])
async def test_failing_hook_prevents_the_start(core: RosCore, event: str) -> None:
    events: list[str] = []
    one = echo()
    one.on("finalize")(lambda: events.append("finalize"))

    @one.on(event)
    def hook() -> None:
        raise OSError("no such device")

    with pytest.raises(PeerRefused, match=f"{event}: OSError: no such device"):
        await ResourceNode(one, core.uri).start()
    assert "/echo" not in core.state().nodes
    assert events == ["finalize"]


def test_a_resource_without_a_profile_is_refused() -> None:
    async def make() -> None:
        ResourceNode(Resource("bare", role="sensing"), "http://127.0.0.1:1/")

    with pytest.raises(ConfigError, match="it has no System Profile; declare one"):
        asyncio.run(make())


class Loud:
    """A resource whose own thread publishes whatever its state, and whose hooks and profile do too."""

    def __init__(self) -> None:
        self.resource = Resource("loud", role="acting")
        self.words = self.resource.output("words", "std_msgs/String")
        self.mode = self.resource.output("mode", "std_msgs/String", latch=True)
        self.resource.profile(offers={}, name="plain")(lambda: self.mode.publish(data="plain"))
        self.resource.profile(offers={}, name="other", cost=1)(lambda: self.mode.publish(data="other"))
        for event in ("configure", "activate", "deactivate"):
            self.resource.on(event)(lambda event=event: self.words.publish(data=event))

    async def thread(self) -> None:
        """What a thread of the user's own does, and it is through with that."""
        await asyncio.to_thread(self.words.publish, data="thread")
        await asyncio.sleep(0)


async def test_outputs_send_only_while_active(core: RosCore, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", "rmpa")
    loud = Loud()
    words: list[str] = []
    modes: list[str] = []
    loud.resource.adaptation(dwell=0)
    member = ResourceNode(loud.resource, core.uri)
    async with Node("ear", master_uri=core.uri) as node, asyncio.timeout(40):
        await node.subscribe("/loud/words", "std_msgs/String", lambda m: words.append(m.message.data))
        await node.subscribe("/loud/mode", "std_msgs/String", lambda m: modes.append(m.message.data))
        await member.runtime.start(member._configure)
        while not (member.runtime._publishers["words"].subscribers and member.adapter.adaptation.profile == "plain"):
            await asyncio.sleep(0.01)
        while not member.runtime._publishers["mode"].subscribers:
            await asyncio.sleep(0.01)
        for _ in range(3):
            await loud.thread()
        member.adapter.pin("other")
        await member.adapter.settled()
        await member.activate()
        await loud.thread()
        while len(words) < 2 or not modes:
            await asyncio.sleep(0.01)
        # What the profile said is how the resource is; of two profiles only the last one's is true.
        assert (words, modes) == (["activate", "thread"], ["other"])
        await member.deactivate()
        await loud.thread()
        await member.activate()
        while len(words) < 4:
            await asyncio.sleep(0.01)
        assert words[2:] == ["deactivate", "activate"]
        await member.close()
    refused = [record.message.partition(" [")[0] for record in caplog.records if "refused" in record.message]
    assert refused == [
        "! /loud: what is published on words is refused while the resource is not active; this is said once",
        "= /loud: words flows again; 4 messages were refused",
        "! /loud: what is published on words is refused while the resource is not active; this is said once",
        "= /loud: words flows again; 1 messages were refused",
    ]


@pytest.fixture
async def bare() -> AsyncIterator[ResourceNode]:
    one = Resource("bare", role="sensing")
    one.profile(offers={}, name="plain")(lambda: None)
    member = ResourceNode(one, "http://127.0.0.1:1/")
    member.runtime.publish_text = lambda name, text: None  # type: ignore[method-assign]
    yield member
    await member.tasks.close()


@pytest.mark.parametrize("state", LifecycleState)
@pytest.mark.parametrize("transition", TRANSITIONS)
async def test_transitions_follow_the_table(bare: ResourceNode, state: LifecycleState, transition: str) -> None:
    bare.runtime.state = state
    valid, target = TRANSITIONS[transition]
    if state in valid:
        await bare._change_state(transition)
        assert bare.runtime.state is target
    else:
        with pytest.raises(LocalProtocolError, match=f"{state} does not lead anywhere by {transition}"):
            await bare._change_state(transition)
        assert bare.runtime.state is state


@pytest.mark.parametrize(("transition", "stays"), [("activate", True), ("deactivate", False), ("finalize", False)])
async def test_what_ends_ends_even_if_its_hook_raises(bare: ResourceNode, transition: str, stays: bool) -> None:
    @bare.resource.on(transition)
    async def hook() -> None:
        with pytest.raises(LocalProtocolError, match=f"finalize while {transition} is under way"):
            await bare._change_state("finalize")
        raise OSError("no such device")

    (before, *_), target = TRANSITIONS[transition]
    bare.runtime.state = before
    with contextlib.suppress(PeerRefused):
        await bare._change_state(transition)
    assert bare.runtime.state is (before if stays else target)


# --- requirements on others


def eye() -> Resource:
    one = Resource("eye", role="sensing", physical=False)
    one.output("sight", "std_msgs/String")
    one.adaptation(window=0.2)
    one.attribute("blur", better="min", unit="px")
    one.profile(offers={"blur": 5}, cost=1, name="wide")(lambda: None)
    one.profile(offers={"blur": 1}, cost=3, name="sharp")(lambda: None)
    return one


async def test_profiles_change_the_requests_to_others(core: RosCore) -> None:
    hand = Resource("hand", role="controlling", physical=False)
    hand.adaptation(window=0.2)
    hand.attribute("slip", better="min", unit="m")
    needs = hand.asks("eye", blur=at_most("4 px", hard=True), priority=2)
    hand.profile(offers={"slip": "5 cm"}, cost=1, name="coarse")(lambda: needs.ask(blur=at_most("9 px")))
    hand.profile(offers={"slip": "1 mm"}, cost=2, name="fine")(lambda: needs.ask(blur=at_most("2 px", hard=True)))
    member = ResourceNode(hand, core.uri)
    await member.start()
    await until(lambda: member.demands.problems() == (["there is no resource /eye"], []), "nobody is there yet")
    other = ResourceNode(eye(), core.uri)
    await other.start()
    await until(lambda: needs.answer is not None and needs.answer.message == "profile wide", "it is answered")
    assert member.demands.problems() == ([], [])
    member.adapter.pin("fine")
    await until(lambda: needs.answer is not None and needs.answer.message == "profile sharp", "more is asked")
    assert other.adapter.adaptation.requirements["/hand"].bounds["blur"].hard
    needs.ask(blur=at_most("0.1 px", hard=True))
    await until(lambda: member.demands.problems()[1], "it cannot be had")
    assert needs.answer is not None
    assert needs.answer.level is DiagnosticLevel.ERROR
    assert "/eye: non-adaptable: no profile gives blur as asked" in member.demands.problems()[1][0]
    needs.ask(blurr=at_most("2 px"))
    await until(lambda: "did you mean blur?" in "".join(member.demands.problems()[1]), "what cannot be asked is said")
    needs.ask()
    await until(lambda: not other.adapter.adaptation.requirements, "nothing is asked")
    assert member.demands.problems() == ([], [])
    needs.ask(blur=at_most("2 px"))
    await until(lambda: other.adapter.adaptation.requirements, "something is asked again")
    # Its descriptor says what it asks at present, to everybody.
    said: list[str] = []
    async with Node("reader", master_uri=core.uri) as node:
        await node.subscribe("/hand/descriptor", "std_msgs/String", lambda m: said.append(m.message.data))
        await until(lambda: said and Descriptor.parse(said[-1]).asks[0].wishes == {"blur": "<= 2 px"}, "it says so")
    await member.close()
    await until(lambda: not other.adapter.adaptation.requirements, "it is forgotten")
    await other.close()
