"""The hub: the one ROS node of the web server, and what its clients share."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import logging
import os
import time
from typing import TYPE_CHECKING, Any, Self

from rmpa.core.errors import PeerRefused, RmpaError
from rmpa.web import limits
from rmpa.web.hub import requests
from rmpa.web.hub.graph import GraphWatch, TypeLibrary
from rmpa.web.hub.node_link import CONTROL_REMEDY, EVERYTHING, OWN_CLIENT, READ_REMEDY, HubClient, NodeLink
from rmpa.web.hub.publishers import ClientCounts, ParamMirror, Publishers, RosTime
from rmpa.web.hub.services import ServedServices, ServiceCalls, read_asset
from rmpa.web.hub.topics import HubTopics

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping
    from types import TracebackType

    from rmpa.ros.wire.xmlrpc import XmlRpcValue
    from rmpa.web.hub.node_link import Key, MakeNode, NodeRules, Receive, Rights, Where
    from rmpa.web.hub.requests import HubRequest

_log = logging.getLogger(__name__)


class Hub:
    """Serves the requests of all clients; an async context manager. The node is started with the first client.

    Args:
        where: Finds the master.
        make_node: Makes the node; it is made anew when the master was away or has shut it down.
        now_ns: The wall clock, in nanoseconds.
        environ: Where packages are searched for assets.
        rules: What the node may do.
    """

    def __init__(
        self,
        where: Where,
        make_node: MakeNode,
        *,
        now_ns: Callable[[], int] = time.time_ns,
        environ: Mapping[str, str] | None = None,
        rules: NodeRules = EVERYTHING,
    ) -> None:
        self._environ = os.environ if environ is None else environ
        self._now_ns = now_ns
        self._numbers = itertools.count(1)
        self._started = False
        self._clients: dict[int, HubClient] = {}
        self._tasks: dict[Key, asyncio.Task[None]] = {}
        self.link = NodeLink(where, make_node, self._param_updated, rules)
        self.params = ParamMirror(self.link)
        self.types = TypeLibrary(self.link)
        self.calls = ServiceCalls(self.link)
        self.served = ServedServices(self.link)
        self.graph = GraphWatch(
            self.link,
            self.calls.found,
            services_changed=self._services_changed,
            master_back=self.params.reload,
        )
        self.topics = HubTopics(
            self.link, self._learn, self._own_latched, lambda: self.graph.topics, self.types.at_hand, now_ns
        )
        self.graph.follow((OWN_CLIENT, 3), self.topics.graph_changed)
        self.publishers = Publishers(
            self.link,
            self.types.find_message,
            known=self.types.at_hand,
            deliver=self._published,
            ended=self.topics.forget_own,
            now_ns=now_ns,
        )
        self.time = RosTime(self.topics, self.params, (OWN_CLIENT, 1), now_ns)
        self.counts = ClientCounts(self.publishers, self.types, (OWN_CLIENT, 2), now_ns)
        self._handlers: Mapping[type[HubRequest], Callable[[HubClient, Any], None]] = {
            requests.Subscribe: self._subscribe,
            requests.Unsubscribe: self._unsubscribe,
            requests.AdvertiseTopic: self._advertise,
            requests.UnadvertiseTopic: self._unadvertise,
            requests.PublishMessage: self._publish,
            requests.CallService: self._call,
            requests.FindService: self._find_service,
            requests.FindServices: self._find_services,
            requests.CancelCall: self._cancel,
            requests.ServeService: self._serve,
            requests.EndService: self._end_service,
            requests.Respond: self._respond,
            requests.GetParams: self._get_params,
            requests.SetParam: self._set_param,
            requests.DeleteParam: self._delete_param,
            requests.FollowParams: self._follow_params,
            requests.UnfollowParams: lambda client, request: self.params.unfollow((client.number, request.handle)),
            requests.FollowGraph: self._follow_graph,
            requests.UnfollowGraph: lambda client, request: self.graph.unfollow((client.number, request.handle)),
            requests.DescribeType: self._describe,
            requests.FetchAsset: self._fetch_asset,
        }

    async def __aenter__(self) -> Self:
        return self

    def start(self) -> None:
        """Start the node, if it is not."""
        if not self._started:
            self._started = True
            self.link.start()
            self.graph.start()

    async def settled(self, timeout: float) -> bool:  # noqa: ASYNC109 - of a first client, who goes on without it
        """Start, and wait until the graph and the parameters are known, at most ``timeout`` seconds."""
        self.start()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                await self.graph.loaded.wait()
                await self.params.loaded.wait()
                return True
        return False

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for client in [*self._clients.values()]:
            self.disconnect(client)
        tasks = [*self._tasks.values()]
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
        await self.graph.close()
        await self.params.close()
        await self.types.close()
        await self.calls.close()
        await self.link.close()
        await self.topics.close()
        await self.publishers.close()
        await self.served.close()

    # --- clients ----------------------------------------------------------------------------------------------

    @property
    def clients(self) -> tuple[HubClient, ...]:
        """All clients."""
        return tuple(self._clients.values())

    def connect(
        self,
        name: str,
        rights: Rights,
        receive: Receive,
    ) -> HubClient:
        """Take a client.

        Args:
            name: For logs and lists.
            rights: What it may do.
            receive: Takes the answers, also within ``ask``; it must not raise.

        Raises:
            PeerRefused: There are too many.
        """
        if len(self._clients) >= limits.CLIENTS_MAX:
            problem = f"{len(self._clients)} clients are connected, which is the limit"
            raise PeerRefused("the web server", problem, "close some pages")
        client = HubClient(next(self._numbers), name, rights, receive)
        self._clients[client.number] = client
        self.start()
        self.graph.active = True
        self.graph.look()
        return client

    def disconnect(self, client: HubClient) -> None:
        """The client has gone: end all that it had. Its publishers stay for a while, as a page may be reloaded."""
        if self._clients.pop(client.number, None) is None:
            return
        for handle, topic in client.subscriptions.items():
            self.topics.unsubscribe((client.number, handle), topic)
        for handle, topic in client.publishers.items():
            self.publishers.unadvertise((client.number, handle), topic)
        for handle, service in client.services.items():
            self.served.end((client.number, handle), service)
        for key in [key for key in self._tasks if key[0] == client.number]:
            self._tasks[key].cancel()
        self.params.forget_client(client.number)
        self.graph.forget_client(client.number)
        self.types.forget_client(client.number)
        self.counts.remove(client.number)
        self.graph.active = bool(self._clients)

    def ask(self, client: HubClient, request: HubRequest) -> None:
        """Do what a client's session asks; what cannot be done is answered by ``Failed``."""
        if client.number not in self._clients:
            return
        try:
            self._handlers[type(request)](client, request)
        except RmpaError as error:
            _fail(client, request.handle, error)

    # --- topics -----------------------------------------------------------------------------------------------

    def _subscribe(self, client: HubClient, request: requests.Subscribe) -> None:
        subscribed = self.topics.names
        if len(subscribed) >= limits.SUBSCRIBED_TOPICS_MAX and request.topic not in subscribed:
            known = self.graph.topics.get(request.topic)
            if known is None or not known.publishers:
                problem = f"its clients subscribe to {len(subscribed)} topics, and {request.topic} has no publisher"
                raise PeerRefused("the web server", problem, "subscribe when it has one, or to fewer topics")
        client.subscriptions[request.handle] = request.topic
        self.topics.subscribe(
            (client.number, request.handle),
            request.topic,
            request.type,
            client.receive,
            functools.partial(_fail, client, request.handle),
            client.receive,
        )

    def _unsubscribe(self, client: HubClient, request: requests.Unsubscribe) -> None:
        topic = client.subscriptions.pop(request.handle, None)
        if topic is not None:
            self.topics.unsubscribe((client.number, request.handle), topic)

    def _advertise(self, client: HubClient, request: requests.AdvertiseTopic) -> None:
        _check(client.rights.control, "publish")

        def failed(error: RmpaError) -> None:
            client.publishers.pop(request.handle, None)
            _fail(client, request.handle, error)

        self.publishers.advertise(
            (client.number, request.handle), request.topic, request.type, failed, latch=request.latch
        )
        client.publishers[request.handle] = request.topic

    def _unadvertise(self, client: HubClient, request: requests.UnadvertiseTopic) -> None:
        topic = client.publishers.pop(request.handle, None)
        if topic is not None:
            self.publishers.unadvertise((client.number, request.handle), topic)

    def _publish(self, client: HubClient, request: requests.PublishMessage) -> None:
        topic = client.publishers.get(request.handle)
        if topic is not None:
            self.publishers.publish(topic, request.payload)

    def _published(self, topic: str, type_: str, payload: memoryview, latch: bool) -> None:
        self.topics.publish(topic, type_, payload, latch=latch)

    def _own_latched(self, topic: str) -> tuple[str, memoryview, int] | None:
        return self.publishers.latched(topic)

    def _learn(self, topic: str, header: Mapping[str, str]) -> None:
        self.types.learn(header)
        if header.get("type"):
            self.graph.saw_type(topic, header["type"])

    # --- services ---------------------------------------------------------------------------------------------

    def _call(self, client: HubClient, request: requests.CallService) -> None:
        _check(client.rights.control, "call services")
        md5sum = self.types.service(request.type).md5sum if request.type else ""

        async def call() -> None:
            try:
                body = await self.calls.call(request.service, md5sum, request.request, request.timeout)
            except RmpaError as error:
                client.receive(requests.ServiceResult(request.handle, ok=False, error=str(error)))
            else:
                client.receive(requests.ServiceResult(request.handle, ok=True, payload=body))

        self._run(client, request.handle, call())

    def _find_service(self, client: HubClient, request: requests.FindService) -> None:
        async def find() -> None:
            found = await self.calls.find(request.service)
            known = self.graph.services.get(request.service)
            if known is not None and known.type != found.type:
                self.graph.found_service()
            client.receive(requests.ServiceFound(request.handle, found.type, found.uri))

        self._run(client, request.handle, find())

    def _find_services(self, client: HubClient, request: requests.FindServices) -> None:
        async def find() -> None:
            unknown = [each.name for each in self.graph.services.values() if not each.type]
            searches = [asyncio.ensure_future(self.calls.find(name)) for name in unknown]
            if searches:
                _, pending = await asyncio.wait(searches, timeout=limits.FIND_ALL_TIMEOUT)
                for search in pending:
                    search.cancel()
                await asyncio.gather(*searches, return_exceptions=True)  # a server that does not tell stays unknown
                self.graph.found_service()
            client.receive(requests.ServiceFound(request.handle, ""))

        self._run(client, request.handle, find())

    def _cancel(self, client: HubClient, request: requests.CancelCall) -> None:
        task = self._tasks.get((client.number, request.handle))
        if task is not None:
            task.cancel()

    def _services_changed(self, names: Any) -> None:
        for name in names:
            self.calls.forget(name)

    def _serve(self, client: HubClient, request: requests.ServeService) -> None:
        _check(client.rights.control, "offer services")

        def failed(error: RmpaError) -> None:
            client.services.pop(request.handle, None)
            _fail(client, request.handle, error)

        def called(call: int, payload: bytes) -> None:
            client.receive(requests.ServiceRequest(request.handle, call, payload))

        kind = self.types.service(request.type)
        self.served.serve((client.number, request.handle), request.service, kind, called, failed)
        client.services[request.handle] = request.service

    def _end_service(self, client: HubClient, request: requests.EndService) -> None:
        service = client.services.pop(request.handle, None)
        if service is not None:
            self.served.end((client.number, request.handle), service)

    def _respond(self, client: HubClient, request: requests.Respond) -> None:
        service = client.services.get(request.handle)
        if service is not None:
            key = client.number, request.handle
            self.served.respond(key, service, request.call, ok=request.ok, response=request.response)

    # --- parameters -------------------------------------------------------------------------------------------

    def _param_updated(self, key: str, value: XmlRpcValue) -> None:
        self.params.updated(key, value)

    def _get_params(self, client: HubClient, request: requests.GetParams) -> None:
        _check(client.rights.view, "read parameters", READ_REMEDY)

        async def get() -> None:
            await self.params.loaded.wait()
            values = self.link.rules.visible(self.params.values(request.names, request.prefix))
            client.receive(requests.ParamsChanged(request.handle, values))

        self._run(client, request.handle, get())

    def _set_param(self, client: HubClient, request: requests.SetParam) -> None:
        _check(client.rights.control, "set parameters")

        async def set_() -> None:
            await self.params.set(request.name, request.value)
            client.receive(requests.ParamsChanged(request.handle, {request.name: request.value}))

        self._run(client, request.handle, set_())

    def _delete_param(self, client: HubClient, request: requests.DeleteParam) -> None:
        _check(client.rights.control, "delete parameters")

        async def delete() -> None:
            await self.params.delete(request.name)
            client.receive(requests.ParamsChanged(request.handle, {request.name: None}))

        self._run(client, request.handle, delete())

    def _follow_params(self, client: HubClient, request: requests.FollowParams) -> None:
        _check(client.rights.view, "read parameters", READ_REMEDY)

        def changed(values: Mapping[str, requests.ParamValue]) -> None:
            visible = self.link.rules.visible(values)
            if visible:
                client.receive(requests.ParamsChanged(request.handle, visible))

        self.params.follow((client.number, request.handle), request.names, changed)

    # --- the graph and types ----------------------------------------------------------------------------------

    def _follow_graph(self, client: HubClient, request: requests.FollowGraph) -> None:
        graph = self.graph

        def changed() -> None:
            topics, services = tuple(graph.topics.values()), tuple(graph.services.values())
            client.receive(requests.GraphChanged(request.handle, topics, services))

        graph.follow((client.number, request.handle), changed)

    def _describe(self, client: HubClient, request: requests.DescribeType) -> None:
        async def describe() -> None:
            if request.service:
                service = await self.types.find_service(request.type)
                text, response = service.request.definition, service.response.definition
                client.receive(requests.Described(request.handle, request.type, text, response))
                return

            def known(kind: Any) -> None:
                answer = requests.Described(request.handle, request.type, kind.definition, md5sum=kind.md5sum)
                client.receive(answer)

            if request.md5sum:
                version = self.types.seen_version(request.type, request.md5sum)
                if version is None:
                    raise RmpaError(f"no publisher has told the version {request.md5sum} of {request.type}")
                known(version)
                return
            try:
                known(await self.types.find_message(request.type))
            except RmpaError:
                self.types.want((client.number, request.handle), request.type, known)
                raise

        self._run(client, request.handle, describe())

    def _fetch_asset(self, client: HubClient, request: requests.FetchAsset) -> None:
        _check(client.rights.view, "fetch assets", READ_REMEDY)

        async def fetch() -> None:
            data = await asyncio.to_thread(read_asset, request.uri, request.most, self._environ)
            client.receive(requests.AssetFetched(request.handle, data))

        self._run(client, request.handle, fetch())

    # --- inside -----------------------------------------------------------------------------------------------

    def _run(self, client: HubClient, handle: int, work: Coroutine[Any, Any, None]) -> None:
        """Do what takes time, in a task; its error is answered by ``Failed``."""
        key = client.number, handle

        async def run() -> None:
            try:
                await work
            except RmpaError as error:
                _fail(client, handle, error)
            except Exception:  # noqa: BLE001 - a task's top
                _log.exception("! a request of %s failed", client.name)
                _fail(client, handle, RmpaError("the web server failed; its log says why"))

        task = self._tasks[key] = asyncio.get_running_loop().create_task(run(), name=f"request of {client.name}")

        def ended(task: asyncio.Task[None]) -> None:
            work.close()  # of a client that has gone before it began
            if self._tasks.get(key) is task:
                del self._tasks[key]

        task.add_done_callback(ended)


def _check(right: bool, what: str, remedy: str = CONTROL_REMEDY) -> None:
    if not right:
        raise PeerRefused("the web server", f"this client may not {what}", remedy)


def _fail(client: HubClient, handle: int, error: RmpaError) -> None:
    client.receive(requests.Failed.of(handle, error))
