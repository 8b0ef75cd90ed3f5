"""The control socket's words."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.observe import limits
from rmpa.observe.control import ControlReply, ControlRequest


def test_golden_request() -> None:
    request = ControlRequest("ping", {"peer": "base", "count": 1})
    assert request.serialize() == b'{"op":"ping","args":{"peer":"base","count":1}}\n'
    assert ControlRequest.parse(request.serialize()) == request
    assert str(request) == "ping(peer, count)"


def test_golden_replies() -> None:
    good = ControlReply(ok=True, value={"times": [0.5]})
    assert good.serialize() == b'{"ok":true,"value":{"times":[0.5]}}\n'
    bad = ControlReply(ok=False, error="no", remedy="do")
    assert bad.serialize() == b'{"ok":false,"error":"no","remedy":"do"}\n'
    assert [ControlReply.parse(r.serialize()) for r in (good, bad)] == [good, bad]


def test_a_request_without_arguments() -> None:
    assert ControlRequest.parse(b'{"op": "snapshot"}') == ControlRequest("snapshot")


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"\n",
        b"snapshot",
        b"[]",
        b"{}",
        b'{"op": 1}',
        b'{"op": "x", "args": []}',
        b'{"op": "\xff"}',
        b"[" * 100_000,
    ],
)
def test_malformed_requests(line: bytes) -> None:
    with pytest.raises(RemoteProtocolError, match="not a control request"):
        ControlRequest.parse(line)


@pytest.mark.parametrize("line", [b"", b"{}", b'{"ok": 1}', b'{"ok": true, "error": null}'])
def test_malformed_replies(line: bytes) -> None:
    with pytest.raises(RemoteProtocolError, match="not a control reply"):
        ControlReply.parse(line)


def test_every_prefix_of_a_request_is_refused() -> None:
    line = ControlRequest("ping", {"peer": "base"}).serialize().rstrip()
    for length in range(len(line)):
        with pytest.raises(RemoteProtocolError):
            ControlRequest.parse(line[:length])


def test_limits() -> None:
    with pytest.raises(LimitExceeded):
        ControlRequest.parse(b" " * (limits.CONTROL_REQUEST_MAX + 1))
    with pytest.raises(LocalProtocolError, match="not JSON"):
        ControlReply(ok=True, value=object()).serialize()


def test_a_value_that_is_not_a_number_is_none() -> None:
    assert ControlReply(ok=True, value=math.nan).serialize() == b'{"ok":true,"value":null}\n'


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


@given(st.text(), st.dictionaries(st.text(), JSON))
def test_requests_survive_their_round_trip(op: str, args: dict[str, object]) -> None:
    line = ControlRequest(op, args).serialize()
    assert line.count(b"\n") == 1
    assert ControlRequest.parse(line) == ControlRequest(op, args)
    assert str(ControlRequest(op, args)).isprintable()


def test_a_struct_as_value() -> None:
    class Point(msgspec.Struct):
        x: int

    assert ControlReply(ok=True, value=Point(1)).serialize() == b'{"ok":true,"value":{"x":1}}\n'
