from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import LocalProtocolError, PeerRefused
from rmpa.resource import limits
from rmpa.resource.declare.qos_request import at_least
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.fenced_call import FencedCall
from rmpa.resource.run.resource_node import ResourceNode
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.resource.declare.connections import Output


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


class Sent(RuntimePart):
    """Counts what leaves."""

    count = 0

    def published(self, output: Output, raw: bytes, now_ns: int) -> None:
        self.count += 1


class Sonar:
    """A resource whose profile ``fine`` hangs until it is let go; its device remembers what touched it last."""

    def __init__(self, core: RosCore) -> None:
        self.resource = Resource("sonar", role="sensing")
        self.mode = self.resource.output("mode", "std_msgs/String", latch=True)
        self.gain = self.resource.parameter("gain", 1.0)
        self.noise = self.resource.attribute("noise", better="min", unit="m")
        self.eye = self.resource.asks("eye")
        self.device: list[str] = []
        self.hangs = threading.Event()
        self.goes_on = threading.Event()
        self.refused: list[str] = []
        self.over = threading.Event()
        self.resource.profile(offers={"noise": 0.01}, cost=3)(self.fine)
        self.resource.profile(offers={"noise": 0.1}, cost=1)(self.coarse)
        self.resource.profile(offers={"noise": 0.5}, cost=9, name="asynchronous")(self.later)
        self.resource.adaptation(window="100 ms", apply_timeout="2 s", cool_down="60 s", dwell=0)
        self.member = ResourceNode(self.resource, core.uri)

    def attempt(self, act: Callable[[], None]) -> None:
        try:
            act()
        except LocalProtocolError as error:
            self.refused.append(str(error))

    def fine(self) -> None:
        self.hangs.set()
        assert self.goes_on.wait(30)
        self.device.append("fine")
        self.attempt(lambda: self.mode.publish(data="fine"))
        self.attempt(lambda: setattr(self.gain, "value", 7.0))
        self.attempt(lambda: self.noise.observe(0.5))
        self.attempt(lambda: self.eye.ask(blur=at_least(1)))
        self.over.set()

    def coarse(self) -> None:
        self.device.append("coarse")
        self.mode.publish(data="coarse")

    async def later(self) -> None:
        try:
            await asyncio.sleep(30)
        finally:
            self.attempt(lambda: self.mode.publish(data="asynchronous"))

    async def until(self, fits: Callable[[], object]) -> None:
        async with asyncio.timeout(30):
            while not fits():
                await asyncio.sleep(0.01)


@pytest.fixture
async def sonar(core: RosCore) -> AsyncIterator[Sonar]:
    one = Sonar(core)
    await one.member.start()
    await one.until(lambda: one.device == ["coarse"])
    yield one
    one.goes_on.set()
    await one.member.close()


@pytest.fixture
async def client(core: RosCore) -> AsyncIterator[Node]:
    async with Node("client", master_uri=core.uri) as node:
        yield node


async def test_late_actions_of_a_hung_profile_have_no_effect(
    sonar: Sonar, client: Node, caplog: pytest.LogCaptureFixture
) -> None:
    adapter = sonar.member.adapter
    modes: list[str] = []
    alarms: list[str] = []
    await client.subscribe("/sonar/mode", "std_msgs/String", lambda m: modes.append(m.message.data))
    await client.subscribe(
        "/sonar/alarms", "diagnostic_msgs/DiagnosticArray", lambda m: alarms.append(m.message.status[0].message)
    )
    await sonar.until(lambda: adapter.reports.publishers["alarms"].subscribers and modes)
    adapter.pin("fine")
    await sonar.until(sonar.hangs.is_set)
    await sonar.until(lambda: adapter.loop.profile == "coarse" and not adapter.loop.applying)
    assert sonar.device == ["coarse", "coarse"]
    # It is not begun a second time while it hangs, whatever its cool-down.
    assert "its function still runs" in adapter.explain()[0].excluded
    await sonar.until(lambda: "the function of profile fine hangs; it was given up" in adapter.health()[1])
    adapter.pin("coarse")
    sonar.goes_on.set()
    await sonar.until(lambda: sonar.device[2:] == ["fine", "coarse"])
    await sonar.until(lambda: not adapter.loop.applying)
    assert [text.partition(":")[0] for text in sonar.refused] == [
        "publish on mode",
        "set parameter gain",
        "observe noise",
        "ask /eye",
    ]
    assert (sonar.gain.value, sonar.eye.requests, set(modes)) == (1.0, {}, {"coarse"})
    await sonar.until(lambda: len(alarms) >= 5)
    assert alarms[0] == "the function of profile fine was given up; it has no effect: publish on mode"
    assert alarms[4].startswith("the function of profile fine, which was given up, has ended after ")
    assert alarms[4].endswith("; coarse is applied once more")
    assert alarms[0] in caplog.text
    # Once, and not again and again.
    windows: list[object] = []
    watcher = RuntimePart()
    watcher.window_ended = lambda *_: windows.append(None)  # type: ignore[method-assign]
    sonar.member.runtime.parts.append(watcher)
    await sonar.until(lambda: len(windows) >= 3)
    assert sonar.device == ["coarse", "coarse", "fine", "coarse"]
    assert "hangs" not in adapter.health()[1]


async def test_hung_coroutine_is_cancelled(sonar: Sonar) -> None:
    adapter = sonar.member.adapter
    adapter.pin("asynchronous")
    await sonar.until(lambda: sonar.refused)
    await sonar.until(lambda: adapter.loop.profile == "coarse" and not adapter.loop.applying)
    assert sonar.refused[0].startswith("publish on mode: profile asynchronous was given up")
    assert sonar.device == ["coarse", "coarse"]
    assert not adapter._applier.hanging


async def test_queued_message_of_a_hung_profile_is_dropped(sonar: Sonar) -> None:
    """It was handed to the loop before the function was given up, and arrives behind that."""
    said: list[str] = []
    sent = Sent()
    sonar.member.runtime.parts.append(sent)
    raw = sonar.mode.type.serialize(sonar.mode.type.make({"data": "late"}))
    call = FencedCall("profile", "fine", lambda _call, what: said.append(what))
    sonar.member.runtime.send(sonar.mode, raw, call)
    call.give_up()
    sonar.member.runtime.send(sonar.mode, raw, call)
    assert (sent.count, len(said)) == (1, 1)
    assert said[0].endswith("it has no effect: publish on mode")


async def test_late_actions_of_a_hung_context_have_no_effect(
    core: RosCore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(limits, "CONTEXT_ENTER_TIMEOUT", 0.1)
    one = Sonar(core)
    goes_on, over = threading.Event(), threading.Event()

    def enter() -> None:
        goes_on.wait(30)
        one.attempt(lambda: setattr(one.gain, "value", 9.0))
        over.set()

    one.resource.context("docked", enter=enter)
    one.member = ResourceNode(one.resource, core.uri)
    await one.member.start()
    with pytest.raises(PeerRefused, match=r"has not ended after 0\.1 s"):
        await one.member.contexts.choose("docked")
    goes_on.set()
    await one.until(over.is_set)
    assert one.refused == ["set parameter gain: context docked was given up meanwhile; it has no effect any more"]
    assert one.gain.value == 1.0
    await one.until(lambda: "the function of context docked was given up" in caplog.text)
    await one.member.close()
