"""Buffers for the payloads of received messages, used again and again. No I/O."""

from __future__ import annotations

from collections import deque

from rmpa.web import limits


class PayloadBuffers:
    """Copies large payloads into buffers that are used again when no view of them is left.

    To fill a fresh buffer of a megabyte takes several times as long as to fill one that was used before: the kernel
    maps and clears each of its pages first.

    Args:
        kept_bytes: Bytes of the buffers that are kept, used and unused.
    """

    def __init__(self, kept_bytes: int = limits.PAYLOAD_BUFFERS_BYTES) -> None:
        self._limit = kept_bytes
        self._kept: deque[bytearray] = deque()
        """Those used last are at the right."""
        self._bytes = 0

    @property
    def bytes(self) -> int:
        """Bytes of the buffers that are kept."""
        return self._bytes

    def copy(self, data: memoryview) -> memoryview:
        """A read-only copy, which stays as it is while there is a view of it."""
        size = len(data)
        if size < limits.PAYLOAD_BUFFER_MIN:
            return memoryview(bytes(data))
        buffer = self._unused(size)
        if buffer is None:
            buffer = bytearray(size)
            self._bytes += size
        self._kept.append(buffer)
        while self._bytes > self._limit or len(self._kept) > limits.PAYLOAD_BUFFERS_MAX:
            self._bytes -= len(self._kept.popleft())
        view = memoryview(buffer)[:size]
        view[:] = data
        return view.toreadonly()

    def clear(self) -> None:
        """Keep no buffer; those in use end with their last view."""
        self._kept.clear()
        self._bytes = 0

    def _unused(self, size: int) -> bytearray | None:
        """Take out the buffer that was used last, of those that are large enough and not far too large.

        It is the one that the processor's caches are most likely to hold.
        """
        for index in reversed(range(len(self._kept))):
            buffer = self._kept[index]
            if size <= len(buffer) <= 2 * size and not _has_views(buffer):
                del self._kept[index]
                return buffer
        return None


def _has_views(buffer: bytearray) -> bool:
    try:
        del buffer[-1:]  # a buffer with a view cannot be resized
    except BufferError:
        return True
    buffer.append(0)  # moves nothing: its memory has not become smaller
    return False
