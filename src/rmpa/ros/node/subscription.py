"""The subscribing end of a topic: a connection to one publisher, and the connections to all publishers."""

from __future__ import annotations

import asyncio
import logging
import random
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.core import limits as core_limits
from rmpa.core.counters import Backoff
from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.core.outbox import URGENT, Outbox
from rmpa.ros import limits
from rmpa.ros.http.rpc import call_api, connect
from rmpa.ros.node.accepted_connection import keep_alive
from rmpa.ros.wire.slave_api import INBOUND, TCPROS, BusConnection
from rmpa.ros.wire.tcpros import (
    ANY,
    LENGTH,
    check_publisher,
    encode_header,
    parse_header,
    printable,
    split_messages,
    subscriber_header,
)
from rmpa.runtime.accept import is_shortage
from rmpa.runtime.stream import Stream

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Iterable

    from rmpa.ros.wire.tcpros import Header

_log = logging.getLogger(__name__)
_PORT_MAX: Final = 65535


def _ignore(*_: object) -> None:
    pass


class PartsTaker(Protocol):
    """Receives a large message in parts, while it still arrives."""

    def begin(self, size: int) -> None:
        """A message of ``size`` bytes, its length included, begins."""

    def part(self, part: memoryview) -> None:
        """The next part of the message; the view is valid during the call only."""

    def abort(self) -> None:
        """The rest of the message will not arrive."""


OUT_OF_FILES: Final = "the subscribing side has no file descriptor left for it; `rmpa doctor` there says what to do"


