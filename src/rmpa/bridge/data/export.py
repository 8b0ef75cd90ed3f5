"""The data path from one local publisher to the peers; only what each message needs is done here.

An ``ExportFlow`` is called from a socket's read callback with a view of its buffer, and passes it on with one system
call for each receiver, a large message in parts while it still arrives. An ``ExportRoute`` is all that is known of
its route to one peer; which there are is decided in ``topics.exports``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

from rmpa.bridge.data.route import RouteBegin, kept_for
from rmpa.bridge.data.route_sender import ReliableRouteSender, RouteSender
from rmpa.core.contract import DEFAULT_CONTRACT, Contract, Durability, Reliability
from rmpa.core.identity import SERIAL_MASK, is_later, serial_add
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.reliable import HistoryCache
from rmpa.ros import limits as ros_limits

if TYPE_CHECKING:
    import asyncio
    from collections.abc import Callable, Sequence

    from rmpa.bridge.data.reception import ImportFlow
    from rmpa.bridge.messages import Description, Source
    from rmpa.bridge.offers import PeerRun
    from rmpa.core.outbox import QueuedMessage
    from rmpa.mesh.io.lane import LaneSender
    from rmpa.mesh.io.link import PeerLink
    from rmpa.ros.node.subscription import TopicConnection


class FlowSender(Protocol):
    """What a flow passes its messages to: the route to a peer, or a subscriber that joins there."""

    @property
    def drained(self) -> bool: ...  # noqa: D102 - as of RouteSender
    def message(self, stamp_ns: int, framed: bytes) -> int: ...  # noqa: D102
    def skip(self, sequence: int) -> None: ...  # noqa: D102
    def begin(self, stamp_ns: int, size: int) -> tuple[LaneSender, QueuedMessage] | None: ...  # noqa: D102
    def drain(self, done: Callable[[], None]) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


@dataclass(slots=True, eq=False)
class ExportRoute:
    """A source on its way to one peer.

    Args:
        session: The peer.
        source: The source.
        number: The route's id; 0 while it is suspended: its peer has no link.
        contract: The contract in force: the stronger terms of both ends.
        asked: The contract that the peer asked for.
        position: Epoch and last message that the peer has of the source, by this or another path; ``None``: nothing.
        unknown: Whether an earlier run of the peer's module may have missed messages.
        shared: Whether the publisher was connected before.
        sender: Sends the messages, and keeps those that the peer does not have; ``None`` until the publisher answers.
        audience: The connections to the publisher that stand for the peer's listeners, by their names here.
        joins: The peer's subscribers that join it, by the numbers of their own routes.
    """

    session: PeerRun
    source: Source
    number: int = 0
    contract: Contract = DEFAULT_CONTRACT
    asked: Contract = DEFAULT_CONTRACT
    position: tuple[int, int] | None = None
    unknown: bool = False
    shared: bool = False
    sender: RouteSender | None = None
    audience: dict[str, TopicConnection] = field(default_factory=dict)
    joins: dict[int, FlowSender] = field(default_factory=dict)

    @property
    def peer(self) -> int:
        """The peer's number."""
        return self.session.peer

    @property
    def flows(self) -> bool:
        """Whether data is sent on it now."""
        return self.sender is not None and self.number > 0

    @property
    def reliable(self) -> bool:
        """Whether each message is kept until the peer has it."""
        return self.contract.reliability is Reliability.RELIABLE

    @property
    def outage(self) -> float:
        """For how many seconds its messages are kept without a link."""
        return self.contract.resume_window if self.reliable else mesh_limits.SILENT_GRACE

    def dismiss(self) -> None:
        """Close what stands for single subscribers of the peer."""
        standing: list[TopicConnection | FlowSender] = [*self.audience.values(), *self.joins.values()]
        for one in standing:
            one.close()
        self.audience.clear()


