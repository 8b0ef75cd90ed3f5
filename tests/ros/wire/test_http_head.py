from __future__ import annotations

import h11
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.ros import limits
from rmpa.ros.wire.http_head import Head, plain_head

ROSCPP = b"POST / HTTP/1.1\r\nUser-Agent: XMLRPC++ 0.7\r\nHost: 10.0.0.1:11311\r\nContent-Type: text/xml\r\n"
ROSPY = (
    b"POST /RPC2 HTTP/1.1\r\nHost: x:11311\r\nAccept-Encoding: gzip\r\nContent-Type: text/xml\r\n"
    b"User-Agent: Python-xmlrpc/3.8\r\n"
)


def by_h11(data: bytes) -> tuple[int, bool] | None:
    """The length of the body and whether the connection closes, as h11 reads a request; ``None`` if it is refused."""
    http = h11.Connection(h11.SERVER)
    http.receive_data(data)
    try:
        request = http.next_event()
    except h11.RemoteProtocolError:
        return None
    assert isinstance(request, h11.Request)
    assert request.method == b"POST"
    headers = dict(request.headers)
    assert b"transfer-encoding" not in headers
    assert not http.they_are_waiting_for_100_continue
    return int(headers[b"content-length"]), http.our_state is h11.MUST_CLOSE or headers.get(b"connection") == b"close"


@pytest.mark.parametrize("start", [ROSCPP, ROSPY])
@pytest.mark.parametrize("name", [b"Content-length", b"Content-Length"])
@pytest.mark.parametrize(("further", "close"), [(b"", False), (b"Connection: close\r\n", True)])
def test_requests_as_clients_send_them(start: bytes, name: bytes, further: bytes, close: bool) -> None:
    data = start + further + name + b": 42\r\n\r\n"
    assert plain_head(data + b"<xml") == Head(len(data), 42, close)
    assert plain_head(bytearray(data)) == Head(len(data), 42, close)
    assert by_h11(data) == (42, close)
    for end in range(len(data)):
        assert plain_head(data[:end]) is None


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"GET / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\n\r\n",
        b"POST / HTTP/1.0\r\nHost: x\r\nContent-length: 1\r\n\r\n",
        b"POST / HTTP/1.1\r\nContent-length: 1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nHost: y\r\nContent-length: 1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\nContent-length: 1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: -1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 0x1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: %d\r\n\r\n" % (limits.HTTP_BODY_MAX + 1),
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\nTransfer-Encoding: chunked\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\nExpect: 100-continue\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\nContent-Encoding: gzip\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\nConnection: upgrade\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\nUser-Agent: a\r\n b\r\n\r\n",
        b"POST / HTTP/1.1\nHost: x\nContent-length: 1\n\n",
        b"POST  / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\n\r\n",
        b" POST / HTTP/1.1\r\nHost: x\r\nContent-length: 1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost : x\r\nContent-length: 1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: x\r\nX-Other: y\r\nContent-length: 1\r\n\r\n",
    ],
)
def test_what_is_unusual_is_left_to_others(data: bytes) -> None:
    assert plain_head(data) is None


_WORDS = (
    b"POST|GET| |/|/RPC2| HTTP/1.1| HTTP/1.0|\r\n|\n|Host: x|host: y|\t|Content-length: |content-Length: |5|05|+5"
    b"|5, 5|Connection: |close|keep-alive|Transfer-Encoding: chunked|User-Agent: a b|Accept: |\x00|\xff|User-Agent:"
)
_PIECES = st.sampled_from(_WORDS.split(b"|"))


@given(st.lists(_PIECES, max_size=14), st.booleans())
def test_what_it_knows_the_general_parser_reads_in_the_same_way(pieces: list[bytes], begin: bool) -> None:
    start = b"POST / HTTP/1.1\r\nHost: x\r\nContent-length: 5\r\n" if begin else b""
    data = start + b"".join(pieces) + b"\r\n\r\n"
    head = plain_head(data)
    if head is not None:
        assert by_h11(data[: head.end]) == (head.length, head.close)
