"""Publishers, subscribers, services and clients of a ``Node``, and what it has registered at its master."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, TypeVar

from rmpa.config import limits as config_limits
from rmpa.core import limits as core_limits
from rmpa.core.errors import LocalProtocolError, PeerRefused, RmpaError, UnreachableError
from rmpa.core.log import RefusalLog
from rmpa.core.statistics import Counters
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.master.mirror import one_call
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.node.slave_node import SlaveNode, Subscription
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.find import type_of_header
from rmpa.ros.types.messages import HeaderNumbers, MessageType, Plain, given_values
from rmpa.ros.wire.tcpros import ANY, LENGTH, Buffer, TopicDescription, frame_message, printable
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from rmpa.ros.node.service_client import ServiceConnection
    from rmpa.ros.node.subscription import PublisherConnection
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue

_log = logging.getLogger(__name__)

# Time in which an ending node unregisters everything; a master that hangs must not delay it longer.
NODE_UNREGISTER_TIMEOUT: Final = 3.0
_REMEDY: Final = "start one (rmpa up, or roscore), or set ROS_MASTER_URI to one that runs"
_CLOSED: Final = "{} is not published any more: its publisher is closed"

Handler = Callable[[Any], "Awaitable[Any] | Any"]
ParamCallback = Callable[[str, "XmlRpcValue"], None]
_Entry = TypeVar("_Entry", "Publisher", "Subscriber", "Service")


class MasterClient:
    """What one node has registered at its master, and its calls there.

    Args:
        slave: The node's servers.
        master_uri: The master.
    """

    def __init__(self, slave: SlaveNode, master_uri: str) -> None:
        self.slave = slave
        self.name = slave.name
        self.master_uri = master_uri
        self._entries: list[Publisher | Subscriber | Service] = []
        # So that the end of one subscriber does not unregister the next one of its topic.
        self._registering = asyncio.Lock()
        # What is unregistered, also where the program does not wait for it any more.
        self._unregistering = OwnedTasks()
        # Whether everything is unregistered, or has begun to be.
        self._ended = False
        # The parameters that are subscribed to, with what is told of their changes.
        self._followed: dict[str, ParamCallback | None] = {}

    @property
    def uri(self) -> str:
        """The slave API, ``http://host:port/``."""
        return self.slave.uri

    async def call_master(self, method: str, *params: XmlRpcValue) -> XmlRpcValue:
        """Call the Master or Parameter API; the caller id is put in front.

        Raises:
            UnreachableError: The master does not answer.
            PeerRefused: The master answers with a code other than 1.
        """
        reply = await self._call(method, *params)
        if reply.code != 1:
            master = f"the ROS master at {self.master_uri}"
            raise PeerRefused(master, f"{method}: {reply.status}", code="core-refuses")
        return reply.value

    async def _call(self, method: str, *params: XmlRpcValue) -> RosReply:
        try:
            return await call_api(self.master_uri, method, self.name, *params)
        except UnreachableError as error:
            raise UnreachableError("ROS master", f"{self.master_uri} (ROS_MASTER_URI)", _REMEDY) from error

    async def _add(self, entry: _Entry) -> _Entry:
        """Serve and register; return the same.

        Raises:
            ValueError: The node has a publisher or service of that name already.
            RmpaError: The node is not open.
        """
        self._check_open()
        entry.serve()
        self._entries.append(entry)
        try:
            async with self._registering:
                await entry.register()
            self._check_open()
        except BaseException as error:
            if entry in self._entries:
                self._entries.remove(entry)
            entry.withdraw()
            if not isinstance(error, PeerRefused):  # the master may have registered it
                self._unregistering.start(self._unregister(entry), f"unregister {entry.key}")
            raise
        return entry

    def _check_open(self) -> None:
        if not self.uri:
            raise RmpaError(f"{self.name} is not open: write `async with rmpa.Node(...) as node:`")
        if self._ended:
            raise RmpaError(f"{self.name} is closed")

    async def remove(self, entry: Publisher | Subscriber | Service) -> None:
        """Unregister and close a publisher, subscriber or service; nothing happens if it is not registered."""
        if entry in self._entries:
            self._entries.remove(entry)
            # To its end, also where the caller is cancelled; the end of the node waits for it.
            await asyncio.shield(self._unregistering.start(self._remove(entry), f"unregister {entry.key}"))

    async def _remove(self, entry: Publisher | Subscriber | Service) -> None:
        await self._unregister(entry)
        entry.withdraw()

    async def _unregister(self, entry: Publisher | Subscriber | Service) -> None:
        async with self._registering:
            if not any((other.kind_name, other.key) == (entry.kind_name, entry.key) for other in self._entries):
                with contextlib.suppress(RmpaError):
                    await self.call_master(f"unregister{entry.kind_name}", entry.key, entry.uri)

    async def _register_again(self) -> None:
        """Register everything at a master that has been started again."""
        for entry in tuple(self._entries):
            try:
                await entry.register(again=True)
            except PeerRefused as error:
                _log.warning("! %s: %s: %s [core-refuses]", self.name, entry.key, error)
        for key in tuple(self._followed):
            await self.call_master("subscribeParam", self.uri, key)

    async def _unregister_all(self) -> None:
        """Unregister everything in one call, with one deadline for a slow master."""
        self._ended = True
        calls = [(f"unregister{entry.kind_name}", (self.name, entry.key, entry.uri)) for entry in self._entries]
        calls += [("unsubscribeParam", (self.name, self.uri, key)) for key in self._followed]
        try:
            async with asyncio.timeout(NODE_UNREGISTER_TIMEOUT):
                if calls:
                    try:
                        await call(self.master_uri, "system.multicall", [one_call(*each) for each in calls])
                    except RosFault:  # a master that lacks it
                        for method, params in calls:
                            await call(self.master_uri, method, *params)
                await asyncio.gather(*self._unregistering)
        except (RmpaError, TimeoutError) as error:
            _log.debug("! %s: not everything is unregistered at %s: %s", self.name, self.master_uri, error)


