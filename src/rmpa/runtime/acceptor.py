"""Accepts the connections of a listening socket, for every server of this process.

A listening socket stays readable as long as a connection waits. Without a free file descriptor the loop would call
the server again and again. An ``Acceptor`` stops watching the socket instead, and tries again after a pause.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import select
from typing import TYPE_CHECKING, Any, Final

from rmpa.core.counters import RefusalLog
from rmpa.runtime import limits
from rmpa.runtime.descriptors import DESCRIPTORS, OUT_OF_DESCRIPTORS, Descriptors, Use

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
    """Hands each connection of ``sock`` to ``on_accept``, a few at a time, while there are descriptors for them.

    Args:
        sock: Bound and listening; closed by ``close()``.
        on_accept: ``(connection, address)``, called from the loop. The connection is non-blocking and belongs to the
            callee, unless the call raises.
        name: The server, for log messages: ``XML-RPC of /talker``.
        use: The purpose of the connections, which decides whether they may take the last descriptors.
        at_once: Connections that are accepted in one callback of the loop.
        descriptors: The file descriptors of this process.
    """

    def __init__(
        self,
        sock: socket.socket,
        on_accept: Callable[[socket.socket, Any], None],
        *,
        name: str,
        use: Use = Use.DATA,
        at_once: int = limits.ACCEPTS,
        descriptors: Descriptors = DESCRIPTORS,
    ) -> None:
        sock.setblocking(False)
        self._sock = sock
        self._on_accept = on_accept
        self._name = name
        self._use = use
        self._at_once = at_once
        self._descriptors = descriptors
        self._refusals = RefusalLog(_log, descriptors.counters)
        self._listening = False
        self._closed = False
        self._timer: asyncio.TimerHandle | None = None

    @property
    def address(self) -> Any:
        """The address that the socket listens at, as ``getsockname`` returns it."""
        return self._sock.getsockname()

    @property
    def paused(self) -> bool:
        """Whether accepting is paused: a connection waits for a descriptor, or ``pause`` was called."""
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
            self._timer = asyncio.get_running_loop().call_later(seconds, self._again)

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
            if not self._has_room():
                self._wait_for_room(None)
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
        return self._descriptors.has_room(self._use, lowest)

    def _has_connection(self) -> bool:
        """Whether a connection waits; without a free descriptor accept(2) fails in either case."""
        look = select.poll()
        look.register(self._sock.fileno(), select.POLLIN)
        return bool(look.poll(0))

    def _failed(self, error: OSError) -> None:
        if error.errno in OUT_OF_DESCRIPTORS:
            self._wait_for_room(error)
            return
        now = asyncio.get_running_loop().time()
        text = f"{self._name} cannot accept connections: {error.strerror}; next attempt in {limits.ACCEPT_PAUSE:g} s"
        self._refusals.refuse(now, "accept.failed", self._name, text)
        self._pause()

    def _wait_for_room(self, error: OSError | None) -> None:
        if not self._has_connection():
            return
        full = error is None or error.errno == errno.EMFILE
        if full and self._descriptors.make_room():
            return  # the loop calls again in its next iteration
        self._descriptors.refuse(self._use, self._name, error)
        self._pause()

    def _pause(self) -> None:
        self._stop()
        self._timer = asyncio.get_running_loop().call_later(limits.ACCEPT_PAUSE, self._again)

    def _again(self) -> None:
        self._timer = None
        if self._has_connection() and not self._has_room() and not self._descriptors.make_room():
            self._descriptors.refuse(self._use, self._name)
            self._timer = asyncio.get_running_loop().call_later(limits.ACCEPT_PAUSE, self._again)
        else:
            self.start()
