"""Services between modules and ROS 2, as rmw_zenoh's clients and servers see them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.config.rules import Crossing, CrossingRule
from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.gateway.ros2 import services
from rmpa.gateway.ros2.format import EntityKind, Ros2Attachment, Ros2Endpoint, Ros2Node, Ros2Qos
from rmpa.gateway.ros2.graph import gid_of
from rmpa.gateway.ros2.types import SERVICE_TYPE, Ros2Types
from rmpa.gateway.rules import SourceKind
from rmpa.ros.types.definitions import known_text
from rmpa.ros.types.installed import ServiceType
from tests.gateway.memory_zenoh import MemoryQuery, MemorySession, eventually
from tests.gateway.ros2.io.ros2_bed import Ros2TopicBed, topic_bed
from tests.gateway.ros2.type_descriptions import response

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

SET_BOOL = ServiceType("std_srvs/SetBool")
ADD = ServiceType("rospy_tutorials/AddTwoInts")
ADD_2 = "example_interfaces/srv/AddTwoInts"


@pytest.fixture
async def bed() -> AsyncIterator[Ros2TopicBed]:
    async with topic_bed() as made:
        for kind, name in ((ADD, ADD_2), (SET_BOOL, "")):
            made.types.service_hash(kind, name)
        yield made


def add(request: bytes) -> bytes:
    value = ADD.request.deserialize(request)
    if value.a < 0:
        raise ValueError("a is below 0")
    return ADD.response.serialize(ADD.response.make({"sum": value.a + value.b}))


def serve_ros2(session: MemorySession, endpoint: Ros2Endpoint, answer: Callable[[MemoryQuery], None]) -> Any:
    """A server of ROS 2: its token and its queryable."""
    session.queryable(endpoint.key(), answer)  # type: ignore[arg-type]
    return session.token(endpoint.token())


def describes(bed: Ros2TopicBed, node: Ros2Node, types: Ros2Types, name: str) -> list[bytes]:
    """A node of ROS 2 describes a type; returns what it was asked."""
    asked: list[bytes] = []
    names = f"{node.name}/get_type_description", SERVICE_TYPE, "RIHS01_" + "1" * 64

    def describe(query: MemoryQuery) -> None:
        asked.append(query.payload)
        query.reply(query.key, response(types, name), query.attachment)
        query.finish()

    serve_ros2(bed.ros2, Ros2Endpoint(node, 2, EntityKind.SERVICE, *names, Ros2Qos()), describe)
    return asked


async def test_a_service_of_a_module_is_called_by_ros2(bed: Ros2TopicBed) -> None:
    bed.graph.server("/add", ADD, add, node="/adder")
    await eventually(lambda: bed.own(EntityKind.SERVICE))
    (token,) = bed.own(EntityKind.SERVICE)
    assert (token.name, token.type, token.node.name) == ("/add", ADD_2, "/rmpa/arm/adder")
    client = bed.endpoint(EntityKind.CLIENT, "/add", ADD_2)
    asked = Ros2Attachment(7, 1000, gid_of(client.token()))
    (reply,) = await bed.ros2.get(client.key(), bed.cdr(f"{ADD_2}_Request", a=4, b=5), asked.serialize())
    assert reply.ok
    assert bed.read(reply.payload, f"{ADD_2}_Response").sum == 9
    answered = Ros2Attachment.parse(reply.attachment)
    assert (answered.sequence, answered.gid) == (7, asked.gid), "rmw_zenoh finds its request by these"


async def test_a_call_that_fails_is_no_response_of_ros2(bed: Ros2TopicBed) -> None:
    bed.graph.server("/add", ADD, add)
    await eventually(lambda: bed.own(EntityKind.SERVICE))
    client = bed.endpoint(EntityKind.CLIENT, "/add", ADD_2)
    attachment = Ros2Attachment(1, 0, bytes(16)).serialize()
    for request, why in ((bed.cdr(f"{ADD_2}_Request", a=-1, b=5), b"below 0"), (b"\0\1\0\0", b"cannot convert")):
        (reply,) = await bed.ros2.get(client.key(), request, attachment)
        assert not reply.ok
        assert why in reply.payload
    (reply,) = await bed.ros2.get(client.key(), bed.cdr(f"{ADD_2}_Request", a=1, b=5), b"short")
    assert not reply.ok


async def test_a_service_that_is_gone_is_gone_in_ros2(bed: Ros2TopicBed) -> None:
    source = bed.graph.server("/add", ADD, add)
    await eventually(lambda: bed.own(EntityKind.SERVICE))
    bed.graph.remove(source)
    assert bed.network.token_keys == []
    assert bed.network.queryables == []


async def test_a_service_that_left_before_it_told_its_type_is_not_asked_again(
    bed: Ros2TopicBed, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = 0

    async def describe(_source: object) -> None:
        nonlocal asked
        asked += 1
        raise UnreachableError("server", "/add")

    monkeypatch.setattr(services, "_ROS2_DESCRIBE_AGAIN", (0.001, 0.001))
    monkeypatch.setattr(bed.graph, "describe", describe)
    source = bed.graph.server("/add", ADD, add)
    await eventually(lambda: asked > 2)
    assert "cannot be asked for its type" in bed.problems["/add"]
    bed.graph.remove(source)
    await eventually(lambda: not len(bed.neighbour.context))
    assert bed.problems == {}


async def test_of_two_servers_of_one_name_one_is_called(bed: Ros2TopicBed) -> None:
    first = bed.graph.server("/add", ADD, add, node="/one")
    bed.graph.server("/add", ADD, add, node="/two")
    await eventually(lambda: bed.own(EntityKind.SERVICE))
    assert [each.node.name for each in bed.own(EntityKind.SERVICE)] == ["/rmpa/arm/one"]
    bed.graph.remove(first)
    await eventually(lambda: [each.node.name for each in bed.own(EntityKind.SERVICE)] == ["/rmpa/arm/two"])


async def test_a_service_of_ros2_is_called_by_a_node(bed: Ros2TopicBed) -> None:
    server = bed.endpoint(EntityKind.SERVICE, "/sum", ADD_2, node="/calculator")
    seen: list[Ros2Attachment] = []

    def answer(query: MemoryQuery) -> None:
        request = bed.read(query.payload, f"{ADD_2}_Request")
        seen.append(Ros2Attachment.parse(query.attachment))
        query.reply(query.key, bed.cdr(f"{ADD_2}_Response", sum=request.a + request.b), query.attachment)
        query.finish()

    serve_ros2(bed.ros2, server, answer)
    await eventually(lambda: "/sum" in bed.graph.services)
    service = bed.graph.services["/sum"]
    assert (service.source.kind, service.source.site, service.source.node) == (
        SourceKind.SERVICE, "ros2", "/calculator",
    )  # fmt: skip
    assert (await service.describe()).md5sum == ADD.md5sum
    for number in (1, 2):
        response = await service.serve(ADD.request.serialize(ADD.request.make({"a": number, "b": 2})))
        assert ADD.response.deserialize(response).sum == number + 2
    (client,) = bed.own(EntityKind.CLIENT)
    assert [(each.sequence, each.gid) for each in seen] == [(1, gid_of(client.token())), (2, gid_of(client.token()))]


async def test_an_error_of_ros2_and_a_server_that_is_gone_are_the_clients_error(bed: Ros2TopicBed) -> None:
    server = bed.endpoint(EntityKind.SERVICE, "/sum", ADD_2)
    queries: list[MemoryQuery] = []
    serve_ros2(bed.ros2, server, queries.append)
    await eventually(lambda: "/sum" in bed.graph.services)
    request = ADD.request.serialize(ADD.request.make({"a": 1, "b": 2}))
    call = asyncio.ensure_future(bed.graph.services["/sum"].serve(request))
    await eventually(lambda: len(queries) == 1)
    queries[0].reply_error("no battery")
    with pytest.raises(PeerRefused, match="no battery"):
        await call
    call = asyncio.ensure_future(bed.graph.services["/sum"].serve(request))
    await eventually(lambda: len(queries) == 2)
    queries[1].finish()
    with pytest.raises(UnreachableError):
        await call


async def test_the_next_server_of_a_name_takes_over(bed: Ros2TopicBed) -> None:
    one = serve_ros2(bed.ros2, bed.endpoint(EntityKind.SERVICE, "/sum", ADD_2, node="/one"), lambda _: None)
    await eventually(lambda: "/sum" in bed.graph.services)
    two = serve_ros2(bed.ros2, bed.endpoint(EntityKind.SERVICE, "/sum", ADD_2, node="/two"), lambda _: None)
    one.close()
    await eventually(lambda: "/sum" in bed.graph.services and bed.graph.services["/sum"].source.node == "/two")
    two.close()
    await eventually(lambda: not bed.graph.services)


async def test_a_service_whose_definition_differs_is_reported_and_not_shown(bed: Ros2TopicBed) -> None:
    node = Ros2Node(0, bed.ros2.zid, 0, "/other")
    other = Ros2Endpoint(node, 1, EntityKind.SERVICE, "/sum", ADD_2, "RIHS01_" + "0" * 64, Ros2Qos())
    unknown = Ros2Endpoint(node, 2, EntityKind.SERVICE, "/odd", "odd_msgs/srv/Odd", "RIHS01_" + "0" * 64, Ros2Qos())
    for each in (other, unknown):
        bed.ros2.token(each.token())

    problems = bed.neighbour.context.problems
    await eventually(lambda: len(problems) == 2)
    assert "definitions differ" in problems["/sum"]
    assert "odd_msgs/Odd" in problems["/odd"]
    assert not bed.graph.services


GRIP = ServiceType(
    "arm_msgs/Grip",
    "arm_msgs/Finger[] fingers\nHeader header\n---\nbool ok\ntime at\n",
    lambda name: "float32 force\nstring name\n" if name == "arm_msgs/Finger" else known_text(name),
)
GRIP_2 = "arm_msgs/srv/Grip"


async def test_a_service_of_a_type_that_ros1_lacks_is_learnt_from_its_node_and_called(bed: Ros2TopicBed) -> None:
    theirs = Ros2Types("jazzy")
    type_hash = theirs.service_hash(GRIP)
    node = Ros2Node(0, bed.ros2.zid, 0, "/gripper")
    server = Ros2Endpoint(node, 1, EntityKind.SERVICE, "/grip", GRIP_2, type_hash, Ros2Qos())
    asked = describes(bed, node, theirs, GRIP_2)

    def answer(query: MemoryQuery) -> None:
        request: Any = theirs.store.deserialize_cdr(query.payload, f"{GRIP_2}_Request")
        made: Any = theirs.store.types
        at = made["builtin_interfaces/msg/Time"](int(request.fingers[0].force), len(request.fingers))
        value = made[f"{GRIP_2}_Response"](request.fingers[1].name == "thumb", at)
        query.reply(query.key, bytes(theirs.store.serialize_cdr(value, f"{GRIP_2}_Response")), query.attachment)
        query.finish()

    serve_ros2(bed.ros2, server, answer)
    await eventually(lambda: "/grip" in bed.graph.services)
    service = bed.graph.services["/grip"]
    description = await service.describe()
    assert (description.type, description.md5sum) == ("arm_msgs/Grip", GRIP.md5sum), "a client's own definition fits"
    fingers = [{"force": 7.0, "name": "index"}, {"force": 1.0, "name": "thumb"}]
    response_1 = await service.serve(GRIP.request.serialize(GRIP.request.make({"fingers": fingers})))
    got = GRIP.response.deserialize(response_1)
    assert (got.ok, got.at.sec, got.at.nanosec) == (True, 7, 2)
    assert len(asked) == 1


async def test_a_service_that_differs_from_ros1s_is_called_by_the_fields_that_its_node_describes(
    bed: Ros2TopicBed,
) -> None:
    theirs = Ros2Types("jazzy").variant({})
    wider = ServiceType("std_srvs/SetBool", "bool data\nstring why\n---\nbool success\nstring message\n")
    name = "std_srvs/srv/SetBool"
    for part in ("", "_Request", "_Response", "_Event"):
        theirs.store.fielddefs.pop(name + part, None)
        theirs.store.types.pop(name + part, None)
    node = Ros2Node(0, bed.ros2.zid, 0, "/motor")
    server = Ros2Endpoint(node, 1, EntityKind.SERVICE, "/on", name, theirs.service_hash(wider), Ros2Qos())
    describes(bed, node, theirs, name)
    asked: list[bytes] = []

    def answer(query: MemoryQuery) -> None:
        asked.append(query.payload)
        value = theirs.store.types[f"{name}_Response"](True, "on")
        query.reply(query.key, bytes(theirs.store.serialize_cdr(value, f"{name}_Response")), query.attachment)
        query.finish()

    serve_ros2(bed.ros2, server, answer)
    await eventually(lambda: "/on" in bed.graph.services)
    service = bed.graph.services["/on"]
    assert (await service.describe()).md5sum == SET_BOOL.md5sum
    got = await service.serve(SET_BOOL.request.serialize(SET_BOOL.request.make({"data": True})))
    assert SET_BOOL.response.deserialize(got).message == "on"
    request: Any = theirs.store.deserialize_cdr(asked[0], f"{name}_Request")
    assert (request.data, request.why) == (True, "")


async def test_rules_and_use_decide_what_crosses() -> None:
    private = CrossingRule(names=("/private/**",), crossing=Crossing.NONE)
    async with topic_bed(rules=(private, CrossingRule(name="/{site}{name}"))) as bed:
        bed.types.service_hash(ADD, ADD_2)
        bed.graph.server("/private/add", ADD, add)
        bed.graph.server("/talker/set_logger_level", ServiceType("roscpp/SetLoggerLevel"), add)
        bed.graph.server("/add", ADD, add)
        bed.ros2.token(bed.endpoint(EntityKind.SERVICE, "/private/sum", ADD_2).token())
        bed.ros2.token(bed.endpoint(EntityKind.SERVICE, "/sum", ADD_2).token())
        await eventually(lambda: bed.own(EntityKind.SERVICE) and bed.graph.services)
        assert [each.name for each in bed.own(EntityKind.SERVICE)] == ["/add"]
        assert list(bed.graph.services) == ["/ros2/sum"]
