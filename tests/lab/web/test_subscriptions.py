"""A measured message is recognised in each encoding, as rosbridge and Foxglove write it."""

from __future__ import annotations

import json
import struct
from base64 import b64encode
from typing import TYPE_CHECKING, get_args

import cbor2
import pytest

from lab.nodes.node import HEAD
from lab.web.subscriptions import How, head_of

if TYPE_CHECKING:
    from collections.abc import Mapping

DATA = HEAD.pack(7, 123_456, 1 << 60) + b"\x07" * 1000
PAYLOAD = struct.pack("<III", 0, 0, len(DATA)) + DATA
LAYOUT = {"dim": [], "data_offset": 0}
PUBLISH = {"op": "publish", "topic": "/image"}
MESSAGES: Mapping[How, str | bytes] = {
    "json": json.dumps({**PUBLISH, "msg": {"layout": LAYOUT, "data": b64encode(DATA).decode()}}),
    "cbor": cbor2.dumps({**PUBLISH, "msg": {"layout": LAYOUT, "data": DATA}}),
    "cbor-raw": cbor2.dumps({**PUBLISH, "msg": {"secs": 1, "nsecs": 2, "bytes": PAYLOAD}}),
    "foxglove": struct.pack("<BIQ", 1, 3, 99) + PAYLOAD,
}


@pytest.mark.parametrize("how", get_args(How))
def test_the_head_of_a_message_is_found_and_nothing_else_is_one(how: How) -> None:
    assert head_of(MESSAGES[how], how) == (7, 123_456, 1 << 60)
    assert head_of('{"op":"status","level":"error"}', how) is None
    assert head_of(b"\x02ab", how) is None
