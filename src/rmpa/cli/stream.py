"""Runs commands that end at Ctrl-C, at a count, or with their master: one anonymous ROS node, closed cleanly."""

from __future__ import annotations

import asyncio
import contextlib
import signal
from typing import TYPE_CHECKING

from rmpa.cli.output import warn
from rmpa.core.errors import UnreachableError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from rmpa.cli.graph import GraphName
    from rmpa.cli.master import Master
    from rmpa.ros.node.node import Node, Received


class Enough(Exception):  # noqa: N818 - not an error
    """``--count`` is reached: raised by a command's callback, caught around ``watch_topic``."""


class StreamWatch:
    """The end of a running command, and the error that its callbacks report."""

    def __init__(self) -> None:
        self._end = asyncio.Event()
        self._error: BaseException | None = None

    def finish(self, error: BaseException | None = None) -> None:
        """End the command; it fails with the first error that is given."""
        self._error = self._error or error
        self._end.set()

    async def finished(self, seconds: float | None = None) -> bool:
        """Wait for the end, or for so many seconds; return whether the command ends.

        Raises:
            BaseException: The error that ``finish`` was given.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._end.wait()
        if self._error is not None:
            raise self._error
        return self._end.is_set()


def run_stream(body: Callable[[], Coroutine[object, object, None]]) -> None:
    """Run a coroutine to its end; Ctrl-C and SIGTERM cancel it, and its own clean-up runs."""
    from rmpa.runtime.accept import raise_file_limit

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
    wanted: GraphName,
    on_message: Callable[[Received], None],
    body: Callable[[StreamWatch], Awaitable[None]],
) -> None:
    """Subscribe to a topic and run ``body``.

    Args:
        master: The master to ask.
        wanted: The topic; with a peer only messages of that peer's nodes count.
        on_message: Called for each message; an exception ends the command and is raised by ``watch.finished``.
        body: Runs until the watch is finished.
    """
    watch = StreamWatch()

    def take(received: Received) -> None:
        if not wanted.matches(received.caller_id):
            return
        try:
            on_message(received)
        except BaseException as error:  # noqa: BLE001 - carried over to the command, which fails with it
            watch.finish(error)

    async def listen(node: Node) -> None:
        subscriber = await node.subscribe(wanted.name, None, take)
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
