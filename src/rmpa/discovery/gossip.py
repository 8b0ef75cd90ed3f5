"""Gossip: the GUIDs of known peers that beacons carry, and the addresses that were learnt from such beacons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rmpa.core.counters import Backoff, TimerQueue, TokenBucket
from rmpa.discovery import limits

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rmpa.core.identity import Guid
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.endpoint import PeerInstance


class GossipSelector:
    """Selects the peers that one beacon gossips about, within the room that a beacon has."""

    def __init__(self) -> None:
        self._turn = 0

    def choose(
        self, peers: Sequence[PeerInstance], to: PeerInstance | None, now: float, *, loopback: bool
    ) -> tuple[Guid, ...]:
        """GUIDs for one beacon, in order; if they are too many, the next beacon goes on where this one ends.

        Peers that have no link and were not heard lately are left out: receivers would send announcements to them for
        as long as they are mentioned.

        Args:
            peers: Those that are known.
            to: The receiver, if the beacon is a unicast; its own GUID is left out.
            now: Monotonic seconds.
            loopback: Whether the receivers can reach loopback addresses.
        """
        count = len(peers)
        start = self._turn % count if count > limits.BEACON_GOSSIP_MAX else 0
        guids: list[Guid] = []
        for number in range(start, start + count):
            peer = peers[number % count]
            if peer is to or not (peer.linked or now - peer.heard <= limits.MULTICAST_SILENCE):
                continue
            guid = peer.identity.guid
            if loopback or not guid.is_loopback:
                guids.append(guid)
                if len(guids) == limits.BEACON_GOSSIP_MAX:
                    self._turn = number + 1
                    break
        return tuple(guids)


@dataclass(slots=True)
class _Candidate:
    backoff: Backoff
    gossiped_at: float


class GossipCandidates:
    """Addresses learnt from gossip. Each gets announcements, with back-off, until it answers or gossip about it ends.

    Gossip about a dead peer ends by itself: a beacon only mentions peers that its sender has heard.

    Args:
        rng: Uniform numbers in [0, 1).
    """

    def __init__(self, rng: Callable[[], float]) -> None:
        self._rng = rng
        self._all: dict[Address, _Candidate] = {}
        self._due: TimerQueue[Address] = TimerQueue()
        self._allowed = TokenBucket(limits.CANDIDATES_PER_SECOND, limits.CANDIDATES_BURST)
        self._resume = float("-inf")

    def __contains__(self, address: Address) -> bool:
        return address in self._all

    def __len__(self) -> int:
        return len(self._all)

    def add(self, address: Address, now: float) -> bool:
        """Gossip mentions ``address``; return ``False`` if there is no room for it."""
        candidate = self._all.get(address)
        if candidate is not None:
            candidate.gossiped_at = now
            return True
        if len(self._all) >= limits.CANDIDATES_MAX:
            return False
        backoff = Backoff(limits.CANDIDATE_RETRY_FIRST, limits.CANDIDATE_RETRY_MAX, self._rng)
        self._all[address] = _Candidate(backoff, now)
        self._due.set(address, now)
        return True

    def answered(self, address: Address) -> bool:
        """Remove an address from which a packet arrived; return whether it was a candidate."""
        self._due.set(address, None)
        return self._all.pop(address, None) is not None

    def take_due(self, now: float) -> list[Address]:
        """The addresses that get an announcement now, longest wait first; those beyond the rate go on waiting."""
        due: list[Address] = []
        while now >= self._resume and (address := self._due.pop(now)) is not None:
            candidate = self._all[address]
            if now - candidate.gossiped_at >= limits.CANDIDATE_LIFETIME:
                del self._all[address]
            elif self._allowed.take(now):
                due.append(address)
                self._due.set(address, now + candidate.backoff.delay())
            else:
                self._due.set(address, now)
                self._resume = self._allowed.next(now)
        return due

    def next_timer(self) -> float | None:
        """When the next announcement is due; ``None``: never."""
        due = self._due.next()
        return None if due is None else max(due, self._resume)
