"""Actions between a module and ROS 2 through the gateway's neighbour: each side's topics, services and tokens."""

from __future__ import annotations

import asyncio
import struct
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.config.rules import GatewaySettings
from rmpa.gateway.ros2.actions import Ros2Actions
from rmpa.gateway.ros2.conversion import ActionPair
from rmpa.gateway.ros2.format import (
    EntityKind,
    Ros2Attachment,
    Ros2Endpoint,
    Ros2Node,
    Ros2Qos,
    data_key,
    parse_token,
)
from rmpa.gateway.ros2.ros2 import Ros2Neighbour
from rmpa.gateway.ros2.types import SERVICE_TYPE, Ros2Types, TypePair
from rmpa.gateway.zenoh.threads import ZenohQos
from rmpa.ros.types.definitions import SEPARATOR, known_text
from rmpa.ros.types.messages import MessageType
from tests.gateway.memory_graph import MemoryGraph
from tests.gateway.memory_zenoh import MemoryQuery, MemoryZenoh, eventually
from tests.gateway.ros2.type_descriptions import response

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.gateway.rules import MeshSource

JAZZY = Ros2Types("jazzy")
TEST = [MessageType(f"actionlib/Test{part}") for part in ("Goal", "Result", "Feedback")]
TYPES = ActionPair(TEST, TypePair("actionlib/action/Test"), JAZZY).types
ACTION = {part: MessageType(f"actionlib/TestAction{part.title()}") for part in ("goal", "feedback", "result")}
ACTION["status"] = MessageType("actionlib_msgs/GoalStatusArray")
ACTION["cancel"] = MessageType("actionlib_msgs/GoalID")
UUID = bytes(range(16))


def blocks(*names: str) -> str:
    """The blocks of embedded types in a definition."""
    return "".join(f"{SEPARATOR}\nMSG: {name}\n{known_text(name)}\n" for name in names)


POINT = blocks("geometry_msgs/Point")
ATTACHMENT = Ros2Attachment(3, 1, bytes(16)).serialize()


def key(part: str) -> str:
    return data_key(0, f"/count/_action/{part}", *TYPES[part])


def made(part: str, **values: Any) -> bytes:
    return ACTION[part].serialize(ACTION[part].make(values))


class Bed:
    """A gateway's neighbour ROS 2 with its part for actions, and a session of a program of ROS 2."""

    def __init__(self) -> None:
        self.network = MemoryZenoh()
        self.graph = MemoryGraph()
        self.ros2 = self.network.session()
        own = self.network.session()
        self.neighbour = Ros2Neighbour(cast("Any", self.graph), cast("Any", own), GatewaySettings())

    def endpoints(self, node: str) -> set[str]:
        tokens = [parse_token(each) for each in self.network.token_keys]
        return {each.name for each in tokens if isinstance(each, Ros2Endpoint) and each.node.name == node}

    def ros1_server(self) -> dict[str, MeshSource]:
        parts = ("status", "feedback", "result")
        return {part: self.graph.publisher(f"/count/{part}", ACTION[part], "/counter") for part in parts}


@pytest.fixture
async def bed() -> AsyncIterator[Bed]:
    bed = Bed()
    bed.neighbour.start()
    yield bed
    await bed.neighbour.close()
    assert not bed.graph.topics
    assert not bed.graph.taps


async def test_a_server_of_ros1_that_goes_aborts_the_goal_of_ros2(bed: Bed) -> None:
    server = bed.ros1_server()
    await eventually(lambda: len(bed.endpoints("/rmpa/arm/counter")) == 5)
    for part in ("goal", "cancel"):
        bed.graph.topics[f"/count/{part}", "/action_clients"].on_demand(True)
    sending = asyncio.ensure_future(
        bed.ros2.get(key("send_goal"), b"\0\1\0\0" + UUID + b"\7\0\0\0", ATTACHMENT, timeout=20)
    )
    goal = bed.graph.topics["/count/goal", "/action_clients"]
    await eventually(lambda: goal.messages)
    name = ACTION["goal"].deserialize(goal.messages[0]).goal_id.id
    bed.graph.send(server["status"], made("status", status_list=[{"goal_id": {"id": name}, "status": 1}]))
    await sending
    waiting = asyncio.ensure_future(bed.ros2.get(key("get_result"), b"\0\1\0\0" + UUID, ATTACHMENT, timeout=20))
    await asyncio.sleep(0)
    await eventually(lambda: bed.network.queryables)
    for _ in range(3):
        await asyncio.sleep(0)  # the query is delivered
    for source in server.values():
        bed.graph.remove(source)
    (reply,) = await waiting
    assert (reply.ok, reply.payload[4]) == (True, 6)
    assert not bed.endpoints("/rmpa/arm/counter")


