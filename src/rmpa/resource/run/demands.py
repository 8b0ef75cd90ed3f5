"""Carries what a resource asks of others, and hears what they say to it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any

from rmpa.core.errors import RmpaError
from rmpa.resource.run.client import ResourceClient
from rmpa.resource.run.descriptor import TOPIC, Descriptor
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.types.diagnostic_array import DiagnosticLevel
from rmpa.ros.types.messages import MessageType
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.resource.declare.attributes import Value
    from rmpa.resource.declare.resource import Demand
    from rmpa.resource.run.runtime import Runtime
    from rmpa.ros.node.topics import Received, Subscriber

_log = logging.getLogger(__name__)


class Demands(RuntimePart):
    """All that one resource asks.

    Args:
        runtime: Of the resource.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._clients: dict[str, ResourceClient] = {}
        self._first: dict[str, str] = {}
        """By resource that something is heard from: its first output."""
        self._undo = contextlib.AsyncExitStack()
        self.listening: dict[str, Subscriber] = {}
        """By topic: the descriptors that are listened to here."""
        self.on_descriptor: list[Callable[[str, Received], None]] = []
        """Called with what such a resource says: its name, and the message."""

    async def start(self) -> None:
        """Ask."""
        async with contextlib.AsyncExitStack() as undo:
            for demand in self._runtime.resource.demands.values():
                client = await undo.enter_async_context(ResourceClient(self._runtime.node, demand.resource))
                self._clients[demand.resource] = client
                demand.asker = self
                undo.callback(setattr, demand, "asker", None)
                following = asyncio.get_running_loop().create_task(
                    self._follow(demand, client), name=f"follow {demand.resource}"
                )
                undo.push_async_callback(_ended, following)
                if demand.wishes:
                    self._ask(demand)
                if any(name.startswith(f"{demand.resource}/") for name in self._runtime.resource.inputs):
                    await self._watch(demand.resource, client)
            self._undo = undo.pop_all()

    async def close(self) -> None:
        """Ask for nothing any more."""
        await self._undo.aclose()
        self._clients.clear()

    def asked(self, demand: Demand) -> None:
        """It asks for something else; called in any thread."""
        self._runtime.call_in_loop(self._ask, demand)

    def troubles(self) -> tuple[list[str], list[str]]:
        """Who is not there, and who does not give what was asked; each ready to read."""
        missing, short = [], []
        for name, client in self._clients.items():
            demand = self._runtime.resource.demands[name]
            if not demand.wishes:
                continue
            if not client.there:
                missing.append(f"there is no resource {name}")
            elif client.answer is not None and client.answer.level is not DiagnosticLevel.OK:
                short.append(f"{name}: {printable(client.answer.message)}")
        return missing, short

    def window(self, _level: DiagnosticLevel, _message: str, measured: Mapping[str, Value]) -> None:
        """Tell those that are asked what arrives here of what they send, as far as it is asked for."""
        resource = self._runtime.resource
        labels = resource.labels
        for name, client in self._clients.items():
            found: dict[str, Any] = {}
            for wish in resource.demands[name].wishes if name in self._first else ():
                output, _, attribute = wish.replace("__", ".").rpartition(".")
                item = f"{name}/{output or self._first[name]}"
                value = measured.get(f"{labels[item]}.{attribute}") if item in resource.inputs else None
                if value is not None:
                    found[wish] = value
            if found and client.there:
                client.report(**found)

    # --- inside -------------------------------------------------------------------------------------------------

    def _ask(self, demand: Demand) -> None:
        client = self._clients.get(demand.resource)
        if client is not None:
            demand.answer = None
            wishes: dict[str, Any] = dict(demand.wishes)
            client.ask(priority=demand.priority if wishes else 0, **wishes)
            self._runtime.describe_again()

    async def _watch(self, name: str, client: ResourceClient) -> None:
        """Learn which of its outputs is the first: ``rate`` alone is that one's."""

        def heard(received: Received) -> None:
            for hear in self.on_descriptor:
                hear(name, received)
            try:
                outputs = Descriptor.parse(str(received.message.data)).outputs
            except RmpaError as error:
                _log.warning("! %s: %s: %s", self._runtime.node.name, name, error)
            else:
                self._first[name] = outputs[0].name if outputs else ""

        await client.observe()
        topic = f"{name}/{TOPIC}"
        self.listening[topic] = await self._runtime.node.subscribe(topic, MessageType("std_msgs/String"), heard)

    async def _follow(self, demand: Demand, client: ResourceClient) -> None:
        said: tuple[DiagnosticLevel, str] | None = None
        async for answer in client.answers():
            demand.answer = answer
            if said != (said := (answer.level, answer.message)):
                level = logging.INFO if answer.level is DiagnosticLevel.OK else logging.WARNING
                mark = "=" if answer.level is DiagnosticLevel.OK else "!"
                name = self._runtime.node.name
                _log.log(level, "%s %s: %s says: %s", mark, name, demand.resource, printable(answer.message))


async def _ended(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.wait([task])
