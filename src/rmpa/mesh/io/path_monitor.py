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
    from rmpa.mesh.io.connection import Connection
    from rmpa.mesh.io.link import PeerLink
    from rmpa.mesh.path_mtu import PathProblem

_log = logging.getLogger(__name__)

Reachable = Callable[["PeerLink"], Coroutine[object, object, bool]]


class PathMonitor:
    """Samples the connections of links that are used, from their own timers; an idle agent does not wake for it.

    Args:
        clock: The time.
        counters: ``link.black_hole`` counts connections that were given up for one, ``path.black_hole`` the paths.
        reachable: Whether the peer of a link can be reached by a new connection, which is closed at once.
    """

    def __init__(self, clock: Clock, counters: Counters, reachable: Reachable) -> None:
        self._clock = clock
        self._counters = counters
        self._reachable = reachable
        self._trials: dict[int, asyncio.Task[None]] = {}
        """By connection: trials of new connections."""
        self._table = PathTable()
        self._timers: dict[int, asyncio.TimerHandle] = {}
        """By link: when to sample it again soon."""

    def segment(self, address: str) -> int | None:
        """Bytes that one packet to an address may carry; ``None`` for as many as the kernel chooses."""
        return self._table.segment(address, self._clock.now())

    def problem(self, link: PeerLink) -> PathProblem | None:
        """What is wrong with the path of a link; ``None`` if nothing is known."""
        lane = link.bulk_connection or link.connection
        return self._table.problem(link.remote_endpoint[0], lane.stalls.segment, self._clock.now())

    def packet_bytes(self, link: PeerLink) -> int | None:
        """Bytes of the largest packet that large messages of a link are sent in; ``None`` if unknown."""
        lane = link.bulk_connection or link.connection
        size = packet_bytes(lane.sock)
        segment = lane.stalls.segment
        return size if size is None or segment is None else min(size, segment + limits.TCP_HEADERS)

    def look(self, link: PeerLink) -> None:
        """Judge both lanes of a link; again soon while something of it is retransmitted."""
        self._cancel_timer(link.id)
        if not link.up:
            return
        express, bulk = link.connection, link.bulk_connection
        again = self._judge(link, express, bulk)
        if bulk is not None and bulk.up and self._judge(link, bulk, express):
            again = True
        if again and link.up:
            loop = asyncio.get_running_loop()
            self._timers[link.id] = loop.call_later(limits.STALL_LOOK, self.look, link)

    def ended(self, connection: Connection) -> None:
        """A connection is over, perhaps before the evidence was complete."""
        self._cancel_timer(connection.id)
        if connection.stalls.suspected:
            self._table.black_hole(connection.remote_endpoint[0], connection.stalls.segment, self._clock.now())

    def close(self) -> list[asyncio.Task[None]]:
        """Stop; return what was cancelled and is to be awaited."""
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
        trials = list(self._trials.values())
        for task in trials:
            task.cancel()
        return trials

    def _start_trial(self, link: PeerLink, lane: Connection) -> None:
        """Both lanes stand still: let the TCP handshake of a new connection be the small packet."""
        if lane.id not in self._trials:
            task = asyncio.get_running_loop().create_task(self._try_path(link, lane), name=f"knock {link.name}")
            self._trials[lane.id] = task
            task.add_done_callback(lambda _: self._trials.pop(lane.id, None))

    async def _try_path(self, link: PeerLink, lane: Connection) -> None:
        if await self._reachable(link):
            lane.stalls.small_passed()

    def _cancel_timer(self, link_id: int) -> None:
        if (timer := self._timers.pop(link_id, None)) is not None:
            timer.cancel()

    def _judge(self, link: PeerLink, lane: Connection, other: Connection | None) -> bool:
        """Judge the connection of one lane; return whether to look again soon."""
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
                self._start_trial(link, lane)
        elif progress is Progress.BLACK_HOLE:
            self._give_up(link, lane)
        return True

    def _flowing(self, lane: Connection, other: Connection | None) -> None:
        if other is not None:
            other.forget_probe()
        address, segment = lane.remote_endpoint[0], lane.stalls.segment
        if segment is not None and self._table.flowed(address, segment, lane.stalls.acked):
            self._counters.add("path.black_hole")
            _log.warning("! %s: %s", lane.name, self._table.problem(address, segment, self._clock.now()))

    def _give_up(self, link: PeerLink, lane: Connection) -> None:
        """Let the next connection send smaller packets, and the express lane at once: its data still flows."""
        now, address = self._clock.now(), lane.remote_endpoint[0]
        state = self._table.black_hole(address, lane.stalls.segment, now)
        if state is PathState.NO_HELP:
            _log.warning("! %s: %s", lane.name, self._table.problem(address, None, now))
        size = self._table.segment(address, now)
        if state is not PathState.TRYING or size is None:
            return
        self._counters.add("link.black_hole")
        if lane is not link.connection:
            link.connection.segment(size)
        lane.reset(f"large packets to {address} are not acknowledged; trying packets of {size} bytes")
