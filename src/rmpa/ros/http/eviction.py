"""Which connection of an XML-RPC server gives way when there are too many, or too many bytes of calls are held.

All clients are of this machine, so addresses tell nothing. What tells a well-behaved one is its pace: it sends its
call at once and reads the answer, while a port scanner, a stuck or stopped program or a hostile one sends a byte now
and then. The slowest gives way, so that ``rostopic list`` is answered beside any number of these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from rmpa.ros import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

_MOMENT: Final = 1e-3
"""Seconds; the first bytes of a call are never slow."""


class Client(Protocol):
    """One connection, as far as the choice needs it."""

    @property
    def idle(self) -> bool:
        """Whether no call is on its way in, none is being answered and no answer is on its way out."""

    @property
    def answering(self) -> bool:
        """Whether a call has come and is being answered: it is not the client that is slow."""

    @property
    def reserved(self) -> int:
        """Bytes set aside for its call."""

    @property
    def received(self) -> int:
        """Bytes of an unfinished call that have come."""

    @property
    def begun(self) -> float:
        """When the call that is unfinished, or whose answer is not read, began, monotonic seconds."""


_C = TypeVar("_C", bound=Client)


def for_newcomer(connections: Iterable[_C], now: float) -> _C | None:
    """The connection to close for a new one; ``None`` if all are being answered.

    The slowest of those that are slow beyond doubt; else the one that is idle for longest, whose client connects anew
    without a word; else the slowest of all.

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
    """The connection to close for the bytes of another call; ``None`` if none is slow."""
    slow = [one for one in connections if one.reserved and not one.answering and _is_slow(one, now)]
    return min(slow, key=lambda one: _pace(one, now), default=None)


def _is_slow(one: Client, now: float) -> bool:
    return now - one.begun > limits.HTTP_SLOW_AFTER and _pace(one, now) < limits.HTTP_PACE_MIN


def _pace(one: Client, now: float) -> float:
    """Bytes a second; 0 for a client that does not read its answer."""
    return one.received / max(now - one.begun, _MOMENT)
