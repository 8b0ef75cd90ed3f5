"""The publishing end of one topic, and the connections that other nodes open.

It sends raw bytes. A publication of a node of this program has its type from the start. The publication of a proxy
gets the type when the route to the remote publisher opens, and holds its subscribers until then.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, Protocol, TypeAlias

from rmpa.core.log import logged_failure
from rmpa.core.outbox import URGENT, Outbox, QueuedMessage
from rmpa.ros import limits
from rmpa.ros.http.rpc import keep_alive, tcpros_info
from rmpa.ros.wire.slave_api import OUTBOUND, BusConnection
from rmpa.ros.wire.tcpros import TopicDescription, check_subscriber, encode_header, printable, publisher_header
from rmpa.runtime import limits as runtime_limits
from rmpa.runtime.stream import OnBytes, Stream

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from rmpa.ros.node.subscription import InProcessConnection
    from rmpa.ros.wire.tcpros import Buffer, Header
    from rmpa.ros.wire.xmlrpc import RosReply

    SubscriberConnection: TypeAlias = "AcceptedConnection | InProcessConnection"

_log = logging.getLogger(__name__)
_NOTHING: Final[Mapping[str, str]] = MappingProxyType({})
# The outbox key of messages.
_MESSAGES: Final = 0


def _ended(*_: object) -> None:
    """The ``on_end`` of a connection that no publication and no service has."""


class AcceptedConnection(Stream):
    """A connection that another node opened to a node of this process, whose header has come: messages or replies go.

    Args:
        sock: Accepted, non-blocking; owned from here on.
        number: The node's own number for this connection.
        request: The other side's header, which has been read.

    Attributes:
        on_data: Gets the bytes after the header, as ``on_bytes`` of a stream; with ``None``, as for subscribers, they
            are dropped.
        on_end: Called once when the other side closed the connection or broke the protocol (then with the error); not
            after ``close()`` or ``refuse()``. The publication or service that takes the connection replaces it.
        since: The count of its publication's messages when it was served.
    """

    def __init__(self, sock: socket.socket, number: int, request: Header) -> None:
        self.number = number
        self.request = request
        self.info = tcpros_info(sock)
        self.peer: tuple[str, int] = sock.getpeername()[:2]
        self.since = 0
        self.on_end: Callable[[AcceptedConnection, Exception | None], None] = _ended
        self.on_data: OnBytes | None = None
        self._socket = sock
        keep_alive(sock)
        outbox = Outbox(limits.SUBSCRIBER_QUEUE_MESSAGES, limits.SUBSCRIBER_QUEUE_BYTES)
        super().__init__(sock, on_bytes=self._take, on_close=lambda error: self.on_end(self, error), outbox=outbox)

    @property
    def caller_id(self) -> str:
        """The other node's name, from its header."""
        return self.request.get("callerid", "")

    @property
    def dropped(self) -> int:
        """Messages dropped because the other side is slow."""
        return self.outbox.dropped[_MESSAGES]

    def accept(self, header: Mapping[str, str], *, nodelay: bool = False) -> None:
        """Answer with the reply header; messages may follow. Does nothing if the connection has ended already.

        Args:
            header: The reply header.
            nodelay: Whether TCP_NODELAY is set even if the other side did not ask for it.
        """
        if self.closed:  # while it was held; ``on_end`` follows
            return
        if nodelay or self.request.get("tcp_nodelay") == "1":
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.send([encode_header(header)], URGENT)

    def bound(self, messages: int, size: int = limits.SUBSCRIBER_QUEUE_BYTES) -> None:
        """Set the most messages and bytes in the queue; one message always fits."""
        self.outbox.set_bounds(messages, size)

    def refuse(self, text: str) -> None:
        """Answer with an error header and close; the other side does not try again by itself."""
        self.send([encode_header({"error": text})], URGENT)
        self.close()

    def hang_up(self, *, drain: bool = False) -> None:
        """Close without a call of ``on_end``, at once or when all that waits is sent."""
        self.on_end = _ended
        if drain:
            self.leave(limits.SUBSCRIBER_DRAIN)
        else:
            self.close()

    def _take(self, data: memoryview) -> tuple[int, int]:
        # A subscriber sends nothing more; reading goes on to detect the end of the stream.
        return self.on_data(data) if self.on_data is not None else (len(data), 0)


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

    def join(self, connection: SubscriberConnection) -> Receiver | None:  # noqa: ARG002 - of those who override it
        """A subscriber connects to a topic that is served; return what takes the messages in its place."""
        return None

    def request(self, caller: str) -> Awaitable[RosReply | None] | None:  # noqa: ARG002 - of those who override it
        """Answer the ``requestTopic`` of a subscriber with this caller id.

        Its reply of ``None`` is the publication's own address. ``None`` instead of an awaitable: no need to wait.
        """
        return None


