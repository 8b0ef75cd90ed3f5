"""Rates of unicast beacons: answers, and the heartbeats of peers that multicast does not reach."""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import TYPE_CHECKING

from rmpa.core.token_bucket import TokenBucket
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.discovery.beacon import Address
    from rmpa.discovery.endpoint import PeerInstance


class AnswerLimit:
    """At most one answer to an address in ``ANSWER_INTERVAL``, and ``ANSWERS_PER_SECOND`` over all addresses."""

    def __init__(self) -> None:
        self._last: OrderedDict[Address, float] = OrderedDict()
        self._second = float("-inf")
        self._count = 0

    def allows(self, address: Address, now: float) -> bool:
        """Whether an answer may be sent to an address now; if so, it is counted as sent."""
        if now - self._last.get(address, float("-inf")) < limits.ANSWER_INTERVAL:
            return False
        if now - self._second >= 1.0:
            self._second = now
            self._count = 0
        if self._count >= limits.ANSWERS_PER_SECOND:
            return False
        self._count += 1
        self._last[address] = now
        self._last.move_to_end(address)
        if len(self._last) > limits.ANSWER_ADDRESSES_MAX:
            self._last.popitem(last=False)
        return True


class UnicastHeartbeats:
    """Selects the peers that get a unicast heartbeat: all verified ones, a few of the others (they may be forged)."""

    def __init__(self) -> None:
        self._turn = 0
        rate = limits.UNICAST_HEARTBEATS_PER_SECOND
        self._allowed = TokenBucket(rate, rate * limits.HEARTBEAT_INTERVAL)
        self._waiting: deque[PeerInstance] = deque()
        self.at: float | None = None
        """When ``take_some`` has peers to return; ``None``: the queue is empty."""

    def choose(self, peers: Sequence[PeerInstance], now: float) -> tuple[list[PeerInstance], bool]:
        """The peers that get a heartbeat now, unverified ones in turn from call to call; whether they are all."""
        chosen = [peer for peer in peers if peer.verified]
        others = [peer for peer in peers if not peer.verified]
        start = self._turn % len(others) if others else 0
        for peer in others[start:] + others[:start]:
            if not self._allowed.take(now):
                return chosen, False
            chosen.append(peer)
            self._turn = (self._turn + 1) % len(others)
        return chosen, True

    def plan(self, peers: Sequence[PeerInstance], now: float) -> bool:
        """Queue heartbeats for the peers that ``choose`` selects; return whether these are all of ``peers``."""
        chosen, complete = self.choose(peers, now)
        waiting = set(map(id, self._waiting))
        self._waiting += [peer for peer in chosen if id(peer) not in waiting]
        self.at = now if self._waiting else None
        return complete

    def take_some(self) -> list[PeerInstance]:
        """Take the next peers out of the queue, so few that sending to them does not delay other work."""
        few = [self._waiting.popleft() for _ in range(min(limits.UNICAST_HEARTBEATS_AT_ONCE, len(self._waiting)))]
        if not self._waiting:
            self.at = None
        return few
