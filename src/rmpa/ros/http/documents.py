"""Reads XML-RPC documents in slices of ``limits.XMLRPC_SLICE``; other pending data is served between two slices.

A document of some MiB takes seconds to parse. It is not parsed in a thread, because a thread that computes takes the
interpreter from the event loop for milliseconds at a time.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, TypeVar, overload

from rmpa.ros import limits
from rmpa.runtime.loop import yield_to_data

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.ros.wire.xmlrpc import DocumentReader

_T = TypeVar("_T")


@overload
def slices(document: Buffer) -> Iterator[Buffer]: ...
@overload
def slices(document: str) -> Iterator[str]: ...
def slices(document: Buffer | str) -> Iterator[Buffer | str]:
    """A document in slices."""
    for begin in range(0, len(document), limits.XMLRPC_SLICE):
        yield document[begin : begin + limits.XMLRPC_SLICE]


def read_small(reader: DocumentReader[_T], document: Buffer) -> _T:
    """Read a document of at most ``limits.HTTP_BODY_INLINE`` bytes; the errors are those of ``reader``."""
    for piece in slices(document):
        reader.feed(piece)
        yield_to_data()
    return reader.close()


async def read_large(reader: DocumentReader[_T], pieces: Iterable[Buffer]) -> _T:
    """Read a document of any size; after ``limits.HTTP_BODY_INLINE`` bytes other callbacks run between slices.

    Args:
        reader: Its errors are raised.
        pieces: Slices of the document.
    """
    size = 0
    try:
        for piece in pieces:
            reader.feed(piece)
            size += len(piece)
            if size > limits.HTTP_BODY_INLINE:
                await asyncio.sleep(0)
            else:
                yield_to_data()
    except BaseException:
        reader.abandon()
        raise
    return reader.close()
