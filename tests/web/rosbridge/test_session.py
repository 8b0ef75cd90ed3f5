"""A session of rosbridge."""

from __future__ import annotations

import json
from typing import Any

import cbor2
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.core.errors import PeerRefused
from rmpa.web.hub.frame_writer import Opcode
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.protocol import decode_png
from rmpa.web.rosbridge.session import OPS
from tests.web.recorder import NOW_NS, answer
from tests.web.rosbridge.client import Client

STRING = "std_msgs/String"
HELLO = b"\x05\0\0\0hello"


# --- subscribing -------------------------------------------------------------------------------------------------


def test_a_subscriber_gets_messages_in_json_of_the_topic_as_it_wrote_it(client: Client) -> None:
    for name, kind in (("/t", STRING), ("t", "std_msgs/msg/String")):
        asked = client.subscribe(name, type=kind)
        assert (asked.topic, asked.type) == ("/t", STRING)
        client.publish(asked)
        ((opcode, parts),) = client.frames()
        text = '{"op":"publish","topic":"' + name + '","msg":{"data":"hello"}}'
        assert (opcode, b"".join(parts)) == (Opcode.TEXT, text.encode())


def test_each_compression(client: Client) -> None:
    for compression in ("none", "png", "cbor", "cbor-raw"):
        client.publish(client.subscribe(f"/{compression[-3:]}", compression=compression))
    none, png, cbor, raw = client.received()
    wanted = {"op": "publish", "msg": {"data": "hello"}}
    assert none == wanted | {"topic": "/one"}
    assert json.loads(decode_png(png["data"])) == wanted | {"topic": "/png"}
    assert cbor == wanted | {"topic": "/bor"}
    secs, nsecs = divmod(NOW_NS, 10**9)
    assert raw["msg"] == {"secs": secs, "nsecs": nsecs, "bytes": HELLO}
    client.subscribe(type="x/Y", compression="cbor-raw").message(b"abc", "x/Y")  # of a type that is not known here
    assert client.received()[0]["msg"]["bytes"] == b"abc"


def test_several_subscriptions_are_one_with_the_best_of_all(client: Client) -> None:
    asked = client.subscribe(id="a", throttle_rate=1000)
    assert not client.send("subscribe", id="b", topic="/t", throttle_rate=100, compression="cbor")
    assert not client.send("subscribe", id="c", topic="/t", throttle_rate=500, compression="png")
    for _ in range(10):
        client.publish(asked)
        client.now += 0.05
    assert [opcode for opcode, _ in client.frames()] == [Opcode.BINARY] * 5
    client.send("unsubscribe", id="b", topic="/t")
    client.now += 0.5
    client.publish(asked)
    assert client.received()[0]["op"] == "png"
    for mid, closed in (("a", False), ("c", True)):
        client.send("unsubscribe", id=mid, topic="/t")
        assert asked.closed is closed


def test_unsubscribe_without_an_id_ends_all(client: Client) -> None:
    asked = client.subscribe(id="a")
    client.send("subscribe", id="b", topic="/t")
    client.send("unsubscribe", topic="/t")
    assert asked.closed


def test_the_longest_queue_is_used_and_freed_with_the_last_subscription(client: Client) -> None:
    asked = client.subscribe(id="a", type=STRING, throttle_rate=1000, queue_length=1)
    client.send("subscribe", id="b", topic="/t", throttle_rate=1000, queue_length=3)
    for number in range(5):
        client.publish(asked, {"data": str(number)})
    client.advance(10)
    assert [each["msg"]["data"] for each in client.received()] == ["0", "2", "3", "4"]
    client.publish(asked)
    client.publish(asked)
    client.send("unsubscribe", topic="/t")
    assert (client.connection.queue.bytes, client.connection.queue.due) == (0, None)


def test_long_messages_come_in_fragments_of_the_smallest_size(client: Client) -> None:
    asked = client.subscribe(id="a", fragment_size=50)
    client.send("subscribe", id="b", topic="/t", fragment_size=30)
    for letter in "xy":
        client.publish(asked, {"data": letter * 100})
    got = client.received()
    assert {each["op"] for each in got} == {"fragment"}
    assert all(len(each["data"]) <= 30 for each in got)
    texts = ["".join(each["data"] for each in got if each["id"] == mid) for mid in (0, 1)]
    assert [json.loads(text)["msg"]["data"] for text in texts] == ["x" * 100, "y" * 100]


