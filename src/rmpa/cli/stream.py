"""Runs a command that goes on until Ctrl-C, a count or its master ends it: one anonymous ROS node, left cleanly."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from typing import TYPE_CHECKING

from rmpa.cli.output import warn
from rmpa.core.errors import UnreachableError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from rmpa.cli.master import Master, TopicName
    from rmpa.ros.node.node import Node, Received


class Enough(Exception):  # noqa: N818 - not an error
    """As many messages came as were asked for: raised by a command's callback, caught around ``watch_topic``."""


class StreamWatch:
    """Until when a command runs, and where its callbacks hand over what went wrong."""

    def __init__(self) -> None:
        self._end = asyncio.Event()
        self._error: BaseException | None = None

    def finish(self, error: BaseException | None = None) -> None:
        """End the command; with an error it fails with that."""
        self._error = self._error or error
        self._end.set()

    async def finished(self, seconds: float | None = None) -> bool:
        """Wait for the end, or for so long; whether it is the end.

        Raises:
            BaseException: What ``finish`` was given.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._end.wait()
        if self._error is not None:
            raise self._error
        return self._end.is_set()


def run_stream(body: Callable[[], Coroutine[object, object, None]]) -> None:
    """Run until the body ends; Ctrl-C and SIGTERM end it too, behind its own cleaning up."""
    from rmpa.runtime.descriptors import raise_file_limit

    async def run() -> None:
        task = asyncio.current_task()
        assert task is not None  # noqa: S101 - it is this one
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, task.cancel)
        await body()

    with contextlib.suppress(KeyboardInterrupt, asyncio.CancelledError):
        raise_file_limit()
        asyncio.run(run())


async def with_node(master: Master, name: str, body: Callable[[Node], Awaitable[None]]) -> None:
    """Run ``body`` with a node of a unique name at a master.

    Raises:
        UnreachableError: The master does not answer.
    """
    from rmpa.ros.node.node import Node

    node = Node(name, master_uri=master.uri, anonymous=True)
    try:
        await node.__aenter__()
    except UnreachableError:
        raise master.unreachable() from None
    try:
        await body(node)
    finally:
        await node.close()


async def watch_topic(
    master: Master,
    wanted: TopicName,
    on_message: Callable[[Received], None],
    body: Callable[[StreamWatch], Awaitable[None]],
) -> None:
    """Subscribe to a topic and run ``body``.

    Args:
        master: The master to ask.
        wanted: The topic, and perhaps the one peer whose messages are meant.
        on_message: Called for each of them; what it raises ends the command.
        body: Runs until the watch is finished.
    """
    watch = StreamWatch()

    def take(received: Received) -> None:
        if not wanted.takes(received.caller_id):
            return
        try:
            on_message(received)
        except BaseException as error:  # noqa: BLE001 - carried over to the command, which fails with it
            watch.finish(error)

    async def listen(node: Node) -> None:
        subscriber = await node.subscribe(wanted.topic, None, take)
        stopped = asyncio.get_running_loop().create_task(_end_with(node, watch))
        try:
            await body(watch)
        finally:
            stopped.cancel()
            for refusal in subscriber.refusals.values():
                warn(refusal)

    await with_node(master, "rmpa_topic", listen)


async def _end_with(node: Node, watch: StreamWatch) -> None:
    await node.stopped.wait()
    watch.finish()