class Service:
    """A service of a ``Node``; made by ``Node.advertise_service``.

    Args:
        node: Serves it.
        name: The global name.
        kind: The type.
        handler: Gets the request as an object; returns the response as an object or as plain values, at once or as an
            awaitable. An exception becomes the client's error.
        timeout: Seconds for a call.
        raw: Whether the handler gets the request's bytes, and returns the response's.
    """

    kind_name = "Service"

    def __init__(
        self, node: MasterClient, name: str, kind: ServiceType, handler: Handler, timeout: float, *, raw: bool
    ) -> None:
        self._node = node
        self.name = self.key = name
        self.kind = kind
        self._raw = raw
        self._handler = handler
        self._tasks = OwnedTasks()
        self.endpoint = ServiceEndpoint(name, node.name, self._called, description=kind.describe(), timeout=timeout)

    @property
    def uri(self) -> str:
        """The URI of the node's services."""
        return self._node.slave.service_uri

    def serve(self) -> None:
        """Take clients."""
        self._node.slave.add_service(self.endpoint)

    async def register(self, *, again: bool = False) -> None:  # noqa: ARG002 - of subscribers
        """Register it at the master."""
        await self._node.call_master("registerService", self.name, self.uri, self._node.uri)

    def withdraw(self) -> None:
        """Close; calls under way get an error."""
        self._node.slave.remove_service(self.name)

    async def close(self) -> None:
        """Unregister the service; calls under way get an error."""
        await self._node.remove(self)

    def _called(self, call: ServiceCall) -> None:
        try:
            result = self._handler(bytes(call.request) if self._raw else self.kind.request.deserialize(call.request))
            if not inspect.isawaitable(result):
                self._reply(call, result)
                return
        except Exception as error:  # noqa: BLE001 - the top of the user's code
            self._failed(call, error)
            return
        call.on_gone = self._tasks.start(self._respond(call, result), f"call of {self.name}").cancel

    async def _respond(self, call: ServiceCall, result: Awaitable[Any]) -> None:
        try:
            self._reply(call, await result)
        except Exception as error:  # noqa: BLE001 - the top of the user's code, as a task
            self._failed(call, error)

    def _reply(self, call: ServiceCall, result: Any) -> None:
        call.reply(True, result if self._raw else _serialize(self.kind.response, result))

    def _failed(self, call: ServiceCall, error: Exception) -> None:
        ours, text = isinstance(error, RmpaError), str(error)
        if not ours:
            _log.error("! %s: a call of %s failed", self.name, printable(call.caller_id), exc_info=error)
        call.fail(text if ours and text else f"{type(error).__name__}: {text}")


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
            text = str(bytes(body), "utf-8", "replace")
            raise PeerRefused(f"service {self.connection.service}", text, code="service-failed")
        return self.kind.response.deserialize(body)

    def close(self) -> None:
        """Close the connection."""
        self.connection.close()


