"""The data path from one peer's route to the local subscribers: what happens to each message, and nothing else.

An ``ImportFlow`` is called from a socket's read callback with a view of its buffer, and passes it on with one system
call for each subscriber, a large message in parts while it still arrives.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from typing import TYPE_CHECKING, Final, Protocol

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
from rmpa.runtime.machine_timer import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.bridge.data.io.link_time import LinkTime
    from rmpa.bridge.data.qos_events import QosEvent
    from rmpa.runtime.stream import Buffer

_LENGTH: Final = 4
_NONE: Final = -1
"""In place of the expected sequence: none came yet, or a message in parts is coming, so each is looked at closely."""


class LocalOutput(Protocol):
    """What the data path needs of a publication: the local subscribers behind it."""

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
        """The rest will not come; return how many subscribers were disconnected because they have the beginning."""
        ...


class ImportFlow:
    """From one peer's route to the local subscribers of its proxy.

    Args:
        output: The local subscribers.
        contract: What holds for the route.
        link_time: The time base of the route's link.
        on_ack: ``(sequence)``: tell the sender that everything up to this message has come.
        on_torn: Subscribers were disconnected in the middle of a message: let them connect again.
        on_broken: A reliable route has lost messages all the same.
        counters: Outlive the route: ``message.lost``, ``message.late``, ``message.stale``, ``message.expired``.
        past: What is known of a reliable source from before this route.
    """

    def __init__(
        self,
        output: LocalOutput,
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
        """Kept messages that the subscribers have, and that the new route may bring again."""
        self._receiver: ReliableReceiver | None = None
        if contract.reliability is Reliability.RELIABLE:
            known = past.receiver if past is not None else None
            self._receiver = known if known is not None else ReliableReceiver()
        self._epoch = 0
        self._plain = self._receiver is None
        self._stale_ns = round((contract.lifespan or runtime_limits.STALE_AGE) * 1e9)
        # The first messages of a route may be old ones that were kept, of a latching publisher at least one.
        self._kept = contract.kept if contract.durability is Durability.TRANSIENT_LOCAL else 1
        self._size = self._received = 0
        self._parts: bytearray | None = None
        """The message that comes in parts so far, where it is only delivered whole."""
        self._sequence: int | None = None
        """The number of the message that comes in parts."""
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
        """Messages that came behind newer ones, or again, and were not delivered."""
        self.stale = 0
        """Best-effort messages that an outage had delayed, and that were dropped for newer ones."""
        self.expired = 0
        """Messages that came after their lifespan."""
        self.oversized = self.oversized_bytes = 0
        """Messages that the publisher's agent left out because they are too long; bytes of the last one."""
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
        """The sender announces its numbering; return whether it is the one received before, or the first."""
        self._epoch = epoch
        self._drop_parts()
        return self._receiver.begin(epoch, first) if self._receiver is not None else True

    def missed(self, count: int) -> None:
        """The sender reports how many messages it has given up that will not show as a gap."""
        if count:
            self._missing(count)

    def skip(self, following: int) -> None:
        """The sender announces which message comes next: those before it will not come."""
        self.missed(self._receiver.skip(following) if self._receiver is not None else 0)

    def missed_unknown(self, why: str) -> None:
        """Messages may be lost, and no agent knows how many."""
        self._counters.add("message.lost_unknown")
        occurred = self.watch.lost_unknown(why, self._loop.time())
        if self._on_broken is not None:
            self._on_broken(occurred)

    def past(self, topic: str, *, missed: bool) -> ReceptionHistory | None:
        """What the source's next route needs to know of this one; ``None``: nothing."""
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
        """The subscribers have these kept messages; leave out those that the new route brings again."""
        self._replay = deque(kept) or None

    def rebind(self, on_ack: Callable[[int], None]) -> None:
        """Go on over another link."""
        self._on_ack = on_ack

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """Deliver one message; a gap in the sequence is what the sender's queue dropped."""
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
        elif not self._accept(sequence, stamp_ns, len(framed), now_ns) or (
            self._replay is not None and self._is_replay(framed)
        ):
            return
        self._output.publish_framed(framed)
        self._note(stamp_ns, now_ns, len(framed))

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Take a part of a large message.

        Raises:
            RemoteProtocolError: The parts do not make one message.
        """
        if flags & FIRST:
            self._begin(sequence, stamp_ns, part)
        if self._sequence is None:
            return  # of a message that is not delivered
        if self._sequence != sequence:
            if is_earlier(sequence, self._sequence):
                return  # of an earlier one, by a lane that is about to end
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
        """No data comes any more."""
        self._drop_parts()
        self._held = None
        if self._hold_timer is not None:
            self._hold_timer.cancel()
            self._hold_timer = None
        if self._ack_timer is not None:
            self._ack_timer.close()

    def torn(self) -> None:
        """The connection is gone: abort a message that came in part."""
        self._drop_parts()

    # --- inside ---------------------------------------------------------------------------------------------

    def _note(self, stamp_ns: int, now_ns: int, size: int) -> None:
        now = self._loop.time()
        self._last_size = size
        self.watch.last = now
        self.quality.arrived(now, now_ns, stamp_ns, size)

    def _follows(self, sequence: int) -> bool:
        """Look closely at a sequence that was not expected: count what is missing; return whether it is a new one."""
        gap = sequence - (self._next if self._expected == _NONE else self._expected) & SERIAL_MASK
        if gap >= SERIAL_HALF:
            self._count_late()
            return False
        # If half a message is here its lane is gone, though this side has not noticed yet.
        self._drop_parts()
        if gap:
            self._missing(gap)
        return True

    def _is_replay(self, framed: memoryview | bytearray) -> bool:
        """Whether the subscribers have this message; the first one that they do not have ends the replay."""
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
        """Whether a message that may be too old is not to be delivered now.

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
        """A newer message has come."""
        self._held = None
        self._count_stale()
        if self._hold_timer is not None:
            self._hold_timer.cancel()
            self._hold_timer = None

    def _deliver_held(self) -> None:
        """No newer message has come."""
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
        """Take the first part of a message; its length is in front."""
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
            # No subscriber may have half of a message that may come again.
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
            self._parts = bytearray()  # only its end shows whether it is one of them
        else:
            self._replay = None
            self._output.begin(size)
        # Any other message that comes before the last part is looked at closely.
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
