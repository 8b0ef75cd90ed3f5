"""The data path through the bridge: what happens to each message, and nothing else.

Both flows are called from a socket's read callback with a view of its buffer and hand it on with one system call
for each receiver, a large message in parts while it still arrives. They take routes as commands and share no state
with the planning side.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.bridge.data.io.route_sender import ReliableRouteSender, RouteSender, make_route_sender
from rmpa.bridge.data.losses import ReceptionHistory
from rmpa.bridge.data.qos_events import QosWatch
from rmpa.bridge.data.quality import Quality
from rmpa.core.contract import Contract, Durability, Priority, Reliability
from rmpa.core.counters import Counters
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.core.serial_number import SERIAL_HALF, SERIAL_MASK, is_earlier
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.reliable import ReliableReceiver
from rmpa.ros import limits as ros_limits
from rmpa.runtime import limits as runtime_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.data.io.link_time import LinkTime
    from rmpa.bridge.data.io.route_sender import DataLink
    from rmpa.bridge.data.qos_events import QosEvent
    from rmpa.runtime.stream import Buffer

_LENGTH: Final = 4
_NONE: Final = -1
"""No sequence is expected: none came yet, or a message in parts is under way. The next one takes the long way."""


class LocalOutput(Protocol):
    """What the data path needs of a publication: local subscribers behind it."""

    def publish_framed(self, framed: Buffer) -> object:
        """Send one message, with its length in front, to each subscriber."""
        ...

    def begin(self, size: int) -> None:
        """Begin a message of ``size`` bytes that come in parts."""
        ...

    def extend(self, part: Buffer) -> None:
        """Send a part of it to each subscriber that has its beginning."""
        ...

    def abort(self) -> int:
        """The rest will not come; return how many subscribers were closed because they have the beginning."""
        ...


class ExportFlow:
    """From one local publisher to the peers that want it; a peer has one leg."""

    __slots__ = (
        "_got",
        "_keeping",
        "_latched",
        "_legs",
        "_size",
        "_stamp",
        "_streaming",
        "_whole",
        "by_peer",
        "bytes",
        "dropped",
        "large",
        "latching",
        "messages",
        "oversized",
        "oversized_bytes",
    )

    def __init__(self) -> None:
        self.by_peer: dict[int, RouteSender] = {}
        self._legs: tuple[RouteSender, ...] = ()
        self._latched: deque[tuple[bytes, int]] = deque(maxlen=1)
        self._keeping = False
        self._streaming: list[RouteSender] = []
        self._whole: bytearray | None = None
        self._size = self._got = self._stamp = 0
        self.latching = False
        """Whether the publisher latches: whoever comes later gets its last message, whatever the contract."""
        self.large = False
        self.messages = 0
        self.bytes = 0
        self.dropped = 0
        self.oversized = self.oversized_bytes = 0
        """Messages of the publisher that were left out because they are too long; the last one's bytes."""

    def left_out(self, size: int) -> None:
        """A message of so many bytes is too long."""
        self.oversized += 1
        self.oversized_bytes = size

    def latch(self) -> None:
        """The publisher latches."""
        self.latching = True
        self.keep(1)

    def keep(self, depth: int) -> None:
        """Keep the last ``depth`` messages for peers that come later."""
        self._keeping = True
        if depth > (self._latched.maxlen or 0):
            self._latched = deque(self._latched, maxlen=min(depth, ros_limits.LATCHED_MAX))

    def add(self, peer: int, link: DataLink, route: int, contract: Contract, epoch: int) -> RouteSender:
        """Send to one more peer from now on; first what its contract, or the publisher, has kept for it."""
        self.remove(peer)
        leg = make_route_sender(link, route, contract, epoch, large=self.large)
        if contract.durability is Durability.TRANSIENT_LOCAL:
            self.keep(contract.kept)
        # What is kept because another peer asked for it is old news, and may be an old command, to this one.
        kept = contract.kept if contract.durability is Durability.TRANSIENT_LOCAL else int(self.latching)
        for framed, stamp in islice(self._latched, max(0, len(self._latched) - kept), None):
            leg.message(stamp, framed)
        self.by_peer[peer] = leg
        self._legs = tuple(self.by_peer.values())
        return leg

    def suspend(self, peer: int, keep: Callable[[bytes, int], object] | None = None) -> None:
        """A peer's link is gone: keep its messages; see ``ReliableRouteSender.suspend``."""
        leg = self.by_peer.get(peer)
        if isinstance(leg, ReliableRouteSender):
            leg.suspend(keep)

    def inherit(self, old: int, new: int) -> RouteSender | None:
        """What is kept for a peer is kept for another one, which has none yet."""
        leg = self.by_peer.pop(old, None)
        if leg is not None:
            self.by_peer[new] = leg
        return leg

    def remove(self, peer: int) -> None:
        """Send to that peer no longer."""
        leg = self.by_peer.pop(peer, None)
        if leg is not None:
            leg.close()
            self._legs = tuple(self.by_peer.values())
            if leg in self._streaming:
                self._streaming.remove(leg)

    def close(self) -> None:
        """The source is left: let go of what was kept of it, which may be large."""
        for peer in tuple(self.by_peer):
            self.remove(peer)
        self._latched.clear()
        self._whole = None

    def message(self, framed: memoryview) -> None:
        """Hand one message on; ``framed`` has its length in front and is valid during the call only."""
        stamp = time.time_ns()
        self.messages += 1
        self.bytes += len(framed)
        for leg in self._legs:
            dropped = leg.message(stamp, framed)
            if dropped:
                self.dropped += dropped
        if self._keeping:
            self._latched.append((bytes(framed), stamp))

    def begin(self, size: int) -> None:
        """A message of ``size`` bytes, its length in front, begins to come."""
        self._stamp = time.time_ns()
        self._size, self._got = size, 0
        self.large = True
        self._streaming = [leg for leg in self._legs if leg.begin(self._stamp, size)]
        self._whole = bytearray() if self._keeping or len(self._streaming) < len(self._legs) else None

    def part(self, part: memoryview) -> None:
        """Hand a part of it on; valid during the call only."""
        for leg in self._streaming:
            self.dropped += leg.part(part)
        if self._whole is not None:
            self._whole += part
        self._got += len(part)
        if self._got >= self._size:
            self._complete()

    def abort(self) -> None:
        """The rest will not come: the publisher hung up."""
        for leg in self._streaming:
            leg.abort()
        self._streaming = []
        self._whole = None

    def _complete(self) -> None:
        self.messages += 1
        self.bytes += self._size
        streamed, self._streaming = self._streaming, []
        if self._whole is None:
            return
        whole, self._whole = bytes(self._whole), None
        for leg in self._legs:
            if leg not in streamed:
                self.dropped += leg.message(self._stamp, whole)
        if self._keeping:
            self._latched.append((whole, self._stamp))


