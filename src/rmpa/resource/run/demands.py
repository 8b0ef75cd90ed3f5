"""The requirements of a resource on other resources: requests, answers, and reports of the observed quality."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import logging
from typing import TYPE_CHECKING, Any

from rmpa.core.errors import RmpaError
from rmpa.resource.run.client import ResourceClient
from rmpa.resource.run.descriptor import TOPIC, Descriptor
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.definitions import DiagnosticLevel
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.connections import Demand
    from rmpa.resource.run.runtime import Runtime
    from rmpa.ros.node.endpoints import Received

_log = logging.getLogger(__name__)


class Demands(RuntimePart):
    """All requirements of one resource on other resources.

    Args:
        runtime: The runtime of the resource that has the requirements.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._clients: dict[str, ResourceClient] = {}
        self._first: dict[str, str] = {}
        """Name of the first output of each resource whose descriptor has been received, by resource."""
        self._undo = contextlib.AsyncExitStack()

    async def start(self) -> None:
        """Send the requests."""
        async with contextlib.AsyncExitStack() as undo:
            for demand in self._runtime.resource.demands.values():
                client = await undo.enter_async_context(ResourceClient(self._runtime.node, demand.resource))
                self._clients[demand.resource] = client
                demand.on_change = functools.partial(self._runtime.call_in_loop, self._request)
                undo.callback(setattr, demand, "on_change", None)
                following = asyncio.get_running_loop().create_task(
                    self._follow(demand, client), name=f"follow {demand.resource}"
                )
                undo.push_async_callback(_ended, following)
                if demand.requests:
                    self._request(demand)
                if any(name.startswith(f"{demand.resource}/") for name in self._runtime.resource.inputs):
                    await self._observe(demand.resource, client)
            self._undo = undo.pop_all()

    async def close(self) -> None:
        """Release all requirements."""
        await self._undo.aclose()
        self._clients.clear()

    def problems(self) -> tuple[list[str], list[str]]:
        """Problems as texts: resources that are not connected, and resources that miss the requirement."""
        missing, short = [], []
        for name, client in self._clients.items():
            demand = self._runtime.resource.demands[name]
            if not demand.requests:
                continue
            if not client.connected:
                missing.append(f"there is no resource {name}")
            elif client.answer is not None and client.answer.level is not DiagnosticLevel.OK:
                short.append(f"{name}: {printable(client.answer.message)}")
        return missing, short

    def window_ended(self, level: DiagnosticLevel, message: str, measured: Mapping[str, Value]) -> None:  # noqa: ARG002
        """Report the measured values of inputs to the resources that send them, for the requested attributes."""
        resource = self._runtime.resource
        labels = resource.labels
        for name, client in self._clients.items():
            found: dict[str, Any] = {}
            for request in resource.demands[name].requests if name in self._first else ():
                output, _, attribute = request.replace("__", ".").rpartition(".")
                item = f"{name}/{output or self._first[name]}"
                value = measured.get(f"{labels[item]}.{attribute}") if item in resource.inputs else None
                if value is not None:
                    found[request] = value
            if found and client.connected:
                client.report(**found)

    # --- inside -------------------------------------------------------------------------------------------------

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
                outputs = Descriptor.parse(str(received.message.data)).outputs
            except RmpaError as error:
                _log.warning("! %s: %s: %s", self._runtime.node.name, name, error)
            else:
                self._first[name] = outputs[0].name if outputs else ""

        await client.observe()
        await self._runtime.node.subscribe(f"{name}/{TOPIC}", MessageType("std_msgs/String"), descriptor_received)

    async def _follow(self, demand: Demand, client: ResourceClient) -> None:
        last: tuple[DiagnosticLevel, str] | None = None
        async for answer in client.answers():
            demand.answer = answer
            if last != (last := (answer.level, answer.message)):
                level = logging.INFO if answer.level is DiagnosticLevel.OK else logging.WARNING
                mark = "=" if answer.level is DiagnosticLevel.OK else "!"
                name = self._runtime.node.name
                _log.log(level, "%s %s: %s says: %s", mark, name, demand.resource, printable(answer.message))


async def _ended(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.wait([task])
