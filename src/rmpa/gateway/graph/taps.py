"""Subscriptions of the gateway to the topics of its own graph."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.ros.node.in_process import InProcessConnection
from rmpa.ros.node.subscription import PublisherConnection
from rmpa.ros.wire.tcpros import LENGTH, TopicDescription

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.gateway.neighbour import MeshSource
    from rmpa.ros.node.publication import Publication
    from rmpa.ros.wire.tcpros import Header

_PREFIX = LENGTH.size


class TopicTap:
    """A subscription to one topic of one node; it reconnects until it is closed or the source is gone.

    Args:
        source: The topic.
        caller_id: The subscribing node.
        number: Returns the connection's number within that node.
        find: ``(node, slave API, topic)``: the topic of a proxy of this process; ``None`` for other publishers.
        on_message: ``(body)``.
        on_described: ``(description)``.
        on_lost: ``(reason)``.
        on_closed: Called once it is closed.
    """

    def __init__(
        self,
        source: MeshSource,
        caller_id: str,
        number: Callable[[], int],
        find: Callable[[str, str, str], Publication | None],
        *,
        on_message: Callable[[memoryview], None],
        on_described: Callable[[TopicDescription], None],
        on_lost: Callable[[str], None],
        on_closed: Callable[[TopicTap], None],
    ) -> None:
        self.source = source
        self._caller_id = caller_id
        self._number = number
        self._find = find
        self._on_message = on_message
        self._on_described = on_described
        self._on_lost = on_lost
        self._on_closed = on_closed
        self.connection: PublisherConnection | InProcessConnection | None = None
        """The connection to the publisher; ``None`` while its address is not known."""
        self._description: TopicDescription | None = None
        self._closed = False

    @property
    def description(self) -> TopicDescription | None:
        """The publisher's header; ``None`` until it is connected."""
        connected = self.connection is not None and self.connection.connected
        return self._description if connected else None

    def follow(self, uri: str) -> None:
        """Connect to the publisher at this slave API, unless it is connected there already.

        Args:
            uri: The publisher's address; empty: it is not in the graph.
        """
        connection = self.connection
        if self._closed or (connection is not None and connection.uri == uri and connection.refused is None):
            return
        if connection is not None:
            connection.close()
            self.connection = None
            if connection.uri != uri:
                self._on_lost("its node is at another address now" if uri else "its node has gone")
        if uri and not self._closed:
            self._connect(uri)

    def _connect(self, uri: str) -> None:
        on_message, here, proxy = self._on_message, self.source.here, self.source.proxy
        if self._find(proxy, uri, here) is not None:
            self.connection = InProcessConnection(
                here,
                uri,
                self._caller_id,
                lambda: self._find(proxy, uri, here),
                on_message=lambda framed: on_message(framed[_PREFIX:]),
                on_header=self._described,
                on_refused=self._refused,
                on_lost=self._on_lost,
                number=self._number(),
            )
        else:
            self.connection = PublisherConnection(
                here,
                uri,
                self._caller_id,
                on_message=lambda framed: on_message(framed[_PREFIX:]),
                on_header=self._described,
                on_refused=self._refused,
                on_lost=self._on_lost,
                number=self._number(),
            )
        self.connection.start()

    def _refused(self, text: str) -> None:
        self._on_lost(f"its publisher refuses: {text}")

    def _described(self, fields: Header) -> None:
        self._description = TopicDescription.from_header(fields)
        self._on_described(self._description)

    def close(self) -> None:
        """Disconnect; no callback is called afterwards."""
        if self._closed:
            return
        self._closed = True
        if self.connection is not None:
            self.connection.close()
        self._on_closed(self)
