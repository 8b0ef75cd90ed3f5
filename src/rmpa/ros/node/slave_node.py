"""A node of this process: its Slave API, its topics and its services."""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
from functools import partial
from typing import TYPE_CHECKING, Protocol

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.log import RefusalLog
from rmpa.core.statistics import Counters
from rmpa.ros import limits
from rmpa.ros.http.server import XmlRpcServer, listen
from rmpa.ros.node.ask import read_header
from rmpa.ros.node.publication import AcceptedConnection, Publication
from rmpa.ros.node.subscription import PublisherConnection, TopicConnection
from rmpa.ros.wire.slave_api import METHODS, TCPROS, BusConnection, bus_info, bus_stats, check_call
from rmpa.ros.wire.tcpros import ANY, ANYTHING, TopicDescription, check_request, printable
from rmpa.ros.wire.xmlrpc import RosFault, RosReply, XmlRpcValue
from rmpa.runtime.accept import Acceptor, Use
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    import socket
    from collections.abc import Awaitable, Callable, Iterable

    from rmpa.ros.node.listeners import SharedListener
    from rmpa.ros.node.service_server import ServiceEndpoint

_log = logging.getLogger(__name__)


def _ignore(*_: object) -> None:
    pass


def _not_followed(_key: str, _value: XmlRpcValue) -> bool:
    return False


class SubscribedTopic(Protocol):
    """A topic that a node subscribes to, or is shown to.

    Attributes:
        topic: The topic's global name.
        type_name: Its type; ``*`` for any.
    """

    topic: str
    type_name: str

    def connections(self) -> list[BusConnection]:
        """The connections to its publishers."""

    def update(self, uris: Iterable[str]) -> None:
        """Take the master's list of publishers, by their slave APIs."""

    def close(self) -> None:
        """Disconnect from all."""


