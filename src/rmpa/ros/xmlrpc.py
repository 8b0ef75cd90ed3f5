"""XML-RPC calls and responses as bytes (xmlrpc.com/spec, and what ROS makes of it).

The standard library marshals; ``defusedxml`` refuses entity declarations; this module bounds depth and size,
insists on the types that ROS has, and writes only what XmlRpc++ (roscpp) can read: it matches strings, and an empty
tag written ``<string/>`` or an ``<i8>`` ends its parsing without an error.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from typing import Final, NamedTuple, TypeAlias, Union, cast
from xml.parsers.expat import ExpatError
from xmlrpc.client import Fault, Marshaller, ResponseError, Unmarshaller

from defusedxml.common import DefusedXmlException
from defusedxml.xmlrpc import DefusedExpatParser

from rmpa.core import limits
from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError, RmpaError

XmlRpcValue: TypeAlias = Union[  # noqa: UP007 - | does not take the forward references of a recursive type
    bool, int, float, str, bytes, datetime, Sequence["XmlRpcValue"], Mapping[str, "XmlRpcValue"], None
]
"""What can be said in XML-RPC. Parsed values are made of lists and dicts; ``None`` is read, never written."""

_MAX_INT: Final = (1 << 31) - 1
_MIN_INT: Final = -(1 << 31)
# XML 1.0, section 2.2: what a document cannot hold, not even escaped.
_ILLEGAL: Final = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_DECLARATION: Final = "<?xml version='1.0'?>\n"


class RosFault(RmpaError):  # noqa: N818 - XML-RPC calls it a fault
    """The other side answered a call with an XML-RPC fault.

    Args:
        code: Its number; Python's servers, rosmaster among them, always say 1.
        text: What it says.
    """

    def __init__(self, code: int, text: str) -> None:
        super().__init__(code, text)
        self.code = code
        self.text = text

    def __str__(self) -> str:
        return f"XML-RPC fault {self.code}: {self.text}"


class Reply(NamedTuple):
    """What every method of the Master, Parameter and Slave APIs returns.

    ``code`` is 1 for success, 0 for a failure, -1 for a mistake of the caller; ``status`` is text for people.
    """

    code: int
    status: str
    value: XmlRpcValue

    @classmethod
    def of(cls, value: XmlRpcValue) -> Reply:
        """Read the triple out of a parsed response.

        Raises:
            RemoteProtocolError: It is none.
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
    if not _MIN_INT <= number <= _MAX_INT:
        raise RemoteProtocolError(
            f"integer {data.strip()[:40]} does not fit XML-RPC's 32 bits; send it as a double or a string"
        )
    unmarshaller.append(number)


def _end_struct(unmarshaller: Unmarshaller, data: str) -> None:
    unmarshaller.end_struct(data)
    struct = unmarshaller._stack[-1]  # noqa: SLF001 - the standard library documents this class by its source
    if not (isinstance(struct, dict) and all(isinstance(key, str) for key in struct)):
        raise RemoteProtocolError("XML-RPC struct with a member name that is not a string")


_INTS: Final = ("i1", "i2", "i4", "i8", "int", "biginteger")
_DISPATCH: Final[dict[str, Callable[[Unmarshaller, str], None]]] = {
    **{tag: handler for tag, handler in Unmarshaller.dispatch.items() if tag != "bigdecimal"},
    **dict.fromkeys(_INTS, _end_int),
    "struct": _end_struct,
}


class _BoundedUnmarshaller(Unmarshaller):
    """The standard unmarshaller, with limits and without the types that ROS does not have."""

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


def _unmarshal(data: bytes, unmarshaller: Unmarshaller) -> tuple[XmlRpcValue, ...]:
    parser = DefusedExpatParser(unmarshaller)
    try:
        parser.feed(data)
        parser.close()
    except BaseException:
        # Closing breaks a reference cycle, which nobody else does while the collector is off.
        with contextlib.suppress(Exception):
            parser.close()
        raise
    return cast(tuple[XmlRpcValue, ...], unmarshaller.close())


