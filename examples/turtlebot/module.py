"""What the four modules' nodes share: their command line, waiting for their core, and a clean end."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import signal
import sys
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from rmpa import MessageType, Node

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Coroutine

KNOCK = 0.02
"""Seconds between looks whether the core is there yet."""


def arguments(description: str | None) -> argparse.ArgumentParser:
    """A command line with ``--master``; a module adds its own flags."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--master",
        metavar="URI",
        default=os.environ.get("ROS_MASTER_URI", "http://127.0.0.1:11311/"),
        help="the ROS core, as `rmpa up` prints it [default: ROS_MASTER_URI, or http://127.0.0.1:11311/]",
    )
    return parser


@contextlib.asynccontextmanager
async def joined(name: str, master_uri: str, *types: str) -> AsyncIterator[Node]:
    """A node at the module's core, once that is up: agent and nodes may be started in any order.

    Args:
        name: The node's.
        master_uri: The core's.
        types: Message types that it uses; what reads and writes them is made while the core starts.
    """
    for kind in map(MessageType, types):
        kind.deserialize(kind.serialize(kind.make()))
    address = urlsplit(master_uri)
    while True:
        try:
            _, writer = await asyncio.open_connection(address.hostname, address.port)
        except OSError:
            await asyncio.sleep(KNOCK)
        else:
            writer.close()
            break
    async with Node(name, master_uri=master_uri) as node:
        yield node


def run(work: Coroutine[object, object, None]) -> None:
    """Run a module until it is done or gets SIGTERM or Ctrl-C; it always has the time to unregister its node."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)

    async def until_signal() -> None:
        task = asyncio.ensure_future(work)
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, task.cancel)
        with contextlib.suppress(asyncio.CancelledError):
            await task

    asyncio.run(until_signal())
