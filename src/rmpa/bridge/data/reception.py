"""The data path from one peer's route to the local subscribers; only what each message needs is done here.

An ``ImportFlow`` is called from a socket's read callback with a view of its buffer, and passes it on with one system
call for each subscriber, a large message in parts while it still arrives.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.bridge.data.quality import QosWatch, Quality
from rmpa.bridge.data.route import ReceptionHistory
from rmpa.core.contract import Contract, Durability, Priority, Reliability
from rmpa.core.counters import Counters
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import SERIAL_HALF, SERIAL_MASK, is_earlier
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.connection import DataHandler
from rmpa.mesh.reliable import ReliableReceiver
from rmpa.ros import limits as ros_limits
from rmpa.ros.wire.tcpros import LENGTH
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.data.quality import QosEvent
    from rmpa.ros.node.publication import Publication


# The time base of one link: relates the peer's time stamps to the local clock.


def _never() -> float:
    """Returns minus infinity: there was no silence yet."""
    return -math.inf


class LinkTime:
    """Offset of the peer's clock, and the end of the last silence; shared by all flows of a link."""

    __slots__ = ("ahead_ns", "error_ns", "resumed_at")

    def __init__(self) -> None:
        self.resumed_at: Callable[[], float] = _never
        """Returns when the link's last silence was last seen, monotonic seconds; see ``runtime.stream``."""
        self.ahead_ns = 0
        """The peer's wall clock minus the local one, ns."""
        self.error_ns: int | None = None
        """The bound of the offset's error, ± ns; ``None`` while the offset is unknown."""

    def set(self, offset: float | None, error: float | None) -> None:
        """Set the offset and its error bound, in seconds."""
        self.ahead_ns = round((offset or 0.0) * 1e9)
        self.error_ns = None if error is None else round(error * 1e9)


_PREFIX_SIZE: Final = LENGTH.size
_NONE: Final = -1
"""No expected sequence: no message came yet, or one is coming in parts, so each sequence is checked closely."""


