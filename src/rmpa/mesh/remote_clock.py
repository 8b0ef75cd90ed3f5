"""The round-trip time of a connection and the remote clock, from four time stamps (RFC 5905, section 8)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from rmpa.mesh import limits


@dataclass(frozen=True, slots=True)
class ClockSample:
    """One exchange of ping and pong.

    Args:
        rtt: Seconds on the wire: the round trip without the time that the remote side took to answer.
        offset: Seconds that the remote wall clock is ahead of the local one, ±rtt/2.
        taken: When, in monotonic seconds.
    """

    rtt: float
    offset: float
    taken: float


class RemoteClock:
    """The remote clock, by the exchange with the least error among the last ``limits.CLOCK_SAMPLES``.

    Queues only make round trips longer, so the shortest has the least error; the error grows with age, because the
    two clocks drift apart (PHI of RFC 5905).
    """

    def __init__(self) -> None:
        self._pings: dict[int, float] = {}
        self._samples: deque[ClockSample] = deque(maxlen=limits.CLOCK_SAMPLES)
        self.rtt: float | None = None
        """The last round trip, in seconds; ``None`` before the first."""

    def pinged(self, t1: int, now: float) -> None:
        """A ping with stamp ``t1`` (ns) is sent."""
        self._pings[t1] = now
        while len(self._pings) > limits.CLOCK_SAMPLES:
            del self._pings[next(iter(self._pings))]

    def ponged(self, t1: int, t2: int, t3: int, t4: int, now: float) -> ClockSample | None:
        """A pong came at wall time ``t4``; all stamps in ns. Returns ``None`` if it answers no known ping.

        ``t1`` and ``t4`` are of the local clock, ``t2`` (ping received) and ``t3`` (pong sent) of the remote one.
        """
        sent = self._pings.pop(t1, None)
        if sent is None:
            return None
        rtt = ((t4 - t1) - (t3 - t2)) / 1e9
        if abs((t4 - t1) / 1e9 - (now - sent)) > limits.CLOCK_STEP or rtt < 0:
            # A wall clock was set in between: earlier samples are void.
            self._samples.clear()
            return None
        sample = ClockSample(rtt, ((t2 - t1) + (t3 - t4)) / 2e9, now)
        if self._samples and self._contradicts(sample):
            self._samples.clear()
        self._samples.append(sample)
        self.rtt = sample.rtt
        return sample

    def estimate(self, now: float) -> tuple[float, float] | None:
        """Offset and its error bound, in seconds: the true offset lies within ±error; ``None`` if unknown."""
        best = min(self._samples, key=lambda s: self._error(s, now), default=None)
        return None if best is None else (best.offset, self._error(best, now))

    def _contradicts(self, sample: ClockSample) -> bool:
        """Whether a sample and the present estimate cannot both be true: a clock was set."""
        offset, error = self.estimate(sample.taken) or (sample.offset, 0.0)
        return abs(sample.offset - offset) > error + sample.rtt / 2 + 1e-6

    @staticmethod
    def _error(sample: ClockSample, now: float) -> float:
        return sample.rtt / 2 + limits.CLOCK_DRIFT * max(0.0, now - sample.taken)
