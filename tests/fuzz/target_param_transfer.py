"""What a peer sends as a large message between agents, and what it asks about parameters and answers to that."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import msgspec

from rmpa.bridge.data.reception import LinkTime
from rmpa.bridge.messages import Message, Request, Response
from rmpa.bridge.params.owner import count_of, key_problem, text_of
from rmpa.bridge.rpc import LinkRequests, PeerRpc
from rmpa.core.errors import RmpaError
from rmpa.core.statistics import Counters
from rmpa.ros.master.parameters import leaves
from tests.bridge.services.test_calls import Wire

_UNTIL = bytes(8)
SEEDS: list[bytes] = [
    _UNTIL + b'{"op":"ask","number":1,"what":"param.set","args":{"key":"/x"}}\n<?xml',
    _UNTIL + b'{"op":"answer","number":1,"ok":true,"value":{}}\n<?xml',
    _UNTIL + b'{"op":"answer","number":1,"ok":true,"value":{"text":"a","count":1}}',
    _UNTIL + b'{"op":"answer","number":1,"ok":true,"value":5}\n\xff',
    _UNTIL + b'{"op":"tell","what":"names.taken"}',
    _UNTIL + b'{"op":"ask","number":1,"what":"param.value","args":{"key":"/a","text":null}}',
    _UNTIL + b'{"op":"ask","number":1,"what":"x","args":{"a":{"b":[1,{"c":2}]},"":{"/x":null}}}',
    b"\xff" * 5,
]


def fuzz(data: bytes) -> None:
    """Whatever comes, an ``RmpaError`` or a request or response."""
    taken: list[Message] = []
    time = LinkTime()
    time.set(0.0, 0.001)
    session = cast("Any", SimpleNamespace(link=Wire(), time=time))
    large = LinkRequests(PeerRpc(Counters()), session)
    large.take = lambda message, *_: taken.append(message)  # type: ignore[method-assign]
    try:
        large.body(1, bytearray(data))
    except RmpaError as error:
        str(error)
    for message in taken:
        said = message.args if isinstance(message, Request) else cast("Response", message).value
        for read in (text_of, count_of):
            try:
                read(said)
            except RmpaError as error:
                str(error)
        for key, _ in leaves("/x", said if isinstance(said, dict) else {}):
            if not key_problem(key) and ("//" in key or not key.startswith("/")):
                raise AssertionError(f"{key!r} would be taken for a parameter's name")
        msgspec.to_builtins(said)
