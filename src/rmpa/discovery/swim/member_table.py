"""The members that the failure detector watches, in the orders in which it needs them, and the table's hashes."""

from __future__ import annotations

import hashlib
import struct
from bisect import bisect_left, insort
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.discovery import limits
from rmpa.discovery.swim.packets import RUN_BYTES, MemberState, News

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.core.guid import Guid
    from rmpa.discovery.beacon import Address

_HASHED: Final = struct.Struct(">8sII")
_NEVER: Final = float("-inf")
_MASK: Final = 0xFFFFFFFF


@dataclass(slots=True)
class Member:
    """One run of an agent that answers probes. Times are seconds of the detector's clock.

    Args:
        guid: Its GUID.
        instance: Its instance id, 16 bytes.
        address: Where its packets go.
        state: Alive or suspect.
        incarnation: The highest number heard of it.
        version: The highest version of its offers heard of it.
        heard: When a packet of its own came last.
        rtt: The last round trip of a probe in seconds; ``None`` before the first.
        linked: Whether there is a link with it.
        suspected: When the suspicion began.
        accusers: The runs that suspect it.
    """

    guid: Guid
    instance: bytes
    address: Address
    state: MemberState = MemberState.ALIVE
    incarnation: int = 0
    version: int = 0
    heard: float = _NEVER
    rtt: float | None = None
    linked: bool = False
    suspected: float = _NEVER
    accusers: tuple[bytes, ...] = ()
    digest: int = 0
    """Its part of the hash of the table."""

    @property
    def run(self) -> bytes:
        """The beginning of its instance id, by which news names it."""
        return self.instance[:RUN_BYTES]

    def news(self, accuser: bytes = b"") -> News:
        """What there is to tell of it; with an accuser, that it is suspected."""
        state = MemberState.SUSPECT if accuser else MemberState.ALIVE
        return News(self.guid, self.run, state, self.incarnation, self.version, accuser)


class MemberTable:
    """The members by place (``Guid.place``), one run at each.

    Args:
        run: This agent's own.
        rng: Uniform numbers in [0, 1).
    """

    def __init__(self, run: bytes, rng: Callable[[], float]) -> None:
        self._own = run
        self._own_digest = 0
        self._rng = rng
        self._all: dict[int, Member] = {}
        self._ring: list[tuple[bytes, int]] = []  # by run, which is random
        self._order: list[int] = []  # of this round's probes, the next one last
        self._buckets = [0] * limits.SYNC_BUCKETS
        self.digest = 0
        """A hash of all members' runs, incarnations and versions, this agent's included; 64 bits."""

    def __len__(self) -> int:
        return len(self._all)

    def __iter__(self) -> Iterator[Member]:
        return iter(self._all.values())

    def get(self, guid: Guid, run: bytes) -> Member | None:
        """The member with this place and run, or ``None``."""
        member = self._all.get(guid.place)
        return member if member is not None and member.run == run[:RUN_BYTES] else None

    def at(self, place: int) -> Member | None:
        """The member at a place, or ``None``."""
        return self._all.get(place)

    def add(self, member: Member) -> None:
        """Add a member at a place that has none."""
        place = member.guid.place
        self._all[place] = member
        insort(self._ring, (member.run, place))
        self._order.insert(int(self._rng() * (len(self._order) + 1)), place)
        self.changed(member)

    def remove(self, member: Member) -> None:
        """Remove a member."""
        place = member.guid.place
        del self._all[place]
        del self._ring[bisect_left(self._ring, (member.run, place))]
        self._flip(member.run, member.digest)

    def changed(self, member: Member) -> None:
        """Update the hashes after the incarnation or version of a member has changed."""
        digest = _digest(member.run, member.incarnation, member.version)
        self._flip(member.run, member.digest ^ digest)
        member.digest = digest

    def own_changed(self, incarnation: int, version: int) -> None:
        """Update the hashes after this agent's own incarnation or version has changed: its own table has it too."""
        digest = _digest(self._own, incarnation, version)
        self._flip(self._own, self._own_digest ^ digest)
        self._own_digest = digest

    @property
    def buckets(self) -> tuple[int, ...]:
        """A hash of each of the table's parts; 32 bits each."""
        return tuple([bucket & _MASK for bucket in self._buckets])

    def in_buckets(self, wanted: int) -> list[Member]:
        """The members of those parts whose bits are set, in the order of the parts."""
        found = [member for member in self._all.values() if wanted >> _bucket(member.run) & 1]
        return sorted(found, key=lambda member: (_bucket(member.run), member.run))

    def next_in_turn(self) -> Member | None:
        """The next member of a random order, in which each comes once before any comes again."""
        while True:
            if not self._order:
                self._order = self._shuffled()
                if not self._order:
                    return None
            member = self._all.get(self._order.pop())
            if member is not None:
                return member

    def successor(self) -> Member | None:
        """The member that follows this agent in the order of runs, which all agents know alike."""
        if not self._ring:
            return None
        index = bisect_left(self._ring, (self._own, 0)) % len(self._ring)
        return self._all[self._ring[index][1]]

    def next_after(self, member: Member) -> Member:
        """The member that follows another one in that order; the same one if it is alone."""
        index = bisect_left(self._ring, (member.run, member.guid.place)) + 1
        return self._all[self._ring[index % len(self._ring)][1]]

    def sample(self, count: int, without: Member | None = None) -> list[Member]:
        """Up to ``count`` different members, chosen at random; ``without`` is never among them."""
        chosen: dict[int, Member] = {}
        for _ in range(3 * count):
            if len(chosen) == count or not self._ring:
                break
            member = self._all[self._ring[int(self._rng() * len(self._ring))][1]]
            if member is not without:
                chosen[member.guid.place] = member
        return list(chosen.values())

    def _flip(self, run: bytes, bits: int) -> None:
        self._buckets[_bucket(run)] ^= bits
        self.digest ^= bits

    def _shuffled(self) -> list[int]:
        order = list(self._all)
        for last in range(len(order) - 1, 0, -1):
            other = int(self._rng() * (last + 1))
            order[last], order[other] = order[other], order[last]
        return order


class GoneMembers:
    """Runs that are no members any more, or not yet, with what was last heard of each; bounded, oldest first out.

    Args:
        room: How many are remembered.
        kept: For how many seconds.
    """

    def __init__(self, room: int, kept: float) -> None:
        self._room = room
        self._kept = kept
        self._all: OrderedDict[bytes, tuple[News, float]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._all)

    def get(self, run: bytes) -> News | None:
        """What was last heard of a run, or ``None``."""
        found = self._all.get(run)
        return found[0] if found is not None else None

    def add(self, news: News, now: float) -> None:
        """Remember news of a run, in place of older news."""
        self._all[news.run] = news, now
        self._all.move_to_end(news.run)
        while len(self._all) > self._room or next(iter(self._all.values()))[1] + self._kept < now:
            self._all.popitem(last=False)

    def pop(self, run: bytes) -> News | None:
        """Forget a run; return what was last heard of it."""
        found = self._all.pop(run, None)
        return found[0] if found is not None else None

    def in_buckets(self, wanted: int, since: float) -> list[News]:
        """News of the runs of those parts whose bits are set, heard since a time."""
        return [n for n, at in self._all.values() if at >= since and wanted >> _bucket(n.run) & 1]


def _bucket(run: bytes) -> int:
    return run[0] % limits.SYNC_BUCKETS


def _digest(run: bytes, incarnation: int, version: int) -> int:
    data = _HASHED.pack(run, incarnation, version)
    return int.from_bytes(hashlib.blake2b(data, digest_size=8).digest(), "big")