class ExportFlow:
    """From one local publisher to the peers that want it, each by a route sender of its own.

    The messages are numbered here, once for all peers, so that a peer can go on by another path. Only a route with a
    ``max_rate``, whose peer gets some of them, has numbers of its own.

    Args:
        uri: The publisher's slave API.
        new_epoch: Returns the epoch of a new numbering.

    Attributes:
        connection: To the publisher.
        description: The publisher's header, once it has answered.
        routes: Its routes by peer, with the suspended ones.
        history: The last messages, for routes that are opened later.
        _streaming: The senders that pass on the present message in parts, each with its lane.
        _whole: The present message so far, where a sender or the history needs it whole.
        leaving: When the flow ends, once its publisher has.
        latching: Whether the publisher latches: a route opened later gets its last message, whatever the contract.
        large: Whether the publisher has sent a message that came in parts.
        oversized, oversized_bytes: Messages that were left out because they are too long; size of the last one, in
            bytes.
    """

    connection: TopicConnection

    def __init__(self, uri: str = "", new_epoch: Callable[[], int] = int) -> None:
        self.uri = uri
        self._new_epoch = new_epoch
        self.epoch = new_epoch()
        self.description: Description | None = None
        self.routes: dict[int, ExportRoute] = {}
        self._senders: tuple[FlowSender, ...] = ()
        self.history = HistoryCache()
        self._keeping = False
        self._streaming: dict[FlowSender, tuple[LaneSender, QueuedMessage]] = {}
        self._whole: bytearray | None = None
        self._size = self._received = self._stamp = 0
        self.latching = False
        self.large = False
        self.messages = 0
        self.bytes = 0
        self.dropped = 0
        self.oversized = self.oversized_bytes = 0
        self.leaving: asyncio.TimerHandle | None = None
        self._over: Callable[[], None] | None = None

    @property
    def number(self) -> int:
        """The number of the last message."""
        return self.messages & SERIAL_MASK

    @property
    def complete(self) -> bool:
        """Whether the last message is the publisher's last one, if the publisher has gone."""
        return True

    @property
    def flowing(self) -> list[ExportRoute]:
        """Its routes on which data is sent now."""
        return [route for route in self.routes.values() if route.flows]

    def latch(self) -> None:
        """Keep the last message: the publisher latches."""
        self.latching = True
        self.keep(1)

    def keep(self, latched: int, depth: int = 0) -> None:
        """Keep at least the last messages for routes opened later.

        Args:
            latched: For late subscribers, at most ``ros.limits.LATCHED_MAX``.
            depth: For peers of a reliable route that go on by another path.
        """
        self._keeping = True
        self.history.latched = max(self.history.latched, min(latched, ros_limits.LATCHED_MAX))
        self.history.depth = max(self.history.depth, depth)

    def begins(self, route: ExportRoute) -> RouteBegin:
        """Where a route begins: behind what the peer has, else with what late subscribers get."""
        sender, contract = route.sender, route.contract
        epoch, after = route.position or (0, 0)
        if sender is not None and sender.epoch == epoch != 0 and sender.contract.same_route(contract):
            # The peer may have kept messages whose acknowledgement was lost; these are not sent again.
            first = sender.following if is_later(sender.following, after) else serial_add(after, 1)
            return RouteBegin(epoch, first, goes_on=True, resumed=True)
        # Messages kept only for another peer's contract are old data here, perhaps old commands.
        late = contract.kept if contract.durability is Durability.TRANSIENT_LOCAL else int(self.latching)
        kept = self.history.newest(late)
        if contract.max_rate is not None:
            return RouteBegin(self._new_epoch(), 1, kept=tuple(kept))
        goes_on = epoch == self.epoch != 0
        if goes_on:
            behind = self.history.after(after)
            kept = behind if route.reliable else behind[max(0, len(behind) - late) :]
        first = kept[0].sequence if kept else serial_add(self.number, 1)
        return RouteBegin(self.epoch, first, goes_on=goes_on, kept=tuple(kept))

    def last(self, route: ExportRoute) -> int | None:
        """The last message of a route, if the publisher has gone; ``None``: others may have been lost."""
        return route.sender.last if route.sender is not None and self.complete else None

    def add(self, route: ExportRoute, link: PeerLink, begin: RouteBegin | None = None) -> RouteSender:
        """Send on a route, first the kept messages; ``begin`` is what ``begins`` has said."""
        if route.sender is not None:
            self.remove(route)
        begin, contract = begin or self.begins(route), route.contract
        kind = ReliableRouteSender if route.reliable else RouteSender
        sender = kind(link, route.number, contract, begin.epoch, begin.first, large=self.large)
        if route.reliable:
            self.keep(0, kept_for(contract))
        if contract.durability is Durability.TRANSIENT_LOCAL:
            self.keep(contract.kept)
        for message in begin.kept:
            sender.skip(message.sequence)
            sender.message(message.stamp_ns, message.payload)
        route.sender = sender
        self._list_senders()
        return sender

    def remove(self, route: ExportRoute) -> None:
        """Send on a route no more, and drop its waiting messages."""
        sender, route.sender = route.sender, None
        if sender is not None:
            sender.close()
            self._streaming.pop(sender, None)
        route.dismiss()
        self.joins_changed()

    @property
    def latched(self) -> bytes:
        """The last message that is kept; empty if there is none."""
        kept = self.history.newest(1)
        return kept[0].payload if kept else b""

    def joins_changed(self) -> None:
        """Let those see what all get who join a route, and no others any more."""
        self._list_senders()
        self._look_drained()

    def _list_senders(self) -> None:
        own = (route.sender for route in self.routes.values() if route.sender is not None)
        self._senders = (*own, *(join for route in self.routes.values() for join in route.joins.values()))

    def drain(self, over: Callable[[], None]) -> None:
        """Call ``over`` once all peers have all messages, for the publisher has ended; perhaps at once."""
        self._over = over
        for sender in self._senders:
            sender.drain(self._look_drained)
        self._look_drained()

    def ended(self) -> None:
        """Wait for nothing any more."""
        self._over = None
        if self.leaving is not None:
            self.leaving.cancel()

    def _look_drained(self) -> None:
        if self._over is not None and all(sender.drained for sender in self._senders):
            over, self._over = self._over, None
            over()

    def close(self) -> None:
        """Free the kept messages, which may be large; its routes have ended."""
        self.ended()
        self.history.clear()
        self._whole = None

    def message(self, framed: memoryview) -> None:
        """Pass one message on; ``framed`` has its length in front and is valid during the call only."""
        stamp, whole = time.time_ns(), bytes(framed)  # one copy for all, which they may keep
        self.messages += 1
        self.bytes += len(whole)
        for sender in self._senders:
            dropped = sender.message(stamp, whole)
            if dropped:
                self.dropped += dropped
        if self._keeping:
            self.history.append(self.number, stamp, whole)

    def begin(self, size: int) -> None:
        """Begin a message of ``size`` bytes, length field included, that comes in parts."""
        self._stamp = time.time_ns()
        self._size, self._received = size, 0
        self.large = True
        begun = ((sender, sender.begin(self._stamp, size)) for sender in self._senders)
        self._streaming = {sender: opened for sender, opened in begun if opened is not None}
        self._whole = bytearray() if self._keeping or len(self._streaming) < len(self._senders) else None

    def part(self, part: memoryview) -> None:
        """Pass on a part of the message; ``part`` is valid during the call only."""
        for lane, message in self._streaming.values():
            self.dropped += lane.extend(message, part)
        if self._whole is not None:
            self._whole += part
        self._received += len(part)
        if self._received >= self._size:
            self._complete()

    def abort(self) -> None:
        """Abort the message that comes in parts: the publisher closed its connection."""
        for lane, message in self._streaming.values():
            lane.abandon(message)
        self._streaming, self._whole = {}, None

    def _complete(self) -> None:
        self.messages += 1
        self.bytes += self._size
        streamed, self._streaming = self._streaming, {}
        whole, self._whole = self._whole, None
        framed = bytes(whole) if whole is not None else None
        for sender in self._senders:
            if sender in streamed:
                continue
            if framed is not None:
                self.dropped += sender.message(self._stamp, framed)
            else:  # it came during the message
                sender.skip(serial_add(self.number, 1))
        if self._keeping and framed is not None:
            self.history.append(self.number, self._stamp, framed)