class ImportFlow(DataHandler):
    """From one peer's route to the local subscribers of its proxy.

    Args:
        output: The local subscribers.
        contract: The contract of the route.
        link_time: The time base of the route's link.
        on_ack: ``(sequence)``: acknowledges everything up to this message to the sender.
        on_torn: Called when subscribers were disconnected in the middle of a message, so that they connect again.
        on_broken: Called with an event when a reliable route has lost messages, or may have.
        counters: Counts, beyond this route, ``message.lost``, ``message.lost_unknown``, ``message.late``,
            ``message.stale`` and ``message.expired``.
        past: The history of a reliable source from before this route.
    """

    def __init__(
        self,
        output: Publication,
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
        self._output = output
        self.contract = contract
        self._link_time = link_time
        self._on_ack = on_ack
        self._on_torn = on_torn
        self._on_broken = on_broken
        self._expected = _NONE
        self._next = 1
        self._replay: deque[bytes] | None = None
        """Kept messages that the subscribers already have, and that the new route may repeat."""
        self._receiver: ReliableReceiver | None = None
        if contract.reliability is Reliability.RELIABLE:
            self._receiver = ReliableReceiver()
        self._epoch = 0
        self._plain = self._receiver is None
        self._stale_ns = round((contract.lifespan or runtime_limits.STALE_AGE) * 1e9)
        # The first messages of a route may be kept, old ones: at least one if the publisher latches.
        self._kept = contract.kept if contract.durability is Durability.TRANSIENT_LOCAL else 1
        self._size = self._received = 0
        self._parts: bytearray | None = None
        """The bytes so far of the message that comes in parts, if it must be delivered whole."""
        self._sequence: int | None = None
        """The sequence of the message that comes in parts; ``None``: there is none."""
        self._held: tuple[int, bytes] | None = None
        """Stamp and bytes of a stale message that waits for a newer one."""
        self._hold_timer: asyncio.TimerHandle | None = None
        self._ack_pending = False
        self._ack_timer: MachineTimer | None = None
        if self._receiver is not None:
            self._ack_timer = MachineTimer(self._receiver.next_timer, self._acknowledge)
        self.quality = Quality()
        self.watch = QosWatch(contract, now)
        if past is not None:
            self.watch.counts.update(past.counts)
            self.watch.recent.extend(past.recent)
        self.lost = past.lost if past is not None else 0
        """Messages that never came: lost in the sender's queue, or with a link."""
        self.late = 0
        """Messages that came after newer ones, or twice, and were not delivered."""
        self.stale = 0
        """Best-effort messages that an outage had delayed, and that were dropped for newer ones."""
        self.expired = 0
        """Messages that came after their lifespan."""
        self.oversized = self.oversized_bytes = 0
        """Messages that the publisher's agent left out because they are too long; size of the last one, in bytes."""
        self._last_size = 0

    @property
    def lane(self) -> str:
        """The lane of the messages, ``express`` or ``bulk``; where size decides, the lane of the last message."""
        if self.contract.priority is Priority.NORMAL:
            return "bulk" if self._last_size > mesh_limits.EXPRESS_MESSAGE_MAX else "express"
        return "express" if self.contract.priority is Priority.HIGH else "bulk"

    @property
    def position(self) -> tuple[int, int] | None:
        """Epoch and sequence of the last reliable message, after which a new link continues; else ``None``."""
        return self._receiver.position() if self._receiver is not None else None

    def begin_epoch(self, epoch: int, first: int) -> bool:
        """Begin the sender's numbering; return whether it is the one received before, or the first one."""
        self._epoch = epoch
        self._drop_parts()
        return self._receiver.begin(epoch, first) if self._receiver is not None else True

    def skip(self, following: int) -> None:
        """Count the messages before ``following``, the next one that the sender announces, as missed."""
        if self._receiver is not None and (count := self._receiver.skip(following)):
            self._missing(count)

    def missed_unknown(self, why: str) -> None:
        """Record that an unknown number of messages may be lost; ``why`` is the reason."""
        self._counters.add("message.lost_unknown")
        occurred = self.watch.lost_unknown(why, self._loop.time())
        if self._on_broken is not None:
            self._on_broken(occurred)

    def past(self, topic: str, *, missed: bool) -> ReceptionHistory | None:
        """Return the history for the source's next route; ``None`` for a best-effort route."""
        if self._receiver is None:
            return None
        return ReceptionHistory(topic, missed, self.lost, self.watch.counts, tuple(self.watch.recent))

    def expect_replay(self, kept: Iterable[bytes]) -> None:
        """Leave out these messages, which the subscribers have, if the new route repeats them at its beginning."""
        self._replay = deque(kept) or None

    def rebind(self, on_ack: Callable[[int], None]) -> None:
        """Acknowledge with ``on_ack`` from now on: the route continues over another link."""
        self._on_ack = on_ack

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """Deliver one message, or drop or hold it; a gap in the sequence counts as lost.

        Args:
            sequence: The number of the message.
            stamp_ns: When it came from its publisher, by the peer's wall clock, ns.
            framed: The message, its 4-byte length in front; valid during the call only.

        Raises:
            RemoteProtocolError: ``framed`` is not exactly one message.
        """
        size = len(framed)
        if size < _PREFIX_SIZE or LENGTH.unpack_from(framed)[0] != size - _PREFIX_SIZE:
            raise RemoteProtocolError(f"a data frame of {size} bytes does not hold one message")
        now_ns = time.time_ns()
        if self._plain:
            if sequence != self._expected and not self._follows(sequence):
                return
            self._expected = sequence + 1 & SERIAL_MASK
            if self._replay is not None and self._is_replay(framed):
                return
            age = now_ns - stamp_ns + self._link_time.ahead_ns
            if age > self._stale_ns and self._hold_back(sequence, stamp_ns, framed, age):
                return
            if self._held is not None:
                self._drop_held()
        elif not self._accept(sequence, stamp_ns, size, now_ns) or (
            self._replay is not None and self._is_replay(framed)
        ):
            return
        self._output.publish_framed(framed)
        self._note(stamp_ns, now_ns, size)

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Take a part of a large message.

        Raises:
            RemoteProtocolError: The parts do not make one message.
        """
        if flags & FIRST:
            self._begin(sequence, stamp_ns, part)
        if self._sequence is None:
            return  # a part of a message that is not delivered
        if self._sequence != sequence:
            if is_earlier(sequence, self._sequence):
                return  # a part of an earlier message, over a lane that is about to end
            raise RemoteProtocolError(f"a part of message {sequence} comes in the middle of message {self._sequence}")
        if flags & ABORT:
            self._drop_parts(missing=False)
            return
        self._received += len(part)
        if self._received > self._size or (self._received == self._size) != bool(flags & LAST):
            raise RemoteProtocolError(f"a message of {self._size} bytes came as {self._received}")
        if self._parts is None:
            self._output.extend(part)
        else:
            self._parts += part
        if flags & LAST:
            self._complete(sequence, stamp_ns)

    def close(self) -> None:
        """Drop what is held or incomplete, and stop the timers."""
        self._drop_parts()
        self._held = None
        if self._hold_timer is not None:
            self._hold_timer.cancel()
            self._hold_timer = None
        if self._ack_timer is not None:
            self._ack_timer.close()

    def torn(self) -> None:
        """Abort a message that came in part: its connection is gone."""
        self._drop_parts()

    # --- inside ---------------------------------------------------------------------------------------------

    def _note(self, stamp_ns: int, now_ns: int, size: int) -> None:
        now = self._loop.time()
        self._last_size = size
        self.watch.last = now
        self.quality.arrived(now, now_ns, stamp_ns, size)

    def _follows(self, sequence: int) -> bool:
        """Checks an unexpected sequence: counts missing messages; returns whether the message is a new one."""
        gap = sequence - (self._next if self._expected == _NONE else self._expected) & SERIAL_MASK
        if gap >= SERIAL_HALF:
            self._count_late()
            return False
        # If a message is here in part, its lane is gone, though this side has not noticed yet.
        self._drop_parts()
        if gap:
            self._missing(gap)
        return True

    def _is_replay(self, framed: memoryview | bytearray) -> bool:
        """Whether the subscribers have this message already; the first new message ends the replay."""
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

    def _hold_back(self, sequence: int, stamp_ns: int, framed: memoryview, age: int) -> bool:
        """Whether a message that may be too old is dropped or held instead of delivered.

        Beyond the contract's lifespan it is dropped. Without a lifespan, a message that an outage had delayed waits
        ``mesh.limits.STALE_HOLD`` for a newer one, and is delivered if none comes: the last command before a cable
        was pulled still counts.
        """
        error = self._link_time.error_ns
        if error is None or age <= self._stale_ns + error:
            return False
        if self.contract.lifespan is None:
            held_up = self._link_time.resumed_at() - (self._loop.time() - age / 1e9)
            if held_up * 1e9 <= self._stale_ns + error:
                return False  # delayed by a slow link or by this process, not by an outage
        if self.contract.lifespan is not None:
            self._count_expired()
            return True
        if sequence <= self._kept:
            return False
        if self._held is not None:
            self._count_stale()
        self._held = (stamp_ns, bytes(framed))
        if self._hold_timer is None:
            self._hold_timer = self._loop.call_later(mesh_limits.STALE_HOLD, self._deliver_held)
        return True

    def _drop_held(self) -> None:
        """Drops the held message: a newer one has come."""
        self._held = None
        self._count_stale()
        if self._hold_timer is not None:
            self._hold_timer.cancel()
            self._hold_timer = None

    def _deliver_held(self) -> None:
        """Delivers the held message: no newer one has come."""
        self._hold_timer = None
        if self._held is not None:
            stamp_ns, framed = self._held
            self._held = None
            self._output.publish_framed(framed)
            self._note(stamp_ns, time.time_ns(), len(framed))

    def _count_late(self) -> None:
        self.late += 1
        self._counters.add("message.late")

    def _count_stale(self) -> None:
        self.stale += 1
        self._counters.add("message.stale")

    def _count_expired(self) -> None:
        self.expired += 1
        self._counters.add("message.expired")
        self.watch.expired(1, self._loop.time())

    def _accept(self, sequence: int, stamp_ns: int, size: int, now_ns: int) -> bool:
        """Whether a reliable message is to be delivered; it is acknowledged in any case."""
        receiver, timer = self._receiver, self._ack_timer
        if receiver is None or timer is None:
            return False
        now = self._loop.time()
        result = receiver.accept(sequence, self._epoch, now, size)
        due = receiver.next_timer()
        if due is not None and due <= now:
            self._acknowledge(now)
            timer.arm()
        elif due is not None and not self._ack_pending:
            self._ack_pending = True
            timer.arm()
        if result.gap:
            self._missing(result.gap)
        if not result.deliver:
            self._count_late()
            return False
        error = self._link_time.error_ns
        if self.contract.lifespan is not None and error is not None:
            age = now_ns - stamp_ns + self._link_time.ahead_ns
            if age > self._stale_ns + error:
                self._count_expired()
                return False
        return True

    def _acknowledge(self, now: float) -> None:
        self._ack_pending = False
        sequence = self._receiver.due_ack(now) if self._receiver is not None else None
        if sequence is not None and self._on_ack is not None:
            self._on_ack(sequence)

    def _begin(self, sequence: int, stamp_ns: int, part: memoryview) -> None:
        """Takes the first part of a message, which begins with the message's length."""
        if len(part) < _PREFIX_SIZE:
            raise RemoteProtocolError(f"a first part of {len(part)} bytes has no length")
        size = _PREFIX_SIZE + int.from_bytes(part[:_PREFIX_SIZE], "little")
        if size > ros_limits.MESSAGE_MAX:
            raise LimitExceeded("message", size, ros_limits.MESSAGE_MAX)
        if self._receiver is not None:
            if not self._receiver.judge(sequence, self._epoch).deliver:
                self._accept(sequence, 0, 0, 0)
                return
            self._drop_parts()
            # Delivered whole only: it may be sent again, so no subscriber may have a part of it.
            self._parts = bytearray()
        elif not self._begin_plain(sequence, stamp_ns, size):
            return
        self._sequence = sequence
        self._size, self._received = size, 0

    def _begin_plain(self, sequence: int, stamp_ns: int, size: int) -> bool:
        """Begin a best-effort message; return whether it is delivered."""
        if sequence != self._expected and not self._follows(sequence):
            return False
        self._expected = sequence + 1 & SERIAL_MASK
        if self._outlived(stamp_ns):
            return False
        if self._held is not None:
            self._drop_held()
        if self._replay is not None and any(len(kept) == size for kept in self._replay):
            self._parts = bytearray()  # only the whole message shows whether it is a repeated one
        else:
            self._replay = None
            self._output.begin(size)
        # Any other message that comes before the last part is checked closely.
        self._next, self._expected = sequence, _NONE
        return True

    def _outlived(self, stamp_ns: int) -> bool:
        """Whether a message in parts is beyond its lifespan."""
        error = self._link_time.error_ns
        if self.contract.lifespan is None or error is None:
            return False
        if time.time_ns() - stamp_ns + self._link_time.ahead_ns <= self._stale_ns + error:
            return False
        self._count_expired()
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
            self._output.publish_framed(parts)
        self._note(stamp_ns, now_ns, self._size)

    def _drop_parts(self, *, missing: bool = True) -> None:
        """Abort the message that comes in parts, if there is one: its rest will not come.

        Args:
            missing: Whether it was lost on the way, rather than aborted by its publisher.
        """
        sequence, self._sequence = self._sequence, None
        if sequence is None:
            return
        if self._plain:
            self._next = sequence if missing else sequence + 1 & SERIAL_MASK
        if self._parts is not None:
            self._parts = None
        elif self._output.abort() and self._on_torn is not None:
            self._on_torn()
