"""What a resource declares, and its dynamic_reconfigure."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rmpa.resource
from rmpa.core.contract import Contract, Reliability
from rmpa.core.errors import ConfigError, LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.resource.actuation import read_config
from rmpa.resource.declare import Parameter, Role
from rmpa.resource.quality import at_least, at_most
from rmpa.resource.reconfigure import DESCRIPTION_TYPE, checked, description, entries
from rmpa.resource.resource import Resource
from rmpa.resource.runtime import describe
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import DefinitionError
from rmpa.ros.types.descriptor import CONFIG_TYPE, Descriptor
from rmpa.ros.types.messages import MessageType


def sonar() -> Resource:
    one = Resource("sonar", role="sensing", physical=False, description="three rings")
    ranges = one.output("ranges", "sensor_msgs/Range", deadline="100 ms", reliability="reliable")
    joy = one.input("/joy", "sensor_msgs/Joy", required=False)
    one.parameter("gain", 1.0, low=0.0, high=10.0, unit="dB")
    one.parameter("beam", "wide", choices=("wide", "narrow"))
    one.attribute("accuracy", better="min", unit="m", tolerance="5 cm")

    @one.profile(offers={"rate": "0.04 kHz", "accuracy": "5 cm", "ranges.latency": "20 ms"}, cost=3)
    def precise() -> None:
        """Look twice."""

    @one.profile(offers={"rate": 10}, best_effort=True)
    async def saving() -> None: ...

    @one.task(rate="40 Hz")
    def measure() -> None:
        ranges.publish(range=1.0)

    @one.task(on=joy, on_failure="stop", stuck_after="2 s")
    async def steer(message: object) -> None: ...

    one.asks("eye", priority=2, rate=at_least("5 Hz"), sight__age=at_most("1 s", hard=True))
    one.asks("/robot1/ear")
    one.context(
        "docked", when="/charging == true", requires={"rate": at_least("1 Hz", hard=True)}, profiles=["saving"]
    )
    return one


def test_a_resource_is_what_was_declared() -> None:
    one = sonar()
    assert one.outputs["ranges"].contract == Contract(reliability=Reliability.RELIABLE, deadline=0.1)
    assert one.profiles["precise"].offers == {
        "rate": 40.0,
        "accuracy": pytest.approx(0.05),
        "ranges.latency": pytest.approx(0.02),
    }
    assert one.profiles["precise"].description == "Look twice."
    assert one.tasks["measure"].rate == 40.0
    assert one.tasks["steer"].stuck_after == 2.0
    assert {"rate", "ranges.rate", "joy.age", "accuracy"} <= one.attributes.keys()
    assert one.declared_attributes["accuracy"].attribute.tolerance == pytest.approx(0.05)


def test_a_descriptor_says_all_of_it_and_survives_the_way() -> None:
    described = describe(sonar(), "/sonar")
    assert Descriptor.parse(described.serialize()) == described
    assert [(o.topic, o.type) for o in described.outputs] == [("/sonar/ranges", "sensor_msgs/Range")]
    assert described.outputs[0].contract == {"reliability": "reliable", "deadline": 0.1}
    assert [(i.topic, i.required) for i in described.inputs] == [("/joy", False)]
    assert described.contexts[0].requires == {"rate": ">= 1 Hz hard"}
    assert [(t.name, t.rate, t.on) for t in described.tasks] == [("measure", 40.0, ""), ("steer", None, "/joy")]
    asked = [(a.resource, a.wishes, a.priority) for a in described.asks]
    assert asked == [("/eye", {"rate": ">= 5 Hz", "sight.age": "<= 1 s hard"}, 2), ("/robot1/ear", {}, 0)]


@pytest.mark.parametrize("text", [b"", b"{}", b"[]", b"\xff", b"[" * 9999, b'{"version":1,"name":3}'])
def test_what_is_no_descriptor_is_refused(text: bytes) -> None:
    with pytest.raises(RemoteProtocolError, match="descriptor of a resource"):
        Descriptor.parse(text)


def test_foreign_or_endless_descriptor_is_refused() -> None:
    text = describe(sonar(), "/sonar").serialize()
    with pytest.raises(RemoteProtocolError, match="version 9; this release reads 1"):
        Descriptor.parse(text.replace('"version":1', '"version":9', 1))
    with pytest.raises(LimitExceeded):
        Descriptor.parse(" " * (2 << 20))


def test_what_is_published_before_it_runs_says_so() -> None:
    with pytest.raises(LocalProtocolError, match=r"its resource does not run \(rmpa run\)"):
        sonar().outputs["ranges"].publish(range=1.0)


async def _later() -> bool:
    return True


NEEDS_ONE: Any = len
NEEDS_LATER: Any = _later
MISTAKES: list[tuple[Callable[[Resource], object], str]] = [
    (lambda r: r.output("ranges", "std_msgs/String"), "there is one of this name already"),
    (lambda r: r.output("a b", "std_msgs/String"), "'a b' is not a ROS name"),
    (lambda r: r.output("quality", "std_msgs/String"), "that name is the resource's own"),
    (
        lambda r: r.output("x", "std_msgs/String", deadlin="1 s"),
        "a contract has no 'deadlin'; did you mean deadline?",
    ),
    (lambda r: r.output("x", "std_msgs/String", deadline="1 Hz"), "x of sonar, deadline: '1 Hz' is a rate"),
    (lambda r: r.parameter("gain", 2.0), "there is one of this name already"),
    (lambda r: r.parameter("a/b", 2.0), "a parameter has a base name"),
    (lambda r: r.parameter("p", [1]), "is no bool, int, float or str"),  # type: ignore[arg-type]
    (lambda r: r.parameter("p", 5, low=9, high=1), "the bounds are the wrong way round"),
    (lambda r: r.parameter("p", 5, low=9), "5 is too little; the least is 9"),
    (lambda r: r.parameter("p", True, low=9), "bounds of True, which is no number"),
    (lambda r: r.parameter("p", "a", choices=("b",)), "'a' is none of its values"),
    (lambda r: r.attribute("rate", better="max"), "there is one of this name already"),
    (lambda r: r.attribute("x", better="mx"), "'mx' is not known here; did you mean max?"),
    (lambda r: r.attribute("x", better="max", scale="ordinal"), "needs its words"),
    (lambda r: r.attribute("x", better="max", unit="m", tolerance="3 s"), "'s' is a unit of time"),
    (lambda r: r.profile(offers={"rat": 3})(lambda: None), "sonar has no such attribute; did you mean rate?"),
    (lambda r: r.profile(offers={"rate": "3 s"})(lambda: None), "'s' is a unit of time"),
    (lambda r: r.profile(offers={}, name="precise")(lambda: None), "there are two of this name"),
    (lambda r: r.profile(offers={}, name="x", best_effort=True)(lambda: None), "saving is the best-effort profile"),
    (lambda r: r.profile(offers={"rate": math.inf})(lambda: None), "inf is not a number"),
    (lambda r: r.profile(offers={}, name="x", cost=-1)(lambda: None), "a cost of -1"),
    (
        lambda r: r.context("x", when="~gian > 3"),
        "context x of sonar: there is no parameter gian; did you mean ~gain?",
    ),
    (lambda r: r.asks("eye", rate=at_least("5 Hz")), "it asks it already"),
    (lambda r: r.asks("sonar"), "that is itself"),
    (lambda r: r.asks("a b"), "'a b' is not a ROS name"),
    (lambda r: r.asks(""), "'' is not a ROS name"),
    (lambda r: r.adaptation(violations=4), "4 of 3 windows"),
    (lambda r: r.adaptation(window="10 ms"), "window is 0.01 s; at least 0.05 s"),
    (lambda r: r.context("docked"), "there are two of this name"),
    (lambda r: r.context("x", profiles=["savin"]), "there is no profile savin; did you mean saving?"),
    (lambda r: r.context("x", requires={"rate": at_most(3)}), "more is better"),
    (lambda r: r.context("x", outputs=[sonar().outputs["ranges"]]), "ranges is no output of this resource"),
    (lambda r: r.task()(lambda: None), "it needs either a rate or an input"),
    (lambda r: r.task(rate=0)(lambda: None), "a rate of 0 Hz"),
    (lambda r: r.task(rate=r.parameters["gain"])(lambda: None), "gain may be what no rate can be"),
    (lambda r: r.task(rate=Parameter("hz", 5.0, 1, 9))(lambda: None), "hz is no parameter of this resource"),
    (lambda r: r.task(rate=1, name="measure")(lambda: None), "there are two of this name"),
    (lambda r: r.task(on=sonar().inputs["/joy"])(lambda: None), "/joy is no input of this resource"),
    (lambda r: r.task(rate=1, on_failure="retry")(lambda: None), "'retry' is not known here"),
    (lambda r: r.output("/sonar/quality", "std_msgs/String"), "that name is the resource's own"),
    (lambda r: r.output("/joy", "sensor_msgs/Joy"), "it is an input of the same resource"),
    (lambda r: r.input("ranges", "std_msgs/String"), "it is an output of the same resource"),
    (lambda r: r.parameter("p", "a", choices=("a", 1)), "1 is no str"),
    (lambda r: r.attribute("priority", better="max"), "'priority' cannot be the name of one"),
    (lambda r: r.attribute("how far", better="max"), "'how far' cannot be the name of one"),
    (lambda r: r.attribute("x", better="max", scale="log", tolerance="two"), "'two' is not a number"),
    (lambda r: r.profile(offers={}, name="x")(lambda gain: None), "<lambda> cannot be called without arguments"),
    (lambda r: r.profile(offers={}, name="x", needs=NEEDS_ONE)(lambda: None), "precondition of profile x"),
    (lambda r: r.profile(offers={}, name="x", needs=NEEDS_LATER)(lambda: None), "is a coroutine function"),
    (lambda r: r.task(rate=1)(lambda message: None), "<lambda> cannot be called without arguments"),
    (lambda r: r.task(on=r.inputs["/joy"])(lambda: None), "<lambda> cannot be called with the message"),
    (lambda r: r.task(rate=1, stuck_after=0)(lambda: None), "stuck after 0 s"),
    (lambda r: r.on("activate")(lambda reason: None), "<lambda> cannot be called without arguments"),
    (lambda r: r.on("activat"), "no change 'activat'; did you mean activate?"),
    (lambda r: Resource("a/b", role="sensing"), "'a/b' is not a ROS base name"),
    (lambda r: Resource("a", role="sensin"), "there is no role 'sensin'; did you mean sensing?"),
    (lambda r: Resource("a", role="watching-tv"), "sensing, acting, controlling"),
]


@pytest.mark.parametrize(("mistake", "said"), MISTAKES, ids=[said[:40] for _, said in MISTAKES])
def test_invalid_declaration_is_refused(mistake: Callable[[Resource], object], said: str) -> None:
    one = sonar()
    before = describe(one, "/sonar")
    with pytest.raises(ConfigError) as caught:
        mistake(one)
    assert said in str(caught.value)
    assert describe(one, "/sonar") == before


def test_what_has_one_name_in_two_namespaces_is_measured_apart() -> None:
    mixer = Resource("mixer", role="sensing")
    for name in ("scan", "/left/scan"):
        mixer.output(name, "sensor_msgs/LaserScan")
    for name in ("/right/scan", "/scan", "/joy"):
        mixer.input(name, "sensor_msgs/LaserScan")
    assert list(mixer.labels.values()) == ["scan", "left.scan", "right.scan", "in.scan", "joy"]
    for name in ("rate", "scan.rate", "left.scan.rate", "in.scan.loss"):
        assert name in mixer.attributes


@pytest.mark.parametrize("value", [None, "far", True, float("nan"), [1.0]])
def test_observe_refuses_invalid_values(value: Any) -> None:
    with pytest.raises(ConfigError, match="is no number"):
        sonar().declared_attributes["accuracy"].observe(value)


def test_the_docs_list_the_roles() -> None:
    page = Path(__file__).parents[2] / "docs" / "guides" / "smart-resources.md"
    section = page.read_text(encoding="utf-8").partition("## Roles\n")[2].partition("\n## ")[0]
    assert re.findall(r'^\| `"(\w+)"` \|', section, re.MULTILINE) == list(Role)
    assert [Resource("sonar", role=role).role for role in Role] == list(Role)


def test_every_public_name_is_found() -> None:
    assert all(getattr(rmpa.resource, name) for name in rmpa.resource.__all__)
    assert rmpa.resource.Node is Node
    assert rmpa.resource.ResourceClient.__module__ == "rmpa.resource.client"
    with pytest.raises(AttributeError, match="Wishes"):
        getattr(rmpa.resource, "Wishes")  # noqa: B009 - the type checker knows it is not there


def test_what_cannot_be_learnt_is_refused_where_it_is_written() -> None:
    one = Resource("eye", role="sensing")
    with pytest.raises(DefinitionError, match=r"did you mean sensor_msgs/Image\?"):
        one.output("sight", "sensor_msgs/Imagge")
    with pytest.raises(DefinitionError, match="is not a type's name; write it like std_msgs/String"):
        one.input("sight", "sensor_msgs/msg/Image")
    assert (one.outputs, one.inputs) == ({}, {})


INT = 2**31


def echo_sounder() -> Resource:
    one = Resource("sonar", role="sensing")
    one.output("ranges", "sensor_msgs/Range")
    one.parameter("gain", 1.0, low=0.5, unit="dB", description="of the amplifier")
    one.parameter("echoes", 3, low=1, high=9.5)
    one.parameter("free", 0)
    one.parameter("beam", "wide", choices=("wide", "narrow"))
    one.parameter("mode", 1, choices=(1, 2))
    one.parameter("on", True)
    one.profile(offers={"rate": 10}, name="slow", description='it\'s "slow"')(lambda: None)
    one.profile(offers={"rate": 40}, name="Automatic")(lambda: None)
    one.context("docked", when="~on")
    return one


ONE = echo_sounder()
KNOWN = entries(ONE)


def sent(kind: str, values: Any) -> Any:
    """As it comes out at the other end."""
    made = MessageType(kind)
    return made.deserialize(made.serialize(made.make(values)))


def check(**values: Any) -> dict[str, Any]:
    return {name: checked(name, value, KNOWN) for name, value in values.items()}


def test_a_description_has_all_that_clients_look_up() -> None:
    message = sent(DESCRIPTION_TYPE, description(KNOWN))
    (group,) = message.groups
    assert (group.name, group.id, group.parent) == ("Default", 0, 0)
    assert [(p.name, p.type) for p in group.parameters] == [
        ("gain", "double"), ("echoes", "int"), ("free", "int"), ("beam", "str"), ("mode", "int"), ("on", "bool"),
        ("profile", "str"), ("context", "str"),
    ]  # fmt: skip
    assert group.parameters[0].description == "of the amplifier [dB]"
    low, high, default = map(read_config, (message.min, message.max, message.dflt))
    assert low.keys() == high.keys() == default.keys() == KNOWN.keys()
    assert (low["gain"], high["gain"]) == (0.5, math.inf)
    assert (low["echoes"], high["echoes"]) == (1, 9)
    assert (low["free"], high["free"]) == (-INT, INT - 1)
    assert (low["on"], high["on"]) == (False, True)
    assert default["beam"] == "wide"
    assert default["profile"] == default["context"] == ""


def test_choices_are_an_expression_that_clients_evaluate() -> None:
    parameters = sent(DESCRIPTION_TYPE, description(KNOWN)).groups[0].parameters
    made = {p.name: ast.literal_eval(p.edit_method) for p in parameters if p.edit_method}
    assert made.keys() == {"beam", "mode", "profile", "context"}
    assert [(c["name"], c["value"], c["type"]) for c in made["mode"]["enum"]] == [("1", 1, "int"), ("2", 2, "int")]
    # A profile of that very name does not take the place of the resource's own choice.
    chosen = [(c["name"], c["value"], c["description"]) for c in made["profile"]["enum"]]
    assert chosen == [
        ("(automatic)", "", "not chosen by hand"), ("slow", "slow", "it's \"slow\""), ("Automatic", "Automatic", ""),
    ]  # fmt: skip


def test_a_number_out_of_range_is_clipped_as_its_servers_do() -> None:
    assert check(gain=-4.0, echoes=100) == {"gain": 0.5, "echoes": 9}
    assert check(gain=3, on=False, beam="narrow") == {"gain": 3.0, "on": False, "beam": "narrow"}


def test_a_profile_is_chosen_by_value_or_name() -> None:
    assert check(profile="slow", context="DOCKED") == {"profile": "slow", "context": "docked"}
    assert check(profile="", context="automatic") == {"profile": "", "context": ""}
    assert check(profile="(automatic)")["profile"] == ""
    assert check(profile="automatic")["profile"] == "Automatic"


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"gian": 1.0}, "parameter gian: there is none of this name; did you mean gain?"),
        ({"gain": math.nan}, "nan is no number that can be used"),
        ({"gain": math.inf}, "inf is no number that can be used"),
        ({"gain": "much"}, "'much' is no double"),
        ({"gain": True}, "True is no double"),
        ({"gain": [1]}, "[1] is no double"),
        ({"echoes": 2.5}, "2.5 is no int"),
        ({"beam": "wyde"}, "'wyde' is none of its values; did you mean wide?"),
        ({"mode": 3}, "3 is none of its values"),
        ({"on": 1}, "1 is no bool"),
        ({"profile": "slwo"}, "there is no profile 'slwo'; did you mean slow?"),
        ({"profile": 1}, "1 is no text"),
        ({"context": "moon"}, "there is no context 'moon'; it is one of automatic, docked"),
    ],
)
def test_invalid_value_is_refused(values: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError) as error:
        check(**{"echoes": 2, **values})
    assert said in str(error.value)


def test_a_parameter_that_is_given_twice() -> None:
    message = sent(CONFIG_TYPE, {"strs": [{"name": "gain", "value": "1"}], "doubles": [{"name": "gain", "value": 1}]})
    with pytest.raises(ConfigError, match="parameter gain: it is given twice"):
        read_config(message)


def test_a_parameter_that_is_set_in_code_is_checked_too() -> None:
    one = echo_sounder().parameters["echoes"]
    one.value = 9
    with pytest.raises(ConfigError, match="10 is too much; the most is 9"):
        one.value = 10
    assert one.value == 9
    with pytest.raises(ConfigError, match="is too much"):
        Resource("x", role="sensing").parameter("big", 2**31)
