"""XML-RPC bodies: calls and responses."""

from __future__ import annotations

import contextlib

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.wire.xmlrpc import (
    RosFault,
    parse_call,
    parse_response,
    serialize_call,
    serialize_fault,
    serialize_response,
)

SEEDS: list[bytes] = [
    serialize_call("registerPublisher", ("/talker", "/chatter", "std_msgs/String", "http://127.0.0.1:4711/")),
    serialize_call("setParam", ("/n", "/p", {"a": [1, 2.5, True, "x", b"y"], "b": {}})),
    serialize_response([1, "ok", [["/rosout", ["/talker"]]]]),
    serialize_fault(1, "no such method"),
    b"<methodCall><methodName>m</methodName><params><param><value>untyped</value></param></params></methodCall>",
    b'<!DOCTYPE x [<!ENTITY a "aaaa">]><methodCall><methodName>&a;</methodName></methodCall>',
]


def fuzz(data: bytes) -> None:
    """Read a body both ways; what was read can be written again unless it holds a nil."""
    with contextlib.suppress(RemoteProtocolError):
        method, params = parse_call(data)
        assert isinstance(method, str)
        assert isinstance(params, tuple)
    with contextlib.suppress(RemoteProtocolError, RosFault):
        parse_response(data)
