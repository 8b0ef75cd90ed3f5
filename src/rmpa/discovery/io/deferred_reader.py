"""Reads a socket whose packets can wait a little: an idle agent wakes once for many of them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rmpa.discovery import limits
from rmpa.runtime.coarse_timer import call_at_tick

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable


class DeferredReader:
    """Reads a socket as packets arrive, or, while ``may_wait()``, at common times of the process.

    ``read`` is to be called before packets of another socket are handled, which keeps the order of arrival.

    Args:
        sock: What is read; lent, not closed here.
        take: Handles a bounded number of the packets that wait; returns whether there may be more.
        may_wait: Whether packets may wait for ``limits.HEARTBEATS_READ_INTERVAL``.
    """

    def __init__(self, sock: socket.socket, take: Callable[[], bool], may_wait: Callable[[], bool]) -> None:
        self._fd = sock.fileno()
        self._take = take
        self._may_wait = may_wait
        self._loop = asyncio.get_running_loop()
        self._tick: asyncio.TimerHandle | None = None
        self._closed = False
        self._loop.add_reader(self._fd, self._readable)

    def read(self) -> None:
        """Handle the packets that wait, if they do not wake the process by themselves."""
        if self._tick is not None and self._take():
            self.hurry()

    def hurry(self) -> None:
        """Read packets as they arrive, from now on until they may wait again."""
        if self._tick is not None:
            self._tick.cancel()
            self._tick = None
            self._loop.add_reader(self._fd, self._readable)

    def pause(self, seconds: float) -> None:
        """Leave the packets to the kernel's buffer for this long."""
        if self._tick is not None:
            self._tick.cancel()
        self._loop.remove_reader(self._fd)
        self._tick = self._loop.call_later(seconds, self._due)

    def close(self) -> None:
        """Read no more."""
        self._closed = True
        if self._tick is not None:
            self._tick.cancel()
            self._tick = None
        self._loop.remove_reader(self._fd)
        # What this refers to refers to this: without a cycle the memory is free at once.
        self._take, self._may_wait = _nothing, _nothing

    def _readable(self) -> None:
        more = self._take()
        if not more and not self._closed and self._tick is None and self._may_wait():
            self._loop.remove_reader(self._fd)
            self._tick = call_at_tick(limits.HEARTBEATS_READ_INTERVAL, self._due)

    def _due(self) -> None:
        self._tick = None
        more = self._take()
        if self._closed or self._tick is not None:
            return
        if more or not self._may_wait():
            self._loop.add_reader(self._fd, self._readable)
        else:
            self._tick = call_at_tick(limits.HEARTBEATS_READ_INTERVAL, self._due)


def _nothing() -> bool:
    return False
