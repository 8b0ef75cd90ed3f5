"""A session of Foxglove."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RmpaError
from rmpa.ros.types.definitions import parse_definition
from rmpa.ros.types.messages import MessageType
from rmpa.web.foxglove import limits
from rmpa.web.hub.graph import GraphService, GraphTopic
from rmpa.web.hub.node_link import Rights
from tests.web.foxglove.client import CHATTER, SET_BOOL, Client
from tests.web.recorder import NOW_NS

# --- opening, channels ---


def test_a_client_hears_first_of_the_server_that_it_is_ros_1_and_what_is_offered(client: Client) -> None:
    info = client.json[0]
    capabilities = info.pop("capabilities")
    assert info == {
        "op": "serverInfo",
        "name": "base",
        "metadata": {"ROS_DISTRO": "noetic"},
        "supportedEncodings": ["ros1"],
        "sessionId": "run-1",
    }
    assert {*capabilities} == {
        *("clientPublish", "parameters", "parametersSubscribe", "services", "connectionGraph", "assets")
    }
    assert Client(Rights()).json[0]["capabilities"] == ["connectionGraph"]
    assert Client(Rights(), sim_time=True).json[0]["capabilities"] == ["time", "connectionGraph"]


def test_a_topic_is_offered_with_the_full_text_of_its_definition(client: Client) -> None:
    client.graph(GraphTopic("/odom", ("nav_msgs/Odometry",), ("/base",)))
    (channel,) = client.of("advertise")[0]["channels"]
    schema = channel.pop("schema")
    about = {"topic": "/odom", "encoding": "ros1", "schemaName": "nav_msgs/Odometry", "schemaEncoding": "ros1msg"}
    assert channel == {"id": 1, **about}
    assert "MSG: geometry_msgs/PoseWithCovariance\n" in schema
    assert not schema.startswith("=")


def test_two_types_on_one_topic_are_two_channels(client: Client) -> None:
    client.graph(GraphTopic("/x", ("std_msgs/String", "std_msgs/Bool"), ("/a", "/b")))
    names = {c["schemaName"]: c["id"] for m in client.of("advertise") for c in m["channels"]}
    assert names.keys() == {"std_msgs/String", "std_msgs/Bool"}
    assert client.subscribe(names["std_msgs/Bool"]).type == "std_msgs/Bool"


def test_topics_without_publishers_or_type_are_not_offered(client: Client) -> None:
    client.graph(GraphTopic("/a", ("std_msgs/String",), (), ("/n",)), GraphTopic("/b", ("*",), ("/n",)))
    assert not client.of("advertise")


def test_an_id_is_never_used_again(client: Client) -> None:
    client.graph(CHATTER)
    client.graph()
    assert client.of("unadvertise") == [{"op": "unadvertise", "channelIds": [1]}]
    client.graph(CHATTER)
    assert client.of("advertise")[-1]["channels"][0]["id"] == 2


def test_an_unknown_type_is_told_and_offered_once_it_is_known(client: Client) -> None:
    client.hub.types.missing["std_msgs/String"] = RmpaError("no definition; install its package")
    client.graph(CHATTER)
    (status,) = client.of("status")
    assert (status["level"], "install its package" in status["message"]) == (1, True)
    assert not client.of("advertise")
    assert Client(beside=client).of("status") == [status]
    client.hub.types.on_learnt(MessageType("std_msgs/String"))
    assert client.of("removeStatus") == [{"op": "removeStatus", "statusIds": [status["id"]]}]
    assert client.of("advertise")[0]["channels"][0]["topic"] == "/chatter"


def test_the_warning_about_a_type_ends_with_its_last_topic(client: Client) -> None:
    client.hub.types.missing["std_msgs/String"] = RmpaError("no definition")
    client.graph(CHATTER)
    client.graph()
    assert client.of("removeStatus")
    client.hub.types.on_learnt(MessageType("std_msgs/String"))
    assert not client.of("advertise")


def test_many_channels_come_in_several_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ADVERTISE_BYTES", 1000)
    client = Client()
    client.graph(*(GraphTopic(f"/t{n}", ("nav_msgs/Odometry",), ("/n",)) for n in range(4)))
    assert [len(m["channels"]) for m in client.of("advertise")] == [1, 1, 1, 1]


# --- subscriptions ---


def test_messages_reach_the_subscription_untouched(client: Client) -> None:
    client.graph(CHATTER)
    payload = memoryview(b"\x02\x00\x00\x00hi")
    client.subscribe().message(payload)
    _, (header, sent) = client.connection.sent[-1]
    assert header == struct.pack("<BIQ", 1, 7, NOW_NS)
    assert sent is payload


def test_a_withdrawn_channel_and_the_client_end_a_subscription(client: Client) -> None:
    client.graph(CHATTER)
    asked = client.subscribe()
    client.send({"op": "unsubscribe", "subscriptionIds": [7]})
    assert asked.closed
    asked = client.subscribe()
    client.graph()
    assert asked.closed
    client.graph(CHATTER)
    client.subscribe(channel=2)
    assert not client.errors


def test_wrong_subscriptions_are_refused_and_the_right_ones_kept(client: Client) -> None:
    client.graph(CHATTER, GraphTopic("/b", ("std_msgs/String",), ("/n",)))
    pairs = [(7, 1), (7, 2), (8, 1), (9, 99), (10, 2)]
    client.send({"op": "subscribe", "subscriptions": [{"id": i, "channelId": c} for i, c in pairs]})
    assert len(client.errors) == 3
    assert [each.topic for each in client.all("subscribe")] == ["/chatter", "/b"]
    client.send({"op": "unsubscribe", "subscriptionIds": [99, 7]})
    assert len(client.errors) == 4


def test_subscriptions_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SUBSCRIPTIONS_MAX", 1)
    client = Client()
    client.graph(CHATTER, GraphTopic("/b", ("std_msgs/String",), ("/n",)))
    client.subscribe(1, 1)
    client.subscribe(2, 2)
    assert "limit" in client.errors[0]


def test_a_failed_subscription_is_told_and_can_be_ended(client: Client) -> None:
    client.graph(CHATTER)
    client.subscribe().failed(RmpaError("md5 sums differ; rebuild the talker"))
    client.send({"op": "unsubscribe", "subscriptionIds": [7]})
    assert client.errors == ["md5 sums differ; rebuild the talker"]


# --- time ---


def test_the_clock_is_sent_on_and_stamps_the_messages() -> None:
    client = Client(sim_time=True)
    clock = client.last("subscribe")
    assert clock.topic == "/clock"
    client.graph(CHATTER)
    asked = client.subscribe()
    asked.message(b"")
    clock.message(struct.pack("<II", 3, 4))
    clock.message(b"broken")
    asked.message(b"")
    assert client.binary == [
        struct.pack("<BIQ", 1, 7, NOW_NS),
        struct.pack("<BQ", 2, 3_000_000_004),
        struct.pack("<BIQ", 1, 7, 3_000_000_004),
    ]


# --- publishing ---


def advertise(number: int = 3, topic: str = "/cmd", encoding: str = "ros1", type_: str = "std_msgs/String") -> Any:
    channel = {"id": number, "topic": topic, "encoding": encoding, "schemaName": type_}
    return {"op": "advertise", "channels": [channel]}


def test_a_client_publishes(client: Client) -> None:
    publisher = client.one("advertise", client.send(advertise(topic="cmd")))
    assert (publisher.topic, publisher.type) == ("/cmd", "std_msgs/String")
    client.send(struct.pack("<BI", 1, 3) + b"\x02\x00\x00\x00hi")
    assert publisher.published == [b"\x02\x00\x00\x00hi"]
    client.send({"op": "unadvertise", "channelIds": [3]})
    assert publisher.closed
    client.send(struct.pack("<BI", 1, 3))
    assert "not advertised" in client.errors[0]


def test_a_topic_that_cannot_be_published_is_refused(client: Client) -> None:
    wrong: tuple[dict[str, str], ...] = ({"encoding": "json"}, {"type_": "String"})
    for count, each in enumerate((*wrong, *({"topic": name} for name in ("/a b", "", "/"))), start=1):
        client.send(advertise(**each))  # type: ignore[arg-type]
        assert len(client.errors) == count
    assert not client.all("advertise")


def test_published_topics_are_bounded_and_numbers_are_used_once(client: Client) -> None:
    for number in range(limits.ADVERTISED_MAX):
        client.send(advertise(number))
    client.send(advertise(0))
    client.send(advertise(9999))
    assert len(client.errors) == 2
    assert len(client.all("advertise")) == limits.ADVERTISED_MAX


def test_messages_of_a_failed_publisher_are_dropped_without_a_status_each(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:

    def refuse(*_: Any) -> None:
        raise RmpaError("others publish it with another type")

    monkeypatch.setattr(client.session, "advertise", refuse)
    client.send(advertise())
    for _ in range(10):
        client.send(struct.pack("<BI", 1, 3))
    assert client.errors == ["others publish it with another type"]


# --- services ---


def call(service: int, number: int, payload: bytes = b"\x01", encoding: bytes = b"ros1") -> bytes:
    return struct.pack("<BIII", 2, service, number, len(encoding)) + encoding + payload


def test_a_service_is_offered_and_called(client: Client) -> None:
    client.graph(SET_BOOL)
    (service,) = client.of("advertiseServices")[0]["services"]
    assert (service["name"], service["response"]["schemaName"]) == ("/set_bool", "std_srvs/SetBoolResponse")
    assert service["request"]["schema"].strip().startswith("bool data")
    asked = client.one("call", client.send(call(service["id"], 12)))
    assert (asked.service, asked.type, asked.request) == ("/set_bool", "std_srvs/SetBool", b"\x01")
    asked.done(b"\x01\x00\x00\x00\x00")
    assert client.binary == [struct.pack("<BIII", 3, 1, 12, 4) + b"ros1\x01\x00\x00\x00\x00"]


def test_calls_that_fail_say_why(client: Client) -> None:
    client.graph(SET_BOOL)
    client.one("call", client.send(call(1, 1))).failed(RmpaError("timed out; is it hanging?"))
    client.send(call(77, 3))
    client.send(call(1, 4, encoding=b"json"))
    failures = {each["callId"]: each["message"] for each in client.of("serviceCallFailure")}
    assert failures.keys() == {1, 3, 4}
    assert failures[1] == "timed out; is it hanging?"
    assert "'json'" in failures[4]


def test_waiting_calls_are_bounded(client: Client) -> None:
    client.graph(SET_BOOL)
    for number in range(limits.CALLS_MAX + 1):
        client.send(call(1, number))
    (failure,) = client.of("serviceCallFailure")
    assert failure["callId"] == limits.CALLS_MAX


def test_the_type_of_a_service_is_searched_where_the_graph_does_not_say_it(client: Client) -> None:
    unknown = GraphService("/set_bool", "", ("/server",))
    for _ in range(2):
        client.graph(unknown)
    assert client.hub.graph.searched == ["/set_bool"]
    assert not client.of("advertiseServices")
    client.graph()
    client.hub.graph.found["/set_bool"] = "std_srvs/SetBool"
    client.graph(unknown)
    assert client.of("advertiseServices")[0]["services"][0]["type"] == "std_srvs/SetBool"
    client.graph()
    assert client.of("unadvertiseServices") == [{"op": "unadvertiseServices", "serviceIds": [1]}]


# --- graph, assets ---


names = st.sampled_from(["/a", "/b", "/c"])
nodes = st.lists(names, unique=True, max_size=2).map(tuple)
graphs = st.dictionaries(names, st.tuples(nodes, nodes), max_size=3)


@given(st.lists(st.tuples(graphs, st.dictionaries(names, nodes, max_size=3)), max_size=6))
def test_a_client_that_applies_all_updates_has_the_graph(
    steps: list[tuple[dict[str, tuple[Any, Any]], dict[str, tuple[str, ...]]]],
) -> None:
    client = Client(Rights())
    client.send({"op": "subscribeConnectionGraph"})
    published: dict[str, tuple[str, ...]] = {}
    subscribed, served = published.copy(), published.copy()
    tables = (
        ("publishedTopics", "publisherIds", published),
        ("subscribedTopics", "subscriberIds", subscribed),
        ("advertisedServices", "providerIds", served),
    )
    for topics, services in steps:
        seen = len(client.of("connectionGraphUpdate"))
        client.graph(
            *(GraphTopic(name, ("std_msgs/String",), *ends) for name, ends in topics.items()),
            *(GraphService(name, "std_srvs/Empty", providers) for name, providers in services.items()),
        )
        for update in client.of("connectionGraphUpdate")[seen:]:
            for key, ids, table in tables:
                table |= {each["name"]: tuple(each[ids]) for each in update[key]}
            for name in update["removedTopics"]:
                published.pop(name, None)
                subscribed.pop(name, None)
            for name in update["removedServices"]:
                del served[name]
        assert {n: i for n, i in published.items() if i} == {n: e[0] for n, e in topics.items() if e[0]}
        assert {n: i for n, i in subscribed.items() if i} == {n: e[1] for n, e in topics.items() if e[1]}
        assert served == services


def fetch(uri: str, number: int = 5) -> dict[str, Any]:
    return {"op": "fetchAsset", "uri": uri, "requestId": number}


def test_a_file_of_a_package_is_fetched(client: Client) -> None:
    asked = client.one("fetch_asset", client.send(fetch("package://robot/meshes/base.stl")))
    assert (asked.uri, asked.most) == ("package://robot/meshes/base.stl", limits.ASSET_MAX)
    asked.done(b"solid")
    assert client.binary[0] == struct.pack("<BIBI", 4, 5, 0, 0) + b"solid"
    client.one("fetch_asset", client.send(fetch("package://robot/none"))).failed(RmpaError("no such file"))
    assert client.binary[1] == struct.pack("<BIBI", 4, 5, 1, 12) + b"no such file"


def test_assets_are_bounded(client: Client) -> None:
    for number in range(limits.ASSETS_MAX + 1):
        client.send(fetch("package://robot/x", number))
    assert len(client.binary) == 1


# --- rights, errors, the end ---


def test_a_malformed_message_is_told_and_too_many_end_the_session(client: Client) -> None:
    client.send({"op": "nonsense"})
    assert "nonsense" in client.errors[0]
    assert not client.connection.ended
    for _ in range(int(limits.STATUS_BURST)):
        client.send(b"")
    assert client.connection.ended == [1008]


def test_what_a_client_may_not_do_is_refused_quietly_after_many_times_but_never_ends_the_session() -> None:
    client = Client(Rights())
    for _ in range(1000):
        client.send(struct.pack("<BI", 1, 3))
    assert not client.connection.ended
    assert len(client.errors) == limits.STATUS_BURST
    client.now = 10.0
    client.send(struct.pack("<BI", 1, 3))
    assert len(client.errors) == limits.STATUS_BURST + 1


def test_a_client_that_has_gone_is_told_no_more(client: Client) -> None:
    beside = Client(beside=client)
    client.session.closing()
    client.graph(CHATTER)
    assert not client.of("advertise")
    assert beside.of("advertise")


def test_a_server_says_its_own_warnings(client: Client) -> None:
    client.session.warn("slow", "slow /scan")
    assert client.json[-1] == {"op": "status", "level": 1, "message": "slow", "id": "slow /scan"}


OWN = MessageType("std_msgs/String").md5sum
OTHER = MessageType("std_msgs/String", parse_definition("std_msgs/String", "int32 other"))


@pytest.fixture
def other_version() -> Client:
    """A client of a hub that has another version of the type, too."""
    client = Client()
    client.hub.types.versions[OTHER.md5sum] = OTHER
    client.graph(CHATTER)
    return client


def test_publishers_with_two_versions_of_a_type_are_two_channels_and_all_clients_are_warned(
    other_version: Client,
) -> None:
    client = other_version
    beside = Client(beside=client)
    asked = client.subscribe(1)
    for md5sum in (OWN, OTHER.md5sum, OWN, OTHER.md5sum):
        asked.message(b"x", md5sum=md5sum)
    assert len(client.binary) == 2, "a message of the other version was sent on a channel with another schema"
    (second,) = client.of("advertise")[-1]["channels"]
    assert (second["topic"], second["schemaName"], second["id"]) == ("/chatter", "std_msgs/String", 2)
    assert "int32 other" in second["schema"]
    assert beside.of("advertise")[-1]["channels"] == [second]
    (warned,) = client.of("status")
    assert warned["level"] == 1
    assert OWN in warned["message"]
    assert OTHER.md5sum in warned["message"]
    assert [warned] == beside.of("status") == Client(beside=client).of("status")
    assert not client.of("unadvertise")
    further = client.subscribe(2, number=8)
    further.message(b"ours", md5sum=OWN)
    further.message(b"other", md5sum=OTHER.md5sum)
    assert len(client.binary) == 3
    client.graph()
    assert sorted(client.of("unadvertise")[-1]["channelIds"]) == [1, 2]
    assert client.of("removeStatus")[-1]["statusIds"] == [warned["id"]]


def test_a_channel_whose_version_no_publisher_has_is_replaced(other_version: Client) -> None:
    client = other_version
    asked = client.subscribe(1)
    asked.message(b"other", md5sum=OTHER.md5sum)
    assert client.of("unadvertise")[-1]["channelIds"] == [1]
    assert asked.closed
    (second,) = client.of("advertise")[-1]["channels"]
    assert "int32 other" in second["schema"]
    assert not client.of("status")
    client.subscribe(second["id"]).message(b"other", md5sum=OTHER.md5sum)
    assert len(client.binary) == 1
    client.graph(CHATTER)
    assert client.of("unadvertise")[-1]["channelIds"] == [1], "the channel of the version was withdrawn again"
