"""Messages of one source that go between gateways together: the payload under a topic's key for batches. Sans-I/O.

The payload is the messages one after the other as in TCPROS, each with its length (4 bytes, little-endian) in front.
The attachment is that of the first message, with the flag of a batch; the others have the following numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.ros.wire.tcpros import LENGTH

if TYPE_CHECKING:
    from collections.abc import Sequence

_LENGTH: Final = LENGTH.size


def join_batch(messages: Sequence[bytes]) -> bytes:
    """The payload of these messages."""
    parts: list[bytes] = []
    for message in messages:
        parts += (LENGTH.pack(len(message)), message)
    return b"".join(parts)


def split_batch(payload: bytes) -> list[memoryview]:
    """The messages of a payload, as views of it, each with its length in front.

    Raises:
        RemoteProtocolError: It is empty, has more than ``limits.BATCH_READ_MAX`` messages, or ends within one.
    """
    messages: list[memoryview] = []
    view = memoryview(payload)
    start, size = 0, len(payload)
    while start + _LENGTH <= size:
        end = start + _LENGTH + LENGTH.unpack_from(payload, start)[0]
        if end > size or len(messages) >= limits.BATCH_READ_MAX:
            break
        messages.append(view[start:end])
        start = end
    if start != size or not messages:
        raise RemoteProtocolError(
            f"a batch of {size} bytes is no whole number of messages from 1 to {limits.BATCH_READ_MAX}"
        )
    return messages
