"""Down-sampling to a contract's ``max_rate``: on a steady beat, and the newest message is the one that is kept."""

from __future__ import annotations


class Downsampler:
    """Admits at most ``rate`` messages a second of one route; pure.

    Args:
        rate: Messages a second.
    """

    __slots__ = ("_due", "_interval", "skipped")

    def __init__(self, rate: float) -> None:
        self._interval = 1 / rate
        self._due = 0.0
        self.skipped = 0
        """Messages that gave way to newer ones."""

    @property
    def due(self) -> float:
        """When the next one may go, monotonic seconds."""
        return self._due

    def admit(self, now: float) -> bool:
        """Whether a message may go now; then the next one may an interval later."""
        # A tenth of the interval early is on time: two clocks at the same rate must not lose every other message.
        if now < self._due - self._interval / 10:
            return False
        # Keep to the beat where messages come faster than it; begin anew after a pause.
        self._due = max(self._due + self._interval, now)
        if self._due < now + self._interval / 2:
            self._due = now + self._interval
        return True
