"""The hub: the one ROS node of the web server, what its clients share, and what each of them may ask of it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import time
import weakref
from typing import TYPE_CHECKING, Any, Final, Self, TypeAlias, TypeVar

from rmpa.config.peer_rules import Access
from rmpa.core.contract import Contracts, Priority
from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.ros.types.codec import codec_for
from rmpa.runtime.tasks import OwnedTasks
from rmpa.web import limits
from rmpa.web.hub.frame_writer import OutFrame, size_of
from rmpa.web.hub.graph import GraphWatch, TypeLibrary
from rmpa.web.hub.node_link import CONTROL_REMEDY, EVERYTHING, READ_REMEDY, NodeLink
from rmpa.web.hub.params import ParamMirror, RosTime, ros_time, value_at
from rmpa.web.hub.services import ServedService, ServiceCalls, read_asset
from rmpa.web.hub.topics import ClientPublication, ClientSubscription, HubTopics, MadeOnce, ReceivedMessage
from rmpa.web.hub.transforms import TransformTree

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping
    from types import TracebackType

    from rmpa.web.hub.node_link import Follower, MakeNode, NodeRules, ParamValue, Payload, Rights, Where

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
_Closable: TypeAlias = "ClientSubscription | ClientPublication | ServedService | Follower"
_WHO: Final = "the web server"
_COUNT: Final = "/client_count"
_CLIENTS: Final = "/connected_clients"
_TYPES: Final = {_COUNT: "std_msgs/Int32", _CLIENTS: "rosbridge_msgs/ConnectedClients"}
_PRIORITIES: Final = {Priority.HIGH: 1, Priority.NORMAL: 0, Priority.LOW: -1}


class Hub:
    """What all clients share; an async context manager. The node is started with the first client.

    Args:
        where: Finds the master.
        make_node: Makes the node; it is made anew when the master was away or has shut it down.
        rules: What the node may do.
        contracts: Of topics.
    """

    # More than 12 fields: the parts, each once.
    def __init__(
        self,
        where: Where,
        make_node: MakeNode,
        *,
        rules: NodeRules = EVERYTHING,
        contracts: Contracts | None = None,
    ) -> None:
        self._contracts = contracts
        self._started = False
        self._clients: dict[HubClient, None] = {}
        self.link = NodeLink(where, make_node, rules)
        self.params = ParamMirror(self.link)
        self.types = TypeLibrary(self.link)
        self.calls = ServiceCalls(self.link)
        self.served: dict[str, ServedService] = {}
        self.graph = GraphWatch(self.link, self.calls, self.params.reload)
        self.topics = HubTopics(self.link, self.types, self.graph)
        self.time = RosTime(self.topics, self.params)
        self.counts = ClientCounts(self)
        # What rosbridge's clients are sent.
        self.frames: MadeOnce[OutFrame] = MadeOnce(limits.FRAMES_KEPT_BYTES, size_of)
        self._values: MadeOnce[Any] = MadeOnce(limits.VALUES_KEPT_BYTES)
        self.transforms = TransformTree(self.topics, self.types)

    async def __aenter__(self) -> Self:
        return self

    def start(self) -> None:
        """Start the node, if it is not."""
        if not self._started:
            self._started = True
            self.link.start()
            self.graph.start()

    async def settled(self, timeout: float) -> None:  # noqa: ASYNC109 - of a first client, who goes on without it
        """Start, and wait until the graph and the parameters are known, at most ``timeout`` seconds."""
        self.start()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self.graph.loaded.wait()
                await self.params.loaded.wait()

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        tasks = [task for client in self._clients for task in client.tasks]
        for client in self.clients:
            self.disconnect(client)
        if tasks:
            await asyncio.wait(tasks)
        for part in (self.graph, self.params, self.types, self.calls, self.link):
            await part.close()
        self.topics.close()
        for served in [*self.served.values()]:
            served.close()
        await self.link.withdrawn()

    def values(self, message: ReceivedMessage) -> Any:
        """The values of a message, which all share: a map of 16 million cells is no list, but a view.

        Raises:
            RmpaError: Its type is not known, or its bytes are not a message of that type.
        """

        def make() -> Any:
            return self.types.codec(message.type, message.md5sum).views(message.payload)

        return self._values.get(message.payload, make)

    def priority(self, topic: str) -> int:
        """The priority of a topic's messages, by its contract: higher ones go first."""
        if self._contracts is None:
            return 0
        known = self.graph.topics.get(topic)
        type_ = known.types[0] if known is not None and known.types else ""
        return _PRIORITIES[self._contracts.of(topic, type_).priority]

    @property
    def clients(self) -> tuple[HubClient, ...]:
        """All clients."""
        return tuple(self._clients)

    def connect(self, client: HubClient) -> None:
        """Take a client.

        Raises:
            PeerRefused: There are too many.
        """
        if len(self._clients) >= limits.CLIENTS_MAX:
            problem = f"{len(self._clients)} clients are connected, which is the limit"
            raise PeerRefused(_WHO, problem, "close some pages")
        self._clients[client] = None
        self.start()
        self.graph.active = True
        self.graph.look()

    def disconnect(self, client: HubClient) -> None:
        """The client has gone: end all that it had. Its publishers stay for a while, as a page may be reloaded."""
        if client in self._clients:
            del self._clients[client]
            client.end_all()
            self.counts.remove(client)
            self.graph.active = bool(self._clients)


