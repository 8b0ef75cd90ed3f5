"""Fuzz target: the arguments and responses of peers about direct transport."""

from __future__ import annotations

import json

import msgspec

from rmpa.bridge.direct import requests
from rmpa.bridge.direct.conditions import Grant, read_reply, reply_of
from rmpa.core.contract import Contract
from rmpa.core.errors import RemoteProtocolError

_READERS = (requests.read_open, requests.read_close, requests.read_closed, requests.read_retry)

SEEDS: list[bytes] = [
    *(
        json.dumps(requests.write(one)).encode()
        for one in (
            requests.OpenDirect("/chatter", "/talker", "/viewer", Contract()),
            requests.CloseDirect("/chatter", "/talker", "/viewer", True),
            requests.DirectClosed("/chatter", "/talker", "", "node", "restarted"),
            requests.RetryDirect("/chatter", "/talker"),
        )
    ),
    b'{"port": 45225, "probe": "/talker/get_loggers"}',
    b'{"why": "caller_id", "text": "another /viewer"}',
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
    for read in _READERS:
        try:
            arguments = read(value)
        except RemoteProtocolError as error:
            if not str(error).isprintable():
                raise AssertionError("an error's text is not safe to log") from error
            continue
        if read(requests.write(arguments)) != arguments:
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