class RelayedFlow(ExportFlow):
    """From a proxy to the peers that a relay passes it on to, with the numbers of the messages at their origin.

    What the proxy says first to a new subscriber is known already, by the numbers.

    Args:
        uri: As of ``ExportFlow``.
        new_epoch: As of ``ExportFlow``.
    """

    def __init__(self, uri: str, new_epoch: Callable[[], int]) -> None:
        super().__init__(uri, new_epoch)
        self._source: ImportFlow | None = None
        self._number = 0
        self._ignoring = False

    @property
    def number(self) -> int:
        """The number of the last message."""
        return self._number

    def follow(self, source: ImportFlow, latched: Sequence[bytes]) -> None:
        """Take the numbering of the flow by which the messages come; the proxy has its header now.

        Args:
            source: The flow.
            latched: The messages that the proxy keeps for late subscribers.
        """
        self._source, self._number = source, source.number
        self.epoch = source.epoch or self.epoch
        if source.history is not None:
            self.history = source.history
            return
        self.keep(len(latched))
        for place, framed in enumerate(latched, 1):
            self.history.append(serial_add(self._number, place - len(latched)), time.time_ns(), framed)

    @property
    def complete(self) -> bool:
        """As of ``ExportFlow``; what a relay has got last need not be the publisher's last message."""
        return self._source is not None and self._source.numbering.complete

    def keep(self, latched: int, depth: int = 0) -> None:
        """As of ``ExportFlow``; what the flow that the messages come by keeps is not kept twice."""
        super().keep(latched, depth)
        self._keeping = self._source is None or self.history is not self._source.history

    def message(self, framed: memoryview) -> None:
        """Pass one message on, unless it is one that the proxy has kept."""
        if self._advance():
            super().message(framed)

    def begin(self, size: int) -> None:
        """Begin a message that comes in parts, likewise."""
        self._ignoring = not self._advance()
        if not self._ignoring:
            super().begin(size)

    def part(self, part: memoryview) -> None:
        """As of ``ExportFlow``."""
        if not self._ignoring:
            super().part(part)

    def abort(self) -> None:
        """As of ``ExportFlow``; the connection goes on, and so do the numbers."""
        for sender in self._senders:
            if sender not in self._streaming:
                sender.skip(serial_add(self._number, 1))
        super().abort()

    def catch_up(self) -> None:
        """Let the peers' numbers include what was lost on the way here."""
        if self._source is not None and is_later(self._source.number, self._number):
            self._number = self._source.number
            for sender in self._senders:
                sender.skip(serial_add(self._number, 1))

    def _advance(self) -> bool:
        """Whether the message that comes is a new one; what was lost before it is a gap for the peers too."""
        if self._source is None or (number := self._source.number) == self._number:
            return False
        if number != serial_add(self._number, 1):
            for sender in self._senders:
                sender.skip(number)
        self._number = number
        return True
