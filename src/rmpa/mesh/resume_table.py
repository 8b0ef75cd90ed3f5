"""Reliable senders whose link is gone, kept in case their receivers come back."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from rmpa.mesh import limits

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rmpa.mesh.reliable import ReliableSender


_Key = TypeVar("_Key", bound=Hashable)


@dataclass(slots=True)
class _Parked:
    sender: ReliableSender
    until: float
    size: int


class ResumeTable(Generic[_Key]):
    """Suspended senders by their key, which names the receiver and the source; pure.

    Each sender stays for a time of its own. At most ``limits.RESUMES_MAX`` senders stay, with
    ``limits.RESUME_BYTES_MAX`` bytes together: beyond a bound the sender that was parked longest leaves the table.
    While a sender is parked, its messages are offered by ``offer`` of this table.
    """

    def __init__(self) -> None:
        self._parked: OrderedDict[_Key, _Parked] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._parked)

    @property
    def pending_bytes(self) -> int:
        """Bytes kept by all parked senders."""
        return self._bytes

    def park(self, key: _Key, sender: ReliableSender, until: float) -> list[_Key]:
        """Suspend a sender and keep its messages for a while; one already parked under this key is replaced.

        Args:
            key: Its receiver and source.
            sender: The sender.
            until: When it leaves the table, monotonic seconds.

        Returns:
            The keys of senders that left the table for it; its own, if it is too large for the table.
        """
        sender.suspend()
        self.claim(key)
        self._parked[key] = _Parked(sender, until, sender.pending_bytes)
        self._bytes += sender.pending_bytes
        return self._shrink()

    def offer(self, key: _Key, payload: bytes, stamp_ns: int) -> list[_Key]:
        """Offer a message to a parked sender; without effect if there is none.

        Returns:
            The keys of senders that left the table for it.
        """
        parked = self._parked.get(key)
        if parked is None:
            return []
        parked.sender.offer(payload, stamp_ns)
        self._bytes += parked.sender.pending_bytes - parked.size
        parked.size = parked.sender.pending_bytes
        return self._shrink()

    def claim(self, key: _Key) -> ReliableSender | None:
        """Take out a sender, still suspended; ``None`` if there is none."""
        parked = self._parked.pop(key, None)
        if parked is None:
            return None
        self._bytes -= parked.size
        return parked.sender

    def limit(self, keys: Iterable[_Key], until: float) -> None:
        """Let the parked senders of these keys leave the table at ``until``, if not before."""
        for key in keys:
            if (parked := self._parked.get(key)) is not None:
                parked.until = min(parked.until, until)

    def expire(self, now: float) -> list[_Key]:
        """Take out the senders whose time is over; return their keys."""
        keys = [key for key, parked in self._parked.items() if parked.until <= now]
        for key in keys:
            self.claim(key)
        return keys

    def next_timer(self) -> float | None:
        """When ``expire`` is due, in monotonic seconds."""
        return min((parked.until for parked in self._parked.values()), default=None)

    def _shrink(self) -> list[_Key]:
        keys = []
        while len(self._parked) > limits.RESUMES_MAX or self._bytes > limits.RESUME_BYTES_MAX:
            keys.append(next(iter(self._parked)))
            self.claim(keys[-1])
        return keys
