"""How long a client's message has been arriving; no I/O.

The library gathers the bytes and fragments of a message (RFC 6455, section 5.4) and passes only whole ones on. What a
connection received beyond the whole ones belongs to a message that is not whole yet.
"""

from __future__ import annotations

from typing import Final

from rmpa.web import limits

_CONTROL_HEADER: Final = 6
"""Bytes of a client's control frame before its payload: two, and the mask."""


class MessageArrival:
    """Finds a message that never ends. A byte too few may be counted for it, and never one too many."""

    def __init__(self) -> None:
        self._accounted = 0
        self._began: float | None = None

    def message_ended(self, received: int) -> None:
        """A message is whole.

        Args:
            received: Bytes of the connection so far.
        """
        self._accounted = received
        self._began = None

    def control_frame(self, size: int) -> None:
        """A ping or pong is whole, which may come between the fragments of a message.

        Args:
            size: Bytes of its payload.
        """
        self._accounted += _CONTROL_HEADER + size

    def takes_too_long(self, received: int, now: float) -> bool:
        """Whether a message has been arriving for ``limits.MESSAGE_TIMEOUT``; to be asked every few seconds.

        Args:
            received: Bytes of the connection so far.
            now: Seconds of a clock that never goes back.
        """
        if received <= self._accounted:
            self._began = None
        elif self._began is None:
            self._began = now
        return self._began is not None and now - self._began >= limits.MESSAGE_TIMEOUT
