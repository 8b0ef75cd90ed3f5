"""Sends large requests and responses in parts; other pending data is served between two parts."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.core.limits import KIB
from rmpa.runtime.loop import yield_to_data

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.runtime.stream import Stream

BODIES: Final = 0
"""The outbox key of requests and responses."""
INLINE: Final = 256 * KIB
"""Larger bodies are sent in parts: to copy 64 MiB into a queue would hold up the event loop for 30 ms."""
_PART: Final = 256 * KIB


async def send_large(stream: Stream, head: bytes, body: Buffer) -> None:
    """Send a body that is larger than ``INLINE``; ends early when the stream is closed."""
    message = stream.open(BODIES, len(head) + len(body))
    stream.extend(message, head)
    view = memoryview(body)
    for start in range(0, len(view), _PART):
        stream.extend(message, view[start : start + _PART])
        while stream.pending_bytes and not stream.closed:
            await stream.drained()
        if stream.closed:
            return
        yield_to_data()
        await asyncio.sleep(0)
