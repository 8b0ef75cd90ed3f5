"""Replaces silent links by new connections to their peers, because TCP retransmits more and more rarely."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.mesh import limits
from rmpa.mesh.io.sockets import unacknowledged

if TYPE_CHECKING:
    import socket
    from collections.abc import Awaitable, Callable, Coroutine

    from rmpa.mesh.io.dialler import Dialler
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.io.securing import SecuredSocket
    from rmpa.mesh.peering_events import SocketAddress

_log = logging.getLogger(__name__)


class Redials:
    """One attempt for each silent link, repeated until the peer answers on either connection.

    Args:
        dialler: Opens the connections.
        start: ``(work, name)``: begins a task that is not awaited.
        alive: Whether bytes were received on a link lately.
        endpoints: Where the peer of a link may be reached.
        secure: Does the TLS handshake of a dialled connection in a secured mesh.
        opened: ``(link, sock, endpoint, secured)``: a new connection to the peer of a link.
    """

    def __init__(
        self,
        dialler: Dialler,
        *,
        start: Callable[[Coroutine[object, object, None], str], asyncio.Task[None]],
        alive: Callable[[int], bool],
        endpoints: Callable[[PeerLink], list[SocketAddress]],
        secure: Callable[[socket.socket], Awaitable[SecuredSocket | None]],
        opened: Callable[[PeerLink, socket.socket, SocketAddress, SecuredSocket | None], None],
    ) -> None:
        self._dialler = dialler
        self._start = start
        self._alive = alive
        self._endpoints = endpoints
        self._secure = secure
        self._opened = opened
        self._tasks: dict[int, asyncio.Task[None]] = {}

    def begin(self, link: PeerLink) -> None:
        """Try to reach the peer of a silent link by a new connection, unless that is done already."""
        if link.id not in self._tasks:
            self._tasks[link.id] = task = self._start(self._redial(link), f"redial {link.name}")
            task.add_done_callback(lambda _: self._tasks.pop(link.id, None))

    def close(self) -> list[asyncio.Task[None]]:
        """Cancel all attempts; return their tasks."""
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        return tasks

    async def _redial(self, link: PeerLink) -> None:
        """Replace a link without acknowledgements as soon as the peer can be reached again, on any path."""
        while link.used and not self._alive(link.id):
            try:
                sock, endpoint = await self._dialler.redial(self._endpoints(link))
            except OSError as error:
                _log.debug("! %s: silent, and not to be reached: %s", link.name, str(error) or "no answer")
                await asyncio.sleep(limits.REDIAL_PAUSE)
                continue
            if is_over(link):
                # The link and its socket ended meanwhile: the peering machine decides on the next dial.
                sock.close()
                return
            if self._alive(link.id) or not unacknowledged(link.connection.sock):
                _log.debug("= %s: silent, but not for want of a way to it", link.name)
                sock.close()
                return
            try:
                secured = await self._secure(sock)
            except OSError as error:
                _log.debug("! %s: silent, and no TLS handshake: %s", link.name, str(error) or "no answer")
                await asyncio.sleep(limits.REDIAL_PAUSE)
                continue
            if is_over(link):
                sock.close()
                return
            self._opened(link, sock, endpoint, secured)
            return


def is_over(link: PeerLink) -> bool:
    """Whether a link was replaced or has ended; to be checked after an ``await``."""
    return not link.used
