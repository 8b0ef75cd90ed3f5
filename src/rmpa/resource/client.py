"""A client of a resource in this or another module: requests a quality and receives the answers.

::

    async with Node("driver") as node, ResourceClient(node, "sonar") as sonar:
        answer = await sonar.require(rate=at_least("20 Hz", hard=True), noise=at_most("5 cm"))
        print(answer.level.name, answer.message)
        async for answer in sonar.answers():
            ...

A resource that has requirements on others is such a client too (``Demands``).
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
import secrets
import time
from typing import TYPE_CHECKING, Any, Self

from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.resource.quality import EXPIRES, PRIORITY, QoSRequest, RequirementAnswer, Value
from rmpa.resource.runtime import Runtime, RuntimePart, topic_of
from rmpa.ros.types.definitions import ARRAY_TYPE, DiagnosticLevel
from rmpa.ros.types.descriptor import TOPIC, Descriptor
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import printable
from rmpa.runtime.tasks import keep_task, start_task

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping

    from rmpa.resource.declare import Demand
    from rmpa.ros.node.endpoints import Publisher, Received, Subscriber
    from rmpa.ros.node.node import Node

_log = logging.getLogger(__name__)


class ResourceClient:
    """One client of one resource; leaving the context (``async with``) releases its requirement.

    Args:
        node: A registered node; it may have one client for each resource.
        resource: Name of the resource's node in this module's graph: ``sonar``, ``/robot1/sonar``.
    """

    def __init__(self, node: Node, resource: str) -> None:
        self._node = node
        self.resource = resource if resource.startswith("/") else f"/{resource}"
        # The last answer to the present request; ``None`` until it arrives.
        self.answer: RequirementAnswer | None = None
        self._requirements: Publisher | None = None
        self._observed: Publisher | None = None
        self._responses: Subscriber | None = None
        self._mark = "none yet"
        self._version = 0
        self._change = asyncio.Event()

    async def __aenter__(self) -> Self:
        """Subscribe to the resource's responses and advertise the requests.

        Raises:
            UnreachableError: The master does not answer.
        """
        kind = MessageType(ARRAY_TYPE)
        try:
            self._responses = await self._node.subscribe(f"{self.resource}/responses", kind, self._response_received)
            self._requirements = await self._node.advertise(f"{self.resource}/requirements", kind, latch=True)
        except BaseException:
            await self.__aexit__()
            raise
        return self

    async def __aexit__(self, *_error: object) -> None:
        for topic in (self._requirements, self._observed, self._responses):
            if topic is not None:
                await topic.close()

    async def require(
        self,
        *,
        priority: int = 0,
        expires: str = "",
        timeout: float = 10.0,  # noqa: ASYNC109 - the message names it; a route may have to be opened first
        **requests: QoSRequest,
    ) -> RequirementAnswer:
        """Request a quality, in place of the previous request, and wait for the answer.

        Args:
            priority: In a conflict between clients the higher priority wins.
            expires: How long the request holds, such as ``"60 s"``; empty: until this client ends.
            timeout: Seconds to wait for the answer.
            requests: By attribute; a qualified one (``ranges.rate``) is written ``ranges__rate``.

        Raises:
            PeerRefused: The request is invalid; the previous one stays in force.
            UnreachableError: No resource of this name has answered in time.
        """
        self.ask(priority=priority, expires=expires, **requests)
        try:
            async with asyncio.timeout(timeout):
                while self.answer is None:
                    self._change.clear()
                    await self._change.wait()
        except TimeoutError:
            remedy = "`rmpa resource list` shows which there are"
            raise UnreachableError("resource", f"{self.resource} ({timeout:g} s)", remedy) from None
        if self.answer.level is DiagnosticLevel.ERROR and "non-adaptable" not in self.answer.message:
            raise PeerRefused(f"resource {self.resource}", self.answer.message)
        return self.answer

    def ask(self, *, priority: int = 0, expires: str = "", **requests: QoSRequest) -> None:
        """Request a quality as ``require`` does, without waiting for the answer; ``answers`` yields it."""
        values = {name.replace("__", "."): str(request) for name, request in requests.items()}
        if priority:
            values[PRIORITY] = str(priority)
        if expires:
            values[EXPIRES] = expires
        if self._requirements is None:
            raise UnreachableError("resource", self.resource, "enter the client first: async with ResourceClient(…)")
        self._mark = secrets.token_hex(8)
        self.answer = None
        # The stamp identifies a latched request that arrives again, so that its expiry does not start again.
        self._publish(self._requirements, values, self._mark)

    @property
    def connected(self) -> bool:
        """Whether the resource publishes responses to this client's node."""
        return self._responses is not None and self._responses.publishers > 0

    async def observe(self, **values: float | str) -> None:
        """Report the quality that this client observes: ``await sonar.observe(rate="12 Hz")``, periodically.

        The resource measures the messages that it sends; fewer may arrive here, and it has to adapt to that. A report
        counts for three of the resource's quality windows, provided that this client has a requirement.

        Args:
            values: By attribute, as in ``require``; a number is in the attribute's unit.

        Raises:
            UnreachableError: The master does not answer.
        """
        if self._observed is None:
            self._observed = await self._node.advertise(f"{self.resource}/observed", MessageType(ARRAY_TYPE))
        if values:
            self.report(**values)

    def report(self, **values: float | str) -> None:
        """Report as ``observe`` does, without waiting; ``observe`` must have been called once.

        Raises:
            UnreachableError: ``observe`` has not been called.
        """
        if self._observed is None:
            raise UnreachableError("resource", self.resource, "await observe() once before")
        self._publish(self._observed, {key.replace("__", "."): str(value) for key, value in values.items()})

    def release(self) -> None:
        """Release the requirement."""
        self.ask()

    async def answers(self) -> AsyncIterator[RequirementAnswer]:
        """The present answer, if there is one, and each change from now on, until the node is closed."""
        seen = 0
        stopped = start_task(self._node.stopped.wait(), f"answers of {self.resource}")
        stopped.add_done_callback(lambda _: self._change.set())
        try:
            while True:
                while self._version == seen:
                    if self._node.stopped.is_set():
                        return
                    self._change.clear()
                    await self._change.wait()
                seen = self._version
                if self.answer is not None:
                    yield self.answer
        finally:
            stopped.cancel()

    def _publish(self, publisher: Publisher, values: Mapping[str, str], mark: str = "") -> None:
        pairs: Any = [{"key": key, "value": value} for key, value in values.items()]
        status: Any = [{"name": self._node.name, "hardware_id": mark, "values": pairs}]
        publisher.publish(header={"stamp": time.time()}, status=status)

    def _response_received(self, received: Received) -> None:
        for status in received.message.status:
            # In the resource's graph this client may have its proxy's name, so the unique mark identifies it.
            if status.hardware_id == self._mark:
                values = {str(pair.key): str(pair.value) for pair in status.values}
                answer = RequirementAnswer(DiagnosticLevel(int(status.level)), str(status.message), values)
                if answer != self.answer:
                    self.answer = answer
                    self._version += 1
                    self._change.set()


