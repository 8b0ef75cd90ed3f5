from __future__ import annotations

import re
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError, LimitExceeded, RemoteProtocolError
from rmpa.core.limits import KIB
from rmpa.ros import limits
from rmpa.ros.wire.http import call_name, too_large, too_many
from rmpa.ros.wire.tcpros import (
    REPLY,
    BodyBuffer,
    ServiceDescription,
    TopicDescription,
    check_publisher,
    check_server,
    check_subscriber,
    client_header,
    decode_header,
    encode_header,
    frame_message,
    is_set,
    parse_header,
    parse_reply_head,
    parse_service_uri,
    printable,
    publisher_header,
    server_header,
    split_messages,
    subscriber_header,
)
from tests.ros.documents import serialize_call

MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


STRING = TopicDescription("std_msgs/String", MD5, "string data\n")


GOLDEN = bytes.fromhex("19000000 09000000 746f7069633d2f7461 08000000 6d643573756d3d2a")


def field(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


def header(*fields: bytes) -> bytes:
    body = b"".join(map(field, fields))
    return struct.pack("<I", len(body)) + body


def test_a_header_is_these_bytes() -> None:
    assert encode_header({"topic": "/ta", "md5sum": "*"}) == (
        b"\x19\x00\x00\x00" + b"\x08\x00\x00\x00md5sum=*" + b"\x09\x00\x00\x00topic=/ta"
    )
    assert parse_header(GOLDEN) == ({"topic": "/ta", "md5sum": "*"}, 29, 4)


@pytest.mark.trap(7)
def test_a_header_is_read_byte_by_byte() -> None:
    wire = encode_header({"topic": "/ta", "md5sum": "*"}) + b"rest"
    for end in range(len(wire) - 4):
        fields, consumed, wanted = parse_header(wire[:end])
        assert (fields, consumed) == (None, 0)
        assert end < wanted <= len(wire) - 4
    assert parse_header(wire)[1] == len(wire) - 4


@given(
    st.dictionaries(
        st.text(st.characters(exclude_characters="=", exclude_categories=["Cs"]), min_size=1).filter(
            lambda key: key == key.strip()
        ),
        st.text(st.characters(exclude_categories=["Cs"])),
    )
)
def test_any_header_survives_the_wire(fields: dict[str, str]) -> None:
    wire = encode_header(fields)
    assert parse_header(wire) == (fields, len(wire), 4)


@pytest.mark.trap(7)
def test_a_value_may_hold_equal_signs() -> None:
    assert decode_header(header(b"message_definition=int32 X=1\n")[4:]) == {"message_definition": "int32 X=1\n"}


@pytest.mark.trap(7)
def test_of_two_fields_with_one_name_the_last_counts() -> None:
    assert decode_header(header(b"topic=/a", b"topic=/b")[4:]) == {"topic": "/b"}


@pytest.mark.trap(7)
def test_blanks_around_a_name_are_taken_off_and_those_of_the_value_stay() -> None:
    assert decode_header(header(b" topic = /a")[4:]) == {"topic": " /a"}


@pytest.mark.trap(7)
def test_bytes_that_are_not_utf8_survive() -> None:
    wire = header(b"message_definition=# 20 \xb0C\n")
    fields, _, _ = parse_header(wire)
    assert fields is not None
    assert encode_header(fields) == wire


@pytest.mark.trap(6, 7)
@pytest.mark.parametrize(
    ("body", "text"),
    [
        (field(b""), "field of length 0"),
        (field(b"topic"), "without '='"),
        (b"\x09\x00\x00\x00topic=/", "field of 9 bytes where 7 are left"),
        (b"\xff\xff\xff\xff", "field of 4294967295 bytes where 0 are left"),
        (field(b"a=b") + b"\x01\x00", "ends within a length, 2 bytes left over"),
    ],
)
def test_a_malformed_header_is_refused(body: bytes, text: str) -> None:
    with pytest.raises(RemoteProtocolError, match=text):
        decode_header(body)


@pytest.mark.trap(6)
def test_a_header_of_half_a_gigabyte_is_refused_from_its_length_alone() -> None:
    with pytest.raises(LimitExceeded, match=r"connection header of 542393671 bytes exceeds the limit of 4194304"):
        parse_header(b"GET ")


def test_a_message_beyond_the_limit_is_refused_behind_those_before_it() -> None:
    huge = struct.pack("<I", limits.TCPROS_MESSAGE_MAX + 1)
    messages, consumed, _ = split_messages(memoryview(frame_message(b"ok") + huge))
    assert (len(messages), consumed) == (1, 6)
    with pytest.raises(LimitExceeded, match="message of"):
        split_messages(memoryview(huge))


@pytest.mark.parametrize("size", [limits.TCPROS_LENGTH_MAX + 1, (1 << 32) - 1])
def test_impossible_length_differs_from_too_long_message(size: int) -> None:
    with pytest.raises(RemoteProtocolError, match=f"{size} bytes cannot be.*corrupt"):
        split_messages(memoryview(struct.pack("<I", size)))
    with pytest.raises(LimitExceeded):
        split_messages(memoryview(struct.pack("<I", limits.TCPROS_LENGTH_MAX)))


SUBSCRIBER = subscriber_header("/t", "/s", TopicDescription("std_msgs/String", MD5, ""))


@pytest.mark.trap(1, 4)
@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({}, None),
        ({"md5sum": "*"}, None),
        ({"type": "other_msgs/Type"}, None),  # the type is ignored where the md5 sum matches
        ({"type": "*"}, None),
        ({"md5sum": "0" * 32}, r"wants topic /t to have type/md5sum \[std_msgs/String/0{32}\], but publisher \[/p\]"),
        ({"md5sum": None}, "required field 'md5sum' is missing"),
        ({"callerid": None}, "required field 'callerid' is missing"),
        ({"type": None}, None),
        ({"topic": None}, "neither a 'topic' nor a 'service' field"),
        ({"topic": "t"}, r"\[/p\] is not a publisher of \[t\]"),
        ({"topic": "/t/"}, r"\[/p\] is not a publisher of \[/t/\]"),
        ({"error": "no"}, "an error was sent where a request was expected: no"),
    ],
)
def test_who_may_subscribe(change: dict[str, str | None], error: str | None) -> None:
    merged = {**SUBSCRIBER, **change}
    answer = check_subscriber({k: v for k, v in merged.items() if v is not None}, "/t", "/p", STRING)
    if error is None:
        assert answer is None
    else:
        assert answer is not None
        assert re.search(error, answer)


