from __future__ import annotations

import json

import cbor2
import pytest

from rmpa.core.errors import PeerRefused
from rmpa.web import limits
from rmpa.web.gateways.frame_writer import Opcode
from rmpa.web.rosbridge.protocol import decode_png
from tests.web.recorder import NOW_NS
from tests.web.rosbridge.client import Client

STRING = "std_msgs/String"
HELLO = b"\x05\0\0\0hello"


# --- subscribing -------------------------------------------------------------------------------------------------


def test_a_subscriber_gets_messages_in_json() -> None:
    client = Client()
    asked = client.subscribe(type=STRING)
    assert (asked.topic, asked.type) == ("/t", STRING)
    client.publish(asked, STRING, {"data": "hello"})
    ((opcode, parts),) = client.frames()
    assert (opcode, b"".join(parts)) == (Opcode.TEXT, b'{"op":"publish","topic":"/t","msg":{"data":"hello"}}')


def test_the_topic_is_called_as_the_client_wrote_it() -> None:
    client = Client()
    asked = client.subscribe("t", type="std_msgs/msg/String")
    assert (asked.topic, asked.type) == ("/t", STRING)
    client.publish(asked, STRING, {"data": "hello"})
    assert client.received()[0]["topic"] == "t"


def test_each_compression() -> None:
    client = Client()
    for compression in ("none", "png", "cbor", "cbor-raw"):
        asked = client.subscribe(f"/{compression[-3:]}", compression=compression)
        client.publish(asked, STRING, {"data": "hello"})
    none, png, cbor, raw = client.received()
    assert none == {"op": "publish", "topic": "/one", "msg": {"data": "hello"}}
    assert json.loads(decode_png(png["data"])) == {"op": "publish", "topic": "/png", "msg": {"data": "hello"}}
    assert cbor == {"op": "publish", "topic": "/bor", "msg": {"data": "hello"}}
    secs, nsecs = divmod(NOW_NS, 10**9)
    assert raw["msg"] == {"secs": secs, "nsecs": nsecs, "bytes": HELLO}


def test_cbor_raw_needs_no_definition() -> None:
    client = Client()
    client.subscribe(type="x/Y", compression="cbor-raw").message(b"abc", "x/Y")
    assert client.received()[0]["msg"]["bytes"] == b"abc"


def test_several_subscriptions_are_one_with_the_best_of_all() -> None:
    client = Client()
    asked = client.subscribe(id="a", throttle_rate=1000)
    assert not client.send("subscribe", id="b", topic="/t", throttle_rate=100, compression="cbor")
    assert not client.send("subscribe", id="c", topic="/t", throttle_rate=500, compression="png")
    for _ in range(10):
        client.publish(asked, STRING, {"data": "hello"})
        client.now += 0.05
    frames = client.frames()
    assert len(frames) == 5
    assert all(opcode is Opcode.BINARY for opcode, _ in frames)
    client.send("unsubscribe", id="b", topic="/t")
    client.now += 0.5
    client.publish(asked, STRING, {"data": "hello"})
    assert client.received()[0]["op"] == "png"
    client.send("unsubscribe", id="a", topic="/t")
    assert not asked.closed
    client.send("unsubscribe", id="c", topic="/t")
    assert asked.closed


def test_unsubscribe_without_an_id_ends_all() -> None:
    client = Client()
    asked = client.subscribe(id="a")
    client.send("subscribe", id="b", topic="/t")
    client.send("unsubscribe", topic="/t")
    assert asked.closed


def test_the_longest_queue_is_used_and_freed_with_the_last_subscription() -> None:
    client = Client()
    handle = client.subscribe(id="a", type=STRING, throttle_rate=1000, queue_length=1)
    client.send("subscribe", id="b", topic="/t", throttle_rate=1000, queue_length=3)
    for number in range(5):
        client.publish(handle, STRING, {"data": str(number)})
    client.advance(10)
    assert [each["msg"]["data"] for each in client.received()] == ["0", "2", "3", "4"]
    client.publish(handle, STRING, {"data": "5"})
    client.publish(handle, STRING, {"data": "6"})
    client.send("unsubscribe", topic="/t")
    assert client.session.queued.used == 0
    assert client.session.next_timer() is None