class PublisherConnection:
    """Connects to one publisher of one topic, and reconnects until it is closed or the publisher refuses it.

    The owner closes the connection when the publisher is no longer registered, and makes a new one for a restarted
    node, which has a new URI. All callbacks are called in the loop, and none after ``close()``.

    Args:
        topic: The topic's global name.
        uri: The publisher's slave API.
        caller_id: The subscribing node; a rospy publisher keeps one connection for each (topic, caller id).
        on_message: ``(framed)``: one message with its 4-byte length in front; the view is only valid during the call.
            It must not raise.
        on_parts: Receives messages above ``core.limits.CUT_THROUGH_BYTES`` in parts while they still arrive; without
            it they too are passed to ``on_message``.
        on_header: ``(fields)``: the publisher's reply header; called at each connection, before its first message.
        on_refused: ``(text)``: the publisher refused, or has another md5 sum; there is no further attempt.
        on_lost: ``(reason)``: the connection failed or ended; it is tried again with back-off. An incomplete message
            is dropped.
        on_oversized: ``(size)``: a message of more than ``limits.TCPROS_MESSAGE_MAX`` begins; it is read and dropped.
        type_name: The type to ask for.
        md5sum: The md5 sum to ask for; ``*`` accepts any.
        definition: The definition to send, if known.
        nodelay: Whether to ask for TCP_NODELAY on the publisher's side.
        number: The connection's number within the node, for ``getBusInfo``.
        rng: Uniform numbers in [0, 1), for the jitter of the back-off.
    """

    def __init__(
        self,
        topic: str,
        uri: str,
        caller_id: str,
        *,
        on_message: Callable[[memoryview], None],
        on_parts: PartsTaker | None = None,
        on_header: Callable[[Header], None] = _ignore,
        on_refused: Callable[[str], None] = _ignore,
        on_lost: Callable[[str], None] = _ignore,
        on_oversized: Callable[[int], None] = _ignore,
        type_name: str = ANY,
        md5sum: str = ANY,
        definition: str = "",
        nodelay: bool = True,
        number: int = 0,
        rng: Callable[[], float] = random.random,
    ) -> None:
        self.topic = topic
        self.uri = uri
        self.fields: Header = {}
        """The publisher's reply header; empty while there is no connection."""
        self.messages = 0
        self.bytes = 0
        self.oversized = 0
        """Messages dropped because they are too long."""
        self.malformed = False
        """Whether the last connection ended because the publisher broke the protocol."""
        self.number = number
        self.refused: str | None = None
        """Why the publisher refused or does not match; ``None`` while it has not refused."""
        self._caller_id = caller_id
        self._type = type_name
        self._md5sum = md5sum
        self._request = encode_header(
            subscriber_header(
                topic, caller_id, type_name=type_name, md5sum=md5sum, definition=definition, nodelay=nodelay
            )
        )
        self._on_message = on_message
        self._parts = on_parts
        self._left = 0
        self._skipping = 0
        self._on_oversized = on_oversized
        self._on_header = on_header
        self._on_refused = on_refused
        self._on_lost = on_lost
        self._backoff = Backoff(limits.TCPROS_RETRY_FIRST, limits.TCPROS_RETRY_MAX, rng)
        self._stream: Stream | None = None
        self._info = ""
        self._ended: asyncio.Future[Exception | None] | None = None
        self._task: asyncio.Task[None] | None = None
        self._closed = False

    @property
    def connected(self) -> bool:
        """Whether the headers have been exchanged."""
        return bool(self.fields)

    @property
    def ended(self) -> bool:
        """Whether the connection's task has ended, or was never started."""
        return self._task is None or self._task.done()

    @property
    def _over(self) -> bool:
        return self._closed or self.refused is not None

    def start(self) -> None:
        """Connect, in a task of its own."""
        self._task = asyncio.get_running_loop().create_task(self._run(), name=f"subscribe {self.topic} {self.uri}")
        self._task.add_done_callback(self._forget_task)

    def close(self) -> None:
        """Disconnect at once; no callback is called any more."""
        self._closed = True
        if self._task is not None:
            self._task.cancel()
        self._drop()

    async def closed(self) -> None:
        """Wait, after ``close()``, until the task has ended."""
        if self._task is not None:
            await asyncio.wait([self._task])

    def connection(self) -> BusConnection:
        """The connection's row in ``getBusInfo`` and ``getBusStats``."""
        return BusConnection(
            self.number, self.uri, INBOUND, self.topic, self.connected, self._info, self.bytes, self.messages
        )

    def _forget_task(self, _: asyncio.Task[None]) -> None:
        """Drop the reference to the ended task: a cancelled task refers to its frames, and so to this object."""
        self._task = None

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            reason = await self._attempt()
            if self._over:
                return
            _log.debug("< %s: lost publisher %s: %s", self.topic, self.uri, reason)
            self._on_lost(reason)
            if loop.time() - began > limits.TCPROS_RETRY_MAX:
                self._backoff.reset()
            await asyncio.sleep(self._backoff.delay())

    async def _attempt(self) -> str:
        """Connect and wait until the connection ends; return the reason."""
        try:
            host, port = await self._request_topic()
            async with asyncio.timeout(limits.TCPROS_CONNECT_TIMEOUT):
                sock = await connect(host, port)
        except TimeoutError:
            return f"no TCPROS server answers in {limits.TCPROS_CONNECT_TIMEOUT:g} s"
        except (OSError, RmpaError) as error:
            return OUT_OF_FILES if is_shortage(error) else str(error)
        loop = asyncio.get_running_loop()
        self._ended = loop.create_future()
        try:
            self._open(sock)
        except OSError as error:
            sock.close()
            return str(error)
        silent = loop.call_later(limits.TCPROS_HANDSHAKE_TIMEOUT, self._handshake_timed_out)
        try:
            ended = await self._ended
        finally:
            silent.cancel()
            self._drop()
        self.malformed = isinstance(ended, RemoteProtocolError)
        return str(ended) if ended is not None else "the publisher closed the connection"

    async def _request_topic(self) -> tuple[str, int]:
        reply = await call_api(self.uri, "requestTopic", self._caller_id, self.topic, [[TCPROS]])
        match reply.value:
            case [str(protocol), str(host), int(port)] if reply.code == 1 and protocol == TCPROS:
                if 0 < port <= _PORT_MAX:
                    return host, port
        raise RemoteProtocolError(f"{self.uri} answers requestTopic with {reply.code}: {printable(reply.status)}")

    def _open(self, sock: socket.socket) -> None:
        keep_alive(sock)
        host, port = sock.getpeername()[:2]
        self._info = f"TCPROS connection on port {sock.getsockname()[1]} to [{host}:{port}]"
        self._stream = Stream(
            sock,
            on_bytes=self._take,
            on_close=self._end,
            outbox=Outbox(1, limits.TCPROS_HEADER_MAX),
        )
        # At once: a rospy node accepts no other connection while it waits for a header.
        self._stream.send([self._request], URGENT)

    def _take(self, data: memoryview) -> tuple[int, int]:
        start = 0
        if self._skipping or self._left or not self.fields:
            start, wanted = self._take_rest_or_header(data)
            if wanted >= 0:
                return start, wanted
        try:
            messages, consumed, wanted = split_messages(data[start:])
        except LimitExceeded as error:
            self._begin_skipping(error.claimed)
            return self._take_next(data, start)
        for message in messages:
            if self._closed:
                break
            self.messages += 1
            self.bytes += len(message)
            self._on_message(message)
        start += consumed
        if self._parts is not None and wanted > core_limits.CUT_THROUGH_BYTES and not self._closed:
            self._left = wanted
            self._parts.begin(wanted)
            if self._left:  # the callback may have closed this connection
                self._take_part(self._parts, data[start:])
            return len(data), 0
        if wanted == LENGTH.size and len(data) - start >= LENGTH.size:
            return self._take_next(data, start)  # a message that is too long
        return start, wanted

    def _take_rest_or_header(self, data: memoryview) -> tuple[int, int]:
        """Consume the rest of a message, or the header, before further messages.

        Returns:
            The number of consumed bytes, and ``_take``'s second result; the latter is -1 if messages may follow.
        """
        start = 0
        if self._skipping:
            start = self._skip(data)
        elif self._left and self._parts is not None:
            start = self._take_part(self._parts, data)
        if self._skipping or self._left or self._closed:
            return start, 0
        if not self.fields:
            fields, start, wanted = parse_header(data)
            if fields is None:
                return 0, wanted
            if not self._accept_header(fields):
                return len(data), 0
        return start, -1

    def _take_next(self, data: memoryview, start: int) -> tuple[int, int]:
        if self._closed:
            return len(data), 0
        consumed, wanted = self._take(data[start:])
        return start + consumed, wanted

    def _begin_skipping(self, size: int) -> None:
        """Begin to drop a message of ``size`` bytes that is longer than ``limits.TCPROS_MESSAGE_MAX``."""
        self._skipping = LENGTH.size + size
        self.oversized += 1
        self._on_oversized(size)

    def _skip(self, data: memoryview) -> int:
        """Drop the received bytes of a message that is too long; return their number."""
        count = min(self._skipping, len(data))
        self._skipping -= count
        self.bytes += count
        return count

    def _take_part(self, parts: PartsTaker, data: memoryview) -> int:
        """Pass on the received bytes of a large message; return their number."""
        count = min(self._left, len(data))
        self._left -= count
        self.bytes += count
        self.messages += not self._left
        parts.part(data[:count])
        return count

    def _accept_header(self, fields: Header) -> bool:
        problem = check_publisher(fields, self._type, self._md5sum)
        if problem is None:
            self.fields = fields
            _log.debug("= %s: connected to publisher %s", self.topic, self.uri)
            self._on_header(fields)
            return not self._closed
        self.refused = problem
        self._drop()
        self._end(None)
        _log.debug("! %s: publisher %s refuses: %s", self.topic, self.uri, problem)
        self._on_refused(problem)
        return False

    def _handshake_timed_out(self) -> None:
        if not self.fields:
            self._end(TimeoutError(f"no header from the publisher in {limits.TCPROS_HANDSHAKE_TIMEOUT:g} s"))

    def _end(self, error: Exception | None) -> None:
        if self._ended is not None and not self._ended.done():
            self._ended.set_result(error)

    def _drop(self) -> None:
        self.fields = {}
        self._skipping = 0
        if self._left and self._parts is not None:
            self._left = 0
            self._parts.abort()
        if self._stream is not None:
            self._stream.close()
            self._stream = None