class Demands(RuntimePart):
    """All requirements of one resource on others: requests, answers, and reports of the observed quality.

    Args:
        runtime: The runtime of the resource that has the requirements.
    """

    def __init__(self, runtime: Runtime) -> None:
        super().__init__(runtime)
        self._clients: dict[str, ResourceClient] = {}
        # The topics of each resource whose descriptor has been received, in this graph: by the prefix that the
        # attributes of the output have; without one by an empty text.
        self._topics: dict[str, dict[str, str]] = {}
        self._undo = contextlib.AsyncExitStack()

    async def start(self) -> None:
        """Send the requests; one that fails leaves nothing behind."""
        try:
            for demand in self._runtime.resource.demands.values():
                client = await self._undo.enter_async_context(ResourceClient(self._runtime.node, demand.resource))
                self._clients[demand.resource] = client
                self._runtime.bind(demand, "on_change", self._request)
                follow = functools.partial(self._follow, demand, client)
                self._work.add(keep_task(follow, f"follow {demand.resource}"))
                if demand.requests:
                    self._request(demand)
                if self._runtime.resource.inputs:
                    await self._observe(demand.resource, client)
        except BaseException:
            await self.close()
            raise

    async def close(self) -> None:
        """Release all requirements."""
        await super().close()
        await self._undo.aclose()
        self._clients.clear()

    def problems(self) -> tuple[list[str], list[str]]:
        """Problems as texts: resources that are not connected, and resources that miss the requirement."""
        missing, short = [], []
        for name, client in self._clients.items():
            if not self._runtime.resource.demands[name].requests:
                continue
            if not client.connected:
                missing.append(f"there is no resource {name}")
            elif client.answer is not None and client.answer.level is not DiagnosticLevel.OK:
                short.append(f"{name}: {printable(client.answer.message)}")
        return missing, short

    def window_ended(self, measured: Mapping[str, Value]) -> None:
        """Report the measured values of inputs to the resources that send them, for the requested attributes."""
        resource, labels = self._runtime.resource, self._runtime.resource.labels
        inputs = {topic_of(name, self._runtime.node.name): labels[name] for name in resource.inputs}
        for name, client in self._clients.items():
            found: dict[str, Any] = {}
            topics = self._topics.get(name, {})
            for request in resource.demands[name].requests if topics else ():
                output, _, attribute = request.replace("__", ".").rpartition(".")
                value = measured.get(f"{inputs.get(topics.get(output, ''), '')}.{attribute}")
                if value is not None:
                    found[request] = value
            if found and client.connected:
                client.report(**found)

    def _request(self, demand: Demand) -> None:
        client = self._clients.get(demand.resource)
        if client is not None:
            demand.answer = None
            requests: dict[str, Any] = dict(demand.requests)
            client.ask(priority=demand.priority if requests else 0, **requests)
            self._runtime.publish_descriptor()

    async def _observe(self, name: str, client: ResourceClient) -> None:
        """Begin to report observations to a resource.

        A request without an output's name, such as ``rate``, refers to the resource's first output. The resource's
        descriptor says which output that is.
        """

        def descriptor_received(received: Received) -> None:
            try:
                said = Descriptor.parse(str(received.message.data))
            except RmpaError as error:
                _log.warning("! %s: %s: %s [resource-trouble]", self._runtime.node.name, name, error)
                return
            prefix = name.removesuffix(said.node)  # of what that module offers here
            topics = {one.label or one.name: f"{prefix}{one.topic}" for one in said.outputs}
            self._topics[name] = {"": next(iter(topics.values()), ""), **topics}

        await client.observe()
        await self._runtime.node.subscribe(f"{name}/{TOPIC}", MessageType("std_msgs/String"), descriptor_received)

    async def _follow(self, demand: Demand, client: ResourceClient) -> None:
        last: tuple[DiagnosticLevel, str] | None = None
        async for answer in client.answers():
            demand.answer = answer
            if last != (last := (answer.level, answer.message)):
                texts = self._runtime.node.name, demand.resource, printable(answer.message)
                if answer.level is DiagnosticLevel.OK:
                    _log.info("= %s: %s says: %s", *texts)
                else:
                    _log.warning("! %s: %s says: %s [resource-trouble]", *texts)
