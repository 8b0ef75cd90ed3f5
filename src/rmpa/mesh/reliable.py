"""Reliable delivery of one source's messages to one peer, over links that fall and come back.

Sans-I/O. A TCP connection loses nothing while it lasts, so nothing is sent twice on one link and no timer repeats
anything. The bytes in flight are lost when a link falls. Therefore the sender keeps each message until the receiver
has acknowledged it, and the next link begins after the last message that the receiver has (its ``position``)::

    offer ──► unsent ──take──► sent ──acknowledged──► gone
                 ▲               │
                 └────suspend────┘        resume(after): messages up to ``after`` are gone too

A message counts as received when its last fragment is received; a message that was cut off is sent again from its
start. Messages that the sender dropped at its bounds show as a gap in the sequence, so the receiver knows exactly how
many messages will never arrive.

Sequence numbers have 32 bits and wrap (``core.identity``). The numbers are those of the stream, not of the path: an
*epoch* identifies one numbering of one publisher's messages, at its origin, and each sender of them uses it, so a
receiver may go on over another path. Methods that run for each message contain the serial arithmetic inline, for
speed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterable
from itertools import islice
from typing import Final, Generic, NamedTuple, TypeVar

from rmpa.core.identity import SERIAL_HALF, SERIAL_MASK, is_earlier, is_later, serial_add, serial_distance
from rmpa.mesh import limits

# The longest delay of an acknowledgement after the first message that it covers. The sender of few messages keeps
# them in memory for this much longer.
ACK_DELAY: Final = 0.010


class Outgoing(NamedTuple):
    """A message to be sent. One is made for each message, so it is a named tuple, which is the fastest to make.

    Args:
        sequence: Its number, 32 bits.
        stamp_ns: When it was received from its publisher, wall clock, nanoseconds.
        payload: Its bytes.
    """

    sequence: int
    stamp_ns: int
    payload: bytes


class ReliableSender:
    """The sending half: numbers the messages and keeps each until it is acknowledged, within bounds.

    A new sender has a link. Beyond a bound the oldest message is dropped; the newest always fits, however large, so
    at most ``max(max_bytes, newest message)`` bytes are kept. A message larger than the window is sent when nothing
    else is in flight.

    Args:
        depth: Messages kept, at least 1.
        max_bytes: Bytes kept.
        window_messages: Messages that may be sent and not acknowledged, at least 1. It should be at least twice
            ``limits.ACK_MESSAGES``; otherwise the sender waits for delayed acknowledgements.
        window_bytes: Bytes that may be sent and not acknowledged; it should be at least twice ``limits.ACK_BYTES``.
        epoch: The epoch of this numbering.
        first: The first message's sequence.

    Attributes:
        overflowed: The number of dropped messages that the receiver did not get. A message that was dropped in flight
            is added at ``resume``, if it did not arrive.
        pending_bytes: The number of bytes kept.
        confirmed: The last message that is known to have arrived, with all messages before it.
    """

    def __init__(
        self, depth: int, max_bytes: int, window_messages: int, window_bytes: int, epoch: int, *, first: int = 1
    ) -> None:
        self._depth = depth
        self._max_bytes = max_bytes
        self._window_messages = window_messages
        self._window_bytes = window_bytes
        self.epoch: Final = epoch
        self.first: Final = first & SERIAL_MASK
        self.overflowed = 0
        self._unsent: deque[Outgoing] = deque()
        self._sent: deque[Outgoing] = deque()
        # ``(sequence, size)`` of the messages that were dropped after they were sent, and may have arrived. All of
        # them are older than the kept messages, and the window bounds their number.
        self._dropped_in_flight: deque[tuple[int, int]] = deque()
        self.pending_bytes = 0
        self._in_flight_bytes = 0
        self._linked = True
        self._next = self.first
        self.confirmed = serial_add(first, -1)
        # The highest sequence that was sent over any link, or reported as lost.
        self._highest = self.confirmed

    @property
    def last(self) -> int:
        """The sequence of the last offered message."""
        return serial_add(self._next, -1)

    @property
    def pending(self) -> int:
        """The number of messages kept."""
        return len(self._sent) + len(self._unsent)

    @property
    def idle(self) -> bool:
        """Whether every offered message has arrived or is lost for good."""
        return not (self._unsent or self._sent or self._dropped_in_flight)

    @property
    def following(self) -> int:
        """The sequence of the message that is sent next: of the oldest waiting one, or of the next one offered."""
        return self._unsent[0].sequence if self._unsent else self._next

    @property
    def lost(self) -> int:
        """The number of messages that the receiver will never get.

        Without a link, messages that were dropped in flight count too, although they may have arrived.
        """
        return self.overflowed if self._linked else self.overflowed + len(self._dropped_in_flight)

    def offer(self, payload: bytes, stamp_ns: int) -> None:
        """Queue one more message. The payload is kept, so it must not be a view of a buffer that changes."""
        self._unsent.append(Outgoing(self._next, stamp_ns, payload))
        self._next = self._next + 1 & SERIAL_MASK
        self.pending_bytes += len(payload)
        count = len(self._sent) + len(self._unsent)
        while count > self._depth or (self.pending_bytes > self._max_bytes and count > 1):
            self._drop_oldest()
            count -= 1

    def skip(self, sequence: int) -> None:
        """Give the next message this sequence: those before it were lost on the way here, and show as a gap."""
        if is_later(sequence, self._next):
            self._next = sequence

    def take(self) -> Outgoing | None:
        """Return the next message if it may be sent now, and count it as sent; without a link none may."""
        in_flight = len(self._dropped_in_flight) + len(self._sent)
        if not self._linked or not self._unsent or in_flight >= self._window_messages:
            return None
        size = len(self._unsent[0].payload)
        if in_flight and self._in_flight_bytes + size > self._window_bytes:
            return None
        message = self._unsent.popleft()
        self._sent.append(message)
        self._in_flight_bytes += size
        self._sent_up_to(message.sequence)
        return message

    def put_back(self) -> None:
        """Undo the ``take`` of the last message, which could not be sent: it is the next one again."""
        message = self._sent.pop()
        self._in_flight_bytes -= len(message.payload)
        self._unsent.appendleft(message)

    def acknowledged(self, sequence: int) -> None:
        """Handle an acknowledgement of all messages up to ``sequence``; ignored if it is old or there is no link.

        The receiver may have more than was sent here, by another path.
        """
        ahead = sequence - self.confirmed & SERIAL_MASK
        if self._linked and 0 < ahead < SERIAL_HALF:
            self._forget(min(ahead, self._highest - self.confirmed & SERIAL_MASK))

    def suspend(self) -> None:
        """Handle the end of the link: unacknowledged messages will be sent again. Without effect if repeated."""
        self._unsent.extendleft(reversed(self._sent))
        self._sent.clear()
        self._in_flight_bytes = 0
        self._linked = False

    def resume(self, after: int) -> None:
        """Continue over a new link after the last message that the receiver has.

        Args:
            after: The receiver's position: it has all messages up to this sequence, perhaps by another path. One from
                before the last acknowledgement is old.
        """
        ahead = serial_distance(self.confirmed, after)
        self.suspend()
        if ahead < SERIAL_HALF:
            self._forget(min(ahead, serial_distance(self.confirmed, self.last)))
        self._sent_up_to(self.confirmed)
        self.overflowed += len(self._dropped_in_flight)
        self._dropped_in_flight.clear()
        self._in_flight_bytes = 0
        self._linked = True
        # The receiver is told which message follows; all messages before it have arrived or show as a gap.
        self._sent_up_to(self.following - 1)

    def rewind(self) -> None:
        """Send all messages in flight again, because the link lost an unknown part of them.

        The receiver ignores the messages that it has. Messages that were dropped in flight count as lost, although
        they may have arrived.
        """
        if self._linked:
            self.resume(self.confirmed)

    def _sent_up_to(self, sequence: int) -> None:
        if sequence - self._highest & SERIAL_MASK < SERIAL_HALF:
            self._highest = sequence & SERIAL_MASK

    def _forget(self, ahead: int) -> None:
        """Drop the messages of the next ``ahead`` sequences, which have arrived.

        They may include unsent messages that the old link delivered after the receiver had reported its position.
        """
        base = self.confirmed
        while self._dropped_in_flight and self._dropped_in_flight[0][0] - base & SERIAL_MASK <= ahead:
            self._in_flight_bytes -= self._dropped_in_flight.popleft()[1]
        while self._sent and self._sent[0].sequence - base & SERIAL_MASK <= ahead:
            size = len(self._sent.popleft().payload)
            self._in_flight_bytes -= size
            self.pending_bytes -= size
        while self._unsent and self._unsent[0].sequence - base & SERIAL_MASK <= ahead:
            self.pending_bytes -= len(self._unsent.popleft().payload)
        self.confirmed = base + ahead & SERIAL_MASK

    def _drop_oldest(self) -> None:
        """Drop the oldest kept message; if it is in flight, it counts against the window until it is acknowledged."""
        was_sent = True
        if self._sent:
            message = self._sent.popleft()
        else:
            message = self._unsent.popleft()
            was_sent = not self._linked and not is_earlier(self._highest, message.sequence)
        size = len(message.payload)
        self.pending_bytes -= size
        if was_sent:
            self._dropped_in_flight.append((message.sequence, size))
        else:
            self.overflowed += 1


class HistoryCache:
    """The last messages of one stream, for receivers that come later, or come back by another path.

    Attributes:
        latched: How many messages are kept for late receivers, whatever their size.
        depth: How many are kept for receivers that have those before, within ``limits.HISTORY_BYTES``.
    """

    def __init__(self) -> None:
        self.latched = self.depth = 0
        self._kept: deque[Outgoing] = deque()
        self._bytes = 0

    def append(self, sequence: int, stamp_ns: int, payload: bytes) -> None:
        """Keep one more message, and drop those beyond the bounds."""
        self._kept.append(Outgoing(sequence, stamp_ns, payload))
        self._bytes += len(payload)
        while (count := len(self._kept)) > self.latched and (
            count > self.depth or self._bytes > limits.HISTORY_BYTES
        ):
            self._bytes -= len(self._kept.popleft().payload)

    def newest(self, count: int) -> list[Outgoing]:
        """The last messages, at most ``count``, the oldest first."""
        return list(islice(self._kept, max(0, len(self._kept) - count), None))

    def after(self, sequence: int) -> list[Outgoing]:
        """The messages that are kept of those behind ``sequence``, the oldest first."""
        return [message for message in self._kept if is_later(message.sequence, sequence)]

    def clear(self) -> None:
        """Free the messages, which may be large."""
        self._kept.clear()
        self._bytes = 0


class ReliableReceiver:
    """The receiving half: accepts each message once, in order, and counts exactly the messages that never arrive.

    It outlives links. Only ``begin`` changes its epoch: a message of another epoch, received over a link that is
    about to be closed, is not a new one. If the sender's first sequence is not known, no gap is reported before the
    first message.

    Args:
        epoch: The sender's, if known; else the first message's is taken.
        first: The sender's first sequence, if known.

    Attributes:
        next: The sequence that comes next; a receiver that takes a message with this one by itself adds 1.
        complete: Whether the publisher has gone, and ``next`` is behind its last message.
    """

    def __init__(self, epoch: int | None = None, first: int | None = None) -> None:
        self._epoch = epoch
        self.next = first
        self.complete = False
        self._unacknowledged = 0
        self._unacknowledged_bytes = 0
        self._unacknowledged_since = 0.0

    def position(self) -> tuple[int, int] | None:
        """``(epoch, last received sequence)`` for the sender's ``resume``; ``None`` if there is nothing to resume."""
        if self._epoch is None or self.next is None:
            return None
        return self._epoch, serial_add(self.next, -1)

    def begin(self, epoch: int, first: int | None = None) -> None:
        """Handle a sender's announcement of its epoch and first sequence."""
        if epoch != self._epoch:
            self._epoch, self.next = epoch, first
            self._unacknowledged = self._unacknowledged_bytes = 0
        elif self.next is None:
            self.next = first

    def skip(self, following: int) -> int:
        """Handle a sender's announcement of its next message; return how many before it will never arrive."""
        if self.next is None or not is_later(following, self.next):
            return 0
        gap = serial_distance(self.next, following)
        self.next = following
        return gap

    def gap(self, sequence: int, epoch: int) -> int | None:
        """Return what ``accept`` would, without changing anything: for the first fragment of a message."""
        if epoch != self._epoch and self._epoch is not None:
            return None
        gap = 0 if self.next is None else sequence - self.next & SERIAL_MASK
        return gap if gap < SERIAL_HALF else None

    def accept(self, sequence: int, epoch: int, now: float, size: int = 0) -> int | None:
        """Take in a complete message of ``size`` bytes, received at ``now`` (monotonic seconds).

        Returns:
            The number of messages directly before it that will never arrive; ``None``: it is not to be delivered,
            because it was delivered before, or arrived too late.
        """
        gap = self.gap(sequence, epoch)
        if self._epoch is None:
            self._epoch = epoch
        if epoch == self._epoch:
            if not self._unacknowledged:
                self._unacknowledged_since = now
            self._unacknowledged += 1
            self._unacknowledged_bytes += size
        if gap is not None:
            self.next = sequence + 1 & SERIAL_MASK
        return gap

    def due_ack(self, now: float) -> int | None:
        """The sequence to acknowledge now, which then counts as acknowledged; ``None`` if no acknowledgement is due.

        All messages up to this sequence have arrived or are known to be lost.
        """
        due = self.next_timer()
        if due is None or now < due or self.next is None:
            return None
        self._unacknowledged = self._unacknowledged_bytes = 0
        return self.next - 1 & SERIAL_MASK

    def next_timer(self) -> float | None:
        """When the next acknowledgement is due, in monotonic seconds; ``None``: nothing is to be acknowledged."""
        if not self._unacknowledged:
            return None
        if self._unacknowledged >= limits.ACK_MESSAGES or self._unacknowledged_bytes >= limits.ACK_BYTES:
            return self._unacknowledged_since
        return self._unacknowledged_since + ACK_DELAY


