"""Ops whose values have any type: a session answers with a status, never with an exception."""

from __future__ import annotations

from typing import Any

import cbor2
import msgspec
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.web.rosbridge.session import OPS
from tests.web.recorder import answer
from tests.web.rosbridge.client import Client

_KEY = st.text(max_size=4) | st.integers()
_ANY = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(2**70), 2**70),
        st.floats(),
        st.text(max_size=9),
        st.binary(max_size=9),
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_KEY, inner, max_size=3),
    max_leaves=6,
)
_NAMES = ["/t", "/s", "/rosapi/topics", "/rosapi/get_param", "std_msgs/String", "std_srvs/SetBool", "actionlib/Test"]
_VALUES = ["none", "png", "cbor", "cbor-raw", "info", "i", {"data": "x"}, {"a": 1}, [1, 2], 0, 1, 5, 1000, True, "{}"]
_USUAL = st.sampled_from([*_NAMES, *_VALUES])


@st.composite
def _op(draw: st.DrawFn) -> dict[str, Any]:
    name = draw(st.sampled_from(sorted(OPS)))
    fields = [field.encode_name for field in msgspec.structs.fields(OPS[name])]
    values = {field: draw(_USUAL | _USUAL | _ANY) for field in fields if draw(st.integers(0, 4))}
    return {"op": name, **values}


@settings(max_examples=150, deadline=None)
@given(st.lists(_op(), max_size=6), st.booleans())
def test_any_ops_in_any_order(ops: list[dict[str, Any]], binary: bool) -> None:
    client = Client()
    client.graph.add_topic("/t", "std_msgs/String")
    client.graph.add_service("/s", "std_srvs/SetBool")
    for op in ops:
        try:
            frame = cbor2.dumps(op) if binary else msgspec.json.encode(op).decode()
        except (TypeError, OverflowError):
            continue
        for asked in client.send_raw(frame):
            answer(asked, b"\1\0\0\0x")
        client.advance(0.001)
    client.advance(1000)
    assert all("op" in each for each in client.received())
    assert client.session.next_timer() is None