class SlaveNode:
    """Serves the topics and services of one node; its owner registers them at a master.

    It has no task of its own, and two listening sockets, or none with a shared ``listener``: an agent can run
    thousands of such nodes.

    Args:
        name: The node's global name.
        host: The address to listen at, and to register unless ``advertised_host`` is given.
        master_uri: The answer to ``getMasterUri``; the owner sets it later if its master does not listen yet.
        advertised_host: The address to register, if it differs from ``host``.
        listener: A started listener that accepts this node's connections and assigns its address; ``host`` and
            ``advertised_host`` are then ignored.
        counters: Count refusals, ``tcpros.refused.*`` among them.
        on_shutdown: ``(reason)``: the master shuts this node down; the owner has to close it.
        on_param_update: ``(key, value) -> whether the node subscribed to that key``.
        on_kill: ``(caller id, reason) -> reply``: awaited after ``on_shutdown`` for the answer to ``shutdown``.
        taps: The owner's own connections to publishers, for ``getBusInfo`` and ``getBusStats``.
        elsewhere: ``(topic)``: the connections to further subscribers of the remote node that this one stands for.

    Attributes:
        uri: The slave API's URI, ``http://host:port/``; empty before ``start()``.
    """

    # More than 12 fields: the tables of topics and services, the two servers, and the callbacks of the Slave API.
    def __init__(
        self,
        name: str,
        host: str,
        master_uri: str,
        *,
        advertised_host: str = "",
        listener: SharedListener | None = None,
        counters: Counters | None = None,
        on_shutdown: Callable[[str], None] = _ignore,
        on_param_update: Callable[[str, XmlRpcValue], bool] = _not_followed,
        on_kill: Callable[[str, str], Awaitable[RosReply]] | None = None,
        taps: Callable[[], Iterable[TopicConnection]] = tuple,
        elsewhere: Callable[[str], Iterable[BusConnection]] = lambda _: (),
    ) -> None:
        self.name = name
        self.master_uri = master_uri
        self.uri = ""
        self.counters = counters if counters is not None else Counters()
        self._host = host
        self._listener = listener
        self._advertised = advertised_host or host
        self._publications: dict[str, Publication] = {}
        self._subscriptions: list[SubscribedTopic] = []
        self._services: dict[str, ServiceEndpoint] = {}
        self._numbers = itertools.count(1)
        self._on_shutdown = on_shutdown
        self._on_kill = on_kill
        self._on_param_update = on_param_update
        self._taps = taps
        self._elsewhere = elsewhere
        self._http = XmlRpcServer(self._call, host, counters=self.counters, name=f"node {name}")
        self._tcpros_port = 0
        self._acceptor: Acceptor | None = None
        # One for each TCPROS connection whose header has not come.
        self._greetings = OwnedTasks()
        self._refusals = RefusalLog(_log, self.counters)

    async def start(self) -> None:
        """Listen.

        Raises:
            StartError: The address cannot be used.
        """
        if self._listener is not None:
            self._advertised = self._listener.attach(self.name, self._http.adopt, self._adopt)
            self._http.port, self._tcpros_port = self._listener.ports
        else:
            await self._http.start()
            name = f"TCPROS server of {self.name}"
            try:
                sock = await listen(name, self._host, 0, Use.DATA)
            except BaseException:
                await self._http.close()
                raise
            self._tcpros_port = sock.getsockname()[1]
            self._acceptor = Acceptor(sock, self._adopt, name=name)
            self._acceptor.start()
        self.uri = f"http://{self._advertised}:{self._http.port}/"

    async def close(self) -> None:
        """Close the topics and services, then the servers; the owner has unregistered them before."""
        services = tuple(self._services.values())
        for topic in tuple(self._publications):
            self.remove_publication(topic)
        for subscription in tuple(self._subscriptions):
            self.remove_subscription(subscription)
        for service in tuple(self._services):
            self.remove_service(service)
        if self._listener is not None and self.uri:
            self._listener.detach(self._advertised)
            self._listener = None  # a second close must not free the next node's address
        if self._acceptor is not None:
            self._acceptor.close()
        await self._greetings.close()
        await self._http.close()
        await asyncio.gather(*(endpoint.closed() for endpoint in services))
        # The node and its servers are a reference cycle, which must not hold the owner until it is collected.
        self._on_shutdown, self._on_kill, self._on_param_update, self._taps = _ignore, None, _not_followed, tuple

    def next_number(self) -> int:
        """A number for a connection of this node."""
        return next(self._numbers)

    def add_publication(self, publication: Publication) -> None:
        """Serve a topic from now on.

        Raises:
            ValueError: The node publishes that topic already.
        """
        if publication.topic in self._publications:
            raise ValueError(f"{self.name} publishes {publication.topic} already")
        self._publications[publication.topic] = publication

    def publication(self, topic: str) -> Publication | None:
        """A topic that is served; ``None`` if it is not."""
        return self._publications.get(topic)

    def remove_publication(self, topic: str) -> None:
        """Stop serving a topic and close its connections; nothing happens if it is not served."""
        publication = self._publications.pop(topic, None)
        if publication is not None:
            publication.withdraw()

    def add_subscription(self, subscription: SubscribedTopic) -> None:
        """Pass ``publisherUpdate`` of its topic on to a subscription."""
        self._subscriptions.append(subscription)

    def remove_subscription(self, subscription: SubscribedTopic) -> None:
        """Disconnect from its topic's publishers."""
        if subscription in self._subscriptions:
            self._subscriptions.remove(subscription)
            subscription.close()

    @property
    def service_uri(self) -> str:
        """The URI of this node's services, ``rosrpc://host:port``; only after ``start()``."""
        return f"rosrpc://{self._advertised}:{self._tcpros_port}"

    def add_service(self, endpoint: ServiceEndpoint) -> None:
        """Serve a service from now on.

        Raises:
            ValueError: The node serves one of that name already.
        """
        if endpoint.service in self._services:
            raise ValueError(f"{self.name} serves {endpoint.service} already")
        self._services[endpoint.service] = endpoint

    def remove_service(self, service: str, text: str = "") -> None:
        """Stop serving a service; calls under way get an error with ``text``.

        Nothing happens if it is not served.
        """
        endpoint = self._services.pop(service, None)
        if endpoint is not None:
            endpoint.withdraw(text)

    def publications(self) -> dict[str, str]:
        """Published topics and types; ``*`` where the type is not known yet."""
        return {p.topic: p.description.type if p.description else ANY for p in self._publications.values()}

    def subscriptions(self) -> dict[str, str]:
        """Subscribed topics and types."""
        found = {s.topic: s.type_name for s in self._subscriptions}
        return found | {tap.topic: tap.fields.get("type", ANY) for tap in self._taps()}

    def connections(self) -> list[BusConnection]:
        """All topic connections."""
        found = [
            c for topic, each in self._publications.items() for c in (*each.connections(), *self._elsewhere(topic))
        ]
        found += [c for subscription in self._subscriptions for c in subscription.connections()]
        return found + [tap.connection() for tap in self._taps()]

    def address_of(self, topic: str) -> tuple[str, int] | None:
        """Host and port for subscribers of a topic; ``None`` if it is not published."""
        return (self._advertised, self._tcpros_port) if topic in self._publications else None

    def _adopt(self, sock: socket.socket, client: tuple[str, int]) -> None:
        """Serve an accepted, non-blocking TCPROS connection; the node owns it from here on."""
        served = sum(topic.subscribers for topic in self._publications.values())
        served += sum(service.clients for service in self._services.values())
        waiting = len(self._greetings)
        if served + waiting >= limits.TCPROS_CONNECTIONS_MAX or waiting >= limits.TCPROS_HANDSHAKES_MAX:
            self._refuse("full", client[0], f"too many connections, one from {client[0]} closed")
            sock.close()
            return
        greeting = self._greetings.start(self._greet(sock, client[0]), f"header of a connection to {self.name}")
        # One that is cancelled before its first step never comes to its own end.
        greeting.add_done_callback(lambda ended: sock.close() if ended.cancelled() else None)

    async def _greet(self, sock: socket.socket, who: str) -> None:
        """Wait for the header of a connection, and pass it to the publication or service that it names."""
        connection = None
        try:
            async with asyncio.timeout(limits.TCPROS_HANDSHAKE_TIMEOUT):
                request = await read_header(sock)
            if request is not None:
                connection = AcceptedConnection(sock, self.next_number(), request)
        except TimeoutError:
            self._refuse("silent", who, f"{who} sent no header within {limits.TCPROS_HANDSHAKE_TIMEOUT:g} s; closed")
        except RemoteProtocolError as error:
            self._refuse("malformed", who, f"a connection from {who}: {error}")
        except OSError:
            pass  # the client has disconnected already, which is normal for rospy
        finally:
            if connection is None:
                sock.close()
        if connection is not None:
            try:
                self._attach(connection)
            except Exception as error:
                connection.lost(error)  # else the other side would wait for ever
                raise

    def _attach(self, connection: AcceptedConnection) -> None:
        fields = connection.request
        problem = check_request(fields)
        if problem is not None:
            self._refuse("header", connection.peer[0], f"a connection from {connection.peer[0]}: {problem}")
            connection.refuse(problem)
            return
        kind = "service" if "service" in fields else "topic"
        name = fields[kind]
        taker = self._services.get(name) if kind == "service" else self._publications.get(name)
        if taker is not None:
            taker.attach(connection)
            return
        # At debug level: the other node may have looked up something that is gone by now.
        _log.debug("! %s: no %s %s", self.name, kind, printable(name))
        verb = "does not offer the service" if kind == "service" else "is not a publisher of"
        connection.refuse(f"[{self.name}] {verb} [{printable(name)}]")

    def _refuse(self, kind: str, who: str, text: str) -> None:
        now = asyncio.get_running_loop().time()
        self._refusals.refuse(now, f"tcpros.refused.{kind}", who, f"{self.name}: {text}")

    def _call(self, method: str, params: tuple[XmlRpcValue, ...]) -> XmlRpcValue | Awaitable[XmlRpcValue]:
        if method not in METHODS:
            raise RosFault(-1, f"{self.name} has no method {method}")
        problem = check_call(method, params)
        if problem is not None:
            return [-1, problem, METHODS[method][1]]
        match method, params:
            case "shutdown", [str(caller), *reason]:
                why = "".join(map(str, reason))
                _log.info("< %s: asked to shut down: %s", self.name, why)
                self._on_shutdown(why)
                return [1, "shutdown", 0] if self._on_kill is None else self._on_kill(caller, why)
            case "requestTopic", [str(caller), str(topic), list(protocols)]:
                return self._request_topic(caller, topic, protocols)
            case "publisherUpdate", [_, str(topic), list(publishers)]:
                for subscription in self._subscriptions:
                    if subscription.topic == topic:
                        subscription.update(map(str, publishers))
                return [1, "", 0]
            case "paramUpdate", [_, str(key), value]:
                # rosmaster appends a slash to the key, and roscpp removes it.
                followed = self._on_param_update(key.rstrip("/") or "/", value)
                return [1, "", 0] if followed else [-1, "not subscribed", 0]
        return self._fact(method)

    def _fact(self, method: str) -> XmlRpcValue:
        """Answer a method that has no parameters."""
        match method:
            case "getBusStats":
                return [1, "", bus_stats(self.publications(), self.subscriptions(), self.connections())]
            case "getBusInfo":
                return [1, "bus info", bus_info(self.connections())]
            case "getSubscriptions":
                return [1, "subscriptions", [list(pair) for pair in self.subscriptions().items()]]
            case "getPublications":
                return [1, "publications", [list(pair) for pair in self.publications().items()]]
            case "getMasterUri":
                return [1, self.master_uri, self.master_uri] if self.master_uri else [0, "master URI not set", ""]
            case "getPid":
                return [1, "", os.getpid()]
        return [1, "", self.name if method == "getName" else self.uri]

    def _request_topic(
        self, caller: str, topic: str, protocols: list[XmlRpcValue]
    ) -> XmlRpcValue | Awaitable[XmlRpcValue]:
        address = self.address_of(topic)
        if address is None:
            return [-1, f"Not a publisher of [{topic}]", []]
        if not any(isinstance(p, list) and p and p[0] == TCPROS for p in protocols):
            return [0, "no supported protocol implementations", []]
        own: list[XmlRpcValue] = [1, f"ready on {address[0]}:{address[1]}", [TCPROS, *address]]
        other = self._publications[topic].events.request(caller)
        return own if other is None else _decided(other, own)


