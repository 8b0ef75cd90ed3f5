"""Parameters between modules and ROS 2: ``ros2 param`` on a module, and the gateway's tree for ROS 2's nodes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from rmpa.bridge.params import transfer
from rmpa.bridge.params.io.core import read_text, write_text
from rmpa.config.gateway_rules import Crossing, CrossingRule, GatewaySettings
from rmpa.core.errors import PeerRefused
from rmpa.gateway.ros2.attachment import Ros2Attachment
from rmpa.gateway.ros2.io.neighbour import Ros2Neighbour
from rmpa.gateway.ros2.io.params import Ros2Params
from rmpa.gateway.ros2.params import EVENT_TYPE, EVENTS, SERVICES, ParamTypes
from rmpa.gateway.ros2.qos import Ros2Qos
from rmpa.gateway.ros2.tokens import EntityKind, Ros2Endpoint, Ros2Node, data_key, parse_token
from rmpa.gateway.ros2.types import Ros2Types
from rmpa.gateway.zenoh_api import ZenohQos
from rmpa.ros.types.messages import MessageType
from tests.gateway.memory_graph import MemoryGraph
from tests.gateway.memory_zenoh import MemoryQuery, MemoryZenoh, eventually

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

TYPES = ParamTypes(Ros2Types("jazzy"))
ATTACHMENT = Ros2Attachment(5, 1, bytes(16)).serialize()


class Tree:
    """The gateway's own parameters."""

    def __init__(self) -> None:
        self.values: dict[str, XmlRpcValue] = {}

    async def read(self, key: str) -> XmlRpcValue:
        found: dict[str, Any] = {}
        for name, value in self.values.items():
            if name.startswith(f"{key}/"):
                *parents, last = name[len(key) + 1 :].split("/")
                at = found
                for part in parents:
                    at = at.setdefault(part, {})
                at[last] = value
        return found or None

    async def provide(self, key: str, value: XmlRpcValue) -> None:
        for name in [name for name in self.values if name == key or name.startswith(f"{key}/")]:
            del self.values[name]
        if value is not None:
            self.values[key] = value


class Bed:
    """A gateway with the module ``arm``, and a session of ROS 2."""

    def __init__(self) -> None:
        self.network = MemoryZenoh()
        self.graph = MemoryGraph()
        self.ros2 = self.network.session()
        self.tree = Tree()
        self.arm: dict[str, XmlRpcValue] = {"/gains/p": 1.5, "/rate": 10, "/secret/key": "x"}
        self.part = Ros2Params(self.ask, self.tree)
        rules = (CrossingRule(names=("/secret/**",), crossing=Crossing.NONE),)
        self.neighbour = Ros2Neighbour(self.graph, self.network.session(), GatewaySettings(rules=rules), [self.part])

    async def ask(self, module: str, what: str, args: dict[str, Any]) -> object:
        """The module's answer, as ``ParamOwner`` gives it."""
        assert module == "arm"
        key = args.get("key", "")
        if what == transfer.NAMES:
            text = await write_text("names", list(self.arm))
        elif what == transfer.GET:
            if key not in self.arm:
                raise PeerRefused("arm", f"there is no parameter {key}")
            text = await write_text(key, self.arm[key])
        elif key == "/rate":
            raise PeerRefused("arm", "/rate may not be set")
        else:
            self.arm[key] = await read_text(args["text"])
            return {"count": 1}
        return {"size": len(text), "text": text, "reading": 0}

    async def call(self, service: str, **fields: Any) -> Any:
        kind, type_hash = TYPES.service(service)
        key = data_key(0, f"/rmpa/arm/{service}", kind, type_hash)
        (reply,) = await self.ros2.get(key, TYPES.write(f"{kind}_Request", **fields), ATTACHMENT)
        assert reply.ok, reply.payload
        assert Ros2Attachment.parse(reply.attachment).sequence == 5
        return TYPES.read(f"{kind}_Response", reply.payload)


def parameter(name: str, value: XmlRpcValue) -> Any:
    return TYPES.make("rcl_interfaces/msg/Parameter", name=name, value=TYPES.value(value))


@pytest.fixture
async def bed() -> AsyncIterator[Bed]:
    made = Bed()
    made.neighbour.start()
    yield made
    await made.neighbour.close()
    own = made.neighbour.context.session.zid
    assert not [key for key in made.network.token_keys if f"/{own}/" in key]


async def test_the_parameters_of_a_module_are_those_of_a_node_of_ros2(bed: Bed) -> None:
    source = bed.graph.publisher("/scan", MessageType("std_msgs/String"))
    names = (await bed.call("list_parameters", prefixes=[], depth=0)).result
    assert list(names.names) == ["gains.p", "rate"], "a rule keeps /secret here"
    values = (await bed.call("get_parameters", names=["gains.p", "rate", "secret.key", "none"])).values
    assert [TYPES.plain(each) for each in values] == [1.5, 10, None, None]
    assert list((await bed.call("get_parameter_types", names=["gains.p", "rate"])).types) == [3, 2]
    assert [each.type for each in (await bed.call("describe_parameters", names=["rate"])).descriptors] == [2]
    bed.graph.remove(source)
    assert not [key for key in bed.network.token_keys if "arm" in key]


