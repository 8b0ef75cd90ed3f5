"""Counts messages and bytes of one topic, and their rate from report to report. Sans-I/O."""

from __future__ import annotations


class SiteTraffic:
    """Messages and bytes, cheaply for each message: rates are computed where they are read.

    Args:
        now: Monotonic seconds.
    """

    __slots__ = ("_at", "_bytes_at", "_messages_at", "bandwidth", "bytes", "messages", "rate")

    def __init__(self, now: float) -> None:
        self.messages = 0
        """Messages ever seen."""
        self.bytes = 0
        """Bytes ever seen."""
        self.rate = 0.0
        """Messages a second between the last two readings."""
        self.bandwidth = 0.0
        """Bytes a second between the last two readings."""
        self._at, self._messages_at, self._bytes_at = now, 0, 0

    def add(self, size: int, messages: int = 1) -> None:
        """Count messages of ``size`` bytes together."""
        self.messages += messages
        self.bytes += size

    def read(self, now: float) -> None:
        """Compute the rates since the last reading, if that is at least a second ago."""
        passed = now - self._at
        if passed >= 1:
            self.rate = (self.messages - self._messages_at) / passed
            self.bandwidth = (self.bytes - self._bytes_at) / passed
            self._at, self._messages_at, self._bytes_at = now, self.messages, self.bytes
