"""Watches both lanes of the links for path-MTU black holes, and has smaller packets sent where there is one."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING

from rmpa.mesh import limits
from rmpa.mesh.io.sockets import packet_bytes, sample
from rmpa.mesh.path_mtu import PathState, PathTable, Progress

if TYPE_CHECKING:
    from rmpa.core.clock import Clock
    from rmpa.core.counters import Counters
    from rmpa.mesh.io.link import MeshLink
    from rmpa.mesh.path_mtu import PathProblem

_log = logging.getLogger(__name__)

Knock = Callable[["MeshLink"], Coroutine[object, object, bool]]


class PathMonitor:
    """Looks at the connections of links that are used, from their own timers; an idle agent does not wake for it.

    Args:
        clock: The time.
        counters: ``link.black_hole`` counts connections that were given up for one, ``path.black_hole`` the paths.
        knock: Whether the peer of a link can be reached by a new connection, which is closed at once.
    """

    def __init__(self, clock: Clock, counters: Counters, knock: Knock) -> None:
        self._clock = clock
        self._counters = counters
        self._knock = knock
        self._knocks: dict[int, asyncio.Task[None]] = {}
        self._table = PathTable()
        self._soon: dict[int, asyncio.TimerHandle] = {}

    def segment(self, address: str) -> int | None:
        """Bytes that one packet to an address may carry; ``None`` for as many as the kernel likes."""
        return self._table.segment(address, self._clock.now())

    def problem(self, link: MeshLink) -> PathProblem | None:
        """What is wrong with the path of a link; ``None`` if nothing is known."""
        lane = link.bulk_link or link
        return self._table.problem(link.remote_endpoint[0], lane.stalls.segment, self._clock.now())

    def packet_bytes(self, link: MeshLink) -> int | None:
        """Bytes of the largest packet that large messages of a link leave in; ``None`` if unknown."""
        lane = link.bulk_link or link
        size = packet_bytes(lane.sock)
        segment = lane.stalls.segment
        return size if size is None or segment is None else min(size, segment + limits.TCP_HEADERS)

    def look(self, link: MeshLink) -> None:
        """Judge both lanes of a link; again soon while something of it is repeated."""
        self._cancel(link)
        if not link.up:
            return
        bulk = link.bulk_link
        again = self._judge(link, link, bulk)
        if bulk is not None and bulk.up and self._judge(link, bulk, link):
            again = True
        if again and link.up:
            loop = asyncio.get_running_loop()
            self._soon[link.id] = loop.call_later(limits.STALL_LOOK, self.look, link)

    def ended(self, lane: MeshLink) -> None:
        """A connection is over, perhaps before the evidence was complete."""
        self._cancel(lane)
        if lane.stalls.suspected:
            self._table.black_hole(lane.remote_endpoint[0], lane.stalls.segment, self._clock.now())

    def close(self) -> list[asyncio.Task[None]]:
        """Look no more; return what was cancelled and is to be awaited."""
        for timer in self._soon.values():
            timer.cancel()
        self._soon.clear()
        knocks = list(self._knocks.values())
        for task in knocks:
            task.cancel()
        return knocks

    def _start_knock(self, link: MeshLink, lane: MeshLink) -> None:
        """Both lanes stand still: let a handshake of TCP be the small packet."""
        if lane.id not in self._knocks:
            task = asyncio.get_running_loop().create_task(self._try_way(link, lane), name=f"knock {link.name}")
            self._knocks[lane.id] = task
            task.add_done_callback(lambda _: self._knocks.pop(lane.id, None))

    async def _try_way(self, link: MeshLink, lane: MeshLink) -> None:
        if await self._knock(link):
            lane.stalls.small_passed()

    def _cancel(self, link: MeshLink) -> None:
        if (timer := self._soon.pop(link.id, None)) is not None:
            timer.cancel()

    def _judge(self, link: MeshLink, lane: MeshLink, other: MeshLink | None) -> bool:
        """Judge one lane; whether to look again soon."""
        if not lane.has_sent():
            lane.stalls.idle(self._clock.now())
            return False
        taken = sample(lane.sock)
        if taken is None:
            return False
        if other is not None and other.take_probe():
            lane.stalls.small_passed()
        progress = lane.stalls.look(taken, self._clock.now())
        if progress is Progress.FLOWING:
            self._flowing(lane, other)
            return False
        if progress is Progress.STALLED:
            if other is not None and other.up and not other.stalls.waiting:
                other.probe()
            else:
                self._start_knock(link, lane)
        elif progress is Progress.BLACK_HOLE:
            self._give_up(link, lane)
        return True

    def _flowing(self, lane: MeshLink, other: MeshLink | None) -> None:
        if other is not None:
            other.forget_probe()
        address, segment = lane.remote_endpoint[0], lane.stalls.segment
        if segment is not None and self._table.flowed(address, segment, lane.stalls.acked):
            self._counters.add("path.black_hole")
            _log.warning("! %s: %s", lane.name, self._table.problem(address, segment, self._clock.now()))

    def _give_up(self, link: MeshLink, lane: MeshLink) -> None:
        """Let the next connection send smaller packets, and the express lane at once: its data still flows."""
        now, address = self._clock.now(), lane.remote_endpoint[0]
        state = self._table.black_hole(address, lane.stalls.segment, now)
        if state is PathState.NO_HELP:
            _log.warning("! %s: %s", lane.name, self._table.problem(address, None, now))
        size = self._table.segment(address, now)
        if state is not PathState.TRYING or size is None:
            return
        self._counters.add("link.black_hole")
        reason = f"large packets to {address} are not acknowledged; trying packets of {size} bytes"
        if lane is not link:
            link.segment(size)
        lane.reset(reason)
