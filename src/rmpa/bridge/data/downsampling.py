"""Down-sampling to a contract's ``max_rate``, at a steady period."""

from __future__ import annotations


class Downsampler:
    """Admits at most ``rate`` messages a second of one route; pure.

    Args:
        rate: Messages a second.
    """

    __slots__ = ("_period", "due", "skipped")

    def __init__(self, rate: float) -> None:
        self._period = 1 / rate
        self.due = 0.0
        """When the next message may be sent, monotonic seconds."""
        self.skipped = 0
        """Messages left out for newer ones; the sender counts them here."""

    def admit(self, now: float) -> bool:
        """Whether a message may be sent now; if so, the next one is due a period later."""
        # A tenth of the period early is on time: two clocks at the same rate must not lose every other message.
        if now < self.due - self._period / 10:
            return False
        # Keep the phase while messages come faster than the rate; restart it after a pause.
        self.due = max(self.due + self._period, now)
        if self.due < now + self._period / 2:
            self.due = now + self._period
        return True