def test_a_broken_message_is_reported_once(client: Client) -> None:
    asked = client.subscribe()
    for _ in range(3):
        asked.message(b"\xff\xff\xff\xff")
    assert "message of /t: 4 bytes are not a std_msgs/String" in client.error()
    client.publish(asked)
    assert client.received()[0]["msg"] == {"data": "hello"}


def test_a_topic_has_one_type_for_subscribers(client: Client) -> None:
    client.graph.add_topic("/t", STRING)
    assert not client.send("subscribe", topic="/t", type="std_msgs/Int8")
    assert "/t has the type std_msgs/String, not std_msgs/Int8" in client.error()
    asked = client.subscribe("/new", type=STRING)
    client.send("subscribe", topic="/new", type="std_msgs/Int8")
    assert "is subscribed as std_msgs/String" in client.error()
    asked.differs("std_msgs/Int32")  # of a publisher that comes later
    assert "/new has the type std_msgs/Int32, not std_msgs/String" in client.error()


def test_a_subscription_that_the_hub_refuses_is_reported_and_may_begin_again(client: Client) -> None:
    asked = client.subscribe(id="i")
    asked.failed(PeerRefused("the core", "not allowed", "ask for the role operator"))
    (status,) = client.received()
    assert status["id"] == "i"
    assert status["msg"] == "subscribe /t: the core refused: not allowed; ask for the role operator"
    assert client.subscribe() is not asked


def test_a_subscription_without_a_type_fails_where_the_topic_does_not_appear(client: Client) -> None:
    none, *others = (client.subscribe(topic, id="i") for topic in ("/none", "/soon", "/published"))
    client.graph.add_topic("/soon", STRING)
    client.hub.published["/published"] = STRING
    client.advance(limits.TYPE_WAIT - 0.01)
    assert client.received() == []
    client.advance(0.01)
    assert [each.closed for each in (none, *others)] == [True, False, False]
    assert "its type is not known; give its 'type'" in client.error()


# --- publishing --------------------------------------------------------------------------------------------------


def test_a_client_publishes(client: Client) -> None:
    request = client.one("advertise", client.send("advertise", topic="t", type=STRING, latch=True, queue_size=5))
    assert (request.topic, request.type, request.latch) == ("/t", STRING, True)
    client.send("publish", topic="/t", msg={"data": "hello"})
    assert (request.published, client.received()) == ([HELLO], [])
    (other,) = client.send("advertise", topic="/bytes", type="std_msgs/UInt8MultiArray")
    message = {"layout": {"dim": [], "data_offset": 0}, "data": b"\x01\x02"}
    client.send_raw(cbor2.dumps({"op": "publish", "topic": "/bytes", "msg": message}))
    assert other.published[0].endswith(b"\x02\0\0\0\x01\x02")


def test_a_message_without_all_fields_is_published_with_a_warning(client: Client) -> None:
    client.send("set_level", level="warning")
    (publisher,) = client.send("advertise", topic="/t", type="geometry_msgs/Point")
    client.send("publish", id="p", topic="/t", msg={"x": 1})
    assert publisher.published == [bytes(6) + b"\xf0\x3f" + bytes(16)]
    (status,) = client.received()
    assert (status["level"], status["id"]) == ("warning", "p")
    assert status["msg"].endswith("were not given: y, z")


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity"])
def test_what_python_clients_write_for_not_a_number_is_taken(client: Client, value: str) -> None:
    (publisher,) = client.send("advertise", topic="/t", type="std_msgs/Float64")
    client.send_raw(f'{{"op": "publish", "topic": "/t", "msg": {{"data": {value}}}}}')
    assert publisher.published[0][-2] & 0xF0 == 0xF0


def test_a_publisher_ends_when_the_last_id_has_unadvertised_it(client: Client) -> None:
    ways: tuple[tuple[dict[str, str], ...], ...] = ({"id": "a"}, {"id": "b"}), ({},)
    for ends in ways:
        publisher = client.one("advertise", client.send("advertise", id="a", topic="/t", type=STRING))
        assert not client.send("advertise", id="b", topic="/t", type=STRING)
        for end in ends:
            assert not publisher.closed
            client.send("unadvertise", topic="/t", **end)
        assert publisher.closed


