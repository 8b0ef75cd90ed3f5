"""Reliable delivery of one source's messages to one peer, over links that fall and come back.

Sans-I/O. TCP loses nothing while it lasts, so nothing is sent twice on one link and no timer repeats anything. What
a link took with it when it fell is what this is about: the sender keeps each message until the other side has
acknowledged it; the next link begins behind the last message that the receiver has (its ``position``)::

    offer ──► unsent ──take──► sent ──acknowledged──► gone
                 ▲               │
                 └────suspend────┘        resume(after): what is not behind ``after`` is gone too

A message is received when its last fragment is; one cut in the middle is sent again whole. What the sender had to
drop because its bounds were reached shows as a jump of the sequence, so the receiver knows exactly how many
messages will never come. That holds for a sender that keeps nothing any more, too (``forgo``): it goes on numbering.

Sequence numbers have 32 bits and wrap; they are compared as in RFC 1982: of two, the later one is less than 2³¹
ahead. An *epoch* names one run of a numbering: a sender that was given up is followed by one of another epoch.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Final, Generic, NamedTuple, TypeVar

from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.mesh import limits

_MASK: Final = 0xFFFFFFFF
_HALF: Final = 1 << 31


class Outgoing(NamedTuple):
    """A message to be sent (a tuple, for one is made for each message).

    Args:
        sequence: Its number, 32 bits.
        stamp_ns: When it came from its publisher, by the wall clock.
        payload: Its bytes.
    """

    sequence: int
    stamp_ns: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class EndedNumbering:
    """What is left of a sender that was given up: what that costs its receiver, once its position is known.

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
    def told(self) -> int:
        """Messages lost that the receiver has seen as gaps, or was to see as such."""
        return self.gaps + sum(count for _, count in self.dropped)

    def untold(self, after: int | None = None) -> int:
        """Messages that the receiver misses and does not know of.

        Args:
            after: The last message that it has; ``None``, or one that cannot be: as far as it has acknowledged.
        """
        return (self.following - 1 - self._position(after)) & _MASK

    def lost(self, after: int | None = None) -> int:
        """All messages of the numbering that the receiver misses; see ``untold``."""
        ahead = (self._position(after) - self.confirmed) & _MASK
        seen = 0
        for sequence, count in self.dropped:
            before = ((sequence - self.confirmed) & _MASK) - count
            seen += min(max(ahead - before, 0), count)
        return self.gaps + seen + self.untold(after)

    def _position(self, after: int | None) -> int:
        if after is None or (after - self.confirmed) & _MASK > (self.highest - self.confirmed) & _MASK:
            return self.confirmed
        return after


