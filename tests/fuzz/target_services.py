"""Fuzz target: the bytes of a service's connection, and the definitions of service types."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.ros import limits
from rmpa.ros.types.definitions import DefinitionError
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.wire.tcpros import (
    BodyBuffer,
    ServiceDescription,
    check_client,
    check_server,
    client_header,
    encode_header,
    frame_reply,
    is_persistent,
    is_probe,
    parse_header,
    parse_reply_head,
    parse_request_length,
    parse_service_uri,
    server_header,
)

_ADD = ServiceDescription("rospy_tutorials/AddTwoInts", "6a2e34150c00229791cc89ff309fff21")

SEEDS: list[bytes] = [
    b"",
    b"\x00\x00\x00\x00\x00",
    b"".join(frame_reply(True, b"abc")),
    b"".join(frame_reply(False, b"no")),
    b"\x01\xff\xff\xff\xff",
    encode_header(client_header("/add", "/c", persistent=True, probe=True)),
    encode_header(server_header("/s", _ADD)),
    b"rosrpc://127.0.0.1:1234",
    b"int64 a\nint64 b\n---\nint64 sum",
    b"std_msgs/Header h\nstring X=a#b\n---\n",
]


def fuzz(data: bytes) -> None:
    """Values or documented errors, whose texts are safe to log; nothing is believed beyond the limits."""
    _headers(data)
    _reply(data)
    size = parse_request_length(data)
    if (size is None) != (len(data) < 4):
        raise AssertionError("a request's length needs four bytes, and no more")
    text = data.decode("utf-8", "replace")
    try:
        host, port = parse_service_uri(text)
    except RmpaError as error:
        _safe(str(error))
    else:
        if not host or port < 0:
            raise AssertionError(f"{text!r} was taken for an address")
    try:
        kind = ServiceType("p/T", text)
    except (DefinitionError, RemoteProtocolError):
        return
    if len(kind.md5sum) != 32:
        raise AssertionError("a type without a sum")


def _headers(data: bytes) -> None:
    try:
        fields, _, _ = parse_header(data)
    except RemoteProtocolError:
        return
    if fields is None:
        return
    is_persistent(fields), is_probe(fields)
    for problem in (
        check_client({"md5sum": "", "callerid": "", **fields}, "/add", "/s", _ADD),
        check_server(fields, "/add", _ADD.md5sum),
    ):
        if problem is not None:
            _safe(problem)
    _safe(str(ServiceDescription.from_header(fields)))


def _reply(data: bytes) -> None:
    try:
        head = parse_reply_head(data)
    except RemoteProtocolError as error:
        _safe(str(error))
        return
    if head is None:
        return
    ok, size = head
    if size > limits.SERVICE_MESSAGE_MAX:
        raise AssertionError("more was believed than is allowed")
    body = BodyBuffer(size)
    taken = body.take(memoryview(data)[5:])
    if taken != min(size, len(data) - 5) or body.whole != (taken == size):
        raise AssertionError("a body took what is not its own")
    if body.whole and b"".join(frame_reply(ok, body.data)) != bytes([ok]) + data[1 : 5 + size]:
        raise AssertionError("a reply does not survive its round trip")


def _safe(text: str) -> None:
    if not text.isprintable():
        raise AssertionError("an error's text is not safe to log")
