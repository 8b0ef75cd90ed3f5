"""Chooses the connection of an XML-RPC server to close when there are too many, or too many bytes of calls.

All clients are on this machine, so their addresses do not distinguish them. A well-behaved client is fast: it sends
its call at once and reads the answer. A port scanner, or a stuck, stopped or hostile program, sends a byte now and
then. The slowest is closed, so that ``rostopic list`` is answered beside any number of these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

_MOMENT: Final = 1e-3
"""Seconds; the least duration in the pace of a call."""


class Client(Protocol):
    """One connection."""

    @property
    def idle(self) -> bool:
        """Whether no call is being received or answered, and no answer is unread."""

    @property
    def answering(self) -> bool:
        """Whether a call is being answered: then the client is not the slow side."""

    @property
    def reserved(self) -> int:
        """Bytes reserved for the connection's call."""

    @property
    def received(self) -> int:
        """Received bytes of an unfinished call."""

    @property
    def begun(self) -> float:
        """When the call began that is unfinished, or whose answer is not read yet, in monotonic seconds."""


_C = TypeVar("_C", bound=Client)


def for_newcomer(connections: Iterable[_C], now: float) -> _C | None:
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


def for_call(connections: Iterable[_C], now: float) -> _C | None:
    """Choose the connection to close for the bytes of another call; ``None`` if none is slow."""
    slow = [one for one in connections if one.reserved and not one.answering and _is_slow(one, now)]
    return min(slow, key=lambda one: _pace(one, now), default=None)


def _is_slow(one: Client, now: float) -> bool:
    return now - one.begun > limits.HTTP_SLOW_AFTER and _pace(one, now) < limits.HTTP_PACE_MIN


def _pace(one: Client, now: float) -> float:
    """Bytes a second; 0 for a client that does not read its answer."""
    return one.received / max(now - one.begun, _MOMENT)
