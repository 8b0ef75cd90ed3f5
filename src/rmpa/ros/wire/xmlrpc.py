"""XML-RPC calls and responses as bytes (xmlrpc.com/spec, and ROS's use of it).

The standard library parses; ``defusedxml`` refuses entity declarations; this module bounds depth and size and allows
only the types that ROS has. Long documents are read and written piece by piece.
"""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from typing import Final, Generic, NamedTuple, TypeAlias, TypeVar, Union, cast
from xml.parsers.expat import ExpatError
from xmlrpc.client import Fault, ResponseError, Unmarshaller

from defusedxml.common import DefusedXmlException
from defusedxml.xmlrpc import DefusedExpatParser

from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.ros import limits
from rmpa.ros.wire.xmlrpc_writer import legal_text, pieces

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
