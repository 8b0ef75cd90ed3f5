"""``Node``: a ROS node in Python without ROS, for programs, tools and tests; ``from rmpa.ros import Node``.

::

    async with Node("talker") as node:
        publisher = await node.advertise("/chatter", "std_msgs/String")
        publisher.publish(data="hello")

    async with Node("echo", anonymous=True) as node:
        async for received in await node.subscribe("/chatter"):
            print(received.message.data)
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from typing import TYPE_CHECKING, Any, Final, Self

from rmpa.config import limits as config_limits
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.environment import RosEnvironment, host_of, is_loopback
from rmpa.ros.node.endpoints import (
    Handler,
    MasterClient,
    Publisher,
    Received,
    Service,
    ServiceClient,
    Subscriber,
    probe,
)
from rmpa.ros.node.fetch_type import find_or_fetch
from rmpa.ros.node.listeners import local_addresses
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.types.definitions import UnknownTypeError
from rmpa.ros.types.find import find_message_type, find_service_type
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import ANY, TopicDescription

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from types import TracebackType

    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

# Time between a node's checks whether its master knows it: a restarted core has the node back within a second.
NODE_MASTER_CHECK: Final = 0.5

# Messages queued for an ``async for``; above it the oldest is dropped.
_RECEIVED_QUEUE: Final = 1000

__all__ = ["Node", "Publisher", "Received", "Service", "ServiceClient", "Subscriber"]

_log = logging.getLogger(__name__)
_NO_DEFAULT: Final = object()


class Node(MasterClient):
    """One node, registered at a master as long as the ``async with`` lasts.

    A restart of the master is detected within ``NODE_MASTER_CHECK``, and everything is registered again; open
    connections go on meanwhile. When the master shuts the node down, it closes itself: ``async for`` loops end and
    ``stopped`` is set.

    Args:
        name: Resolved in the namespace; ``__name:=`` replaces it.
        master_uri: Replaces that of the environment.
        anonymous: Whether the name is made unique.
        environment: Replaces that of this process's variables; pass one to use command-line arguments.
        on_shutdown: ``(reason)``: called when the master shuts the node down, before the node closes.
        on_param_update: ``(key, value)``: a parameter subscribed to by ``follow_param`` has changed.

    Raises:
        ConfigError: A ROS variable cannot be used.
        ValueError: The name is not a legal one.

    Attributes:
        stopped: Set when the node is closed.
    """

    def __init__(
        self,
        name: str,
        *,
        master_uri: str = "",
        anonymous: bool = False,
        environment: RosEnvironment | None = None,
        on_shutdown: Callable[[str], None] | None = None,
        on_param_update: Callable[[str, XmlRpcValue], None] | None = None,
    ) -> None:
        if environment is None:
            environment = RosEnvironment.read(os.environ, (), local_addresses())
        if anonymous:
            name = f"{name}_{os.getpid()}_{time.time_ns() // 1_000_000}"
        self.environment = environment
        self.stopped = asyncio.Event()
        self._on_shutdown = on_shutdown
        self._on_param_update = on_param_update
        self._watch: asyncio.Task[None] | None = None
        self._closing: asyncio.Task[None] | None = None
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
        """
        await self.slave.start()
        try:
            await self.call_master("getPid")
        except BaseException:
            await self.slave.close()
            raise
        self._watch = asyncio.get_running_loop().create_task(self._watch_master(), name=f"watch master {self.name}")
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Unregister everything and close; may be called twice."""
        await asyncio.shield(self._begin_close())

    # --- topics -----------------------------------------------------------------------------------------------

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
        publisher = Publisher(self, resolved, description, known, queue_messages)
        await self._add(publisher)
        return publisher

    async def subscribe(
        self,
        topic: str,
        kind: str | MessageType | None = None,
        callback: Callable[[Received], None] | None = None,
        *,
        on_bytes: Callable[[memoryview, Mapping[str, str]], None] | None = None,
        own: bool = True,
        nodelay: bool = True,
        queue_messages: int = _RECEIVED_QUEUE,
    ) -> Subscriber:
        """Subscribe to a topic, of this node's own publisher too, as rospy and roscpp do.

        Args:
            topic: Resolved in the namespace.
            kind: The type; ``None`` accepts any. Without a definition on this machine the publisher's is used.
            callback: Called in the event loop with each message; its exceptions are logged. Without one, use
                ``async for`` on the result.
            on_bytes: ``(data, header)``: called in place of ``callback`` with a message's bytes, a view that is valid
                during the call only, and the publisher's connection header.
            own: Whether what this node publishes on the topic is received too.
            nodelay: Whether to ask publishers for TCP_NODELAY.
            queue_messages: Messages queued for the ``async for``; above it the oldest is dropped.

        Raises:
            DefinitionError: The type is not known.
            UnreachableError: The master does not answer.
            PeerRefused: The master refuses the registration.
            ValueError: The node subscribes to that topic already.
        """
        resolved = self._resolve(topic)
        type_name = kind if isinstance(kind, str) else ANY
        if isinstance(kind, str):
            kind = await self._find_type(kind) if kind != ANY else None
        if ("Subscriber", resolved) in self._entries:
            raise ValueError(f"{self.name} subscribes to {resolved} already")
        subscriber = Subscriber(
            self,
            resolved,
            kind,
            callback,
            on_bytes=on_bytes,
            type_name=type_name,
            own_uri="" if own else self.uri,
            nodelay=nodelay,
            queue_messages=queue_messages,
        )
        await self._add(subscriber)
        return subscriber

    # --- services ---------------------------------------------------------------------------------------------

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
        service = Service(self, resolved, kind, handler, timeout, raw=raw)
        await self._add(service)
        return service

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

    # --- the master -------------------------------------------------------------------------------------------

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
            raise PeerRefused(f"the ROS master at {self.master_uri}", reply.status)
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

    async def follow_param(self, key: str) -> XmlRpcValue:
        """Subscribe to a parameter: ``on_param_update`` gets its changes; return its value, ``{}`` for none."""
        resolved = self._resolve(key)
        self._followed.add(resolved)
        return await self.call_master("subscribeParam", self.uri, resolved)

    # --- inside -----------------------------------------------------------------------------------------------

    async def _find_type(self, name: str) -> MessageType | None:
        """Find a message type on this machine; ``None`` if only a publisher can supply it.

        Raises:
            DefinitionError: The definition is malformed, or rmpa brings the types of its package, but none of this
                name.
        """
        try:
            return await asyncio.to_thread(find_message_type, name)
        except UnknownTypeError as error:
            if not error.fetchable:
                raise
            return None

    async def _version_of(self, uri: str, service: str, found: ServiceType) -> ServiceType | None:
        """Find the server's version of a service type; ``None`` if it is the same or is not on this machine."""
        try:
            said = (await probe(uri, service, self.name, limits.SERVICE_OPEN_TIMEOUT)).description
            other = await asyncio.to_thread(find_service_type, found.name, said.md5sum)
        except RmpaError:
            return None
        return other if said.type == found.name and other.md5sum != found.md5sum else None

    def _resolve(self, name: str) -> str:
        return self.environment.resolve(name, self.name)

    async def _watch_master(self) -> None:
        while True:
            await asyncio.sleep(NODE_MASTER_CHECK)
            if not (self._entries or self._followed):
                continue
            try:
                if (await self._call("lookupNode", self.name)).code != 1:
                    _log.info(
                        "= %s: the master at %s was started anew; registering again", self.name, self.master_uri
                    )
                    await self._register_again()
            except RmpaError as error:
                _log.debug("! %s: %s", self.name, error)

    def _param_update(self, key: str, value: XmlRpcValue) -> bool:
        # An update of a namespace concerns subscriptions below it, and the other way round.
        if not any(
            key == f or key.startswith(f.rstrip("/") + "/") or f.startswith(key.rstrip("/") + "/")
            for f in self._followed
        ):
            return False
        if self._on_param_update is not None:
            self._on_param_update(key, value)
        return True

    def _shutdown_requested(self, reason: str) -> None:
        if self._closing is None:
            if self._on_shutdown is not None:
                self._on_shutdown(reason)
            self._begin_close()  # in a task of its own, so that the answer to this call is sent first

    def _begin_close(self) -> asyncio.Task[None]:
        if self._closing is None:
            self._closing = asyncio.get_running_loop().create_task(self._close(), name=f"close {self.name}")
        return self._closing

    async def _close(self) -> None:
        if self._watch is not None:
            self._watch.cancel()
            await asyncio.wait([self._watch])
        self.stopped.set()
        await self._unregister_all()
        for entry in self._entries.values():
            if isinstance(entry, Publisher):
                await entry.drained()
            elif isinstance(entry, Subscriber):
                entry.ended()
        await self.slave.close()
