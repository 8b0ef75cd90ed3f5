"""``Node``: a ROS node in Python without ROS, for programs, tools and tests; ``rmpa.Node``.

::

    async with Node("talker") as node:
        publisher = await node.advertise("/chatter", "std_msgs/String")
        async for count in node.rate(10):
            publisher.publish(data=f"hello {count}")

    async with Node("echo", anonymous=True) as node:
        async for received in await node.subscribe("/chatter"):
            print(received.message.data)
"""

from __future__ import annotations

import asyncio
import inspect
import logging
import os
import signal
import time
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, Self

from rmpa.config import limits as config_limits
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.core.timers import Schedule, positive
from rmpa.ros import limits
from rmpa.ros.environment import RosEnvironment, host_of, is_loopback
from rmpa.ros.node.endpoints import (
    Handler,
    MasterClient,
    ParamCallback,
    Publisher,
    Received,
    Service,
    ServiceClient,
    Subscriber,
)
from rmpa.ros.node.fetch_type import find_here, find_or_fetch
from rmpa.ros.node.listeners import local_addresses
from rmpa.ros.node.rosout import RosoutHandler
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.types.find import find_service_type
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import ANY, TopicDescription
from rmpa.runtime.tasks import OwnedTasks, keep_task, start_task

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
    from types import TracebackType

    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_log = logging.getLogger(__name__)

# Time between a node's checks whether its master knows it: a restarted core has the node back within a second.
NODE_MASTER_CHECK: Final = 0.5
# Messages queued for an ``async for``; above it the oldest is dropped.
_RECEIVED_QUEUE: Final = 1000

__all__ = ["Node", "Publisher", "Received", "Service", "ServiceClient", "Subscriber"]

_NO_DEFAULT: Final = object()
# Time between two look-ups of a service that is waited for.
_SERVICE_CHECK: Final = 0.2


def check_plain(function: object, what: str) -> None:
    """Refuse what is no function, and a coroutine function, which nothing would await, with TypeError."""
    if not callable(function) or inspect.iscoroutinefunction(function):
        raise TypeError(f"{what} is a plain function, not {function!r}")


