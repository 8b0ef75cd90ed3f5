"""XML-RPC calls and responses as bytes (xmlrpc.com/spec, and ROS's use of it).

The standard library parses; ``defusedxml`` refuses entity declarations; this module bounds depth and size and allows
only the types that ROS has. Long documents are read and written piece by piece.
"""

from __future__ import annotations

import base64
import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import datetime
from itertools import chain
from typing import Final, NamedTuple, TypeAlias, Union, cast
from xml.parsers.expat import ExpatError
from xmlrpc.client import Fault, ResponseError, Unmarshaller

from defusedxml.common import DefusedXmlException
from defusedxml.xmlrpc import DefusedExpatParser

from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError, RmpaError
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.ros import limits

# Writes values as XML-RPC, piece by piece, so that other work can be done between two pieces. The text is exactly
# that of Python's ``xmlrpc.client``, because XmlRpc++ (roscpp) is known to read it: that parser compares strings, and
# stops without an error at ``<string/>`` or ``<i8>``.


# XML 1.0, section 2.2: characters that a document cannot hold, not even escaped.
_ILLEGAL: Final = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
# Parts of text in one piece: some 50 microseconds.
_PIECE: Final = 128
# Characters of a long string, or bytes of binary data, in one piece; base64 has 57 bytes in a line.
_SLICE: Final = 57 * 128


def pieces(what: str, value: object) -> Iterator[bytes]:
    """Yield ``<value>…</value>`` in pieces of some KiB; the value must not change meanwhile.

    Args:
        what: The document, for the text of errors, such as ``the response``.
        value: Of the types that ROS has; lists and tuples alike, dicts with strings as keys.

    Raises:
        LocalProtocolError: A value cannot be written: ``None``, an integer beyond 32 bits, a control character.
    """
    out: list[str] = []
    try:
        for text in _texts(value, 0):
            out.append(text)
            if len(out) >= _PIECE or len(text) >= _SLICE:
                yield "".join(out).encode()
                out.clear()
    except LocalProtocolError as error:
        raise LocalProtocolError(f"{what} {error}") from None
    yield "".join(out).encode()


def _texts(item: object, depth: int) -> Iterable[str]:
    """The text of a value, in parts."""
    write = _SCALARS.get(type(item))
    if write is not None:
        return write(item)
    if depth > limits.XMLRPC_DEPTH_MAX:
        raise LocalProtocolError(f"is nested deeper than {limits.XMLRPC_DEPTH_MAX} levels")
    if isinstance(item, dict):
        return _struct(item, depth + 1)
    if isinstance(item, list | tuple):
        return _array(item, depth + 1)
    raise LocalProtocolError(f"cannot be said in XML-RPC: it holds a {type(item).__name__}")


def _struct(members: Mapping[object, object], depth: int) -> Iterator[str]:
    yield "<value><struct>\n"
    for key, item in members.items():
        if not isinstance(key, str):
            raise LocalProtocolError("cannot be said in XML-RPC: it has a dictionary key that is not a string")
        yield f"<member>\n<name>{_escaped(key)}</name>\n"
        yield from _texts(item, depth)
        yield "</member>\n"
    yield "</struct></value>\n"


def _array(items: Iterable[object], depth: int) -> Iterator[str]:
    yield "<value><array><data>\n"
    for item in items:
        write = _SCALARS.get(type(item))  # here too: arrays are long
        yield from _texts(item, depth) if write is None else write(item)
    yield "</data></array></value>\n"


def _escaped(text: str) -> str:
    if not text.isprintable() and (illegal := _ILLEGAL.search(text)) is not None:
        raise LocalProtocolError(f"holds the character {illegal[0]!a}, which XML cannot hold; remove it")
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _string(value: str) -> Iterable[str]:
    if len(value) <= _SLICE:
        return (f"<value><string>{_escaped(value)}</string></value>\n",)
    slices = (_escaped(value[begin : begin + _SLICE]) for begin in range(0, len(value), _SLICE))
    return chain(("<value><string>",), slices, ("</string></value>\n",))


def _base64(value: bytes) -> Iterable[str]:
    slices = (base64.encodebytes(value[at : at + _SLICE]).decode("ascii") for at in range(0, len(value), _SLICE))
    return chain(("<value><base64>\n",), slices, ("</base64></value>\n",))


def _int(value: int) -> Iterable[str]:
    if not INT32_MIN <= value <= INT32_MAX:
        raise LocalProtocolError(f"cannot be said in XML-RPC: {str(value)[:40]} does not fit 32 bits")
    return (f"<value><int>{value}</int></value>\n",)


def _datetime(value: datetime) -> Iterable[str]:
    return (f"<value><dateTime.iso8601>{value.year:04d}{value:%m%dT%H:%M:%S}</dateTime.iso8601></value>\n",)


