"""Bodies of calls as they come, and what is said of those that are too large."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.limits import KIB
from rmpa.ros import limits
from rmpa.ros.wire.http import CallBody, call_name, too_large, too_many
from rmpa.ros.wire.xmlrpc import serialize_call


@pytest.mark.parametrize(
    ("method", "params", "name"),
    [
        ("setParam", ["/loader", "/robot_description", "x"], "setParam /robot_description"),
        ("setParam", ["/loader", "/ns", {"a": 1}], "setParam /ns"),
        ("system.multicall", [[{"methodName": "setParam", "params": ["/r", "/a", "x"]}]], "system.multicall"),
        ("registerPublisher", ["/n", "/t", "std_msgs/String", "http://x:1/"], "registerPublisher"),
    ],
)
def test_call_is_named_by_its_beginning(method: str, params: list[object], name: str) -> None:
    assert call_name(serialize_call(method, params)[: 4 * KIB]) == name  # type: ignore[arg-type]


def test_roscpps_untyped_strings_are_read_too() -> None:
    body = b"<methodCall><methodName>setParam</methodName><params><param><value>/n</value></param>"
    body += b"<param><value>/k</value></param><param>"
    assert call_name(body) == "setParam /k"


@pytest.mark.parametrize("begin", [b"", b"<methodName>", b"\xff" * 100, b"<methodName>a b</methodName>"])
def test_unclear_beginning_is_a_call(begin: bytes) -> None:
    assert call_name(begin) == "a call"


def test_the_texts_name_the_call_the_sizes_and_the_remedy() -> None:
    begin = serialize_call("setParam", ["/loader", "/map", "x"])
    assert all(part in too_large(begin, 70_000_000) for part in ("/map", "70000000", "64 MiB", "one by one"))
    assert all(part in too_many(begin, 70_000_000) for part in ("/map", "70000000", "256 MiB", "again"))


@given(st.lists(st.binary(max_size=300), max_size=20), st.integers(100, 2000), st.booleans())
def test_any_parts_within_the_bound_come_out_whole(parts: list[bytes], limit: int, room: bool) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "HTTP_BODY_MAX", limit)
        patch.setattr(limits, "HTTP_BODY_INLINE", 100)
        body = CallBody(lambda _: room)
        for part in parts:
            body.add(part)
            assert len(body._data) <= max(limit, 4 * KIB)
        whole = b"".join(parts)
        assert body.size == len(whole)
        data, refusal = body.end()
        if len(whole) <= 100 or (len(whole) <= limit and room):
            assert (bytes(data), refusal) == (whole, "")
        else:
            assert whole.startswith(bytes(data))
            assert str(len(whole)) in refusal
        assert (body.size, body.why) == (0, None), "the next one begins anew"
