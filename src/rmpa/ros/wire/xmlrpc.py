"""XML-RPC as bytes: reads and writes calls and responses, within bounds.

Collects the body of an XML-RPC call; a call that is too large is answered with an XML-RPC fault.

A fault is the only error that ROS's clients show: ``rospy.set_param`` ignores a status of -1 and xmlrpc.client hides
the text of an HTTP error, while ``rosparam`` and ``roslaunch`` print a fault's text. A client reads no answer before
it has sent its whole call, so a refused call is read to its end, but only its beginning is kept.
"""

from __future__ import annotations

import base64
import contextlib
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from itertools import chain
from typing import TYPE_CHECKING, Final, Generic, NamedTuple, TypeAlias, TypeVar, Union, cast
from xml.parsers.expat import ExpatError
from xmlrpc.client import Fault, ResponseError, Unmarshaller

from defusedxml.common import DefusedXmlException
from defusedxml.xmlrpc import DefusedExpatParser

from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError, RmpaError
from rmpa.core.limits import INT32_MAX, INT32_MIN, KIB
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

_METHOD: Final = re.compile(rb"<methodName>\s*([A-Za-z0-9_.]{1,64})\s*</methodName>")
_TEXTS: Final = re.compile(rb"<value>\s*(?:<string>)?([^<]{1,256})(?:</string>)?\s*</value>")
_BEGIN: Final = 4 * KIB
"""Bytes of a refused call that are kept, to name the call in the fault."""


class CallBody:
    """Collects one body after the other.

    Args:
        reserve: ``(bytes) -> whether there is room``: called once for each large call.
    """

    __slots__ = ("_data", "_left_out", "_reserve", "_why", "reserved")

    def __init__(self, reserve: Callable[[int], bool]) -> None:
        self._reserve = reserve
        self._data = bytearray()
        self._left_out = 0
        self._why: Callable[[bytes | bytearray, int], str] | None = None
        self.reserved = 0
        """Bytes reserved for the present call, until ``answered``."""

    def __len__(self) -> int:
        """Bytes received."""
        return len(self._data) + self._left_out

    @property
    def refused(self) -> bool:
        """Whether the call is too large: its bytes are dropped."""
        return self._why is not None

    def expect(self, size: int) -> bool:
        """Announce the size of a body that has a Content-length; return whether it is accepted."""
        if size > limits.HTTP_BODY_MAX:
            self._why = too_large
        elif size > limits.HTTP_BODY_INLINE and not self.reserved:
            if self._reserve(size):
                self.reserved = size
            else:
                self._why = too_many
        return self._why is None

    def add(self, data: bytes | bytearray) -> None:
        """Add a part."""
        size = len(self) + len(data)
        if self._why is None and size > limits.HTTP_BODY_INLINE:
            # A body in chunks has no announced size.
            self.expect(max(size, limits.HTTP_BODY_MAX))
        if self._why is None:
            self._data += data
        else:
            del self._data[_BEGIN:]
            self._data += data[: _BEGIN - len(self._data)]
            self._left_out = size - len(self._data)

    def end(self) -> tuple[memoryview, str]:
        """Return the whole body and an empty text; for a refused one its beginning and the text of the fault."""
        data, size, why = self._data, len(self), self._why
        self._data, self._left_out, self._why = bytearray(), 0, None
        return memoryview(data), why(data, size) if why is not None else ""

    def answered(self) -> None:
        """Release the reserved bytes, because the call is answered."""
        self.reserved = 0


def call_name(begin: bytes | bytearray) -> str:
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


def too_large(begin: bytes | bytearray, size: int, limit: int = 0) -> str:
    """The text of the fault for a call of ``size`` bytes, with the limit and a remedy."""
    limit = limit or limits.HTTP_BODY_MAX
    return (
        f"{call_name(begin)}: {size} bytes, above the {limit} ({limit >> 20} MiB) of one call; set its parts one by "
        "one, keep large data in a file and its path in the parameter, or publish it on a latched topic"
    )


def too_many(begin: bytes | bytearray, size: int) -> str:
    """The text of the fault for a call that does not fit beside those under way."""
    return (
        f"{call_name(begin)}: {size} bytes beside other large calls, above the {limits.HTTP_BODIES_MAX >> 20} MiB of "
        "all that are under way; try again in a moment"
    )


# Writes values as XML-RPC, piece by piece, so that other work can be done between two pieces.
#
# The text is exactly that of Python's ``xmlrpc.client``, because XmlRpc++ (roscpp) is known to read it: that parser
# compares strings, and stops without an error at ``<string/>`` or ``<i8>``.


