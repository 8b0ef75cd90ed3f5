"""The probes of a failure detector that are under way, its own and those for others, with their time-outs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core.clock import earliest
from rmpa.core.sizes import UINT32_MAX
from rmpa.core.timer_queue import TimerQueue
from rmpa.core.token_bucket import TokenBucket
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.guid import Guid
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.swim.member_table import Member

Relay = tuple[int, int, "Guid", bytes, "Address"]
"""A probe on behalf of another member: place of the subject, the request's number, the subject's GUID and run,
and the address of the member that requested it."""


@dataclass(slots=True)
class PendingProbe:
    """One probe that waits for its answer.

    Args:
        place: That of the probed member.
        run: Its run.
        at: When it was sent.
        timeout: Seconds until others are asked to probe too.
        asked: How many others were asked; ``None`` before.
        nacks: How many of these had no answer either, but could say so.
    """

    place: int
    run: bytes
    at: float
    timeout: float
    asked: int | None = None
    nacks: int = 0


class Probing:
    """Numbers and time-outs of probes.

    The time-out follows from the measured round trips as that of TCP does (RFC 6298), within bounds.

    Args:
        rng: Uniform numbers in [0, 1); the first number is random, so that answers cannot be guessed.
    """

    def __init__(self, rng: Callable[[], float]) -> None:
        self._sequence = int(rng() * UINT32_MAX)
        self._probes: dict[int, PendingProbe] = {}
        self._timers: TimerQueue[int] = TimerQueue()
        self._relays: dict[int, Relay] = {}
        self._relay_timers: TimerQueue[int] = TimerQueue()
        self._relay_rate = TokenBucket(limits.RELAYS_PER_SECOND, limits.RELAYS_PER_SECOND)
        self._rtt = limits.PROBE_RTT_FIRST
        self._deviation = limits.PROBE_RTT_FIRST / 2
        self._sync: tuple[bytes, float] | None = None

    @property
    def timeout(self) -> float:
        """Seconds in which an answer comes, if it comes."""
        wanted = self._rtt + 4 * self._deviation
        return min(max(wanted, limits.PROBE_TIMEOUT_MIN), limits.PROBE_TIMEOUT_MAX)

    def measured(self, rtt: float) -> None:
        """Take in one measured round trip."""
        self._deviation += (abs(rtt - self._rtt) - self._deviation) / 4
        self._rtt += (rtt - self._rtt) / 8

    def begin(self, member: Member, now: float, factor: float) -> int:
        """Begin a probe; return its number. ``factor`` prolongs its time-outs."""
        sequence = self._next_sequence()
        timeout = self.timeout
        if member.rtt is not None:
            timeout = min(max(timeout, 3 * member.rtt), limits.PROBE_TIMEOUT_MAX)
        self._probes[sequence] = PendingProbe(member.guid.place, member.run, now, timeout * factor)
        self._timers.set(sequence, now + timeout * factor)
        return sequence

    def ask(self, sequence: int, asked: int, now: float) -> None:
        """Record that ``asked`` other members were asked to probe too; their answers may take longer."""
        probe = self._probes[sequence]
        probe.asked = asked
        self._timers.set(sequence, now + probe.timeout * limits.INDIRECT_TIMEOUT_FACTOR)

    def get(self, sequence: int) -> PendingProbe | None:
        """The probe with a number, while it waits."""
        return self._probes.get(sequence)

    def nack(self, sequence: int) -> None:
        """Record that one of the members that were asked had no answer either."""
        probe = self._probes.get(sequence)
        if probe is not None:
            probe.nacks += 1

    def end(self, sequence: int) -> None:
        """A probe was answered, or is given up."""
        self._probes.pop(sequence, None)
        self._timers.set(sequence, None)

    def begin_relay(self, target: Member, number: int, source: Address, now: float) -> int | None:
        """Begin a probe for another member; return its number, ``None`` if there is no room for it."""
        if len(self._relays) >= limits.RELAYS_MAX or not self._relay_rate.take(now):
            return None
        sequence = self._next_sequence()
        self._relays[sequence] = target.guid.place, number, target.guid, target.run, source
        self._relay_timers.set(sequence, now + self.timeout)
        return sequence

    def end_relay(self, sequence: int) -> Relay | None:
        """The probe for another member with this number was answered; ``None``: there is none."""
        self._relay_timers.set(sequence, None)
        return self._relays.pop(sequence, None)

    def take_due(self, now: float) -> list[int]:
        """The numbers of the probes whose time-out is over; ``ask`` or ``end`` each."""
        return self._timers.take(now)

    def take_relays(self, now: float) -> list[Relay]:
        """Probes for others that were not answered; they are given up."""
        return [self._relays.pop(sequence) for sequence in self._relay_timers.take(now)]

    def postpone(self, more: float, now: float) -> None:
        """This process did not run for a while: answers may wait to be read."""
        for sequence, probe in self._probes.items():
            probe.at += more
            rest = probe.timeout * (1.0 if probe.asked is None else limits.INDIRECT_TIMEOUT_FACTOR)
            self._timers.set(sequence, max(now + limits.SWIM_LATE_GRACE, min(probe.at, now) + rest))

    def clear(self) -> None:
        """Give up all probes of this agent's own."""
        for sequence in list(self._probes):
            self.end(sequence)

    def next_timer(self) -> float | None:
        """When the next time-out is over; ``None``: never."""
        return earliest(self._timers.next(), self._relay_timers.next())

    def sync_begun(self, run: bytes, now: float) -> None:
        """A comparison of tables was asked of this run."""
        self._sync = run, now

    def sync_answered(self, run: bytes, now: float) -> bool:
        """Whether this run was asked for a comparison lately, and answers for the first time."""
        if self._sync is None or self._sync[0] != run or now - self._sync[1] > limits.SYNC_INTERVAL:
            return False
        self._sync = None
        return True

    def _next_sequence(self) -> int:
        self._sequence = (self._sequence + 1) & UINT32_MAX
        return self._sequence
