from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.resource import limits
from rmpa.resource.adaptation import Adaptation, AdaptationSettings
from rmpa.resource.adapter import alarm_values, answer_to, health
from rmpa.resource.client import ResourceClient
from rmpa.resource.decision import Alarm, AlarmKind, Decider, Profile, Shortfall
from rmpa.resource.declare import Context
from rmpa.resource.functions import HungError, Preconditions
from rmpa.resource.node import ResourceNode
from rmpa.resource.quality import MEASURED, Bound, Requirement, at_least, at_most
from rmpa.resource.resource import Resource
from rmpa.resource.runtime import RuntimePart
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import DiagnosticLevel
from tests.resource.rig import ARRAY, ERROR, OK, WARN, Recorder, bound, pairs, status
from tests.waiting import until

RATE, LATENCY = MEASURED["rate"], MEASURED["latency"]
ATTRIBUTES = {"rate": RATE, "latency": LATENCY}
FAST = Profile("fast", {"rate": 40.0})
WANTED = bound(RATE, at_least=20, hard=True)


def decided(*, runs: bool = True, rate: float = 20.0) -> Adaptation:
    one = Adaptation(ATTRIBUTES, Decider("camera", ATTRIBUTES, [FAST]), AdaptationSettings(), Recorder())
    if runs:
        one.reconsider("it starts", 0.0)
        one.applied(0.0)
        one.require(asked(rate), 0.0)
    return one


def asked(rate: float = 20.0, client: str = "/a", priority: int = 0) -> Requirement:
    bounds = {"rate": bound(RATE, at_least=rate, hard=True), "latency": bound(LATENCY, at_most=0.1)}
    return Requirement(client, bounds, priority=priority)


def test_alarm_text_and_values() -> None:
    alarm = Alarm(AlarmKind.ADAPTATION, (Shortfall("rate", WANTED, 3.5),), "fast", "slow")
    assert str(alarm) == "adaptation: rate fell short under fast; slow takes over"
    assert alarm_values(alarm, ATTRIBUTES, cleared=False, reaction=2.0) == {
        "before": "fast", "after": "slow", "cleared": "false", "rate": "wanted at least 20 Hz, given 3.5 Hz",
    }  # fmt: skip
    assert alarm_values(alarm, ATTRIBUTES, cleared=True, reaction=2.0)["reaction"] == "2 s"
    none = Alarm(AlarmKind.NON_ADAPTABLE, (Shortfall("rate", WANTED, None),), "", "limp")
    assert str(none) == "non-adaptable: no profile gives rate as asked; limp is the best there is"
    assert alarm_values(none, ATTRIBUTES, cleared=False, reaction=None)["rate"].endswith("given nothing")


def test_health_reports_the_worst() -> None:
    assert health(decided(), [], []) == (DiagnosticLevel.OK, "profile fast")
    assert health(decided(), [], ["task a stuck"]) == (DiagnosticLevel.WARN, "task a stuck")
    assert health(decided(), ["no node publishes /b"], ["c"]) == (DiagnosticLevel.STALE, "no node publishes /b; c")
    assert health(decided(runs=False), [], ["c"]) == (DiagnosticLevel.ERROR, "no profile runs; c")
    level, text = health(decided(rate=90.0), ["no node publishes /b"], [])
    assert (level, text) == (
        DiagnosticLevel.ERROR, "non-adaptable: no profile gives rate as asked; fast is the best there is",
    )  # fmt: skip


def test_answer_to_a_client() -> None:
    level, message, values = answer_to(asked(), decided(), ATTRIBUTES, {"rate": 30.0})
    assert (level, message) == (DiagnosticLevel.OK, "profile fast")
    assert values == {
        "rate": "wanted at least 20 Hz, given 30 Hz",
        "latency": "wanted at most 0.1 s, given not measured yet",
    }
    assert answer_to(asked(), decided(), ATTRIBUTES, {"rate": 9.0})[:2] == (DiagnosticLevel.WARN, "rate falls short")
    both = answer_to(asked(), decided(), ATTRIBUTES, {"rate": 9.0, "latency": 2.0})
    assert both[:2] == (DiagnosticLevel.WARN, "rate, latency fall short")
    assert answer_to(asked(), decided(runs=False), ATTRIBUTES, {})[:2] == (
        DiagnosticLevel.WARN,
        "no profile runs yet",
    )
    assert answer_to(asked(90.0), decided(rate=90.0), ATTRIBUTES, {})[0] is DiagnosticLevel.ERROR
    contradicted = decided()
    contradicted.require(Requirement("/b", {"rate": Bound(high=RATE.position(5.0), hard=True)}, priority=1), 0.0)
    level, message, _ = answer_to(asked(), contradicted, ATTRIBUTES, {"rate": 30.0})
    assert level is not DiagnosticLevel.OK
    assert "/b" in message


# --- with a core


def excluded(member: ResourceNode) -> str:
    """Why the first profile is excluded."""
    return member.adapter.adaptation.explain(asyncio.get_running_loop().time())[0].excluded


