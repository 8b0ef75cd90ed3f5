"""Reliable senders whose link is gone, kept in case their receivers come back."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from rmpa.mesh import limits

if TYPE_CHECKING:
    from rmpa.mesh.reliable import ReliableSender


_Key = TypeVar("_Key", bound=Hashable)


@dataclass(slots=True)
class _Parked:
    sender: ReliableSender
    until: float
    size: int


class ResumeTable(Generic[_Key]):
    """Suspended senders by their key, which names the receiver and the source; pure.

    A sender keeps its messages for a time of its own, and only counts new ones after that. At most
    ``limits.RESUMES_MAX`` senders keep messages, of ``limits.RESUME_BYTES_MAX`` bytes together: beyond a bound the
    sender that was parked longest drops its messages. Senders that only count stay until they are claimed, at most
    ``limits.RESUMES_COUNTED_MAX``: the one that has counted longest is forgotten first. While a sender is parked, its
    messages are offered by ``offer`` of this table.
    """

    def __init__(self) -> None:
        self._parked: OrderedDict[_Key, _Parked] = OrderedDict()
        self._counting: OrderedDict[_Key, ReliableSender] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._parked) + len(self._counting)

    @property
    def pending_bytes(self) -> int:
        """Bytes kept by all parked senders."""
        return self._bytes

    def park(self, key: _Key, sender: ReliableSender, until: float) -> list[_Key]:
        """Suspend a sender and keep its messages for a while; one already parked under this key is replaced.

        Args:
            key: Its receiver and source.
            sender: The sender.
            until: When it drops its messages, monotonic seconds.

        Returns:
            The keys of senders that dropped their messages for it; its own, if it is too large for the table.
        """
        sender.suspend()
        self._remove(key)
        if sender.counting:
            self._counting[key] = sender
            return []
        self._parked[key] = _Parked(sender, until, sender.pending_bytes)
        self._bytes += sender.pending_bytes
        return self._shrink()

    def offer(self, key: _Key, payload: bytes, stamp_ns: int) -> list[_Key]:
        """Offer a message to a parked sender; without effect if there is none.

        Returns:
            The keys of senders that dropped their messages for it.
        """
        parked = self._parked.get(key)
        if parked is None:
            if (sender := self._counting.get(key)) is not None:
                sender.offer(payload, stamp_ns)
            return []
        parked.sender.offer(payload, stamp_ns)
        self._bytes += parked.sender.pending_bytes - parked.size
        parked.size = parked.sender.pending_bytes
        return self._shrink()

    def claim(self, key: _Key, epoch: int | None) -> ReliableSender | None:
        """Take out the sender of a receiver that is back, still suspended; ``None`` if there is none of this epoch.

        A sender of another epoch leaves the table too: the receiver has no use for it.
        """
        sender = self._remove(key)
        return sender if sender is not None and sender.epoch == epoch else None

    def move(self, old: _Key, new: _Key) -> None:
        """Park what is parked under one key under another one."""
        if (parked := self._parked.pop(old, None)) is not None:
            self._parked[new] = parked
        elif (sender := self._counting.pop(old, None)) is not None:
            self._counting[new] = sender

    def expire(self, now: float) -> list[_Key]:
        """Let senders whose time is over drop their messages and only count; return their keys."""
        keys = [key for key, parked in self._parked.items() if parked.until <= now]
        for key in keys:
            self._stop_keeping(key)
        return keys

    def next_timer(self) -> float | None:
        """When ``expire`` is due, in monotonic seconds."""
        return min((parked.until for parked in self._parked.values()), default=None)

    def forget(self) -> list[_Key]:
        """Forget the senders that have counted longest, beyond their bound; return their keys."""
        keys = []
        while len(self._counting) > limits.RESUMES_COUNTED_MAX:
            keys.append(self._counting.popitem(last=False)[0])
        return keys

    def _shrink(self) -> list[_Key]:
        keys = []
        while len(self._parked) > limits.RESUMES_MAX or self._bytes > limits.RESUME_BYTES_MAX:
            key = next(iter(self._parked))
            self._stop_keeping(key)
            keys.append(key)
        return keys

    def _stop_keeping(self, key: _Key) -> None:
        sender = self._remove(key)
        if sender is not None:
            sender.stop_keeping()
            self._counting[key] = sender

    def _remove(self, key: _Key) -> ReliableSender | None:
        parked = self._parked.pop(key, None)
        if parked is None:
            return self._counting.pop(key, None)
        self._bytes -= parked.size
        return parked.sender
