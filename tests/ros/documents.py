"""Calls as documents of XML-RPC, as a client writes them and a server reads them."""

from __future__ import annotations

from collections.abc import Sequence

from rmpa.ros.wire.xmlrpc import DocumentReader, XmlRpcValue, call_pieces


def parse_call(data: bytes) -> tuple[str, tuple[XmlRpcValue, ...]]:
    """Read a whole ``methodCall`` document."""
    reader = DocumentReader()
    reader.feed(data)
    return reader.call()


def serialize_call(method: str, params: Sequence[XmlRpcValue]) -> bytes:
    """Write a ``methodCall`` document."""
    return b"".join(call_pieces(method, params))
