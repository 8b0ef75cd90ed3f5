"""The bulk lanes of all links: each is dialled when it is first wanted, and ended when it is not used."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from rmpa.core.backoff import Backoff
from rmpa.mesh import limits
from rmpa.mesh.frames import FrameKind, LaneWord
from rmpa.mesh.lane_demand import LaneAction

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from rmpa.core.clock import Clock
    from rmpa.core.counters import Counters
    from rmpa.mesh.io.connection import Connection
    from rmpa.mesh.io.link import PeerLink

_log = logging.getLogger(__name__)

_WORDS: Final = {
    LaneAction.SAY_WANT: LaneWord.WANT,
    LaneAction.SAY_LEAVE: LaneWord.LEAVE,
    LaneAction.SAY_KEEP: LaneWord.KEEP,
}


class BulkLanes:
    """Carries out what the links' machines decide; see ``mesh.lane_demand``.

    Args:
        connect: Connects to the peer of a link, and begins the handshake; raises ``OSError``.
        start: Runs a coroutine as a task.
        clock: The time.
        rng: Uniform numbers in [0, 1), for jitter.
        counters: Where failures are counted.
    """

    def __init__(
        self,
        connect: Callable[[PeerLink], Coroutine[object, object, None]],
        start: Callable[[Coroutine[object, object, None], str], asyncio.Task[None]],
        *,
        clock: Clock,
        rng: Callable[[], float],
        counters: Counters,
    ) -> None:
        self._connect = connect
        self._start = start
        self._clock = clock
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
        """A link is used with its peer."""
        self._act(link, link.lane_demand.begin())

    def link_ended(self, link_id: int) -> None:
        """A link is gone."""
        self._backoffs.pop(link_id, None)

    def want(self, link: PeerLink) -> None:
        """A message waits for the bulk lane of a link."""
        self._act(link, link.lane_demand.want())

    def said(self, link: PeerLink, word: int) -> None:
        """Take a word of a peer about the bulk lane."""
        self._act(link, link.lane_demand.said(word, self._clock.now(), used=link.bulk_used()))

    def tick(self, link: PeerLink) -> None:
        """Look whether the lane is used; called about once in a keepalive interval of its connection."""
        self._act(link, link.lane_demand.check(self._clock.now(), used=link.bulk_used()))

    def opened(self, link: PeerLink, bulk: Connection) -> None:
        """A handshake of the lane succeeded."""
        self._backoffs.pop(link.id, None)
        link.attach(bulk)
        _log.debug("= %s: bulk lane (%s)", bulk.name, "dialled" if bulk.dialled else "accepted")

    def ended(self, link: PeerLink, bulk: Connection, reason: str, *, expected: bool) -> None:
        """A connection ended; ``expected`` says that it was dialled for this link, and its handshake was not done."""
        ours = link.bulk_connection is bulk
        if not ours and not (link.used and expected):
            return
        action, lost = link.lane_demand.down(orderly=bulk.orderly, waiting=link.bulk.outbox.waiting_entries > 0)
        if ours:
            link.detach(bulk, lost=lost)
        if link.used and lost:
            self._counters.add("link.bulk_lost")
            _log.info("= %s: the bulk lane is gone (%s); small messages go on", link.name, reason)
        self._act(link, action, self._backoff(link).delay() if lost else 0.0)

    def _act(self, link: PeerLink, action: LaneAction, delay: float = 0.0) -> None:
        if action is LaneAction.NOTHING or self._closed:
            return
        if action is LaneAction.DIAL:
            self._dial(link, delay)
        elif action is LaneAction.SAY_LEAVE:
            link.pause_bulk()
        elif action is LaneAction.RESUME:
            link.resume_bulk()
        elif action is LaneAction.CLOSE:
            link.end_bulk("the bulk lane is not used")
        if (word := _WORDS.get(action)) is not None:
            link.mark(FrameKind.LANE, word, 0)

    def _dial(self, link: PeerLink, delay: float) -> None:
        if link.used and link.bulk_connection is None and link.id not in self._dials:
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
