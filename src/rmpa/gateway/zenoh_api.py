"""Values of Zenoh that the neighbours and ``gateway.zenoh`` share. The library is imported only by the latter."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum


class ZenohPriority(IntEnum):
    """Zenoh's priorities; a lower number goes first."""

    REAL_TIME = 1
    INTERACTIVE_HIGH = 2
    INTERACTIVE_LOW = 3
    DATA_HIGH = 4
    DATA = 5
    DATA_LOW = 6
    BACKGROUND = 7


@dataclass(frozen=True, slots=True)
class ZenohQos:
    """The QoS of one publisher, and the bounds of its queue in this process.

    Args:
        reliable: Zenoh's reliability ``RELIABLE``; else ``BEST_EFFORT``.
        block: Congestion control ``BLOCK`` (it waits in a thread of its own); else ``DROP``.
        priority: Zenoh's priority.
        messages: Messages that wait at most; above it the oldest is dropped, and counted.
        bytes: Bytes that wait at most; one message always fits.
        cache: Samples that a later subscriber gets (an advanced publisher); 0: an ordinary publisher.
    """

    reliable: bool = True
    block: bool = True
    priority: ZenohPriority = ZenohPriority.DATA
    messages: int = 1000
    bytes: int = 64 * 1024 * 1024
    cache: int = 0


@dataclass(frozen=True, slots=True)
class ZenohSample:
    """One message that was received.

    Args:
        key: Its key.
        payload: Its bytes.
        attachment: Its attachment; empty if it has none.
    """

    key: str
    payload: bytes
    attachment: bytes


@dataclass(frozen=True, slots=True)
class ZenohReply:
    """One answer to ``get``.

    Args:
        key: The key that was answered; empty for an error.
        payload: The answer, or the error's text in UTF-8.
        attachment: Its attachment; empty if it has none.
        ok: Whether it is an answer and no error.
    """

    key: str
    payload: bytes
    attachment: bytes
    ok: bool