@pytest.mark.trap(2)
def test_a_publisher_answers_with_all_fields() -> None:
    assert publisher_header("/t", "/p", TopicDescription("std_msgs/String", MD5, "string data\n", latching=True)) == {
        "callerid": "/p",
        "latching": "1",
        "md5sum": MD5,
        "message_definition": "string data\n",
        "topic": "/t",
        "type": "std_msgs/String",
    }
    assert publisher_header("/t", "/p", STRING)["latching"] == "0"


@pytest.mark.trap(2)
@pytest.mark.parametrize(
    "description", [TopicDescription("*", MD5, ""), TopicDescription("std_msgs/String", "*", "")]
)
def test_a_publisher_never_answers_with_a_wildcard(description: TopicDescription) -> None:
    with pytest.raises(ValueError, match="cannot have the type"):
        publisher_header("/t", "/p", description)


@pytest.mark.trap(1)
@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"type": "std_msgs/String", "md5sum": MD5}, None),
        ({"error": "go away\x1b[31m"}, "go away�[31m"),
        ({"md5sum": MD5}, "required field 'type' is missing in the publisher's reply"),
        ({"type": "std_msgs/String"}, "required field 'md5sum' is missing in the publisher's reply"),
        ({"type": "*", "md5sum": MD5}, "the publisher's reply has '*' where a type or md5 sum must be"),
        ({"type": "a/B", "md5sum": "0"}, f"the publisher has [a/B/0], not [std_msgs/String/{MD5}]"),
    ],
)
def test_whether_a_publisher_is_believed(fields: dict[str, str], error: str | None) -> None:
    assert check_publisher(fields, "std_msgs/String", MD5) == error


def test_what_a_peer_sends_is_safe_to_print() -> None:
    assert printable("a\nb\x1b\udcff" + "x" * 300) == "a�b��" + "x" * 195 + "…"


SERVICE_MD5 = "6a2e34150c00229791cc89ff309fff21"


ADD = ServiceDescription("rospy_tutorials/AddTwoInts", SERVICE_MD5)


def test_the_reply_header_has_what_rospy_and_roscpp_look_for() -> None:
    assert server_header("/server", ADD) == {
        "callerid": "/server",
        "md5sum": SERVICE_MD5,
        "request_type": "rospy_tutorials/AddTwoIntsRequest",
        "response_type": "rospy_tutorials/AddTwoIntsResponse",
        "type": "rospy_tutorials/AddTwoInts",
    }
    assert ServiceDescription.from_header(server_header("/server", ADD)) == ServiceDescription(
        ADD.type, SERVICE_MD5, ADD.type + "Request", ADD.type + "Response"
    )


@pytest.mark.parametrize("description", [ServiceDescription("*", SERVICE_MD5), ServiceDescription("a/B", "*")])
def test_no_server_answers_with_a_star(description: ServiceDescription) -> None:
    with pytest.raises(ValueError, match="cannot have the type"):
        server_header("/server", description)