async def test_of_two_gateways_of_one_mesh_one_shows_the_parameters_of_a_module(bed: Bed) -> None:
    part = Ros2Params(bed.ask, bed.tree)
    other = Ros2Neighbour(bed.graph, bed.network.session(), GatewaySettings(), [part])
    other.start()

    def sessions() -> set[str]:
        tokens = [parse_token(key) for key in bed.network.token_keys]
        return {each.node.zid for each in tokens if isinstance(each, Ros2Endpoint) and each.node.name == "/rmpa/arm"}

    try:
        bed.graph.publisher("/scan", MessageType("std_msgs/String"))
        await eventually(lambda: sessions() == {bed.neighbour.context.session.zid})
        assert (bed.part.report()["params_out"], part.report()["params_out"]) == (["arm"], [])
        later = bed.graph.publisher("/later", MessageType("std_msgs/String"), "/other")
        assert part.report()["params_out"] == [], "the other gateway answers for all nodes of the module"
        await bed.neighbour.close()
        await eventually(lambda: sessions() == {other.context.session.zid})
        assert list((await bed.call("list_parameters", prefixes=["gains"], depth=0)).result.names) == ["gains.p"]
        bed.graph.remove(later)
    finally:
        await other.close()


async def test_a_parameter_of_a_module_is_set_or_refused_by_the_module(bed: Bed) -> None:
    bed.graph.publisher("/scan", MessageType("std_msgs/String"))
    wanted = [parameter("gains.p", 2.5), parameter("rate", 3), parameter("secret.key", "y")]
    results = (await bed.call("set_parameters", parameters=wanted)).results
    assert [each.successful for each in results] == [True, False, False]
    assert "may not be set" in results[1].reason
    assert bed.arm == {"/gains/p": 2.5, "/rate": 10, "/secret/key": "x"}
    both = [parameter("gains.p", 9.5), parameter("rate", 3)]
    result = (await bed.call("set_parameters_atomically", parameters=both)).result
    assert not result.successful
    assert bed.arm["/gains/p"] == 2.5, "all or none"


class Ros2NodeWithParams:
    """A node of ROS 2 with parameters."""

    def __init__(self, bed: Bed) -> None:
        self.values: dict[str, Any] = {"rate": 10, "gains.p": 1.5, "name": "bot"}
        self.session = bed.network.session()
        node = Ros2Node(0, self.session.zid, 0, "/ns/bot")
        for number, service in enumerate(SERVICES, 1):
            kind, type_hash = TYPES.service(service)
            name = f"/ns/bot/{service}"
            endpoint = Ros2Endpoint(node, number, EntityKind.SERVICE, name, kind, type_hash, Ros2Qos())
            self.session.queryable(endpoint.key(), self._taker(service, kind))
            self.session.token(endpoint.token())
        key = data_key(0, EVENTS, EVENT_TYPE, TYPES.event_hash())
        self.events = self.session.publisher(key, ZenohQos(), lambda _: None)

    def _taker(self, service: str, kind: str) -> Any:
        def take(query: MemoryQuery) -> None:
            request = TYPES.read(f"{kind}_Request", query.payload)
            reply = TYPES.write(f"{kind}_Response", **self._answer(service, request))
            query.reply(query.key, reply, query.attachment)
            query.finish()

        return take

    def _answer(self, service: str, request: Any) -> dict[str, Any]:
        if service == "list_parameters":
            made = TYPES.make("rcl_interfaces/msg/ListParametersResult", names=list(self.values), prefixes=[])
            return {"result": made}
        if service == "get_parameters":
            return {"values": [TYPES.value(self.values.get(name)) for name in request.names]}
        results = []
        for each in request.parameters:
            fine = each.name in self.values and each.name != "name"
            if fine:
                self.values[each.name] = TYPES.plain(each.value)
            results.append(
                TYPES.make(
                    "rcl_interfaces/msg/SetParametersResult", successful=fine, reason="" if fine else "read-only"
                )
            )
        return {"results": results}

    def tell(self, name: str, value: XmlRpcValue) -> None:
        stamp = TYPES.make("builtin_interfaces/msg/Time", sec=1, nanosec=2)
        self.events.put(
            TYPES.write(
                EVENT_TYPE,
                stamp=stamp,
                node="/ns/bot",
                new_parameters=[],
                changed_parameters=[parameter(name, value)] if value is not None else [],
                deleted_parameters=[parameter(name, None)] if value is None else [],
            ),
            ATTACHMENT,
        )


KEYS = {"/ros2/ns/bot/rate": 10, "/ros2/ns/bot/gains/p": 1.5, "/ros2/ns/bot/name": "bot"}


async def test_the_parameters_of_a_node_of_ros2_are_in_the_gateways_tree(bed: Bed) -> None:
    node = Ros2NodeWithParams(bed)
    await eventually(lambda: bed.tree.values == KEYS)
    assert bed.neighbour.report()["params_in"] == {"/ns/bot": 3}
    node.tell("rate", 20)
    await eventually(lambda: bed.tree.values["/ros2/ns/bot/rate"] == 20)
    node.tell("gains.p", None)
    await eventually(lambda: "/ros2/ns/bot/gains/p" not in bed.tree.values)
    node.session.close()
    await eventually(lambda: not bed.tree.values)


async def test_what_is_set_in_the_tree_is_set_at_the_node_or_put_back(bed: Bed) -> None:
    node = Ros2NodeWithParams(bed)
    await eventually(lambda: bed.tree.values == KEYS)
    bed.tree.values |= {"/ros2/ns/bot/rate": 30, "/ros2/ns/bot/name": "other", "/ros2/ns/bot/new": 1}
    await eventually(lambda: node.values["rate"] == 30)
    await eventually(lambda: bed.tree.values == {**KEYS, "/ros2/ns/bot/rate": 30})
    assert node.values["name"] == "bot"
    problems = bed.neighbour.report()["problems"]
    assert isinstance(problems, dict)
    assert "read-only" in problems["parameter name of /ns/bot"]