def test_a_topic_of_the_graph_may_be_published_without_advertising(client: Client) -> None:
    client.graph.add_topic("/t", STRING)
    publisher = client.one("advertise", client.send("publish", topic="/t", msg={"data": "hello"}))
    assert (publisher.type, publisher.published) == (STRING, [HELLO])
    assert not client.send("publish", topic="/unknown", msg={})
    assert "advertise it first" in client.error()


def test_a_topic_has_one_type_for_publishers(client: Client) -> None:
    client.graph.add_topic("/t", STRING)
    client.send("advertise", topic="/mine", type=STRING)
    for topic, kind, said in (
        ("/t", "std_msgs/Int8", "has the type std_msgs/String"),
        ("/mine", "std_msgs/Int8", "is advertised as std_msgs/String"),
        ("/x", "no_such/Type", "no_such/Type"),
    ):
        assert not client.send("advertise", topic=topic, type=kind)
        assert said in client.error()


# --- fragments and status ----------------------------------------------------------------------------------------


def test_ops_in_fragments_and_pictures_are_done(client: Client) -> None:
    text = json.dumps({"op": "advertise", "topic": "/t", "type": STRING})
    assert not client.send("fragment", id=1, data=text[20:], num=1, total=2)
    assert client.send("fragment", id=1, data=text[:20], num=0, total=2)
    # The picture holds the op publish, of a topic that is known nowhere.
    client.publish(client.subscribe("/p", compression="png"))
    (op,) = client.received()
    client.send("png", data=op["data"])
    assert "publish /p" in client.error()
    half = len(op["data"]) // 2
    client.send("png", id="x", num=0, total=2, data=op["data"][:half])
    client.send("png", id="x", num=1, total=2, data=op["data"][half:])
    assert "publish /p" in client.error()


def test_fragments_within_fragments_end(client: Client) -> None:
    text = json.dumps({"op": "set_level", "level": "info"})
    for _ in range(3):
        text = json.dumps({"op": "fragment", "id": "i", "num": 0, "total": 1, "data": text})
    client.send_raw(text)
    assert "once only" in client.error()


def test_an_incomplete_message_is_dropped_with_a_warning(client: Client) -> None:
    client.send("set_level", level="warning")
    client.send("fragment", id="i", data="{", num=0, total=2)
    client.advance(limits.FRAGMENT_TIMEOUT)
    (status,) = client.received()
    assert (status["level"], status["id"]) == ("warning", "i")


def test_levels_of_status_messages(client: Client) -> None:
    for count, level in enumerate(("none", "error", "warning", "info")):
        client.send("set_level", level=level)
        client.received()
        client.send("advertise", topic="/t", type=STRING)
        client.send("unsubscribe", topic="/unknown")
        client.send("nonsense")
        assert len(client.received()) == count
    client.send("set_level", level="loud")
    assert "none, error, warning, info" in client.error()


