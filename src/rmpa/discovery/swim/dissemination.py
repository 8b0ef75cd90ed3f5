"""Makes the packets that one failure detector sends, with the news that they carry. Sans-I/O."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rmpa.discovery import limits
from rmpa.discovery.swim.events import SendSwim
from rmpa.discovery.swim.news_queue import NewsQueue
from rmpa.discovery.swim.packets import RUN_BYTES, MemberState, News, SwimKind, SwimPacket, room_for_news

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.guid import Guid
    from rmpa.core.identity import Identity
    from rmpa.discovery.beacon import Address
    from rmpa.discovery.swim.member_table import Member, MemberTable


class Dissemination:
    """Makes the packets of one failure detector. Each carries this agent's own state, and news while there is some.

    Args:
        identity: This agent's own.
        table: The members.
        rng: Uniform numbers in [0, 1).
    """

    def __init__(self, identity: Identity, table: MemberTable, rng: Callable[[], float]) -> None:
        self._own = identity
        self._run = identity.instance[:RUN_BYTES]
        self._table = table
        self._rng = rng
        self._queue = NewsQueue()
        self._outputs: list[SendSwim] = []
        self.active = False
        """Whether this agent probes, and spreads news."""
        self.incarnation = 0
        """How often this agent refuted a suspicion."""
        self.version = 0
        """The version of what this agent offers."""
        self.at: float | None = None
        """When ``gossip`` is due; ``None``: never."""
        table.own_changed(0, 0)

    @property
    def waiting(self) -> int:
        """The number of news that is being spread."""
        return len(self._queue)

    def take(self) -> list[SendSwim]:
        """The packets to send, in order; each is returned once."""
        taken, self._outputs = self._outputs, []
        return taken

    def spread(self, news: News, now: float) -> None:
        """Send news with each packet, and in packets of its own, until it has reached all in all likelihood."""
        if self.active:
            self._queue.add(news)
            if self.at is None:
                self.at = now + limits.GOSSIP_INTERVAL * self._rng()

    def spread_own(self, now: float) -> None:
        """Spread this agent's own incarnation and version, of which one has changed."""
        self._table.own_changed(self.incarnation, self.version)
        self.spread(self._own_news(MemberState.ALIVE), now)
        if self.at is not None:
            self.at = now

    def leave(self) -> None:
        """Send some members the news that this agent leaves."""
        self._queue.add(self._own_news(MemberState.LEFT))
        for member in self._table.sample(limits.LEAVE_FANOUT):
            self.send(SwimKind.NEWS, member.address, to=member)

    def stop(self) -> None:
        """Drop all news, and gossip no more until there is other news."""
        self.at = None
        self._queue = NewsQueue()

    def gossip(self, now: float) -> None:
        """Send the news to some members in packets of its own."""
        for member in self._table.sample(limits.GOSSIP_FANOUT):
            if len(self._queue):
                self.send(SwimKind.NEWS, member.address, to=member)
        self.at = now + limits.GOSSIP_INTERVAL if len(self._queue) and len(self._table) else None

    def send(
        self,
        kind: SwimKind,
        address: Address,
        *,
        to: Member | None = None,
        sequence: int = 0,
        subject: tuple[Guid, bytes] | None = None,
        buckets: tuple[int, ...] = (),
        ended: News | None = None,
    ) -> None:
        """Send a packet.

        Args:
            kind: What it is for.
            address: Where it goes.
            to: The member that it goes to, which gets news: first of all, if it is suspected, that it is. ``None``:
                the packet goes to an agent that is no member, and has no news.
            sequence: The packet's ``sequence``.
            subject: The packet's ``subject``.
            buckets: The packet's ``buckets``.
            ended: The news that the receiver, which is no member here, has failed: it may refute that.
        """
        news: list[News] = []
        if ended is not None:
            news.append(ended)
        elif to is not None:
            if to.state is MemberState.SUSPECT:
                news.append(to.news(self._run))
            if self.active and len(self._queue):
                limit = limits.NEWS_SENT_FACTOR * math.ceil(math.log10(len(self._table) + 2))
                news += self._queue.take(room_for_news(kind) - sum(n.size for n in news), limit)
        self._emit(kind, address, sequence=sequence, subject=subject, buckets=buckets, news=tuple(news))

    def send_table(self, to: Member, parts: int, wanted: int, ended: list[News]) -> None:
        """Send parts of the table.

        Args:
            to: The member that it goes to.
            parts: A bit for each part that is sent.
            wanted: A bit for each part that is wanted in return.
            ended: The members of these parts that have failed or left lately.
        """
        entries = [self._own_news(MemberState.ALIVE), *(m.news() for m in self._table.in_buckets(parts)), *ended]
        size = room_for_news(SwimKind.TABLE) // entries[0].size
        for start in range(0, min(len(entries), size * limits.SYNC_PACKETS_MAX), size):
            self._emit(SwimKind.TABLE, to.address, news=tuple(entries[start : start + size]), wanted=wanted)
            wanted = 0

    def _own_news(self, state: MemberState) -> News:
        return News(self._own.guid, self._run, state, self.incarnation, self.version)

    def _emit(
        self,
        kind: SwimKind,
        address: Address,
        *,
        sequence: int = 0,
        subject: tuple[Guid, bytes] | None = None,
        buckets: tuple[int, ...] = (),
        news: tuple[News, ...] = (),
        wanted: int = 0,
    ) -> None:
        own = self._own
        packet = SwimPacket(
            kind,
            own.guid,
            own.instance,
            own.domain,
            sequence,
            self._table.digest,
            self.incarnation,
            self.version,
            self.active,
            subject,
            news,
            buckets,
            wanted,
        )
        self._outputs.append(SendSwim(packet, address))
