"""Accepts the connections of a listening socket, for every server of this process.

A connection for which no file descriptor is left is closed at once. Where accept(2) itself fails, the listening
socket stays readable, and the loop would call the server again and again: an ``Acceptor`` pauses then.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.counters import RefusalLog
from rmpa.runtime import limits
from rmpa.runtime.descriptors import DESCRIPTORS, OUT_OF_DESCRIPTORS, Use

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

_log = logging.getLogger(__name__)

_GONE: Final = frozenset(
    {
        errno.ECONNABORTED,
        errno.EHOSTDOWN,
        errno.EHOSTUNREACH,
        errno.ENETDOWN,
        errno.ENETUNREACH,
        errno.ENONET,
        errno.ENOPROTOOPT,
        errno.EOPNOTSUPP,
        errno.EPROTO,
    }
)
"""Errors of accept(2) that concern one waiting connection only; the next one may succeed."""


class Acceptor:
    """Hands each connection of ``sock`` to ``on_accept``, a few at a time.

    Args:
        sock: Bound and listening; closed by ``close()``.
        on_accept: ``(connection, address)``, called from the loop. The connection is non-blocking and belongs to the
            callee, unless the call raises.
        name: The server, for log messages: ``XML-RPC of /talker``.
        use: The purpose of the connections, which decides whether they may take the last descriptors; else they are
            closed.
        at_once: Connections that are accepted in one callback of the loop.
        make_room: Closes another connection where no descriptor is left for a new one, whose turn comes in the loop's
            next iteration; returns whether there was one.
    """

    def __init__(
        self,
        sock: socket.socket,
        on_accept: Callable[[socket.socket, Any], None],
        *,
        name: str,
        use: Use = Use.DATA,
        at_once: int = limits.ACCEPTS,
        make_room: Callable[[], bool] | None = None,
    ) -> None:
        sock.setblocking(False)
        self._sock = sock
        self._on_accept = on_accept
        self._name = name
        self._use = use
        self._at_once = at_once
        self._make_room = make_room
        self._refusals = RefusalLog(_log, DESCRIPTORS.counters)
        self._listening = False
        self._closed = False
        self._timer: asyncio.TimerHandle | None = None

    @property
    def address(self) -> Any:
        """The address that the socket listens at, as ``getsockname`` returns it."""
        return self._sock.getsockname()

    @property
    def paused(self) -> bool:
        """Whether accepting is paused."""
        return self._timer is not None

    def start(self) -> None:
        """Begin to accept."""
        self._timer = None
        if not self._listening and not self._closed:
            asyncio.get_running_loop().add_reader(self._sock.fileno(), self._acceptable)
            self._listening = True

    def pause(self, seconds: float) -> None:
        """Leave connections to the kernel, which refuses those that its queue does not hold, for so long."""
        if not self._closed and self._timer is None:
            self._stop()
            self._timer = asyncio.get_running_loop().call_later(seconds, self.start)

    def close(self) -> None:
        """Stop accepting, and close the listening socket; may be called twice."""
        self._stop()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._closed = True
        self._sock.close()

    def _stop(self) -> None:
        if self._listening:
            asyncio.get_running_loop().remove_reader(self._sock.fileno())
            self._listening = False

    def _acceptable(self) -> None:
        for _ in range(self._at_once):
            if self._closed or self._timer is not None:
                return  # ``on_accept`` closed or paused this acceptor
            if self._make_room is not None and not self._has_room() and self._make_room():
                return
            try:
                sock, address = self._sock.accept()
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                if error.errno in _GONE:
                    continue
                self._failed(error)
                return
            if not DESCRIPTORS.keeps(self._use, sock, f"a connection to {self._name}"):
                continue
            try:
                sock.setblocking(False)
                self._on_accept(sock, address)
            except BaseException:
                sock.close()
                raise

    def _has_room(self) -> bool:
        """Whether these connections may take the lowest free descriptor, whose number a duplicate shows."""
        try:
            lowest = os.dup(self._sock.fileno())
        except OSError:
            return False
        os.close(lowest)
        return DESCRIPTORS.has_room(self._use, lowest)

    def _failed(self, error: OSError) -> None:
        if error.errno in OUT_OF_DESCRIPTORS:
            DESCRIPTORS.refuse(self._use, f"a connection to {self._name}", error)
        else:
            now, pause = asyncio.get_running_loop().time(), limits.ACCEPT_PAUSE
            text = f"{self._name} cannot accept connections: {error.strerror}; next attempt in {pause:g} s"
            self._refusals.refuse(now, "accept.failed", self._name, text)
        self.pause(limits.ACCEPT_PAUSE)