class Node(MasterClient):
    """One node, registered at a master as long as the ``async with`` lasts.

    A restart of the master is detected within ``NODE_MASTER_CHECK``, and everything is registered again; open
    connections go on meanwhile. When the master shuts the node down, it closes itself: ``async for`` loops end and
    ``stopped`` is set.

    Args:
        name: Resolved in the namespace; ``__name:=`` replaces it.
        master_uri: Replaces that of the environment.
        anonymous: Whether the name is made unique.
        argv: Arguments that replace names and set private parameters, such as ``sys.argv[1:]`` of a node that
            roslaunch starts. Others are left alone.
        environment: Replaces what is read of this process's variables and of ``argv``.
        on_shutdown: ``(reason)``: called when the master shuts the node down, before the node closes.
        on_param_update: ``(key, value)``: a parameter subscribed to by ``follow_param`` has changed.
        handle_signals: Whether SIGINT (Ctrl-C) and SIGTERM close the node, so that its loops end and the program goes
            on behind the ``async with``. For the main thread.

    Raises:
        ConfigError: A ROS variable cannot be used.
        ValueError: The name is not a legal one.

    Attributes:
        stopped: Set when the node is closed.
        master_check: Seconds between two looks at the master.
    """

    def __init__(
        self,
        name: str,
        *,
        master_uri: str = "",
        anonymous: bool = False,
        argv: Sequence[str] = (),
        environment: RosEnvironment | None = None,
        on_shutdown: Callable[[str], None] | None = None,
        on_param_update: ParamCallback | None = None,
        handle_signals: bool = False,
    ) -> None:
        if environment is None:
            environment = RosEnvironment.read(os.environ, argv, local_addresses())
        if anonymous:
            name = f"{name}_{os.getpid()}_{time.time_ns() // 1_000_000}"
        self.environment = environment
        self.stopped = asyncio.Event()
        self.master_check = NODE_MASTER_CHECK
        self._on_shutdown = on_shutdown
        self._on_param_update = on_param_update
        self._signals = (signal.SIGINT, signal.SIGTERM) if handle_signals else ()
        self._rosout: RosoutHandler | None = None
        self._tasks = OwnedTasks()
        self._closing: asyncio.Task[None] | None = None
        # The process of the master at which all is registered; ``None``: not all of it.
        self._master_pid: XmlRpcValue = None
        master_uri = master_uri or environment.master_uri
        host = environment.host
        if not environment.host_given and is_loopback(host_of(master_uri)):
            # No other machine reaches that master, and the node goes on when the network is lost.
            host = "127.0.0.1"
        slave = SlaveNode(
            environment.node_name(name),
            "127.0.0.1" if is_loopback(host) else "0.0.0.0",  # noqa: S104 - as every ROS node does
            master_uri,
            advertised_host=host,
            on_shutdown=self._shutdown_requested,
            on_param_update=self._param_update,
        )
        super().__init__(slave, master_uri)

    async def __aenter__(self) -> Self:
        """Listen, and call the master once.

        Raises:
            UnreachableError: The master does not answer.
            RmpaError: The node was opened before.
        """
        if self.uri:
            raise RmpaError(f"{self.name} was opened before: make another with rmpa.Node(...)")
        await self.slave.start()
        try:
            self._master_pid = await self.call_master("getPid")
            for key, value in self.environment.parameters.items():
                await self.set_param(f"~{key}", value)
        except BaseException as error:
            await self.slave.close()
            if isinstance(error, UnreachableError):
                raise error.with_traceback(None) from None  # a short traceback, whose last line says what to do
            raise
        loop = asyncio.get_running_loop()
        for number in self._signals:
            loop.add_signal_handler(number, self._begin_close)
        self._tasks.add(keep_task(self._watch_master, f"watch master {self.name}"))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Unregister everything and close; may be called twice."""
        await asyncio.shield(self._begin_close())

    async def advertise(
        self,
        topic: str,
        kind: str | MessageType | TopicDescription,
        *,
        latch: bool = False,
        queue_messages: int = limits.SUBSCRIBER_QUEUE_MESSAGES,
    ) -> Publisher:
        """Publish a topic.

        Args:
            topic: Resolved in the namespace; ``~name`` is the node's own.
            kind: The type: its name, which ``rmpa.ros.types.find`` finds here or a publisher sends; a type; or, for
                raw bytes only, a description.
            latch: Whether each new subscriber gets the last message.
            queue_messages: Messages queued for one slow subscriber; above it the oldest is dropped.

        Raises:
            DefinitionError: The type is not known.
            UnreachableError: The master does not answer.
            PeerRefused: The master refuses the registration.
        """
        resolved = self._resolve(topic)
        if isinstance(kind, str):
            kind = await find_or_fetch(self.master_uri, self.name, kind, resolved)
        description = kind if isinstance(kind, TopicDescription) else kind.describe(latching=latch)
        known = kind if isinstance(kind, MessageType) else None
        return await self._add(Publisher(self, resolved, description, known, queue_messages))

    async def subscribe(
        self,
        topic: str,
        kind: str | MessageType | None = None,
        callback: Callable[[Received], None] | None = None,
        *,
        on_bytes: Callable[[memoryview, Mapping[str, str]], None] | None = None,
        own: bool = True,
        accepts: Callable[[str], bool] | None = None,
        nodelay: bool = True,
        queue_messages: int = _RECEIVED_QUEUE,
    ) -> Subscriber:
        """Subscribe to a topic, of this node's own publisher too, as rospy does; each subscriber connects for itself.

        Args:
            topic: Resolved in the namespace.
            kind: The type; ``None`` accepts any. Without a definition on this machine the publisher's is used.
            callback: Called in the event loop with each message; its exceptions are logged. Without one, use
                ``async for`` on the result.
            on_bytes: ``(data, header)``: called in place of ``callback`` with a message's bytes, a view that is valid
                during the call only, and the publisher's connection header.
            own: Whether what this node publishes on the topic is received too.
            accepts: Whether the publisher of a slave API URI is connected to; ``None``: each.
            nodelay: Whether to ask publishers for TCP_NODELAY.
            queue_messages: Messages queued for the ``async for``; above it the oldest is dropped.

        Raises:
            DefinitionError: The type is not known.
            UnreachableError: The master does not answer.
            PeerRefused: The master refuses the registration.
            TypeError: ``callback`` is a coroutine function.
        """
        resolved = self._resolve(topic)
        if callback is not None:
            check_plain(callback, f"the callback for {resolved}")
        type_name = kind if isinstance(kind, str) else ANY
        if isinstance(kind, str):
            kind = await find_here(kind) if kind != ANY else None
        subscriber = Subscriber(
            self,
            resolved,
            kind,
            callback,
            on_bytes=on_bytes,
            type_name=type_name,
            own=own,
            accepts=accepts,
            nodelay=nodelay,
            queue_messages=queue_messages,
        )
        return await self._add(subscriber)

    async def wait_for_message(
        self,
        topic: str,
        kind: str | MessageType | None = None,
        timeout: float | None = None,  # noqa: ASYNC109 - the message names it
    ) -> Received:
        """The next message of a topic; arguments and errors are those of ``subscribe``.

        Args:
            topic: Resolved in the namespace.
            kind: The type; ``None`` accepts any.
            timeout: Seconds; ``None`` waits for ever.

        Raises:
            UnreachableError: There was none in time, or the node was closed.
        """
        subscriber = await self.subscribe(topic, kind, queue_messages=1)
        where = f"{self.name}, which is closed"
        try:
            async with asyncio.timeout(timeout):
                async for received in subscriber:
                    return received
        except TimeoutError:
            where = f"{self.name} in {timeout:g} s"
        finally:
            await subscriber.close()
        refused = "".join(list(subscriber.refusals.values())[-1:])
        remedy = refused or f"`rmpa why {subscriber.topic}` says what is missing"
        raise UnreachableError(f"publisher of {subscriber.topic}", where, remedy)

    async def advertise_service(
        self,
        name: str,
        kind: str | ServiceType,
        handler: Handler,
        *,
        timeout: float = config_limits.SERVICE_TIMEOUT,  # noqa: ASYNC109 - of each call; the client gets an error
        raw: bool = False,
    ) -> Service:
        """Serve a service.

        Args:
            name: Resolved in the namespace; ``~name`` is the node's own.
            kind: The type.
            handler: Called in the loop with each request's object; returns the response, as an object or plain
                values, at once or as an awaitable. An exception becomes the client's error.
            timeout: Seconds for a call before the client gets an error.
            raw: Whether the handler gets the request's bytes, and returns the response's.

        Raises:
            DefinitionError: The type is not known.
            UnreachableError: The master does not answer.
            PeerRefused: The master refuses the registration.
            ValueError: The node serves that service already.
        """
        resolved = self._resolve(name)
        kind = await asyncio.to_thread(find_service_type, kind) if isinstance(kind, str) else kind
        return await self._add(Service(self, resolved, kind, handler, timeout, raw=raw))

    async def lookup_service(self, name: str) -> str:
        """The URI of a service, ``rosrpc://host:port``.

        Raises:
            UnreachableError: No node serves it, or the master does not answer.
        """
        resolved = self._resolve(name)
        reply = await self._call("lookupService", resolved)
        if reply.code != 1:
            where = f"the ROS master {self.master_uri}"
            raise UnreachableError(f"server of service {resolved}", where, "does its node run?")
        return str(reply.value)

    async def wait_for_service(self, name: str, timeout: float | None = None) -> None:  # noqa: ASYNC109
        """Wait until a service answers.

        Args:
            name: Resolved in the namespace.
            timeout: Seconds; ``None`` waits for ever.

        Raises:
            UnreachableError: It does not in time; the text says why.
        """
        loop = asyncio.get_running_loop()
        until = None if timeout is None else loop.time() + timeout
        while True:
            try:
                uri = await self.lookup_service(name)
                await ServiceConnection.probe(uri, self._resolve(name), self.name, limits.SERVICE_OPEN_TIMEOUT)
            except RmpaError:
                if self.stopped.is_set() or (until is not None and loop.time() >= until):
                    raise
            else:
                return
            await self._stopped_before(loop.time() + _SERVICE_CHECK)

    async def connect_service(self, name: str, kind: str | ServiceType, *, persistent: bool = True) -> ServiceClient:
        """Connect to a service, for many calls or for one; close the result.

        Raises:
            DefinitionError: The type is not known.
            UnreachableError: No node serves it, or its server does not answer.
            PeerRefused: The server has another version of the type, or another service.
        """
        found = await asyncio.to_thread(find_service_type, kind) if isinstance(kind, str) else kind
        uri, resolved = await self.lookup_service(name), self._resolve(name)

        async def connect(to: ServiceType) -> ServiceClient:
            opened = await ServiceConnection.open(uri, resolved, self.name, md5sum=to.md5sum, persistent=persistent)
            return ServiceClient(opened, to)

        try:
            return await connect(found)
        except PeerRefused:
            # This machine may have two versions of the type: one of a workspace, and the one that rmpa brings.
            other = await self._version_of(uri, resolved, found) if isinstance(kind, str) else None
            if other is None:
                raise
        return await connect(other)

    async def call_service(
        self,
        name: str,
        kind: str | ServiceType,
        request: object = None,
        timeout: float | None = config_limits.SERVICE_TIMEOUT,  # noqa: ASYNC109 - the message names it
    ) -> Any:
        """Call a service once; arguments and errors are those of ``connect_service`` and ``ServiceClient.call``.

        Returns:
            The response as an object.
        """
        client = await self.connect_service(name, kind, persistent=False)
        try:
            return await client.call(request, timeout)
        finally:
            client.close()

    async def get_published_topics(self, subgraph: str = "") -> list[tuple[str, str]]:
        """Topics that have a publisher, with their types."""
        value = await self.call_master("getPublishedTopics", subgraph)
        return [(str(p[0]), str(p[1])) for p in value if isinstance(p, list)] if isinstance(value, list) else []

    async def get_param(self, key: str, default: XmlRpcValue | object = _NO_DEFAULT) -> XmlRpcValue:
        """A parameter's value, or ``default`` where one is given and the parameter does not exist.

        Raises:
            PeerRefused: The parameter does not exist, and no ``default`` is given.
        """
        reply = await self._call("getParam", self._resolve(key))
        if reply.code == 1:
            return reply.value
        if default is _NO_DEFAULT:
            raise PeerRefused(f"the ROS master at {self.master_uri}", reply.status, code="core-refuses")
        return default  # type: ignore[return-value]

    async def set_param(self, key: str, value: XmlRpcValue) -> None:
        """Set a parameter."""
        await self.call_master("setParam", self._resolve(key), value)

    async def has_param(self, key: str) -> bool:
        """Whether a parameter exists."""
        return bool(await self.call_master("hasParam", self._resolve(key)))

    async def delete_param(self, key: str) -> None:
        """Delete a parameter.

        Raises:
            PeerRefused: The parameter does not exist.
        """
        await self.call_master("deleteParam", self._resolve(key))

    async def search_param(self, key: str) -> str | None:
        """The full name of the nearest parameter of this name, searched upwards through the namespaces.

        ``None`` if there is none.
        """
        reply = await self._call("searchParam", key)
        return str(reply.value) if reply.code == 1 else None

    async def follow_param(self, key: str, callback: ParamCallback | None = None) -> XmlRpcValue:
        """Subscribe to a parameter or a namespace; return its value, ``{}`` for none.

        Args:
            key: Resolved in the namespace; ``~name`` is the node's own.
            callback: ``(key, value)``: called in the event loop with each change; a deleted parameter's value is
                ``{}``. ``on_param_update`` is called too.
        """
        resolved = self._resolve(key)
        self._followed[resolved] = callback
        return await self.call_master("subscribeParam", self.uri, resolved)

    def rate(self, hz: float) -> AsyncIterator[int]:
        """The numbers 0, 1, 2 … at a rate, the first one at once, until the node closes.

        Due times are absolute, so that lateness does not add up. A time that is a whole period past is left out, and
        so is its number.

        Args:
            hz: How many a second, above 0.
        """
        return self._ticks(positive(1 / positive(hz, "a rate"), "1 / a rate"))

    async def _ticks(self, period: float) -> AsyncIterator[int]:
        loop = asyncio.get_running_loop()
        schedule, count = Schedule(period, loop.time()), 0
        while True:
            due, missed = schedule.next_due(loop.time())
            if await self._stopped_before(due):
                return
            count += missed
            yield count
            count += 1

    def timer(self, period: float, callback: Callable[[], Awaitable[None] | None]) -> asyncio.Task[None]:
        """Call a function again and again, the first time after one period, until the node closes.

        Args:
            period: Seconds from one call to the next, above 0, by absolute times as in ``rate``.
            callback: A function or a coroutine function; its exceptions are logged.

        Returns:
            Its task: ``cancel()`` ends it.
        """
        ticks = self.rate(1 / positive(period, "a timer's period"))

        async def run() -> None:
            async for count in ticks:
                if not count:
                    continue
                try:
                    result = callback()
                    if inspect.isawaitable(result):
                        await result
                except Exception:  # noqa: BLE001 - the top of the user's code
                    _log.exception("! %s: a timer of %g s failed", self.name, period)

        return self._tasks.start(run(), f"timer of {self.name}")

    @cached_property
    def logger(self) -> logging.Logger:
        """The node's log: its records go to ``/rosout``, and to the handlers that the program has configured.

        Without a handler they go to standard error. First read it inside of the ``async with``; it may be used in any
        thread then. Its level is INFO unless the program sets another.
        """
        logger = logging.getLogger("rosout" + self.name.replace("/", "."))
        if logger.level == logging.NOTSET:
            logger.setLevel(logging.INFO)
        self._rosout = RosoutHandler(self, self.advertise)
        logger.addHandler(self._rosout)
        return logger

    async def _version_of(self, uri: str, service: str, found: ServiceType) -> ServiceType | None:
        """Find the server's version of a service type; ``None`` if it is the same or is not on this machine."""
        try:
            said = (await ServiceConnection.probe(uri, service, self.name, limits.SERVICE_OPEN_TIMEOUT)).description
            other = await asyncio.to_thread(find_service_type, found.name, said.md5sum)
        except RmpaError:
            return None
        return other if said.type == found.name and other.md5sum != found.md5sum else None

    def _resolve(self, name: str) -> str:
        return self.environment.resolve(name, self.name)

    async def _watch_master(self) -> None:
        while True:
            await asyncio.sleep(self.master_check)
            if not (self._entries or self._followed):
                continue
            try:
                pid = await self.call_master("getPid")
                if pid != self._master_pid or (await self._call("lookupNode", self.name)).code != 1:
                    _log.info(
                        "= %s: the master at %s was started again; registering again", self.name, self.master_uri
                    )
                    self._master_pid = None
                    await self._register_again()
                    self._master_pid = pid
            except RmpaError as error:
                _log.debug("! %s: %s", self.name, error)

    def _param_update(self, key: str, value: XmlRpcValue) -> bool:
        # An update of a namespace concerns subscriptions below it, and the other way round.
        concerned = [
            callback
            for f, callback in self._followed.items()
            if key == f or key.startswith(f.rstrip("/") + "/") or f.startswith(key.rstrip("/") + "/")
        ]
        for callback in (*concerned, self._on_param_update) if concerned else ():
            try:
                if callback is not None:
                    callback(key, value)
            except Exception:  # noqa: BLE001 - the top of the user's code
                _log.exception("! %s: the callback for parameter %s failed", self.name, key)
        return bool(concerned)

    async def _stopped_before(self, due: float) -> bool:
        try:
            async with asyncio.timeout_at(due):
                await self.stopped.wait()
        except TimeoutError:
            return False
        return True

    def _shutdown_requested(self, reason: str) -> None:
        if self._closing is None:
            if self._on_shutdown is not None:
                self._on_shutdown(reason)
            self._begin_close()  # in a task of its own, so that the answer to this call is sent first

    def _begin_close(self) -> asyncio.Task[None]:
        if self._closing is None:
            self._closing = start_task(self._close(), f"close {self.name}")
        return self._closing

    async def _close(self) -> None:
        self.stopped.set()
        if self._rosout is not None:
            await self._rosout.drained()
            self.logger.removeHandler(self._rosout)
        await self._tasks.close()
        await self._unregister_all()
        for entry in self._entries:
            if not isinstance(entry, Service):
                entry.ended()
        await asyncio.gather(*(entry.drained() for entry in self._entries if isinstance(entry, Publisher)))
        await self.slave.close()
        for number in self._signals:
            asyncio.get_running_loop().remove_signal_handler(number)
