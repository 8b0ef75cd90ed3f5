from __future__ import annotations

import contextlib
import datetime as dt
import gc
import xmlrpc.client

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.ros import limits
from rmpa.ros.wire.xmlrpc import (
    DocumentReader,
    RosFault,
    XmlRpcValue,
    parse_response,
    serialize_fault,
    serialize_response,
)
from tests.ros.documents import parse_call, serialize_call

GOLDEN_CALL = b"""<?xml version='1.0'?>
<methodCall>
<methodName>setParam</methodName>
<params>
<param>
<value><string>/n</string></value>
</param>
<param>
<value><struct>
<member>
<name>a</name>
<value><array><data>
<value><int>-1</int></value>
<value><double>2.5</double></value>
<value><boolean>1</boolean></value>
<value><string></string></value>
<value><base64>
eHk=
</base64></value>
<value><dateTime.iso8601>20200102T03:04:05</dateTime.iso8601></value>
</data></array></value>
</member>
<member>
<name>e</name>
<value><struct>
</struct></value>
</member>
</struct></value>
</param>
</params>
</methodCall>
"""
GOLDEN_PARAMS: tuple[XmlRpcValue, ...] = (
    "/n",
    {"a": [-1, 2.5, True, "", b"xy", dt.datetime(2020, 1, 2, 3, 4, 5)], "e": {}},  # noqa: DTZ001 - XML-RPC has none
)


def call_with(value: str) -> bytes:
    return f"<methodCall><methodName>m</methodName><params><param>{value}</param></params></methodCall>".encode()


def test_golden_call() -> None:
    assert serialize_call("setParam", GOLDEN_PARAMS) == GOLDEN_CALL
    assert parse_call(GOLDEN_CALL) == ("setParam", GOLDEN_PARAMS)


def test_every_prefix_of_a_call_is_refused_or_equal() -> None:
    for end in range(len(GOLDEN_CALL.rstrip())):
        with pytest.raises(RemoteProtocolError):
            parse_call(GOLDEN_CALL[:end])


@pytest.mark.parametrize("size", [1, 2, 7, 100])
def test_a_call_is_read_piece_by_piece(size: int) -> None:
    reader = DocumentReader()
    for begin in range(0, len(GOLDEN_CALL), size):
        reader.feed(GOLDEN_CALL[begin : begin + size])
    assert reader.call() == ("setParam", GOLDEN_PARAMS)


def test_an_endless_comment_in_pieces_is_looked_at_a_few_times_only() -> None:
    """expat begins again at the start of an unfinished token whenever it is fed: 8 MiB would take seconds."""
    reader = DocumentReader()
    given: list[bytes] = []
    reader._parser.feed = given.append  # type: ignore[method-assign, assignment]
    reader._expat = type("Stuck", (), {"CurrentByteIndex": 0})()
    for _ in range(4096):
        reader.feed(b"x" * 2048)
    assert len(given) < 16


def test_reading_leaves_no_garbage_for_a_collector_that_is_off() -> None:
    bodies = [GOLDEN_CALL, *MALFORMED]
    gc.collect()
    gc.disable()
    try:
        for body in bodies:
            with contextlib.suppress(RemoteProtocolError):
                parse_call(body)
        assert gc.collect() == 0
    finally:
        gc.enable()


def test_golden_response_and_fault() -> None:
    response = serialize_response([1, "ok", []])
    assert response == (
        b"<?xml version='1.0'?>\n<methodResponse>\n<params>\n<param>\n<value><array><data>\n"
        b"<value><int>1</int></value>\n"
        b"<value><string>ok</string></value>\n<value><array><data>\n</data></array></value>\n</data></array></value>\n"
        b"</param>\n</params>\n</methodResponse>\n"
    )
    assert parse_response(response) == [1, "ok", []]
    with pytest.raises(RosFault) as caught:
        parse_response(serialize_fault(4, "no <such> \x01 method"))
    assert (caught.value.number, caught.value.text) == (4, "no <such> ? method")


@pytest.mark.trap(27)
@pytest.mark.parametrize(
    "trap", ["<string/>", "<value/>", "<array/>", "<data/>", "<struct/>", "<nil", "<i8>", "CDATA", "<!--"]
)
def test_nothing_is_written_that_xmlrpcpp_stops_at(trap: str) -> None:
    """XmlRpc++ matches strings, and what it does not know ends its parsing without an error."""
    written = serialize_response(
        ["", [], {}, {"": ""}, [[]], "<string/>", "]]>", "&#10;", True, dt.datetime(1, 1, 1)]  # noqa: DTZ001
    )
    assert trap.encode() not in written
    assert b"<boolean>1</boolean>" in written
    assert b"<boolean>true" not in written


@pytest.mark.trap(27)
def test_untyped_strings_as_roscpp_sends_them() -> None:
    body = call_with("<value>/talker</value>").replace(b"</params>", b"<param><value></value></param></params>")
    assert parse_call(body) == ("m", ("/talker", ""))


