"""Topics between modules and ROS 2, as rmw_zenoh's nodes see them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rmpa.config.rules import Crossing, CrossingRule, Ros2Settings
from rmpa.gateway import limits
from rmpa.gateway.ros2.conversion import Conversion
from rmpa.gateway.ros2.format import NO_HASH, EntityKind, Ros2Attachment, Ros2Durability, Ros2Qos, gid_of
from rmpa.gateway.ros2.types import Ros2Types
from rmpa.gateway.zenoh.threads import ZenohQos
from rmpa.ros.types.messages import MessageType
from tests.gateway.memory_zenoh import eventually
from tests.gateway.ros2.io.ros2_bed import NO_TYPE, STRING, Ros2Bed, cdr, ros2_bed, string

LATCHED = Ros2Qos(durability=Ros2Durability.TRANSIENT_LOCAL, depth=1)
HEADER = "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id"
CUSTOM = MessageType.learn(
    "arm_msgs/Grip", f"Header header\nfloat64 width\nduration hold\nstring[] fingers\n{HEADER}"
)


def types_with(kind: MessageType) -> Ros2Types:
    types = Ros2Types("jazzy")
    types.learn(kind.specifications)
    return types


# --- from the mesh to ROS 2 -----------------------------------------------------------------------------------------


async def test_a_topic_of_a_module_is_a_publisher_of_ros2(bed: Ros2Bed) -> None:
    source = bed.graph.publisher("/chatter", STRING)
    (endpoint,) = bed.own(EntityKind.PUBLISHER)
    assert (endpoint.name, endpoint.type, endpoint.node.name) == (
        "/chatter", "std_msgs/msg/String", "/rmpa/arm/talker",
    )  # fmt: skip
    assert endpoint.type_hash.startswith("RIHS01_df668c740482bbd48fb39d76a70dfd4b")
    assert any("/NN/%/%rmpa%arm/talker" in key for key in bed.network.token_keys)
    assert bed.graph.send(source, string("nothing crosses")) == 0
    chatter = bed.subscribe("/chatter")
    await eventually(lambda: bed.graph.taps)
    for text in ("one", "zwei"):
        bed.graph.send(source, string(text))
    await eventually(lambda: len(chatter.heard) == 2)
    assert [bed.read(each.payload).data for each in chatter.heard] == ["one", "zwei"]
    attached = [Ros2Attachment.parse(each.attachment) for each in chatter.heard]
    assert [(each.sequence, each.gid) for each in attached] == [(n, gid_of(endpoint.token())) for n in (1, 2)]
    chatter.close()
    await eventually(lambda: not bed.graph.taps)
    bed.graph.remove(source)
    assert bed.own(EntityKind.PUBLISHER) == []


async def test_a_latched_topic_is_transient_local_before_its_first_subscriber(
    monkeypatch: pytest.MonkeyPatch, bed: Ros2Bed
) -> None:
    monkeypatch.setattr(limits, "LATCH_LOOK_AFTER", 0.0)
    source = bed.graph.publisher("/map", STRING, latching=True)
    bed.graph.send(source, string("early"))
    bed.graph.publisher("/chatter", STRING)
    bed.graph.publisher("/camera", MessageType("sensor_msgs/Image"), latching=True)
    bed.graph.publisher("/tf_static", MessageType("tf2_msgs/TFMessage"), latching=True)

    def latched() -> list[str]:
        return sorted(each.name for each in bed.own(EntityKind.PUBLISHER) if each.qos.latched)

    assert latched() == ["/tf_static"], "that name says so"
    await eventually(lambda: latched() == ["/map", "/tf_static"])
    await eventually(lambda: not bed.graph.taps)
    late = bed.subscribe("/map", qos=LATCHED)
    await eventually(lambda: bed.graph.taps)
    assert {tap.source.name for tap in bed.graph.taps} == {"/map"}, "a driver of a camera is not started by that"
    bed.graph.send(source, string("map"))
    await eventually(lambda: len(late.heard) >= 2)
    heard = [bed.read(each.payload).data for each in late.heard]
    assert heard == ["early", "map"], "what came while it was asked is not kept beside"
    assert len([each for each in bed.own(EntityKind.PUBLISHER) if each.name == "/map"]) == 1


async def test_a_type_that_ros2_lacks_is_learnt_from_its_publisher(bed: Ros2Bed) -> None:
    source, types, name = bed.graph.publisher("/grip", CUSTOM), types_with(CUSTOM), "arm_msgs/msg/Grip"
    await eventually(lambda: bed.own(EntityKind.PUBLISHER))
    (endpoint,) = bed.own(EntityKind.PUBLISHER)
    assert (endpoint.type, endpoint.type_hash) == (name, types.type_hash(name))
    await eventually(lambda: not bed.graph.taps)  # only the header was wanted
    grip = bed.subscribe("/grip", type_name=name, type_hash=endpoint.type_hash)
    await eventually(lambda: bed.graph.taps)
    value = CUSTOM.make({"width": 0.5, "fingers": ["a", "b"], "hold": {"secs": -1, "nsecs": 5}})
    bed.graph.send(source, CUSTOM.serialize(value))
    await eventually(lambda: grip.heard)
    got: Any = types.store.deserialize_cdr(grip.heard[0].payload, name)
    assert (got.width, got.fingers, got.hold.sec) == (0.5, ["a", "b"], -1)


async def test_a_type_without_a_pair_is_told_with_what_to_write(bed: Ros2Bed) -> None:
    source = bed.graph.publisher("/odd", MessageType.learn("std_msgs/String", "string text\nint32 count"))
    bed.subscribe("/odd")
    await eventually(lambda: bed.problems)
    (text,) = bed.problems.values()
    assert "count, text" in text
    assert "fields_1_to_2" in text
    (way,) = bed.neighbour.ways("/odd")
    assert (way.flows, way.stages[-1].text) == (False, text)
    assert bed.own(EntityKind.PUBLISHER) == []
    bed.graph.remove(source)
    assert bed.problems == {}


async def test_a_subscription_with_another_hash_or_type_is_told(bed: Ros2Bed) -> None:
    bed.graph.publisher("/chatter", STRING)
    for node, more in (
        ("/older", {"type_hash": NO_TYPE}),
        ("/humble", {"type_hash": NO_HASH}),
        ("/other", {"type_name": "std_msgs/msg/Int32"}),
        ("/fits", {}),
    ):
        bed.subscribe("/chatter", node=node, **more)  # fmt: skip
    await eventually(lambda: len(bed.problems) == 3)
    for node, text in (("older", "definitions differ"), ("humble", "Humble"), ("other", "std_msgs/msg/Int32")):
        assert text in bed.problems[f"/chatter of /{node}"]
    await eventually(lambda: bed.graph.taps)
    (way,) = bed.neighbour.ways("/chatter")
    assert (way.peer, way.to, way.node) == ("arm", "ros2", "/talker")
    heard = next(stage for stage in way.stages if stage.name == "heard")
    assert "/older" in heard.text
    assert "/humble" in heard.text


async def test_humble_has_no_hash_and_longer_gids() -> None:
    async with ros2_bed(ros2=Ros2Settings(distribution="humble")) as bed:
        source = bed.graph.publisher("/chatter", STRING)
        (endpoint,) = bed.own(EntityKind.PUBLISHER)
        assert endpoint.type_hash == NO_HASH
        chatter = bed.subscribe("/chatter")
        await eventually(lambda: bed.graph.taps)
        bed.graph.send(source, string("hi"))
        await eventually(lambda: chatter.heard)
        assert Ros2Attachment.parse(chatter.heard[0].attachment).gid == gid_of(endpoint.token()) + bytes(8)


# --- from ROS 2 to the mesh -----------------------------------------------------------------------------------------


async def test_a_topic_of_ros2_is_a_source_of_its_node(bed: Ros2Bed) -> None:
    talker = bed.publisher("/chatter")
    topic = await bed.shown("/chatter")
    assert (topic.source.site, topic.source.module, topic.source.type) == ("ros2", "", "std_msgs/String")
    assert topic.description == STRING.describe()
    talker.say("unheard")
    assert not talker.wanted
    await bed.subscribed(talker)
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


async def test_a_publisher_that_restarts_loses_nothing_while_nodes_subscribe_anew(bed: Ros2Bed) -> None:
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


async def test_a_header_is_numbered_as_its_publisher_numbers_its_messages(bed: Ros2Bed) -> None:
    kind, name = MessageType("geometry_msgs/PointStamped"), "geometry_msgs/msg/PointStamped"
    talker = bed.publisher("/point", type_name=name)
    topic = await bed.subscribed(talker)
    conversion = Conversion(kind, name, bed.types)
    for x in (1.0, 2.0):
        talker.put(conversion.to_ros2(kind.serialize(kind.make({"point": {"x": x}}))), skip=1)
    await eventually(lambda: len(topic.messages) == 2)
    got: list[Any] = [kind.deserialize(each) for each in topic.messages]
    assert [(each.header.seq, each.point.x) for each in got] == [(2, 1.0), (4, 2.0)]


async def test_a_program_that_chooses_its_own_gid_is_heard(bed: Ros2Bed) -> None:
    talker = bed.publisher("/chatter")
    talker.gid = bytes(range(16))
    topic = await bed.subscribed(talker)
    talker.say("mine")
    bare = bed.ros2.publisher(talker.endpoint.key(), ZenohQos(), lambda _: None)
    bare.put(b"\0\1\0\0\x05\0\0\0bare\0")
    await eventually(lambda: len(topic.messages) == 2)
    assert topic.messages == [string("mine"), string("bare")]


async def test_losses_are_counted_by_the_numbers(bed: Ros2Bed) -> None:
    talker = bed.publisher("/chatter")
    await bed.subscribed(talker)
    talker.say("a")
    talker.say("b", skip=3)
    talker.put(b"\0\1\0\0\xff")
    (imported,) = bed.neighbour.topics.imports.values()
    await eventually(lambda: imported.unconverted)
    assert (imported.publishers["/bot"].received, imported.sequences.lost, imported.unconverted) == (2, 3, 1)
    (way,) = bed.neighbour.ways("/chatter", "ros2")
    assert (way.flows, "3 were lost" in way.stages[-1].text) == (True, True)
    assert bed.neighbour.ways("/chatter", "warehouse") == []
    assert len(bed.problems) == 1


async def test_a_transient_local_topic_is_latched_here(bed: Ros2Bed) -> None:
    one, two = (bed.publisher("/map", node=node, qos=LATCHED) for node in ("/one", "/two"))
    one.say("1")
    two.say("2")
    first, second = await bed.shown("/map", "/one"), await bed.shown("/map", "/two")
    assert first.description is not None
    assert first.description.latching
    first.on_demand(True)
    await eventually(lambda: first.messages == [string("1")])
    second.on_demand(True)
    await eventually(lambda: second.messages)
    assert second.messages == [string("2")], "the history came with the first subscriber"
    first.on_demand(False)
    first.on_demand(True)
    assert first.messages[1] == b"forgotten", "what is latched may be old by then"


async def test_the_fields_of_a_type_that_only_ros2_has_are_asked_of_its_node(bed: Ros2Bed) -> None:
    name = "base_msgs/msg/Wheels"
    theirs = types_with(MessageType.learn("base_msgs/Wheels", "float64[4] speed\nstring[] names\nint32 count"))
    publisher = bed.publisher("/wheels", node="/base", type_name=name, type_hash=theirs.type_hash(name))
    bed.describes("/base", theirs, name)
    topic = await bed.shown("/wheels", "/base")
    await eventually(lambda: topic.description)
    assert topic.description is not None
    kind = MessageType.learn(topic.description.type, topic.description.definition, topic.description.md5sum)
    assert [str(field) for field in kind.fields] == ["float64[4]", "string[]", "int32"]
    await bed.subscribed(publisher)
    publisher.put(cdr(theirs, name, np.array([1.0, 2, 3, 4]), ["a"], -7))
    await eventually(lambda: topic.messages)
    got = kind.deserialize(topic.messages[0])
    assert (list(got.speed), got.names, got.count) == ([1.0, 2.0, 3.0, 4.0], ["a"], -7)


async def test_a_type_that_no_one_describes_is_told_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch, bed: Ros2Bed
) -> None:
    monkeypatch.setattr(limits, "ROS2_SERVICE_WAIT", 0.05)
    bed.publisher("/wheels", node="/base", type_name="base_msgs/msg/Wheels", type_hash=NO_TYPE)
    bed.publisher("/chatter", node="/old", type_hash=NO_TYPE)
    await eventually(lambda: len(bed.problems) == 2)
    texts = sorted(bed.problems.values())
    assert "start_type_description_service" in texts[1]
    assert "gateway.ros2.distribution" in texts[0] + texts[1]
    assert all(each.problem for each in bed.neighbour.topics.imports.values())


async def test_a_type_that_is_learnt_later_makes_the_topic_known(bed: Ros2Bed) -> None:
    name = "arm_msgs/msg/Grip"
    bed.publisher("/grip_state", type_name=name, type_hash=types_with(CUSTOM).type_hash(name))
    topic = await bed.shown("/grip_state")
    assert topic.description is None
    bed.graph.publisher("/grip", CUSTOM)
    await eventually(lambda: topic.description)
    assert topic.description == CUSTOM.describe()


async def test_no_more_nodes_are_asked_at_one_time_than_the_bound(
    monkeypatch: pytest.MonkeyPatch, bed: Ros2Bed
) -> None:
    monkeypatch.setattr(limits, "ROS2_ASKS_MAX", 3)
    monkeypatch.setattr(limits, "ROS2_SERVICE_WAIT", 60.0)
    for number in range(5):
        bed.publisher(f"/t{number}", type_name=f"odd_msgs/msg/T{number}", type_hash=NO_TYPE)
    await eventually(lambda: len(bed.problems) == 2)
    assert all("asked for types already" in text for text in bed.problems.values())


# --- rules, and what is not believed --------------------------------------------------------------------------------


async def test_rules_decide_what_crosses_and_its_name() -> None:
    rules = (
        CrossingRule(names=("/secret",), crossing=Crossing.NONE),
        CrossingRule(names=("/in",), sites=("ros2",), crossing=Crossing.IN, name="/{site}{name}"),
        CrossingRule(rate=2.0),
    )
    async with ros2_bed(rules=rules) as bed:
        sources = {name: bed.graph.publisher(name, STRING) for name in ("/secret", "/in", "/out")}
        for name in (*sources, "/rosout", "/a/_action/feedback"):
            bed.publisher(name)
        await eventually(lambda: len(bed.graph.topics) == 2)
        assert sorted(name for name, _ in bed.graph.topics) == ["/out", "/ros2/in"]
        assert [each.name for each in bed.own(EntityKind.PUBLISHER)] == ["/out"]
        assert "gateway.rule 1" in bed.neighbour.topics.refused["/secret of /bot"]
        ways = bed.neighbour.ways("/secret")
        assert {(way.peer, way.to, way.flows) for way in ways} == {("ros2", "gate", False), ("gate", "ros2", False)}
        bed.subscribe("/out")
        await eventually(lambda: bed.graph.taps)
        for _ in range(50):
            bed.graph.send(sources["/out"], string("x"))
        (export,) = bed.neighbour.topics.exports()
        assert export.messages + export.limited == 50
        assert export.limited >= 40, "its rate is kept, and counted"


async def test_of_two_gateways_of_one_mesh_one_shows_a_node_and_the_other_takes_over(bed: Ros2Bed) -> None:
    second = bed.gateway()
    second.start()
    source = bed.graph.publisher("/chatter", STRING)
    await eventually(lambda: len(bed.own(EntityKind.PUBLISHER)) == 1)
    (shown,) = bed.own(EntityKind.PUBLISHER)
    assert shown.node.zid == bed.neighbour.context.session.zid
    assert second.report()["standing_by"] == {"/rmpa/arm/talker": shown.node.zid}
    chatter = bed.subscribe("/chatter")
    await eventually(lambda: bed.graph.taps)
    assert bed.graph.send(source, string("once")) == 1
    other = bed.graph.publisher("/second", STRING)
    await eventually(lambda: len(bed.own(EntityKind.PUBLISHER)) == 2)
    await bed.neighbour.close()
    await eventually(lambda: len(bed.own(EntityKind.PUBLISHER)) == 2)
    await eventually(lambda: bed.graph.taps)
    assert {each.node.zid for each in bed.own(EntityKind.PUBLISHER)} == {second.context.session.zid}
    bed.graph.send(source, string("twice"))
    await eventually(lambda: len(chatter.heard) == 2)
    for each in (source, other):
        bed.graph.remove(each)
    assert second.report()["standing_by"] == {}
    await second.close()
