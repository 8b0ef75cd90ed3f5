"""The publishing end of one topic.

It sends raw bytes. A publication of a node of this program has its type from the start. The publication of a proxy
gets the type when the route to the remote publisher opens, and holds its subscribers until then.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, TypeAlias

from rmpa.core.counters import logged_failure
from rmpa.ros import limits
from rmpa.ros.wire.slave_api import OUTBOUND, BusConnection
from rmpa.ros.wire.tcpros import TopicDescription, check_subscriber, printable, publisher_header
from rmpa.runtime import limits as runtime_limits

if TYPE_CHECKING:
    from collections.abc import Awaitable, Mapping, Sequence

    from rmpa.core.outbox import QueuedMessage
    from rmpa.ros.node.accepted_connection import AcceptedConnection
    from rmpa.ros.node.in_process import InProcessSubscriber
    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.ros.wire.xmlrpc import RosReply

    SubscriberConnection: TypeAlias = AcceptedConnection | InProcessSubscriber

_log = logging.getLogger(__name__)


_NOTHING: Final[Mapping[str, str]] = MappingProxyType({})


class PublicationEvents:
    """What a publication tells its owner, which overrides what it needs.

    All are called in the event loop, and may call methods of the publication.
    """

    __slots__ = ()

    def first_subscriber(self) -> None:
        """Demand rises from 0."""

    def last_subscriber(self) -> None:
        """Demand returns to 0."""

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        """A subscriber was refused; its header and the text of the error header."""

    def listeners_changed(self) -> None:
        """``Publication.listeners`` has changed."""

    def request(self, caller: str) -> Awaitable[RosReply | None] | None:  # noqa: ARG002 - of those who override it
        """Answer the ``requestTopic`` of a subscriber with this caller id.

        Its reply of ``None`` is the publication's own address. ``None`` instead of an awaitable: no need to wait.
        """
        return None


_NO_EVENTS: Final = PublicationEvents()


class Publication:
    """One topic of one (real or proxy) node, with its subscribers.

    Demand is the number of connections, held ones included.

    Args:
        topic: Its global name; compared literally with what subscribers ask for.
        caller_id: The publishing node's name.
        description: Type, md5 sum, definition and latching, or ``None`` until ``describe()``.
        events: What is called at changes.
        queue_messages: Messages queued for one slow subscriber; above it the oldest is dropped.
        queue_bytes: Bytes queued for one slow subscriber; one message always fits.
    """

    __slots__ = (
        "_description",
        "_dropped_before",
        "_held",
        "_latched",
        "_left",
        "_open",
        "_partial",
        "_queue_bytes",
        "_queue_messages",
        "_reply",
        "_size",
        "_whole",
        "_withdrawn",
        "bytes",
        "caller_id",
        "events",
        "messages",
        "topic",
    )

    def __init__(
        self,
        topic: str,
        caller_id: str,
        description: TopicDescription | None = None,
        *,
        events: PublicationEvents = _NO_EVENTS,
        queue_messages: int = limits.SUBSCRIBER_QUEUE_MESSAGES,
        queue_bytes: int = limits.SUBSCRIBER_QUEUE_BYTES,
    ) -> None:
        self.topic = topic
        self.caller_id = caller_id
        self.messages = 0
        """Messages published."""
        self.bytes = 0
        """Bytes published, lengths included; each message counts once, whatever the number of subscribers."""
        self._description: TopicDescription | None = None
        self._reply: Mapping[str, str] = _NOTHING
        self.events = events
        """Latched messages that a subscriber has had by another path, by its caller id."""
        self._queue_messages = queue_messages
        self._queue_bytes = queue_bytes
        self._held: tuple[SubscriberConnection, ...] = ()
        self._open: tuple[SubscriberConnection, ...] = ()
        # Empty containers take most of the memory of a topic without a subscriber; these are made when needed.
        self._latched: deque[bytes] | None = None
        self._partial: Sequence[tuple[SubscriberConnection, QueuedMessage]] = ()
        self._whole: bytearray | None = None
        self._size = self._left = 0
        self._dropped_before = 0
        self._withdrawn = False
        if description is not None:
            self.describe(description)

    @property
    def description(self) -> TopicDescription | None:
        """The description, once it is known."""
        return self._description

    @property
    def latched(self) -> tuple[bytes, ...]:
        """The messages kept for later subscribers, oldest first, with their lengths in front."""
        return tuple(self._latched) if self._latched is not None else ()

    @property
    def subscribers(self) -> int:
        """Connections, held ones included."""
        return len(self._held) + len(self._open)

    @property
    def listeners(self) -> tuple[str, ...]:
        """The caller ids of the subscribers that are served."""
        return tuple(connection.caller_id for connection in self._open)

    @property
    def callers(self) -> frozenset[str]:
        """The caller ids of all subscribers that are connected, held ones included."""
        return frozenset(connection.caller_id for connection in (*self._open, *self._held))

    @property
    def dropped(self) -> int:
        """Messages dropped for slow subscribers, those that have disconnected included."""
        return self._dropped_before + sum(connection.dropped for connection in self._open)

    def connections(self) -> list[BusConnection]:
        """All connections, for ``getBusInfo`` and ``getBusStats``."""
        return [
            BusConnection(
                connection.number,
                connection.caller_id,
                OUTBOUND,
                self.topic,
                connection in self._open,
                connection.info,
                connection.stream.bytes_out,
                connection.messages,
                connection.dropped,
                connection.stream.pending_bytes,
            )
            for connection in (*self._open, *self._held)
        ]

    def attach(self, connection: SubscriberConnection) -> None:
        """Take over a connection whose header names this topic: serve it, hold it, or refuse it."""
        problem = check_subscriber(connection.fields, self.topic, self.caller_id, self._description)
        if problem is not None:
            self._refuse(connection, problem)
            return
        first = self.subscribers == 0
        connection.on_end = self._gone
        if self._description is None:
            _log.debug(
                "= %s: holds subscriber %s until the type is known", self.topic, printable(connection.caller_id)
            )
            self._held += (connection,)
        else:
            self._serve(connection)
        if first and self.subscribers:
            self.events.first_subscriber()

    def describe(self, description: TopicDescription) -> int:
        """Set the description: held subscribers that match are served, the others refused.

        A restarted publisher may have another definition. Subscribers with the old one are disconnected, because
        TCPROS has no other way to notify them; rospy reconnects at the next ``publisherUpdate``.

        Returns:
            The number of disconnected subscribers: if any, the owner should register the topic again.

        Raises:
            ValueError: Type or md5 sum is ``*``; see ``tcpros.publisher_header``.
        """
        before = self.subscribers
        reply = publisher_header(self.topic, self.caller_id, description)
        old: tuple[SubscriberConnection, ...] = ()
        if self._reply and self._reply != reply:
            self._latched = None
            old, self._open = self._open, ()
            self.events.listeners_changed()
            for connection in old:
                self._count_dropped(connection)
                connection.close()
        self._description = description
        self._reply = reply
        for connection in self._held:
            problem = check_subscriber(connection.fields, self.topic, self.caller_id, description)
            with logged_failure(_log, "%s: subscriber %s failed", self.topic, printable(connection.caller_id)):
                if problem is None:
                    self._serve(connection)
                else:
                    self._refuse(connection, problem)
            self._held = tuple(other for other in self._held if other is not connection)
        if before and not self.subscribers:
            self.events.last_subscriber()
        return len(old)

    def publish_framed(self, framed: Buffer) -> int:
        """Send one message to all subscribers, independently of each other.

        Args:
            framed: The message with its 4-byte length in front. It is copied where it is queued.

        Returns:
            Older messages dropped for it, over all subscribers.
        """
        self.messages += 1
        self.bytes += len(framed)
        if self._description is not None and self._description.latching:
            self._keep_latched(bytes(framed))
        dropped = 0
        for connection in self._open:
            dropped += connection.send(framed)
        return dropped

    def begin(self, size: int) -> None:
        """Begin a message of ``size`` bytes, its length included, whose parts follow.

        A subscriber that connects before the message's end does not get it, unless the topic is latched.
        """
        self._size = self._left = size
        self._partial = [(connection, connection.begin(size)) for connection in self._open]
        latching = self._description is not None and self._description.latching
        self._whole = bytearray() if latching else None

    def extend(self, part: Buffer) -> None:
        """Send the next part to all subscribers that have the message's beginning."""
        for connection, message in self._partial:
            connection.extend(message, part)
        self._left -= len(part)
        if self._whole is not None:
            self._whole += part
        if self._left:
            return
        self.messages += 1
        self.bytes += self._size
        partial, self._partial = self._partial, ()
        if self._whole is not None:
            framed, self._whole = bytes(self._whole), None
            self._keep_latched(framed)
            served = {connection for connection, _ in partial}
            for connection in self._open:
                if connection not in served:
                    connection.send(framed)

    def abort(self) -> int:
        """Give up the message in progress, whose rest will not arrive.

        Subscribers that got its beginning are disconnected: TCPROS has no way to take back half a message.

        Returns:
            The number of disconnected subscribers: if any, the owner should register the topic again.
        """
        broken = [connection for connection, message in self._partial if connection.abandon(message)]
        self._partial = ()
        self._whole = None
        before = self.subscribers
        for connection in broken:
            self._count_dropped(connection)
            connection.close()
        self._open = tuple(connection for connection in self._open if connection not in broken)
        self.events.listeners_changed()
        if before and not self.subscribers:
            self.events.last_subscriber()
        return len(broken)

    def bound(self, messages: int) -> None:
        """Set the bound on messages queued for one slow subscriber."""
        self._queue_messages = min(messages, limits.SUBSCRIBER_QUEUE_MESSAGES)
        for connection in self._open:
            connection.bound(self._queue_messages, self._queue_bytes)

    def keep(self, depth: int) -> None:
        """Set the number of latched messages that are kept for later subscribers."""
        self._latched = deque(self._latched or (), maxlen=min(depth, limits.LATCHED_MAX))

    def forget_latched(self) -> None:
        """Drop the latched messages, because their source is gone or will send them again."""
        if self._latched is not None:
            self._latched.clear()

    def hang_up(self, caller_id: str) -> bool:
        """Close the connections of one subscriber; return whether there was one."""
        gone = [connection for connection in (*self._open, *self._held) if connection.caller_id == caller_id]
        for connection in gone:
            connection.close()
            self._gone(connection, None)
        return bool(gone)

    async def drained(self, timeout: float = runtime_limits.DRAIN_TIMEOUT) -> None:  # noqa: ASYNC109 - for all together
        """Wait until all published messages are sent, at most ``timeout`` seconds."""
        if self._open:
            await asyncio.gather(*(connection.stream.drained(timeout) for connection in self._open))

    def withdraw(self) -> None:
        """Close all connections without calling ``last_subscriber``."""
        self._withdrawn = True
        connections, self._held, self._open = (*self._held, *self._open), (), ()
        for connection in connections:
            self._count_dropped(connection)
            connection.close()
        self._latched = None
        self._partial = ()
        self._whole = None

    def _keep_latched(self, framed: bytes) -> None:
        if self._latched is None:
            self._latched = deque(maxlen=1)
        self._latched.append(framed)

    def _serve(self, connection: SubscriberConnection) -> None:
        _log.debug(
            "> %s: serves subscriber %s at %s", self.topic, printable(connection.caller_id), connection.peer[0]
        )
        connection.accept(self._reply, self._queue_messages, self._queue_bytes)
        for framed in self.latched:
            connection.send(framed)
        if not connection.stream.closed:
            self._open += (connection,)
            self.events.listeners_changed()

    def _refuse(self, connection: SubscriberConnection, text: str) -> None:
        _log.debug("! %s: refuses subscriber %s: %s", self.topic, printable(connection.caller_id), text)
        connection.refuse(text)
        self.events.mismatch(connection.fields, text)

    def _count_dropped(self, connection: SubscriberConnection) -> None:
        self._dropped_before += connection.dropped

    def _gone(self, connection: SubscriberConnection, error: Exception | None) -> None:
        _log.debug("< %s: subscriber %s is gone (%s)", self.topic, printable(connection.caller_id), error or "closed")
        before = self.subscribers
        self._count_dropped(connection)
        self._partial = [(other, message) for other, message in self._partial if other is not connection]
        self._held = tuple(other for other in self._held if other is not connection)
        self._open = tuple(other for other in self._open if other is not connection)
        self.events.listeners_changed()
        if before and not self.subscribers and not self._withdrawn:
            self.events.last_subscriber()
