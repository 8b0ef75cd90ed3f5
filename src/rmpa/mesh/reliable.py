"""Reliable delivery of one source's messages to one peer, over links that fall and come back.

Sans-I/O. TCP loses nothing while it lasts, so nothing is sent twice on one link and no timer repeats anything. What
was on its way when a link fell is lost. Therefore the sender keeps each message until the receiver has acknowledged
it, and the next link begins behind the last message that the receiver has (its ``position``)::

    offer ──► unsent ──take──► sent ──acknowledged──► gone
                 ▲               │
                 └────suspend────┘        resume(after): what is not behind ``after`` is gone too

A message is received when its last fragment is; one cut in the middle is sent again whole. Messages that the sender
dropped because its bounds were reached show as a gap in the sequence, so the receiver knows exactly how many messages
will never come. That holds for a sender that keeps nothing any more, too (``stop_keeping``): it goes on numbering.

Sequence numbers have 32 bits and wrap (``core.serial_number``). An *epoch* names one run of a numbering: a sender
that was given up is followed by one of another epoch. Methods that run for each message write the serial arithmetic
out.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final, NamedTuple

from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.core.serial_number import SERIAL_HALF, SERIAL_MASK, is_earlier, is_later, serial_add, serial_distance
from rmpa.mesh import limits


class Outgoing(NamedTuple):
    """A message to be sent (a named tuple, which is the fastest to make: there is one for each message).

    Args:
        sequence: Its number, 32 bits.
        stamp_ns: When it came from its publisher, wall clock.
        payload: Its bytes.
    """

    sequence: int
    stamp_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class EndedNumbering:
    """What is known of a sender that was given up: how much its receiver misses, once its position is known.

    Args:
        epoch: Names the numbering.
        confirmed: The receiver has everything up to this message, as far as it has acknowledged.
        highest: The highest sequence that was sent.
        following: The sequence that the next message would have had.
        gaps: Messages lost before ``confirmed``; the receiver has seen these as gaps.
        dropped: (last sequence, count) of gaps between ``confirmed`` and ``highest``, in order: mostly none.
    """

    epoch: int
    confirmed: int
    highest: int
    following: int
    gaps: int
    dropped: tuple[tuple[int, int], ...] = ()

    @property
    def seen_as_gaps(self) -> int:
        """Lost messages that the receiver has seen as gaps, or would have seen as such."""
        return self.gaps + sum(count for _, count in self.dropped)

    def unseen(self, after: int | None = None) -> int:
        """Messages that the receiver misses and does not know of.

        Args:
            after: The last message that it has; ``None``, or one that was never sent: as far as it has acknowledged.
        """
        return serial_distance(self._position(after), self.following - 1)

    def lost(self, after: int | None = None) -> int:
        """All messages of the numbering that the receiver misses; see ``unseen``."""
        ahead = serial_distance(self.confirmed, self._position(after))
        seen = 0
        for sequence, count in self.dropped:
            before = serial_distance(self.confirmed, sequence) - count
            seen += min(max(ahead - before, 0), count)
        return self.gaps + seen + self.unseen(after)

    def _position(self, after: int | None) -> int:
        highest = serial_distance(self.confirmed, self.highest)
        if after is None or serial_distance(self.confirmed, after) > highest:
            return self.confirmed
        return after


class ReliableSender:
    """The sending half: numbers the messages and keeps each until it is acknowledged, within bounds.

    It begins with a link. Beyond a bound the oldest message is dropped; the newest always fits, however large, so at
    most ``max(max_bytes, the newest message)`` is held. A message larger than the window is sent when nothing else is
    in flight.

    Args:
        depth: Messages kept, at least 1.
        max_bytes: Bytes kept.
        window_messages: Messages that may be sent and not acknowledged, at least 1; two or more times
            ``limits.ACK_MESSAGES``, or the sender waits for delayed acknowledgements.
        window_bytes: The same in bytes; two or more times ``limits.ACK_BYTES``.
        epoch: Names this numbering; no other sender of the source to this peer may have had it.
        first: The first message's sequence.
    """

    def __init__(
        self, depth: int, max_bytes: int, window_messages: int, window_bytes: int, epoch: int, *, first: int = 1
    ) -> None:
        if not (0 < depth < SERIAL_HALF and 0 < window_messages < SERIAL_HALF):
            raise LocalProtocolError(f"a depth of {depth} and a window of {window_messages} messages cannot be")
        self._depth = depth
        self._max_bytes = max_bytes
        self._window_messages = window_messages
        self._window_bytes = window_bytes
        self.epoch: Final = epoch
        self.first: Final = first & SERIAL_MASK
        """The first message's sequence, for the receiver's ``begin``."""
        self.overflowed = 0
        """Messages dropped that the receiver did not get; of one that was in flight that is known at ``resume``."""
        self._unsent: deque[Outgoing] = deque()
        self._sent: deque[Outgoing] = deque()
        self._dropped_in_flight: deque[tuple[int, int]] = deque()
        """(sequence, size) of messages dropped after they were sent: it is not known yet whether they arrived. All of
        them are older than those kept, and there are no more than the window allows."""
        self._bytes = 0
        self._in_flight_bytes = 0
        self._linked = True
        self._counting = False
        self._next = self.first
        self._acknowledged = serial_add(first, -1)
        self._highest = self._acknowledged
        """The highest sequence sent over any link, or said to be lost."""

    @property
    def next_sequence(self) -> int:
        """The number that the next message offered will get."""
        return self._next

    @property
    def confirmed(self) -> int:
        """The receiver has everything up to this message, as far as is known."""
        return self._acknowledged

    @property
    def pending(self) -> int:
        """Messages kept."""
        return len(self._sent) + len(self._unsent)

    @property
    def pending_bytes(self) -> int:
        """Bytes kept."""
        return self._bytes

    @property
    def in_flight(self) -> int:
        """Messages sent over the present link and not acknowledged."""
        return len(self._dropped_in_flight) + len(self._sent) if self._linked else 0

    @property
    def idle(self) -> bool:
        """Whether all that was offered has arrived or is lost for good."""
        return not (self._unsent or self._sent or self._dropped_in_flight)

    @property
    def counting(self) -> bool:
        """Whether messages are only counted, until ``resume``."""
        return self._counting

    @property
    def following(self) -> int:
        """The sequence of the message that is sent next: the oldest one that waits, else the next one offered."""
        return self._unsent[0].sequence if self._unsent else self._next

    @property
    def lost(self) -> int:
        """Messages that the receiver will never get; without a link those that may have arrived count too."""
        return self.overflowed if self._linked else self.overflowed + len(self._dropped_in_flight)

    def offer(self, payload: bytes, stamp_ns: int) -> None:
        """Take one more message; it is kept, so it must not be a view of a buffer."""
        if self._counting:
            self._count()
            return
        self._unsent.append(Outgoing(self._next, stamp_ns, payload))
        self._next = self._next + 1 & SERIAL_MASK
        self._bytes += len(payload)
        count = len(self._sent) + len(self._unsent)
        while count > self._depth or (self._bytes > self._max_bytes and count > 1):
            self._drop_oldest()
            count -= 1

    def take(self, most: int | None = None) -> list[Outgoing]:
        """Return the messages that may be sent now, in order; they count as sent. Without a link there are none.

        Args:
            most: How many at most.
        """
        taken: list[Outgoing] = []
        if not self._linked:
            return taken
        room = self._window_messages - len(self._dropped_in_flight) - len(self._sent)
        if most is not None and most < room:
            room = most
        while self._unsent and len(taken) < room:
            message = self._unsent[0]
            size = len(message.payload)
            if self._in_flight_bytes + size > self._window_bytes and (self._sent or self._dropped_in_flight):
                break
            self._sent.append(self._unsent.popleft())
            self._in_flight_bytes += size
            taken.append(message)
        if taken:
            self._sent_up_to(taken[-1].sequence)
        return taken

    def put_back(self) -> None:
        """The last message taken cannot be sent now after all: it is the next one again.

        Raises:
            LocalProtocolError: None is in flight.
        """
        if not self._sent:
            raise LocalProtocolError("no message is under way that could be taken back")
        message = self._sent.pop()
        self._in_flight_bytes -= len(message.payload)
        self._unsent.appendleft(message)

    def acknowledged(self, sequence: int) -> None:
        """The receiver has everything up to ``sequence``; an old acknowledgement, or one without a link, is ignored.

        Raises:
            RemoteProtocolError: No message so late was ever sent.
        """
        ahead = sequence - self._acknowledged & SERIAL_MASK
        if not self._linked or not 0 < ahead < SERIAL_HALF:
            return
        self._check(ahead, sequence, "acknowledges")
        self._forget(ahead)

    def suspend(self) -> None:
        """The link is gone: what was not acknowledged will be sent again. Without effect if repeated."""
        self._unsent.extendleft(reversed(self._sent))
        self._sent.clear()
        self._in_flight_bytes = 0
        self._linked = False

    def stop_keeping(self) -> None:
        """The link has been gone for too long: drop all messages and only count new ones, until ``resume``.

        Raises:
            LocalProtocolError: There is a link.
        """
        if self._linked:
            raise LocalProtocolError("a sender with a link keeps what its receiver has not acknowledged")
        while self._unsent:
            self._drop_oldest()
        self._counting = True

    def ended(self) -> EndedNumbering:
        """What stays known of this sender when it is given up."""
        kept = sorted(
            serial_distance(self._acknowledged, sequence)
            for sequence in (
                *(sequence for sequence, _ in self._dropped_in_flight),
                *(message.sequence for message in (*self._sent, *self._unsent)),
            )
        )
        ahead = serial_distance(self._acknowledged, self._highest)
        dropped = []
        before = 0
        for offset in (*(one for one in kept if one <= ahead), ahead + 1):
            if offset - before > 1:
                dropped.append((serial_add(self._acknowledged, offset - 1), offset - before - 1))
            before = offset
        behind = serial_distance(self._acknowledged, self._next - 1)
        gaps = self.overflowed - (behind - len(kept))
        return EndedNumbering(self.epoch, self._acknowledged, self._highest, self._next, gaps, tuple(dropped))

    def resume(self, after: int) -> None:
        """There is a new link, and the receiver has everything up to ``after``: go on from there.

        Raises:
            RemoteProtocolError: It claims what was never sent, or less than it acknowledged; nothing has changed.
        """
        ahead = serial_distance(self._acknowledged, after)
        self._check(ahead, after, "resumes")
        self.suspend()
        self._forget(ahead)
        self.overflowed += len(self._dropped_in_flight)
        self._dropped_in_flight.clear()
        self._in_flight_bytes = 0
        self._linked = True
        self._counting = False
        # The receiver learns which message follows, and then has all before it, be it as a gap.
        self._sent_up_to(self.following - 1)

    def rewind(self) -> None:
        """The link lost an unknown part of what is in flight: all of it will be sent again.

        The receiver leaves out what it has. What was dropped in flight counts as lost, though it may have arrived.
        """
        if self._linked:
            self.resume(self._acknowledged)

    def _sent_up_to(self, sequence: int) -> None:
        if sequence - self._highest & SERIAL_MASK < SERIAL_HALF:
            self._highest = sequence & SERIAL_MASK

    def _check(self, ahead: int, sequence: int, verb: str) -> None:
        if ahead > self._highest - self._acknowledged & SERIAL_MASK:
            known = f"sent up to {self._highest}, acknowledged up to {self._acknowledged}"
            raise RemoteProtocolError(f"a receiver {verb} message {sequence}, of those {known}")

    def _forget(self, ahead: int) -> None:
        """The next ``ahead`` sequences have arrived: drop their messages.

        Unsent ones may be among them: what an old link still delivered behind the position given to ``resume``.
        """
        base = self._acknowledged
        while self._dropped_in_flight and self._dropped_in_flight[0][0] - base & SERIAL_MASK <= ahead:
            self._in_flight_bytes -= self._dropped_in_flight.popleft()[1]
        while self._sent and self._sent[0].sequence - base & SERIAL_MASK <= ahead:
            size = len(self._sent.popleft().payload)
            self._in_flight_bytes -= size
            self._bytes -= size
        while self._unsent and self._unsent[0].sequence - base & SERIAL_MASK <= ahead:
            self._bytes -= len(self._unsent.popleft().payload)
        self._acknowledged = base + ahead & SERIAL_MASK

    def _count(self) -> None:
        """Count a message that will not be sent; number it unless its number would look like an old one."""
        self.overflowed += 1
        if serial_distance(self._acknowledged, self._next) < SERIAL_HALF - 1:
            self._next = serial_add(self._next, 1)

    def _drop_oldest(self) -> None:
        """Drop the oldest kept message; one in flight stays in the window until it is acknowledged."""
        was_sent = True
        if self._sent:
            message = self._sent.popleft()
        else:
            message = self._unsent.popleft()
            was_sent = not self._linked and not is_earlier(self._highest, message.sequence)
        size = len(message.payload)
        self._bytes -= size
        if was_sent:
            self._dropped_in_flight.append((message.sequence, size))
        else:
            self.overflowed += 1


@dataclass(frozen=True, slots=True)
class ReceiveResult:
    """What to do with a message that came.

    Args:
        deliver: Whether to deliver it; else it was delivered before, or came too late.
        gap: Messages directly before it that will never come.
    """

    deliver: bool
    gap: int = 0


DELIVER: Final = ReceiveResult(deliver=True)
"""Deliver it; nothing is missing before it."""
DUPLICATE: Final = ReceiveResult(deliver=False)
"""Do not deliver it."""


class ReliableReceiver:
    """The receiving half: each message once, in order, with the exact number of those that never come.

    It outlives links. Only ``begin`` changes its epoch: a message of another epoch, over a link that is about to be
    closed, is a duplicate. Without the sender's first sequence no gap is reported before the first message.

    Args:
        epoch: The sender's, if known; else the first message's is taken.
        first: The sender's first sequence, if known.
    """

    def __init__(self, epoch: int | None = None, first: int | None = None) -> None:
        self._epoch = epoch
        self._next = first
        self._unacknowledged = 0
        self._unacknowledged_bytes = 0
        self._unacknowledged_since = 0.0
        self.gap_total = 0
        """Messages that will never come, of all epochs."""
        self.duplicates = 0
        """Messages that came again or too late, and were not delivered."""
        self.breaks = 0
        """Times that an epoch followed another one: how many messages were lost in between is unknown."""

    def position(self) -> tuple[int, int] | None:
        """Epoch and last sequence that came, for the sender's ``resume``; ``None`` if there is nothing to resume."""
        if self._epoch is None or self._next is None:
            return None
        return self._epoch, serial_add(self._next, -1)

    def begin(self, epoch: int, first: int | None = None) -> bool:
        """A sender announces its epoch, and its first sequence.

        Returns:
            Whether no messages are lost uncounted: it goes on with the present epoch, or is the first one at all.
        """
        if epoch == self._epoch:
            if self._next is None:
                self._next = first
            return True
        known = self._epoch is not None
        self._epoch, self._next = epoch, first
        self._unacknowledged = self._unacknowledged_bytes = 0
        self.breaks += known
        return not known

    def skip(self, following: int) -> int:
        """The sender announces which message comes next; return how many before it will never come."""
        if self._next is None or not is_later(following, self._next):
            return 0
        gap = serial_distance(self._next, following)
        self._next = following
        self.gap_total += gap
        return gap

    def judge(self, sequence: int, epoch: int) -> ReceiveResult:
        """What ``accept`` would return, for a message's first fragment; nothing changes before its last one."""
        if epoch != self._epoch:
            return DELIVER if self._epoch is None else DUPLICATE
        gap = 0 if self._next is None else sequence - self._next & SERIAL_MASK
        if not gap:
            return DELIVER
        return DUPLICATE if gap >= SERIAL_HALF else ReceiveResult(deliver=True, gap=gap)

    def accept(self, sequence: int, epoch: int, now: float, size: int = 0) -> ReceiveResult:
        """A whole message of ``size`` bytes has come at ``now``, in monotonic seconds."""
        if epoch != self._epoch:
            if self._epoch is not None:
                self.duplicates += 1
                return DUPLICATE
            self._epoch = epoch
        gap = 0 if self._next is None else sequence - self._next & SERIAL_MASK
        if not self._unacknowledged:
            self._unacknowledged_since = now
        self._unacknowledged += 1
        self._unacknowledged_bytes += size
        if gap >= SERIAL_HALF:
            self.duplicates += 1
            return DUPLICATE
        self._next = sequence + 1 & SERIAL_MASK
        if not gap:
            return DELIVER
        self.gap_total += gap
        return ReceiveResult(deliver=True, gap=gap)

    def due_ack(self, now: float) -> int | None:
        """The sequence to acknowledge now, up to which all has come; it counts as acknowledged. ``None``: not yet."""
        due = self.next_timer()
        if due is None or now < due or self._next is None:
            return None
        self._unacknowledged = self._unacknowledged_bytes = 0
        return self._next - 1 & SERIAL_MASK

    def next_timer(self) -> float | None:
        """When ``due_ack`` will have something, in monotonic seconds."""
        if not self._unacknowledged:
            return None
        if self._unacknowledged >= limits.ACK_MESSAGES or self._unacknowledged_bytes >= limits.ACK_BYTES:
            return self._unacknowledged_since
        return self._unacknowledged_since + limits.ACK_DELAY