# Writers of the types other than list and dict.
_SCALARS: Final[dict[type, Callable[..., Iterable[str]]]] = {
    bool: lambda value: (f"<value><boolean>{value:d}</boolean></value>\n",),
    int: _int,
    float: lambda value: (f"<value><double>{value!r}</double></value>\n",),
    str: _string,
    bytes: _base64,
    bytearray: _base64,
    datetime: _datetime,
}


# A value of XML-RPC. Parsed containers are lists and dicts; ``None`` is read, never written.
XmlRpcValue: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, bytes, datetime, Sequence["XmlRpcValue"], Mapping[str, "XmlRpcValue"], None
]

_DECLARATION: Final = "<?xml version='1.0'?>\n"


class RosFault(RmpaError):  # noqa: N818 - XML-RPC calls it a fault
    """The other side answered a call with an XML-RPC fault.

    Args:
        number: The fault code; Python's servers, rosmaster among them, always have 1.
        text: The fault string.
    """

    code = "refused"

    def __init__(self, number: int, text: str) -> None:
        super().__init__(number, text)
        self.number = number
        self.text = text

    def __str__(self) -> str:
        return f"XML-RPC fault {self.number}: {self.text}"


class RosReply(NamedTuple):
    """The result of every method of the Master, Parameter Server and Slave APIs.

    ``code`` is 1 for success, 0 for a failure, -1 for an error of the caller; ``status`` is text for people.
    """

    code: int
    status: str
    value: XmlRpcValue

    @classmethod
    def of(cls, value: XmlRpcValue) -> RosReply:
        """Convert the value of a parsed response.

        Raises:
            RemoteProtocolError: The value is not such a triple.
        """
        match value:
            case [int(code), str(status), result]:
                return cls(code, status, result)
        raise RemoteProtocolError(f"the response is not [code, status, value]: {brief(value)}")


def brief(value: object, limit: int = 120) -> str:
    """``repr`` of a value, cut to ``limit`` characters: fit for a log."""
    text = repr(value)
    return text if len(text) <= limit else f"{text[: limit - 1]}…"


def _end_int(unmarshaller: Unmarshaller, data: str) -> None:
    number = int(data)
    if not INT32_MIN <= number <= INT32_MAX:
        raise RemoteProtocolError(
            f"integer {data.strip()[:40]} does not fit XML-RPC's 32 bits; send it as a double or a string"
        )
    unmarshaller.append(number)


def _end_struct(unmarshaller: Unmarshaller, data: str) -> None:
    unmarshaller.end_struct(data)
    struct = unmarshaller._stack[-1]  # noqa: SLF001 - the standard library documents this class by its source
    if not (isinstance(struct, dict) and set(map(type, struct)) <= {str}):
        raise RemoteProtocolError("XML-RPC struct with a member name that is not a string")


_INTS: Final = ("i1", "i2", "i4", "i8", "int", "biginteger")
_DISPATCH: Final[dict[str, Callable[[Unmarshaller, str], None]]] = {
    **{tag: handler for tag, handler in Unmarshaller.dispatch.items() if tag != "bigdecimal"},
    **dict.fromkeys(_INTS, _end_int),
    "struct": _end_struct,
}


class _BoundedUnmarshaller(Unmarshaller):
    """The standard unmarshaller, with limits and only the types that ROS has."""

    def __init__(self) -> None:
        super().__init__(use_builtin_types=True)
        self.dispatch = _DISPATCH
        self._depth = 0
        self._elements = 0

    def start(self, tag: str, attrs: dict[str, str]) -> None:
        self._depth += 1
        self._elements += 1
        if self._depth > limits.XMLRPC_DEPTH_MAX:
            raise RemoteProtocolError(f"XML-RPC values are nested deeper than {limits.XMLRPC_DEPTH_MAX} elements")
        if self._elements > limits.XMLRPC_ELEMENTS_MAX:
            raise RemoteProtocolError(f"XML-RPC body has more than {limits.XMLRPC_ELEMENTS_MAX} elements")
        super().start(tag, attrs)

    def end(self, tag: str) -> None:
        self._depth -= 1
        super().end(tag)


