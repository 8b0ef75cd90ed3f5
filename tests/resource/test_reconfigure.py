from __future__ import annotations

import ast
import math
from typing import Any

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource.reconfigure import (
    DESCRIPTION_TYPE,
    checked,
    config,
    description,
    entries,
    read_config,
)
from rmpa.resource.resource import Resource
from rmpa.ros.types.descriptor import CONFIG_TYPE
from rmpa.ros.types.messages import MessageType

INT = 2**31


def sonar() -> Resource:
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


ONE = sonar()
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


def test_without_contexts_there_is_none_to_choose() -> None:
    one = Resource("bare", role="sensing")
    one.profile(offers={}, name="only")(lambda: None)
    assert list(entries(one)) == ["profile"]


def test_a_config_comes_back() -> None:
    values: dict[str, Any] = {"gain": 2.5, "echoes": 4, "beam": "narrow", "on": False, "profile": "slow"}
    message = sent(CONFIG_TYPE, config(values, KNOWN))
    assert read_config(message) == values
    assert [(g.name, g.state, g.id, g.parent) for g in message.groups] == [("Default", True, 0, 0)]


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
    one = sonar().parameters["echoes"]
    one.value = 9
    with pytest.raises(ConfigError, match="10 is too much; the most is 9"):
        one.value = 10
    assert one.value == 9
    with pytest.raises(ConfigError, match="is too much"):
        Resource("x", role="sensing").parameter("big", 2**31)
