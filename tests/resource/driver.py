"""A node as drivers are: it publishes images, and has dynamic_reconfigure; on the test's core."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

from rmpa.core.errors import RmpaError
from rmpa.resource.actuation import read_config
from rmpa.resource.reconfigure import config
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.endpoints import Publisher
from rmpa.ros.node.node import Node
from rmpa.ros.types.descriptor import CONFIG_TYPE, SERVICE_TYPE

Values = dict[str, Any]


class Driver:
    """The node; ``values`` are those of its dynamic parameters.

    Args:
        node: Open.
        values: The values that it begins with.
    """

    def __init__(self, node: Node, values: Values) -> None:
        self.node = node
        self.values = values
        # What each call has asked for.
        self.calls: list[Values] = []
        # What the node makes of what it is asked for.
        self.accept: Callable[[Values], Values] = lambda asked: asked
        self.answers = asyncio.Event()
        self.answers.set()
        self._updates: Publisher | None = None

    async def start(self) -> None:
        self._updates = await self.node.advertise("~parameter_updates", CONFIG_TYPE, latch=True)
        self._updates.publish(config(self.values))
        await self.node.advertise_service("~set_parameters", SERVICE_TYPE, self._serve)

    def turn(self, **values: Any) -> None:
        """Change values as rqt_reconfigure does."""
        assert self._updates is not None
        self.values |= values
        self._updates.publish(config(self.values))

    async def _serve(self, request: Any) -> Any:
        asked = read_config(request.config)
        self.calls.append(asked)
        await self.answers.wait()
        self.turn(**self.accept(asked))
        return {"config": config(self.values)}


@asynccontextmanager
async def driver(core: RosCore, name: str = "cam", **values: Any) -> AsyncIterator[Driver]:
    """A driver that runs as long as the ``async with`` lasts."""
    async with Node(name, master_uri=core.uri) as node:
        one = Driver(node, values)
        await one.start()
        yield one


def refuse(_: Values) -> Values:
    raise RmpaError("no such mode")
