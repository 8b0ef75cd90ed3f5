"""The bulk lanes of all links: each is dialled when a message first wants it, and ends with its link.

Only the side that dialled the link dials its bulk lane; the other side asks for it by a lane frame.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from rmpa.core.counters import Backoff
from rmpa.mesh import limits
from rmpa.mesh.frames import FrameKind

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from rmpa.core.counters import Counters
    from rmpa.mesh.io.connection import Connection
    from rmpa.mesh.io.link import PeerLink

_log = logging.getLogger(__name__)


class BulkLanes:
    """Dials the bulk lanes, again for as long as their links stand.

    Args:
        connect: Connects to the peer of a link, and begins the handshake; raises ``OSError``.
        start: Runs a coroutine as a task.
        rng: Uniform numbers in [0, 1), for jitter.
        counters: Where failures are counted.
    """

    def __init__(
        self,
        connect: Callable[[PeerLink], Coroutine[object, object, None]],
        start: Callable[[Coroutine[object, object, None], str], asyncio.Task[None]],
        *,
        rng: Callable[[], float],
        counters: Counters,
    ) -> None:
        self._connect = connect
        self._start = start
        self._rng = rng
        self._counters = counters
        self._dials: dict[int, asyncio.Task[None]] = {}
        self._backoffs: dict[int, Backoff] = {}
        self._closed = False

    def close(self) -> list[asyncio.Task[None]]:
        """Dial no more; return the cancelled tasks, to be awaited."""
        self._closed = True
        tasks = list(self._dials.values())
        for task in tasks:
            task.cancel()
        return tasks

    def link_up(self, link: PeerLink) -> None:
        """A link is used with its peer, which may have asked for the lane before."""
        if link.dialled and link.bulk_wanted:
            self._dial(link)

    def link_ended(self, link_id: int) -> None:
        """A link is gone."""
        self._backoffs.pop(link_id, None)

    def want(self, link: PeerLink) -> None:
        """A message waits for the bulk lane of a link, here or at the peer that asks for it."""
        if link.bulk_wanted:
            return
        link.bulk_wanted = True
        if link.dialled:
            self._dial(link)
        else:
            link.mark(FrameKind.LANE, 0, 0)

    def opened(self, link: PeerLink, bulk: Connection) -> None:
        """A handshake of the lane succeeded."""
        self._backoffs.pop(link.id, None)
        link.attach(bulk)
        _log.debug("= %s: bulk lane (%s)", bulk.name, "dialled" if bulk.dialled else "accepted")

    def ended(self, link: PeerLink, bulk: Connection, reason: str, *, expected: bool) -> None:
        """A connection ended; ``expected`` says that it was dialled for this link, and its handshake was not done."""
        if link.bulk_connection is bulk:
            link.detach(bulk)
        elif not (link.used and expected):
            return
        if link.used:
            self._counters.add("link.bulk_lost")
            _log.info("= %s: the bulk lane is gone (%s); small messages go on", link.name, reason)
            if link.dialled:
                self._dial(link, self._backoff(link).delay())

    def _dial(self, link: PeerLink, delay: float = 0.0) -> None:
        if not self._closed and link.used and link.bulk_connection is None and link.id not in self._dials:
            self._dials[link.id] = task = self._start(self._connected(link, delay), f"bulk {link.name}")
            task.add_done_callback(lambda _: self._dials.pop(link.id, None))

    async def _connected(self, link: PeerLink, delay: float) -> None:
        backoff = self._backoff(link)
        await asyncio.sleep(delay)
        while link.used:
            try:
                await self._connect(link)
            except OSError as error:
                self._counters.add("link.bulk_failed")
                _log.debug("! %s: no bulk lane: %s", link.name, error)
                await asyncio.sleep(backoff.delay())
            else:
                return

    def _backoff(self, link: PeerLink) -> Backoff:
        return self._backoffs.setdefault(link.id, Backoff(limits.BACKOFF_FIRST, limits.BACKOFF_MAX, self._rng))
