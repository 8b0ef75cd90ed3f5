"""One source's way to one peer: lane, bounds, down-sampling, and the memory of what the peer has not yet.

A leg is called for each message from the publisher's read callback; it takes no detour when nothing is in the way.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import TYPE_CHECKING, Protocol

from rmpa.bridge.data.downsampling import Downsampler
from rmpa.bridge.data.lane_switch import EXPRESS, LaneSwitch
from rmpa.core.contract import Contract, History, Reliability
from rmpa.core.serial_number import SERIAL_MASK, is_earlier
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.reliable import ReliableSender
from rmpa.runtime import limits as runtime_limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.outbox import QueuedMessage
    from rmpa.runtime.stream import Buffer


class DataLane(Protocol):
    """What the data path needs of one lane of a link."""

    def send(self, route: int, sequence: int, stamp_ns: int, payload: Buffer) -> int:
        """Send one message; return how many older ones were dropped for it."""
        ...

    def open(self, route: int, size: int, sequence: int, stamp_ns: int) -> QueuedMessage:
        """Begin a message whose bytes follow."""
        ...

    def extend(self, parcel: QueuedMessage, data: Buffer) -> int:
        """Send further bytes of it."""
        ...

    def abandon(self, parcel: QueuedMessage) -> None:
        """The rest will never come."""
        ...

    def fence(self, route: int, number: int) -> None:
        """Send a fence behind the messages of a route."""
        ...

    def set_terms(self, route: int, depth: int, max_age: float | None, *, strict: bool) -> None:
        """Bound what may wait of a route."""
        ...

    def discard(self, route: int) -> None:
        """Let go of what waits of a route, and of its terms."""
        ...


class DataLink(Protocol):
    """What the data path needs of a link."""

    @property
    def express(self) -> DataLane:
        """Small and urgent messages."""
        ...

    @property
    def bulk(self) -> DataLane:
        """Large ones."""
        ...


class RouteSender:
    """One route, best effort.

    Args:
        link: The peer's.
        route: The route's id.
        contract: What holds for it.
        large: Whether the source is known to have large messages.
    """

    reliable = False

    def __init__(self, link: DataLink, route: int, contract: Contract, *, large: bool = False) -> None:
        self.link: DataLink | None = link
        self.route = route
        self.contract = contract
        self._depth = mesh_limits.KEEP_ALL_MESSAGES if contract.history is History.KEEP_ALL else contract.depth
        self.sequence = 0
        self.dropped = 0
        """Messages that gave way because a bound of ours was reached."""
        self._loop = asyncio.get_running_loop()
        self._lane: DataLane = link.express
        self._switch = LaneSwitch(contract, large=large)
        self._small = mesh_limits.EXPRESS_MESSAGE_MAX
        self._held: deque[tuple[int, int, bytes]] = deque()
        self._held_bytes = 0
        self._parcel: QueuedMessage | None = None
        self._throttle = Downsampler(contract.max_rate) if contract.max_rate is not None else None
        self._newest: tuple[int, bytes] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._direct = False
        self._set_terms()
        self._settle()

    @property
    def lane(self) -> str:
        """``express`` or ``bulk``."""
        return self._switch.lane.name.lower()

    @property
    def large(self) -> bool:
        """Whether its messages go, or are about to go, by the bulk lane."""
        return self._switch.target is not EXPRESS

    @property
    def skipped(self) -> int:
        """Messages left out to keep to the contract's rate."""
        return self._throttle.skipped if self._throttle is not None else 0

    def message(self, stamp_ns: int, framed: Buffer) -> int:
        """Send one message; return how many older ones were dropped for it."""
        if self._direct and len(framed) <= self._small:
            self.sequence = sequence = self.sequence + 1 & SERIAL_MASK
            return self._lane.send(self.route, sequence, stamp_ns, framed)
        if self._throttle is not None and not self._throttle.admit(self._loop.time()):
            self._wait_for_turn(self._throttle, stamp_ns, framed)
            return 0
        if self._throttle is not None and self._newest is not None:
            self._throttle.skipped += 1
            self._newest = None
        return self._send(stamp_ns, framed)

    def begin(self, stamp_ns: int, size: int) -> bool:
        """Begin a message of ``size`` bytes; whether its parts can go as they come, else give it whole."""
        if self._throttle is not None or not self._lane_for(size):
            return False
        self.sequence = self.sequence + 1 & SERIAL_MASK
        self._parcel = self._lane.open(self.route, size, self.sequence, stamp_ns)
        return True

    def part(self, part: Buffer) -> int:
        """Send a part of a message that was begun; return how many older messages were dropped for it."""
        return self._lane.extend(self._parcel, part) if self._parcel is not None else 0

    def abort(self) -> None:
        """The rest of the message that was begun will never come."""
        if self._parcel is not None:
            self._lane.abandon(self._parcel)
            self._parcel = None

    def fenced(self, number: int) -> None:
        """The peer has answered a fence."""
        if self._switch.fenced(number):
            self._go_on()

    def acknowledged(self, sequence: int) -> None:
        """The peer has everything up to a message; nobody asked, for best effort."""

    def lane_lost(self) -> None:
        """The bulk lane's connection is gone."""
        if self._switch.lane_lost():
            self._discard_bulk()
            self._go_on()

    def close(self) -> None:
        """No more messages go this way."""
        self.link = None
        self._direct = False
        self._held.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    # --- inside ---------------------------------------------------------------------------------------------

    def _send(self, stamp_ns: int, framed: Buffer) -> int:
        self.sequence = sequence = self.sequence + 1 & SERIAL_MASK
        if self._lane_for(len(framed)):
            return self._lane.send(self.route, sequence, stamp_ns, framed)
        return self._hold(sequence, stamp_ns, bytes(framed))

    def _lane_for(self, size: int) -> bool:
        """Whether a message may go by the present lane now; begins to change it where it may not."""
        if self.link is None or self._switch.fencing:
            return False
        if not self._switch.judge(size, self._loop.time()):
            return True
        self._begin_fence()
        return False

    def _begin_fence(self) -> None:
        self._direct = False
        self._lane.fence(self.route, self._switch.fence())

    def _hold(self, sequence: int, stamp_ns: int, payload: bytes) -> int:
        """Keep a message until the lane has changed, within the contract's bounds."""
        self._held.append((sequence, stamp_ns, payload))
        self._held_bytes += len(payload)
        dropped = 0
        while len(self._held) > 1 and (
            len(self._held) > self._depth or self._held_bytes > mesh_limits.LINK_QUEUE_BYTES
        ):
            self._held_bytes -= len(self._held.popleft()[2])
            dropped += 1
        self.dropped += dropped
        return dropped

    def _go_on(self) -> None:
        self._settle()
        held, self._held = self._held, deque()
        self._held_bytes = 0
        for sequence, stamp_ns, payload in held:
            # A large one may have come while the way back to the express lane was fenced.
            if self._lane_for(len(payload)):
                self._lane.send(self.route, sequence, stamp_ns, payload)
            else:
                self._hold(sequence, stamp_ns, payload)

    def _discard_bulk(self) -> None:
        """Let go of what waits for the bulk lane's next connection: it would come behind what is sent now."""
        if self.link is not None:
            self.link.bulk.discard(self.route)
            self._set_terms()

    def _settle(self) -> None:
        """Use the switch's lane; begin to change it at once where it is not the one that is wanted."""
        if self.link is None:
            return
        self._lane = self.link.express if self._switch.lane is EXPRESS else self.link.bulk
        if self._switch.target is not self._switch.lane:
            self._begin_fence()
            return
        # On the way back from the bulk lane each message is counted, so only the express lane is direct.
        self._direct = self._switch.lane is EXPRESS and self._throttle is None

    def _set_terms(self) -> None:
        if self.link is None:
            return
        contract = self.contract
        for lane, stale in (
            (self.link.express, runtime_limits.STALE_AGE),
            (self.link.bulk, mesh_limits.BULK_STALE_AGE),
        ):
            strict = contract.lifespan is not None
            lane.set_terms(self.route, self._depth, contract.lifespan if strict else stale, strict=strict)

    def _wait_for_turn(self, throttle: Downsampler, stamp_ns: int, framed: Buffer) -> None:
        """Keep the newest until the beat lets it go."""
        if self._newest is not None:
            throttle.skipped += 1
        self._newest = (stamp_ns, bytes(framed))
        if self._timer is None:
            self._timer = self._loop.call_at(throttle.due, self._turn_came)

    def _turn_came(self) -> None:
        self._timer = None
        if self._newest is None or self._throttle is None:
            return
        if not self._throttle.admit(self._loop.time()):
            self._timer = self._loop.call_at(self._throttle.due, self._turn_came)
            return
        stamp_ns, payload = self._newest
        self._newest = None
        self._send(stamp_ns, payload)


