"""Fuzz target: the arguments and responses of peers about direct transport."""

from __future__ import annotations

import msgspec

from rmpa.bridge.direct.conditions import DirectAsk, Grant, read_ask, read_reply, reply_of
from rmpa.core.contract import Contract
from rmpa.core.errors import RemoteProtocolError

SEEDS: list[bytes] = [
    msgspec.json.encode(DirectAsk("/chatter", "/talker", "/viewer", Contract(), True)),
    msgspec.json.encode(DirectAsk("/add", "/adder")),
    b'{"name": "/chatter", "node": "/talker", "user": "/viewer"}',
    b'{"port": 45225, "probe": "/talker/get_loggers"}',
    b'{"port": 70000, "probe": "/adder/get_loggers"}',
    b'{"why": "caller_id", "text": "another /viewer"}',
    b'{"why": "moon", "text": "of a later release"}',
    b"[1, 2]",
]


def fuzz(data: bytes) -> None:
    """Valid values or a documented error; a port, a service and a text are always fit for use."""
    try:
        value = msgspec.json.decode(data)  # as messages between agents are decoded
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return
    _response(value)
    if not isinstance(value, dict):
        return
    try:
        found = read_ask(value)
    except RemoteProtocolError as error:
        if not str(error).isprintable():
            raise AssertionError("an error's text is not safe to log") from error
        return
    if read_ask(msgspec.to_builtins(found)) != found:
        raise AssertionError("arguments do not survive their round trip")


def _response(value: object) -> None:
    try:
        found = read_reply(value, "/talker")
    except RemoteProtocolError:
        return
    if isinstance(found, Grant):
        if not 0 < found.port < 1 << 16 or not found.probe.isprintable():
            raise AssertionError(f"{found} was taken for a grant")
    elif not found.text.isprintable():
        raise AssertionError("a reason is not safe to show")
    if read_reply(reply_of(found), "/talker") != found:
        raise AssertionError("a response does not survive its round trip")
