"""Sends the bodies of requests and responses: small ones in one call, large ones in parts that let data go first."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.core.sizes import KIB
from rmpa.runtime.event_loop import yield_to_data

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.runtime.stream import Stream

BODIES: Final = 0
"""The key of what a service's connection sends."""
INLINE: Final = 256 * KIB
"""Larger bodies leave in parts: to copy one of 64 MiB into a queue would hold everything else up for 30 ms."""
_PART: Final = 256 * KIB


async def send_large(stream: Stream, head: bytes, body: Buffer) -> None:
    """Send a body that is larger than ``INLINE``; ends early when the stream is closed."""
    parcel = stream.open(BODIES, len(head) + len(body))
    stream.extend(parcel, head)
    view = memoryview(body)
    for start in range(0, len(view), _PART):
        stream.extend(parcel, view[start : start + _PART])
        while stream.pending_bytes and not stream.closed:
            await stream.drained()
        if stream.closed:
            return
        yield_to_data()
        await asyncio.sleep(0)