DOCK = [
    MessageType.learn("dock_msgs/DockGoal", "geometry_msgs/Point place\nuint16 tries\n" + POINT),
    MessageType.learn("dock_msgs/DockResult", "string where\n"),
    MessageType.learn("dock_msgs/DockFeedback", "float32 left\n"),
]


async def test_an_action_of_a_type_that_ros1_lacks_is_learnt_from_its_server(bed: Bed) -> None:
    theirs = Ros2Types("jazzy")
    action = "dock_msgs/action/Dock"
    pair = ActionPair(DOCK, TypePair(action), theirs)
    types, session = pair.types, bed.network.session()
    node = Ros2Node(0, session.zid, 0, "/docker")
    goals: list[MemoryQuery] = []
    results: list[MemoryQuery] = []
    numbers = iter(range(1, 100))

    def declare(kind: EntityKind, name: str, type_name: str, type_hash: str) -> Ros2Endpoint:
        endpoint = Ros2Endpoint(node, next(numbers), kind, name, type_name, type_hash, Ros2Qos())
        session.token(endpoint.token())
        return endpoint

    def describe(query: MemoryQuery) -> None:
        asked = [
            types[part][0]
            for part in ("send_goal", "get_result", "feedback")
            if types[part][0].encode() in query.payload
        ]
        query.reply(query.key, response(theirs, asked[0]), query.attachment)
        query.finish()

    head = "/dock/_action"
    send = declare(EntityKind.SERVICE, f"{head}/send_goal", *types["send_goal"])
    session.queryable(send.key(), goals.append)  # type: ignore[arg-type]
    get = declare(EntityKind.SERVICE, f"{head}/get_result", *types["get_result"])
    session.queryable(get.key(), results.append)  # type: ignore[arg-type]
    told = declare(EntityKind.PUBLISHER, f"{head}/feedback", *types["feedback"])
    service = "/docker/get_type_description"
    describer = declare(EntityKind.SERVICE, service, SERVICE_TYPE, "RIHS01_" + "1" * 64)
    session.queryable(describer.key(), describe)  # type: ignore[arg-type]

    await eventually(lambda: len(bed.graph.topics) == 3)
    status, feedback, result = (bed.graph.topics[f"/dock/{p}", "/docker"] for p in ("status", "feedback", "result"))
    assert result.description is not None
    assert result.description.type == "dock_msgs/DockActionResult"
    own = MessageType.learn(result.description.type, result.description.definition, result.description.md5sum)
    status.on_demand(True)
    goal_type = MessageType.learn(
        "dock_msgs/DockActionGoal",
        "Header header\nactionlib_msgs/GoalID goal_id\ndock_msgs/DockGoal goal\n"
        + blocks("std_msgs/Header", "actionlib_msgs/GoalID")
        + f"{SEPARATOR}\nMSG: dock_msgs/DockGoal\n{DOCK[0].definition}",
    )
    client = bed.graph.publisher("/dock/goal", goal_type, "/client")
    goal = goal_type.make({"goal_id": {"id": "g1"}, "goal": {"place": {"x": 2.0}, "tries": 9}})
    bed.graph.send(client, goal_type.serialize(goal))
    await eventually(lambda: goals)
    request: Any = theirs.store.deserialize_cdr(goals[0].payload, f"{types['send_goal'][0]}_Request")
    assert (request.goal.place.x, request.goal.tries) == (2.0, 9)
    goals[0].reply(goals[0].key, b"\0\1\0\0\1" + bytes(11), goals[0].attachment)
    goals[0].finish()
    await eventually(lambda: results)
    session.publisher(told.key(), ZenohQos(), lambda _: None).put(
        b"\0\1\0\0" + goals[0].payload[4:20] + struct.pack("<f", 0.5)
    )
    await eventually(lambda: feedback.messages)
    value: Any = theirs.store.types[f"{types['get_result'][0]}_Response"](
        4, theirs.store.types[f"{action}_Result"]("home")
    )
    payload = bytes(theirs.store.serialize_cdr(value, f"{types['get_result'][0]}_Response"))
    results[0].reply(results[0].key, payload, results[0].attachment)
    results[0].finish()
    await eventually(lambda: result.messages)
    got = own.deserialize(result.messages[0])
    assert (got.status.status, got.result.where) == (3, "home")
    session.close()
    await eventually(lambda: not bed.graph.topics)


async def test_other_topics_of_such_names_are_left_to_other_parts(bed: Bed) -> None:
    part = Ros2Actions(bed.neighbour.context)
    text = MessageType("std_msgs/String")
    assert not part.mesh_source(bed.graph.publisher("/door/status", text), there=True)
    assert not part.mesh_source(bed.graph.publisher("/goal", text), there=True)
    assert part.mesh_source(bed.graph.publisher("/do/goal", ACTION["goal"]), there=True)