class Sonar:
    """A resource whose profiles set how often it publishes, and a client's eyes on it."""

    def __init__(self, core: RosCore) -> None:
        self.resource = Resource("sonar", role="sensing", physical=False)
        self.words = self.resource.output("words", "std_msgs/String")
        self.noise = self.resource.attribute("noise", better="min", unit="m")
        self.applied: list[str] = []
        self.current = ""
        self.broken: dict[str, BaseException] = {}
        for name, noise, cost in (("fine", 0.01, 3), ("coarse", 0.1, 1)):
            self.resource.profile(offers={"noise": noise}, cost=cost, name=name)(self._applier(name))
        self.resource.task(rate=50, name="ping")(lambda: self.words.publish(data=self.current))
        self.resource.adaptation(window=0.2, dwell=0.3, cool_down=2, apply_timeout=4)
        self.member = ResourceNode(self.resource, core.uri)
        self.adapter = self.member.adapter

    def _applier(self, name: str) -> Callable[[], None]:
        def apply() -> None:
            if name in self.broken:
                raise self.broken[name]
            self.current = name
            self.applied.append(name)

        return apply


@pytest.fixture
async def sonar(core: RosCore) -> AsyncIterator[Sonar]:
    one = Sonar(core)
    await one.member.start()
    yield one
    await one.member.close()


async def ask(node: Node, **values: str) -> Any:
    publisher = await node.advertise("/sonar/requirements", ARRAY, latch=True)
    say(publisher, **values)
    return publisher


def say(publisher: Any, **values: str) -> None:
    pairs: Any = [{"key": key, "value": value} for key, value in values.items()]
    publisher.publish(publisher.make({"status": [{"name": "client", "values": pairs}]}))


async def test_violation_raises_an_alarm_and_changes_the_profile(sonar: Sonar, node: Node) -> None:
    alarms = await node.subscribe("/sonar/alarms", ARRAY)
    quality = await node.subscribe("/diagnostics", ARRAY)
    responses = await node.subscribe("/sonar/responses", ARRAY)
    await ask(node, noise="<= 20 cm")
    await status(responses, lambda s: s.name == "/client" and s.level == OK)
    assert sonar.applied == ["coarse"]
    done = asyncio.Event()

    async def disturb() -> None:
        while not done.is_set():
            sonar.noise.observe(0.5 if sonar.current == "coarse" else 0.02)
            await asyncio.sleep(0.02)

    disturbing = asyncio.create_task(disturb())
    alarm = await status(alarms, lambda s: s.level == WARN)
    assert alarm.message == "adaptation: noise fell short under coarse; fine takes over"
    assert pairs(alarm)["noise"].startswith("wanted at most 0.2 m, given 0.5")
    seen = await status(quality, lambda s: s.name == "sonar" and pairs(s).get("profile") == "fine" and s.level == OK)
    assert "reaction" in pairs(seen)
    later = await status(quality, lambda s: s.name == "sonar" and pairs(s)["level_for"] > pairs(seen)["level_for"])
    assert later.level == OK
    over = await status(alarms, lambda s: pairs(s)["cleared"] == "true")
    assert over.level == OK
    done.set()
    await disturbing
    assert sonar.applied == ["coarse", "fine"]
    # Two windows, and what it takes to apply it.
    assert sonar.adapter.reaction is not None
    assert sonar.adapter.reaction < 5


async def test_invalid_requirement_is_answered_and_changes_nothing(sonar: Sonar, node: Node) -> None:
    responses = await node.subscribe("/sonar/responses", ARRAY)
    publisher = await ask(node, noise="<= 5 cm")
    await status(responses, lambda s: s.name == "/client" and s.level == OK)
    say(publisher, nois="<= 5 cm")
    told = await status(responses, lambda s: s.name == "/client" and s.level == ERROR)
    assert "sonar has no such attribute; did you mean noise?" in told.message
    assert "what was asked before stays" in told.message
    assert pairs(told)["noise"].startswith("wanted at most 0.05 m")
    say(publisher, noise="<= 6 cm")
    await status(responses, lambda s: s.name == "/client" and s.level == OK)


async def test_resource_client_requests_and_answers(sonar: Sonar, node: Node) -> None:
    async with ResourceClient(node, "sonar") as one:
        answer = await one.require(noise=at_most("5 cm", hard=True), timeout=30)
        assert answer.values["noise"].startswith("wanted at most 0.05 m")
        async with asyncio.timeout(30):
            if answer.message != "profile fine":
                async for answer in one.answers():
                    if answer.message == "profile fine":
                        break
        async with asyncio.timeout(30):  # who looks late does not miss what was said meanwhile
            async for answer in one.answers():
                assert answer.message == "profile fine"
                break
        with pytest.raises(PeerRefused, match="less is better"):
            await one.require(noise=at_least("5 cm"), timeout=30)
        answer = await one.require(noise=at_most("1 mm", hard=True), timeout=30)
        assert answer.level is DiagnosticLevel.ERROR
        assert "non-adaptable" in answer.message
        answer = await one.require(words__rate=at_least("1 Hz"), timeout=30)
        assert answer.values.keys() == {"words.rate"}
    await until(lambda: not sonar.adapter.adaptation.requirements)


