"""The tokens, keys and attachments of rmw_zenoh, and the graph of them."""

from __future__ import annotations

import pytest

from rmpa.core.contract import ContractRule, Contracts, Durability, History, Priority, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.format import (
    EntityKind,
    Ros2Attachment,
    Ros2Durability,
    Ros2Endpoint,
    Ros2History,
    Ros2Liveliness,
    Ros2Node,
    Ros2Qos,
    Ros2Reliability,
    data_key,
    dds_type,
    graph_key,
    parse_token,
    ros2_qos,
    ros_type,
    zenoh_qos,
)
from rmpa.gateway.ros2.graph import Ros2Graph, valid_name
from rmpa.gateway.zenoh.threads import ZenohPriority

NO_HASH = "RIHS01_" + "0" * 64
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
NODE = Ros2Node(2, "a1b2c3", 0, "/robot/talker")
NODE_TOKEN = "@ros2_lv/2/a1b2c3/0/0/NN/%/%robot/talker"
CHATTER = Ros2Endpoint(NODE, 10, EntityKind.PUBLISHER, "/robot/chatter", "std_msgs/msg/String", HASH, Ros2Qos())
CHATTER_TOKEN = (
    f"@ros2_lv/2/a1b2c3/0/10/MP/%/%robot/talker/%robot%chatter/std_msgs::msg::dds_::String_/{HASH}/::,10:,:,:,,"
)


@pytest.mark.parametrize(
    ("entity", "token"),
    [
        (NODE, NODE_TOKEN),
        (CHATTER, CHATTER_TOKEN),
        (Ros2Node(0, "ff", 3, "/talker"), "@ros2_lv/0/ff/3/3/NN/%/%/talker"),
        (Ros2Node(0, "ff", 3, "/talker", "/secure/enclave"), "@ros2_lv/0/ff/3/3/NN/%secure%enclave/%/talker"),
    ],
)
def test_nodes_and_endpoints_have_the_tokens_of_rmw_zenoh(entity: Ros2Node | Ros2Endpoint, token: str) -> None:
    assert (entity.token(), parse_token(token)) == (token, entity)


def test_data_of_a_topic_goes_by_its_name_type_and_hash_and_types_have_two_names() -> None:
    assert CHATTER.key() == f"2/robot/chatter/std_msgs::msg::dds_::String_/{HASH}"
    assert data_key(0, "/chatter", "std_msgs/msg/String", "*") == "0/chatter/std_msgs::msg::dds_::String_/*"
    assert graph_key(7) == "@ros2_lv/7/**"
    assert dds_type("example_interfaces/srv/AddTwoInts") == "example_interfaces::srv::dds_::AddTwoInts_"
    assert ros_type("example_interfaces::srv::dds_::AddTwoInts_") == "example_interfaces/srv/AddTwoInts"


