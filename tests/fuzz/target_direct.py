"""Fuzz target: the arguments and responses of peers about direct transport."""

from __future__ import annotations

import json

import msgspec

from rmpa.bridge.direct.grants import DirectAsk, read_ask, read_want, write
from rmpa.bridge.direct.nodes import Grant, read_reply, reply_of
from rmpa.core.contract import Contract
from rmpa.core.errors import RemoteProtocolError

SEEDS: list[bytes] = [
    json.dumps(write(DirectAsk("/chatter", "/talker", "/viewer", Contract(), True))).encode(),
    json.dumps(write(DirectAsk("/add", "/adder"))).encode(),
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
    for read in (read_ask, read_want):
        try:
            found = read(value)
        except RemoteProtocolError as error:
            if not str(error).isprintable():
                raise AssertionError("an error's text is not safe to log") from error
            continue
        again = read_ask(write(found)) if isinstance(found, DirectAsk) else read_want(found._asdict())
        if again != found:
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
