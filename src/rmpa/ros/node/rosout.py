"""The log of a node: a ``logging.Logger`` whose records go to ``/rosout``, as rospy's and roscpp's do."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sys
from collections import deque
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.ros.node.loggers import level_of
from rmpa.runtime.tasks import keep_task

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from rmpa.ros.node.endpoints import MasterClient, Publisher

_log = logging.getLogger(__name__)

_TOPIC: Final = "/rosout"
_TYPE: Final = "rosgraph_msgs/Log"
# Records that wait for the connection of the core's /rosout; above it the oldest is dropped.
_WAITING: Final = 1000
# Time in which the core's /rosout connects: what is published before that would be lost.
_SUBSCRIBED_WITHIN: Final = 1.0
# Time between two attempts to register at a master that does not answer.
_RETRY: Final = 1.0


class RosoutHandler(logging.Handler):
    """Publishes records on ``/rosout``; records may come from any thread.

    A program that does not configure ``logging`` sees them on standard error too.

    Args:
        node: The node; each message has the topics that it publishes.
        advertise: ``Node.advertise``.
    """

    def __init__(self, node: MasterClient, advertise: Callable[..., Awaitable[Publisher]]) -> None:
        super().__init__()
        self._node = node
        self._advertise = advertise
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[dict[str, object]] = deque(maxlen=_WAITING)
        self._publisher: Publisher | None = None
        self._task: asyncio.Task[None] | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Publish a record."""
        text = self.format(record)
        if not logging.getLogger().handlers:
            print(f"[{record.levelname}] [{record.created:.6f}]: {text}", file=sys.stderr)
        fields: dict[str, object] = {
            "header": {"stamp": record.created},
            "level": 1 << level_of(record.levelno),
            "name": self._node.name,
            "msg": text,
            "file": record.pathname,
            "function": record.funcName or "",
            "line": record.lineno,
        }
        with contextlib.suppress(RuntimeError):  # the loop is closed: the program ends
            self._loop.call_soon_threadsafe(self._take, fields)

    async def drained(self) -> None:
        """Wait until what has been logged is published, for a moment at the most."""
        await asyncio.sleep(0)  # what other calls have put into the loop comes first
        if self._task is not None:
            await asyncio.wait([self._task], timeout=_SUBSCRIBED_WITHIN)
            self._task.cancel()

    def _take(self, fields: dict[str, object]) -> None:
        self._waiting.append(fields)
        if self._publisher is not None:
            self._publish(self._publisher)
        elif self._task is None:
            self._task = keep_task(self._start, f"rosout of {self._node.name}")

    async def _start(self) -> None:
        publisher: Publisher | None = None
        while publisher is None:
            try:
                publisher = await self._advertise(_TOPIC, _TYPE, latch=True)
            except RmpaError as error:
                _log.debug("! %s: %s", self._node.name, error)
                await asyncio.sleep(_RETRY)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_SUBSCRIBED_WITHIN):
                await publisher.wait_for_subscriber()
        self._publisher = publisher
        self._publish(publisher)

    def _publish(self, publisher: Publisher) -> None:
        while self._waiting:
            publisher.publish(topics=sorted(self._node.slave.publications()), **self._waiting.popleft())
