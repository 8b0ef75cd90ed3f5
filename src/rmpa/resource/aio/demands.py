"""Carries what a resource asks of others, and hears what they say to it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any

from rmpa.resource.aio.client import ResourceClient
from rmpa.resource.aio.runtime import RuntimePart
from rmpa.ros.diagnostic_array import Level
from rmpa.ros.tcpros import printable

if TYPE_CHECKING:
    from rmpa.resource.aio.runtime import Runtime
    from rmpa.resource.declare import Demand

_log = logging.getLogger(__name__)


class Demands(RuntimePart):
    """All that one resource asks.

    Args:
        runtime: Of the resource.
    """

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self._clients: dict[str, ResourceClient] = {}
        self._undo = contextlib.AsyncExitStack()

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
            elif client.answer is not None and client.answer.level is not Level.OK:
                short.append(f"{name}: {printable(client.answer.message)}")
        return missing, short

    # --- inside -------------------------------------------------------------------------------------------------

    def _ask(self, demand: Demand) -> None:
        client = self._clients.get(demand.resource)
        if client is not None:
            demand.answer = None
            wishes: dict[str, Any] = dict(demand.wishes)
            client.ask(priority=demand.priority if wishes else 0, **wishes)

    async def _follow(self, demand: Demand, client: ResourceClient) -> None:
        said: tuple[Level, str] | None = None
        async for answer in client.answers():
            demand.answer = answer
            if said != (said := (answer.level, answer.message)):
                level = logging.INFO if answer.level is Level.OK else logging.WARNING
                mark = "=" if answer.level is Level.OK else "!"
                name = self._runtime.node.name
                _log.log(level, "%s %s: %s says: %s", mark, name, demand.resource, printable(answer.message))


async def _ended(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.wait([task])
