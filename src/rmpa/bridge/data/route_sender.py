"""The sending end of one route: the lane of its messages, what is kept for the next link, and their bounds.

It is called for each message from the publisher's read callback, by its flow (``bridge.data.export``).
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from itertools import chain
from typing import TYPE_CHECKING, Final

from msgspec import UNSET

from rmpa.bridge.data.route import EXPRESS, Downsampler, LaneSwitch, kept_for
from rmpa.core.contract import Contract, History
from rmpa.core.identity import SERIAL_MASK, is_earlier, serial_add
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.reliable import ReliableSender

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.outbox import QueuedMessage
    from rmpa.mesh.io.lane import LaneSender
    from rmpa.mesh.io.link import PeerLink

    Keep = Callable[[bytes, int], object]

# Nanoseconds: after a lease of silence the peer ends a link on which nothing comes, and after another one this side,
# which may have heard the peer until then. Half as much again is for a busy machine.
_RESENT_NS: Final = round(3 * mesh_limits.EXPRESS_LEASE * 1e9)
_SMALL: Final = mesh_limits.EXPRESS_MESSAGE_MAX


class RouteSender:
    """The sending end of a best-effort route: the lane of its messages, queue bounds, and down-sampling.

    It is called for each message from the publisher's read callback. ``message`` has a short path for the usual case:
    a small message on the express lane, without down-sampling.

    A link that falls silent loses what the kernel had taken. So the last messages are kept, and sent again over the
    next link if the peer does not have them (``suspend``, ``resume``); what came in parts is not.

    Args:
        link: The link to the peer.
        route: The route's id.
        contract: The route's contract.
        epoch: Identifies the numbering; see ``mesh.reliable``.
        first: The sequence of the first message.
        large: Whether the source is known to have large messages.

    Attributes:
        _held: Sequence, stamp and bytes of messages that wait until the lane has changed, or for the next link.
        _sent: When each of the last messages was sent, ns, and the same of it.
        _newest: Stamp and bytes of the message that down-sampling sends next.
        _direct: Whether ``message`` may take its short path for small messages.
        lapse: When a suspended route of best effort ends.
    """

    reliable = False
    lost = 0

    def __init__(
        self,
        link: PeerLink,
        route: int,
        contract: Contract,
        epoch: int = 0,
        first: int = 1,
        *,
        large: bool = False,
    ) -> None:
        self.contract = contract
        self.epoch = epoch
        self._depth = kept_for(contract)
        chosen = contract.depth is not UNSET or contract.history is History.KEEP_ALL
        self._max_bytes = mesh_limits.LANE_QUEUE_BYTES if chosen else mesh_limits.ROUTE_QUEUE_BYTES
        self.sequence = serial_add(first, -1)
        self._loop = asyncio.get_running_loop()
        self._switch = LaneSwitch(contract, large=large)
        self._held: deque[tuple[int, int, bytes]] = deque()
        self._held_bytes = 0
        self._sent: deque[tuple[int, tuple[int, int, bytes]]] = deque()
        self._sent_bytes = 0
        self._downsampler = Downsampler(contract.max_rate) if contract.max_rate is not None else None
        self._newest: tuple[int, bytes] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._done: Callable[[], None] | None = None
        self._direct = False
        self.lapse: asyncio.TimerHandle | None = None
        self.link: PeerLink | None
        self._lane: LaneSender
        self._use(link, route)

    @property
    def lane(self) -> str:
        """The present lane, ``express`` or ``bulk``, to show."""
        return self._switch.lane.name.lower()

    def message(self, stamp_ns: int, framed: bytes) -> int:
        """Send one message, which may be kept; return how many older ones were dropped for it."""
        if self._direct and len(framed) <= _SMALL:
            self.sequence = sequence = self.sequence + 1 & SERIAL_MASK
            return self._transmit(sequence, stamp_ns, framed)
        if self._downsampler is not None and not self._downsampler.admit(self._loop.time()):
            self._newest = (stamp_ns, framed)  # in place of an older one, until the rate allows it
            if self._timer is None:
                self._timer = self._loop.call_at(self._downsampler.due, self._send_newest, self._downsampler)
            return 0
        self._newest = None
        return self._send(stamp_ns, framed)

    def begin(self, stamp_ns: int, size: int) -> tuple[LaneSender, QueuedMessage] | None:
        """Begin a message of ``size`` bytes: return its lane, and the message there, to which its parts are added.

        ``None``: it cannot be sent in parts, and must come whole.
        """
        if self._downsampler is not None or not self._lane_for(size):
            return None
        self.sequence = self.sequence + 1 & SERIAL_MASK
        return self._lane, self._lane.open(self.route, size, self.sequence, stamp_ns)

    def skip(self, sequence: int) -> None:
        """Give the next message this sequence: those before it were lost, or not sent to this peer."""
        if self._downsampler is None:
            self.sequence = serial_add(sequence, -1)

    def fenced(self, number: int) -> None:
        """Take the peer's answer to a fence, and send what has waited over the new lane."""
        if self._switch.fenced(number):
            self._fence_over()

    def drain(self, done: Callable[[], None]) -> None:
        """Call ``done`` once the peer has all messages, or the route has ended; no further message follows."""
        self._done = done
        if self._newest is not None:
            self._send(*self._newest)
            self._newest = None
        if self.link is not None and not self._switch.fencing:
            self._begin_fence()

    @property
    def drained(self) -> bool:
        """Whether nothing of the route is on its way any more."""
        return self.link is None or not (self._switch.fencing or self._held)

    @property
    def last(self) -> int:
        """The number of the last message."""
        return self.sequence

    @property
    def following(self) -> int:
        """The number of the message that is sent next over a new link, if the peer does not have it."""
        return self._held[0][0] if self._held else serial_add(self.sequence, 1)

    def acknowledged(self, sequence: int) -> None:
        """Ignore an acknowledgement; only reliable routes need it."""

    def suspend(self, keep: Keep | None = None) -> None:  # noqa: ARG002 - for reliable routes
        """Keep messages while the link is gone, within the bounds of the queue, until ``resume`` or ``close``."""
        self.link, self._direct = None, False
        if self.lapse is not None:
            self.lapse.cancel()  # its link has ended before the peer opened the route
        waiting = chain((message for _, message in self._sent), self._held)
        self._sent, self._held = deque(), deque()
        self._sent_bytes = self._held_bytes = 0
        for message in waiting:
            self._hold(*message)

    def resume(self, link: PeerLink, route: int, after: int) -> None:
        """Continue on a new link; the peer has everything up to ``after``."""
        if self.lapse is not None:
            self.lapse.cancel()
        while self._held and not is_earlier(after, self._held[0][0]):
            self._held_bytes -= len(self._held.popleft()[2])
        self._switch.restart()
        self._use(link, route)
        self._go_on()

    def lane_lost(self) -> None:
        """Handle the loss of the bulk lane's connection; it ends a change from that lane at once."""
        if self._switch.lane_lost():
            self._discard_bulk()
            self._fence_over()

    def close(self) -> None:
        """Send no more messages."""
        self.link = None
        self._direct = False
        self._held.clear()
        if self._done is not None:
            self._done()
        for timer in (self._timer, self.lapse):
            if timer is not None:
                timer.cancel()

    def _send(self, stamp_ns: int, framed: bytes) -> int:
        self.sequence = sequence = self.sequence + 1 & SERIAL_MASK
        if self._lane_for(len(framed)):
            return self._transmit(sequence, stamp_ns, framed)
        return self._hold(sequence, stamp_ns, framed)

    def _transmit(self, sequence: int, stamp_ns: int, framed: bytes, now_ns: int | None = None) -> int:
        """Sends a message, at its stamp or now, and keeps it while the link may prove to have been silent."""
        sent, now_ns = self._sent, stamp_ns if now_ns is None else now_ns
        sent.append((now_ns, (sequence, stamp_ns, framed)))
        self._sent_bytes += len(framed)
        while (
            sent[0][0] < now_ns - _RESENT_NS
            or len(sent) > self._depth
            or (self._sent_bytes > self._max_bytes and len(sent) > 1)
        ):
            self._sent_bytes -= len(sent.popleft()[1][2])
        return self._lane.send(self.route, sequence, stamp_ns, framed)

    def _send_newest(self, downsampler: Downsampler) -> None:
        self._timer = None
        if self._newest is not None and not downsampler.admit(self._loop.time()):
            self._timer = self._loop.call_at(downsampler.due, self._send_newest, downsampler)
        elif self._newest is not None:
            newest, self._newest = self._newest, None
            self._send(*newest)

    def _hold(self, sequence: int, stamp_ns: int, payload: bytes) -> int:
        """Keep a message until the lane has changed, within the contract's bounds; return how many were dropped."""
        self._held.append((sequence, stamp_ns, payload))
        self._held_bytes += len(payload)
        dropped = 0
        while len(self._held) > 1 and (len(self._held) > self._depth or self._held_bytes > self._max_bytes):
            self._held_bytes -= len(self._held.popleft()[2])
            dropped += 1
        return dropped

    def _go_on(self) -> None:
        """Sends what has waited for the lane."""
        held, self._held, self._held_bytes = self._held, deque(), 0
        now_ns = time.time_ns()
        for sequence, stamp_ns, payload in held:
            # A large message may have come during the change back to the express lane.
            if self._lane_for(len(payload)):
                self._transmit(sequence, stamp_ns, payload, now_ns)
            else:
                self._hold(sequence, stamp_ns, payload)

    def _lane_for(self, size: int) -> bool:
        """Whether a message may be sent over the present lane now; if not, begins the change of lane it needs."""
        if self.link is None or self._switch.fencing:
            return False
        if not self._switch.judge(size, self._loop.time()):
            return True
        self._begin_fence()
        return False

    def _fence_over(self) -> None:
        """Uses the lane that a fence was for; if no message is behind it, a draining route is empty."""
        waited = bool(self._held)
        self._use_lane()
        self._go_on()
        if self._done is not None and not self._switch.fencing:
            if waited:
                self._begin_fence()
            else:
                self._done()

    def _begin_fence(self) -> None:
        self._direct = False
        self._lane.fence(self.route, self._switch.fence())

    def _use(self, link: PeerLink, route: int) -> None:
        """Uses a route of a link from now on."""
        self.link, self.route = link, route
        self._set_bounds(link)
        self._use_lane()

    def _use_lane(self) -> None:
        """Uses the lane that the switch is on; begins a further change at once if the target is another lane."""
        if self.link is None:
            return
        self._lane = self.link.express if self._switch.lane is EXPRESS else self.link.bulk
        if self._switch.target is not self._switch.lane:
            self._begin_fence()
            return
        # On the bulk lane small messages are counted for the return, so only the express lane is direct.
        self._direct = self._switch.lane is EXPRESS and self._downsampler is None and not self.reliable

    def _discard_bulk(self) -> None:
        """Drops messages that wait for the bulk lane's next connection: they would arrive after newer ones."""
        if self.link is not None:
            self.link.bulk.discard(self.route)
            self._set_bounds(self.link)

    def _set_bounds(self, link: PeerLink) -> None:
        lifespan, above = self.contract.lifespan, 0
        if lifespan is None and self._max_bytes < mesh_limits.LANE_QUEUE_BYTES:
            lifespan, above = mesh_limits.ROUTE_QUEUE_AGE, mesh_limits.ROUTE_BURST_BYTES
        for lane in (link.express, link.bulk):
            lane.set_terms(self.route, self._depth, lifespan, above=above)


