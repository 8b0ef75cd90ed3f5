"""Counts the messages of one source of another site that were lost, by their sequence numbers. Sans-I/O."""

from __future__ import annotations


class SequenceCounter:
    """Follows the sequence numbers of one source, which count from 1 in each run of its exporter.

    A latched message that comes once more (from a cache) has a number that is known.
    """

    def __init__(self) -> None:
        self._run: int | None = None
        self._last = 0
        self._announced = 0
        self._expects_first = False
        self._gaps = 0

    @property
    def lost(self) -> int:
        """Messages that were sent and have not come; those on their way count too until they come."""
        return self._gaps + max(0, self._announced - self._last)

    def take(self, run: int, sequence: int) -> bool:
        """Count a message that came.

        Args:
            run: The exporter's run.
            sequence: Its number.

        Returns:
            Whether it is new; else it is to be dropped.
        """
        if run != self._run:
            self._settle()
            self._run, self._announced = run, sequence
        elif self._expects_first:
            self._gaps += max(0, sequence - self._last - 1)
        elif sequence <= self._last:
            return False
        else:
            self._gaps += sequence - self._last - 1
        self._last, self._expects_first = sequence, False
        return True

    def announced(self, run: int, sequence: int) -> None:
        """The exporter says how many messages it has sent; if none has come yet, what it sends later is expected."""
        if self._run is None:
            self._run, self._last, self._announced, self._expects_first = run, sequence, sequence, True
        elif run == self._run:
            self._announced = max(self._announced, sequence)

    def restart(self) -> None:
        """Nothing is subscribed any more: the next message begins anew, without a loss."""
        self._settle()
        self._run, self._last, self._announced, self._expects_first = None, 0, 0, False

    def _settle(self) -> None:
        self._gaps = self.lost
        self._announced = self._last
