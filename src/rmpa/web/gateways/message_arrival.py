"""How long a client's message has been arriving, and how old it may be; no I/O.

The library gathers the bytes and fragments of a message (RFC 6455, section 5.4) and passes only whole ones on. What a
connection received beyond the whole ones belongs to a message that is not whole yet.
"""

from __future__ import annotations

import struct
from collections import deque
from typing import Final

from rmpa.web import limits

_PING: Final = struct.Struct("!I")
_UNANSWERED_MAX: Final = 8
"""Pings without an answer, behind which no further one is sent: they wait as the client's frames do."""
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


class CommandAge:
    """Bounds the age of what a client sends by the pings that it answers; no clocks are compared.

    A client answers pings in order with its other frames, and TCP keeps that order: what comes behind the answer to a
    ping was sent after that ping, so it is younger. What TCP kept over a cut comes in front of the answers to all
    pings since. The bound is never too low. It is too high by the round trip, and by the time between two pings.

    Args:
        now: When the handshake was answered, which the client awaits before its first frame.
    """

    def __init__(self, now: float) -> None:
        self._number = 0
        self._sent: deque[tuple[int, float]] = deque()
        self._younger_than = now

    def ping(self, now: float) -> bytes | None:
        """The payload of the next ping; ``None`` while too many have no answer."""
        if len(self._sent) >= _UNANSWERED_MAX:
            return None
        self._number = self._number + 1 & 0xFFFFFFFF
        self._sent.append((self._number, now))
        return _PING.pack(self._number)

    def pong(self, payload: bytes) -> None:
        """A ping is answered, and with it all before it (RFC 6455, section 5.5.3)."""
        number = _PING.unpack(payload)[0] if len(payload) == _PING.size else None
        if any(each == number for each, _ in self._sent):
            while self._sent:
                each, self._younger_than = self._sent.popleft()
                if each == number:
                    return

    def bound(self, now: float) -> float:
        """Seconds that the frame which comes now may be old at most."""
        return now - self._younger_than
