"""``rmpa param`` of nodes of ROS 2, with real rclpy."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from lab.bed.gateways import python_of
from lab.bed.processes import eventually
from tests.interop.ros2_hall import LONG, Hall, OtherEnd, running_hall

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = [pytest.mark.ros, pytest.mark.netns, pytest.mark.timeout(150)]
RULES = """
[[gateway.rule]]
names = ["/still2/set_parameters*"]
crossing = "none"
"""


@pytest.fixture(scope="module", params=["jazzy", pytest.param("kilted", marks=pytest.mark.long)])
def hall(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    if not python_of(request.param).exists():
        pytest.skip(f"ROS 2 {request.param} is not there: scripts/install-ros2")
    with running_hall(tmp_path_factory.mktemp("dds"), way=request.param, gateway_config=RULES) as hall:
        yield hall


def declaring(hall: Hall, name: str) -> OtherEnd:
    """A node that has parameters, once they are to be had."""
    node = hall.node(name)
    values = {"speed": 1.5, "count": 7, "name": "two", "on": True, "gains.p": 1.0, "gains.i": 0.5, "list": [1.0, 2.0]}
    for key, value in values.items():
        node.do("declare", name=key, value=value)
    eventually(lambda: param(hall, "list", name)[0] == 0, LONG, what=f"the parameters of {name}", every=0.5)
    return node


def param(hall: Hall, verb: str, node: str, *words: str) -> tuple[int, str]:
    return hall.robot.agent.rmpa("param", verb, "--peer", f"ros2/{node}", *words)


def value(hall: Hall, node: str, key: str) -> object:
    code, text = param(hall, "get", node, key, "--json")
    assert code == 0, text
    return json.loads(text)


def test_parameters_are_listed_read_and_set(hall: Hall) -> None:
    node = declaring(hall, "asked2")
    assert {"/speed", "/gains.p", "/use_sim_time"} <= set(param(hall, "list", "asked2")[1].split())
    assert value(hall, "asked2", "/speed") == 1.5
    assert value(hall, "asked2", "/on") is True
    assert value(hall, "asked2", "/gains") == {"p": 1.0, "i": 0.5}
    assert "two" in hall.robot.agent.rmpa("param", "get", "ros2/asked2:/name")[1]
    for key, text, made in (("speed", "2", 2.0), ("count", "8", 8), ("list", "[3, 4.5]", [3.0, 4.5])):
        code, said = param(hall, "set", "asked2", f"/{key}", text)
        assert code == 0, said
        assert node.ask("value", "value", name=key)["value"] == made
    assert param(hall, "set", "asked2", "/gains", "{p: 3, i: 4}")[0] == 0
    assert value(hall, "asked2", "/gains") == {"p": 3.0, "i": 4.0}
    code, text = param(hall, "dump", "asked2")
    assert code == 0, text
    assert "gains.p: 3.0" in text


def test_what_cannot_be_read_or_set_is_told(hall: Hall) -> None:
    declaring(hall, "still2")
    for words, told in (
        (("get", "still2", "/nothing"), "no parameter nothing"),
        (("set", "still2", "/speed", "3.0"), "gateway.rule 1"),
        (("get", "gone2", "/speed"), "no node of ROS 2 answers at /gone2"),
    ):
        code, text = param(hall, *words)
        assert code != 0
        assert told in text, text


def test_a_value_that_the_node_refuses_is_told_and_nothing_is_set(hall: Hall) -> None:
    declaring(hall, "strict2")
    code, text = param(hall, "set", "strict2", "/", "{speed: 9.0, count: words}")
    assert code != 0
    assert "count" in text or "type" in text, text
    assert value(hall, "strict2", "/speed") == 1.5