def _serialize(kind: MessageType, value: object) -> Buffer:
    return kind.serialize(given_values(kind.name, value, None))


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
        return codec_for(self.kind).plain_values(memoryview(self.raw))

    @property
    def caller_id(self) -> str:
        """The publishing node."""
        return self.header.get("callerid", "")


class Publisher(PublicationEvents):
    """Publishes one topic of a ``Node``; made by ``Node.advertise``.

    Attributes:
        refusals: Why subscribers (by caller id) were refused.
        numbers: Numbers what ``publish`` sends; what ``publish_raw`` sends has its numbers already.
    """

    kind_name: Final = "Publisher"

    def __init__(
        self, node: MasterClient, topic: str, description: TopicDescription, kind: MessageType | None, queue: int
    ) -> None:
        self._node = node
        self.topic = self.key = topic
        self.uri = node.uri
        self.refusals: dict[str, str] = {}
        self.refusal_log = RefusalLog(_log, Counters())
        self.description = description
        self.kind = kind
        self.numbers = HeaderNumbers(kind) if kind is not None else None
        self._change = asyncio.Event()
        self._closed = self._ended = False
        most = _at_least_one(queue)
        self.publication = Publication(topic, node.name, description, events=self, queue_messages=most)

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

        ``header.seq`` counts the messages, 1, 2, 3 …, as rospy has it. A number in place of a string becomes its
        text: ``data=5`` is "5".

        Raises:
            MessageError: The message does not fit the type, whether there is a subscriber or not.
            RmpaError: The publisher was closed.
        """
        kind = self._known()
        if self._closed:
            raise RmpaError(_CLOSED.format(self.topic))
        payload: Buffer = kind.serialize(given_values(kind.name, message, fields))
        return self.publish_raw(self.numbers.stamp(payload) if self.numbers is not None else payload)

    def publish_raw(self, payload: Buffer) -> int:
        """Publish a serialized message as it is, without a length in front; returns as ``publish``.

        Raises:
            ValueError: The message is longer than ``ros.limits.TCPROS_MESSAGE_MAX`` bytes.
        """
        return self.publication.publish_framed(frame_message(payload))

    async def wait_for_subscriber(self) -> None:
        """Wait until there is at least one subscriber.

        Raises:
            RmpaError: The publisher or its node is closed.
        """
        await self._change.wait()
        if self._ended:
            raise RmpaError(_CLOSED.format(self.topic))

    async def drained(self) -> None:
        """Wait until all published messages are sent, at most ``runtime.limits.DRAIN_TIMEOUT`` seconds."""
        await self.publication.drained()

    async def close(self) -> None:
        """Send the queued messages, unregister, and close the connections."""
        await self.drained()
        await self._node.remove(self)

    def serve(self) -> None:
        """Take subscribers."""
        self._node.slave.add_publication(self.publication)

    async def register(self, *, again: bool = False) -> None:  # noqa: ARG002 - of subscribers
        """Register it at the master."""
        await self._node.call_master("registerPublisher", self.topic, self.description.type, self.uri)

    def withdraw(self) -> None:
        """Close the connections."""
        self._closed = True
        self.ended()
        self._node.slave.remove_publication(self.topic)

    def ended(self) -> None:
        """End ``wait_for_subscriber``; no further subscribers arrive."""
        self._ended = True
        self._change.set()

    def first_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        self._change.set()

    def last_subscriber(self) -> None:
        """Of ``PublicationEvents``."""
        if not self._ended:
            self._change.clear()

    def mismatch(self, fields: Mapping[str, str], text: str) -> None:
        """Of ``PublicationEvents``."""
        _refuse(self, "publication.refused", printable(fields.get("callerid", "")), text)

    def _known(self) -> MessageType:
        if self.kind is None:
            raise LocalProtocolError(f"{self.topic} was advertised for raw bytes; use publish_raw")
        return self.kind


class Subscriber:
    """Receives one topic of a ``Node``, by callback or ``async for``; made by ``Node.subscribe``.

    Attributes:
        refusals: Why publishers (by slave API URI) refused or do not match.
        dropped: Messages dropped because the ``async for`` is slow.
    """

    kind_name: Final = "Subscriber"

    # More than 12 fields: the three ways to receive, and the queue of one of them.
    def __init__(
        self,
        node: MasterClient,
        topic: str,
        kind: MessageType | None,
        callback: Callable[[Received], None] | None,
        *,
        on_bytes: Callable[[memoryview, Mapping[str, str]], None] | None = None,
        type_name: str = ANY,
        own: bool,
        accepts: Callable[[str], bool] | None = None,
        nodelay: bool,
        queue_messages: int,
    ) -> None:
        self._node = node
        self.topic = self.key = topic
        self.uri = node.uri
        self.refusals: dict[str, str] = {}
        self.refusal_log = RefusalLog(_log, Counters())
        self.kind = kind
        self.type_name = kind.name if kind is not None else type_name
        self.dropped = 0
        self._callback = callback
        self._on_bytes = on_bytes
        self._queue: deque[Received] = deque()
        self._queue_messages = _at_least_one(queue_messages)
        self._wake = asyncio.Event()
        self._ended = False
        self.subscription = Subscription(
            topic,
            node.slave,
            on_message=self._message,
            on_refused=self._refused,
            own=own,
            accepts=accepts,
            wanted=kind.describe() if kind is not None else TopicDescription(type_name, ANY, ""),
            nodelay=nodelay,
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
        await self._node.remove(self)

    def ended(self) -> None:
        """End the ``async for`` once its queue is empty; no further messages arrive."""
        self._ended = True
        self._wake.set()

    def serve(self) -> None:
        """Follow the publishers of the topic."""
        self._node.slave.add_subscription(self.subscription)

    async def register(self, *, again: bool = False) -> None:
        """Register it at the master, and connect to the publishers that it tells."""
        uris = await self._node.call_master("registerSubscriber", self.topic, self.type_name, self.uri)
        if isinstance(uris, list):
            self.subscription.update([str(uri) for uri in uris], keep=again)

    def withdraw(self) -> None:
        """Disconnect from the publishers."""
        self._node.slave.remove_subscription(self.subscription)

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
        _refuse(self, "subscription.refused", connection.uri, text)


def _at_least_one(queue_messages: int) -> int:
    if queue_messages < 1:
        raise ValueError(f"queue_messages is at least 1, not {queue_messages}")
    return queue_messages


def _refuse(end: Publisher | Subscriber, name: str, who: str, text: str) -> None:
    end.refusals[who] = text
    if len(end.refusals) > core_limits.LOG_KINDS_MAX:
        end.refusals.pop(next(iter(end.refusals)))
    end.refusal_log.refuse(asyncio.get_running_loop().time(), name, who, f"{end.topic}: {text}")
