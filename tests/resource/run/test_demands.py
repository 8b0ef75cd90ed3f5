from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource.declare.requirements import at_least, at_most
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.descriptor import Descriptor
from rmpa.resource.run.resource_node import ResourceNode
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import DiagnosticLevel

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


async def until(holds: Callable[[], object], what: str) -> None:
    try:
        async with asyncio.timeout(30):
            while not holds():
                await asyncio.sleep(0.02)
    except TimeoutError:
        raise AssertionError(what) from None


def eye() -> Resource:
    one = Resource("eye", role="sensing", physical=False)
    one.output("sight", "std_msgs/String")
    one.attribute("blur", better="min", unit="px")
    one.profile(offers={"blur": 5}, cost=1, name="wide")(lambda: None)
    one.profile(offers={"blur": 1}, cost=3, name="sharp")(lambda: None)
    return one


async def test_profiles_change_the_requests_to_others(core: RosCore) -> None:
    hand = Resource("hand", role="controlling", physical=False)
    hand.attribute("slip", better="min", unit="m")
    needs = hand.asks("eye", blur=at_most("4 px", hard=True), priority=2)
    hand.profile(offers={"slip": "5 cm"}, cost=1, name="coarse")(lambda: needs.ask(blur=at_most("9 px")))
    hand.profile(offers={"slip": "1 mm"}, cost=2, name="fine")(lambda: needs.ask(blur=at_most("2 px", hard=True)))
    member = ResourceNode(hand, core.uri, window=0.2)
    await member.start()
    await until(lambda: member.demands.problems() == (["there is no resource /eye"], []), "nobody is there yet")
    other = ResourceNode(eye(), core.uri, window=0.2)
    await other.start()
    await until(lambda: needs.answer is not None and needs.answer.message == "profile wide", "it is answered")
    assert member.demands.problems() == ([], [])
    member.adapter.pin("fine")
    await until(lambda: needs.answer is not None and needs.answer.message == "profile sharp", "more is asked")
    assert other.adapter.loop.requirements["/hand"].bounds["blur"].hard
    needs.ask(blur=at_most("0.1 px", hard=True))
    await until(lambda: member.demands.problems()[1], "it cannot be had")
    assert needs.answer is not None
    assert needs.answer.level is DiagnosticLevel.ERROR
    assert "/eye: non-adaptable: no profile gives blur as asked" in member.demands.problems()[1][0]
    needs.ask(blurr=at_most("2 px"))
    await until(lambda: "did you mean blur?" in "".join(member.demands.problems()[1]), "what cannot be asked is said")
    needs.ask()
    await until(lambda: not other.adapter.loop.requirements, "nothing is asked")
    assert member.demands.problems() == ([], [])
    needs.ask(blur=at_most("2 px"))
    await until(lambda: other.adapter.loop.requirements, "something is asked again")
    # Its descriptor says what it asks at present, to everybody.
    said: list[str] = []
    async with Node("reader", master_uri=core.uri) as node:
        await node.subscribe("/hand/descriptor", "std_msgs/String", lambda m: said.append(m.message.data))
        await until(lambda: said and Descriptor.parse(said[-1]).asks[0].wishes == {"blur": "<= 2 px"}, "it says so")
    await member.close()
    await until(lambda: not other.adapter.loop.requirements, "it is forgotten")
    await other.close()


def test_invalid_demand_is_refused() -> None:
    one = eye()
    one.asks("hand", rate=at_least("5 Hz"))
    for name, said in (
        ("hand", "it asks it already"),
        ("/hand", "it asks it already"),
        ("eye", "that is itself"),
        ("a b", "'a b' is not a ROS name"),
        ("", "'' is not a ROS name"),
    ):
        with pytest.raises(ConfigError) as caught:
            one.asks(name, rate=at_least("5 Hz"))
        assert said in str(caught.value)