class Receiver(Protocol):
    """What takes the messages of a publication: a subscriber, or what stands for one."""

    def send(self, parts: Sequence[Buffer], key: int) -> int:
        """Take one message."""

    def open(self, key: int, size: int) -> QueuedMessage:
        """A message of ``size`` bytes begins."""

    def extend(self, message: QueuedMessage, data: Buffer) -> int:
        """Take a part of it."""

    def abandon(self, message: QueuedMessage) -> bool:
        """Its rest will not come; return whether the connection must be closed for that."""

    def close(self) -> None:
        """End."""


_NO_EVENTS: Final = PublicationEvents()


class Publication:
    """One topic of one (real or proxy) node, with its subscribers.

    Demand is the number of connections. While there is no description they are held, and get no messages.

    Args:
        topic: Its global name; compared literally with what subscribers ask for.
        caller_id: The publishing node's name.
        description: Type, md5 sum, definition and latching, or ``None`` until ``describe()``.
        events: What is called at changes.
        queue_messages: Messages queued for one slow subscriber; above it the oldest is dropped.

    Attributes:
        messages: Messages published.
        bytes: Bytes published, lengths included; each message counts once, whatever the number of subscribers.
        latched: The messages kept for later subscribers, oldest first, with their lengths in front.
    """

    # More than 12 fields: what is sent to new subscribers, the bounds of their queues, and the message in progress.
    def __init__(
        self,
        topic: str,
        caller_id: str,
        description: TopicDescription | None = None,
        *,
        events: PublicationEvents = _NO_EVENTS,
        queue_messages: int = limits.SUBSCRIBER_QUEUE_MESSAGES,
    ) -> None:
        self.topic = topic
        self.caller_id = caller_id
        self.events = events
        self.messages = 0
        self.bytes = 0
        self.description: TopicDescription | None = None
        self.latched: tuple[bytes, ...] = ()
        self._keeps = 1
        self._reply = _NOTHING
        self._queue_messages = queue_messages
        self._connections: tuple[SubscriberConnection, ...] = ()
        # What takes messages in the place of subscribers.
        self._joining: dict[SubscriberConnection, Receiver] = {}
        self._receivers: tuple[Receiver, ...] = ()
        # The message in progress: the bytes to come, the subscribers that have its beginning, and, if it will be
        # latched, what has come.
        self._left = 0
        self._partial: Sequence[tuple[Receiver, QueuedMessage]] = ()
        self._whole: bytearray | None = None
        self._dropped_before = 0
        if description is not None:
            self.describe(description)

    @property
    def subscribers(self) -> int:
        """Connections, held ones included."""
        return len(self._connections)

    @property
    def listeners(self) -> tuple[str, ...]:
        """The caller ids of the subscribers that are served."""
        return tuple(one.caller_id for one in self._connections) if self.description is not None else ()

    @property
    def callers(self) -> frozenset[str]:
        """The caller ids of all subscribers that are connected, held ones included."""
        return frozenset(one.caller_id for one in self._connections)

    @property
    def dropped(self) -> int:
        """Messages dropped for slow subscribers, those that have disconnected included."""
        return self._dropped_before + sum(one.dropped for one in self._connections)

    def connections(self) -> list[BusConnection]:
        """All connections, for ``getBusInfo`` and ``getBusStats``."""
        served = self.description is not None
        return [
            BusConnection(
                one.number,
                one.caller_id,
                OUTBOUND,
                self.topic,
                served,
                one.info,
                one.bytes_out,
                self.messages - one.since if served else 0,
                one.dropped,
                one.pending_bytes,
            )
            for one in self._connections
        ]

    def attach(self, connection: SubscriberConnection) -> None:
        """Take over a connection whose header names this topic: serve it, hold it, or refuse it."""
        connection.on_end = self._gone
        if not self._admit(connection):
            return
        self._connections += (connection,)
        if self.description is not None:
            if (receiver := self.events.join(connection)) is not None:
                self._joining[connection] = receiver
            self.events.listeners_changed()
        self._list_receivers()
        if len(self._connections) == 1:
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
        reply = publisher_header(self.topic, self.caller_id, description)
        before, connections, held = self._reply, self._connections, self.description is None
        self.description, self._reply = description, reply
        if held:
            self._connections = ()
            for connection in connections:
                with logged_failure(_log, "%s: subscriber %s failed", self.topic, printable(connection.caller_id)):
                    if self._admit(connection):
                        self._connections += (connection,)
            self._list_receivers()
            if connections:
                self.events.listeners_changed()
                if not self._connections:
                    self.events.last_subscriber()
        elif before != reply:
            self.latched = ()
            self._end(connections)
            return len(connections)
        return 0

    def publish_framed(self, framed: Buffer) -> int:
        """Send one message to all subscribers, independently of each other.

        Args:
            framed: The message with its 4-byte length in front. It is copied where it is queued.

        Returns:
            Older messages dropped for it, over all subscribers.
        """
        self.messages += 1
        self.bytes += len(framed)
        if self.description is None:
            return 0
        if self.description.latching:
            self._latch(bytes(framed))
        parts, dropped = (framed,), 0
        for receiver in self._receivers:
            dropped += receiver.send(parts, _MESSAGES)
        return dropped

    def begin(self, size: int) -> None:
        """Begin a message of ``size`` bytes, its length included, whose parts follow.

        A subscriber that connects before the message's end does not get it, unless the topic is latched.
        """
        self._left = size
        if self.description is not None:
            self._partial = [(receiver, receiver.open(_MESSAGES, size)) for receiver in self._receivers]
            self._whole = bytearray() if self.description.latching else None

    def extend(self, part: Buffer) -> None:
        """Send the next part to all subscribers that have the message's beginning."""
        for receiver, message in self._partial:
            receiver.extend(message, part)
        self.bytes += len(part)
        self._left -= len(part)
        if self._whole is not None:
            self._whole += part
        if self._left:
            return
        self.messages += 1
        served = {receiver for receiver, _ in self._partial}
        self._partial = ()
        if self._whole is not None:
            framed, self._whole = bytes(self._whole), None
            self._latch(framed)
            for receiver in self._receivers:
                if receiver not in served:
                    receiver.send((framed,), _MESSAGES)

    def abort(self) -> int:
        """Give up the message in progress, whose rest will not arrive.

        Subscribers that got its beginning are disconnected: TCPROS has no way to take back half a message.

        Returns:
            The number of disconnected subscribers: if any, the owner should register the topic again.
        """
        broken = {receiver for receiver, message in self._partial if receiver.abandon(message)}
        self._partial, self._whole = (), None
        self._end([one for one in self._connections if one in broken])
        return len(broken)

    def join(self) -> None:
        """Treat all present subscribers as new ones."""
        for connection in self._connections:
            if connection not in self._joining and (receiver := self.events.join(connection)) is not None:
                self._joining[connection] = receiver
        self._list_receivers()

    def joined(self, connection: SubscriberConnection) -> None:
        """Send to a subscriber itself from now on."""
        if self._joining.pop(connection, None) is not None:
            self._list_receivers()

    def _list_receivers(self) -> None:
        self._receivers = tuple(self._joining.get(one, one) for one in self._connections)

    def bound(self, messages: int) -> None:
        """Set the bound on messages queued for one slow subscriber."""
        self._queue_messages = min(messages, limits.SUBSCRIBER_QUEUE_MESSAGES)
        for connection in self._connections:
            connection.bound(self._queue_messages)

    def keep(self, depth: int) -> None:
        """Set the number of latched messages that are kept for later subscribers."""
        self._keeps = max(1, min(depth, limits.LATCHED_MAX))
        self.latched = self.latched[-self._keeps :]

    def forget_latched(self) -> None:
        """Drop the latched messages, because their source is gone or will send them again."""
        self.latched = ()

    def hang_up(self, caller_id: str) -> bool:
        """Close the connections of one subscriber; return whether there was one."""
        gone = [connection for connection in self._connections if connection.caller_id == caller_id]
        self._end(gone)
        return bool(gone)

    async def drained(self, timeout: float = runtime_limits.DRAIN_TIMEOUT) -> None:  # noqa: ASYNC109 - for all together
        """Wait until all published messages are sent, at most ``timeout`` seconds."""
        await asyncio.gather(*(connection.drained(timeout) for connection in self._connections))

    def withdraw(self) -> None:
        """Close all connections without an event, once each has been sent what was published."""
        self.events = _NO_EVENTS
        self.latched, self._whole = (), None
        begun = {receiver for receiver, _ in self._partial}
        self._end([one for one in self._connections if one in begun])
        self._end(self._connections, drain=True)

    def _latch(self, framed: bytes) -> None:
        self.latched = (*self.latched, framed)[-self._keeps :]

    def _admit(self, connection: SubscriberConnection) -> bool:
        """Serve a connection, or hold it until the type is known; return ``False`` if it is refused or has ended."""
        who = printable(connection.caller_id)
        problem = check_subscriber(connection.request, self.topic, self.caller_id, self.description)
        if problem is not None:
            _log.debug("! %s: refuses subscriber %s: %s", self.topic, who, problem)
            connection.refuse(problem)
            self.events.mismatch(connection.request, problem)
            return False
        if self.description is None:
            _log.debug("= %s: holds subscriber %s until the type is known", self.topic, who)
            return True
        _log.debug("> %s: serves subscriber %s at %s", self.topic, who, connection.peer[0])
        connection.bound(self._queue_messages)
        connection.accept(self._reply)
        connection.since = self.messages - len(self.latched)
        for framed in self.latched:
            connection.send((framed,), _MESSAGES)
        return not connection.closed

    def _end(self, connections: Sequence[SubscriberConnection], *, drain: bool = False) -> None:
        """Close connections and forget them."""
        if not connections:
            return
        gone = set(connections)
        for receiver in [self._joining.pop(one) for one in connections if one in self._joining]:
            receiver.close()
        self._dropped_before += sum(one.dropped for one in gone)
        self._partial = [each for each in self._partial if each[0] not in gone]
        left = tuple(one for one in self._connections if one not in gone)
        ended, self._connections = len(left) < len(self._connections), left
        self._list_receivers()
        for connection in connections:
            connection.hang_up(drain=drain)
        self.events.listeners_changed()
        if ended and not left:
            self.events.last_subscriber()

    def _gone(self, connection: SubscriberConnection, error: Exception | None) -> None:
        _log.debug("< %s: subscriber %s is gone (%s)", self.topic, printable(connection.caller_id), error or "closed")
        self._end((connection,))