class HubClient:
    """One client, from ``Hub.connect`` to ``Hub.disconnect``: what it asks for, as far as it may.

    All methods raise ``PeerRefused`` for what it may not. What they return is open until it is closed, or the client
    has gone.

    Args:
        hub: The hub.
        name: For logs and lists.
        rights: What it may do.
    """

    def __init__(self, hub: Hub, name: str, rights: Rights) -> None:
        self.hub = hub
        self.name = name
        self.rights = rights
        self.tasks = OwnedTasks()
        self._open: weakref.WeakSet[_Closable] = weakref.WeakSet()

    def late(self) -> str:
        """Why a command that comes now may be too old; empty: it is not."""
        return ""

    def show_late(self, text: str) -> None:
        """Tell the client that what it publishes comes too late."""

    def subscribe(
        self,
        topic: str,
        type_: str | None,
        receive: Callable[[ReceivedMessage], None],
        failed: Callable[[RmpaError], None],
        differs: Callable[[str], None] = lambda _: None,
    ) -> ClientSubscription:
        """Subscribe to a topic; see ``HubTopics.subscribe``."""
        subscribed = self.hub.topics.subscribed
        if len(subscribed) >= limits.SUBSCRIBED_TOPICS_MAX and topic not in subscribed:
            known = self.hub.graph.topics.get(topic)
            if known is None or not known.publishers:
                problem = f"its clients subscribe to {len(subscribed)} topics, and {topic} has no publisher"
                raise PeerRefused(_WHO, problem, "subscribe when it has one, or to fewer topics")
        made = self.hub.topics.subscribe(topic, type_, receive, failed, differs)
        self._open.add(made)
        return made

    def advertise(
        self, topic: str, type_: str, failed: Callable[[RmpaError], None], *, latch: bool = False
    ) -> ClientPublication:
        """Publish a topic; see ``HubTopics.advertise``."""
        self.check_control("publish")
        made = self.hub.topics.advertise(topic, type_, failed, latch=latch, accepts=self._accepts)
        self._open.add(made)
        return made

    def _accepts(self, topic: str) -> bool:
        if text := self.late():
            self.show_late(f"what was published on {topic}: {text}")
        return not text

    def call(
        self, service: str, type_: str, request: Payload, timeout: float | None = None
    ) -> Coroutine[Any, Any, Payload]:
        """Call a service; see ``ServiceCalls.call``. With an empty ``type_`` it may have any."""
        self.check_command("call services")
        md5sum = self.hub.types.service(type_).md5sum if type_ else ""
        return self.hub.calls.call(service, md5sum, request, timeout)

    def find_service(self, service: str) -> Coroutine[Any, Any, str]:
        """The type of a service that is to be called; see ``GraphWatch.find``."""
        self.check_command("call services")
        self.hub.link.rules.check(Access.CALL, service)
        return self.hub.graph.find(service)

    def serve(
        self,
        service: str,
        type_: str,
        called: Callable[[bytes, asyncio.Future[Payload]], None],
        failed: Callable[[RmpaError], None],
    ) -> ServedService:
        """Offer a service; see ``ServedService``."""
        self.check_control("offer services")
        hub = self.hub
        made = ServedService(hub.link, hub.served, service, hub.types.service(type_), called, failed)
        self._open.add(made)
        return made

    @property
    def param_tree(self) -> Mapping[str, ParamValue]:
        """The parameters that the client may see, as a tree."""
        self._check_view("read parameters")
        return self.hub.link.rules.visible_tree(self.hub.params.tree)

    def read_param(self, name: str) -> object:
        """The value of a global name, a namespace as a whole; ``MISSING`` where there is none.

        What the rules deny is refused, also one parameter in a namespace: it never counts as not there.
        """
        self._check_view("read parameters")
        value = value_at(self.hub.params.tree, name)
        self.hub.link.rules.check_param(name, value)
        return value

    async def get_params(self, names: tuple[str, ...] = ()) -> Mapping[str, ParamValue]:
        """The values of ``names`` that are there; without names those of all parameters."""
        self._check_view("read parameters")
        await self.hub.params.loaded.wait()
        return self.hub.link.rules.visible(self.hub.params.values(names))

    def set_param(self, name: str, value: ParamValue) -> Coroutine[Any, Any, None]:
        """Set a parameter; see ``ParamMirror.set``."""
        self.check_command("set parameters")
        return self.hub.params.set(name, value)

    def delete_param(self, name: str) -> Coroutine[Any, Any, None]:
        """Delete a parameter, with all below it; see ``ParamMirror.delete``."""
        self.check_command("delete parameters")
        return self.hub.params.delete(name)

    def follow_params(self, names: tuple[str, ...], changed: Callable[[Mapping[str, ParamValue]], None]) -> Follower:
        """Call ``changed`` at each change of ``names``, or of all; ``None`` is a parameter that was deleted."""
        self._check_view("read parameters")

        def visible(values: Mapping[str, ParamValue]) -> None:
            if shown := self.hub.link.rules.visible(values):
                changed(shown)

        made = self.hub.params.follow(names, visible)
        self._open.add(made)
        return made

    async def fetch_asset(self, uri: str, most: int) -> bytes:
        """A file of a ROS package; see ``read_asset``."""
        self._check_view("fetch assets")
        return await asyncio.to_thread(read_asset, uri, most, os.environ)

    def run(
        self, work: Coroutine[Any, Any, _T], done: Callable[[_T], None], failed: Callable[[RmpaError], None]
    ) -> None:
        """Do what takes time, while the client is there; then call ``done`` with its result, or ``failed``."""

        async def run() -> None:
            try:
                try:
                    done(await work)
                except RmpaError as error:
                    failed(error)
            except Exception:
                failed(RmpaError("the web server failed; its log says why"))
                raise

        task = self.tasks.start(run(), f"request of {self.name}")
        task.add_done_callback(lambda _: work.close())  # of a client that has gone before it began

    def end_all(self) -> None:
        """Close what is open, and give up what is under way."""
        self.tasks.cancel()
        for each in [*self._open]:
            each.close()

    def _check_view(self, what: str) -> None:
        if not self.rights.view:
            raise PeerRefused(_WHO, f"this client may not {what}", READ_REMEDY, code="not-permitted")

    def check_control(self, what: str) -> None:
        """Refuse what changes something to a client that may only look."""
        if not self.rights.control:
            raise PeerRefused(_WHO, f"this client may not {what}", CONTROL_REMEDY, code="not-permitted")

    def check_command(self, what: str) -> None:
        """Refuse also what may be too old."""
        self.check_control(what)
        if text := self.late():
            raise RmpaError(f"{text}; send it again; command_age_ms of [web] sets the bound")


