"""Connects to peers: one TCP connect, and the race of all addresses of a peer."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
from typing import TYPE_CHECKING

from rmpa.mesh import limits
from rmpa.mesh.handshake import Lane
from rmpa.mesh.io.sockets import limit_segments, tune_bulk, tune_express
from rmpa.runtime.accept import DESCRIPTORS, Use

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Coroutine, Sequence

    from rmpa.config.settings import LaneSettings
    from rmpa.core.counters import Counters
    from rmpa.mesh.peering_events import SocketAddress


class Dialler:
    """Opens the TCP connections that this side dials.

    Args:
        lanes: The options of the lanes' sockets.
        counters: Where options that the system refuses are counted.
    """

    def __init__(self, lanes: LaneSettings, counters: Counters) -> None:
        self._lanes = lanes
        self._counters = counters
        self._attempts: set[asyncio.Task[socket.socket]] = set()

    async def connect(
        self, endpoint: SocketAddress, lane: Lane, within: float = limits.DIAL_TIMEOUT
    ) -> socket.socket:
        """Connect once, for one lane.

        Raises:
            OSError: It failed, or took longer than ``within`` seconds (``TimeoutError``).
        """
        sock = DESCRIPTORS.open_socket(Use.LINK, what=f"a link to {endpoint[0]}:{endpoint[1]}")
        try:
            (tune_bulk if lane is Lane.BULK else tune_express)(sock, self._lanes, self._counters)
            if not endpoint[0].startswith("127."):
                limit_segments(sock, self._counters)
            async with asyncio.timeout(within):
                await asyncio.get_running_loop().sock_connect(sock, endpoint)
        except BaseException:
            sock.close()
            raise
        return sock

    async def dial(self, endpoints: Sequence[SocketAddress]) -> tuple[socket.socket, SocketAddress]:
        """Connect for the express lane where a peer answers first; raises as ``_race``."""
        return await self._race(endpoints, self._connect_repeatedly)

    async def redial(self, endpoints: Sequence[SocketAddress]) -> tuple[socket.socket, SocketAddress]:
        """The same with one short attempt at each endpoint, for a peer that was linked until now."""
        return await self._race(endpoints, self._connect_briefly)

    def close(self) -> list[asyncio.Task[socket.socket]]:
        """Cancel all attempts; return them, to be awaited."""
        for task in self._attempts:
            task.cancel()
        return list(self._attempts)

    async def _connect_briefly(self, endpoint: SocketAddress) -> socket.socket:
        return await self.connect(endpoint, Lane.EXPRESS, limits.REDIAL_TIMEOUT)

    async def _connect_repeatedly(self, endpoint: SocketAddress) -> socket.socket:
        """Connect; a lost SYN is repeated by new attempts, because TCP waits a second."""
        *short, last = limits.DIAL_ATTEMPTS
        for within in short:
            with contextlib.suppress(TimeoutError):
                return await self.connect(endpoint, Lane.EXPRESS, within)
        return await self.connect(endpoint, Lane.EXPRESS, last)

    async def _race(
        self,
        endpoints: Sequence[SocketAddress],
        attempt: Callable[[SocketAddress], Coroutine[object, object, socket.socket]],
    ) -> tuple[socket.socket, SocketAddress]:
        """Connect to the endpoint that answers first (RFC 8305).

        The next endpoint has its turn when the one before it failed, or was silent for ``limits.DIAL_STAGGER``.

        Raises:
            OSError: No endpoint answers; the error is the one that came first.
        """
        left = list(endpoints)
        if len(left) == 1:
            return await attempt(left[0]), left[0]
        running: dict[asyncio.Task[socket.socket], SocketAddress] = {}
        first: OSError | None = None
        try:
            while left or running:
                if left:
                    endpoint = left.pop(0)
                    task = asyncio.get_running_loop().create_task(attempt(endpoint))
                    running[task] = endpoint
                    self._attempts.add(task)
                    task.add_done_callback(self._attempts.discard)
                pause = limits.DIAL_STAGGER if left else None
                done, _ = await asyncio.wait(running, timeout=pause, return_when=asyncio.FIRST_COMPLETED)
                for task in [task for task in running if task in done]:
                    endpoint = running.pop(task)
                    try:
                        return task.result(), endpoint
                    except OSError as error:  # TimeoutError is one, no file descriptor for the socket another
                        first = first if first is not None else error
        finally:
            for task in running:  # not awaited: the link does not wait for the slower attempts
                task.add_done_callback(_close_late)
                task.cancel()
        raise first if first is not None else OSError(errno.EHOSTUNREACH, os.strerror(errno.EHOSTUNREACH))


def _close_late(task: asyncio.Task[socket.socket]) -> None:
    """Close the socket of an attempt that succeeded although another one was faster."""
    if not task.cancelled() and task.exception() is None:
        task.result().close()
