from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.resource.declare.parameters import AdaptationSettings
from rmpa.resource.declare.requirements import at_least, at_most
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.adapter import Adapter
from rmpa.resource.run.client import ResourceClient
from rmpa.resource.run.runtime import Runtime
from rmpa.resource.run.tasks import Tasks
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import DiagnosticLevel
from rmpa.ros.types.messages import MessageType

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.ros.node.endpoints import Subscriber

ARRAY = "diagnostic_msgs/DiagnosticArray"
OK, WARN, ERROR = 0, 1, 2
QUICK = AdaptationSettings(violations=2, windows=3, dwell=0.3, cool_down=2.0, apply_timeout=4.0)


@pytest.fixture(scope="module", autouse=True)
def _warm() -> None:
    kind = MessageType(ARRAY)
    kind.deserialize(kind.serialize(kind.make()))


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


class Sonar:
    """A resource whose profiles set how often it publishes, and a client's eyes on it."""

    def __init__(self, core: RosCore) -> None:
        self.resource = Resource("sonar", role="sensing", physical=False)
        self.words = self.resource.output("words", "std_msgs/String")
        self.noise = self.resource.attribute("noise", better="min", unit="m")
        self.applied: list[str] = []
        self.current = ""
        self.broken: dict[str, BaseException | threading.Event] = {}
        for name, noise, cost in (("fine", 0.01, 3), ("coarse", 0.1, 1)):
            self.resource.profile(offers={"noise": noise}, cost=cost, name=name)(self._applier(name))
        self.resource.task(rate=50, name="ping")(lambda: self.words.publish(data=self.current))
        self.runtime = Runtime(self.resource, Node("sonar", master_uri=core.uri))
        self.problems: list[object] = []
        self.tasks = Tasks(self.runtime, on_problem=self.problems.append, on_deactivate=self.problems.append)
        self.adapter = Adapter(self.runtime, self.tasks, window=0.2, settings=QUICK)

    def _applier(self, name: str) -> Callable[[], None]:
        def apply() -> None:
            problem = self.broken.get(name)
            if isinstance(problem, threading.Event):
                problem.wait(30)
            elif problem is not None:
                raise problem
            self.current = name
            self.applied.append(name)

        return apply


@pytest.fixture
async def sonar(core: RosCore) -> AsyncIterator[Sonar]:
    one = Sonar(core)
    await one.runtime.start([one.tasks, one.adapter])
    one.tasks.activate()
    yield one
    for problem in one.broken.values():
        if isinstance(problem, threading.Event):
            problem.set()
    await one.runtime.close()


@pytest.fixture
async def client(core: RosCore) -> AsyncIterator[Node]:
    async with Node("client", master_uri=core.uri) as node:
        yield node


async def ask(node: Node, **values: str) -> Any:
    publisher = await node.advertise("/sonar/requirements", ARRAY, latch=True)
    say(publisher, **values)
    return publisher


def say(publisher: Any, **values: str) -> None:
    pairs: Any = [{"key": key, "value": value} for key, value in values.items()]
    publisher.publish(publisher.make({"status": [{"name": "client", "values": pairs}]}))


async def status(topic: Subscriber, fits: Callable[[Any], bool]) -> Any:
    """The first status on a topic that fits."""
    async with asyncio.timeout(30):
        async for received in topic:
            for one in received.message.status:
                if fits(one):
                    return one
    raise AssertionError


def pairs(one: Any) -> dict[str, str]:
    return {pair.key: pair.value for pair in one.values}


async def test_client_is_served_and_answered(sonar: Sonar, client: Node) -> None:
    responses = await client.subscribe("/sonar/responses", ARRAY)
    profile = await client.subscribe("/sonar/profile", "std_msgs/String")
    await ask(client, noise="<= 5 cm", rate=">= 1 Hz")
    async with asyncio.timeout(30):
        async for received in profile:
            if received.message.data == "fine":
                break
    sonar.noise.observe(0.01)
    told = await status(responses, lambda s: s.name == "/client" and "0.01 m" in pairs(s)["noise"])
    assert (told.level, told.message) == (OK, "profile fine")
    assert pairs(told)["noise"] == "wanted at most 0.05 m, given 0.01 m"
    decision = await client.subscribe("/sonar/decision", "std_msgs/String")
    async with asyncio.timeout(30):
        said: dict[str, Any] = {}
        async for received in decision:
            said = msgspec.json.decode(received.message.data)
            if said["profile"] == "fine":
                break
    assert [(score["profile"], score["distance"] < 0.1) for score in said["scores"]] == [
        ("fine", True),
        ("coarse", False),
    ]


