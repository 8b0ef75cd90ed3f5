"""A subscription to a publication of this process, without a socket.

A relay or a gateway subscribes to its own proxies. Each message then goes from the publication to the subscriber by a
call, while it is received: nothing is copied, and no queue is between them.
"""

from __future__ import annotations

import asyncio
import random
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.core import limits as core_limits
from rmpa.core.counters import Backoff
from rmpa.core.limits import MIB
from rmpa.core.outbox import QueuedMessage
from rmpa.ros import limits
from rmpa.ros.wire.slave_api import INBOUND, BusConnection
from rmpa.ros.wire.tcpros import ANY, subscriber_header

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.ros.node.subscription import PartsTaker
    from rmpa.ros.wire.tcpros import Buffer, Header

_INFO: Final = "in this process"
_KEPT_BUFFER: Final = 4 * MIB


def _ignore(*_: object) -> None:
    pass


class _NoStream:
    """Stands for the stream that a connection within the process has not."""

    __slots__ = ("bytes_out", "closed")
    pending_bytes: Final = 0

    def __init__(self) -> None:
        self.bytes_out = 0
        self.closed = False

    async def drained(self, timeout: float = 0.0) -> None:  # noqa: ASYNC109 - the stream's signature
        """Return at once: nothing waits."""


class InProcessSubscriber:
    """The connection as the publication sees it; it does what ``AcceptedConnection`` does for a subscriber.

    Args:
        fields: The subscriber's header.
        number: The connection's number.
        owner: The subscribing end.
    """

    peer: Final = (_INFO, 0)
    info: Final = _INFO
    dropped: Final = 0

    def __init__(self, fields: Header, number: int, owner: InProcessConnection) -> None:
        self.fields = fields
        self.number = number
        self.caller_id = fields["callerid"]
        self.messages = 0
        self.stream = _NoStream()
        self.on_end: Callable[[InProcessSubscriber, Exception | None], None] = _ignore
        self._owner = owner

    def accept(self, header: Mapping[str, str], _queue_messages: int, _queue_bytes: int) -> None:
        """Pass the publisher's header on; messages may follow."""
        self._owner.described(self, dict(header))

    def bound(self, _queue_messages: int, _queue_bytes: int) -> None:
        """Do nothing: there is no queue."""

    def refuse(self, text: str) -> None:
        """Pass the publisher's refusal on."""
        self.stream.closed = True
        self._owner.refused_by(self, text)

    def send(self, framed: Buffer) -> int:
        """Pass one message on; none is ever dropped here."""
        if not self.stream.closed:
            self.messages += 1
            self.stream.bytes_out += len(framed)
            self._owner.message(framed)
        return 0

    def begin(self, size: int) -> QueuedMessage:
        """Begin a message of ``size`` bytes that comes in parts."""
        self.messages += 1
        self.stream.bytes_out += size
        self._owner.begin(size)
        return QueuedMessage(0, size)

    def extend(self, _message: QueuedMessage, part: Buffer) -> int:
        """Pass on a part."""
        if not self.stream.closed:
            self._owner.part(part)
        return 0

    def abandon(self, _message: QueuedMessage) -> bool:
        """Give up the message in progress; the connection goes on."""
        self._owner.abort()
        return False

    def close(self) -> None:
        """End the connection, from the publication's side."""
        if not self.stream.closed:
            self.stream.closed = True
            self._owner.closed_by(self)


class AttachTarget(Protocol):
    """What takes a subscriber over: a ``Publication``."""

    def attach(self, connection: InProcessSubscriber, /) -> None:
        """Serve it, hold it, or refuse it."""