class ReliableRouteSender(RouteSender):
    """Sends the messages of one reliable route: each is kept until the peer has it, over links that come and go.

    Args:
        link: The link to the peer.
        route: The route's id.
        contract: The route's contract.
        epoch: Identifies the numbering; see ``mesh.reliable``.
        first: The sequence of the first message.
        large: Whether the source is known to have large messages.
    """

    reliable = True

    def __init__(
        self, link: PeerLink, route: int, contract: Contract, epoch: int, first: int = 1, *, large: bool = False
    ) -> None:
        self._keep: Keep | None = None
        self._reported = 0
        super().__init__(link, route, contract, epoch, first, large=large)
        self.sender = ReliableSender(
            self._depth,
            mesh_limits.REPLAY_BYTES,
            mesh_limits.RELIABLE_WINDOW_MESSAGES,
            mesh_limits.RELIABLE_WINDOW_BYTES,
            epoch,
            first=first,
        )

    def drain(self, done: Callable[[], None]) -> None:
        """Call ``done`` once the peer has all messages, or the route has ended; no further message follows."""
        self._done = done

    @property
    def drained(self) -> bool:
        """Whether nothing of the route is on its way any more; an absent peer is not waited for."""
        return self.link is None or self.sender.idle

    def skip(self, sequence: int) -> None:
        """As of ``RouteSender``."""
        if self._downsampler is None:
            self.sender.skip(sequence)

    def begin(self, stamp_ns: int, size: int) -> None:
        """A message that may have to be sent again is needed whole."""

    def acknowledged(self, sequence: int) -> None:
        """Forget the messages up to ``sequence``, which the peer has, and send what the window allows."""
        self.sender.acknowledged(sequence)
        self._go_on()
        if self._done is not None:
            self._done()

    def lane_lost(self) -> None:
        """Send the messages again that were on the lost bulk lane; the peer drops those that it has."""
        if self._switch.lane is EXPRESS or self.link is None:
            return
        # Messages that still wait for the lane are sent again too: ahead of the lost ones they would show as a gap.
        self._discard_bulk()
        self.sender.rewind()
        if self._switch.lane_lost():
            self._use_lane()
        self._go_on()

    @property
    def last(self) -> int:
        """The number of the last message."""
        return self.sender.last

    @property
    def following(self) -> int:
        """The number of the message that is sent next over a new link, if the peer does not have it."""
        return self.sender.following

    @property
    def lost(self) -> int:  # type: ignore[override] # counted by the numbering
        """The number of messages that the peer will never get."""
        return self.sender.lost

    def suspend(self, keep: Keep | None = None) -> None:
        """Keep messages while the link is gone, until ``resume`` or until they are given up.

        Args:
            keep: ``(payload, stamp_ns)``: offers a message to the sender within the bounds that all suspended
                senders have together.
        """
        self.link = None
        self._keep = keep
        self.sender.suspend()

    def resume(self, link: PeerLink, route: int, after: int) -> None:
        """Continue on a new link; the peer has everything up to ``after``."""
        self.sender.resume(after)
        self._keep = None
        self._switch.restart()
        self._use(link, route)
        self._go_on()

    def missed(self) -> int:
        """Return how many messages were lost for the peer since the last call."""
        missed, self._reported = self.sender.lost - self._reported, self.sender.lost
        return missed

    def _send(self, stamp_ns: int, framed: bytes) -> int:
        before = self.sender.overflowed
        if self._keep is not None:
            self._keep(framed, stamp_ns)
        else:
            self.sender.offer(framed, stamp_ns)
            self._go_on()
        return self.sender.overflowed - before

    def _go_on(self) -> None:
        """Sends what the window allows."""
        while self.link is not None and not self._switch.fencing and (message := self.sender.take()):
            if not self._lane_for(len(message.payload)):
                self.sender.put_back()
                return
            self._lane.send(self.route, message.sequence, message.stamp_ns, message.payload)

    def _set_bounds(self, link: PeerLink) -> None:
        """Sets no bounds: a numbered message may not be dropped from a queue; the window bounds the queue."""
        for lane in (link.express, link.bulk):
            lane.set_terms(self.route, mesh_limits.KEEP_ALL_MESSAGES, spared=True)