async def test_missing_resource_is_unreachable(node: Node, core: RosCore) -> None:
    async with ResourceClient(node, "nowhere") as one:
        with pytest.raises(UnreachableError, match="/nowhere"):
            await one.require(noise=at_most(1), timeout=0.2)
        with pytest.raises(ValueError, match="publishes /nowhere/requirements already"):
            await ResourceClient(node, "nowhere").__aenter__()
    assert "/nowhere/responses" not in core.state().subscribers
    async with ResourceClient(node, "nowhere") as one:
        answers = asyncio.create_task(anext(one.answers(), None))
        await asyncio.sleep(0)
        await node.close()
        assert await asyncio.wait_for(answers, 30) is None


# --- preconditions


def declared(needs: Callable[[], str | bool | None]) -> Resource:
    one = Resource("sonar", role="sensing")
    one.attribute("noise", better="min", unit="m")
    one.profile(offers={"noise": 0.01}, needs=needs, name="fine")(lambda: None)
    one.profile(offers={"noise": 0.1}, cost=1, name="coarse")(lambda: None)
    one.adaptation(window="50 ms", dwell=0)
    return one


async def test_blocking_precondition_delays_nothing(core: RosCore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "PRECONDITION_TIMEOUT", 0.3)
    goes_on, threads = threading.Event(), set()
    calls: list[float] = []

    def needs() -> bool:
        calls.append(time.monotonic())
        threads.add(threading.get_ident())
        return goes_on.wait(40)

    member = ResourceNode(declared(needs), core.uri)
    await member.start()
    loop = member.adapter.adaptation
    windows: list[None] = []
    watcher = RuntimePart(member.runtime)
    watcher.window_ended = lambda *_: windows.append(None)  # type: ignore[method-assign]
    member.runtime.parts.append(watcher)
    member.adapter.enter_context(Context("lab", requires={"noise": at_most("5 cm")}))
    await until(lambda: loop.profile == "coarse")
    await until(lambda: len(windows) >= 5)
    assert excluded(member) == "its precondition has not answered for 0.3 s"
    assert len(calls) == 1  # it is not asked again as long as it has not answered
    goes_on.set()
    await until(lambda: loop.profile == "fine")
    assert threading.get_ident() not in threads
    await member.close()


async def test_first_decision_waits_for_preconditions(core: RosCore) -> None:
    applied: list[str] = []
    member = ResourceNode(declared(lambda: "the lid is shut"), core.uri)
    watcher = RuntimePart(member.runtime)
    watcher.changed = lambda: applied.extend(filter(None, [member.adapter.adaptation.applying]))  # type: ignore[method-assign]
    member.runtime.parts.append(watcher)
    await member.start()
    await until(lambda: applied)
    assert applied[0] == "coarse"
    assert excluded(member) == "the lid is shut"
    await member.close()


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (True, None),
        (None, None),
        (False, "its precondition does not hold"),
        ("no lens", "no lens"),
        ("", None),
        (OSError("no bus"), "its precondition failed: OSError: no bus"),
    ],
)
async def test_precondition_results(answer: str | bool | Exception | None, why: str | None) -> None:
    def needs() -> str | bool | None:
        if isinstance(answer, Exception):
            raise answer
        return answer

    one = Preconditions(declared(needs).profiles)
    for _ in range(2):
        assert (await one.check()).get("fine") == why
    await one.close()


# --- functions that hang


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
    member = ResourceNode(arm.resource, core.uri, stop=hung)
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
    member.adapter.adaptation.pinned = "thread"
    with pytest.raises(HungError, match="profile thread has not returned within"):
        await member.start()
    assert member.ended.is_set()
    arm.goes_on.set()


# --- what clients observe


@pytest.fixture
async def camera(core: RosCore) -> AsyncIterator[ResourceNode]:
    one = Resource("camera", role="sensing", physical=False)
    frames = one.output("frames", "std_msgs/String")
    for name, cost in (("full", 2), ("small", 1)):
        one.profile(offers={"rate": 50}, cost=cost, name=name)(lambda: None)
    one.adaptation(window="200 ms", settle="200 ms", cool_down="60 s")
    one.task(rate=50, name="shoot")(lambda: frames.publish(data="x"))
    member = ResourceNode(one, core.uri)
    await member.start()
    yield member
    await member.close()


async def test_observed_quality_of_inputs_is_reported(core: RosCore, camera: ResourceNode) -> None:
    one = Resource("viewer", role="controlling")
    one.input("/camera/frames", "std_msgs/String")
    one.input("/elsewhere", "std_msgs/String", required=False)
    one.asks("camera", rate=at_least("10 Hz"), frames__age=at_most("1 s"))
    one.profile(offers={}, name="look")(lambda: None)
    one.adaptation(window="200 ms")
    viewer = ResourceNode(one, core.uri)
    await viewer.start()
    seen = camera.adapter.clients
    await until(lambda: 20 < float(seen["/viewer"].observed.get("rate", 0)) < 100)
    assert float(seen["/viewer"].observed["frames.age"]) > 0
    assert "latency" not in seen["/viewer"].observed  # it did not ask for that
    await viewer.close()
