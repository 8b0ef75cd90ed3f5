"""The data path from one peer's route to the local subscribers; only what each message needs is done here.

An ``ImportFlow`` is called from a socket's read callback with a view of its buffer, and passes it on with one system
call for each subscriber, a large message in parts while it still arrives.
"""

from __future__ import annotations

import asyncio
import math
import sys
import time
from collections import Counter, deque
from typing import TYPE_CHECKING, Final

from rmpa.bridge.data.quality import QosEvent, QosWatch, Quality
from rmpa.bridge.data.route import kept_for
from rmpa.core.contract import Contract, Priority, Reliability
from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.core.identity import SERIAL_MASK, is_earlier, is_later, serial_add, serial_distance
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.frames import FrameKind
from rmpa.mesh.reliable import HistoryCache, ReliableReceiver
from rmpa.ros import limits as ros_limits
from rmpa.ros.wire.tcpros import LENGTH
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.loop import MachineTimer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rmpa.core.statistics import Counters
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.node.publication import Publication


class LinkTime:
    """Offset of the peer's clock, and the end of the last silence; shared by all flows of a link.

    Attributes:
        resumed_at: Returns when the link's last silence was last seen, monotonic seconds; see ``runtime.stream``.
            Minus infinity: there was none yet.
        ahead_ns: The peer's wall clock minus the local one, ns.
        error_ns: The bound of the offset's error, ± ns; ``None`` while the offset is unknown.
    """

    __slots__ = ("ahead_ns", "error_ns", "resumed_at")

    def __init__(self) -> None:
        self.resumed_at: Callable[[], float] = lambda: -math.inf
        self.ahead_ns = 0
        self.error_ns: int | None = None

    def set(self, offset: float | None, error: float | None) -> None:
        """Set the offset and its error bound, in seconds."""
        self.ahead_ns = round((offset or 0.0) * 1e9)
        self.error_ns = None if error is None else round(error * 1e9)


_PREFIX_SIZE: Final = LENGTH.size