def test_empty_tags_are_read() -> None:
    assert parse_call(call_with("<value/>"))[1] == ("",)
    assert parse_call(call_with("<value><string/></value>"))[1] == ("",)
    assert parse_call(call_with("<value><array><data/></array></value>"))[1] == ([],)
    assert parse_call(call_with("<value><nil/></value>"))[1] == (None,)


@pytest.mark.trap(27)
@pytest.mark.parametrize("number", [2**31, -(2**31) - 1, 10**30])
@pytest.mark.parametrize("tag", ["int", "i4", "i8"])
def test_integers_beyond_32_bits_are_refused_with_a_remedy(number: int, tag: str) -> None:
    with pytest.raises(RemoteProtocolError, match="32 bits; send it as a double"):
        parse_call(call_with(f"<value><{tag}>{number}</{tag}></value>"))
    with pytest.raises(LocalProtocolError):
        serialize_call("m", [number])


MALFORMED: list[bytes] = [
    b"", b"\x00", b"GET / HTTP/1.1\r\n\r\n", b"<methodCall></methodCall>",
    b"<methodCall><params></params></methodCall>", b"<methodCall><methodName></methodName></methodCall>",
    b"<html><body>hello</body></html>", b"<methodCall><methodName>m</methodName></array></methodCall>", b"</value>",
    call_with("<value><int>x</int></value>"), call_with("<value><int></int></value>"),
    call_with("<value><boolean>yes</boolean></value>"),
    call_with("<value><struct><member><name>a</name></member></struct></value>"),
    call_with("<value><struct><member><name>a</name><value>b</value></member>"),
    call_with("<value><struct><member><name>a</name><value>b</value></member></value>"),
    call_with("<value><struct><member><value><int>1</int></value><value>x</value></member></struct></value>"),
    call_with("<value><struct><member><value><array></array></value><value>x</value></member></struct></value>"),
    call_with("<value><bigdecimal>1e9999</bigdecimal></value>"),
    call_with("<value><dateTime.iso8601>2020-01-02</dateTime.iso8601></value>"),
    serialize_fault(1, "a fault is no call"), GOLDEN_CALL + b"<more/>",
]  # fmt: skip


@pytest.mark.parametrize("body", MALFORMED)
def test_malformed_calls_are_refused(body: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        parse_call(body)


@pytest.mark.parametrize(
    "body",
    [
        b"", b"<methodResponse></methodResponse>", b"<methodResponse><params></params></methodResponse>",
        b"<methodResponse><fault><value><string>oops</string></value></fault></methodResponse>",
        b"<methodResponse><fault><value><struct></struct></value></fault></methodResponse>", GOLDEN_CALL,
    ],
)  # fmt: skip
def test_malformed_responses_are_refused(body: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        parse_response(body)


def test_entity_bombs_are_refused() -> None:
    bomb = b'<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>' + call_with("<value>&b;</value>")
    with pytest.raises(RemoteProtocolError, match="entities"):
        parse_call(bomb)


def test_depth_and_size_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    deep = "<value><array><data>" * 100 + "</data></array></value>" * 100
    with pytest.raises(RemoteProtocolError, match="nested deeper"):
        parse_call(call_with(deep))
    with pytest.raises(LimitExceeded):
        parse_call(b" " * (limits.HTTP_BODY_MAX + 1))
    monkeypatch.setattr(limits, "XMLRPC_ELEMENTS_MAX", 100)
    with pytest.raises(RemoteProtocolError, match="more than 100 elements"):
        parse_call(call_with("<value><array><data>" + "<value/>" * 100 + "</data></array></value>"))


def test_a_deep_value_is_our_error_and_not_a_recursion() -> None:
    value: list[XmlRpcValue] = []
    for _ in range(5000):
        value = [value]
    with pytest.raises(LocalProtocolError):
        serialize_response(value)


texts = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"], exclude_characters="\ufffe\uffff"))
values: st.SearchStrategy[XmlRpcValue] = st.recursive(
    st.one_of(
        st.booleans(),
        st.integers(-(2**31), 2**31 - 1),
        st.floats(allow_nan=False),
        texts,
        st.binary(),
        st.datetimes(min_value=dt.datetime(1000, 1, 1)).map(lambda d: d.replace(microsecond=0)),  # noqa: DTZ001
    ),
    lambda below: st.one_of(st.lists(below), st.dictionaries(texts, below)),
    max_leaves=20,
)


@given(st.lists(values, max_size=4))
def test_calls_come_back_as_they_were(params: list[XmlRpcValue]) -> None:
    assert parse_call(serialize_call("m", params)) == ("m", tuple(params))


@given(values)
def test_we_write_what_the_standard_library_writes(value: XmlRpcValue) -> None:
    written = serialize_response(value).decode()
    assert written == xmlrpc.client.dumps((value,), methodresponse=True)  # type: ignore[arg-type]
    (read,), _ = xmlrpc.client.loads(written, use_builtin_types=True)
    assert read == value