async def test_violation_raises_an_alarm_and_changes_the_profile(sonar: Sonar, client: Node) -> None:
    alarms = await client.subscribe("/sonar/alarms", ARRAY)
    quality = await client.subscribe("/diagnostics", ARRAY)
    responses = await client.subscribe("/sonar/responses", ARRAY)
    await ask(client, noise="<= 20 cm")
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


async def test_invalid_requirement_is_answered_and_changes_nothing(sonar: Sonar, client: Node) -> None:
    responses = await client.subscribe("/sonar/responses", ARRAY)
    publisher = await ask(client, noise="<= 5 cm")
    await status(responses, lambda s: s.name == "/client" and s.level == OK)
    say(publisher, nois="<= 5 cm")
    told = await status(responses, lambda s: s.name == "/client" and s.level == ERROR)
    assert "sonar has no such attribute; did you mean noise?" in told.message
    assert "what was asked before stays" in told.message
    assert pairs(told)["noise"].startswith("wanted at most 0.05 m")
    say(publisher, noise="<= 6 cm")
    await status(responses, lambda s: s.name == "/client" and s.level == OK)


async def test_invalid_first_requirement_is_answered(sonar: Sonar, client: Node) -> None:
    responses = await client.subscribe("/sonar/responses", ARRAY)
    await ask(client, noise=">= 5 cm")
    told = await status(responses, lambda s: s.name == "/client")
    assert told.level == ERROR
    assert "less is better" in told.message
    assert not sonar.adapter.loop.requirements


async def test_dead_client_is_released(sonar: Sonar, core: RosCore) -> None:
    async with Node("mortal", master_uri=core.uri) as node:
        responses = await node.subscribe("/sonar/responses", ARRAY)
        await ask(node, noise="<= 5 cm")
        await status(responses, lambda s: s.name == "/mortal" and s.level == OK)
        assert sonar.adapter.loop.requirements.keys() == {"/mortal"}
    async with asyncio.timeout(30):
        while sonar.adapter.loop.requirements or sonar.current != "coarse":
            await asyncio.sleep(0.05)


async def test_failed_profile_is_replaced(sonar: Sonar, client: Node) -> None:
    responses = await client.subscribe("/sonar/responses", ARRAY)
    sonar.broken["fine"] = OSError("no such mode")
    publisher = await ask(client, noise="<= 5 cm")
    async with asyncio.timeout(30):
        while not (excluded := sonar.adapter.loop.explain(asyncio.get_running_loop().time())[0].excluded):
            await asyncio.sleep(0.02)
    assert excluded == "OSError: no such mode"
    assert sonar.adapter.loop.profile == "coarse"
    # It goes on publishing under the profile that it has.
    words = await client.subscribe("/sonar/words", "std_msgs/String")
    async with asyncio.timeout(30):
        async for received in words:
            assert received.message.data == "coarse"
            break
    say(publisher)
    await status(responses, lambda s: True)


async def test_choice_by_hand_and_context_change_the_profile(sonar: Sonar) -> None:
    async def until(profile: str) -> None:
        async with asyncio.timeout(30):
            while sonar.adapter.loop.profile != profile:
                await asyncio.sleep(0.02)

    await until("coarse")
    sonar.adapter.pin("fine")
    await until("fine")
    sonar.adapter.pin("")
    await until("coarse")
    sonar.adapter.enter_context("lab", {}, {"coarse": "not in the lab"})
    await until("fine")
    sonar.adapter.enter_context("", {}, {})
    await until("coarse")


async def test_resource_client_requests_and_answers(sonar: Sonar, client: Node) -> None:
    async with ResourceClient(client, "sonar") as one:
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
    async with asyncio.timeout(30):
        while sonar.adapter.loop.requirements:
            await asyncio.sleep(0.05)


async def test_missing_resource_is_unreachable(client: Node) -> None:
    async with ResourceClient(client, "nowhere") as one:
        with pytest.raises(UnreachableError, match="/nowhere"):
            await one.require(noise=at_most(1), timeout=0.2)
