from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.limits import KIB
from rmpa.ros import limits
from rmpa.ros.wire.http import HTTP_HEADERS_MAX, HttpRequest, RequestParser, ResponseParser

ROSCPP = b"POST / HTTP/1.1\r\nUser-Agent: XMLRPC++ 0.7\r\nHost: 10.0.0.1:11311\r\nContent-Type: text/xml\r\n"
ROSPY = (
    b"POST /RPC2 HTTP/1.1\r\nHost: x:11311\r\nAccept-Encoding: gzip\r\nContent-Type: text/xml\r\n"
    b"User-Agent: Python-xmlrpc/3.8\r\n"
)


def parser(*, room: bool = True) -> RequestParser:
    return RequestParser(lambda _: room, lambda: None)


def parse(*parts: bytes) -> Sequence[HttpRequest]:
    made = parser()
    return [found for part in parts for found in made.feed(part)]


@pytest.mark.parametrize("start", [ROSCPP, ROSPY])
@pytest.mark.parametrize("name", [b"Content-length", b"Content-Length"])
@pytest.mark.parametrize(("further", "close"), [(b"", False), (b"Connection: close\r\n", True)])
def test_requests_as_clients_send_them(start: bytes, name: bytes, further: bytes, close: bool) -> None:
    data = start + further + name + b": 5\r\n\r\n<xml>"
    wanted = [HttpRequest(memoryview(b"<xml>"), "", close)]
    assert parse(data) == wanted
    assert parse(*(bytes([byte]) for byte in data)) == wanted


def test_http_1_0_closes_whatever_it_asks_for() -> None:
    data = b"POST / HTTP/1.0\r\nConnection: keep-alive\r\nContent-length: 1\r\n\r\nx"
    assert parse(data) == [HttpRequest(memoryview(b"x"), "", True)]


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", 405), (b"POST / HTTP/1.1\r\nContent-length: 1\r\n\r\nx", 400),
        (b"POST / HTTP/1.1\r\nHost: x\r\nHost: y\r\nContent-length: 1\r\n\r\nx", 400),
        (b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\nContent-length: 1\r\n\r\nx", 400),
        (b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: -1\r\n\r\n", 400),
        (b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 0x1\r\n\r\n", 400),
        (b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\nTransfer-Encoding: chunked\r\n\r\n", 400),
        (b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\nContent-Encoding: gzip\r\n\r\nx", 415),
        (b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: %d\r\n\r\n" % (limits.HTTP_DISCARDED_MAX + 1), 413),
        (b"POST / HTTP/1.1\r\nHost: x\r\nConnection: upgrade\r\nUpgrade: h2c\r\n\r\n", 400),
        (b"POST / HTTP/1.1\r\nHost : x\r\nContent-length: 1\r\n\r\nx", 400),
        (b"CONNECT x:80 HTTP/1.1\r\nHost: x\r\n\r\n", 405), (b"\x16\x03\x01\x02\x00\x01\x00", 400),
    ],
)  # fmt: skip
def test_what_cannot_be_answered_is_refused(data: bytes, status: int) -> None:
    made = parser()
    *_, refusal = made.feed(data)
    assert refusal.status == status
    assert made.feed(ROSPY + b"Content-length: 1\r\n\r\nx") == [], "nothing behind it is read"


@given(st.lists(st.binary(min_size=1, max_size=300), max_size=20), st.integers(100, 2000), st.booleans())
def test_any_chunks_within_the_bound_come_out_whole(parts: list[bytes], limit: int, room: bool) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(limits, "HTTP_BODY_MAX", limit)
        patch.setattr(limits, "HTTP_BODY_INLINE", 100)
        made, whole = parser(room=room), b"".join(parts)
        assert made.feed(ROSPY + b"Transfer-Encoding: chunked\r\n\r\n") == []
        for part in parts:
            assert made.feed(b"%x\r\n%s\r\n" % (len(part), part)) == []
            assert len(made._body) <= max(limit, 4 * KIB)
        assert made.size == len(whole)
        (found,) = made.feed(b"0\r\n\r\n")
        if len(whole) <= 100 or (len(whole) <= limit and room):
            assert (bytes(found.body), found.refusal) == (whole, "")
        else:
            assert whole.startswith(bytes(found.body))
            assert str(len(whole)) in found.refusal
        assert made.size == 0, "the next one begins anew"


@pytest.mark.parametrize(
    ("start", "statuses"),
    [
        (b"X: ", [431]),
        (b"Transfer-Encoding: chunked\r\n\r\n1;", [431]),
        (b"Transfer-Encoding: chunked\r\n\r\n1\r\nx\r\n0\r\nX: ", [431]),
    ],
)
def test_headers_trailers_and_chunk_lines_are_bounded(start: bytes, statuses: list[int]) -> None:
    parts = [ROSPY + start, *[b"x" * 1000] * (HTTP_HEADERS_MAX // 1000 + 1)]
    assert [found.status for found in parse(*parts)] == statuses


def test_a_client_that_expects_100_continue() -> None:
    made = parser()
    assert made.feed(ROSPY + b"Expect: 100-continue\r\nContent-length: 1\r\n\r\n") == []
    assert made.expects_continue
    assert made.feed(b"x") == [HttpRequest(memoryview(b"x"), "", False)]
    large = ROSPY + b"Expect: 100-continue\r\nContent-length: %d\r\n\r\n" % (limits.HTTP_BODY_MAX + 1)
    assert [found.status for found in parse(large)] == [413]


def test_the_end_within_a_request_is_refused() -> None:
    made = parser()
    assert made.feed_eof() == []
    made.feed(ROSPY)
    assert [found.status for found in made.feed_eof()] == [400]


def response(*parts: bytes) -> bytes | None:
    made = ResponseParser("http://x:1/")
    for part in parts:
        if (body := made.feed(part)) is not None:
            return body
    return None


def test_a_status_of_1xx_comes_before_the_response() -> None:
    head = b"HTTP/1.1 100 Continue\r\n\r\n"
    whole = head + b"HTTP/1.1 200 OK\r\nContent-length: 2\r\n\r\nok"
    assert response(whole) == b"ok"
    assert response(head, whole[len(head) :]) == b"ok"
    assert response(*(bytes([byte]) for byte in whole)) == b"ok"


def test_a_response_without_a_length_ends_with_the_connection() -> None:
    head = b"HTTP/1.1 200 OK\r\n\r\n"
    assert response(head + b"ab", b"c") is None
    assert response(head + b"ab", b"c", b"") == b"abc"
    with pytest.raises(RemoteProtocolError, match="closed before the response"):
        response(b"HTTP/1.1 200 OK\r\nContent-length: 5\r\n\r\nab", b"")
    with pytest.raises(RemoteProtocolError, match="http://x:1/ does not speak HTTP"):
        response(b"SSH-2.0-OpenSSH\r\n")