class Subscription:
    """A topic that a node of this process subscribes to: one connection to each listed publisher.

    Unlike rospy it disconnects from publishers that are no longer listed. A publisher that refused is tried again
    when the master lists it again.

    Args:
        topic: The topic's global name.
        caller_id: The node's name.
        on_message: ``(connection, framed)``; the view is only valid during the call.
        on_refused: ``(connection, text)``.
        own_uri: The node's slave API, if it is ignored in the list: the node does not subscribe to itself.
        type_name: The type to ask for.
        md5sum: The md5 sum to ask for.
        definition: The definition to send.
        nodelay: Whether to ask for TCP_NODELAY.
        number: Returns the number of a new connection.
    """

    def __init__(
        self,
        topic: str,
        caller_id: str,
        *,
        on_message: Callable[[PublisherConnection, memoryview], None],
        on_refused: Callable[[PublisherConnection, str], None] = _ignore,
        own_uri: str = "",
        type_name: str = ANY,
        md5sum: str = ANY,
        definition: str = "",
        nodelay: bool = True,
        number: Callable[[], int] = int,
    ) -> None:
        self.topic = topic
        self.type_name = type_name
        self._caller_id = caller_id
        self._on_message = on_message
        self._on_refused = on_refused
        self._own_uri = own_uri
        self._md5sum = md5sum
        self._definition = definition
        self._nodelay = nodelay
        self._number = number
        self._connections: dict[str, PublisherConnection] = {}
        self._closing: set[PublisherConnection] = set()

    @property
    def publishers(self) -> int:
        """Connected publishers."""
        return sum(connection.connected for connection in self._connections.values())

    @property
    def callers(self) -> set[str]:
        """The names of the connected publishers, from their headers."""
        return {
            connection.fields.get("callerid", "") for connection in self._connections.values() if connection.connected
        }

    def connections(self) -> list[BusConnection]:
        """The rows of all connections in ``getBusInfo`` and ``getBusStats``."""
        return [connection.connection() for connection in self._connections.values()]

    def update(self, uris: Iterable[str], *, keep: bool = False) -> None:
        """Apply the master's list of publishers: connect to the new ones, disconnect from the missing ones.

        Args:
            uris: The slave APIs of the listed publishers.
            keep: Disconnect from none, because the list of a restarted master is incomplete.
        """
        listed = {uri for uri in uris if uri != self._own_uri}
        for uri in () if keep else self._connections.keys() - listed:
            self._disconnect(uri)
        for uri in listed:
            connection = self._connections.get(uri)
            if connection is not None and connection.refused is not None:
                self._disconnect(uri)
                connection = None
            if connection is None:
                self._connect(uri)

    def close(self) -> None:
        """Disconnect from all publishers."""
        for uri in tuple(self._connections):
            self._disconnect(uri)

    async def closed(self) -> None:
        """Wait, after ``close()``, until all tasks have ended."""
        for connection in tuple(self._closing):
            await connection.closed()
        self._closing.clear()

    def _connect(self, uri: str) -> None:
        connection = PublisherConnection(
            self.topic,
            uri,
            self._caller_id,
            on_message=lambda framed: self._on_message(connection, framed),
            on_refused=lambda text: self._on_refused(connection, text),
            on_oversized=lambda size: self._oversized(connection, size),
            type_name=self.type_name,
            md5sum=self._md5sum,
            definition=self._definition,
            nodelay=self._nodelay,
            number=self._number(),
        )
        self._connections[uri] = connection
        connection.start()

    def _oversized(self, connection: PublisherConnection, size: int) -> None:
        if connection.oversized == 1:
            limit = limits.TCPROS_MESSAGE_MAX
            _log.warning(
                "! %s: a message of %d bytes of %s is left out: more than %d; others come as usual",
                self.topic,
                size,
                connection.uri,
                limit,
            )

    def _disconnect(self, uri: str) -> None:
        connection = self._connections.pop(uri)
        connection.close()
        self._closing = {left for left in self._closing if not left.ended}
        self._closing.add(connection)
