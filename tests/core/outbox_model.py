"""What an outbox must do, said plainly: lists, no accounts; and what its wire must look like, read back by frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core import limits
from rmpa.core.outbox import ABORT, FIRST, LAST, Outbox, QueuedMessage
from rmpa.mesh.frames import Frame, FrameKind, pack_data_header, pack_fragment_header, unpack_header

if TYPE_CHECKING:
    from collections.abc import Iterable

HEADER = 24
FRAGMENT = 64
_RING = bytes(range(256))


def payload(number: int, size: int, offset: int = 0) -> bytes:
    """Bytes that tell whose they are, and where they belong."""
    start = (number * 31 + offset) & 0xFF
    return (_RING * (size // 256 + 2))[start : start + size]


def whole(key: int, number: int, size: int) -> bytes:
    """A message in one frame, as a lane sends small ones."""
    return pack_data_header(size, key, number, size) + payload(number, size)


def fence(key: int, number: int) -> bytes:
    return Frame(FrameKind.FENCE, route=key, sequence=number).serialize()


@dataclass
class Entry:
    """One message, mark or parcel that was put in."""

    key: int
    number: int
    size: int
    born: float
    pinned: bool = False
    parcel: QueuedMessage | None = None
    given: int = 0
    """Bytes put in so far, of a framed one without headers."""
    begun: bool = False
    left: int = 0
    """Bytes that were committed, as given."""
    fate: str = "waits"

    @property
    def held(self) -> int:
        return self.given - self.left

    @property
    def counts(self) -> bool:
        """Whether it counts against the bounds, and may be dropped."""
        return not self.begun and not self.pinned


@dataclass
class Reader:
    """One connection's bytes, read back frame by frame; asserts that they can be.

    Args:
        longest: Bytes of a fragment at the most; a message in one frame may be longer.
    """

    longest: int = FRAGMENT
    pending: bytes = b""
    begun: dict[int, tuple[int, int, int]] = field(default_factory=dict)
    """By route: the number and size of the message that is coming, and how much of it has come."""
    last: dict[tuple[int, int], int] = field(default_factory=dict)

    def feed(self, data: bytes) -> list[tuple[int, int, int, int, str]]:
        """``(kind, route, number, bytes of payload, what)`` of each further whole frame."""
        self.pending += data
        read = []
        while len(self.pending) >= HEADER:
            length, kind, flags, _, route, number, stamp = unpack_header(self.pending, 0)
            if len(self.pending) < HEADER + length:
                break
            body, self.pending = self.pending[HEADER : HEADER + length], self.pending[HEADER + length :]
            read.append((kind, route, number, length, self._frame(kind, flags, route, number, stamp, body)))
        return read

    def _frame(self, kind: int, flags: int, route: int, number: int, size: int, body: bytes) -> str:
        if kind in {FrameKind.HELLO, FrameKind.PING}:
            return "whole"
        if kind != FrameKind.DATA:
            self._in_order(kind, route, number)
            assert route not in self.begun, "a mark in the middle of a message of its route"
            return "whole"
        if flags & FIRST:
            assert route not in self.begun, "a message within a message of its route"
            self._in_order(kind, route, number)
            self.begun[route] = (number, size, 0)
        assert self.begun[route][:2] == (number, size), "a fragment of another message"
        got = self.begun[route][2]
        assert body == payload(number, len(body), got)
        got += len(body)
        self.begun[route] = (number, size, got)
        if flags & ABORT:
            assert not body
            del self.begun[route]
            return "aborted"
        assert 0 < len(body) <= self.longest or flags & (FIRST | LAST) == FIRST | LAST
        assert (got == size) == bool(flags & LAST)
        if flags & LAST:
            del self.begun[route]
            return "whole"
        return "part"

    def _in_order(self, kind: int, route: int, number: int) -> None:
        key = (kind if kind == FrameKind.CONTROL else 0, route)
        assert number > self.last.get(key, 0), "order is kept per key, marks among the messages"
        self.last[key] = number


class Model:
    """The same as an outbox, in lists; it is told what the outbox did, and says whether that was right.

    Args:
        box: The outbox, with ``FRAGMENT`` and the mesh's framer.
        entries: Its bound for each key.
        max_bytes: Its bound over all.
    """

    def __init__(self, box: Outbox, entries: int, max_bytes: int) -> None:
        self.box = box
        self.max_bytes = max_bytes
        self.terms: dict[int, tuple[int, float | None, bool]] = {}
        self.entries = entries
        self.flows: dict[int, list[Entry]] = {}
        self.outside: dict[tuple[int, int], Entry] = {}
        """Whole entries whose first bytes the driver sent without asking the outbox."""
        self.urgent: list[Entry] = []
        self.reader = Reader()
        self.seen = b""
        """What was committed on this connection and is known here."""
        self.consumed = 0
        self.in_flight: list[tuple[int, Entry]] = []
        """Entries whose last byte was committed, with the place of their end on this connection."""
        self.asked_at = self.standstill_end = 0.0
        self.newest = 0
        self.served: dict[int, set[int]] = {}
        self.drops = dict(box.dropped)
        self.expiries = dict(box.expired)

    # --- putting in -----------------------------------------------------------------------------------------

    def bounds(self, key: int) -> tuple[int, float | None, bool]:
        return self.terms.get(key, (self.entries, None, False))

    def enter(self, entry: Entry, count: int, dropped: int) -> None:
        """So many bytes of an entry, its first or further ones, were put in."""
        before = sum(e.held for e in self.waiting() if e.counts)
        flow = self.flows.get(entry.key, [])
        others = sum(not e.pinned for e in flow)
        full = entry not in flow and not entry.pinned and others >= self.bounds(entry.key)[0]
        drops = self.take_drops()
        assert sum(drops.values()) == dropped
        for key, number in drops.items():
            need = (key == entry.key and full) or before + count * entry.counts > self.max_bytes
            assert need, "dropped without need"
            self.drop_oldest(key, number, entry)
        entry.given += count
        if entry not in flow:
            self.flows.setdefault(entry.key, []).append(entry)
        self.newest = entry.held * entry.counts
        loose = sum(e.counts for e in self.flows[entry.key])
        assert loose <= max(self.bounds(entry.key)[0], 1) or not full
        self.ready()

    def drop_oldest(self, key: int, count: int, newest: Entry) -> None:
        for _ in range(count):
            entry = next(e for e in self.flows[key] if e.counts)
            assert entry is not newest, "the newest always fits"
            entry.fate = "dropped"
            self.flows[key].remove(entry)
        self.ready()

    def take_drops(self) -> dict[int, int]:
        now = dict(self.box.dropped)
        counts = {k: n - self.drops.get(k, 0) for k, n in now.items() if n != self.drops.get(k, 0)}
        self.drops = now
        return counts

    def remove(self, entries: Iterable[Entry], fate: str) -> None:
        for entry in list(entries):
            entry.fate = fate
            self.flows[entry.key].remove(entry)
        self.ready()

    def waiting(self) -> list[Entry]:
        return [entry for flow in self.flows.values() for entry in flow]

    def ready(self) -> None:
        """Who has bytes for a turn."""
        for key in list(self.flows):
            if not self.flows[key]:
                del self.flows[key]
        can = {key for key, flow in self.flows.items() if flow[0].held}
        for key in can - self.served.keys():
            self.served[key] = set()
        for key in self.served.keys() - can:
            del self.served[key]

    # --- taking out -----------------------------------------------------------------------------------------

    def asked(self, now: float) -> None:
        """The driver asks for the head: ages begin anew behind a standstill."""
        if now - self.asked_at > limits.STANDSTILL:
            self.standstill_end = now
        self.asked_at = now

    def age(self, entry: Entry, now: float, *, strict: bool) -> float:
        return now - (entry.born if strict else max(entry.born, self.standstill_end))

    def look(self, now: float) -> None:
        """The outbox was asked for its head: what it has committed since the last time."""
        committed = b"".join(self.box._committed)
        known = len(self.seen) - self.consumed
        assert self.seen[self.consumed :] == committed[:known], "what was committed stays"
        self.read(committed[known:], now)
        for key in list(self.flows):
            while self._too_old(key, now):
                pass
        assert not self.budget(), "expired without need"
        self.ready()

    def read(self, fresh: bytes, now: float) -> None:
        """So many more bytes are on their way on this connection."""
        at = len(self.seen) - len(self.reader.pending)
        self.seen += fresh
        for kind, route, number, length, what in self.reader.feed(fresh):
            at += HEADER + length
            entry = self.outside.get((route, number)) if kind == FrameKind.DATA else None
            if kind == FrameKind.CONTROL:
                entry = self.urgent.pop(0)
                assert entry.number == number
            elif entry is not None and what != "aborted":
                entry.left += length
            elif kind != FrameKind.HELLO and what != "aborted":
                self._turn(route, number, length, what, at, now)
            if entry is not None and what == "whole":
                self.in_flight.append((at, entry))
                self.outside.pop((route, number), None)
        self.ready()

    def _turn(self, key: int, number: int, length: int, what: str, at: int, now: float) -> None:
        assert not self.urgent, "urgent entries go in front"
        while self.flows[key][0].number != number and self._too_old(key, now):
            pass
        entry = self.flows[key][0]
        assert entry.number == number, "the oldest of the key leaves first"
        for other, since in list(self.served.items()):
            if other != key and key in since:
                while self._too_old(other, now):
                    pass  # its turn came, and all that it had was too old
                self.ready()
                assert other not in self.served, f"{key} had two turns while {other} waited"
            elif other != key:
                since.add(key)
        self.served[key] = set()
        if not entry.begun:
            self._begin(entry, now)
        entry.left += length if entry.parcel is not None else entry.given
        if what == "whole":
            assert entry.left == entry.size
            self.flows[key].pop(0)
            self.in_flight.append((at, entry))
        self.ready()

    def _begin(self, entry: Entry, now: float) -> None:
        entry.begun = True
        _, max_age, strict = self.bounds(entry.key)
        if max_age is not None and not entry.pinned and (strict or len(self.flows[entry.key]) > 1):
            assert self.age(entry, now, strict=strict) <= max_age, "too old to leave"

    def budget(self) -> dict[int, int]:
        """How many entries the outbox says were too old, by key, and are not known here."""
        counts = {key: count - self.expiries.get(key, 0) for key, count in self.box.expired.items()}
        return {key: count for key, count in counts.items() if count}

    def _too_old(self, key: int, now: float) -> bool:
        """Whether the outbox dropped the key's oldest for its age; then it had to be."""
        if not self.budget().get(key):
            return False
        entry = self.flows[key].pop(0)
        _, max_age, strict = self.bounds(key)
        assert entry.counts, "what was begun, and marks, are never too old"
        assert max_age is not None
        assert self.age(entry, now, strict=strict) > max_age, "not yet too old"
        assert strict or self.flows[key], "the newest leaves, however old"
        entry.fate = "expired"
        self.expiries[key] = self.expiries.get(key, 0) + 1
        return True

    def sent(self, count: int) -> None:
        """So many more bytes have left."""
        self.consumed += count
        for end, entry in list(self.in_flight):
            if end <= self.consumed:
                entry.fate = "left"
                self.in_flight.remove((end, entry))

    def cut(self) -> int:
        """The connection is gone; how many entries that had bytes still to come it tore."""
        for _, entry in self.in_flight:
            entry.fate = "torn"
        for entry in [*self.outside.values(), *self.urgent]:
            entry.fate = "torn"
        torn = [entry for entry in self.waiting() if entry.begun]
        self.remove(torn, "torn")
        self.urgent.clear()
        self.outside.clear()
        self.in_flight.clear()
        self.reader = Reader()
        self.seen = b""
        self.consumed = 0
        self.served.clear()
        self.ready()
        return len(torn)

    # --- what must be ---------------------------------------------------------------------------------------

    def check(self) -> None:
        """The accounts are right, and within the bounds."""
        box = self.box
        waiting = self.waiting()
        counted = sum(e.held for e in waiting if e.counts)
        others = sum(e.held for e in waiting if not e.counts)
        urgent = sum(e.given for e in self.urgent)
        committed = sum(map(len, box._committed))
        assert box._committed_bytes == committed
        assert box.urgent_bytes == urgent
        assert box._data_bytes == counted
        assert box.pending_bytes == committed + urgent + counted + others
        assert counted <= max(self.max_bytes, self.newest)
        assert set(box._queues) == set(self.flows), "a key without entries is forgotten"
        for key, flow in self.flows.items():
            assert box.waiting(key) == len(flow)
            assert box._queues[key].size == sum(e.held for e in flow if e.counts)
        ready = sorted(key for key, flow in self.flows.items() if flow[0].held)
        assert sorted(box._round_robin) == ready == sorted(self.served)
        assert bool(box) == bool(committed or self.urgent or ready)
        assert box.waiting_entries == sum(not entry.pinned for entry in waiting)


def make_box(entries: int, max_bytes: int) -> Outbox:
    return Outbox(entries, max_bytes, frame=pack_fragment_header, fragment=FRAGMENT)