class ImportFlow:
    """From one peer's route to the local subscribers of its proxy.

    Most messages need a look at their number and their age alone (``_plain``). The numbering takes a message when it
    is complete. So a gap shows what was lost, whatever ended a message in parts. There are more than a dozen fields,
    because a message in parts, a held one, a replay and an acknowledgement that is due are states of the same route.

    Args:
        output: The local subscribers.
        contract: The contract of the route.
        link_time: The time base of the route's link.
        counters: Count, beyond this route, ``message.lost``, ``message.lost_unknown``, ``message.late``,
            ``message.stale`` and ``message.expired``.
        on_event: Called with what happened to the contract, and with losses of a reliable route.
        on_torn: Called when subscribers were disconnected in the middle of a message, so that they connect again.
        past: The watch of a reliable source from before this route.
        numbering: That of the flow before this one, of another contract, if it goes on.
        relays: Whether this module may pass the messages on.

    Attributes:
        _replay: Kept messages that the subscribers already have, and that the new route may repeat.
        _sequence: The number of the message that comes in parts; ``None``: there is none.
        _whole: The bytes so far of the message that comes in parts, if it must be delivered whole.
        _held: The end of the wait, the stamp and the bytes of a stale message that waits for a newer one.
        counts: Messages that were not delivered: ``lost`` in the sender's queue or on a link, ``late`` (behind newer
            ones, or twice), ``stale`` (delayed by an outage, dropped for newer ones), ``expired`` (after their
            lifespan).
        history: The last messages of a reliable source, where this module may pass them on.
        oversized, oversized_bytes: Messages that the publisher's agent left out because they are too long; size of
            the last one, in bytes.
    """

    def __init__(
        self,
        output: Publication,
        contract: Contract,
        link_time: LinkTime,
        counters: Counters,
        on_event: Callable[[QosEvent], None],
        on_torn: Callable[[], None],
        past: QosWatch | None = None,
        *,
        numbering: ReliableReceiver | None = None,
        relays: bool = False,
    ) -> None:
        self._on_event = on_event
        self._on_torn = on_torn
        self._output = output
        self.contract = contract
        self.link_time = link_time
        self._counters = counters
        self._loop = asyncio.get_running_loop()
        self._reliable = contract.reliability is Reliability.RELIABLE
        self.numbering = numbering or ReliableReceiver()
        self.history: HistoryCache | None = None
        if relays and self._reliable:
            self.history = HistoryCache()
            self.history.latched, self.history.depth = contract.kept, kept_for(contract)
        oldest = contract.lifespan or (runtime_limits.STALE_AGE if contract.newest_only else None)
        self._stale_ns = sys.maxsize if oldest is None else round(oldest * 1e9)
        self._plain = not self._reliable
        self._replay: deque[bytes] | None = None
        self._sequence: int | None = None
        self._size = self._received = 0
        self._whole: bytearray | None = None
        self._held: tuple[asyncio.TimerHandle, int, bytes] | None = None
        self._link: PeerLink
        self.route = self.epoch = 0
        self._had = 0
        self._ack_timer: asyncio.TimerHandle | None = None
        self.quality = Quality()
        self.watch = QosWatch(contract, self._loop.time(), past)
        self._watch_timer = MachineTimer(self.watch.next_timer, lambda now: self._tell(self.watch.handle_timer(now)))
        self.counts: Counter[str] = Counter()
        self.oversized = self.oversized_bytes = 0

    @property
    def lane(self) -> str:
        """The lane of the messages, ``express`` or ``bulk``; where size decides, the lane of the last message."""
        if self.contract.priority is Priority.NORMAL:
            return "bulk" if self.quality.last_size > mesh_limits.EXPRESS_MESSAGE_MAX else "express"
        return "express" if self.contract.priority is Priority.HIGH else "bulk"

    @property
    def position(self) -> tuple[int, int] | None:
        """Epoch and sequence of the last message, after which a new route continues; ``None``: it cannot."""
        return self.numbering.position() if self.epoch else None

    @property
    def number(self) -> int:
        """The number of the message that is delivered now, or was delivered last."""
        if self._sequence is not None:
            return self._sequence
        return serial_add(self.numbering.next or 0, -1)

    def bind(self, link: PeerLink, route: int, epoch: int, first: int) -> bool:
        """Take the data of a route that was opened, on a new link or by another path.

        Args:
            link: The link, to which messages of a reliable route are acknowledged.
            route: The route's id.
            epoch: The sender's numbering.
            first: Its first sequence.

        Returns:
            Whether the numbering of the earlier route goes on.
        """
        position = self.numbering.position()
        self._link, self.route, self.epoch = link, route, epoch
        self.torn()
        self._stop_ack_timer()
        self.numbering.begin(epoch, first)
        self._had = self.number
        self._tell(self.watch.link_up(self._loop.time()))
        return position is not None and position[0] == epoch != 0

    def skip(self, following: int) -> None:
        """Count the messages before ``following``, the next one that the sender announces, as missed."""
        if count := self.numbering.skip(following):
            self._missing(count)

    def missed_unknown(self, why: str) -> None:
        """Record that an unknown number of messages may be lost; ``why`` is the reason."""
        self._counters.add("message.lost_unknown")
        occurred = self.watch.lost_unknown(why, self._loop.time())
        if self._reliable:
            self._on_event(occurred)

    def expect_replay(self, kept: Iterable[bytes]) -> None:
        """Leave out these messages, which the subscribers have, if the new route repeats them at its beginning."""
        self._replay = deque(kept) or None
        self._judge()

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
        now_ns, numbering = time.time_ns(), self.numbering
        age_ns = now_ns - stamp_ns + self.link_time.ahead_ns
        if self._plain and sequence == numbering.next and age_ns <= self._stale_ns:
            numbering.next = sequence + 1 & SERIAL_MASK
        elif not self._admits(sequence, stamp_ns, framed, now_ns):
            return
        self._output.publish_framed(framed)
        self.watch.last = now = self._loop.time()
        self.quality.arrived(now, now_ns, stamp_ns, size)

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
            self.torn()
            if not self._reliable:
                self._accept(sequence, 0)  # its publisher has aborted it: it is not lost
            return
        self._received += len(part)
        if self._received > self._size or (self._received == self._size) != bool(flags & LAST):
            raise RemoteProtocolError(f"a message of {self._size} bytes came as {self._received}")
        if self._whole is None:
            self._output.extend(part)
        else:
            self._whole += part
        if flags & LAST:
            self._complete(sequence, stamp_ns)

    def link_down(self) -> None:
        """Abort a message that came in part, and start the lease of the source's liveliness."""
        self.torn()
        self.watch.link_down(self._loop.time())
        self._watch_timer.arm()

    def torn(self) -> None:
        """Abort a message that came in part, if there is one: its rest will not come."""
        whole, self._whole = self._whole, None
        if self._sequence is not None and whole is None and self._output.abort():
            self._on_torn()
        self._sequence = None
        self._judge()

    def close(self) -> None:
        """Drop what is held or incomplete, and stop the timers."""
        self.torn()
        if self._held is not None:
            self._held[0].cancel()
            self._held = None
        self._stop_ack_timer()
        self._watch_timer.close()

    def _judge(self) -> None:
        """Whether nothing but the number and the age of the next message has to be looked at."""
        usual = self._replay is None and self._sequence is None and self._held is None
        self._plain = usual and not self._reliable

    def _admits(self, sequence: int, stamp_ns: int, framed: memoryview, now_ns: int) -> bool:
        """Whether a message is delivered that is not plain, not the next one, or perhaps too old."""
        if not self._accept(sequence, len(framed)):
            return False
        if self.history is not None:
            self.history.append(sequence, now_ns, bytes(framed))
        if self._reliable and self._replay is None and self.contract.lifespan is None:
            return True
        admits = not (
            self._is_replay(framed)
            or self._is_expired(stamp_ns, now_ns)
            or self._hold_back(sequence, stamp_ns, framed, now_ns)
        )
        if admits:
            self._drop_held()
        self._judge()
        return admits

    def _accept(self, sequence: int, size: int) -> bool:
        """Whether a complete message is a new one. In any case a reliable one is acknowledged."""
        now = self._loop.time()
        gap = self.numbering.accept(sequence, self.epoch, now, size)
        due = self.numbering.next_timer() if self._reliable else None
        if due is not None and due <= now:
            self._acknowledge(now)
        elif due is not None and self._ack_timer is None:
            self._ack_timer = self._loop.call_at(due, self._acknowledge, due)
        if gap is None:
            if is_later(sequence, self._had):  # else a new path repeats what had come by the old one
                self._count("late")
            return False
        if self._sequence is not None:
            self.torn()  # its lane is gone, though this side has not noticed yet
        if gap:
            self._missing(gap)
        return True

    def _is_replay(self, framed: memoryview | bytearray) -> bool:
        """Whether the subscribers have this message already; the first new message ends the replay."""
        while self._replay:
            if memoryview(self._replay.popleft()) == framed:
                return True
        self._replay = None
        return False

    def _is_too_old(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether a message is certainly older than the lifespan, or than ``STALE_AGE`` if only the newest counts."""
        error_ns = self.link_time.error_ns
        return error_ns is not None and now_ns - stamp_ns + self.link_time.ahead_ns > self._stale_ns + error_ns

    def _is_expired(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether a message is beyond the contract's lifespan."""
        if self.contract.lifespan is None or not self._is_too_old(stamp_ns, now_ns):
            return False
        self._count("expired")
        self.watch.expired(1, self._loop.time())
        return True

    def _hold_back(self, sequence: int, stamp_ns: int, framed: memoryview, now_ns: int) -> bool:
        """Whether a message is held that an outage has delayed, not a slow link or this process.

        It waits ``mesh.limits.STALE_HOLD`` for a newer one, and is delivered if none comes: the last command before a
        cable was pulled still counts.
        """
        if not self.contract.newest_only or not self._is_too_old(stamp_ns, now_ns):
            return False
        if serial_distance(self._had, sequence) <= 1:  # the first message of a route may be a kept one, which is old
            return False
        sent_at = self._loop.time() - (now_ns - stamp_ns + self.link_time.ahead_ns) / 1e9
        held_up = self.link_time.resumed_at() - sent_at
        if held_up * 1e9 <= self._stale_ns + (self.link_time.error_ns or 0):
            return False
        if self._held is None:
            timer = self._loop.call_later(mesh_limits.STALE_HOLD, self._deliver_held)
        else:
            timer = self._held[0]
            self._count("stale")
        self._held = timer, stamp_ns, bytes(framed)
        return True

    def _drop_held(self) -> None:
        """Drops the held message, if there is one: a newer one has come."""
        if self._held is not None:
            self._held[0].cancel()
            self._held = None
            self._count("stale")

    def _deliver_held(self) -> None:
        """Delivers the held message: no newer one has come."""
        if self._held is not None:
            (_, stamp_ns, framed), self._held = self._held, None
            self._judge()
            self._deliver(framed, stamp_ns)

    def _acknowledge(self, now: float) -> None:
        self._stop_ack_timer()
        if (sequence := self.numbering.due_ack(now)) is not None:
            self._link.mark(FrameKind.ACK, self.route, sequence)

    def _begin(self, sequence: int, stamp_ns: int, part: memoryview) -> None:
        """Takes the first part of a message, which begins with the message's length."""
        if len(part) < _PREFIX_SIZE:
            raise RemoteProtocolError(f"a first part of {len(part)} bytes has no length")
        size = _PREFIX_SIZE + LENGTH.unpack_from(part)[0]
        if size > ros_limits.MESSAGE_MAX:
            raise LimitExceeded("message", size, ros_limits.MESSAGE_MAX)
        if self.numbering.gap(sequence, self.epoch) is None:
            self._accept(sequence, 0)
            return
        self.torn()
        if not self._reliable and self._is_expired(stamp_ns, time.time_ns()):
            self._accept(sequence, 0)
            return
        self._drop_held()
        self._sequence = sequence
        if self._reliable or any(len(kept) == size for kept in self._replay or ()):
            # Delivered whole only. A reliable message may be sent again, so no subscriber may have a part of it; and
            # only the whole message shows whether it repeats a kept one.
            self._whole = bytearray()
        else:
            self._replay = None
            self._output.begin(size)
        self._size, self._received = size, 0
        self._judge()

    def _complete(self, sequence: int, stamp_ns: int) -> None:
        whole, self._whole, self._sequence = self._whole, None, None
        now_ns = time.time_ns()
        is_new = self._accept(sequence, self._size)
        if whole is None:
            self._note(stamp_ns, now_ns, self._size)
            self._judge()
            return
        if is_new and self.history is not None:
            self.history.append(sequence, now_ns, bytes(whole))
        if is_new and not self._is_expired(stamp_ns, now_ns) and not self._is_replay(whole):
            self._deliver(whole, stamp_ns)
        self._judge()

    def _deliver(self, framed: bytes | bytearray, stamp_ns: int) -> None:
        self._output.publish_framed(framed)
        self._note(stamp_ns, time.time_ns(), len(framed))

    def _note(self, stamp_ns: int, now_ns: int, size: int) -> None:
        self.watch.last = now = self._loop.time()
        self.quality.arrived(now, now_ns, stamp_ns, size)

    def _count(self, what: str, count: int = 1) -> None:
        self.counts[what] += count
        self._counters.add(f"message.{what}", count)

    def _missing(self, count: int) -> None:
        self._count("lost", count)
        occurred = self.watch.lost(count, self._loop.time())
        if self._reliable:
            self._on_event(occurred)

    def _tell(self, events: Iterable[QosEvent]) -> None:
        for occurred in events:
            self._on_event(occurred)
        self._watch_timer.arm()

    def _stop_ack_timer(self) -> None:
        if self._ack_timer is not None:
            self._ack_timer.cancel()
            self._ack_timer = None
