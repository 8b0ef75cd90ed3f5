"""The subscribing end of a topic: a connection to one publisher, by TCPROS or within the process, or to all."""

from __future__ import annotations

import asyncio
import logging
import random
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.core.outbox import Outbox, QueuedMessage
from rmpa.core.timers import Backoff
from rmpa.ros import limits
from rmpa.ros.http.rpc import connect, keep_alive, tcpros_info
from rmpa.ros.node.ask import exchange_headers, request_topic
from rmpa.ros.wire.slave_api import INBOUND, BusConnection
from rmpa.ros.wire.tcpros import ANYTHING, LENGTH, check_publisher, split_messages, subscriber_header
from rmpa.runtime.accept import is_shortage
from rmpa.runtime.stream import Stream
from rmpa.runtime.tasks import keep_task

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from rmpa.ros.wire.tcpros import Buffer, Header, TopicDescription

    Attach = Callable[["InProcessConnection"], None]

_log = logging.getLogger(__name__)

# Pause before the second attempt to reach a publisher; roscpp's own value.
TCPROS_RETRY_FIRST: Final = 0.1
# The longest pause between attempts, while the graph lists the publisher.
TCPROS_RETRY_MAX: Final = 2.0


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


class TopicConnection(ABC):
    """A subscriber's connection to one publisher of one topic.

    It connects again until it is closed or the publisher refuses it. The owner closes it when the publisher is no
    longer registered, and makes a new one for a restarted node, which has a new URI. All callbacks are called in the
    loop, and none after ``close()``.

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
        wanted: The type and md5 sum to ask for, and the definition to send, if known.
        nodelay: Whether to ask for TCP_NODELAY on the publisher's side.
        number: The connection's number within the node, for ``getBusInfo``.
        find: Returns ``Publication.attach`` while there is one at that address, if it is one of this process.

    Attributes:
        info: The addresses, in the form of ``rosnode info``.
        malformed: Whether the last connection ended because the publisher broke the protocol.
        request: The subscriber's header.
        fields: The publisher's reply header; empty while there is no connection.
        refused: Why the publisher refused or does not match; ``None`` while it has not refused.
    """

    info = ""
    malformed = False

    # More than 12 fields: the counts of ``getBusStats``, and a callback for each thing that happens to a connection.
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
        wanted: TopicDescription = ANYTHING,
        nodelay: bool = True,
        number: int = 0,
        find: Callable[[], Attach | None] = lambda: None,
    ) -> None:
        self.topic = topic
        self.uri = uri
        self.number = number
        self.request = subscriber_header(topic, caller_id, wanted, nodelay=nodelay)
        self.fields: Header = {}
        self.messages = self.bytes = self.oversized = 0
        self.refused: str | None = None
        self._on_message = on_message
        self._parts = on_parts
        self._on_header = on_header
        self._on_refused = on_refused
        self._on_lost = on_lost
        self._on_oversized = on_oversized
        self._find = find
        # Bytes to come of a message that comes in parts, and what takes them as they come.
        self._left = 0
        self._taker: PartsTaker | None = None
        self._backoff = Backoff(TCPROS_RETRY_FIRST, TCPROS_RETRY_MAX, random.random)
        self._closed = False

    @property
    def connected(self) -> bool:
        """Whether the headers have been exchanged."""
        return bool(self.fields)

    @abstractmethod
    def start(self) -> None:
        """Connect, in a later turn of the loop."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect at once; no callback is called any more."""

    def _lose(self) -> None:
        """Note that there is no connection; the message in progress is dropped."""
        self.fields = {}
        self._abort()

    def _begin(self, size: int, taker: PartsTaker | None) -> None:
        """Begin a message that comes in parts."""
        self._left, self._taker = size, taker
        if taker is not None:
            taker.begin(size)

    def _abort(self) -> None:
        """Drop the message in progress, whose rest will not come."""
        left, self._left = self._left, 0
        if left and self._taker is not None:
            self._taker.abort()

    def connection(self) -> BusConnection:
        """The connection's row in ``getBusInfo`` and ``getBusStats``."""
        return BusConnection(
            self.number, self.uri, INBOUND, self.topic, self.connected, self.info, self.bytes, self.messages
        )