class ReliableSender:
    """The sending half: numbers the messages and keeps each until it is acknowledged, within bounds.

    It begins with a link. Beyond a bound the oldest message is dropped; the newest always fits, however large, so
    at most ``max(max_bytes, the newest message)`` is held. A message larger than the window goes when nothing
    else is under way.

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
        if not (0 < depth < _HALF and 0 < window_messages < _HALF):
            raise LocalProtocolError(f"a depth of {depth} and a window of {window_messages} messages cannot be")
        self._depth = depth
        self._max_bytes = max_bytes
        self._window_messages = window_messages
        self._window_bytes = window_bytes
        self.epoch: Final = epoch
        self.first: Final = first & _MASK
        """The first message's sequence, for the receiver's ``begin``."""
        self.overflowed = 0
        """Messages dropped that the receiver did not get; of one that was under way it is known by ``resume``."""
        self._unsent: deque[Outgoing] = deque()
        self._sent: deque[Outgoing] = deque()
        self._doubtful: deque[tuple[int, int]] = deque()
        """(sequence, size) of messages dropped after they were sent: it is not known yet whether they arrived.
        All of them are older than those kept, and there are no more than the window allows."""
        self._bytes = 0
        self._under_way_bytes = 0
        self._linked = True
        self._forgone = False
        self._next = self.first
        self._acknowledged = (first - 1) & _MASK
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
    def under_way(self) -> int:
        """Messages sent over the present link and not acknowledged."""
        return len(self._doubtful) + len(self._sent) if self._linked else 0

    @property
    def idle(self) -> bool:
        """Whether all that was offered has arrived or is lost for good."""
        return not (self._unsent or self._sent or self._doubtful)

    @property
    def forgone(self) -> bool:
        """Whether messages are only counted, until ``resume``."""
        return self._forgone

    @property
    def following(self) -> int:
        """The sequence of the next message that will be sent: of the oldest one that waits, else of the next one."""
        return self._unsent[0].sequence if self._unsent else self._next

    @property
    def lost(self) -> int:
        """Messages that the receiver will never get; without a link those count that may have arrived."""
        return self.overflowed if self._linked else self.overflowed + len(self._doubtful)

    def offer(self, payload: bytes, stamp_ns: int) -> None:
        """Take one more message; it is kept, so it must not be a view into a buffer."""
        if self._forgone:
            self._count()
            return
        self._unsent.append(Outgoing(self._next, stamp_ns, payload))
        self._next = (self._next + 1) & _MASK
        self._bytes += len(payload)
        count = len(self._sent) + len(self._unsent)
        while count > self._depth or (self._bytes > self._max_bytes and count > 1):
            self._drop_oldest()
            count -= 1

    def take(self, most: int | None = None) -> list[Outgoing]:
        """What may be sent now, in order: it counts as sent; none without a link.

        Args:
            most: How many at the most.
        """
        taken: list[Outgoing] = []
        if not self._linked:
            return taken
        room = self._window_messages - len(self._doubtful) - len(self._sent)
        if most is not None and most < room:
            room = most
        while self._unsent and len(taken) < room:
            message = self._unsent[0]
            size = len(message.payload)
            if self._under_way_bytes + size > self._window_bytes and (self._sent or self._doubtful):
                break
            self._sent.append(self._unsent.popleft())
            self._under_way_bytes += size
            taken.append(message)
        if taken:
            self._sent_up_to(taken[-1].sequence)
        return taken

    def untake(self) -> None:
        """The last one taken cannot be sent now after all: it is the next one again.

        Raises:
            LocalProtocolError: None is under way.
        """
        if not self._sent:
            raise LocalProtocolError("no message is under way that could be taken back")
        message = self._sent.pop()
        self._under_way_bytes -= len(message.payload)
        self._unsent.appendleft(message)

    def acknowledged(self, sequence: int) -> None:
        """The receiver has everything up to ``sequence``; an old acknowledgement, or one without a link, is ignored.

        Raises:
            RemoteProtocolError: Nothing so late was ever sent.
        """
        ahead = (sequence - self._acknowledged) & _MASK
        if not self._linked or not 0 < ahead < _HALF:
            return
        self._check(ahead, sequence, "acknowledges")
        self._forget(ahead)

    def suspend(self) -> None:
        """The link is gone: everything that was not acknowledged is to be sent again. Without effect if repeated."""
        self._unsent.extendleft(reversed(self._sent))
        self._sent.clear()
        self._under_way_bytes = 0
        self._linked = False

    def forgo(self) -> None:
        """The link has been gone for too long: let go of everything, and only count what comes, until ``resume``.

        Raises:
            LocalProtocolError: There is a link.
        """
        if self._linked:
            raise LocalProtocolError("a sender with a link keeps what its receiver has not acknowledged")
        while self._unsent:
            self._drop_oldest()
        self._forgone = True

    def ended(self) -> EndedNumbering:
        """What is left of this sender when it is given up."""
        kept = sorted(
            (sequence - self._acknowledged) & _MASK
            for sequence in (
                *(sequence for sequence, _ in self._doubtful),
                *(message.sequence for message in (*self._sent, *self._unsent)),
            )
        )
        ahead = (self._highest - self._acknowledged) & _MASK
        dropped = []
        before = 0
        for offset in (*(one for one in kept if one <= ahead), ahead + 1):
            if offset - before > 1:
                dropped.append(((self._acknowledged + offset - 1) & _MASK, offset - before - 1))
            before = offset
        behind = (self._next - 1 - self._acknowledged) & _MASK
        gaps = self.overflowed - (behind - len(kept))
        return EndedNumbering(self.epoch, self._acknowledged, self._highest, self._next, gaps, tuple(dropped))

    def resume(self, after: int) -> None:
        """There is a new link, and the receiver has everything up to ``after``: go on from there.

        Raises:
            RemoteProtocolError: It claims what was never sent, or less than it acknowledged; nothing has changed.
        """
        ahead = (after - self._acknowledged) & _MASK
        self._check(ahead, after, "resumes")
        self.suspend()
        self._forget(ahead)
        self.overflowed += len(self._doubtful)
        self._doubtful.clear()
        self._under_way_bytes = 0
        self._linked = True
        self._forgone = False
        # The receiver is told which message follows, and then has all up to it, be it as a gap.
        self._sent_up_to(self.following - 1)

    def rewind(self) -> None:
        """The link lost a part of what is under way, nobody knows which: all of it is to be sent again.

        The receiver leaves out what it has. What was dropped under way counts as lost, though it may have arrived.
        """
        if self._linked:
            self.resume(self._acknowledged)

    def _sent_up_to(self, sequence: int) -> None:
        if (sequence - self._highest) & _MASK < _HALF:
            self._highest = sequence & _MASK

    def _check(self, ahead: int, sequence: int, verb: str) -> None:
        if ahead > (self._highest - self._acknowledged) & _MASK:
            known = f"sent up to {self._highest}, acknowledged up to {self._acknowledged}"
            raise RemoteProtocolError(f"a receiver {verb} message {sequence}, of those {known}")

    def _forget(self, ahead: int) -> None:
        """The next ``ahead`` sequences have arrived.

        Unsent ones may be among them: what an old link still brought behind the position that ``resume`` was told.
        """
        base = self._acknowledged
        while self._doubtful and (self._doubtful[0][0] - base) & _MASK <= ahead:
            self._under_way_bytes -= self._doubtful.popleft()[1]
        while self._sent and (self._sent[0].sequence - base) & _MASK <= ahead:
            size = len(self._sent.popleft().payload)
            self._under_way_bytes -= size
            self._bytes -= size
        while self._unsent and (self._unsent[0].sequence - base) & _MASK <= ahead:
            self._bytes -= len(self._unsent.popleft().payload)
        self._acknowledged = (base + ahead) & _MASK

    def _count(self) -> None:
        """One more message that will not be sent; numbered, unless the receiver could not tell it from an old one."""
        self.overflowed += 1
        if (self._next - self._acknowledged) & _MASK < _HALF - 1:
            self._next = (self._next + 1) & _MASK

    def _drop_oldest(self) -> None:
        """Let go of the oldest kept message; one under way stays in the window until it is acknowledged."""
        was_sent = True
        if self._sent:
            message = self._sent.popleft()
        else:
            message = self._unsent.popleft()
            was_sent = not self._linked and (self._highest - message.sequence) & _MASK < _HALF
        size = len(message.payload)
        self._bytes -= size
        if was_sent:
            self._doubtful.append((message.sequence, size))
        else:
            self.overflowed += 1


@dataclass(frozen=True, slots=True)
class ReceiveResult:
    """What to do with a message that came.

    Args:
        deliver: Whether to hand it on; else it was handed on before, or came too late.
        gap: Messages directly before it that will never come.
    """

    deliver: bool
    gap: int = 0


DELIVER: Final = ReceiveResult(deliver=True)
"""Hand it on; nothing is missing before it."""
DUPLICATE: Final = ReceiveResult(deliver=False)
"""Do not hand it on."""


class ReliableReceiver:
    """The receiving half: each message once, in order, with the exact number of those that never come.

    It outlives links. Only ``begin`` changes its epoch: what still comes of another one, over a link that is about to
    be closed, is a duplicate. Without the sender's first sequence no gap is claimed before the first message.

    Args:
        epoch: The sender's, if known; else the first message's is taken.
        first: The sender's first sequence, if known.
    """

    def __init__(self, epoch: int | None = None, first: int | None = None) -> None:
        self._epoch = epoch
        self._next = first
        self._owed = 0
        self._owed_bytes = 0
        self._owed_since = 0.0
        self.gap_total = 0
        """Messages that will never come, of all epochs."""
        self.duplicates = 0
        """Messages that came again or too late, and were not handed on."""
        self.breaks = 0
        """Times that an epoch followed another one: how many messages were lost in between is unknown."""

    def position(self) -> tuple[int, int] | None:
        """Epoch and last sequence that came, for the sender's ``resume``; ``None`` if there is nothing to resume."""
        if self._epoch is None or self._next is None:
            return None
        return self._epoch, (self._next - 1) & _MASK

    def begin(self, epoch: int, first: int | None = None) -> bool:
        """A sender says its epoch, and its first sequence.

        Returns:
            Whether nothing is lost unseen: it goes on with the present epoch, or is the first one at all.
        """
        if epoch == self._epoch:
            if self._next is None:
                self._next = first
            return True
        known = self._epoch is not None
        self._epoch, self._next = epoch, first
        self._owed = self._owed_bytes = 0
        self.breaks += known
        return not known

    def skip(self, following: int) -> int:
        """The sender says which message comes next; return how many before it will never come."""
        gap = 0 if self._next is None else (following - self._next) & _MASK
        if not 0 < gap < _HALF:
            return 0
        self._next = following
        self.gap_total += gap
        return gap

    def judge(self, sequence: int, epoch: int) -> ReceiveResult:
        """What ``accept`` would say, at a message's first fragment; nothing changes until its last one has come."""
        if epoch != self._epoch:
            return DELIVER if self._epoch is None else DUPLICATE
        gap = 0 if self._next is None else (sequence - self._next) & _MASK
        if not gap:
            return DELIVER
        return DUPLICATE if gap >= _HALF else ReceiveResult(deliver=True, gap=gap)

    def accept(self, sequence: int, epoch: int, now: float, size: int = 0) -> ReceiveResult:
        """A whole message of ``size`` bytes has come at ``now``, in monotonic seconds."""
        if epoch != self._epoch:
            if self._epoch is not None:
                self.duplicates += 1
                return DUPLICATE
            self._epoch = epoch
        gap = 0 if self._next is None else (sequence - self._next) & _MASK
        if not self._owed:
            self._owed_since = now
        self._owed += 1
        self._owed_bytes += size
        if gap >= _HALF:
            self.duplicates += 1
            return DUPLICATE
        self._next = (sequence + 1) & _MASK
        if not gap:
            return DELIVER
        self.gap_total += gap
        return ReceiveResult(deliver=True, gap=gap)

    def due_ack(self, now: float) -> int | None:
        """The sequence to acknowledge now, up to which all has come; it counts as acknowledged. ``None``: not yet."""
        due = self.next_timer()
        if due is None or now < due or self._next is None:
            return None
        self._owed = self._owed_bytes = 0
        return (self._next - 1) & _MASK

    def next_timer(self) -> float | None:
        """When ``due_ack`` will have something, in monotonic seconds."""
        if not self._owed:
            return None
        if self._owed >= limits.ACK_MESSAGES or self._owed_bytes >= limits.ACK_BYTES:
            return self._owed_since
        return self._owed_since + limits.ACK_DELAY


