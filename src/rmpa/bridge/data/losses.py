"""What the receivers of reliable sources have missed: counted at the sender, told to the receiver.

Pure. ``LossRecords`` are the sender's, asked by the exports as ``KeptMessages``; ``ReceptionHistory`` is what a
receiver remembers.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

import msgspec

from rmpa.mesh import limits

if TYPE_CHECKING:
    from collections import Counter

    from rmpa.bridge.data.qos_events import QosEvent, QosEventKind
    from rmpa.bridge.messages import RouteOpened, Source
    from rmpa.mesh.reliable import EndedNumbering, ReliableReceiver


@dataclass(frozen=True, slots=True)
class Missed:
    """What a peer has missed of a reliable source before a new numbering, and does not know of.

    Args:
        count: Messages.
        at_least: Whether there may be more.
    """

    count: int
    at_least: bool = False


class KeptMessages(Protocol):
    """What the exports ask of those who keep reliable messages."""

    def following(self, source: Source, peer: int, after: int) -> int | None:
        """The sequence of the next message of a suspended route, if its peer has all up to ``after``."""
        ...

    def settle(self, source: Source, peer: int, epoch: int, after: int) -> Missed | None:
        """A peer asks for a source anew: count what it missed until now, once; ``None``: that is not known.

        Args:
            source: Which.
            peer: Who.
            epoch: The last numbering that it has a part of; 0 if it has none.
            after: The last message of that which it has.
        """
        ...


class NothingKept:
    """No messages are kept: for exports alone."""

    def following(self, source: Source, peer: int, after: int) -> int | None:  # noqa: ARG002 - as Kept has it
        """Not known."""
        return None

    def settle(self, source: Source, peer: int, epoch: int, after: int) -> Missed | None:  # noqa: ARG002 - likewise
        """Not known."""
        return None


NOTHING_KEPT: Final = NothingKept()


def going_on(opened: RouteOpened, following: int | None) -> RouteOpened:
    """Say in an ``opened`` which message comes next of a numbering that goes on, if that is known."""
    return opened if following is None else msgspec.structs.replace(opened, following=following)


def beginning_anew(opened: RouteOpened, missed: Missed | None) -> RouteOpened:
    """Say in an ``opened`` what was missed before its numbering, if that is known."""
    if missed is None:
        return opened
    lost, at_least = min(missed.count, limits.LOST_TOLD_MAX), missed.at_least or msgspec.UNSET
    return msgspec.structs.replace(opened, lost=lost, at_least=at_least)


@dataclass(slots=True)
class _Record:
    """What one peer has missed of one source.

    Args:
        settled: Messages of numberings that are over and accounted for.
        ended: The last numbering that ended without that, if one did.
        wished: Whether the peer itself ended it.
        at_least: Whether messages were published since that nobody counts.
    """

    settled: int = 0
    ended: EndedNumbering | None = None
    wished: bool = False
    at_least: bool = False

    @property
    def provisional(self) -> int:
        """Messages of the ended numbering, as far as is known."""
        if self.ended is None:
            return 0
        return self.ended.seen_as_gaps if self.wished else self.ended.lost()


class LossRecords:
    """What peers have missed of this module's reliable sources, for as long as is remembered.

    At most ``limits.LOSSES_REMEMBERED`` of them; the one that was changed first is forgotten first.
    """

    def __init__(self) -> None:
        self._records: OrderedDict[tuple[int, Source], _Record] = OrderedDict()

    def __len__(self) -> int:
        return len(self._records)

    def count(self, source: Source, peer: int) -> int:
        """Messages that a peer has missed of a source, those of a numbering that goes on left out."""
        record = self._records.get((peer, source))
        return record.settled + record.provisional if record is not None else 0

    def end(self, source: Source, peer: int, ended: EndedNumbering, *, wished: bool, at_least: bool) -> None:
        """A numbering has ended.

        Args:
            source: Of what.
            peer: To whom.
            ended: What is left of it.
            wished: Whether the peer ended it.
            at_least: Whether its publisher goes on, and nobody counts.
        """
        record = self._records.pop((peer, source), None) or _Record()
        record.settled += record.provisional
        record.ended, record.wished, record.at_least = ended, wished, at_least
        self._put(peer, source, record)

    def settle(self, source: Source, peer: int, epoch: int, after: int, *, inherited: bool = False) -> Missed | None:
        """A peer asks for a source anew; see ``KeptMessages``.

        Args:
            source: Which.
            peer: Who.
            epoch: The last numbering that it has a part of; 0 if it has none.
            after: The last message of that which it has.
            inherited: Whether it follows another run of its module, which may have missed something.
        """
        record = self._records.get((peer, source))
        if record is None or record.ended is None:
            return None
        ended, record.ended = record.ended, None
        if ended.epoch == epoch:
            record.settled += ended.lost(after)
            return Missed(ended.unseen(after), record.at_least)
        if inherited and not epoch and not record.wished:
            record.settled += ended.lost()
            return Missed(ended.unseen(), record.at_least)
        # It did not want what it has not got, or it has forgotten what it had.
        record.settled += ended.seen_as_gaps if record.wished or not epoch else ended.lost()
        if not record.settled:
            del self._records[peer, source]
        return None

    def inherit(self, old: int, new: int) -> None:
        """A module has another run: what the old one missed is that one's matter from now on."""
        for peer, source in [key for key in self._records if key[0] == old]:
            self._put(new, source, self._records.pop((peer, source)))

    def unclaimed(self, peer: int) -> None:
        """A peer that was away has not asked for what it missed: nobody there wants that."""
        for (owner, source), record in list(self._records.items()):
            if owner == peer and record.ended is not None:
                record.settled += record.ended.seen_as_gaps
                record.ended = None
                if not record.settled:
                    del self._records[owner, source]

    def forget(self, peer: int) -> None:
        """A peer will not come back."""
        for key in [key for key in self._records if key[0] == peer]:
            del self._records[key]

    def _put(self, peer: int, source: Source, record: _Record) -> None:
        self._records[peer, source] = record
        if len(self._records) > limits.LOSSES_REMEMBERED:
            self._records.popitem(last=False)


@dataclass(slots=True)
class ReceptionHistory:
    """What is known of a reliable source from before its present route.

    Args:
        topic: Its topic here.
        receiver: Where its numbering stands; ``None``: nothing goes on from there.
        missed: Whether somebody listened when the route ended, so that what came since is missed.
        lost: Messages that never came.
        counts: What happened to its contract, by kind.
        recent: The last of that.
    """

    topic: str
    receiver: ReliableReceiver | None
    missed: bool
    lost: int
    counts: Counter[QosEventKind]
    recent: tuple[QosEvent, ...]

    def forget_position(self, *, missed: bool) -> None:
        """The numbering means nothing any more."""
        self.receiver = None
        self.missed = missed
