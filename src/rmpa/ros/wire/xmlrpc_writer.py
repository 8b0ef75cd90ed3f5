"""Writes values as XML-RPC, piece by piece, so that other work can be done between two pieces.

The text is exactly that of Python's ``xmlrpc.client``, because XmlRpc++ (roscpp) is known to read it: that parser
compares strings, and stops without an error at ``<string/>`` or ``<i8>``.
"""

from __future__ import annotations

import base64
import re
from datetime import datetime
from itertools import chain
from typing import TYPE_CHECKING, Final, cast

from rmpa.core.errors import LocalProtocolError
from rmpa.core.limits import INT32_MAX, INT32_MIN
from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

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