class ImportFlow:
    """From one peer's route to the local subscribers of its proxy.

    Args:
        outlet: The local end.
        contract: What holds for the route.
        time: The link's.
        on_ack: ``(sequence)``: tell the sender that everything up to this message has come.
        on_torn: Subscribers were closed in the middle of a message: let them come again.
        on_broken: A reliable route has lost messages all the same.
        counters: Outlive the route: ``message.lost``, ``message.late``, ``message.stale``, ``message.expired``.
        past: What is known from before, of a reliable source.
    """

    def __init__(
        self,
        outlet: LocalOutput,
        contract: Contract,
        link_time: LinkTime,
        *,
        on_ack: Callable[[int], None] | None = None,
        on_torn: Callable[[], None] | None = None,
        on_broken: Callable[[QosEvent], None] | None = None,
        counters: Counters | None = None,
        past: ReceptionHistory | None = None,
    ) -> None:
        self._counters = counters if counters is not None else Counters()
        self._loop = asyncio.get_running_loop()
        now = self._loop.time()
        self._outlet = outlet
        self.contract = contract
        self._time = link_time
        self._on_ack = on_ack
        self._on_torn = on_torn
        self._on_broken = on_broken
        self._expected = _NONE
        self._next = 1
        self._replay: deque[bytes] | None = None
        self._receiver: ReliableReceiver | None = None
        if contract.reliability is Reliability.RELIABLE:
            known = past.receiver if past is not None else None
            self._receiver = known if known is not None else ReliableReceiver()
        self._epoch = 0
        self._plain = self._receiver is None
        self._stale_ns = round((contract.lifespan or runtime_limits.STALE_AGE) * 1e9)
        # The first ones of a route may be as old as they are: kept messages, of a latching publisher at least one.
        self._kept = contract.kept if contract.durability is Durability.TRANSIENT_LOCAL else 1
        self._size = self._got = 0
        self._parts: bytearray | None = None
        self._sequence: int | None = None
        self._stale: tuple[int, int, bytes] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._ack_timer: asyncio.TimerHandle | None = None
        self.quality = Quality()
        self.watch = QosWatch(contract, now)
        if past is not None:
            self.watch.counts.update(past.counts)
            self.watch.recent.extend(past.recent)
        self.lost = past.lost if past is not None else 0
        """Messages that never came: the sender's queue, or a link, lost them."""
        self.late = 0
        """Messages that came behind newer ones, or again, and were left out."""
        self.stale = 0
        """Best-effort messages that an outage had held up and that gave way to newer ones."""
        self.expired = 0
        """Messages that came after their lifespan."""
        self.oversized = self.oversized_bytes = 0
        """Messages that its publisher's agent has left out because they are too long; the last one's bytes."""
        self._last_size = 0

    @property
    def lane(self) -> str:
        """The lane of its messages: ``express`` or ``bulk``; where size decides, that of the last one."""
        if self.contract.priority is Priority.NORMAL:
            return "bulk" if self._last_size > mesh_limits.EXPRESS_MESSAGE_MAX else "express"
        return "express" if self.contract.priority is Priority.HIGH else "bulk"

    @property
    def position(self) -> tuple[int, int] | None:
        """Epoch and sequence of the last reliable message, from which a new link goes on."""
        return self._receiver.position() if self._receiver is not None else None

    def begin_epoch(self, epoch: int, first: int) -> bool:
        """The sender says which numbering this is; whether it is the one that was received before, or the first."""
        self._epoch = epoch
        self._drop_parts()
        return self._receiver.begin(epoch, first) if self._receiver is not None else True

    def missed(self, count: int) -> None:
        """The sender says how many messages it has given up that no gap will tell of."""
        if count:
            self._missing(count)

    def skip(self, following: int) -> None:
        """The sender says which message comes next: those before it will not."""
        self.missed(self._receiver.skip(following) if self._receiver is not None else 0)

    def missed_unknown(self, why: str) -> None:
        """Messages may be lost, and nobody knows how many."""
        self._counters.add("message.lost_unknown")
        occurred = self.watch.lost_unknown(why, self._loop.time())
        if self._on_broken is not None:
            self._on_broken(occurred)

    def past(self, topic: str, *, missed: bool) -> ReceptionHistory | None:
        """What is to be known when the source's next route opens; ``None``: nothing."""
        if self._receiver is None:
            return None
        return ReceptionHistory(
            topic,
            self._receiver if missed and self._receiver.position() is not None else None,
            missed,
            self.lost,
            self.watch.counts,
            tuple(self.watch.recent),
        )

    def expect_replay(self, kept: Iterable[bytes]) -> None:
        """The subscribers have these kept messages already; the new route brings again those that are still kept."""
        self._replay = deque(kept) or None

    def rebind(self, on_ack: Callable[[int], None]) -> None:
        """Go on over another link."""
        self._on_ack = on_ack

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """Hand one message on; a gap in the sequence is what the sender's queue dropped."""
        now_ns = time.time_ns()
        if self._plain:
            if sequence != self._expected and not self._follows(sequence):
                return
            self._expected = sequence + 1 & SERIAL_MASK
            if self._replay is not None and self._is_replay(framed):
                return
            age = now_ns - stamp_ns + self._time.ahead_ns
            if age > self._stale_ns and self._give_way(sequence, stamp_ns, framed, age):
                return
            if self._stale is not None:
                self._supersede()
        elif not self._accept(sequence, stamp_ns, len(framed), now_ns) or (
            self._replay is not None and self._is_replay(framed)
        ):
            return
        self._outlet.publish_framed(framed)
        self._note(stamp_ns, now_ns, len(framed))

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Take a part of a large message.

        Raises:
            RemoteProtocolError: The parts do not make one message.
        """
        if flags & FIRST:
            self._begin(sequence, stamp_ns, part)
        if self._sequence is None:
            return  # of a message that is left out
        if self._sequence != sequence:
            if is_earlier(sequence, self._sequence):
                return  # of one from before, by a lane that is about to end
            raise RemoteProtocolError(f"a part of message {sequence} comes in the middle of message {self._sequence}")
        if flags & ABORT:
            self._drop_parts(missing=False)
            return
        self._got += len(part)
        if self._got > self._size or (self._got == self._size) != bool(flags & LAST):
            raise RemoteProtocolError(f"a message of {self._size} bytes came as {self._got}")
        if self._parts is None:
            self._outlet.extend(part)
        else:
            self._parts += part
        if flags & LAST:
            self._complete(sequence, stamp_ns)

    def close(self) -> None:
        """No data comes any more."""
        self._drop_parts()
        self._stale = None
        for timer in (self._timer, self._ack_timer):
            if timer is not None:
                timer.cancel()
        self._timer = self._ack_timer = None

    def torn(self) -> None:
        """The connection is gone: half a message must not stay where it is."""
        self._drop_parts()

    # --- inside ---------------------------------------------------------------------------------------------

    def _note(self, stamp_ns: int, now_ns: int, size: int) -> None:
        now = self._loop.time()
        self._last_size = size
        self.watch.last = now
        self.quality.arrived(now, now_ns, stamp_ns, size)

    def _follows(self, sequence: int) -> bool:
        """The long way of a sequence: count what is missing; whether the message is not one from before."""
        gap = sequence - (self._next if self._expected == _NONE else self._expected) & SERIAL_MASK
        if gap >= SERIAL_HALF:
            self._was_late()
            return False
        # Half a message is here, and its lane is gone, though we have not heard of that yet.
        self._drop_parts()
        if gap:
            self._missing(gap)
        return True

    def _is_replay(self, framed: memoryview | bytearray) -> bool:
        """Whether the subscribers have this message; the first that they do not have ends the replay."""
        replay = self._replay
        while replay:
            if memoryview(replay.popleft()) == framed:
                return True
        self._replay = None
        return False

    def _missing(self, count: int) -> None:
        self.lost += count
        self._counters.add("message.lost", count)
        occurred = self.watch.lost(count, self._loop.time())
        if self._on_broken is not None and self._receiver is not None:
            self._on_broken(occurred)

    def _give_way(self, sequence: int, stamp_ns: int, framed: memoryview, age: int) -> bool:
        """A message that is older than the contract, or an outage, allows; whether it is dealt with.

        Without a lifespan it waits a moment for a newer one behind it, and is delivered if none comes: the last
        command before a cable was pulled still counts.
        """
        error = self._time.error_ns
        if error is None or age <= self._stale_ns + error:
            return False
        if self.contract.lifespan is None:
            held_up = self._time.resumed_at() - (self._loop.time() - age / 1e9)
            if held_up * 1e9 <= self._stale_ns + error:
                return False  # not an outage held it up for so long, but a slow link, or we
        if self.contract.lifespan is not None:
            self._has_expired()
            return True
        if sequence <= self._kept:
            return False
        if self._stale is not None:
            self._gave_way()
        self._stale = (sequence, stamp_ns, bytes(framed))
        if self._timer is None:
            self._timer = self._loop.call_later(mesh_limits.STALE_HOLD, self._nothing_newer)
        return True

    def _supersede(self) -> None:
        self._stale = None
        self._gave_way()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _was_late(self) -> None:
        self.late += 1
        self._counters.add("message.late")

    def _gave_way(self) -> None:
        self.stale += 1
        self._counters.add("message.stale")

    def _has_expired(self) -> None:
        self.expired += 1
        self._counters.add("message.expired")
        self.watch.expired(1, self._loop.time())

    def _nothing_newer(self) -> None:
        self._timer = None
        if self._stale is not None:
            _, stamp_ns, framed = self._stale
            self._stale = None
            self._outlet.publish_framed(framed)
            self._note(stamp_ns, time.time_ns(), len(framed))

    def _accept(self, sequence: int, stamp_ns: int, size: int, now_ns: int) -> bool:
        """Judge a reliable message; acknowledge it, handed on or not."""
        receiver = self._receiver
        if receiver is None:
            return False
        now = self._loop.time()
        verdict = receiver.accept(sequence, self._epoch, now, size)
        if self._ack_timer is None:
            self._acknowledge(receiver, now)
        elif (due := receiver.next_timer()) is not None and due <= now:
            self._ack_timer.cancel()
            self._acknowledge(receiver, now)
        if verdict.gap:
            self._missing(verdict.gap)
        if not verdict.deliver:
            self._was_late()
            return False
        error = self._time.error_ns
        if self.contract.lifespan is not None and error is not None:
            age = now_ns - stamp_ns + self._time.ahead_ns
            if age > self._stale_ns + error:
                self._has_expired()
                return False
        return True

    def _acknowledge(self, receiver: ReliableReceiver, now: float) -> None:
        self._ack_timer = None
        sequence = receiver.due_ack(now)
        if sequence is not None and self._on_ack is not None:
            self._on_ack(sequence)
        due = receiver.next_timer()
        if due is not None:
            self._ack_timer = self._loop.call_at(due, self._ack_due)

    def _ack_due(self) -> None:
        self._ack_timer = None
        if self._receiver is not None:
            # The loop's clock may round a timer to a moment before it is due.
            self._acknowledge(self._receiver, self._loop.time() + 0.001)

    def _begin(self, sequence: int, stamp_ns: int, part: memoryview) -> None:
        """The first part of a message: its length is in front."""
        if len(part) < _LENGTH:
            raise RemoteProtocolError(f"a first part of {len(part)} bytes has no length")
        size = _LENGTH + int.from_bytes(part[:_LENGTH], "little")
        if size > ros_limits.MESSAGE_MAX:
            raise LimitExceeded("message", size, ros_limits.MESSAGE_MAX)
        if self._receiver is not None:
            if not self._receiver.judge(sequence, self._epoch).deliver:
                self._accept(sequence, 0, 0, 0)
                return
            self._drop_parts()
            # One that may come again must not have reached anybody by half.
            self._parts = bytearray()
        elif not self._begin_plain(sequence, stamp_ns, size):
            return
        self._sequence = sequence
        self._size, self._got = size, 0

    def _begin_plain(self, sequence: int, stamp_ns: int, size: int) -> bool:
        """The first part of a best-effort message; whether its parts are wanted."""
        if sequence != self._expected and not self._follows(sequence):
            return False
        self._expected = sequence + 1 & SERIAL_MASK
        if self._outlived(stamp_ns):
            return False
        if self._stale is not None:
            self._supersede()
        if self._replay is not None and any(len(kept) == size for kept in self._replay):
            self._parts = bytearray()  # what it is shows at its end
        else:
            self._replay = None
            self._outlet.begin(size)
        # Until then whatever else comes takes the long way.
        self._next, self._expected = sequence, _NONE
        return True

    def _outlived(self, stamp_ns: int) -> bool:
        """Whether a message in parts is beyond its lifespan."""
        error = self._time.error_ns
        if self.contract.lifespan is None or error is None:
            return False
        if time.time_ns() - stamp_ns + self._time.ahead_ns <= self._stale_ns + error:
            return False
        self._has_expired()
        return True

    def _complete(self, sequence: int, stamp_ns: int) -> None:
        parts, self._parts, self._sequence = self._parts, None, None
        now_ns = time.time_ns()
        if self._plain:
            self._expected = sequence + 1 & SERIAL_MASK
        elif not self._accept(sequence, stamp_ns, self._size, now_ns):
            return
        if parts is not None:
            if self._replay is not None and self._is_replay(parts):
                return
            self._outlet.publish_framed(parts)
        self._note(stamp_ns, now_ns, self._size)

    def _drop_parts(self, *, missing: bool = True) -> None:
        """Half a message came, and nothing more of it will.

        Args:
            missing: Whether it is lost on the way, not given up by its publisher.
        """
        sequence, self._sequence = self._sequence, None
        if sequence is None:
            return
        if self._plain:
            self._next = sequence if missing else sequence + 1 & SERIAL_MASK
        if self._parts is not None:
            self._parts = None
        elif self._outlet.abort() and self._on_torn is not None:
            self._on_torn()