class InProcessConnection:
    """Subscribes to a publication of this process; ``PublisherConnection`` does it for another process.

    It connects in a later turn of the loop, and connects again until it is closed. All callbacks are called in the
    loop, and none after ``close()``.

    Args:
        topic: The topic's name.
        uri: The publisher's slave API.
        caller_id: The subscribing node.
        find: Returns the publication, or ``None`` while there is none at that address.
        on_message: ``(framed)``: one message with its length in front; the view is valid during the call only.
        on_parts: Receives messages above ``core.limits.CUT_THROUGH_BYTES``, as parts if they come so.
        on_header: ``(fields)``: the publisher's header, at each connection, before its first message.
        on_refused: ``(text)``: the publication refused; there is no further attempt.
        on_lost: ``(reason)``: the connection ended; it is tried again.
        number: The connection's number within the node.
    """

    malformed: Final = False
    oversized: Final = 0

    def __init__(
        self,
        topic: str,
        uri: str,
        caller_id: str,
        find: Callable[[], AttachTarget | None],
        *,
        on_message: Callable[[memoryview], None],
        on_parts: PartsTaker | None = None,
        on_header: Callable[[Header], None] = _ignore,
        on_refused: Callable[[str], None] = _ignore,
        on_lost: Callable[[str], None] = _ignore,
        number: int = 0,
    ) -> None:
        self.topic = topic
        self.uri = uri
        self.number = number
        self.fields: Header = {}
        """The publisher's header; empty while there is no connection."""
        self.messages = 0
        self.bytes = 0
        self.refused: str | None = None
        """Why the publication refused; ``None`` while it has not refused."""
        self._request = subscriber_header(topic, caller_id, type_name=ANY, md5sum=ANY)
        self._find = find
        self._on_message = on_message
        self._parts = on_parts
        self._on_header = on_header
        self._on_refused = on_refused
        self._on_lost = on_lost
        self._buffer = memoryview(bytearray())
        """Where a message that comes in parts is assembled; kept for the next one, unless it is very large."""
        self._filled = self._size = 0
        self._in_parts = False
        self._backoff = Backoff(limits.TCPROS_RETRY_FIRST, limits.TCPROS_RETRY_MAX, random.random)
        self._other: InProcessSubscriber | None = None
        """The publication's end."""
        self._next: asyncio.Handle | None = None
        self._closed = False

    @property
    def connected(self) -> bool:
        """Whether the publisher's header has come."""
        return bool(self.fields)

    def start(self) -> None:
        """Connect in the next turn of the loop."""
        self._next = asyncio.get_running_loop().call_soon(self._attach)

    def close(self) -> None:
        """Disconnect at once; no callback is called any more."""
        self._closed = True
        if self._next is not None:
            self._next.cancel()
            self._next = None
        self.fields = {}
        end, self._other = self._other, None
        if end is not None and not end.stream.closed:
            end.stream.closed = True
            end.on_end(end, None)
        self.abort()

    def connection(self) -> BusConnection:
        """The connection's row in ``getBusInfo`` and ``getBusStats``."""
        return BusConnection(
            self.number, self.uri, INBOUND, self.topic, self.connected, _INFO, self.bytes, self.messages
        )

    def _attach(self) -> None:
        self._next = None
        publication = self._find()
        if publication is None:
            self._lost("its publisher is not there any more")
            return
        self._other = InProcessSubscriber(dict(self._request), self.number, self)
        publication.attach(self._other)

    def _lost(self, reason: str) -> None:
        self.fields = {}
        self._other = None
        self.abort()
        self._next = asyncio.get_running_loop().call_later(self._backoff.delay(), self._attach)
        self._on_lost(reason)

    # --- called by the publication's end ----------------------------------------------------------------------

    def described(self, end: InProcessSubscriber, fields: Header) -> None:
        """Take the publisher's header."""
        if end is self._other and not self._closed:
            self.fields = fields
            self._backoff.reset()
            self._on_header(fields)

    def refused_by(self, end: InProcessSubscriber, text: str) -> None:
        """End for good: the publication refused."""
        if end is self._other and not self._closed:
            self._other = None
            self.refused = text
            self._on_refused(text)

    def closed_by(self, end: InProcessSubscriber) -> None:
        """Report, in the next turn of the loop, that the publication has closed the connection."""
        if end is self._other and not self._closed:
            self.fields = {}
            self._other = None
            self._next = asyncio.get_running_loop().call_soon(self._lost, "the publisher closed the connection")

    def message(self, framed: Buffer) -> None:
        """Take one message."""
        size = len(framed)
        self.messages += 1
        self.bytes += size
        view = framed if isinstance(framed, memoryview) else memoryview(framed)
        if self._parts is not None and size > core_limits.CUT_THROUGH_BYTES:
            self._parts.begin(size)
            self._parts.part(view)
        else:
            self._on_message(view)

    def begin(self, size: int) -> None:
        """Take the beginning of a message that comes in parts."""
        self._size, self._filled = size, 0
        self._in_parts = self._parts is not None and size > core_limits.CUT_THROUGH_BYTES
        if self._parts is not None and self._in_parts:
            self._parts.begin(size)
        elif len(self._buffer) < size or self._parts is not None:
            # One that takes parts may send the message on: then it is read until the end of the present read.
            self._buffer = memoryview(bytearray(size))

    def part(self, part: Buffer) -> None:
        """Take the next part; the last one completes the message."""
        before, size = self._filled, self._size
        self._filled += len(part)
        if self._filled == size:
            self.messages += 1
            self.bytes += size
            self._size = 0
        if self._parts is not None and self._in_parts:
            self._parts.part(part if isinstance(part, memoryview) else memoryview(part))
            return
        self._buffer[before : self._filled] = part
        if self._filled == size:
            self._on_message(self._buffer[:size])
            if len(self._buffer) > _KEPT_BUFFER:
                self._buffer = memoryview(bytearray())

    def abort(self) -> None:
        """Drop the message in progress: its rest will not come."""
        aborted, self._size = self._size, 0
        if aborted and self._in_parts and self._parts is not None:
            self._parts.abort()
