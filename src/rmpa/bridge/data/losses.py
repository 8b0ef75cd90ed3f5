"""How many messages the receivers of reliable sources have missed: counted at the sender, reported to the receiver.

Pure. ``LossRecords`` belong to the sender, whose exports query them as ``KeptMessages``; ``ReceptionHistory`` is what
a receiver remembers.
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
    """Messages of a reliable source that a peer missed before a new numbering, unknown to the peer.

    Args:
        count: How many.
        at_least: Whether there may be more.
    """

    count: int
    at_least: bool = False


class KeptMessages(Protocol):
    """What the exports need of the part that keeps reliable messages."""

    def following(self, source: Source, peer: int, after: int) -> int | None:
        """The sequence of the next message of a suspended route whose peer has all up to ``after``; or ``None``."""
        ...

    def settle(self, source: Source, peer: int, epoch: int, after: int) -> Missed | None:
        """Return, once, what a peer that opens a source's route again has missed; ``None`` if unknown.

        Args:
            source: The source.
            peer: The peer's number.
            epoch: The last numbering of which it has messages; 0 if it has none.
            after: The last message of that numbering that it has.
        """
        ...


class NothingKept:
    """A ``KeptMessages`` that keeps none."""

    def following(self, source: Source, peer: int, after: int) -> int | None:  # noqa: ARG002 - as KeptMessages has it
        """Not known."""
        return None

    def settle(self, source: Source, peer: int, epoch: int, after: int) -> Missed | None:  # noqa: ARG002 - likewise
        """Not known."""
        return None


NOTHING_KEPT: Final = NothingKept()


def going_on(opened: RouteOpened, following: int | None) -> RouteOpened:
    """Add to an ``opened`` which message comes next of a numbering that goes on, if that is known."""
    return opened if following is None else msgspec.structs.replace(opened, following=following)


def beginning_anew(opened: RouteOpened, missed: Missed | None) -> RouteOpened:
    """Add to an ``opened`` what was missed before its numbering, if that is known."""
    if missed is None:
        return opened
    lost, at_least = min(missed.count, limits.LOST_TOLD_MAX), missed.at_least or msgspec.UNSET
    return msgspec.structs.replace(opened, lost=lost, at_least=at_least)


@dataclass(slots=True)
class _Record:
    """What one peer has missed of one source.

    Args:
        settled: Missed messages of numberings that are accounted for.
        ended: The last numbering that ended, if it is not accounted for yet.
        wished: Whether the peer itself ended it.
        at_least: Whether further messages were published since then, which no agent counts.
    """

    settled: int = 0
    ended: EndedNumbering | None = None
    wished: bool = False
    at_least: bool = False

    @property
    def provisional(self) -> int:
        """Missed messages of the ended numbering, as far as they are known before it is settled."""
        if self.ended is None:
            return 0
        return self.ended.seen_as_gaps if self.wished else self.ended.lost()


class LossRecords:
    """How many messages of this module's reliable sources each peer has missed.

    At most ``limits.LOSSES_REMEMBERED`` records are kept; the one whose last change is oldest is forgotten first.
    """

    def __init__(self) -> None:
        self._records: OrderedDict[tuple[int, Source], _Record] = OrderedDict()

    def __len__(self) -> int:
        return len(self._records)

    def count(self, source: Source, peer: int) -> int:
        """Messages of a source that a peer has missed, those of a numbering that goes on not included."""
        record = self._records.get((peer, source))
        return record.settled + record.provisional if record is not None else 0

    def end(self, source: Source, peer: int, ended: EndedNumbering, *, wished: bool, at_least: bool) -> None:
        """Record a numbering that has ended.

        Args:
            source: The source.
            peer: The peer's number.
            ended: The state of the numbering at its end.
            wished: Whether the peer itself closed the route.
            at_least: Whether the publisher goes on, so that further messages are missed and not counted.
        """
        record = self._records.pop((peer, source), None) or _Record()
        record.settled += record.provisional
        record.ended, record.wished, record.at_least = ended, wished, at_least
        self._put(peer, source, record)

    def settle(self, source: Source, peer: int, epoch: int, after: int, *, inherited: bool = False) -> Missed | None:
        """Settle the ended numbering of a source that a peer opens again; see ``KeptMessages``.

        Args:
            source: The source.
            peer: The peer's number.
            epoch: The last numbering of which it has messages; 0 if it has none.
            after: The last message of that numbering that it has.
            inherited: Whether the peer follows an earlier run of its module, which may have missed messages.
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
        # The peer had closed the route itself, or it no longer knows its last message.
        record.settled += ended.seen_as_gaps if record.wished or not epoch else ended.lost()
        if not record.settled:
            del self._records[peer, source]
        return None

    def inherit(self, old: int, new: int) -> None:
        """Move the records of a module's old run to its new run."""
        for peer, source in [key for key in self._records if key[0] == old]:
            self._put(new, source, self._records.pop((peer, source)))

    def unclaimed(self, peer: int) -> None:
        """Settle the records of a peer that is back and has not opened its routes again in time."""
        for (owner, source), record in list(self._records.items()):
            if owner == peer and record.ended is not None:
                record.settled += record.ended.seen_as_gaps
                record.ended = None
                if not record.settled:
                    del self._records[owner, source]

    def forget(self, peer: int) -> None:
        """Drop the records of a peer that will not come back."""
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
        topic: Its topic in the local graph.
        receiver: The position in its numbering; ``None``: a new route begins anew.
        missed: Whether there were subscribers when the route ended, so that later messages are missed.
        lost: Messages that never came.
        counts: Events of its contract, by kind.
        recent: The last events.
    """

    topic: str
    receiver: ReliableReceiver | None
    missed: bool
    lost: int
    counts: Counter[QosEventKind]
    recent: tuple[QosEvent, ...]

    def forget_position(self, *, missed: bool) -> None:
        """Forget the position, so that a new route begins anew; ``missed`` as in the class."""
        self.receiver = None
        self.missed = missed