def test_long_messages_come_in_fragments_of_the_smallest_size() -> None:
    client = Client()
    handle = client.subscribe(id="a", fragment_size=50)
    client.send("subscribe", id="b", topic="/t", fragment_size=30)
    client.publish(handle, STRING, {"data": "x" * 100})
    client.publish(handle, STRING, {"data": "y" * 100})
    got = client.received()
    assert {each["op"] for each in got} == {"fragment"}
    assert all(len(each["data"]) <= 30 for each in got)
    first, second = ("".join(each["data"] for each in got if each["id"] == mid) for mid in (0, 1))
    assert json.loads(first)["msg"]["data"] == "x" * 100
    assert json.loads(second)["msg"]["data"] == "y" * 100


def test_a_broken_message_is_reported_once() -> None:
    client = Client()
    handle = client.subscribe()
    for _ in range(3):
        handle.message(b"\xff\xff\xff\xff")
    assert "message of /t: 4 bytes are not a std_msgs/String" in client.error()
    client.publish(handle, STRING, {"data": "ok"})
    assert client.received()[0]["msg"] == {"data": "ok"}


def test_another_type_than_the_topic_has_is_refused() -> None:
    client = Client()
    client.graph.add_topic("/t", STRING)
    assert not client.send("subscribe", topic="/t", type="std_msgs/Int8")
    assert "/t has the type std_msgs/String, not std_msgs/Int8" in client.error()
    client.send("subscribe", topic="/new", type=STRING)
    client.send("subscribe", topic="/new", type="std_msgs/Int8")
    assert "is subscribed as std_msgs/String" in client.error()


def test_a_subscription_that_the_hub_refuses_is_reported_and_may_begin_again() -> None:
    client = Client()
    handle = client.subscribe(id="i")
    handle.failed(PeerRefused("the core", "not allowed", "ask for the role operator"))
    (status,) = client.received()
    assert status["id"] == "i"
    assert status["msg"] == "subscribe /t: the core refused: not allowed; ask for the role operator"
    assert client.subscribe() is not handle


def test_a_subscription_without_a_type_fails_where_the_topic_does_not_appear() -> None:
    client = Client()
    none, *others = (client.subscribe(topic, id="i") for topic in ("/none", "/soon", "/published"))
    client.graph.add_topic("/soon", STRING)
    client.hub.published["/published"] = STRING
    client.advance(limits.TYPE_WAIT - 0.01)
    assert client.received() == []
    client.advance(0.01)
    assert none.closed
    assert not any(each.closed for each in others)
    assert "its type is not known; give its 'type'" in client.error()


def test_a_publisher_of_another_type_that_comes_later_is_reported() -> None:
    client = Client()
    client.subscribe(type="std_msgs/Int32").differs(STRING)
    assert "/t has the type std_msgs/String, not std_msgs/Int32" in client.error()


# --- publishing --------------------------------------------------------------------------------------------------


def test_a_client_publishes() -> None:
    client = Client()
    request = client.one("advertise", client.send("advertise", topic="t", type=STRING, latch=True, queue_size=5))
    assert (request.topic, request.type, request.latch) == ("/t", STRING, True)
    client.send("publish", topic="/t", msg={"data": "hello"})
    assert request.published == [HELLO]
    assert not client.received()


def test_a_message_without_all_fields_is_published_with_a_warning() -> None:
    client = Client()
    client.send("set_level", level="warning")
    (publisher,) = client.send("advertise", topic="/t", type="geometry_msgs/Point")
    client.send("publish", id="p", topic="/t", msg={"x": 1})
    assert publisher.published == [bytes(6) + b"\xf0\x3f" + bytes(16)]
    (status,) = client.received()
    assert (status["level"], status["id"]) == ("warning", "p")
    assert status["msg"].endswith("were not given: y, z")


@pytest.mark.parametrize("value", ["NaN", "Infinity", "-Infinity"])
def test_what_python_clients_write_for_not_a_number_is_taken(value: str) -> None:
    client = Client()
    (publisher,) = client.send("advertise", topic="/t", type="std_msgs/Float64")
    client.send_raw(f'{{"op": "publish", "topic": "/t", "msg": {{"data": {value}}}}}')
    assert publisher.published[0][-2] & 0xF0 == 0xF0


def test_a_publisher_ends_when_the_last_id_has_unadvertised_it() -> None:
    client = Client()
    publisher = client.one("advertise", client.send("advertise", id="a", topic="/t", type=STRING))
    assert not client.send("advertise", id="b", topic="/t", type=STRING)
    client.send("unadvertise", id="a", topic="/t")
    assert not publisher.closed
    client.send("unadvertise", id="b", topic="/t")
    assert publisher.closed
    publisher = client.one("advertise", client.send("advertise", id="c", topic="/t", type=STRING))
    client.send("advertise", id="d", topic="/t", type=STRING)
    client.send("unadvertise", topic="/t")
    assert publisher.closed


