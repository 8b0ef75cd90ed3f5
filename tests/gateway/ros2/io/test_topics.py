"""Topics between modules and ROS 2, as rmw_zenoh's nodes see them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from rmpa.config.rules import Crossing, CrossingRule, GatewaySettings, Ros2Settings
from rmpa.gateway import limits
from rmpa.gateway.ros2.conversion import Conversion
from rmpa.gateway.ros2.format import (
    NO_HASH,
    EntityKind,
    Ros2Attachment,
    Ros2Durability,
    Ros2Qos,
)
from rmpa.gateway.ros2.graph import gid_of
from rmpa.gateway.ros2.ros2 import Ros2Neighbour
from rmpa.gateway.ros2.types import SERVICE_TYPE, Ros2Types
from rmpa.gateway.zenoh.threads import ZenohQos
from rmpa.ros.types.messages import MessageType
from tests.gateway.memory_zenoh import MemoryQuery, eventually
from tests.gateway.ros2.io.ros2_bed import STRING, find_none, string, topic_bed
from tests.gateway.ros2.type_descriptions import response

if TYPE_CHECKING:
    import pytest

    from rmpa.gateway.zenoh.threads import ZenohSample

LATCHED = Ros2Qos(durability=Ros2Durability.TRANSIENT_LOCAL, depth=1)
HEADER = "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id"
CUSTOM = MessageType.learn(
    "arm_msgs/Grip", f"Header header\nfloat64 width\nduration hold\nstring[] fingers\n{HEADER}"
)


# --- from the mesh to ROS 2 -----------------------------------------------------------------------------------------


async def test_a_topic_of_a_module_is_a_publisher_of_ros2() -> None:
    async with topic_bed() as bed:
        source = bed.graph.publisher("/chatter", STRING)
        (endpoint,) = bed.own(EntityKind.PUBLISHER)
        assert (endpoint.name, endpoint.type) == ("/chatter", "std_msgs/msg/String")
        assert endpoint.node.name == "/rmpa/arm/talker"
        assert endpoint.type_hash.startswith("RIHS01_df668c740482bbd48fb39d76a70dfd4b")
        assert any("/NN/%/%rmpa%arm/talker" in key for key in bed.network.token_keys)
        assert bed.graph.send(source, string("nothing crosses")) == 0
        heard: list[ZenohSample] = []
        ends = bed.subscribe("/chatter", heard)
        await eventually(lambda: bed.graph.taps)
        for text in ("one", "zwei"):
            bed.graph.send(source, string(text))
        await eventually(lambda: len(heard) == 2)
        assert [bed.read(each.payload).data for each in heard] == ["one", "zwei"]
        attached = [Ros2Attachment.parse(each.attachment) for each in heard]
        assert [each.sequence for each in attached] == [1, 2]
        assert {each.gid for each in attached} == {gid_of(endpoint.token())}
        for each in ends:
            each.close()
        await eventually(lambda: not bed.graph.taps)
        bed.graph.remove(source)
        assert bed.own(EntityKind.PUBLISHER) == []


async def test_a_latched_topic_is_transient_local_before_its_first_subscriber(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(limits, "LATCH_LOOK_AFTER", 0.0)
    async with topic_bed() as bed:
        source = bed.graph.publisher("/map", STRING, latching=True)
        bed.graph.publisher("/chatter", STRING)
        bed.graph.publisher("/camera", MessageType("sensor_msgs/Image"), latching=True)
        bed.graph.publisher("/tf_static", MessageType("tf2_msgs/TFMessage"), latching=True)

        def latched() -> list[str]:
            return sorted(each.name for each in bed.own(EntityKind.PUBLISHER) if each.qos.latched)

        assert latched() == ["/tf_static"], "that name says so"
        await eventually(lambda: latched() == ["/map", "/tf_static"])
        await eventually(lambda: not bed.graph.taps)
        late: list[ZenohSample] = []
        bed.subscribe("/map", late, qos=LATCHED)
        await eventually(lambda: bed.graph.taps)
        assert {tap.source.name for tap in bed.graph.taps} == {"/map"}, "a driver of a camera is not started by that"
        bed.graph.send(source, string("map"))
        await eventually(lambda: late)
        assert len([each for each in bed.own(EntityKind.PUBLISHER) if each.name == "/map"]) == 1


async def test_a_type_that_ros2_lacks_is_learnt_from_its_publisher() -> None:
    async with topic_bed() as bed:
        source = bed.graph.publisher("/grip", CUSTOM)
        types = Ros2Types("jazzy")
        types.learn(CUSTOM.specifications)
        await eventually(lambda: bed.own(EntityKind.PUBLISHER))
        (endpoint,) = bed.own(EntityKind.PUBLISHER)
        assert (endpoint.type, endpoint.type_hash) == (
            "arm_msgs/msg/Grip",
            types.type_hash("arm_msgs/msg/Grip"),
        )
        await eventually(lambda: not bed.graph.taps)  # only the header was wanted
        heard: list[ZenohSample] = []
        declared = bed.ros2.subscribe(endpoint.key(), heard.append)
        await eventually(lambda: bed.graph.taps)
        value = CUSTOM.make({"width": 0.5, "fingers": ["a", "b"], "hold": {"secs": -1, "nsecs": 5}})
        bed.graph.send(source, CUSTOM.serialize(value))
        await eventually(lambda: heard)
        got: Any = types.store.deserialize_cdr(heard[0].payload, "arm_msgs/msg/Grip")
        assert (got.width, got.fingers, got.hold.sec) == (0.5, ["a", "b"], -1)
        declared.close()


async def test_a_type_without_a_pair_is_told_with_what_to_write() -> None:
    other = MessageType.learn("std_msgs/String", "string text\nint32 count")
    async with topic_bed() as bed:
        source = bed.graph.publisher("/odd", other)
        bed.subscribe("/odd", [])
        await eventually(lambda: bed.problems)
        (text,) = bed.problems.values()
        assert "count, text" in text
        assert "fields_1_to_2" in text
        (way,) = bed.neighbour.ways("/odd")
        assert not way.flows
        assert way.stages[-1].text == text
        assert bed.own(EntityKind.PUBLISHER) == []
        bed.graph.remove(source)
        assert bed.problems == {}


async def test_a_subscription_with_another_hash_or_type_is_told() -> None:
    async with topic_bed() as bed:
        bed.graph.publisher("/chatter", STRING)
        bed.subscribe("/chatter", [], node="/older", type_hash="RIHS01_" + "0" * 64)
        bed.subscribe("/chatter", [], node="/humble", type_hash=NO_HASH)
        bed.subscribe("/chatter", [], node="/other", type_name="std_msgs/msg/Int32")
        ends = bed.subscribe("/chatter", [], node="/fits")
        await eventually(lambda: len(bed.problems) == 3)
        assert "definitions differ" in bed.problems["/chatter of /older"]
        assert "Humble" in bed.problems["/chatter of /humble"]
        assert "std_msgs/msg/Int32" in bed.problems["/chatter of /other"]
        (way,) = bed.neighbour.ways("/chatter")
        assert (way.peer, way.to, way.node) == ("arm", "ros2", "/talker")
        heard = next(stage for stage in way.stages if stage.name == "heard")
        assert "/older" in heard.text
        assert "/humble" in heard.text
        for each in ends:
            each.close()


async def test_humble_has_no_hash_and_longer_gids() -> None:
    async with topic_bed(ros2=Ros2Settings(distribution="humble")) as bed:
        source = bed.graph.publisher("/chatter", STRING)
        (endpoint,) = bed.own(EntityKind.PUBLISHER)
        assert endpoint.type_hash == NO_HASH
        heard: list[ZenohSample] = []
        bed.subscribe("/chatter", heard)
        await eventually(lambda: bed.graph.taps)
        bed.graph.send(source, string("hi"))
        await eventually(lambda: heard)
        assert Ros2Attachment.parse(heard[0].attachment).gid == gid_of(endpoint.token()) + bytes(8)


# --- from ROS 2 to the mesh -----------------------------------------------------------------------------------------


async def test_a_topic_of_ros2_is_a_source_of_its_node() -> None:
    async with topic_bed() as bed:
        talker = bed.publisher("/chatter")
        topic = await bed.shown("/chatter")
        assert (topic.source.site, topic.source.module, topic.source.type) == ("ros2", "", "std_msgs/String")
        assert topic.description == STRING.describe()
        talker.say("unheard")
        assert not talker.wanted
        topic.on_demand(True)
        await eventually(lambda: talker.wanted)
        (subscription,) = bed.own(EntityKind.SUBSCRIPTION)
        assert (subscription.name, subscription.node.name) == ("/chatter", "/rmpa/gate")
        talker.say("one")
        talker.say("two")
        await eventually(lambda: len(topic.messages) == 2)
        assert topic.messages == [string("one"), string("two")]
        topic.on_demand(False)
        await eventually(lambda: not talker.wanted)
        assert bed.own(EntityKind.SUBSCRIPTION) == []
        talker.close()
        await eventually(lambda: bed.topic("/chatter") is None)


async def test_a_publisher_that_restarts_loses_nothing_while_nodes_subscribe_anew() -> None:
    async with topic_bed() as bed:
        talker = bed.publisher("/chatter")
        topic = await bed.subscribed(talker)
        talker.close()
        await eventually(lambda: bed.topic("/chatter") is None)
        again = bed.publisher("/chatter")
        for number in range(60):
            again.say(f"{number}")
        topic = await bed.shown("/chatter")
        again.say("60")
        topic.on_demand(True)
        await eventually(lambda: len(topic.messages) == 61)
        assert topic.messages == [string(f"{number}") for number in range(61)]


async def test_a_header_is_numbered_as_its_publisher_numbers_its_messages() -> None:
    kind, name = MessageType("geometry_msgs/PointStamped"), "geometry_msgs/msg/PointStamped"
    async with topic_bed() as bed:
        talker = bed.publisher("/point", type_name=name)
        topic = await bed.subscribed(talker)
        conversion = Conversion(kind, name, bed.types)
        for x in (1.0, 2.0):
            talker.put(conversion.to_ros2(kind.serialize(kind.make({"point": {"x": x}}))), skip=1)
        await eventually(lambda: len(topic.messages) == 2)
        got: list[Any] = [kind.deserialize(each) for each in topic.messages]
        assert [(each.header.seq, each.point.x) for each in got] == [(2, 1.0), (4, 2.0)]


async def test_a_program_that_chooses_its_own_gid_is_heard() -> None:
    async with topic_bed() as bed:
        talker = bed.publisher("/chatter")
        talker.gid = bytes(range(16))
        topic = await bed.subscribed(talker)
        talker.say("mine")
        bare = bed.ros2.publisher(talker.endpoint.key(), ZenohQos(), lambda _: None)
        bare.put(b"\0\1\0\0\x05\0\0\0bare\0")
        await eventually(lambda: len(topic.messages) == 2)
        assert topic.messages == [string("mine"), string("bare")]


async def test_losses_are_counted_by_the_numbers() -> None:
    async with topic_bed() as bed:
        talker = bed.publisher("/chatter")
        await bed.subscribed(talker)
        talker.say("a")
        talker.say("b", skip=3)
        talker.put(b"\0\1\0\0\xff")
        (imported,) = bed.neighbour.topics.imports.values()
        await eventually(lambda: imported.unconverted)
        assert (imported.publishers["/bot"].received, imported.sequences.lost, imported.unconverted) == (2, 3, 1)
        (way,) = bed.neighbour.ways("/chatter", "ros2")
        assert way.flows
        assert "3 were lost" in way.stages[-1].text
        assert bed.neighbour.ways("/chatter", "warehouse") == []
        assert len(bed.problems) == 1


async def test_a_transient_local_topic_is_latched_here() -> None:
    async with topic_bed() as bed:
        one, two = (bed.publisher("/map", node=node, qos=LATCHED) for node in ("/one", "/two"))
        one.say("1")
        two.say("2")
        first, second = await bed.shown("/map", "/one"), await bed.shown("/map", "/two")
        assert first.description is not None
        assert first.description.latching
        first.on_demand(True)
        await eventually(lambda: first.messages)
        assert first.messages == [string("1")]
        second.on_demand(True)
        await eventually(lambda: second.messages)
        assert second.messages == [string("2")], "the history came with the first subscriber"
        first.on_demand(False)
        first.on_demand(True)
        assert first.messages[1] == b"forgotten", "what is latched may be old by then"


async def test_a_transient_local_publisher_that_comes_later_has_its_history_asked() -> None:
    async with topic_bed() as bed:
        plain = bed.publisher("/map", node="/plain")
        await bed.subscribed(plain)
        late = bed.publisher("/map", node="/late", qos=LATCHED)
        late.say("kept")
        topic = await bed.shown("/map", "/late")
        topic.on_demand(True)
        await eventually(lambda: topic.messages)
        assert topic.messages[0] == string("kept")


def describe(types: Ros2Types, name: str, query: MemoryQuery) -> None:
    """What a ROS 2 node answers when it is asked for its type."""
    query.reply(query.key, response(types, name), query.attachment)
    query.finish()


async def test_the_fields_of_a_type_that_only_ros2_has_are_asked_of_its_node() -> None:
    name = "base_msgs/msg/Wheels"
    theirs = Ros2Types("jazzy")
    theirs.learn(
        MessageType.learn("base_msgs/Wheels", "float64[4] speed\nstring[] names\nint32 count").specifications
    )
    async with topic_bed() as bed:
        server = bed.endpoint(
            EntityKind.SERVICE, "/base/get_type_description", SERVICE_TYPE, "/base", type_hash="RIHS01_" + "1" * 64
        )
        bed.ros2.queryable(server.key(), lambda query: describe(theirs, name, query))  # type: ignore[arg-type]
        publisher = bed.publisher("/wheels", node="/base", type_name=name, type_hash=theirs.type_hash(name))
        bed.ros2.token(server.token())
        await eventually(lambda: (topic := bed.topic("/wheels", "/base")) and topic.description)
        topic = bed.topic("/wheels", "/base")
        assert topic is not None
        assert topic.description is not None
        kind = MessageType.learn(topic.description.type, topic.description.definition, topic.description.md5sum)
        assert [str(field) for field in kind.fields] == ["float64[4]", "string[]", "int32"]
        topic.on_demand(True)
        await eventually(lambda: publisher.wanted)
        import numpy as np

        value = theirs.store.types[name](np.array([1.0, 2, 3, 4]), ["a"], -7)
        publisher.put(bytes(theirs.store.serialize_cdr(value, name)))
        await eventually(lambda: topic.messages)
        got = kind.deserialize(topic.messages[0])
        assert (list(got.speed), got.names, got.count) == ([1.0, 2.0, 3.0, 4.0], ["a"], -7)


async def test_a_type_that_no_one_describes_is_told_with_what_to_do() -> None:
    async with topic_bed() as bed:
        bed.publisher("/wheels", node="/base", type_name="base_msgs/msg/Wheels", type_hash="RIHS01_" + "2" * 64)
        bed.publisher("/chatter", node="/old", type_hash="RIHS01_" + "2" * 64)
        await eventually(lambda: len(bed.problems) == 2, limits.ROS2_SERVICE_WAIT + 20)
        texts = sorted(bed.problems.values())
        assert "start_type_description_service" in texts[1]
        assert "gateway.ros2.distribution" in texts[0] + texts[1]
        assert all(each.problem for each in bed.neighbour.topics.imports.values())


async def test_a_type_that_is_learnt_later_makes_the_topic_known() -> None:
    theirs = Ros2Types("jazzy")
    theirs.learn(CUSTOM.specifications)
    type_hash = theirs.type_hash("arm_msgs/msg/Grip")
    async with topic_bed() as bed:
        bed.publisher("/grip_state", type_name="arm_msgs/msg/Grip", type_hash=type_hash)
        topic = await bed.shown("/grip_state")
        assert topic.description is None
        bed.graph.publisher("/grip", CUSTOM)
        await eventually(lambda: topic.description)
        assert topic.description == CUSTOM.describe()


async def test_no_more_nodes_are_asked_at_one_time_than_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ROS2_ASKS_MAX", 3)
    monkeypatch.setattr(limits, "ROS2_SERVICE_WAIT", 60.0)
    async with topic_bed() as bed:
        for number in range(5):
            bed.publisher(f"/t{number}", type_name=f"odd_msgs/msg/T{number}", type_hash="RIHS01_" + "3" * 64)
        await eventually(lambda: len(bed.problems) == 2)
        assert all("asked for types already" in text for text in bed.problems.values())


# --- rules, and what is not believed --------------------------------------------------------------------------------


async def test_rules_decide_what_crosses_and_its_name() -> None:
    rules = (
        CrossingRule(names=("/secret",), crossing=Crossing.NONE),
        CrossingRule(names=("/in",), sites=("ros2",), crossing=Crossing.IN, name="/{site}{name}"),
    )
    async with topic_bed(rules=rules) as bed:
        for name in ("/secret", "/in", "/out"):
            bed.graph.publisher(name, STRING)
            bed.publisher(name)
        bed.publisher("/rosout")
        bed.publisher("/a/_action/feedback")
        await eventually(lambda: len(bed.graph.topics) == 2)
        assert sorted(name for name, _ in bed.graph.topics) == ["/out", "/ros2/in"]
        assert [each.name for each in bed.own(EntityKind.PUBLISHER)] == ["/out"]
        assert "gateway.rule 1" in bed.neighbour.topics.refused["/secret of /bot"]
        ways = bed.neighbour.ways("/secret")
        assert {(way.peer, way.to) for way in ways} == {("ros2", "gate"), ("gate", "ros2")}
        assert not any(way.flows for way in ways)


async def test_a_rate_limit_is_kept_and_counted() -> None:
    async with topic_bed(rules=(CrossingRule(rate=2.0),)) as bed:
        source = bed.graph.publisher("/chatter", STRING)
        heard: list[ZenohSample] = []
        bed.subscribe("/chatter", heard)
        await eventually(lambda: bed.graph.taps)
        for _ in range(50):
            bed.graph.send(source, string("x"))
        ((export, _),) = bed.neighbour.topics.exports()
        assert export.messages + export.limited == 50
        assert export.limited >= 40


async def test_of_two_gateways_of_one_mesh_one_shows_a_node_and_the_other_takes_over() -> None:
    async with topic_bed() as bed:
        second = cast("Any", bed.network.session())
        gateways = [Ros2Neighbour(cast("Any", bed.graph), second, GatewaySettings(), find=find_none)]
        gateways[0].start()
        source = bed.graph.publisher("/chatter", STRING)
        await eventually(lambda: len(bed.own(EntityKind.PUBLISHER)) == 1)
        (first,) = bed.own(EntityKind.PUBLISHER)
        assert first.node.zid == bed.neighbour.context.session.zid
        assert gateways[0].report()["standing_by"] == {"/rmpa/arm/talker": first.node.zid}
        heard: list[ZenohSample] = []
        bed.subscribe("/chatter", heard)
        await eventually(lambda: bed.graph.taps)
        assert bed.graph.send(source, string("once")) == 1
        other = bed.graph.publisher("/second", STRING)
        await eventually(lambda: len(bed.own(EntityKind.PUBLISHER)) == 2)
        await bed.neighbour.close()
        await eventually(lambda: len(bed.own(EntityKind.PUBLISHER)) == 2)
        await eventually(lambda: bed.graph.taps)
        assert {each.node.zid for each in bed.own(EntityKind.PUBLISHER)} == {gateways[0].context.session.zid}
        bed.graph.send(source, string("twice"))
        await eventually(lambda: len(heard) == 2)
        for each in (source, other):
            bed.graph.remove(each)
        assert gateways[0].report()["standing_by"] == {}
        await gateways[0].close()