# XML 1.0, section 2.2: characters that a document cannot hold, not even escaped.
_ILLEGAL: Final = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_PIECE: Final = 128
"""Scalars in one piece: some 50 microseconds."""
_SLICE: Final = 57 * 128
"""Characters of a long string, or bytes of binary data, in one piece; base64 has 57 bytes in a line."""


def legal_text(text: str) -> str:
    """Replace characters that XML cannot hold by ``?``."""
    return _ILLEGAL.sub("?", text)


def pieces(what: str, value: object) -> Iterator[bytes]:
    """Yield ``<value>…</value>`` in pieces of some KiB; the value must not change meanwhile.

    Args:
        what: The document, for the text of errors, such as ``the response``.
        value: Of the types that ROS has; lists and tuples alike, dicts with strings as keys.

    Raises:
        LocalProtocolError: A value cannot be written: ``None``, an integer beyond 32 bits, a control character.
    """
    try:
        yield from _pieces(value)
    except _NotXmlRpcError as error:
        raise LocalProtocolError(f"{what} {error}") from None


class _NotXmlRpcError(Exception):
    """A value cannot be written; the text has the reason, without a subject."""


def _pieces(value: object) -> Iterator[bytes]:
    out: list[str] = []
    rest: Iterator[object] = iter((value,))
    members, end = False, ""
    above: list[tuple[Iterator[object], bool, str]] = []
    while True:
        for item in rest:
            if members:
                key, item = cast("tuple[object, object]", item)  # noqa: PLW2901 - of the pair, the value
                out.append(f"<member>\n<name>{_name(key)}</name>\n")
            write = _SCALARS.get(type(item))
            if write is None:
                if len(above) > limits.XMLRPC_DEPTH_MAX:
                    raise _NotXmlRpcError(f"is nested deeper than {limits.XMLRPC_DEPTH_MAX} levels")
                above.append((rest, members, end))
                rest, begin, end = _open(item, end="</member>\n" if members else "")
                members = type(item) is dict
                out.append(begin)
                break
            for text in write(item):
                out.append(text)
                if len(text) >= _SLICE:
                    yield _flush(out)
            if members:
                out.append("</member>\n")
            if len(out) >= _PIECE:
                yield _flush(out)
        else:
            out.append(end)
            if not above:
                break
            rest, members, end = above.pop()
    yield _flush(out)


def _flush(out: list[str]) -> bytes:
    piece = "".join(out).encode()
    out.clear()
    return piece


def _open(item: object, end: str) -> tuple[Iterator[object], str, str]:
    """Return the elements of a list or dict, the text before them and the text after them, which ends in ``end``."""
    if type(item) is dict:
        return iter(item.items()), "<value><struct>\n", f"</struct></value>\n{end}"
    if type(item) in {list, tuple}:
        return iter(cast("list[object]", item)), "<value><array><data>\n", f"</data></array></value>\n{end}"
    raise _NotXmlRpcError(f"cannot be said in XML-RPC: it holds a {type(item).__name__}")


def _escaped(text: str) -> str:
    if not text.isprintable() and (illegal := _ILLEGAL.search(text)) is not None:
        raise _NotXmlRpcError(f"holds the character {illegal[0]!a}, which XML cannot hold; remove it")
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _name(key: object) -> str:
    if type(key) is not str:
        raise _NotXmlRpcError("cannot be said in XML-RPC: it has a dictionary key that is not a string")
    return _escaped(key)


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
        raise _NotXmlRpcError(f"cannot be said in XML-RPC: {str(value)[:40]} does not fit 32 bits")
    return (f"<value><int>{value}</int></value>\n",)


def _datetime(value: datetime) -> Iterable[str]:
    return (f"<value><dateTime.iso8601>{value.year:04d}{value:%m%dT%H:%M:%S}</dateTime.iso8601></value>\n",)


_SCALARS: Final[dict[type, Callable[..., Iterable[str]]]] = {
    bool: lambda value: (f"<value><boolean>{value:d}</boolean></value>\n",),
    int: _int,
    float: lambda value: (f"<value><double>{value!r}</double></value>\n",),
    str: _string,
    bytes: _base64,
    bytearray: _base64,
    datetime: _datetime,
}
"""Writers of the types other than list and dict."""