async def _decided(other: Awaitable[RosReply | None], own: list[XmlRpcValue]) -> XmlRpcValue:
    try:
        return await other or own
    except Exception:  # noqa: BLE001 - the subscriber would not ask again
        _log.exception("! a requestTopic was not decided; answered with the own address")
        return own


class Subscription:
    """A topic that a node of this process subscribes to: one connection to each listed publisher.

    Unlike rospy it disconnects from publishers that are no longer listed. A publisher that refused is tried again
    when the master lists it again.

    Args:
        topic: The topic's global name.
        node: The node, which listens already.
        on_message: ``(connection, framed)``; the view is only valid during the call.
        on_refused: ``(connection, text)``.
        own: Whether the node subscribes to itself too.
        accepts: Whether the publisher of a slave API is connected to; ``None``: each.
        wanted: The type and md5 sum to ask for, and the definition to send.
        nodelay: Whether to ask for TCP_NODELAY.
    """

    def __init__(
        self,
        topic: str,
        node: SlaveNode,
        *,
        on_message: Callable[[PublisherConnection, memoryview], None],
        on_refused: Callable[[PublisherConnection, str], None] = _ignore,
        own: bool = False,
        accepts: Callable[[str], bool] | None = None,
        wanted: TopicDescription = ANYTHING,
        nodelay: bool = True,
    ) -> None:
        self.topic = topic
        self.type_name = wanted.type
        self._connection = partial(PublisherConnection, topic, caller_id=node.name, wanted=wanted, nodelay=nodelay)
        self._on_message = on_message
        self._on_refused = on_refused
        self._node = node
        self._own = own
        self._accepts = accepts
        self._connections: dict[str, PublisherConnection] = {}

    @property
    def publishers(self) -> int:
        """Connected publishers."""
        return sum(connection.connected for connection in self._connections.values())

    @property
    def callers(self) -> set[str]:
        """The names of the connected publishers, from their headers."""
        return {one.fields.get("callerid", "") for one in self._connections.values() if one.connected}

    def connections(self) -> list[BusConnection]:
        """The rows of all connections in ``getBusInfo`` and ``getBusStats``."""
        return [connection.connection() for connection in self._connections.values()]

    def update(self, uris: Iterable[str], *, keep: bool = False) -> None:
        """Apply the master's list of publishers: connect to the new ones, disconnect from the missing ones.

        Args:
            uris: The slave APIs of the listed publishers.
            keep: Disconnect from none, because the list of a restarted master is incomplete.
        """
        left_out = "" if self._own else self._node.uri
        listed = {uri for uri in uris if uri != left_out and (self._accepts is None or self._accepts(uri))}
        for uri, connection in tuple(self._connections.items()):
            if connection.refused is not None if uri in listed else not keep:
                self._connections.pop(uri).close()
        for uri in listed - self._connections.keys():
            self._connect(uri)

    def close(self) -> None:
        """Disconnect from all publishers."""
        self.update(())

    def _connect(self, uri: str) -> None:
        connection: PublisherConnection = self._connection(
            uri=uri,
            on_message=lambda framed: self._on_message(connection, framed),
            on_refused=lambda text: self._on_refused(connection, text),
            on_oversized=lambda size: self._oversized(connection, size),
            number=self._node.next_number(),
        )
        self._connections[uri] = connection
        connection.start()

    def _oversized(self, connection: PublisherConnection, size: int) -> None:
        if connection.oversized == 1:
            _log.warning(
                "! %s: a message of %d bytes of %s is left out: more than %d; shorter ones come [message-too-long]",
                self.topic,
                size,
                connection.uri,
                limits.TCPROS_MESSAGE_MAX,
            )
