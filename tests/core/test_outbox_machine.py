"""The outbox against a plain model, by everything that a driver may do to it; its wire is read back by frame."""

from __future__ import annotations

from unittest import mock

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rmpa.core import limits
from rmpa.core.outbox import FIRST, LAST, QueuedMessage
from rmpa.mesh.frames import Frame, FrameKind, pack_fragment_header
from tests.core.outbox_model import FRAGMENT, Entry, Model, fence, make_box, payload, whole

ENTRIES = 4
BYTES = 600
KEYS = st.integers(1, 4)


class AgainstModel(RuleBasedStateMachine):
    """A driver that does what ``Stream`` and ``LaneSender`` do, in any order that they may."""

    def __init__(self) -> None:
        super().__init__()
        self.small = mock.patch.object(limits, "COMMIT_BYTES", 150)
        self.small.start()
        self.box = make_box(ENTRIES, BYTES)
        self.model = Model(self.box, ENTRIES, BYTES)
        self.now = 100.0
        self.numbers = 0
        self.open: dict[int, Entry] = {}
        self.entries: list[Entry] = []

    # --- putting in -----------------------------------------------------------------------------------------

    def entry(self, key: int, size: int, *, pinned: bool = False) -> Entry:
        self.numbers += 1
        made = Entry(key, self.numbers, size, self.now, pinned)
        self.entries.append(made)
        return made

    @rule(key=KEYS, size=st.integers(1, 500))
    def push(self, key: int, size: int) -> None:
        if key in self.open:
            return
        entry = self.entry(key, size + 24)
        data = whole(key, entry.number, size)
        self.model.enter(entry, len(data), self.box.push(data, key, self.now))

    @rule(key=KEYS)
    def mark(self, key: int) -> None:
        if key in self.open:
            return
        entry = self.entry(key, 24, pinned=True)
        data = fence(key, entry.number)
        self.model.enter(entry, len(data), self.box.push(data, key, self.now, pinned=True))

    @rule(size=st.integers(0, 50))
    def urgent(self, size: int) -> None:
        entry = self.entry(0, size)
        data = Frame(FrameKind.CONTROL, bytes(size), sequence=entry.number).serialize()
        entry.given = len(data)
        self.box.push_urgent(data)
        self.model.urgent.append(entry)

    @rule(key=KEYS, size=st.integers(1, 500))
    def begin(self, key: int, size: int) -> None:
        if key in self.open:
            return
        entry = self.open[key] = self.entry(key, size)
        entry.parcel = QueuedMessage(key, size, entry.number, size, self.now)

    @rule(key=KEYS, size=st.integers(1, 200))
    def extend(self, key: int, size: int) -> None:
        entry = self.open.get(key)
        if entry is None or entry.parcel is None:
            return
        size = min(size, entry.size - entry.given)
        data = payload(entry.number, entry.size)[entry.given : entry.given + size]
        gone = entry.fate != "waits"
        assert entry.parcel.dropped == gone
        dropped = self.box.extend(entry.parcel, data)
        if gone:
            assert not dropped
            entry.given += size
        else:
            self.model.enter(entry, size, dropped)
        if entry.given == entry.size:
            del self.open[key]

    @rule(key=KEYS)
    def abandon(self, key: int) -> None:
        entry = self.open.pop(key, None)
        if entry is None or entry.parcel is None:
            return
        assert not self.box.abandon(entry.parcel), "with a framer the other side can always be told"
        if entry.fate == "waits":
            if entry in self.model.flows.get(key, []):
                self.model.remove([entry], "abandoned")
            entry.fate = "abandoned"

    @rule(key=KEYS)
    def discard(self, key: int) -> None:
        if (entry := self.open.get(key)) is not None and entry not in self.model.flows.get(key, []):
            self.abandon(key)
        waiting = self.model.flows.get(key, [])
        assert self.box.discard(key) == len(waiting)
        self.model.remove(waiting, "discarded")
        self.model.terms.pop(key, None)
        self.open.pop(key, None)

    @rule(
        key=KEYS,
        entries=st.integers(1, 6),
        age=st.one_of(st.none(), st.sampled_from([0.5, 2.0])),
        strict=st.booleans(),
    )
    def set_terms(self, key: int, entries: int, age: float | None, strict: bool) -> None:
        self.box.set_terms(key, entries, age, strict=strict)
        self.model.terms[key] = (entries, age, strict)

    # --- what a driver sends without asking -----------------------------------------------------------------

    @precondition(lambda self: not self.box)
    @rule(key=KEYS, size=st.integers(1, 300), sent=st.integers(0, 400))
    def send_at_once(self, key: int, size: int, sent: int) -> None:
        """A socket that takes a whole message in part."""
        if key in self.open:
            return
        entry = self.entry(key, size)
        data = whole(key, entry.number, size)
        entry.given = size
        self._take_directly(entry, data, sent)

    @precondition(lambda self: not self.box)
    @rule(key=KEYS, sent=st.integers(0, 200), size=st.integers(1, 2 * FRAGMENT))
    def send_part_at_once(self, key: int, sent: int, size: int) -> None:
        """Likewise the next bytes of a message whose bytes before have left."""
        entry = self.open.get(key)
        if entry is None or entry.parcel is None or self.box.waiting(key) or entry.fate != "waits":
            return
        parcel = entry.parcel
        size = min(size, entry.size - entry.given)
        data = b""
        while size:
            length = min(FRAGMENT, size)
            flags = FIRST * (not parcel.sent) | LAST * (parcel.sent + length == parcel.size)
            part = payload(entry.number, entry.size)[entry.given : entry.given + length]
            data += pack_fragment_header(parcel, length, flags) + part
            parcel.sent += length
            entry.given += length
            size -= length
        entry.begun = True
        self._take_directly(entry, data, sent)
        if entry.given == entry.size:
            del self.open[key]

    def _take_directly(self, entry: Entry, data: bytes, sent: int) -> None:
        self.model.outside[entry.key, entry.number] = entry
        self.model.read(data[:sent], self.now)
        self.model.sent(len(data[:sent]))
        self.box.push_rest(data[sent:])
        self.model.look(self.now)
        self.model.outside.clear()

    # --- taking out -----------------------------------------------------------------------------------------

    @rule(count=st.integers(0, 500), parts=st.integers(1, 8))
    def send(self, count: int, parts: int) -> None:
        self.model.asked(self.now)
        head = b"".join(self.box.head(parts, self.now))[:count]
        self.model.look(self.now)
        self.box.consumed(len(head))
        self.model.sent(len(head))

    @rule(seconds=st.sampled_from([0.1, 0.25, 0.6, 3.0]))
    def wait(self, seconds: float) -> None:
        self.now += seconds

    @rule(hello=st.integers(0, 30))
    def lose_the_connection(self, hello: int) -> None:
        for key, entry in list(self.open.items()):
            if entry.parcel is not None and entry.begun and entry not in self.model.flows.get(key, []):
                entry.parcel.dropped = True  # the lane does this: the outbox does not know of it
                entry.fate = "torn"
        assert self.box.reset() == self.model.cut()
        self.box.prepend(Frame(FrameKind.HELLO, bytes(hello)).serialize())

    # --- what must be ---------------------------------------------------------------------------------------

    @invariant()
    def accounts(self) -> None:
        self.model.check()

    def teardown(self) -> None:
        try:
            for key in list(self.open):
                self.abandon(key)
            while self.box:
                before = self.model.consumed
                self.send(200, 3)
                assert self.model.consumed > before or not self.box, "what waits leaves"
                self.model.check()
            self.model.look(self.now)
            assert self.box.pending_bytes == 0
            assert not self.model.reader.pending
            assert not self.model.reader.begun, "no half message stays on the wire"
            assert {entry.fate for entry in self.entries} <= {
                "left",
                "dropped",
                "expired",
                "abandoned",
                "discarded",
                "torn",
            }
        finally:
            self.small.stop()


TestAgainstModel = AgainstModel.TestCase
TestAgainstModel.settings = settings(max_examples=250, stateful_step_count=50, deadline=None)
