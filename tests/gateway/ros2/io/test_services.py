"""Services between modules and ROS 2, as rmw_zenoh's clients and servers see them."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from rmpa.config.rules import Crossing, CrossingRule
from rmpa.core.errors import PeerRefused, UnreachableError
from rmpa.gateway.ros2 import services
from rmpa.gateway.ros2.format import EntityKind, Ros2Attachment, gid_of
from rmpa.gateway.ros2.types import Ros2Types
from rmpa.gateway.rules import SourceKind
from rmpa.gateway.zenoh.threads import ZenohSample
from rmpa.ros.types.definitions import known_text
from rmpa.ros.types.installed import ServiceType
from tests.gateway.memory_graph import MemoryService
from tests.gateway.memory_zenoh import MemoryQuery, eventually
from tests.gateway.ros2.io.ros2_bed import NO_TYPE, Ros2Bed, cdr, ros2_bed

ADD = ServiceType("rospy_tutorials/AddTwoInts")
ADD_2 = "example_interfaces/srv/AddTwoInts"


@pytest.fixture(autouse=True)
def _types(bed: Ros2Bed) -> None:
    bed.types.service_hash(ADD, ADD_2)


def add(request: bytes) -> bytes:
    value = ADD.request.deserialize(request)
    if value.a < 0:
        raise ValueError("a is below 0")
    return ADD.response.serialize(ADD.response.make({"sum": value.a + value.b}))


def asking(kind: ServiceType, **values: Any) -> bytes:
    """A request of ROS 1."""
    return kind.request.serialize(kind.request.make(values))


def servers(bed: Ros2Bed) -> list[str]:
    """The nodes that have a service of a module in ROS 2's graph."""
    return [each.node.name for each in bed.own(EntityKind.SERVICE)]


async def call(
    bed: Ros2Bed, request: bytes | None = None, attachment: bytes | None = None, **values: int
) -> ZenohSample:
    """A call of /add by a client of ROS 2."""
    client = bed.endpoint(EntityKind.CLIENT, "/add", ADD_2)
    attached = Ros2Attachment(7, 1000, gid_of("a token")).serialize() if attachment is None else attachment
    made = bed.cdr(f"{ADD_2}_Request", **values) if request is None else request
    (reply,) = await bed.ros2.get(client.key(), made, attached)
    return reply


async def shown(bed: Ros2Bed, name: str) -> MemoryService:
    await eventually(lambda: name in bed.graph.services)
    return bed.graph.services[name]


# --- of modules, called by ROS 2 ------------------------------------------------------------------------------------


async def test_a_service_of_a_module_is_called_by_ros2_until_it_is_gone(bed: Ros2Bed) -> None:
    source = bed.graph.server("/add", ADD, add, node="/adder")
    await eventually(lambda: servers(bed))
    (token,) = bed.own(EntityKind.SERVICE)
    assert (token.name, token.type, token.node.name) == ("/add", ADD_2, "/rmpa/arm/adder")
    reply = await call(bed, a=4, b=5)
    assert (reply.ok, bed.read(reply.payload, f"{ADD_2}_Response").sum) == (True, 9)
    answered = Ros2Attachment.parse(reply.attachment)
    assert (answered.sequence, answered.gid) == (7, gid_of("a token")), "rmw_zenoh finds its request by these"
    bed.graph.remove(source)
    assert (bed.network.token_keys, bed.network.queryables) == ([], [])


async def test_a_call_that_fails_is_no_response_of_ros2(bed: Ros2Bed) -> None:
    bed.graph.server("/add", ADD, add)
    await eventually(lambda: servers(bed))
    for reply, why in (
        (await call(bed, a=-1, b=5), b"below 0"),
        (await call(bed, b"\0\1\0\0"), b"cannot convert"),
        (await call(bed, attachment=b"short", a=1, b=5), b"attachment"),
    ):
        assert (reply.ok, why in reply.payload) == (False, True)