class PublisherConnection(TopicConnection):
    """A connection by TCPROS to a publisher of another process."""

    _stream: Stream | None = None
    _task: asyncio.Task[None] | None = None
    _ended: asyncio.Future[Exception | None]

    def start(self) -> None:
        """Connect, in a task of its own."""
        self._task = keep_task(self._run, f"subscribe {self.topic} {self.uri}")

    def close(self) -> None:
        """Disconnect at once; no callback is called any more."""
        self._closed = True
        if self._task is not None:
            self._task.cancel()
            self._task = None  # a cancelled task refers to its frames, and so to this object
        self._drop()

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            reason = await self._attempt()
            if self._closed or self.refused is not None:
                self._task = None
                return
            _log.debug("< %s: lost publisher %s: %s", self.topic, self.uri, reason)
            self._on_lost(reason)
            if loop.time() - began > TCPROS_RETRY_MAX:
                self._backoff.reset()
            await asyncio.sleep(self._backoff.delay())

    async def _attempt(self) -> str:
        """Connect and wait until the connection ends; return the reason."""
        within, ended = limits.TCPROS_CONNECT_TIMEOUT, None
        try:
            address = await request_topic(self.uri, self.topic, self.request["callerid"], timeout=within)
            async with asyncio.timeout(within):
                sock = await connect(*address)
        except TimeoutError:
            return f"no TCPROS server answers in {within:g} s"
        except (OSError, RmpaError) as error:
            return OUT_OF_FILES if is_shortage(error) else str(error)
        try:
            keep_alive(sock)
            self.info = tcpros_info(sock)
            # At once: a rospy node accepts no other connection while it waits for a header.
            async with asyncio.timeout(within):
                fields = await exchange_headers(sock, self.request)
            if fields is not None and self._accepts(fields):
                self._ended = asyncio.get_running_loop().create_future()
                self._stream = Stream(sock, on_bytes=self._take, on_close=self._end, outbox=Outbox(1, 1))
                ended = await self._ended
        except TimeoutError:
            return f"no header from the publisher in {within:g} s"
        except (OSError, RemoteProtocolError) as error:
            ended = error
        finally:
            self._drop()
            sock.close()
        self.malformed = isinstance(ended, RemoteProtocolError)
        return str(ended) if ended is not None else "the publisher closed the connection"

    def _take(self, data: memoryview) -> tuple[int, int]:
        at = 0
        while self.fields:  # a callback may close the connection
            if self._left:
                at += self._take_part(data[at:])
                if self._left:
                    return at, 0
            try:
                messages, consumed, wanted = split_messages(data[at:])
            except LimitExceeded as error:
                self._begin(LENGTH.size + error.claimed, None)
                self.oversized += 1
                self._on_oversized(error.claimed)
                continue
            for message in messages:
                if self._closed:
                    break
                self.messages += 1
                self.bytes += len(message)
                self._on_message(message)
            at += consumed
            if self._parts is not None and wanted > core_limits.CUT_THROUGH_BYTES and not self._closed:
                self._begin(wanted, self._parts)
            elif wanted > LENGTH.size or len(data) - at < LENGTH.size:  # else a message that is too long follows
                return at, wanted
        return len(data), 0

    def _take_part(self, data: memoryview) -> int:
        """Pass on, or drop, the received bytes of the message in progress; return their number."""
        count = min(self._left, len(data))
        self._left -= count
        self.bytes += count
        if self._taker is not None:
            self.messages += not self._left
            self._taker.part(data[:count])
        return count

    def _accepts(self, fields: Header) -> bool:
        """Take the publisher's header; return whether messages follow."""
        problem = check_publisher(fields, self.request["type"], self.request["md5sum"])
        if problem is None:
            self.fields = fields
            _log.debug("= %s: connected to publisher %s", self.topic, self.uri)
            self._on_header(fields)
            return self.connected  # the callback may close the connection
        self.refused = problem
        _log.debug("! %s: publisher %s refuses: %s", self.topic, self.uri, problem)
        self._on_refused(problem)
        return False

    def _end(self, error: Exception | None) -> None:
        if not self._ended.done():
            self._ended.set_result(error)

    def _drop(self) -> None:
        self._lose()
        if self._stream is not None:
            self._stream.close()
            self._stream = None