class ReliableRouteSender(RouteSender):
    """One route whose messages are kept until the peer has them, over links that fall and come back.

    Args:
        link: The peer's.
        route: The route's id.
        contract: What holds for it.
        epoch: Names this numbering.
        large: Whether the source is known to have large messages.
    """

    reliable = True

    def __init__(self, link: DataLink, route: int, contract: Contract, epoch: int, *, large: bool = False) -> None:
        depth = mesh_limits.KEEP_ALL_MESSAGES if contract.history is History.KEEP_ALL else contract.depth
        self.sender = ReliableSender(
            depth,
            mesh_limits.REPLAY_BYTES,
            mesh_limits.RELIABLE_WINDOW_MESSAGES,
            mesh_limits.RELIABLE_WINDOW_BYTES,
            epoch,
        )
        self._keep: Callable[[bytes, int], object] | None = None
        self._told = 0
        super().__init__(link, route, contract, large=large)
        self._direct = False

    def begin(self, stamp_ns: int, size: int) -> bool:  # noqa: ARG002 - as the other kind
        """A message that may have to be sent again is wanted whole."""
        return False

    def acknowledged(self, sequence: int) -> None:
        """The peer has everything up to a message."""
        self.sender.acknowledged(sequence)
        self._pump()

    def lane_lost(self) -> None:
        """The bulk lane's connection is gone: what was on it is sent again; the peer leaves out what it has."""
        if self._switch.lane is EXPRESS or self.link is None:
            return
        # What still waits for the lane comes again too, in its place: in front of those torn it would be a gap.
        self._discard_bulk()
        self.sender.rewind()
        if self._switch.lane_lost():
            self._go_on()
        else:
            self._pump()

    def suspend(self, keep: Callable[[bytes, int], object] | None = None) -> None:
        """The link is gone; messages are kept until ``resume``, or until it is given up.

        Args:
            keep: ``(payload, stamp_ns)``: offers a message to the sender, and sees to it that all suspended ones
                together keep no more than they may.
        """
        self.link = None
        self._keep = keep
        self.sender.suspend()

    def resume(self, link: DataLink, route: int, after: int) -> None:
        """There is a new link, and the peer has everything up to ``after``.

        An acknowledgement may know better: of two links that came up at once, the older one's word came last.

        Raises:
            RemoteProtocolError: It cannot have.
        """
        known = self.sender.confirmed
        self.sender.resume(known if is_earlier(after, known) else after)
        self._keep = None
        self.link, self.route = link, route
        self._switch.restart()
        self._set_terms()
        self._settle()
        self._direct = False
        self._pump()

    def missed(self) -> int:
        """Messages that the peer will never get, since this was asked last."""
        missed, self._told = self.sender.lost - self._told, self.sender.lost
        return missed

    # --- inside ---------------------------------------------------------------------------------------------

    def _send(self, stamp_ns: int, framed: Buffer) -> int:
        before = self.sender.overflowed
        if self._keep is not None:
            self._keep(bytes(framed), stamp_ns)
        else:
            self.sender.offer(bytes(framed), stamp_ns)
            self._pump()
        lost = self.sender.overflowed - before
        self.dropped += lost
        return lost

    def _pump(self) -> None:
        """Send what the window allows."""
        while self.link is not None and not self._switch.fencing:
            for message in self.sender.take(1):
                if not self._lane_for(len(message.payload)):
                    self.sender.put_back()
                    return
                self._lane.send(self.route, message.sequence, message.stamp_ns, message.payload)
                break
            else:
                return

    def _go_on(self) -> None:
        self._settle()
        self._direct = False
        self._pump()

    def _set_terms(self) -> None:
        """Nothing that was numbered may be dropped from a queue; the window bounds it instead."""
        if self.link is not None:
            for lane in (self.link.express, self.link.bulk):
                lane.set_terms(self.route, mesh_limits.KEEP_ALL_MESSAGES, None, strict=False)


def make_route_sender(link: DataLink, route: int, contract: Contract, epoch: int, *, large: bool) -> RouteSender:
    """The leg that a contract asks for."""
    if contract.reliability is Reliability.RELIABLE:
        return ReliableRouteSender(link, route, contract, epoch, large=large)
    return RouteSender(link, route, contract, large=large)