# --- malformed and hostile ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ("", "not JSON"),
        ("{", "not JSON"),
        ("[]", "not a list"),
        ("1", "not a int"),
        ("{}", "no 'op'"),
        ('{"op": 5}', "no 'op'"),
        ('{"receiver": "/x", "msg": []}', "rosbridge v1"),
        ('{"op": "dance"}', "unknown op 'dance'"),
        ('{"op": "subscribe"}', "missing required field `topic`"),
        ('{"op": "subscribe", "topic": 5}', "Expected `str`"),
        ('{"op": "subscribe", "topic": "/t", "throttle_rate": "fast"}', "throttle_rate"),
        ('{"op": "subscribe", "topic": "/t", "throttle_rate": -1}', "throttle_rate is 0 or more"),
        ('{"op": "subscribe", "topic": "/t", "queue_length": NaN}', "queue_length is 0 or more"),
        ('{"op": "subscribe", "topic": "/t", "fragment_size": 0}', "fragment_size is 1 or more"),
        ('{"op": "subscribe", "topic": "/t", "compression": "zip"}', "unknown compression"),
        ('{"op": "subscribe", "topic": "a b"}', "not a ROS name"),
        ('{"op": "subscribe", "topic": ""}', "1 to 1024 characters"),
        ('{"op": "subscribe", "topic": "/t", "type": "../etc"}', "not a type's name"),
        ('{"op": "subscribe", "topic": "/t", "id": {}}', "id"),
        ('{"op": "subscribe", "topic": "/t", "id": 99999999999999999999}', "64 bits"),
        ('{"op": "subscribe", "topic": "/t", "id": "\\ud800"}', "not JSON"),
        ('{"op": "subscribe", "topic": "\ud800"}', "not JSON"),
        ('{"op": "fragment", "id": "i", "num": 0, "total": 1, "data": "nonsense"}', "not JSON"),
        ('{"op": "fragment", "num": 0, "total": 1, "data": ""}', "missing required field `id`"),
        ('{"op": "png", "data": "AAAA", "num": 0}', "'id', 'num' and 'total'"),
        ('{"op": "service_response", "service": "/s", "id": "i", "result": true}', "is not advertised"),
        ('{"op": "unadvertise_service", "service": "/s"}', "is not advertised"),
        ('{"op": "advertise_action", "action": "/a", "type": "x/Y"}', "unknown op 'advertise_action'"),
        (b"\xff", "CBOR"),
        (b"\x9b\xff\xff\xff\xff\xff\xff\xff\xff", "CBOR"),
        (b"\x5b\x00\x00\x00\xff\xff\xff\xff\xff", "CBOR"),
        (b"\x81" * 100_000, "CBOR"),
        (b"\xa1\x01\x02", "no 'op'"),
        ("[" * 100_000, "too deep"),
        ("[" + "{}," * limits.CONTAINERS_MAX + "{}]", "objects and lists"),
        (bytes(limits.BINARY_FRAME_MAX + 1), "exceeds the limit"),
        ('{"op": "publish", "topic": "/t", "msg": ' + '{"a":' * 100_000, "too deep"),
        ("x" * (limits.FRAME_MAX + 1), "exceeds the limit"),
    ],
)  # fmt: skip
def test_what_is_malformed_is_answered_by_an_error(client: Client, data: str | bytes, says: str) -> None:
    assert not client.send_raw(data)
    assert says in client.error()


def test_the_error_has_the_id_of_the_op(client: Client) -> None:
    client.send("subscribe", id="mine", topic=7)
    assert [status["id"] for status in client.received()] == ["mine"]


def test_what_a_client_may_have_is_bounded(client: Client) -> None:
    for number in range(limits.SUBSCRIPTIONS_MAX + 5):
        client.send("subscribe", topic=f"/t{number}")
    assert len(client.received()) == 5
    for number in range(limits.SUBSCRIBERS_MAX + 4):
        client.send("subscribe", topic="/t1", id=number)
    assert len(client.received()) == 5
    for number in range(limits.ADVERTISED_MAX + 5):
        client.send("advertise", topic=f"/t{number}", type=STRING)
    assert len(client.received()) == 5


_KEY = st.text(max_size=4) | st.integers()
_ANY = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(2**70), 2**70),
        st.floats(),
        st.text(max_size=9),
        st.binary(max_size=9),
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_KEY, inner, max_size=3),
    max_leaves=6,
)
_NAMES = ["/t", "/s", "/rosapi/topics", "/rosapi/get_param", "std_msgs/String", "std_srvs/SetBool", "actionlib/Test"]
_VALUES = ["none", "png", "cbor", "cbor-raw", "info", "i", {"data": "x"}, {"a": 1}, [1, 2], 0, 1, 5, 1000, True, "{}"]
_USUAL = st.sampled_from([*_NAMES, *_VALUES])


@st.composite
def _op(draw: st.DrawFn) -> dict[str, Any]:
    name = draw(st.sampled_from(sorted(OPS)))
    fields = [field.encode_name for field in msgspec.structs.fields(OPS[name])]
    values = {field: draw(_USUAL | _USUAL | _ANY) for field in fields if draw(st.integers(0, 4))}
    return {"op": name, **values}


@settings(max_examples=150, deadline=None)
@given(st.lists(_op(), max_size=6), st.booleans())
def test_any_ops_in_any_order(ops: list[dict[str, Any]], binary: bool) -> None:
    client = Client()
    client.graph.add_topic("/t", "std_msgs/String")
    client.graph.add_service("/s", "std_srvs/SetBool")
    for op in ops:
        try:
            frame = cbor2.dumps(op) if binary else msgspec.json.encode(op).decode()
        except (TypeError, OverflowError):
            continue
        for asked in client.send_raw(frame):
            answer(asked, b"\1\0\0\0x")
        client.advance(0.001)
    client.advance(1000)
    assert all("op" in each for each in client.received())
    assert client.session.next_timer() is None