@pytest.mark.trap(24)
def test_persistent_as_rospy_and_roscpp_write_it() -> None:
    assert client_header("/add", "/c", persistent=True)["persistent"] == "1"
    assert "persistent" not in client_header("/add", "/c")
    for value in ("1", "true", "True", "TRUE"):
        assert is_set({"persistent": value}, "persistent")
    for value in ("0", "false", "", "yes"):
        assert not is_set({"persistent": value}, "persistent")
    assert is_set(client_header("/add", "/c", probe=True), "probe")
    assert not is_set({}, "probe")


def test_a_servers_header_is_not_believed_unseen() -> None:
    assert check_server(server_header("/s", ADD), "/add", SERVICE_MD5) is None
    assert check_server({"md5sum": SERVICE_MD5}, "/add") is None  # all that roscpp needs
    assert check_server({"error": "no\x1b[2J"}, "/add") == "no�[2J"
    assert check_server({"type": "a/B"}, "/add") == "required field 'md5sum' is missing in the server's reply"
    other = "1" * 32
    assert (
        check_server({"md5sum": other}, "/add", SERVICE_MD5)
        == f"the server of /add has md5sum [{other}], not [{SERVICE_MD5}]"
    )


@pytest.mark.trap(25)
def test_golden_replies() -> None:
    assert REPLY.pack(True, 3) + b"abc" == b"\x01\x03\x00\x00\x00abc"
    assert parse_reply_head(b"\x01\x03\x00\x00\x00abc") == (True, 3)
    assert parse_reply_head(b"\x00\x02\x00\x00\x00") == (False, 2)
    for size in range(5):
        assert parse_reply_head(b"\x01\x03\x00\x00\x00"[:size]) is None


def test_a_claim_beyond_the_limit_is_not_believed() -> None:
    with pytest.raises(LimitExceeded, match="service response of 4294967295 bytes"):
        parse_reply_head(b"\x01\xff\xff\xff\xff")
    assert parse_reply_head(b"\x01" + limits.SERVICE_MESSAGE_MAX.to_bytes(4, "little"))


@given(st.binary(max_size=300), st.lists(st.integers(1, 50)))
def test_a_body_takes_its_own_bytes_only(data: bytes, cuts: list[int]) -> None:
    body = BodyBuffer(len(data))
    stream = memoryview(data + b"next")
    for cut in cuts:
        stream = stream[body.take(stream[:cut]) :]
    stream = stream[body.take(stream) :]
    assert body.whole
    assert bytes(body.data) == data
    assert bytes(stream) == b"next"


def test_service_uris() -> None:
    assert parse_service_uri("rosrpc://localhost:1234") == ("localhost", 1234)
    assert parse_service_uri("rosrpc://127.0.0.1:1234/") == ("127.0.0.1", 1234)
    assert parse_service_uri("rosrpc://[::1]:1234") == ("::1", 1234)
    with pytest.raises(ConfigError):
        parse_service_uri("rosrpc://a:" + "9" * 5000)
    for bad in (
        "http://a:1",
        "rosrpc://a",
        "rosrpc://:1",
        "rosrpc://a:b",
        "",
        "rosrpc://",
        "rosrpc://a:0",
        "rosrpc://a:65536",
    ):
        with pytest.raises(ConfigError, match="is not a service's address"):
            parse_service_uri(bad)  # fmt: skip


# Bodies of calls as they come, and what is said of those that are too large.


@pytest.mark.parametrize(
    ("method", "params", "name"),
    [
        ("setParam", ["/loader", "/robot_description", "x"], "setParam /robot_description"),
        ("setParam", ["/loader", "/ns", {"a": 1}], "setParam /ns"),
        ("system.multicall", [[{"methodName": "setParam", "params": ["/r", "/a", "x"]}]], "system.multicall"),
        ("registerPublisher", ["/n", "/t", "std_msgs/String", "http://x:1/"], "registerPublisher"),
    ],
)
def test_call_is_named_by_its_beginning(method: str, params: list[object], name: str) -> None:
    assert call_name(serialize_call(method, params)[: 4 * KIB]) == name  # type: ignore[arg-type]


def test_roscpps_untyped_strings_are_read_too() -> None:
    body = b"<methodCall><methodName>setParam</methodName><params><param><value>/n</value></param>"
    body += b"<param><value>/k</value></param><param>"
    assert call_name(body) == "setParam /k"


@pytest.mark.parametrize("begin", [b"", b"<methodName>", b"\xff" * 100, b"<methodName>a b</methodName>"])
def test_unclear_beginning_is_a_call(begin: bytes) -> None:
    assert call_name(begin) == "a call"


def test_the_texts_name_the_call_the_sizes_and_the_remedy() -> None:
    begin = serialize_call("setParam", ["/loader", "/map", "x"])
    assert all(part in too_large(begin, 70_000_000) for part in ("/map", "70000000", "64 MiB", "one by one"))
    assert all(part in too_many(begin, 70_000_000) for part in ("/map", "70000000", "256 MiB", "again"))