class ClientCounts:
    """rosbridge_suite's counts: the number and the list of rosbridge clients, latched, from the first client on.

    Args:
        hub: Publishes them.
    """

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self._clients: dict[HubClient, dict[str, Any]] = {}
        self._publications: list[ClientPublication] | None = None

    def add(self, client: HubClient, address: str) -> None:
        """A client is there."""
        self._clients[client] = {"ip_address": address, "connection_time": ros_time(time.time_ns())}
        self._publish()

    def remove(self, client: HubClient) -> None:
        """A client has gone."""
        if self._clients.pop(client, None) is not None:
            self._publish()

    def _publish(self) -> None:
        if self._publications is None:
            self._publications = []
            for topic, type_ in _TYPES.items():
                with contextlib.suppress(PeerRefused):  # a client publishes that topic with another type
                    made = self._hub.topics.advertise(topic, type_, self._refused, latch=True)
                    self._publications.append(made)
        clients = [*self._clients.values()]
        values = {_COUNT: {"data": len(clients)}, _CLIENTS: {"clients": clients}}
        for each in self._publications:
            codec = codec_for(self._hub.types.message(_TYPES[each.topic]))
            each.publish(codec.write(values[each.topic], 0).payload)

    @staticmethod
    def _refused(error: RmpaError) -> None:
        _log.warning("! %s [%s]", error, error.code)