_Key = TypeVar("_Key", bound=Hashable)


class ResumeTable(Generic[_Key]):
    """Suspended senders by their key, which names the receiver and the source; pure.

    Each sender stays for a time of its own. At most ``limits.RESUMES_MAX`` senders stay, with
    ``limits.RESUME_BYTES_MAX`` bytes together: beyond a bound the sender that was parked longest leaves the table.
    While a sender is parked, its messages are offered by ``offer`` of this table.

    Attributes:
        pending_bytes: Bytes kept by all parked senders.
    """

    def __init__(self) -> None:
        # The senders, and when each leaves the table; the one that was parked longest first.
        self._parked: dict[_Key, tuple[ReliableSender, float]] = {}
        self.pending_bytes = 0

    def __len__(self) -> int:
        return len(self._parked)

    def park(self, key: _Key, sender: ReliableSender, until: float) -> list[_Key]:
        """Suspend a sender and keep its messages for a while; one already parked under this key is replaced.

        Args:
            key: Its receiver and source.
            sender: The sender.
            until: When it leaves the table, monotonic seconds.

        Returns:
            The keys of senders that left the table for it; its own, if it is too large for the table.
        """
        sender.suspend()
        self.claim(key)
        self._parked[key] = sender, until
        self.pending_bytes += sender.pending_bytes
        return self._shrink()

    def offer(self, key: _Key, payload: bytes, stamp_ns: int) -> list[_Key]:
        """Offer a message to a parked sender; without effect if there is none.

        Returns:
            The keys of senders that left the table for it.
        """
        if key not in self._parked:
            return []
        sender, _ = self._parked[key]
        before = sender.pending_bytes
        sender.offer(payload, stamp_ns)
        self.pending_bytes += sender.pending_bytes - before
        return self._shrink()

    def claim(self, key: _Key) -> ReliableSender | None:
        """Take out a sender, still suspended; ``None`` if there is none."""
        if key not in self._parked:
            return None
        sender, _ = self._parked.pop(key)
        self.pending_bytes -= sender.pending_bytes
        return sender

    def limit(self, keys: Iterable[_Key], until: float) -> None:
        """Let the parked senders of these keys leave the table at ``until``, if not before."""
        for key in keys:
            if key in self._parked:
                sender, before = self._parked[key]
                self._parked[key] = sender, min(before, until)

    def expire(self, now: float) -> list[_Key]:
        """Take out the senders whose time is over; return their keys."""
        keys = [key for key, (_, until) in self._parked.items() if until <= now]
        for key in keys:
            self.claim(key)
        return keys

    def next_timer(self) -> float | None:
        """When ``expire`` is due, in monotonic seconds."""
        return min((until for _, until in self._parked.values()), default=None)

    def _shrink(self) -> list[_Key]:
        keys = []
        while len(self._parked) > limits.RESUMES_MAX or self.pending_bytes > limits.RESUME_BYTES_MAX:
            keys.append(next(iter(self._parked)))
            self.claim(keys[-1])
        return keys
