"""Shared by our own nodes: the layout of their one message type, counting subscribers, start and end."""

from __future__ import annotations

import asyncio
import signal
import struct
from typing import TYPE_CHECKING, Final

from node import Subscribers
from rmpa.ros.node.node import Node

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.ros.node.node import Publisher

KIND: Final = "std_msgs/UInt8MultiArray"
_LAYOUT: Final = struct.Struct("<III")
DATA: Final = _LAYOUT.size
"""Where the data begins in a message without dimensions: behind their count, the offset and the data's length."""
_LOOK: Final = 0.02
"""Seconds between looks at the number of subscribers."""


def framed(data: bytearray) -> bytes:
    """A message of this data, without dimensions."""
    return _LAYOUT.pack(0, 0, len(data)) + data


async def watch(publisher: Publisher) -> None:
    """Say ``connected`` whenever the number of subscribers changes, for ever."""
    subscribers = Subscribers()
    while True:
        subscribers.changed(publisher.subscribers)
        await asyncio.sleep(_LOOK)


def run(name: str, body: Callable[[Node, asyncio.Event], Awaitable[None]]) -> None:
    """Run a node until a signal or its master ends it.

    Args:
        name: Of the node; the program's with a number where the user gave none.
        body: Sets it up, and returns when the event is set.
    """

    async def main() -> None:
        loop = asyncio.get_running_loop()
        ended = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, ended.set)
        async with Node(name, on_shutdown=lambda _: ended.set()) as node:
            await body(node, ended)

    asyncio.run(main())
