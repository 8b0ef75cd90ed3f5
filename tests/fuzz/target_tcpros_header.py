"""Fuzz target: TCPROS connection headers, and what is decided from them."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.wire.tcpros import (
    TopicDescription,
    check_publisher,
    check_subscriber,
    encode_header,
    error_header,
    parse_header,
    publisher_header,
    subscriber_header,
)

_STRING = TopicDescription("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n", latching=True)

SEEDS: list[bytes] = [
    b"",
    bytes(4),
    b"GET / HTTP/1.1\r\n",
    encode_header(subscriber_header("/t", "/s")),
    encode_header(subscriber_header("/t", "/s", type_name="a/B", md5sum="0" * 32, definition="int32 x=1\n")),
    encode_header(publisher_header("/t", "/p", _STRING)) + b"\x05\x00\x00\x00hello",
    encode_header(error_header("no \udcff")),
    encode_header({"service": "/add", "md5sum": "*", "callerid": "/c", "probe": "1"}),
]


def fuzz(data: bytes) -> None:
    """A header that survives its own round trip, or a documented error; whole and in pieces alike."""
    try:
        fields, consumed, wanted = parse_header(data)
    except RemoteProtocolError as error:
        if not str(error).isprintable():
            raise AssertionError("an error's text is not safe to log") from error
        return
    if fields is None:
        if consumed or wanted <= len(data):
            raise AssertionError("a header that is not whole wants more than there is")
        return
    again, _, _ = parse_header(encode_header(fields))
    if again != fields:
        raise AssertionError(f"{fields} does not survive its round trip")
    for end in (0, 3, consumed - 1):
        if parse_header(data[:end])[0] is not None:
            raise AssertionError("a part of a header was taken for the whole")
    for text in (check_subscriber(fields, "/t", "/p", _STRING), check_publisher(fields, "a/B", "0" * 32)):
        if text is not None and not text.isprintable():
            raise AssertionError("an error's text is not safe to log")