_Key = TypeVar("_Key", bound=Hashable)


@dataclass(slots=True)
class _Parked:
    sender: ReliableSender
    until: float
    size: int


class ResumeTable(Generic[_Key]):
    """Senders whose link is gone, in case their receivers come back.

    Each keeps its messages for a time of its own. Of those that keep some there are at most ``limits.RESUMES_MAX``
    with ``limits.RESUME_BYTES_MAX``; beyond a bound the one parked longest lets its messages go. Those that have let
    them go only count what comes; they stay until they are claimed, at most ``limits.RESUMES_COUNTED_MAX``, of which
    the one that counts for longest is forgotten first. A key names the receiver and the source. While a sender is
    parked, offer to it by ``offer``.
    """

    def __init__(self) -> None:
        self._parked: OrderedDict[_Key, _Parked] = OrderedDict()
        self._counting: OrderedDict[_Key, ReliableSender] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._parked) + len(self._counting)

    @property
    def pending_bytes(self) -> int:
        """Bytes kept by all parked senders."""
        return self._bytes

    def park(self, key: _Key, sender: ReliableSender, until: float) -> list[_Key]:
        """Suspend a sender and keep its messages until some time; one already there under this key is replaced.

        Args:
            key: Its receiver and source.
            sender: The sender.
            until: Monotonic seconds.

        Returns:
            The keys of senders that let their messages go for it; its own, if it is too large for the table.
        """
        sender.suspend()
        self._remove(key)
        if sender.forgone:
            self._counting[key] = sender
            return []
        self._parked[key] = _Parked(sender, until, sender.pending_bytes)
        self._bytes += sender.pending_bytes
        return self._shrink()

    def offer(self, key: _Key, payload: bytes, stamp_ns: int) -> list[_Key]:
        """A message for a parked sender; nothing happens if it is not there.

        Returns:
            The keys of senders that let their messages go for it.
        """
        parked = self._parked.get(key)
        if parked is None:
            if (sender := self._counting.get(key)) is not None:
                sender.offer(payload, stamp_ns)
            return []
        parked.sender.offer(payload, stamp_ns)
        self._bytes += parked.sender.pending_bytes - parked.size
        parked.size = parked.sender.pending_bytes
        return self._shrink()

    def claim(self, key: _Key, epoch: int | None) -> ReliableSender | None:
        """The receiver is back: its sender, still suspended, if it is here and of this epoch.

        Whatever was parked under the key leaves the table: a receiver that asks for another epoch has no use for it.
        """
        sender = self._remove(key)
        return sender if sender is not None and sender.epoch == epoch else None

    def move(self, old: _Key, new: _Key) -> None:
        """A sender that is parked under one key is parked under another one from now on."""
        if (parked := self._parked.pop(old, None)) is not None:
            self._parked[new] = parked
        elif (sender := self._counting.pop(old, None)) is not None:
            self._counting[new] = sender

    def expire(self, now: float) -> list[_Key]:
        """Let those whose time is over only count; return their keys."""
        keys = [key for key, parked in self._parked.items() if parked.until <= now]
        for key in keys:
            self._forgo(key)
        return keys

    def next_timer(self) -> float | None:
        """When ``expire`` is due, in monotonic seconds."""
        return min((parked.until for parked in self._parked.values()), default=None)

    def forget(self) -> list[_Key]:
        """Let go of those that have only counted for longest, beyond their bound; return their keys."""
        keys = []
        while len(self._counting) > limits.RESUMES_COUNTED_MAX:
            keys.append(self._counting.popitem(last=False)[0])
        return keys

    def _shrink(self) -> list[_Key]:
        keys = []
        while len(self._parked) > limits.RESUMES_MAX or self._bytes > limits.RESUME_BYTES_MAX:
            key = next(iter(self._parked))
            self._forgo(key)
            keys.append(key)
        return keys

    def _forgo(self, key: _Key) -> None:
        sender = self._remove(key)
        if sender is not None:
            sender.forgo()
            self._counting[key] = sender

    def _remove(self, key: _Key) -> ReliableSender | None:
        parked = self._parked.pop(key, None)
        if parked is None:
            return self._counting.pop(key, None)
        self._bytes -= parked.size
        return parked.sender
