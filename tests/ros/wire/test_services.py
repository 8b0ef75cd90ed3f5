from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError, LimitExceeded
from rmpa.ros import limits
from rmpa.ros.wire.tcpros import (
    BodyBuffer,
    ServiceDescription,
    check_client,
    check_server,
    client_header,
    frame_reply,
    is_persistent,
    is_probe,
    parse_reply_head,
    parse_request_length,
    parse_service_uri,
    server_header,
)

MD5 = "6a2e34150c00229791cc89ff309fff21"
ADD = ServiceDescription("rospy_tutorials/AddTwoInts", MD5)


def test_the_reply_header_has_what_rospy_and_roscpp_look_for() -> None:
    assert server_header("/server", ADD) == {
        "callerid": "/server",
        "md5sum": MD5,
        "request_type": "rospy_tutorials/AddTwoIntsRequest",
        "response_type": "rospy_tutorials/AddTwoIntsResponse",
        "type": "rospy_tutorials/AddTwoInts",
    }
    assert ServiceDescription.from_header(server_header("/server", ADD)) == ServiceDescription(
        ADD.type, MD5, ADD.type + "Request", ADD.type + "Response"
    )


@pytest.mark.parametrize("description", [ServiceDescription("*", MD5), ServiceDescription("a/B", "*")])
def test_no_server_answers_with_a_star(description: ServiceDescription) -> None:
    with pytest.raises(ValueError, match="cannot have the type"):
        server_header("/server", description)


@pytest.mark.trap(24)
def test_persistent_as_rospy_and_roscpp_write_it() -> None:
    assert client_header("/add", "/c", persistent=True)["persistent"] == "1"
    assert "persistent" not in client_header("/add", "/c")
    for value in ("1", "true", "True", "TRUE"):
        assert is_persistent({"persistent": value})
    for value in ("0", "false", "", "yes"):
        assert not is_persistent({"persistent": value})
    assert is_probe(client_header("/add", "/c", probe=True))
    assert not is_probe({})


def test_another_md5_sum_does_not_fit() -> None:
    header = client_header("/add", "/client", md5sum="0" * 32)
    text = check_client(header, "/add", "/server", ADD)
    assert text == (
        f"client [/client] wants service /add to have md5sum [{'0' * 32}], but server [/server] has "
        f"[rospy_tutorials/AddTwoInts/{MD5}]"
    )
    assert check_client(client_header("/add", "/c"), "/add", "/server", ADD) is None
    assert check_client(client_header("/add", "/c", md5sum=MD5), "/add", "/server", ADD) is None


def test_a_servers_header_is_not_believed_unseen() -> None:
    assert check_server(server_header("/s", ADD), "/add", MD5) is None
    assert check_server({"md5sum": MD5}, "/add") is None  # all that roscpp needs
    assert check_server({"error": "no\x1b[2J"}, "/add") == "no�[2J"
    assert check_server({"type": "a/B"}, "/add") == "required field 'md5sum' is missing in the server's reply"
    other = "1" * 32
    assert check_server({"md5sum": other}, "/add", MD5) == f"the server of /add has md5sum [{other}], not [{MD5}]"


@pytest.mark.trap(25)
def test_golden_replies() -> None:
    assert b"".join(frame_reply(True, b"abc")) == b"\x01\x03\x00\x00\x00abc"
    assert b"".join(frame_reply(False, b"no")) == b"\x00\x02\x00\x00\x00no"
    assert b"".join(frame_reply(False, b"")) == b"\x00\x00\x00\x00\x00"
    assert parse_reply_head(b"\x01\x03\x00\x00\x00abc") == (True, 3)
    assert parse_reply_head(b"\x00\x02\x00\x00\x00") == (False, 2)
    for size in range(5):
        assert parse_reply_head(b"\x01\x03\x00\x00\x00"[:size]) is None
    assert parse_request_length(b"\x08\x00\x00\x00") == 8
    assert parse_request_length(b"\x08\x00\x00") is None


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
            parse_service_uri(bad)
