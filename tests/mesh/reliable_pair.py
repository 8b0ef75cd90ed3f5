"""A reliable sender and receiver with a link between them that falls, and a plain model of the right result.

Every payload begins with the number of the message as it was published, so that what was delivered, lost or doubled
is read from the payloads alone, whatever the sequences say.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import pairwise

from rmpa.mesh.reliable import ACK_DELAY, Outgoing, ReliableReceiver, ReliableSender

MASK = 0xFFFFFFFF


def payload(number: int, size: int = 0) -> bytes:
    """A message that holds its number."""
    return number.to_bytes(4, "big") + bytes(size)


def number_of(data: bytes) -> int:
    """The number in a message."""
    return int.from_bytes(data[:4], "big")


def taken(sender: ReliableSender, most: int | None = None) -> list[Outgoing]:
    """What may be sent now, at most so many messages."""
    messages: list[Outgoing] = []
    while (most is None or len(messages) < most) and (message := sender.take()) is not None:
        messages.append(message)
    return messages


@dataclass(frozen=True)
class Fragment:
    """A piece of a message in flight."""

    epoch: int
    message: Outgoing
    first: bool
    last: bool


@dataclass(frozen=True)
class Bounds:
    """The bounds of a sender."""

    depth: int = 8
    max_bytes: int = 400
    window_messages: int = 4
    window_bytes: int = 200
    first: int = 1

    def sender(self, epoch: int) -> ReliableSender:
        return ReliableSender(
            self.depth, self.max_bytes, self.window_messages, self.window_bytes, epoch, first=self.first
        )


class Pair:
    """Both machines, what is in flight between them, and the model.

    Args:
        bounds: Of the sender, and of those that follow it.
        says_first: Whether a sender tells its first sequence.
    """

    def __init__(self, bounds: Bounds, *, says_first: bool = True) -> None:
        self.bounds = bounds
        self.says_first = says_first
        self.now = 100.0
        self.published = 0
        self.epoch = 0
        self.linked = True
        self.data: deque[Fragment] = deque()
        self.acks: deque[tuple[int, int]] = deque()
        self.ghosts: deque[Fragment] = deque()
        """What an old link still brings, behind the position that its successor was opened with."""
        self.receiver = ReliableReceiver()
        self.doubled: set[int] = set()
        self.fresh_receiver()

    # --- what happens ---------------------------------------------------------------------------------------

    def fresh_sender(self) -> None:
        """The sender begins anew: another epoch, nothing kept; the receiver is told."""
        self.epoch += 1
        self.sender = self.bounds.sender(self.epoch)
        self.start = self.published
        self.kept: list[tuple[int, int]] = []
        self.delivered: list[int] = []
        self.gaps = 0
        self.newest = 0
        self.haunted = False
        self.data.clear()
        self.acks.clear()
        self.linked = True
        self.receiver.begin(self.epoch, self.sender.first if self.says_first else None)

    def fresh_receiver(self) -> None:
        """The receiver begins anew, and so does the sender: nothing is there to resume."""
        self.receiver = ReliableReceiver()
        assert self.receiver.position() is None
        self.ghosts.clear()
        self.fresh_sender()

    def offer(self, size: int) -> None:
        """A message is published."""
        data = payload(self.published, size)
        self.sender.offer(data, self.published * 1000)
        self.kept.append((self.published, len(data)))
        self.published += 1
        self.newest = len(data)
        bounds = self.bounds
        while len(self.kept) > 1 and (
            len(self.kept) > bounds.depth or sum(size for _, size in self.kept) > bounds.max_bytes
        ):
            self.kept.pop(0)

    def send(self, most: int | None, pieces: int) -> int:
        """What may be sent goes on the link, each message in so many fragments."""
        sent = taken(self.sender, most)
        for message in sent:
            assert message.sequence == self.sequence(number_of(message.payload))
            assert message.stamp_ns == number_of(message.payload) * 1000
            for n in range(pieces):
                self.data.append(Fragment(self.epoch, message, first=n == 0, last=n == pieces - 1))
        return len(sent)

    def hesitate(self) -> None:
        """One is taken, and cannot go now."""
        if self.sender.take() is not None:
            self.sender.put_back()

    def lose_lane(self) -> None:
        """What is under way is lost, but not the link; acknowledgements go on."""
        self.data.clear()
        self.haunted = True
        self.sender.rewind()

    def arrive(self) -> None:
        """The next fragment comes; at the first of a message it is decided, with the last it is received."""
        self._handle(self.data.popleft())

    def haunt(self) -> None:
        """The old link brings one more fragment."""
        self._handle(self.ghosts.popleft())

    def tick(self, seconds: float) -> None:
        """Time goes by at the receiver; it may acknowledge."""
        self.now += seconds
        due = self.receiver.next_timer()
        ack = self.receiver.due_ack(self.now)
        assert (ack is not None) == (due is not None and due <= self.now)
        if ack is None:
            return
        assert self.receiver.next_timer() is None
        assert ack == self.sequence(self.delivered[-1] if self.delivered else self.start - 1)
        if self.linked:
            self.acks.append((ack, self.delivered[-1] if self.delivered else self.start - 1))

    def hear(self) -> None:
        """The next acknowledgement comes."""
        sequence, number = self.acks.popleft()
        self.sender.acknowledged(sequence)
        self._trim(number)

    def cut(self, ghosts: int) -> None:
        """The link falls: what is under way is lost, but for some fragments that the receiver reads later."""
        late = [self.data.popleft() for _ in range(min(ghosts, len(self.data)))]
        self.ghosts.extend(late)
        self.haunted |= bool(late)
        self.data.clear()
        self.acks.clear()
        self.linked = False
        self.sender.suspend()

    def resume(self) -> None:
        """A new link: the receiver says where it is."""
        position = self.receiver.position()
        last = self.delivered[-1] if self.delivered else self.start - 1
        if position is None:
            assert not self.says_first
            assert not self.delivered
            position = (self.epoch, self.sequence(self.start - 1))
        assert position == (self.epoch, self.sequence(last))
        self.sender.resume(position[1])
        self._trim(last)
        self.receiver.begin(self.epoch, self.sender.first if self.says_first else None)
        self.linked = True

    # --- what must be ---------------------------------------------------------------------------------------

    def sequence(self, number: int) -> int:
        """The sequence that a published message must have."""
        return (self.bounds.first + number - self.start) & MASK

    def check(self) -> None:
        """The sender keeps what the model keeps, and its bounds."""
        sender, bounds = self.sender, self.bounds
        assert sender.pending == len(self.kept)
        assert sender.pending_bytes == sum(size for _, size in self.kept)
        assert sender.pending <= bounds.depth
        assert sender.pending_bytes <= max(bounds.max_bytes, self.newest)
        assert sender.last == self.sequence(self.published - 1)
        assert len(sender._dropped_in_flight) <= bounds.window_messages
        under_way = [s for _, s in sender._dropped_in_flight] + [len(m.payload) for m in sender._sent]
        assert len(under_way) <= bounds.window_messages or not self.linked
        assert sender._in_flight_bytes == (sum(under_way) if self.linked else 0)
        assert sum(under_way) <= bounds.window_bytes or len(under_way) == 1 or not self.linked
        assert self.linked or sender.take() is None
        assert all(a < b for a, b in pairwise(self.delivered))

    def drain(self) -> None:
        """The link stays: everything that can come has come, and every message's fate is known exactly."""
        if not self.linked:
            self.resume()
        while self.send(None, 1) or self.data or self.acks or self.receiver.next_timer() is not None:
            while self.ghosts:
                self.haunt()
            while self.data:
                self.arrive()
            self.tick(ACK_DELAY)
            while self.acks:
                self.hear()
        self.check()
        assert self.sender.idle
        assert self.sender.pending == 0
        offered = self.published - self.start
        assert len(self.delivered) + self.gaps == offered
        assert not offered or self.delivered[-1] == self.published - 1, "the newest is never dropped"
        if self.haunted or not self.says_first:
            assert self.sender.overflowed >= self.gaps
        else:
            assert self.sender.overflowed == self.gaps
        if offered <= self.bounds.depth and self.bounds.max_bytes >= 1 << 20:
            assert self.gaps == 0, "nothing is lost while it fits"

    def _trim(self, number: int) -> None:
        self.kept = [kept for kept in self.kept if kept[0] > number]

    def _handle(self, fragment: Fragment) -> None:
        message, receiver = fragment.message, self.receiver
        before = (receiver.position(), receiver.next_timer())
        gap = receiver.gap(message.sequence, fragment.epoch)
        assert before == (receiver.position(), receiver.next_timer()), "judging changes nothing"
        if not fragment.last:
            return
        assert receiver.accept(message.sequence, fragment.epoch, self.now, len(message.payload)) == gap
        if gap is None:
            return
        number = number_of(message.payload)
        assert number not in self.doubled, f"message {number} was delivered twice"
        self.doubled.add(number)
        previous = self.delivered[-1] if self.delivered else self.start - 1
        if self.delivered or self.says_first:
            assert gap == number - previous - 1, "the gap is exact"
        else:
            assert gap == 0, "nothing is claimed that is not known"
        self.gaps += number - previous - 1
        self.delivered.append(number)