@pytest.mark.parametrize(
    "key",
    [
        "", "@ros2_lv", "@ros2_lv/0/ff/3/3/NN/%/%", "ros2_lv/0/ff/3/3/NN/%/%/talker",
        "@ros2_lv/0/ff/3/3/XX/%/%/talker", "@ros2_lv/x/ff/3/3/NN/%/%/talker", "@ros2_lv/-1/ff/3/3/NN/%/%/talker",
        "@ros2_lv/²/ff/3/3/NN/%/%/talker", "@ros2_lv/0/ff/99999999999999999999999/3/NN/%/%/talker",
        "@ros2_lv/0/ff/3/3/NN/%/%/%", "@ros2_lv/0/ff/3/3/NN/%/%/a%b", "@ros2_lv/0/ff/3/3/NN//%/talker",
        "@ros2_lv/0/*/3/3/NN/%/%/talker", "@ros2_lv/0/ff/3/3/MP/%/%/talker", CHATTER_TOKEN.replace("dds_", "other"),
        CHATTER_TOKEN.replace("String_", "_"), CHATTER_TOKEN.replace("::,10:,:,:,,", "::,ten:,:,:,,"),
        CHATTER_TOKEN.replace("::,10:,:,:,,", "::"), "@ros2_lv/0/ff/3/3/NN/%/%/" + "a" * limits.KEY_MAX,
    ],
)  # fmt: skip
def test_what_is_no_token_is_refused(key: str) -> None:
    with pytest.raises(RemoteProtocolError):
        parse_token(key)


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Ros2Qos(), "::,10:,:,:,,"),
        (Ros2Qos(durability=Ros2Durability.TRANSIENT_LOCAL, depth=1), ":1:,1:,:,:,,"),
        (Ros2Qos(reliability=Ros2Reliability.BEST_EFFORT, depth=5), "2::,5:,:,:,,"),
        (Ros2Qos(history=Ros2History.KEEP_ALL, depth=0), "::2,0:,:,:,,"),
        (Ros2Qos(deadline=1_500_000_000, lifespan=2), "::,10:1,500000000:0,2:,,"),
        (Ros2Qos(liveliness=Ros2Liveliness.MANUAL_BY_TOPIC, lease=3_000_000_000), "::,10:,:,:3,3,0"),
    ],
)
def test_a_qos_and_its_text(qos: Ros2Qos, text: str) -> None:
    assert qos.serialize() == text
    assert Ros2Qos.parse(text) == qos


def test_kinds_that_are_not_known_count_as_the_default_and_transient_local_is_latched() -> None:
    assert Ros2Qos.parse("0:9:7,10:,:,:4,,") == Ros2Qos.parse("1:2:1,10:,:,:1,,") == Ros2Qos()
    assert [Ros2Qos.parse(text).latched for text in (":1:,1:,:,:,,", "::,10:,:,:,,")] == [True, False]


# --- The attachment of ROS 2's messages -----------------------------------------------------------------------------

GOLDEN_BYTES = bytes.fromhex("0700000000000000 15cd5b0700000000 10 000102030405060708090a0b0c0d0e0f")
ATTACHMENT = Ros2Attachment(7, 123456789, bytes(range(16)))


def test_golden_bytes() -> None:
    assert ATTACHMENT.serialize() == GOLDEN_BYTES
    for later in (b"", b"more"):  # what later versions add is ignored
        assert Ros2Attachment.parse(GOLDEN_BYTES + later) == ATTACHMENT
    for length in range(33):
        with pytest.raises(RemoteProtocolError):
            Ros2Attachment.parse(GOLDEN_BYTES[:length])


def test_the_older_form_with_names_is_read() -> None:
    raw = (
        b"\x0fsequence_number" + (7).to_bytes(8, "little") + b"\x10source_timestamp" + (9).to_bytes(8, "little")
        + b"\x0asource_gid" + b"\x10" + bytes(range(16))
    )  # fmt: skip
    assert Ros2Attachment.parse(raw) == Ros2Attachment(7, 9, bytes(range(16)))
    for end in range(16, len(raw)):
        with pytest.raises(RemoteProtocolError):
            Ros2Attachment.parse(raw[:end])


# --- The QoS of our topics in ROS 2 and in Zenoh, by contract -------------------------------------------------------


def terms(*, latching: bool = False, **values: object) -> tuple[str, bool, ZenohPriority, int, int]:
    """The QoS in the token; block, priority, bound and cache of Zenoh's publisher."""
    contracts = Contracts((ContractRule((), (), values),) if values else ())
    qos = ros2_qos(contracts, "/a", "std_msgs/String", latching=latching)
    zenoh = zenoh_qos(contracts.of("/a", "std_msgs/String"), qos)
    assert zenoh.reliable is zenoh.block
    return qos.serialize(), zenoh.block, zenoh.priority, zenoh.messages, zenoh.cache


