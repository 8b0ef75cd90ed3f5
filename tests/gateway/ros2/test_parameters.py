"""Parameters of ROS 2's nodes: what is asked of a node, and what is made of its values."""

from __future__ import annotations

import json
from typing import Any

import pytest

from rmpa.core.errors import RmpaError
from rmpa.gateway.ros2.asking import Ros2Asker, _kind, service_types
from rmpa.gateway.ros2.conversion import Ros2Codec
from rmpa.gateway.ros2.format import EntityKind
from rmpa.gateway.rules import CrossingRules
from rmpa.gateway.zenoh.threads import ZenohSample


class Node:
    """A node of ROS 2 with the parameters ``count`` and ``list``; it keeps what it was called with."""

    def __init__(self, *services: str) -> None:
        self.services = services
        self.asked: list[Any] = []
        self.nodes = {"/arm"}
        self.reason = ""

    def at(self, name: str, kind: EntityKind) -> Any:
        return iter([name] if name.rpartition("/")[2] in self.services and kind is EntityKind.SERVICE else [])

    async def call(self, server: str, request: bytes) -> ZenohSample:
        kind = "rcl_interfaces/srv/" + server.rpartition("/")[2].title().replace("_", "")
        asked = Ros2Codec(service_types(), f"{kind}_Request").read(request)
        self.asked.append(asked)
        answer: dict[str, Any] = {"result": {"successful": not self.reason, "reason": self.reason}}
        if "List" in kind:
            answer = {"result": {"names": ["list", "bytes", "count"]}}
        elif "Get" in kind:
            answer = {"values": [VALUES.get(name, {}) for name in asked["names"]]}
        made = Ros2Codec(service_types(), f"{kind}_Response").write(answer)
        return ZenohSample(made + b"garbage")


VALUES = {
    "count": {"type": 2, "integer_value": 7},
    "list": {"type": 8, "double_array_value": [1.0, 2.0]},
    "bytes": {"type": 5, "byte_array_value": [1, -1]},
}
ALL = ("list_parameters", "get_parameters", "set_parameters_atomically")


class Asker(Ros2Asker):
    """Asks the stand-in."""

    def __init__(self, node: Node) -> None:
        given: Any = node
        super().__init__(given, given, given, CrossingRules())
        self._node = node

    async def call(self, server: Any, request: bytes) -> ZenohSample:
        return await self._node.call(server, request)


async def ask(node: Node, why: str = "", **args: str) -> Any:
    text = await Asker(node).parameters({"node": "/arm", **args}, lambda _: why)
    return json.loads(text) if text else None


async def test_names_values_and_all_of_them_are_read_whatever_follows_a_response() -> None:
    node = Node(*ALL)
    assert await ask(node) == ["bytes", "count", "list"]
    assert await ask(node, key="list") == [1.0, 2.0]
    assert await ask(node, key="") == {"bytes": [1, 255], "count": 7, "list": [1.0, 2.0]}
    with pytest.raises(RmpaError, match="no parameter nothing"):
        await ask(node, key="nothing")


async def test_a_value_is_set_by_the_type_of_the_parameter() -> None:
    node = Node(*ALL)
    await ask(node, key="", text='{"list": [3, 4], "made": {"here": true}}')
    made = {each["name"]: each["value"] for each in node.asked[-1]["parameters"]}
    assert (made["list"]["type"], list(made["list"]["double_array_value"])) == (8, [3.0, 4.0])
    assert (made["made.here"]["type"], made["made.here"]["bool_value"]) == (1, True)
    await ask(node, key="bytes", text="[255]")
    assert list(node.asked[-1]["parameters"][0]["value"]["byte_array_value"]) == [-1]
    node.reason = "it is read only"
    with pytest.raises(RmpaError, match="read only"):
        await ask(node, key="count", text="8")


@pytest.mark.parametrize("text", ["[1, true]", '[{"a": 1}]', "not JSON", "[" * 100_000, str(2**70)])
async def test_what_is_no_value_is_refused(text: str) -> None:
    with pytest.raises(RmpaError):
        await ask(Node(*ALL), key="count", text=text)


async def test_a_program_that_may_not_call_and_a_node_without_parameters_are_told() -> None:
    node = Node(*ALL)
    with pytest.raises(RmpaError, match="you may not"):
        await ask(node, "you may not", key="count")
    assert not node.asked
    with pytest.raises(RmpaError, match="without services of parameters"):
        await ask(Node())
    node = Node()
    node.nodes.clear()
    with pytest.raises(RmpaError, match="no node of ROS 2"):
        await ask(node)


@pytest.mark.parametrize(
    ("value", "present", "kind"),
    [
        (None, 4, 0), (1, 3, 3), (1, 2, 2), (True, 3, 1), ([], 0, 9), ([], 7, 7), ([1], 5, 5), ([1, 2.5], 0, 8),
        (["a"], 0, 9),
    ],
)  # fmt: skip
def test_the_type_of_a_value(value: Any, present: int, kind: int) -> None:
    assert _kind(value, present) == kind