class DocumentReader:
    """Reads one document piece by piece, so that other work can be done between two pieces."""

    def __init__(self) -> None:
        self._unmarshaller = _BoundedUnmarshaller()
        self._parser = DefusedExpatParser(self._unmarshaller)
        self._expat = self._parser._parser  # type: ignore[attr-defined] # noqa: SLF001 - the standard library's
        self._expat.buffer_text = True
        self._size = 0
        self._waiting = bytearray()
        self._token = 0

    def feed(self, data: bytes | bytearray | memoryview) -> None:
        """Parse the next piece.

        Raises:
            RemoteProtocolError: The document is malformed, too deep or too large, declares entities, or holds an
                integer beyond 32 bits.
        """
        self._size += len(data)
        if self._size > limits.HTTP_BODY_MAX:
            raise LimitExceeded("XML-RPC body", self._size, limits.HTTP_BODY_MAX)
        self._waiting += data
        # expat scans an unfinished token (such as a comment of megabytes) from its start each time that it is fed:
        # bytes are fed again when there are as many as the unfinished token had.
        if len(self._waiting) < self._token:
            return
        try:
            self._give()
        except BaseException as error:
            self._malformed(error)
            raise
        self._token = self._size - self._expat.CurrentByteIndex

    def abandon(self) -> None:
        """Stop reading; this breaks a reference cycle, which would wait for the garbage collector."""
        with contextlib.suppress(Exception):
            self._parser.close()

    def call(self) -> tuple[str, tuple[XmlRpcValue, ...]]:
        """The name and the parameters of a ``methodCall``, once all pieces were fed.

        Raises:
            RemoteProtocolError: As for ``feed``, or the document is incomplete or not a call.
        """
        try:
            method, params = self._end()
        except Fault as fault:
            raise RemoteProtocolError("an XML-RPC fault came where a call was expected") from fault
        if not method:
            raise RemoteProtocolError("XML-RPC call without a methodName")
        return method, params

    def response(self) -> XmlRpcValue:
        """The value of a ``methodResponse``, once all pieces were fed.

        Raises:
            RosFault: The response is a fault.
            RemoteProtocolError: As for ``feed``, or the document is incomplete or has not exactly one value.
        """
        try:
            method, params = self._end()
        except Fault as fault:
            if not isinstance(fault.faultCode, int):
                raise RemoteProtocolError(f"XML-RPC fault with code {brief(fault.faultCode)}") from fault
            raise RosFault(fault.faultCode, str(fault.faultString)) from fault
        if method is not None or len(params) != 1:
            raise RemoteProtocolError(f"XML-RPC response with {len(params)} values; there must be one")
        return params[0]

    def _end(self) -> tuple[str | None, tuple[XmlRpcValue, ...]]:
        try:
            self._give()
            self._parser.close()
            params = cast("tuple[XmlRpcValue, ...]", self._unmarshaller.close())
        except BaseException as error:
            self._malformed(error)
            raise
        return self._unmarshaller.getmethodname(), params

    def _give(self) -> None:
        waiting = bytes(self._waiting)
        self._waiting.clear()
        self._parser.feed(waiting)

    def _malformed(self, error: BaseException) -> None:
        # A function, and no context manager: from Python 3.13 on its frame would hold the error in a reference cycle.
        self.abandon()
        for kinds, text in _MALFORMED:
            if isinstance(error, kinds):
                raise RemoteProtocolError(text.format(error).rstrip()) from error


# What the parsers raise for malformed documents, with the text of our error.
_MALFORMED: Final[Sequence[tuple[type[Exception] | tuple[type[Exception], ...], str]]] = (
    (DefusedXmlException, "XML declares entities, which XML-RPC has no use for: {}"),
    (ExpatError, "malformed XML: {}"),
    (ResponseError, "this XML is not XML-RPC {}"),
    # The standard unmarshaller has no error of its own for elements in the wrong order or bad content.
    ((ArithmeticError, AttributeError, LookupError, TypeError, ValueError), "malformed XML-RPC value: {}"),
)


def parse_response(data: bytes) -> XmlRpcValue:
    """Read a whole ``methodResponse`` document; returns and raises as ``DocumentReader.response``."""
    reader = DocumentReader()
    reader.feed(data)
    return reader.response()


def call_pieces(method: str, params: Sequence[XmlRpcValue]) -> Iterator[bytes]:
    """Write a ``methodCall`` document in pieces of some KiB, so that other work can be done in between.

    Raises:
        LocalProtocolError: A value cannot be written: ``None``, an integer beyond 32 bits, a control character.
    """
    yield f"{_DECLARATION}<methodCall>\n<methodName>{method}</methodName>\n<params>\n".encode()
    for param in params:
        yield b"<param>\n"
        yield from pieces(f"the call of {method}", param)
        yield b"</param>\n"
    yield b"</params>\n</methodCall>\n"


def response_pieces(value: XmlRpcValue) -> Iterator[bytes]:
    """Write a ``methodResponse`` document in pieces; the errors are those of ``call_pieces``."""
    yield f"{_DECLARATION}<methodResponse>\n<params>\n<param>\n".encode()
    yield from pieces("the response", value)
    yield b"</param>\n</params>\n</methodResponse>\n"


def serialize_response(value: XmlRpcValue) -> bytes:
    """Write a ``methodResponse`` document; the errors are those of ``call_pieces``."""
    return b"".join(response_pieces(value))


def serialize_fault(code: int, text: str) -> bytes:
    """Write a fault as a ``methodResponse``; characters that XML cannot hold become ``?``."""
    body = b"".join(pieces("the fault", {"faultCode": code, "faultString": _ILLEGAL.sub("?", text)}))
    return b"%s<methodResponse>\n<fault>\n%s</fault>\n</methodResponse>\n" % (_DECLARATION.encode(), body)