class InProcessConnection(TopicConnection):
    """A subscription to a publication of this process, without a socket.

    A relay or a gateway subscribes to its own proxies. Each message goes from the publication to the subscriber by a
    call, while it is received: nothing is copied, and no queue is between them. The publication uses it as it uses
    an ``AcceptedConnection``.

    Attributes:
        closed: Whether no publication has the connection.
    """

    peer: Final = ("in this process", 0)
    info = "in this process"
    dropped: Final = 0
    pending_bytes: Final = 0
    closed = True
    since = 0
    # What has come of a message in parts, for a subscriber that takes it whole.
    _whole: bytearray
    _next: asyncio.Handle | None = None

    on_end: Callable[[InProcessConnection, Exception | None], None]

    @property
    def caller_id(self) -> str:
        """The subscribing node."""
        return self.request["callerid"]

    @property
    def bytes_out(self) -> int:
        """Bytes passed on."""
        return self.bytes

    def start(self) -> None:
        """Connect in the next turn of the loop."""
        self._next = asyncio.get_running_loop().call_soon(self._attach)

    def close(self) -> None:
        """Disconnect at once; no callback is called any more."""
        self._closed = True
        if self._next is not None:
            self._next.cancel()
        attached = not self.closed
        self._detach()
        if attached:
            self.on_end(self, None)

    def _attach(self) -> None:
        attach = self._find()
        if attach is None:
            self._lost("its publisher is not there any more")
        else:
            self.closed = False
            attach(self)

    def _detach(self) -> None:
        self.closed = True
        self._lose()

    def _lost(self, reason: str) -> None:
        self._next = asyncio.get_running_loop().call_later(self._backoff.delay(), self._attach)
        self._on_lost(reason)

    def accept(self, header: Mapping[str, str]) -> None:
        """Take the publisher's header; messages may follow."""
        if not self.closed:
            self.fields = dict(header)
            self._backoff.reset()
            self._on_header(self.fields)

    def bound(self, _messages: int) -> None:
        """Do nothing: there is no queue."""

    def refuse(self, text: str) -> None:
        """End for good: the publication refused."""
        self._detach()
        self.refused = text
        self._on_refused(text)

    def hang_up(self, *, drain: bool = False) -> None:  # noqa: ARG002 - nothing waits
        """End the connection, and report it in the next turn of the loop."""
        if not self.closed:
            self._detach()
            self._next = asyncio.get_running_loop().call_soon(self._lost, "the publisher closed the connection")

    async def drained(self, _within: float) -> None:
        """Return at once: nothing waits."""

    def send(self, parts: Sequence[Buffer], key: int) -> int:
        """Pass on one message, the only one of ``parts``; none is ever dropped here."""
        framed = memoryview(parts[0])
        size = len(framed)
        if self._parts is not None and size > core_limits.CUT_THROUGH_BYTES:
            self.extend(self.open(key, size), framed)
        elif not self.closed:
            self.messages += 1
            self.bytes += size
            self._on_message(framed)
        return 0

    def open(self, key: int, size: int) -> QueuedMessage:
        """Begin a message of ``size`` bytes that comes in parts."""
        if not self.closed:
            self._whole = bytearray()
            self._begin(size, self._parts if size > core_limits.CUT_THROUGH_BYTES else None)
        return QueuedMessage(key, size)

    def extend(self, _message: QueuedMessage, part: Buffer) -> int:
        """Pass on a part; the last one completes the message."""
        if self.closed:
            return 0
        self._left -= len(part)
        self.bytes += len(part)
        self.messages += not self._left
        if self._taker is not None:
            self._taker.part(memoryview(part))
            return 0
        self._whole += part
        if not self._left:
            # Not used again: the subscriber may send it on, and then it is read until the read ends.
            self._on_message(memoryview(self._whole))
        return 0

    def abandon(self, _message: QueuedMessage) -> bool:
        """Drop the message in progress, whose rest will not come; the connection goes on."""
        self._abort()
        return False