def _parse(data: bytes) -> tuple[str | None, tuple[XmlRpcValue, ...]]:
    if len(data) > limits.HTTP_BODY_MAX:
        raise LimitExceeded("XML-RPC body", len(data), limits.HTTP_BODY_MAX)
    unmarshaller = _BoundedUnmarshaller()
    try:
        params = _unmarshal(data, unmarshaller)
    except DefusedXmlException as error:
        raise RemoteProtocolError(f"XML declares entities, which XML-RPC has no use for: {error}") from error
    except ExpatError as error:
        raise RemoteProtocolError(f"malformed XML: {error}") from error
    except ResponseError as error:
        raise RemoteProtocolError(f"this XML is not XML-RPC {error}".rstrip()) from error
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        # The standard unmarshaller has no error of its own for elements in the wrong order or with bad content.
        raise RemoteProtocolError(f"malformed XML-RPC value: {error}") from error
    return unmarshaller.getmethodname(), params


def parse_call(data: bytes) -> tuple[str, tuple[XmlRpcValue, ...]]:
    """Read a ``methodCall`` document.

    Returns:
        The method's name and its parameters.

    Raises:
        RemoteProtocolError: It is malformed, too deep or too large, declares entities, or holds an integer beyond
            32 bits.
    """
    try:
        method, params = _parse(data)
    except Fault as fault:
        raise RemoteProtocolError("an XML-RPC fault came where a call was expected") from fault
    if not method:
        raise RemoteProtocolError("XML-RPC call without a methodName")
    return method, params


def parse_response(data: bytes) -> XmlRpcValue:
    """Read a ``methodResponse`` document.

    Raises:
        RosFault: The response is a fault.
        RemoteProtocolError: As for ``parse_call``, or there is not exactly one value.
    """
    try:
        method, params = _parse(data)
    except Fault as fault:
        if not isinstance(fault.faultCode, int):
            raise RemoteProtocolError(f"XML-RPC fault with code {brief(fault.faultCode)}") from fault
        raise RosFault(fault.faultCode, str(fault.faultString)) from fault
    if method is not None or len(params) != 1:
        raise RemoteProtocolError(f"XML-RPC response with {len(params)} values; there must be one")
    return params[0]


def _dump(what: str, values: Fault | tuple[XmlRpcValue, ...]) -> str:
    try:
        text = Marshaller().dumps(cast(Fault | tuple[str], values))  # typeshed knows lists and dicts only
    except (OverflowError, RecursionError, TypeError) as error:
        raise LocalProtocolError(f"{what} cannot be said in XML-RPC: {error}") from error
    illegal = _ILLEGAL.search(text)
    if illegal is not None:
        raise LocalProtocolError(f"{what} holds the character {illegal[0]!a}, which XML cannot hold; remove it")
    return text


def serialize_call(method: str, params: Sequence[XmlRpcValue]) -> bytes:
    """Write a ``methodCall`` document.

    Raises:
        LocalProtocolError: A value cannot be said: ``None``, an integer beyond 32 bits, a control character.
    """
    body = _dump(f"the call of {method}", tuple(params))
    return f"{_DECLARATION}<methodCall>\n<methodName>{method}</methodName>\n{body}</methodCall>\n".encode()


def serialize_response(value: XmlRpcValue) -> bytes:
    """Write a ``methodResponse`` document; the errors are those of ``serialize_call``."""
    return f"{_DECLARATION}<methodResponse>\n{_dump('the response', (value,))}</methodResponse>\n".encode()


def serialize_fault(code: int, text: str) -> bytes:
    """Write a fault as a ``methodResponse``; characters that XML cannot hold become ``?``."""
    body = _dump("the fault", Fault(code, _ILLEGAL.sub("?", text)))
    return f"{_DECLARATION}<methodResponse>\n{body}</methodResponse>\n".encode()
