"""Publishers, subscriptions, services and clients of a ``Node``.

The services of a ``Node``: ``Service`` serves one, ``ServiceClient`` calls one.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import time
from collections import deque
from collections.abc import Awaitable, Callable
from functools import cached_property
from typing import TYPE_CHECKING, Any

from rmpa.config import limits as config_limits
from rmpa.core import limits as core_limits
from rmpa.core.counters import Counters, RefusalLog
from rmpa.core.errors import LocalProtocolError, PeerRefused, RmpaError
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.service_client import ServiceConnection, ServiceFailed
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.node.subscription import Subscription
from rmpa.ros.types.find import type_of_header
from rmpa.ros.types.messages import HeaderNumbers, MessageError
from rmpa.ros.wire.tcpros import ANY, LENGTH, frame_message, printable

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from rmpa.ros.node.subscription import PublisherConnection
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.types.messages import MessageType, Plain
    from rmpa.ros.wire.tcpros import Buffer, TopicDescription

_log = logging.getLogger(__name__)

Handler = Callable[[Any], "Awaitable[Any] | Any"]


class Service:
    """A service of a ``Node``; made by ``Node.advertise_service``.

    Args:
        name: The global name.
        caller_id: The node's name.
        kind: The type.
        handler: Gets the request as an object; returns the response as an object or as plain values, at once or as an
            awaitable. An exception becomes the client's error.
        timeout: Seconds for a call.
        on_close: Unregisters the service.
        raw: Whether the handler gets the request's bytes, and returns the response's.
    """

    def __init__(
        self,
        name: str,
        caller_id: str,
        kind: ServiceType,
        handler: Handler,
        timeout: float,
        on_close: Callable[[str], Awaitable[None]],
        *,
        raw: bool = False,
    ) -> None:
        self.name = name
        self.kind = kind
        self._raw = raw
        self._handler = handler
        self._on_close = on_close
        self._tasks: set[asyncio.Task[None]] = set()
        self.endpoint = ServiceEndpoint(name, caller_id, self._serve, description=kind.describe(), timeout=timeout)

    async def close(self) -> None:
        """Unregister the service; calls under way get an error."""
        await self._on_close(self.name)

    def _serve(self, call: ServiceCall) -> None:
        try:
            result = self._handler(bytes(call.request) if self._raw else self.kind.request.deserialize(call.request))
        except Exception as error:  # noqa: BLE001 - the top of the user's code
            self._failed(call, error)
            return
        if not inspect.isawaitable(result):
            self._reply(call, result)
            return
        task = asyncio.get_running_loop().create_task(self._respond(call, result), name=f"call of {self.name}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

        def gone() -> None:
            task.cancel()

        call.on_gone = gone

    async def _respond(self, call: ServiceCall, result: Awaitable[Any]) -> None:
        try:
            self._reply(call, await result)
        except Exception as error:  # noqa: BLE001 - the top of the user's code, as a task
            self._failed(call, error)

    def _reply(self, call: ServiceCall, result: Any) -> None:
        try:
            call.reply(True, result if self._raw else _serialize(self.kind.response, result))
        except MessageError as error:
            self._failed(call, error)

    def _failed(self, call: ServiceCall, error: Exception) -> None:
        if not isinstance(error, RmpaError):
            _log.error("! %s: a call of %s failed", self.name, printable(call.caller_id), exc_info=error)
        text = str(error)
        call.fail(text if isinstance(error, RmpaError) and text else f"{type(error).__name__}: {text}")


class ServiceClient:
    """Calls one service over one connection, one call at a time; made by ``Node.connect_service``.

    Args:
        connection: To its server.
        kind: The type.
    """

    def __init__(self, connection: ServiceConnection, kind: ServiceType) -> None:
        self.connection = connection
        self.kind = kind

    @property
    def closed(self) -> bool:
        """Whether either side has closed the connection."""
        return self.connection.closed

    async def call(
        self,
        request: object = None,
        timeout: float | None = config_limits.SERVICE_TIMEOUT,  # noqa: ASYNC109 - the message names it
    ) -> Any:
        """Call the service.

        Args:
            request: As an object, or as plain values (see ``MessageType.make``).
            timeout: Seconds; ``None`` waits for ever.

        Returns:
            The response as an object.

        Raises:
            MessageError: The request does not fit the type, or the response is not one.
            PeerRefused: The server answers with an error.
            ServiceFailed: The server disconnected, or did not answer in time.
        """
        ok, body = await self.connection.call(_serialize(self.kind.request, request), timeout)
        if not ok:
            raise PeerRefused(f"service {self.connection.service}", str(bytes(body), "utf-8", "replace"))
        return self.kind.response.deserialize(body)

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()


def _serialize(kind: MessageType, value: object) -> Buffer:
    return kind.serialize(kind.given(value))


async def probe(uri: str, service: str, caller_id: str, timeout: float) -> ServiceConnection:  # noqa: ASYNC109
    """Ask a server for its description; returns the closed connection with ``description`` and ``caller_id``.

    Raises:
        RmpaError: As ``ServiceConnection.open``.
    """
    connection = await ServiceConnection.open(uri, service, caller_id, md5sum=ANY, probe=True, timeout=timeout)
    connection.close()
    return connection


__all__ = ["Handler", "Service", "ServiceClient", "ServiceFailed", "probe"]


# The topics of a ``Node``: publishers, subscribers and received messages.


class Received:
    """One received message.

    Args:
        raw: Its bytes, without the length.
        header: The publisher's connection header: ``type``, ``md5sum``, ``message_definition``, ``callerid`` …
        stamp_ns: The time of reception, wall clock in nanoseconds.
        kind: Its type, if the subscriber has one.
    """

    def __init__(self, raw: bytes, header: Mapping[str, str], stamp_ns: int, kind: MessageType | None) -> None:
        self.raw = raw
        self.header = header
        self.stamp_ns = stamp_ns
        self._kind = kind

    @cached_property
    def kind(self) -> MessageType:
        """The message type: the subscriber's, or the one in the publisher's header.

        Raises:
            DefinitionError: The publisher's definition cannot be used.
        """
        return self._kind if self._kind is not None else type_of_header(self.header)

    @cached_property
    def message(self) -> Any:
        """The message object, deserialized at the first access.

        Raises:
            MessageError: The bytes are not such a message.
            DefinitionError: As for ``kind``.
        """
        return self.kind.deserialize(self.raw)

    @property
    def plain(self) -> dict[str, Plain]:
        """The message as plain values; the errors are those of ``message``."""
        return self.kind.to_plain(self.message)

    @property
    def caller_id(self) -> str:
        """The publishing node."""
        return self.header.get("callerid", "")


class Publisher(PublicationEvents):
    """Publishes one topic of a ``Node``; made by ``Node.advertise``."""

    def __init__(
        self,
        topic: str,
        caller_id: str,
        description: TopicDescription,
        kind: MessageType | None,
        queue_messages: int,
        on_close: Callable[[str], Awaitable[None]],
    ) -> None:
        self.topic = topic
        self.description = description
        self.kind = kind
        self.numbers = HeaderNumbers(kind) if kind is not None else None
        """Numbers what ``publish`` sends; what ``publish_raw`` sends has its numbers already."""
        self._on_close = on_close
        self._change = asyncio.Event()
        self._log = RefusalLog(_log, Counters())
        self.refusals: dict[str, str] = {}
        """Why subscribers (by caller id) were refused."""
        self.publication = Publication(topic, caller_id, description, events=self, queue_messages=queue_messages)

    @property
    def subscribers(self) -> int:
        """Number of connected subscribers."""
        return self.publication.subscribers

    def make(self, values: Plain = None) -> Any:
        """A message of this topic's type from plain values; see ``MessageType.make``."""
        return self._known().make(values)

    def publish(self, message: object = None, /, **fields: object) -> int:
        """Publish a message; return the number of older messages dropped for slow subscribers.

        Args:
            message: A message object, or plain values (see ``MessageType.make``): a mapping of fields, a list of all
                fields, or the value itself where the type has one field.
            fields: In place of ``message``: fields by name; the others are 0, empty or false.

        ``header.seq`` counts the messages, 1, 2, 3 …, as rospy has it.

        Raises:
            MessageError: The message does not fit the type.
        """
        kind = self._known()
        payload: Buffer = kind.serialize(kind.given(message, fields))
        return self.publish_raw(self.numbers.stamp(payload) if self.numbers is not None else payload)

    def publish_raw(self, payload: Buffer) -> int:
        """Publish a serialized message as it is, without a length in front; returns as ``publish``.

        Raises:
            ValueError: The message is longer than ``ros.limits.TCPROS_MESSAGE_MAX`` bytes.
        """
        return self.publication.publish_framed(frame_message(payload))

    async def wait_for_subscriber(self) -> None:
        """Wait until there is at least one subscriber."""
        await self._change.wait()

    async def drained(self) -> None:
        """Wait until all published messages are sent, at most ``runtime.limits.DRAIN_TIMEOUT`` seconds."""
        await self.publication.drained()

    async def close(self) -> None:
        """Send the queued messages, unregister, and close the connections."""
        await self.drained()
        await self._on_close(self.topic)

    def first_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        self._change.set()

    def last_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        self._change.clear()

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        """Of ``PublicationEvents``."""
        who = printable(fields.get("callerid", ""))
        _remember(self.refusals, who, text)
        self._log.refuse(asyncio.get_running_loop().time(), "publication.refused", who, f"{self.topic}: {text}")

    def _known(self) -> MessageType:
        if self.kind is None:
            raise LocalProtocolError(f"{self.topic} was advertised for raw bytes; use publish_raw")
        return self.kind