def test_a_topic_of_the_graph_may_be_published_without_advertising() -> None:
    client = Client()
    client.graph.add_topic("/t", STRING)
    publisher = client.one("advertise", client.send("publish", topic="/t", msg={"data": "hello"}))
    assert (publisher.type, publisher.published) == (STRING, [HELLO])
    assert not client.send("publish", topic="/unknown", msg={})
    assert "advertise it first" in client.error()


def test_a_topic_has_one_type() -> None:
    client = Client()
    client.graph.add_topic("/t", STRING)
    assert not client.send("advertise", topic="/t", type="std_msgs/Int8")
    assert "has the type std_msgs/String" in client.error()
    client.send("advertise", topic="/mine", type=STRING)
    assert not client.send("advertise", topic="/mine", type="std_msgs/Int8")
    assert "is advertised as std_msgs/String" in client.error()
    assert not client.send("advertise", topic="/x", type="no_such/Type")
    assert "no_such/Type" in client.error()


def test_binary_frames_are_ops_in_cbor() -> None:
    client = Client()
    (publisher,) = client.send("advertise", topic="/t", type="std_msgs/UInt8MultiArray")
    message = {"layout": {"dim": [], "data_offset": 0}, "data": b"\x01\x02"}
    client.send_raw(cbor2.dumps({"op": "publish", "topic": "/t", "msg": message}))
    assert publisher.published[0].endswith(b"\x02\0\0\0\x01\x02")


# --- fragments, status, authentication ---------------------------------------------------------------------------


def test_ops_in_fragments_and_pictures_are_done() -> None:
    client = Client()
    text = json.dumps({"op": "advertise", "topic": "/t", "type": STRING})
    assert not client.send("fragment", id=1, data=text[20:], num=1, total=2)
    assert client.send("fragment", id=1, data=text[:20], num=0, total=2)
    other = Client()
    handle = other.subscribe("/p", compression="png")
    other.publish(handle, STRING, {"data": "hello"})
    (op,) = other.received()
    # The picture holds the op publish, of a topic that is known nowhere.
    client.send("png", **{key: op[key] for key in ("data",)})
    assert "publish /p" in client.error()
    half = len(op["data"]) // 2
    client.send("png", id="x", num=0, total=2, data=op["data"][:half])
    client.send("png", id="x", num=1, total=2, data=op["data"][half:])
    assert "publish /p" in client.error()


def test_fragments_within_fragments_end() -> None:
    client = Client()
    text = json.dumps({"op": "set_level", "level": "info"})
    for _ in range(3):
        text = json.dumps({"op": "fragment", "id": "i", "num": 0, "total": 1, "data": text})
    client.send_raw(text)
    assert "once only" in client.error()


def test_an_incomplete_message_is_dropped_with_a_warning() -> None:
    client = Client()
    client.send("set_level", level="warning")
    client.send("fragment", id="i", data="{", num=0, total=2)
    client.advance(limits.FRAGMENT_TIMEOUT)
    (status,) = client.received()
    assert (status["level"], status["id"]) == ("warning", "i")


def test_levels_of_status_messages() -> None:
    client = Client()
    for level, count in (("none", 0), ("error", 1), ("warning", 2), ("info", 3)):
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
        ('{"op": "send_action_goal", "action": "/a", "action_type": "x/Y"}', "unknown op 'send_action_goal'"),
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
def test_what_is_malformed_is_answered_by_an_error(data: str | bytes, says: str) -> None:
    client = Client()
    assert not client.send_raw(data)
    assert says in client.error()


def test_the_error_has_the_id_of_the_op() -> None:
    client = Client()
    client.send("subscribe", id="mine", topic=7)
    (status,) = client.received()
    assert status["id"] == "mine"


def test_what_a_client_may_have_is_bounded() -> None:
    client = Client()
    for number in range(limits.SUBSCRIPTIONS_MAX + 5):
        client.send("subscribe", topic=f"/t{number}")
    assert len(client.received()) == 5
    for number in range(limits.SUBSCRIBERS_MAX + 4):
        client.send("subscribe", topic="/t1", id=number)
    assert len(client.received()) == 5
    for number in range(limits.ADVERTISED_MAX + 5):
        client.send("advertise", topic=f"/t{number}", type=STRING)
    assert len(client.received()) == 5
