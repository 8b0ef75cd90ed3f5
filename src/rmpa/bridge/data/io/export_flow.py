"""The data path from one local publisher to the peers; only what each message needs is done here.

An ``ExportFlow`` is called from a socket's read callback with a view of its buffer, and passes it on with one system
call for each receiver, a large message in parts while it still arrives. It takes routes as commands and shares no
state with the planning side.
"""

from __future__ import annotations

import time
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING

from rmpa.bridge.data.io.route_sender import ReliableRouteSender, RouteSender, make_route_sender
from rmpa.core.contract import Contract, Durability
from rmpa.ros import limits as ros_limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.mesh.io.link import PeerLink


class ExportFlow:
    """From one local publisher to the peers that want it, each by a route sender of its own."""

    __slots__ = (
        "_history",
        "_keeping",
        "_received",
        "_senders",
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
        self._senders: tuple[RouteSender, ...] = ()
        self._history: deque[tuple[bytes, int]] = deque(maxlen=1)
        """Bytes and stamps of the last messages, for routes that are opened later."""
        self._keeping = False
        self._streaming: list[RouteSender] = []
        """The senders that pass on the present message in parts."""
        self._whole: bytearray | None = None
        """The present message so far, where a sender or the history needs it whole."""
        self._size = self._received = self._stamp = 0
        self.latching = False
        """Whether the publisher latches: a route opened later gets its last message, whatever the contract."""
        self.large = False
        """Whether the publisher has sent a message that came in parts."""
        self.messages = 0
        self.bytes = 0
        self.dropped = 0
        self.oversized = self.oversized_bytes = 0
        """Messages that were left out because they are too long; size of the last one, in bytes."""

    def left_out(self, size: int) -> None:
        """Count a message of ``size`` bytes that was too long."""
        self.oversized += 1
        self.oversized_bytes = size

    def latch(self) -> None:
        """Keep the last message: the publisher latches."""
        self.latching = True
        self.keep(1)

    def keep(self, depth: int) -> None:
        """Keep at least the last ``depth`` messages, at most ``ros.limits.LATCHED_MAX``, for routes opened later."""
        self._keeping = True
        if depth > (self._history.maxlen or 0):
            self._history = deque(self._history, maxlen=min(depth, ros_limits.LATCHED_MAX))

    def add(self, peer: int, link: PeerLink, route: int, contract: Contract, epoch: int) -> RouteSender:
        """Send to one more peer; first the kept messages that its contract, or the latching publisher, allows."""
        self.remove(peer)
        sender = make_route_sender(link, route, contract, epoch, large=self.large)
        if contract.durability is Durability.TRANSIENT_LOCAL:
            self.keep(contract.kept)
        # Messages kept only for another peer's contract are old data here, perhaps old commands.
        kept = contract.kept if contract.durability is Durability.TRANSIENT_LOCAL else int(self.latching)
        for framed, stamp in islice(self._history, max(0, len(self._history) - kept), None):
            sender.message(stamp, framed)
        self.by_peer[peer] = sender
        self._senders = tuple(self.by_peer.values())
        return sender

    def suspend(self, peer: int, keep: Callable[[bytes, int], object] | None = None) -> None:
        """Suspend the reliable route of a peer whose link is gone; see ``ReliableRouteSender.suspend``."""
        sender = self.by_peer.get(peer)
        if isinstance(sender, ReliableRouteSender):
            sender.suspend(keep)

    def remove(self, peer: int) -> None:
        """Stop sending to a peer."""
        sender = self.by_peer.pop(peer, None)
        if sender is not None:
            sender.close()
            self._senders = tuple(self.by_peer.values())
            if sender in self._streaming:
                self._streaming.remove(sender)

    def close(self) -> None:
        """Remove all peers, and free the kept messages, which may be large."""
        for peer in tuple(self.by_peer):
            self.remove(peer)
        self._history.clear()
        self._whole = None

    def message(self, framed: memoryview) -> None:
        """Pass one message on; ``framed`` has its length in front and is valid during the call only."""
        stamp = time.time_ns()
        self.messages += 1
        self.bytes += len(framed)
        for sender in self._senders:
            dropped = sender.message(stamp, framed)
            if dropped:
                self.dropped += dropped
        if self._keeping:
            self._history.append((bytes(framed), stamp))

    def begin(self, size: int) -> None:
        """Begin a message of ``size`` bytes, length field included, that comes in parts."""
        self._stamp = time.time_ns()
        self._size, self._received = size, 0
        self.large = True
        self._streaming = [sender for sender in self._senders if sender.begin(self._stamp, size)]
        self._whole = bytearray() if self._keeping or len(self._streaming) < len(self._senders) else None

    def part(self, part: memoryview) -> None:
        """Pass on a part of the message; ``part`` is valid during the call only."""
        for sender in self._streaming:
            self.dropped += sender.part(part)
        if self._whole is not None:
            self._whole += part
        self._received += len(part)
        if self._received >= self._size:
            self._complete()

    def abort(self) -> None:
        """Abort the message that comes in parts: the publisher closed its connection."""
        for sender in self._streaming:
            sender.abort()
        self._streaming = []
        self._whole = None

    def _complete(self) -> None:
        self.messages += 1
        self.bytes += self._size
        streamed, self._streaming = self._streaming, []
        if self._whole is None:
            return
        whole, self._whole = bytes(self._whole), None
        for sender in self._senders:
            if sender not in streamed:
                self.dropped += sender.message(self._stamp, whole)
        if self._keeping:
            self._history.append((whole, self._stamp))
