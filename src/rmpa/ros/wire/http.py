"""HTTP/1.1 (RFC 9112) as XML-RPC uses it: bytes in, requests or a response out. httptools (llhttp) does the parsing.

A request is a POST to any path; its body has a length or is sent in chunks. Of a response only the body is used.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final, NamedTuple
from urllib.parse import quote

from httptools import HttpParserError, HttpParserUpgrade, HttpRequestParser, HttpResponseParser

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.limits import KIB
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.ros.wire.tcpros import Buffer

# All headers of one request.
HTTP_HEADERS_MAX: Final = 64 * KIB

_REASONS: Final = {
    200: b"OK",
    400: b"Bad Request",
    405: b"Method Not Allowed",
    413: b"Content Too Large",
    415: b"Unsupported Media Type",
    431: b"Request Header Fields Too Large",
}
CONTINUE: Final = b"HTTP/1.1 100 Continue\r\n\r\n"


_METHOD: Final = re.compile(rb"<methodName>\s*([A-Za-z0-9_.]{1,64})\s*</methodName>")
_TEXTS: Final = re.compile(rb"<value>\s*(?:<string>)?([^<]{1,256})(?:</string>)?\s*</value>")
# Bytes of a refused call that are kept, to name the call in the fault.
_BEGIN: Final = 4 * KIB


def call_name(begin: Buffer) -> str:
    """A call's method, with the key if it is about a parameter: ``setParam /map``; ``a call`` if it is unknown.

    Args:
        begin: The first bytes of the call.
    """
    method = _METHOD.search(begin)
    if method is None:
        return "a call"
    name = method[1].decode("ascii")
    texts = _TEXTS.findall(begin, method.end())
    if "Param" in name and len(texts) > 1:
        name += " " + texts[1].decode("utf-8", "replace")
    return name


def too_large(begin: Buffer, size: int) -> str:
    """The text of the fault for a call of ``size`` bytes, with the limit and a remedy."""
    limit = limits.HTTP_BODY_MAX
    return (
        f"{call_name(begin)}: {size} bytes, above the {limit} ({limit >> 20} MiB) of one call; set its parts one by "
        "one, keep large data in a file and its path in the parameter, or publish it on a latched topic"
    )


def too_many(begin: Buffer, size: int) -> str:
    """The text of the fault for a call that does not fit beside those under way."""
    return (
        f"{call_name(begin)}: {size} bytes beside other large calls, above the {limits.HTTP_BODIES_MAX >> 20} MiB of "
        "all that are under way; try again in a moment"
    )


class HttpRequest(NamedTuple):
    """One XML-RPC call, or a request that is refused.

    Args:
        body: The XML; for a call that is too large only its beginning.
        refusal: The text of the fault for a call that is too large, or of the answer with an error of HTTP; empty for
            all others.
        close: Whether the connection ends with the answer.
        status: The status code of the answer. After a request with an error of HTTP nothing is parsed.
        counter: The counter of the refusal, such as ``http.malformed``.
    """

    body: memoryview
    refusal: str
    close: bool
    status: int = 200
    counter: str = "http.too_large"


class RequestParser:
    """Parses the requests of one client.

    A call that is too large is answered with an XML-RPC fault, the only error that ROS's clients show:
    ``rospy.set_param`` ignores a status of -1 and xmlrpc.client hides the text of an HTTP error, while ``rosparam``
    and ``roslaunch`` print a fault's text. A client reads no answer before it has sent its whole call, so a refused
    call is read to its end, but only its beginning is kept.

    Args:
        reserve: ``(bytes) -> whether there is room``: called once for each large call.
        on_begin: Called with the first byte of each request.

    Attributes:
        size: Bytes received of the body of the present request.
        reserved: Bytes reserved for the present call, until the owner sets 0.
        receiving: Whether a request has begun and is not complete.
        expects_continue: Whether the client waits for ``CONTINUE`` before it sends a body; the owner resets it.
    """

    # More than 12 fields: the body, the headers and their bounds.
    def __init__(self, reserve: Callable[[int], bool], on_begin: Callable[[], None]) -> None:
        self.size = self.reserved = 0
        self.receiving = self.expects_continue = False
        self._reserve = reserve
        self._on_begin = on_begin
        self._parser: HttpRequestParser | None = HttpRequestParser(self)
        self._found: list[HttpRequest] = []
        self._refused = False
        self._headers: dict[bytes, bytes] = {}
        self._body = bytearray()
        # Makes the text of the fault from the beginning and size of a call that is too large; it is dropped.
        self._why: Callable[[Buffer, int], str] | None = None
        # Bytes since the last body data or end of a request: of headers, trailers and the lines between chunks.
        self._without_body = 0
        self._progress = False

    def feed(self, data: Buffer) -> list[HttpRequest]:
        """Take the next bytes; return the requests that are complete now, a refusal last.

        The size of headers is bounded with the granularity of ``data``: give no more than some KiB at a time.
        """
        if self._parser is None or self._refused:
            return []
        self._progress = False
        try:
            self._parser.feed_data(data)
        except HttpParserUpgrade:
            self._refuse(400, "this server speaks HTTP/1.1 only", "http.malformed")
        except HttpParserError as error:
            self._refuse(400, str(error), "http.malformed")
        self._without_body = 0 if self._progress else self._without_body + len(data)
        if self._without_body > HTTP_HEADERS_MAX:
            self._refuse(431, f"headers of more than {HTTP_HEADERS_MAX} bytes", "http.malformed")
        found, self._found = self._found, []
        return found

    def feed_eof(self) -> list[HttpRequest]:
        """Note the end of the client's stream; return a refusal if a request is incomplete."""
        if self.receiving:
            self._refuse(400, "the connection ended within a request", "http.malformed")
        found, self._found = self._found, []
        return found

    def close(self) -> None:
        """Parse no more; this breaks a reference cycle, which would wait for the garbage collector."""
        self._parser = None

    def _refuse(self, status: int, text: str, counter: str) -> None:
        if not self._refused:
            self._refused = True
            self._found.append(HttpRequest(memoryview(b""), text, True, status, counter))

    def on_message_begin(self) -> None:
        """Begin a request at its first byte."""
        self.receiving = True
        self._headers = {}
        self._on_begin()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Note one header, or one of the trailers."""
        name = name.lower()
        # Two Host headers count as an empty one, which is refused for HTTP/1.1.
        self._headers[name] = b"" if name == b"host" and name in self._headers else value

    def on_headers_complete(self) -> None:
        """Check the headers of a request: refuse one that cannot be answered before its body arrives."""
        if self._parser is None:
            return
        headers = self._headers
        size = int(headers.get(b"content-length") or 0)
        method, is_1_1 = self._parser.get_method(), self._parser.get_http_version() == "1.1"
        if method != b"POST":
            self._refuse(405, f"{method.decode('ascii')}: XML-RPC is called by POST only", "http.method")
        elif is_1_1 and not headers.get(b"host"):
            self._refuse(400, "there must be one Host header", "http.malformed")
        elif size > limits.HTTP_DISCARDED_MAX:
            self._refuse(413, f"a body of {size} bytes, above {limits.HTTP_BODY_MAX}", "http.too_large")
        elif headers.get(b"content-encoding", b"identity").lower() != b"identity":
            self._refuse(415, "an encoded body; send it as it is", "http.encoding")
        else:
            self._expect(size)
            if is_1_1 and headers.get(b"expect", b"").lower() == b"100-continue":
                if self._why is not None:
                    self._refuse(413, f"a body of more than {limits.HTTP_BODY_MAX} bytes", "http.too_large")
                self.expects_continue = not self._refused

    def _expect(self, size: int) -> None:
        """Judge the size of a body."""
        if size > limits.HTTP_BODY_MAX:
            self._why = too_large
        elif size > limits.HTTP_BODY_INLINE and not self.reserved:
            if self._reserve(size):
                self.reserved = size
            else:
                self._why = too_many

    def on_body(self, data: bytes) -> None:
        """Add a part of the body."""
        self._progress = True
        if self._refused:
            return
        self.size += len(data)
        if self._why is None and self.size > limits.HTTP_BODY_INLINE:
            # A body in chunks has no announced size.
            self._expect(max(self.size, limits.HTTP_BODY_MAX))
        self._body += data
        if self._why is not None:
            del self._body[_BEGIN:]

    def on_message_complete(self) -> None:
        """Complete a request at its last byte."""
        self._progress = True
        self.receiving = self.expects_continue = False
        if not self._refused and self._parser is not None:
            close = self._parser.get_http_version() != "1.1" or not self._parser.should_keep_alive()
            text = self._why(self._body, self.size) if self._why is not None else ""
            self._found.append(HttpRequest(memoryview(self._body), text, close))
            self._body, self.size, self._why = bytearray(), 0, None


class ResponseParser:
    """Parses one response. Its status is ignored, except 1xx: XmlRpc++ and its copies send arbitrary ones.

    Args:
        uri: The server's, for errors.
    """

    def __init__(self, uri: str) -> None:
        self._uri = uri
        self._parser: HttpResponseParser | None = HttpResponseParser(self)
        self._body = bytearray()
        self._complete = self._has_length = False
        # Whether the body ends with the connection: it has neither a length nor chunks.
        self._until_close = False

    def feed(self, data: bytes) -> bytes | None:
        """Take the next bytes, or empty ones at the end of the connection; return the body once it is complete.

        Raises:
            RemoteProtocolError: The bytes are not HTTP, the connection ended too early, or the body is larger than
                ``limits.HTTP_BODY_MAX``.
        """
        if self._parser is None or not (data or self._until_close):
            raise RemoteProtocolError("the connection was closed before the response")
        try:
            self._parser.feed_data(data)
        except HttpParserError as error:
            if not self._complete:  # else the error is in bytes after the response
                raise RemoteProtocolError(f"{self._uri} does not speak HTTP: {error}") from error
        if len(self._body) > limits.HTTP_BODY_MAX:
            raise LimitExceeded("XML-RPC response", len(self._body), limits.HTTP_BODY_MAX)
        # A response with status 1xx precedes the response itself.
        if (data and not self._complete) or self._parser.get_status_code() < 200:
            return None
        return bytes(self._body)

    def close(self) -> None:
        """Parse no more; this breaks a reference cycle, which would wait for the garbage collector."""
        self._parser = None

    def on_message_begin(self) -> None:
        """Begin a response, or the one after a status of 1xx."""
        self._complete = self._has_length = False

    def on_header(self, name: bytes, value: bytes) -> None:  # noqa: ARG002 - httptools' interface
        """Note whether the end of the body is told."""
        self._has_length |= name.lower() in {b"content-length", b"transfer-encoding"}

    def on_headers_complete(self) -> None:
        """Judge where the body ends."""
        self._until_close = not self._has_length

    def on_body(self, data: bytes) -> None:
        """Add a part of the body."""
        self._body += data

    def on_message_complete(self) -> None:
        """Complete the response at its last byte."""
        self._complete = True


def response_head(status: int, size: int, *, close: bool) -> bytes:
    """The head of a response; XmlRpc++ wants ``Content-length`` with one blank, and no chunks."""
    kind = b"text/xml" if status == 200 else b"text/plain; charset=utf-8"
    text = b"HTTP/1.1 %d %s\r\nServer: rmpa\r\nContent-Type: %s\r\nContent-length: %d\r\n%s\r\n"
    return text % (status, _REASONS[status], kind, size, b"Connection: close\r\n" if close else b"")


def post_request(host: str, port: int, path: str, body: bytes) -> bytes:
    """A whole POST request; the connection ends with its response."""
    address = f"{host}:{port}".encode("ascii" if host.isascii() else "idna")
    return (
        b"POST %s HTTP/1.1\r\nHost: %s\r\nUser-Agent: rmpa\r\nContent-Type: text/xml\r\nContent-length: %d\r\n"
        b"Connection: close\r\n\r\n%s" % (quote(path, safe="/%:@!$&'()*+,;=~").encode(), address, len(body), body)
    )