async def test_a_service_that_left_before_it_told_its_type_is_not_asked_again(
    bed: Ros2Bed, monkeypatch: pytest.MonkeyPatch
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


async def test_of_two_servers_of_one_name_one_is_called(bed: Ros2Bed) -> None:
    first = bed.graph.server("/add", ADD, add, node="/one")
    bed.graph.server("/add", ADD, add, node="/two")
    await eventually(lambda: servers(bed))
    assert servers(bed) == ["/rmpa/arm/one"]
    bed.graph.remove(first)
    await eventually(lambda: servers(bed) == ["/rmpa/arm/two"])


# --- of ROS 2, called by a node -------------------------------------------------------------------------------------


async def test_a_service_of_ros2_is_called_by_a_node(bed: Ros2Bed) -> None:
    seen: list[Ros2Attachment] = []

    def answer(query: MemoryQuery) -> None:
        request = bed.read(query.payload, f"{ADD_2}_Request")
        seen.append(Ros2Attachment.parse(query.attachment))
        query.answer(bed.cdr(f"{ADD_2}_Response", sum=request.a + request.b))

    bed.server("/sum", ADD_2, answer, node="/calculator")
    service = await shown(bed, "/sum")
    source = service.source
    assert (source.kind, source.site, source.node) == (SourceKind.SERVICE, "ros2", "/calculator")
    assert (await service.describe()).md5sum == ADD.md5sum
    for number in (1, 2):
        assert ADD.response.deserialize(await service.serve(asking(ADD, a=number, b=2))).sum == number + 2
    (client,) = bed.own(EntityKind.CLIENT)
    assert [(each.sequence, each.gid) for each in seen] == [(n, gid_of(client.token())) for n in (1, 2)]


async def test_an_error_of_ros2_and_a_server_that_is_gone_are_the_clients_error(bed: Ros2Bed) -> None:
    queries: list[MemoryQuery] = []
    bed.server("/sum", ADD_2, queries.append)
    service = await shown(bed, "/sum")
    for end, error in (
        (lambda query: query.reply_error("no battery"), pytest.raises(PeerRefused, match="no battery")),
        (MemoryQuery.finish, pytest.raises(UnreachableError)),
    ):
        under_way = asyncio.ensure_future(service.serve(asking(ADD, a=1, b=2)))
        await eventually(lambda: queries)
        end(queries.pop())
        with error:
            await under_way


async def test_the_next_server_of_a_name_takes_over(bed: Ros2Bed) -> None:
    one = bed.server("/sum", ADD_2, node="/one")
    await shown(bed, "/sum")
    two = bed.server("/sum", ADD_2, node="/two")
    one.close()
    await eventually(lambda: "/sum" in bed.graph.services and bed.graph.services["/sum"].source.node == "/two")
    two.close()
    await eventually(lambda: not bed.graph.services)


async def test_a_service_whose_definition_differs_is_reported_and_not_shown(
    bed: Ros2Bed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rmpa.gateway.limits.ROS2_SERVICE_WAIT", 0.05)
    bed.server("/sum", ADD_2, type_hash=NO_TYPE)
    bed.server("/odd", "odd_msgs/srv/Odd", type_hash=NO_TYPE)
    await eventually(lambda: len(bed.problems) == 2)
    assert "definitions differ" in bed.problems["/sum"]
    assert "odd_msgs/Odd" in bed.problems["/odd"]
    assert not bed.graph.services


GRIP = ServiceType(
    "arm_msgs/Grip",
    "arm_msgs/Finger[] fingers\nHeader header\n---\nbool ok\ntime at\n",
    lambda name: "float32 force\nstring name\n" if name == "arm_msgs/Finger" else known_text(name),
)


async def test_a_service_of_a_type_that_ros1_lacks_is_learnt_from_its_node_and_called(bed: Ros2Bed) -> None:
    theirs, name = Ros2Types("jazzy"), "arm_msgs/srv/Grip"
    type_hash = theirs.service_hash(GRIP)
    asked = bed.describes("/gripper", theirs, name)

    def answer(query: MemoryQuery) -> None:
        request: Any = theirs.store.deserialize_cdr(query.payload, f"{name}_Request")
        time = theirs.store.types["builtin_interfaces/msg/Time"]
        at = time(int(request.fingers[0].force), len(request.fingers))
        query.answer(cdr(theirs, f"{name}_Response", request.fingers[1].name == "thumb", at))

    bed.server("/grip", name, answer, node="/gripper", type_hash=type_hash)
    service = await shown(bed, "/grip")
    description = await service.describe()
    assert (description.type, description.md5sum) == ("arm_msgs/Grip", GRIP.md5sum), "a client's own definition fits"
    fingers = [{"force": 7.0, "name": "index"}, {"force": 1.0, "name": "thumb"}]
    got = GRIP.response.deserialize(await service.serve(asking(GRIP, fingers=fingers)))
    assert (got.ok, got.at.sec, got.at.nanosec) == (True, 7, 2)
    assert len(asked) == 1


async def test_rules_and_use_decide_what_crosses() -> None:
    private = CrossingRule(names=("/private/**",), crossing=Crossing.NONE)
    async with ros2_bed(rules=(private, CrossingRule(name="/{site}{name}"))) as bed:
        bed.types.service_hash(ADD, ADD_2)
        bed.graph.server("/private/add", ADD, add)
        bed.graph.server("/talker/set_logger_level", ServiceType("roscpp/SetLoggerLevel"), add)
        bed.graph.server("/add", ADD, add)
        for name in ("/private/sum", "/sum"):
            bed.server(name, ADD_2)
        await eventually(lambda: servers(bed) and bed.graph.services)
        assert [each.name for each in bed.own(EntityKind.SERVICE)] == ["/add"]
        assert list(bed.graph.services) == ["/ros2/sum"]
