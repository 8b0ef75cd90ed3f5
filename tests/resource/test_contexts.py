"""Contexts, and the rules that choose them."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError, PeerRefused
from rmpa.resource import limits
from rmpa.resource.actuation import read_config
from rmpa.resource.expression import Expression, Scalar, parse_expression, split_reference
from rmpa.resource.node import ResourceNode
from rmpa.resource.quality import at_least
from rmpa.resource.reconfigure import DESCRIPTION_TYPE
from rmpa.resource.resource import Resource
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.descriptor import CONFIG_TYPE, SERVICE_TYPE
from tests.resource.rig import ARRAY, DEADLINE, TEXT, listen
from tests.waiting import until


class Lamp:
    """A resource that says under which profile, context and colours it speaks."""

    def __init__(self, core: RosCore) -> None:
        self.core = core
        self.problem: Exception | None = None
        # The context whose function fails.
        self.jammed = ""
        self.profile = self.place = ""
        self.entered: list[str] = []
        one = self.resource = Resource("lamp", role="acting")
        said = one.output("said", TEXT)
        other = one.output("other", TEXT)
        one.parameter("level", 1.0, low=0.0, high=10.0)
        self.red = one.parameter("red", 0, low=0)
        self.green = one.parameter("green", 0, low=0)
        one.parameter("colour", "white", choices=("white", "blue"))
        for name, rate, cost in (("slow", 50, 1), ("fast", 60, 2), ("broken", 60, 3)):
            one.profile(offers={"rate": rate}, cost=cost, name=name)(self._apply(name))
        one.context("dark", when="~level < 1", profiles=["fast"], outputs=[said], enter=self._enter("dark"))
        one.context(
            "docked", when="/battery/power_supply_status == 1 or /charging", requires={"rate": at_least("55 Hz")},
            enter=self._enter("docked"),
        )  # fmt: skip
        one.context("away", enter=self._enter("away"))

        @one.task(rate=100)
        def speak() -> None:
            words = [self.profile, self.place, str(self.red.value)]
            time.sleep(0.002)
            words += [self.profile, self.place, str(self.green.value)]
            said.publish(data=" ".join(w or "-" for w in words))
            other.publish(data="here")

        one.adaptation(window=0.2)
        self.member = ResourceNode(one, core.uri)

    def _apply(self, name: str) -> Callable[[], None]:
        def apply() -> None:
            if name == "broken":
                raise OSError("no such bulb")
            time.sleep(0.05)
            self.profile = name

        return apply

    def _enter(self, name: str) -> Callable[[], None]:
        def enter() -> None:
            if name == self.jammed:
                raise OSError("jammed")
            if self.problem is not None:
                raise self.problem
            self.place = name
            self.entered.append(name)
            time.sleep(0.02)

        return enter


@pytest.fixture
async def lamp(core: RosCore) -> AsyncIterator[Lamp]:
    one = Lamp(core)
    await one.member.start()
    yield one
    await one.member.close()


async def ask(node: Node, **values: object) -> dict[str, Any]:
    """What set_parameters answers."""
    lists: dict[type, str] = {bool: "bools", int: "ints", str: "strs", float: "doubles"}
    config: dict[str, Any] = {key: [] for key in lists.values()}
    for name, value in values.items():
        config[lists[type(value)]].append({"name": name, "value": value})
    async with asyncio.timeout(DEADLINE):
        reply = await node.call_service("/lamp/set_parameters", SERVICE_TYPE, {"config": config})
    return read_config(reply.config)


async def test_parameters_are_set_and_published_together(lamp: Lamp, node: Node) -> None:
    updates = await listen(node, "/lamp/parameter_updates", CONFIG_TYPE)
    described = await listen(node, "/lamp/parameter_descriptions", DESCRIPTION_TYPE)
    said = await listen(node, "/lamp/said")
    await until(lambda: updates and described and said, "it says nothing of itself")
    first = {"level": 1.0, "red": 0, "green": 0, "colour": "white", "profile": "", "context": ""}
    assert read_config(updates[0]) == first
    for number in range(1, 19):
        await ask(node, red=number, green=number, level=99.0)
    reply = await ask(node, red=19, green=19, level=99.0)
    assert reply == first | {"red": 19, "green": 19, "level": 10.0}
    await until(lambda: read_config(updates[-1]) == reply, "the last update does not come")
    assert [read_config(u)["red"] for u in updates] == list(range(20))
    # No run of the task has seen one of both.
    assert all(words[2] == words[5] for words in (str(m.data).split() for m in said))
    with pytest.raises(PeerRefused, match="parameter rde: there is none of this name; did you mean red"):
        await ask(node, green=5, rde=5)
    with pytest.raises(PeerRefused, match="'pink' is none of its values"):
        await ask(node, green=5, colour="pink")
    assert lamp.green.value == 19
    lamp.green.value = 3  # code of the resource sets it
    await until(lambda: read_config(updates[-1])["green"] == 3, "what code sets is not said")
    async with asyncio.timeout(DEADLINE):
        while await node.get_param("/lamp") != reply | {"green": 3}:
            await asyncio.sleep(0.02)


async def test_parameter_server_values_are_loaded(core: RosCore, node: Node) -> None:
    chosen = {"profile": "fast", "context": "away"}
    await node.set_param("/lamp", {"level": 20, "red": "much", "green": 4, "else": [1], **chosen})
    lamp = Lamp(core)
    lamp.green.value, lamp.green.given = 5, True  # rmpa run --set
    await lamp.member.start()
    assert lamp.green.value == 5
    assert lamp.resource.parameters["level"].value == 10.0
    assert lamp.red.value == 0
    assert lamp.entered == ["away"]
    await until(lambda: lamp.profile == "fast", "the profile chosen does not run")
    await lamp.member.close()


async def test_rules_select_a_context(lamp: Lamp, node: Node) -> None:
    contexts = await listen(node, "/lamp/context")
    said = await listen(node, "/lamp/said")
    other = await listen(node, "/lamp/other")
    await until(lambda: said and other and contexts, "it says nothing")
    await ask(node, level=0.5)
    await until(lambda: contexts[-1].data == "dark", "a parameter's rule does nothing")
    # Only its profile may run, only its output flows, and no message mixes two.
    assert lamp.profile == "fast"
    count, heard = len(said), len(other)
    await until(lambda: len(said) > count + 5, "what belongs to the context does not flow")
    assert len(other) == heard
    battery = await node.advertise("/battery", "sensor_msgs/BatteryState", latch=True)
    battery.publish(battery.make({"power_supply_status": 1}))
    await ask(node, level=2.0)
    await until(lambda: contexts[-1].data == "docked", "a topic's rule does nothing")
    assert lamp.profile == "fast"
    assert "context docked" in lamp.member.adapter.adaptation.requirements
    await until(lambda: len(other) > heard, "the other output does not flow again")
    battery.publish(battery.make({"power_supply_status": 2}))
    await until(lambda: contexts[-1].data == "" and lamp.profile == "slow", "it stays for ever")
    assert not lamp.member.adapter.adaptation.requirements
    charging = await node.advertise("/charging", "std_msgs/Bool", latch=True)
    charging.publish(charging.make(True))
    await until(lambda: contexts[-1].data == "docked", "the other topic does nothing")
    await charging.close()  # nobody says so any more
    await until(lambda: contexts[-1].data == "", "it believes one that is gone")
    pairs = [str(m.data).split() for m in said]
    assert all(words[:2] == words[3:5] for words in pairs)
    seen = {(words[0], words[1]) for words in pairs}
    assert ("fast", "-") not in seen


async def test_choice_by_hand_overrides_rules(lamp: Lamp, node: Node) -> None:
    contexts = await listen(node, "/lamp/context")
    answers = await listen(node, "/lamp/responses", ARRAY)
    setter = await node.advertise("/lamp/set_context", TEXT)
    await setter.wait_for_subscriber()
    setter.publish(setter.make({"data": "away"}))
    await until(lambda: contexts and contexts[-1].data == "away", "the topic does nothing")
    await ask(node, level=0.5)
    setter.publish(setter.make({"data": "dcoked"}))
    await until(
        lambda: any("no context 'dcoked'; did you mean docked?" in s.message for a in answers for s in a.status),
        "a wrong one is not told",
    )
    assert contexts[-1].data == "away"
    assert (await ask(node, context=""))["context"] == ""
    await until(lambda: contexts[-1].data == "dark", "the rules do not decide again")
    assert lamp.entered == ["away", "dark"]


async def test_a_choice_that_fails_takes_nothing_from_the_next_one(lamp: Lamp) -> None:
    contexts = lamp.member.contexts
    lamp.jammed = "away"
    first = asyncio.ensure_future(contexts.choose("away"))
    await asyncio.sleep(0)
    second = asyncio.ensure_future(contexts.choose("docked"))
    with pytest.raises(PeerRefused, match="jammed"):
        await first
    await second
    assert (contexts.current, contexts.chosen) == ("docked", "docked")


async def test_a_context_that_cannot_begin_changes_nothing(lamp: Lamp, node: Node) -> None:
    contexts = lamp.member.contexts
    lamp.problem = OSError("jammed")
    with pytest.raises(PeerRefused, match="context away refused: OSError: jammed"):
        await ask(node, context="away", red=5)
    assert (contexts.current, contexts.chosen, lamp.red.value) == ("", "", 0)
    lamp.problem = None
    with pytest.raises(ConfigError, match="no context 'awya'; did you mean away"):
        await contexts.choose("awya")
    said = await listen(node, "/lamp/said")
    await until(lambda: said, "its tasks do not go on")
    await contexts.choose("away")
    assert contexts.current == "away"


async def test_missing_field_of_a_rule_is_reported(lamp: Lamp, node: Node) -> None:
    charging = await node.advertise("/charging", TEXT, latch=True)
    charging.publish(charging.make({"data": "yes"}))
    battery = await node.advertise("/battery", "std_msgs/Bool", latch=True)
    battery.publish(battery.make(True))
    health = await listen(node, "/lamp/quality", ARRAY)
    text = "rule over /battery/power_supply_status: std_msgs/Bool has no power_supply_status; it has data"
    await until(lambda: any(text in s.message for m in health for s in m.status), "nobody says what is wrong")
    assert lamp.member.contexts.current == ""


async def test_a_rule_over_its_own_topics(core: RosCore, node: Node) -> None:
    one = Resource("gauge", role="sensing")
    orders = one.input("/orders", TEXT, required=False)
    said = one.output("said", TEXT)
    one.profile(offers={}, name="plain")(lambda: None)
    one.task(on=orders, name="repeat")(lambda message: said.publish(data=message.data))
    one.context("told", when="/orders == 'go' and /gauge/said.data == 'go'")
    member = ResourceNode(one, core.uri)
    await member.start()
    assert member.contexts.chosen == member.contexts.current == ""
    sender = await node.advertise("/orders", TEXT)
    await sender.wait_for_subscriber()
    contexts = member.contexts
    for word, wanted in (("go", "told"), ("stop", "")):
        async with asyncio.timeout(DEADLINE):
            while contexts.current != wanted:
                sender.publish(sender.make({"data": word}))
                await asyncio.sleep(0.05)
    await member.close()


PARAMETERS = ("gain", "name", "on")


def rule(text: str) -> Expression:
    return parse_expression(text, PARAMETERS, "context docked")


@pytest.mark.parametrize(
    ("text", "true", "false"),
    [
        ("/b/charging == true and ~gain > 3", {"/b/charging": True, "~gain": 4}, {"/b/charging": True, "~gain": 3}),
        ("/b.charging", {"/b.charging": True}, {"/b.charging": False}),
        ("not /b.charging", {"/b.charging": False}, {"/b.charging": True}),
        ("~gain >= -1.5e1", {"~gain": -15}, {"~gain": -15.1}),
        ("3 < ~gain", {"~gain": 3.5}, {"~gain": 3}),
        ('~name == "it\'s"', {"~name": "it's"}, {"~name": "its"}),
        ("~name != 'a and b'", {"~name": "a"}, {"~name": "a and b"}),
        ("~gain == /x", {"~gain": 2, "/x": 2.0}, {"~gain": 2, "/x": 3}),
        ("~on == true", {"~on": 1}, {"~on": 0}),  # a uint8 of a driver
        # and binds closer than or; brackets closer than both
        ("~on or ~gain > 1 and ~gain < 0", {"~on": True, "~gain": 5}, {"~on": False, "~gain": 5}),
        ("(~on or ~gain > 1) and ~gain < 5", {"~on": False, "~gain": 2}, {"~on": True, "~gain": 5}),
        ("not (~on and ~gain > 1)", {"~on": True, "~gain": 1}, {"~on": True, "~gain": 2}),
        ("not ~on == true", {"~on": False}, {"~on": True}),
    ],
)
def test_a_rule_holds_or_not(text: str, true: dict[str, Scalar], false: dict[str, Scalar]) -> None:
    assert rule(text).holds(true) is True
    assert rule(text).holds(false) is False


def test_what_is_not_known_decides_nothing() -> None:
    both = rule("/b.x > 1 and ~on")
    assert both.holds({"~on": True}) is None
    assert both.holds({"~on": False}) is False
    either = rule("/b.x > 1 or ~on")
    assert either.holds({"~on": True}) is True
    assert either.holds({"~on": False}) is None
    assert rule("not /b.x == 1").holds({}) is None
    assert rule("/b.x != 1").holds({"/b.x": math.nan}) is None


def test_a_text_is_no_number() -> None:
    assert rule("/b.x == 1").holds({"/b.x": "1"}) is False
    assert rule("/b.x > 1").holds({"/b.x": "2"}) is False
    assert rule("/b.x != 1").holds({"/b.x": "1"}) is True


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a value is missing; for example /battery/charging"),
        ("~gain >", "a value is missing"),
        ("> 3", "a value is missing in front of '>'"),
        ("~gian > 3", "there is no parameter gian; did you mean ~gain?"),
        ("~gain > 3 3", "'3' stands where the rule must end"),
        ("~gain > 3V", "'3V' cannot be read"),
        ("(~gain > 3", "a bracket is not closed"),
        ("~gain > 3)", "')' stands where the rule must end"),
        ("~on = true", "'= true' cannot be read"),
        ("~on == True", "'True' is no value; did you mean true?"),
        ("~name == docked", "'docked' is no value; texts have quotes"),
        ("~name == 'docked", "cannot be read"),
        ("__import__('os')", "there is no function __import__"),
        ("and", "'and' is no value"),
        ("(" * 50 + "~on" + ")" * 50, f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets"),
        ("not " * 50 + "~on", f"deeper than {limits.CONTEXT_RULE_DEPTH} brackets"),
        ("~on or " * 200 + "~on", "1403 characters"),
    ],
)
def test_invalid_rule_is_refused(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        rule(text)
    assert said in str(error.value)
    assert str(error.value).startswith("context docked: ")


@given(st.text(alphabet="~/.()<>=! andortuefls'\"0123_x-", max_size=80))
def test_any_text_is_a_rule_or_an_error(text: str) -> None:
    with contextlib.suppress(ConfigError):
        made = parse_expression(text, ("x", "a"))
        assert made.holds({}) in (True, False, None)
        known = made.holds(dict.fromkeys(made.references, 1.0))
        assert known is not None or "/" in text  # a division by zero


def test_the_graph_tells_which_part_is_the_topic() -> None:
    assert list(split_reference("/a/b/c")) == [("/a/b/c", ()), ("/a/b", ("c",)), ("/a", ("b", "c"))]
    assert list(split_reference("/a/b.c.d")) == [("/a/b", ("c", "d"))]
    assert rule("/a > 1 and /a < ~gain").references == ("/a", "~gain")
