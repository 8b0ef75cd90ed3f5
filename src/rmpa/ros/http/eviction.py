"""Chooses the connection of an XML-RPC server to close when there are too many, or too many bytes of calls.

All clients are on this machine, so their addresses do not distinguish them. A well-behaved client is fast: it sends
its call at once and reads the answer. A port scanner, or a stuck, stopped or hostile program, sends a byte now and
then. The slowest is closed, so that ``rostopic list`` is answered beside any number of these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.ros.http.connection import HttpConnection

_MOMENT: Final = 1e-3
"""Seconds; the least duration in the pace of a call."""


def for_newcomer(connections: Iterable[HttpConnection], now: float) -> HttpConnection | None:
    """Choose the connection to close for a new one; ``None`` if all are being answered.

    It is the slowest of those below ``limits.HTTP_PACE_MIN``; else the one that is idle for longest, whose client
    reconnects by itself; else the slowest of all.

    Args:
        connections: In the order of their last use.
        now: Monotonic seconds.
    """
    stalled, idle = [], None
    for one in connections:
        if one.idle:
            idle = idle or one
        elif not one.answering:
            stalled.append(one)
    slow = [one for one in stalled if _is_slow(one, now)]
    if idle is not None and not slow:
        return idle
    return min(slow or stalled, key=lambda one: _pace(one, now), default=None)


def for_call(connections: Iterable[HttpConnection], now: float) -> HttpConnection | None:
    """Choose the connection to close for the bytes of another call; ``None`` if none is slow."""
    slow = [one for one in connections if one.reserved and not one.answering and _is_slow(one, now)]
    return min(slow, key=lambda one: _pace(one, now), default=None)


def _is_slow(one: HttpConnection, now: float) -> bool:
    return now - one.begun > limits.HTTP_SLOW_AFTER and _pace(one, now) < limits.HTTP_PACE_MIN


def _pace(one: HttpConnection, now: float) -> float:
    """Bytes a second; 0 for a client that does not read its answer."""
    return one.received / max(now - one.begun, _MOMENT)
