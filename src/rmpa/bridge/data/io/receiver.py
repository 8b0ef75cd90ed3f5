"""Passes the data frames of the links to the handlers of their routes: the path of every message."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

from rmpa.core.errors import RemoteProtocolError
from rmpa.mesh.frames import FrameKind
from rmpa.ros.wire.tcpros import LENGTH

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.bridge.data.io.route_sender import RouteSender
    from rmpa.core.counters import Counters
    from rmpa.mesh.io.link import PeerLink

_LENGTH: Final = LENGTH.size


class DataHandler(Protocol):
    """Takes the data that arrives on one route."""

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """Take a whole message, its 4-byte length in front; ``framed`` is valid during the call only."""
        ...

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Take a part of a large message (``core.outbox`` FIRST, LAST, ABORT); valid during the call only."""
        ...


class DataReceiver:
    """Finds the handler of a frame by its link and its route; drops frames of routes that were closed meanwhile.

    Args:
        counters: Counts dropped frames as ``route.unknown``.
        sender: ``(peer, route)``: returns the sender of a route, for acknowledgements and fences.
    """

    def __init__(self, counters: Counters, sender: Callable[[int, int], RouteSender | None]) -> None:
        self._counters = counters
        self._sender = sender
        self._handlers: dict[PeerLink, Mapping[int, DataHandler]] = {}
        self._peers: dict[PeerLink, int] = {}

    def link_up(self, link: PeerLink, peer: int, handlers: Mapping[int, DataHandler]) -> None:
        """Accept data from a link.

        Args:
            link: The link.
            peer: The number of its peer's session.
            handlers: The handler of each open route, by its id; changes as routes are opened and closed.
        """
        self._handlers[link] = handlers
        self._peers[link] = peer

    def link_down(self, link: PeerLink) -> None:
        """Drop further data of a link that is gone."""
        self._handlers.pop(link, None)
        self._peers.pop(link, None)

    def data(self, link: PeerLink, route: int, sequence: int, stamp_ns: int, payload: memoryview) -> None:
        """Pass on a data frame with a whole message.

        Raises:
            RemoteProtocolError: The frame does not hold exactly one message; the caller closes the link.
        """
        handlers = self._handlers.get(link)
        handler = handlers.get(route) if handlers is not None else None
        if handler is None:
            self._counters.add("route.unknown")
            return
        size = len(payload)
        if size < _LENGTH or LENGTH.unpack_from(payload)[0] != size - _LENGTH:
            raise RemoteProtocolError(f"a data frame of {size} bytes on route {route} does not hold one message")
        handler.message(sequence, stamp_ns, payload)

    def part(self, link: PeerLink, route: int, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        """Pass on a part of a large message."""
        handlers = self._handlers.get(link)
        if handlers is None:
            return
        handler = handlers.get(route)
        if handler is None:
            self._counters.add("route.unknown")
        else:
            handler.part(sequence, stamp_ns, flags, part)

    def mark(self, link: PeerLink, kind: FrameKind, route: int, sequence: int) -> None:
        """Pass an acknowledgement, or the answer to a fence, to the route's sender."""
        peer = self._peers.get(link)
        sender = self._sender(peer, route) if peer is not None else None
        if sender is None:
            return
        if kind is FrameKind.ACK:
            sender.acknowledged(sequence)
        elif kind is FrameKind.FENCED:
            sender.fenced(sequence)
