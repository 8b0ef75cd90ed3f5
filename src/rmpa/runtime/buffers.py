"""What a partial write leaves of its buffers."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

Buffer = bytes | bytearray | memoryview


def unsent(parts: Sequence[Buffer], sent: int) -> list[Buffer]:
    """The parts without their first ``sent`` bytes; nothing is copied."""
    left: list[Buffer] = []
    for part in parts:
        size = len(part)
        if sent >= size:
            sent -= size
        else:
            left.append(memoryview(part)[sent:] if sent else part)
            sent = 0
    return left