class Subscriber:
    """Receives one topic of a ``Node``, by callback or ``async for``; made by ``Node.subscribe``."""

    def __init__(
        self,
        topic: str,
        caller_id: str,
        kind: MessageType | None,
        callback: Callable[[Received], None] | None,
        *,
        on_bytes: Callable[[memoryview, Mapping[str, str]], None] | None = None,
        type_name: str = ANY,
        own_uri: str = "",
        nodelay: bool,
        queue_messages: int,
        number: Callable[[], int],
        on_close: Callable[[str], Awaitable[None]],
    ) -> None:
        self.topic = topic
        self.kind = kind
        self.type_name = kind.name if kind is not None else type_name
        self.dropped = 0
        """Messages dropped because the ``async for`` is slow."""
        self.refusals: dict[str, str] = {}
        """Why publishers (by slave API URI) refused or do not match."""
        self._callback = callback
        self._on_bytes = on_bytes
        self._refusals = RefusalLog(_log, Counters())
        self._queue: deque[Received] = deque()
        self._queue_messages = queue_messages
        self._wake = asyncio.Event()
        self._ended = False
        self._on_close = on_close
        self.subscription = Subscription(
            topic,
            caller_id,
            on_message=self._message,
            on_refused=self._refused,
            own_uri=own_uri,
            type_name=self.type_name,
            md5sum=kind.md5sum if kind is not None else ANY,
            definition=kind.definition if kind is not None else "",
            nodelay=nodelay,
            number=number,
        )

    @property
    def publishers(self) -> int:
        """Number of connected publishers."""
        return self.subscription.publishers

    @property
    def callers(self) -> set[str]:
        """The names of the connected publishers."""
        return self.subscription.callers

    async def __aiter__(self) -> AsyncIterator[Received]:
        """The messages, until the subscriber or its node is closed."""
        while True:
            while self._queue:
                yield self._queue.popleft()
            if self._ended:
                return
            self._wake.clear()
            await self._wake.wait()

    async def close(self) -> None:
        """Unregister and disconnect from all publishers."""
        self.ended()
        await self._on_close(self.topic)

    def ended(self) -> None:
        """End the ``async for`` once its queue is empty; no further messages arrive."""
        self._ended = True
        self._wake.set()

    def _message(self, connection: PublisherConnection, framed: memoryview) -> None:
        try:
            if self._on_bytes is not None:
                self._on_bytes(framed[LENGTH.size :], connection.fields)
                return
            received = Received(bytes(framed[LENGTH.size :]), connection.fields, time.time_ns(), self.kind)
            if self._callback is not None:
                self._callback(received)
                return
        except Exception:  # noqa: BLE001 - a callback's mistake must not end the connection
            caller = connection.fields.get("callerid", "?")
            _log.exception("! %s: the callback failed on a message from %s", self.topic, caller)
            return
        if len(self._queue) >= self._queue_messages:
            self._queue.popleft()
            self.dropped += 1
        self._queue.append(received)
        self._wake.set()

    def _refused(self, connection: PublisherConnection, text: str) -> None:
        _remember(self.refusals, connection.uri, text)
        now = asyncio.get_running_loop().time()
        self._refusals.refuse(
            now, "subscription.refused", connection.uri, f"{self.topic}: publisher {connection.uri}: {text}"
        )


def _remember(refusals: dict[str, str], who: str, text: str) -> None:
    refusals[who] = text
    if len(refusals) > core_limits.LOG_KINDS_MAX:
        refusals.pop(next(iter(refusals)))