def test_each_contract_has_its_qos() -> None:
    plain = terms()
    assert plain[:3] == ("::,10:,:,:,,", True, ZenohPriority.DATA), "reliable, as TCPROS is"
    assert plain[4] == 0
    assert terms(reliability=Reliability.RELIABLE) == plain
    assert terms(reliability=Reliability.BEST_EFFORT)[:2] == ("2::,10:,:,:,,", False)
    assert terms(latching=True)[0] == ":1:,1:,:,:,,"
    assert terms(latching=True)[4] == 1
    assert terms(durability=Durability.TRANSIENT_LOCAL, depth=7) == (":1:,7:,:,:,,", True, ZenohPriority.DATA, 7, 7)
    assert terms(history=History.KEEP_ALL)[0] == "::2,10:,:,:,,"
    assert terms(depth=5)[0] == "::,5:,:,:,,"
    assert terms(priority=Priority.HIGH)[2] is ZenohPriority.REAL_TIME
    assert terms(priority=Priority.LOW)[2] is ZenohPriority.DATA_LOW
    assert terms(deadline=0.5, lifespan=2.0, liveliness_lease=1.5)[0] == "::,10:0,500000000:2,0:,1,500000000"


def publisher(number: int = 1, node: str = "/bot", name: str = "/chatter", zid: str = "ab", domain: int = 0) -> str:
    made = Ros2Node(domain, zid, 0, node)
    return Ros2Endpoint(made, number, EntityKind.PUBLISHER, name, "std_msgs/msg/String", NO_HASH, Ros2Qos()).token()


def test_what_appears_is_there_until_it_disappears() -> None:
    graph = Ros2Graph(0, "cd")
    node, endpoint = Ros2Node(0, "ab", 0, "/bot"), publisher()
    assert graph.change(node.token(), alive=True) == node
    made = graph.change(endpoint, alive=True)
    assert isinstance(made, Ros2Endpoint)
    assert graph.change(endpoint, alive=True) is None, "a token that is told twice is one"
    assert list(graph.at("/chatter", EntityKind.PUBLISHER)) == [made]
    assert list(graph.at("/chatter", EntityKind.SUBSCRIPTION)) == []
    assert (graph.nodes, len(graph)) == ({"/bot"}, 1)
    assert graph.change(endpoint, alive=False) == made
    assert graph.change(endpoint, alive=False) is None
    assert graph.change(node.token(), alive=False) == node
    assert (graph.nodes, len(graph), list(graph.at("/chatter", *EntityKind))) == (set(), 0, [])


def test_what_is_not_of_this_graph_is_ignored_and_counted() -> None:
    graph = Ros2Graph(0, "cd")
    for key, reason in (
        (publisher(domain=7), "other domain"),
        (publisher(node="/rmpa/arm/talker"), "other gateway"),
        (publisher(node="/rmpa/host_gateway"), "other gateway"),
        (publisher(name="/a b"), "impossible name"),
        (publisher(node="/a//b"), "impossible name"),
        (publisher()[:-20], "malformed"),
    ):
        before = graph.ignored[reason]
        assert graph.change(key, alive=True) is None
        assert graph.ignored[reason] == before + 1, key
        assert graph.change(key, alive=False) is None  # fmt: skip
    assert graph.change(publisher(zid="cd"), alive=True) is None
    assert graph.ignored.total() == 6, "this gateway's own tokens are nothing to tell of"
    assert graph.change(publisher(node="/rmpad/talker"), alive=True) is not None


def test_tokens_above_the_bounds_are_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ROS2_ENDPOINTS_MAX", 3)
    monkeypatch.setattr(limits, "ROS2_NODES_MAX", 2)
    graph = Ros2Graph(0, "cd")
    for number in range(5):
        graph.change(publisher(number), alive=True)
        graph.change(Ros2Node(0, "ab", number, f"/bot{number}").token(), alive=True)
    assert (len(graph), len(graph.nodes)) == (3, 2)
    assert graph.ignored == {"too many endpoints": 2, "too many nodes": 3}
    graph.change(publisher(0), alive=False)
    assert graph.change(publisher(9), alive=True) is not None


def test_names_that_ros2_does_not_allow_are_told_apart() -> None:
    assert valid_name("/a/b_1")
    for name in ("/1a", "/a/2", "a", "/", "/a/", "/a b", "/" + "x" * 300):
        assert not valid_name(name), name