# XML-RPC calls and responses as bytes (xmlrpc.com/spec, and ROS's use of it).
#
# The standard library parses; ``defusedxml`` refuses entity declarations; this module bounds depth and size and
# allows
# only the types that ROS has. Long documents are read and written piece by piece.


XmlRpcValue: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, bytes, datetime, Sequence["XmlRpcValue"], Mapping[str, "XmlRpcValue"], None
]
"""A value of XML-RPC. Parsed containers are lists and dicts; ``None`` is read, never written."""

_T = TypeVar("_T")
_DECLARATION: Final = "<?xml version='1.0'?>\n"


class RosFault(RmpaError):  # noqa: N818 - XML-RPC calls it a fault
    """The other side answered a call with an XML-RPC fault.

    Args:
        code: The fault code; Python's servers, rosmaster among them, always have 1.
        text: The fault string.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(code, text)
        self.code = code
        self.text = text

    def __str__(self) -> str:
        return f"XML-RPC fault {self.code}: {self.text}"


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


class DocumentReader(ABC, Generic[_T]):
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
        with self._errors():
            self._give()
        self._token = self._size - self._expat.CurrentByteIndex

    def abandon(self) -> None:
        """Stop reading; this breaks a reference cycle, which would wait for the garbage collector."""
        with contextlib.suppress(Exception):
            self._parser.close()

    @abstractmethod
    def close(self) -> _T:
        """The content of the document, once all pieces were fed."""

    def _end(self) -> tuple[str | None, tuple[XmlRpcValue, ...]]:
        """Finish the document; return the method's name, or ``None`` for a response, and the values.

        Raises:
            Fault: The document is a fault.
            RemoteProtocolError: As for ``feed``, or the document is incomplete.
        """
        with self._errors():
            self._give()
            self._parser.close()
            params = cast("tuple[XmlRpcValue, ...]", self._unmarshaller.close())
        return self._unmarshaller.getmethodname(), params

    def _give(self) -> None:
        waiting = bytes(self._waiting)
        self._waiting.clear()
        self._parser.feed(waiting)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self.abandon()
            if isinstance(error, Fault):
                raise
            if isinstance(error, DefusedXmlException):
                text = f"XML declares entities, which XML-RPC has no use for: {error}"
                raise RemoteProtocolError(text) from error
            if isinstance(error, ExpatError):
                raise RemoteProtocolError(f"malformed XML: {error}") from error
            if isinstance(error, ResponseError):
                raise RemoteProtocolError(f"this XML is not XML-RPC {error}".rstrip()) from error
            if isinstance(error, ArithmeticError | AttributeError | LookupError | TypeError | ValueError):
                # The standard unmarshaller has no error of its own for elements in the wrong order or bad content.
                raise RemoteProtocolError(f"malformed XML-RPC value: {error}") from error
            raise


class CallReader(DocumentReader["tuple[str, tuple[XmlRpcValue, ...]]"]):
    """Reads a ``methodCall`` document."""

    def close(self) -> tuple[str, tuple[XmlRpcValue, ...]]:
        """The method's name and its parameters, once all pieces were fed.

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


class ResponseReader(DocumentReader[XmlRpcValue]):
    """Reads a ``methodResponse`` document."""

    def close(self) -> XmlRpcValue:
        """The value, once all pieces were fed.

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


def parse_call(data: bytes) -> tuple[str, tuple[XmlRpcValue, ...]]:
    """Read a whole ``methodCall`` document; returns and raises as ``CallReader``."""
    reader = CallReader()
    reader.feed(data)
    return reader.close()


def parse_response(data: bytes) -> XmlRpcValue:
    """Read a whole ``methodResponse`` document; returns and raises as ``ResponseReader``."""
    reader = ResponseReader()
    reader.feed(data)
    return reader.close()


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


def serialize_call(method: str, params: Sequence[XmlRpcValue]) -> bytes:
    """Write a ``methodCall`` document; the errors are those of ``call_pieces``."""
    return b"".join(call_pieces(method, params))


def serialize_response(value: XmlRpcValue) -> bytes:
    """Write a ``methodResponse`` document; the errors are those of ``call_pieces``."""
    return b"".join(response_pieces(value))


def serialize_fault(code: int, text: str) -> bytes:
    """Write a fault as a ``methodResponse``; characters that XML cannot hold become ``?``."""
    body = b"".join(pieces("the fault", {"faultCode": code, "faultString": legal_text(text)}))
    return b"%s<methodResponse>\n<fault>\n%s</fault>\n</methodResponse>\n" % (_DECLARATION.encode(), body)
