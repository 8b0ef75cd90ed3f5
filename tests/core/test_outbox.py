"""The outbox: bounds hold, order is kept per key, no message is torn, no byte is lost.

Here by example, and whole messages alone against a plain model; ``test_outbox_machine.py`` has all that there is.
"""

from __future__ import annotations

import time

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from rmpa.core import limits
from rmpa.core.errors import LocalProtocolError
from rmpa.core.outbox import ABORT, FIRST, LAST, URGENT, Outbox, QueuedMessage

ENTRIES = 4
BYTES = 300


def drain(box: Outbox, step: int = 1 << 30) -> bytes:
    out = b""
    while box:
        head = b"".join(box.head())[:step]
        assert head
        out += head
        box.consumed(len(head))
    return out


def test_in_order_with_urgent_first_behind_what_was_begun() -> None:
    box = Outbox(10, 1000)
    box.push_rest(b"half", 1)
    box.push(b"data", 1)
    box.push_urgent(b"now")
    assert box.pending_bytes == 11
    assert drain(box, 3) == b"halfnowdata"
    assert box.pending_bytes == box.waiting_entries == 0


def test_the_oldest_of_the_same_key_goes_first() -> None:
    box = Outbox(2, 1000)
    box.push(b"other", 2)
    assert [box.push(b"%d" % i, 1) for i in range(4)] == [0, 0, 1, 1]
    assert drain(box) == b"other23"
    assert box.dropped == {1: 2}


def test_a_flood_does_not_push_commands_out() -> None:
    box = Outbox(1000, 10_000)
    for i in range(5):
        box.push(b"cmd%d" % i, 1)
    for _ in range(20):
        box.push(bytes(3000), 2)
    assert box.push(b"cmd5", 1) in (0, 1)
    assert box.dropped[1] == 0
    assert b"".join(box.head()).count(b"cmd") == 6


def test_one_message_always_fits() -> None:
    box = Outbox(10, 100)
    box.push(b"a", 1)
    assert box.push(bytes(5000), 2) == 1
    assert len(drain(box)) == 5000


def test_an_entry_half_sent_is_never_dropped() -> None:
    box = Outbox(1, 100)
    box.push(b"abcdef", 1)
    box.consumed(3)
    box.push(b"gone", 1)
    box.push(b"kept", 1)
    assert box.discard(1) == 1
    assert drain(box) == b"def"


def test_what_is_dropped_is_freed() -> None:
    box = Outbox(10, 1 << 20)
    box.push(b"in front", 99)
    for _ in range(10_000):
        box.push(bytes(100), 1)
    assert sum(p.held for f in box._queues.values() for p in f.messages) == box.pending_bytes == 1008
    assert box.waiting_entries == 11


def test_dropping_stays_cheap_with_many_keys() -> None:
    def cost(keys: int) -> float:
        box = Outbox(2, 1 << 30)
        for key in range(keys):
            box.push(b"x", key)
            box.push(b"x", key)
        started = time.perf_counter()
        for _ in range(2000):
            box.push(b"x", 0)
        return time.perf_counter() - started

    assert min(cost(4000) for _ in range(3)) < 20 * min(cost(10) for _ in range(3)) + 0.01


def test_nothing_is_nothing() -> None:
    box = Outbox(1, 1)
    assert box.push(b"", 1) == 0
    box.push_urgent(b"")
    box.push_rest(b"", 1)
    assert not box
    assert box.head() == []
    box.consumed(0)


def test_out_of_turn_is_our_own_fault() -> None:
    box = Outbox(1, 1)
    with pytest.raises(LocalProtocolError):
        box.consumed(1)
    box.push(b"x", 1)
    with pytest.raises(LocalProtocolError):
        box.push_rest(b"y", 1)


def test_clear_lets_go_and_keeps_the_counts() -> None:
    box = Outbox(1, 10)
    box.push(b"a", 1)
    box.push(b"b", 1)
    box.push_urgent(b"u")
    box.consumed(0)
    box.clear()
    assert not box
    assert box.pending_bytes == box.urgent_bytes == 0
    assert box.dropped == {1: 1}


# --- in turns and in parts ----------------------------------------------------------------------------------------


def flags_of(parcel: QueuedMessage, length: int, flags: int) -> bytes:
    """A header that can be read in a test: ``<7:3F`` is the first fragment of route 7, 3 bytes."""
    letters = "".join(letter for letter, flag in (("F", FIRST), ("L", LAST), ("A", ABORT)) if flags & flag)
    return f"<{parcel.key}:{length}{letters}>".encode()


def framed(**bounds: int) -> Outbox:
    return Outbox(bounds.get("entries", 10), bounds.get("max_bytes", 1000), frame=flags_of, fragment=4)


def test_messages_of_several_keys_take_turns() -> None:
    box = Outbox(10, 1000)
    for key in (1, 2, 3):
        for number in range(3):
            box.push(b"%d%d " % (key, number), key)
    box.push_urgent(b"now ")
    assert drain(box) == b"now 10 20 30 11 21 31 12 22 32 "


def test_small_message_is_sent_between_fragments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "COMMIT_BYTES", 1)  # nothing is prepared beyond what leaves
    box = framed()
    large = QueuedMessage(1, 10)
    box.extend(large, b"0123456789")
    assert b"".join(box.head()) == b"<1:4F>0123"
    box.push(b"small", 2)
    box.push_urgent(b"!")
    assert drain(box) == b"<1:4F>0123!<1:4>4567small<1:2L>89"
    assert large.sent == large.size


def test_message_without_bytes_does_not_block_others() -> None:
    box = framed()
    growing = QueuedMessage(1, 9)
    box.extend(growing, b"abc")
    assert drain(box) == b"<1:3F>abc"
    assert not box
    assert box.waiting(1) == 1
    box.push(b"other", 2)
    box.push(b"later", 1)
    assert drain(box) == b"other", "the next of its key waits for the rest"
    box.extend(QueuedMessage(3, 1), b"x")
    growing_rest = b"defghi"
    with pytest.raises(LocalProtocolError, match="9 bytes"):
        box.extend(growing, growing_rest + b"j")


def test_later_bytes_of_a_message_stay_behind_its_first() -> None:
    """A leg sends the parts of one message in one go; this is what keeps the model honest."""
    box = framed()
    growing = QueuedMessage(1, 6)
    box.extend(growing, b"abc")
    box.extend(growing, b"def")
    box.push(b"next", 1)
    assert drain(box) == b"<1:4F>abcd<1:2L>efnext"


def test_small_pieces_are_joined_into_full_fragments() -> None:
    box = framed()
    parcel = QueuedMessage(1, 10)
    for byte in b"0123456789":
        box.extend(parcel, bytes([byte]))
    assert drain(box) == b"<1:4F>0123<1:4>4567<1:2L>89"


def test_without_a_framer_bytes_leave_as_they_are() -> None:
    box = Outbox(10, 1000, fragment=4)
    parcel = QueuedMessage(1, 10)
    box.extend(parcel, b"0123456")
    box.push_urgent(b"!")
    assert drain(box) == b"!0123456"
    box.extend(parcel, b"789")
    assert drain(box) == b"789"


def test_a_message_that_was_not_begun_is_abandoned_without_a_word() -> None:
    box = framed()
    parcel = QueuedMessage(1, 10)
    box.extend(parcel, b"0123")
    assert box.abandon(parcel) is False
    assert not box
    assert box.pending_bytes == box.waiting(1) == 0
    assert box.extend(parcel, b"4567") == 0
    assert not box


def test_one_that_was_begun_is_abandoned_with_a_word_once() -> None:
    box = framed()
    parcel = QueuedMessage(1, 10)
    box.extend(parcel, b"012345")
    box.head(2)
    assert box.abandon(parcel) is False
    assert box.abandon(parcel) is False
    box.extend(parcel, b"6789")
    assert drain(box) in (b"<1:4F>0123<1:0LA>", b"<1:4F>0123<1:2>45<1:0LA>")
    assert box.pending_bytes == 0


def test_without_a_framer_nobody_can_be_told() -> None:
    box = Outbox(10, 1000)
    parcel = QueuedMessage(1, 10)
    box.extend(parcel, b"012345")
    drain(box)
    assert box.abandon(parcel) is True
    assert box.abandon(parcel) is False


def test_a_closed_route_aborts_what_it_began() -> None:
    box = framed()
    parcel = QueuedMessage(1, 10)
    box.extend(parcel, b"0123456789")
    box.push(b"behind", 1)
    box.consumed(len(b"<1:4F>0123"))
    assert box.discard(1) == 2
    assert parcel.dropped
    assert drain(box).endswith(b"<1:0LA>")
    assert box.pending_bytes == 0


def test_a_growing_message_that_was_dropped_is_dropped_for_good() -> None:
    box = framed(entries=1)
    old = QueuedMessage(1, 10)
    box.extend(old, b"0123")
    assert box.push(b"new", 1) == 1
    assert old.dropped
    assert box.extend(old, b"456789") == 0
    assert drain(box) == b"new"
    assert box.dropped == {1: 1}


def test_what_grows_pushes_others_out_but_never_itself() -> None:
    box = framed(max_bytes=20)
    box.push(bytes(15), 2)
    growing = QueuedMessage(1, 40)
    assert box.extend(growing, bytes(4)) == 0
    assert box.extend(growing, bytes(30)) == 1
    assert box.dropped == {2: 1}
    assert not growing.dropped


def test_marks_are_never_dropped_and_push_nothing_out() -> None:
    box = framed(entries=2, max_bytes=20)
    box.push(b"old", 1)
    for number in range(30):
        assert box.push(b"[%02d]" % number, 1, pinned=True) == 0
    for number in range(5):
        box.push(b"m%d" % number, 1)
    assert drain(box) == b"".join(b"[%02d]" % n for n in range(30)) + b"m3m4"
    assert box.dropped == {1: 4}
    assert [box.push(b"m%d" % number, 1) for number in range(3)] == [0, 0, 1], "marks that left count no more"


# --- terms of a key -----------------------------------------------------------------------------------------------


def test_expired_entries_are_dropped_but_the_newest_is_sent() -> None:
    box = Outbox(10, 1000)
    box.set_terms(1, 10, 0.5)
    for tenth in range(4):
        box.push(b"%d" % tenth, 1, now=1.0 + tenth / 10)
    assert b"".join(box.head(now=1.55)) == b"123"
    box.push(b"x", 2, now=9.0)
    box.clear()
    for tenth in range(4):
        box.push(b"%d" % tenth, 1, now=1.0 + tenth / 10)
    assert b"".join(box.head(now=99.0)) == b"3"
    assert box.expired == {1: 4}
    assert not box.dropped


def test_a_lifespan_holds_for_the_newest_too() -> None:
    box = Outbox(10, 1000)
    box.set_terms(1, 10, 0.5, strict=True)
    box.push(b"a", 1, now=1.0)
    box.push(b"b", 1, now=1.2)
    assert box
    assert box.head(now=2.0) == []
    assert not box
    assert box.pending_bytes == 0
    assert box.expired == {1: 2}


def test_what_was_begun_and_marks_never_grow_too_old() -> None:
    box = framed()
    box.set_terms(1, 10, 0.5, strict=True)
    begun = QueuedMessage(1, 6, born=1.0)
    box.extend(begun, b"abc")
    assert b"".join(box.head(now=1.1)) == b"<1:3F>abc"
    box.extend(begun, b"def")
    box.push(b"[]", 1, now=1.2, pinned=True)
    box.push(b"old", 1, now=1.2)
    box.consumed(len(b"<1:3F>abc"))
    assert b"".join(box.head(now=9.0)) == b"<1:3L>def[]"


def test_terms_hold_for_what_waits_already_and_end_with_the_route() -> None:
    box = Outbox(1, 1000)
    box.push(b"a", 1)
    box.set_terms(1, 3)
    assert [box.push(b"%d" % n, 1) for n in range(3)] == [0, 0, 1]
    box.discard(1)
    assert [box.push(b"%d" % n, 1) for n in range(2)] == [0, 1]


# --- another connection -------------------------------------------------------------------------------------------


def test_reset_drops_begun_entries_and_keeps_the_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(limits, "COMMIT_BYTES", 1)
    box = framed()
    torn, whole = QueuedMessage(1, 8), QueuedMessage(2, 8)
    box.extend(torn, b"01234567")
    box.head()
    box.extend(whole, b"abcdefgh")
    box.push(b"one", 1)
    box.push(b"[]", 2, pinned=True)
    box.push_urgent(b"bye of the old one")
    box.consumed(3)
    assert box.reset() == 1
    assert torn.dropped
    assert not whole.dropped
    assert box.pending_bytes == len(b"one") + len(b"abcdefgh") + len(b"[]")
    box.prepend(b"hello ")
    assert drain(box) in (b"hello <2:4F>abcdone<2:4L>efgh[]", b"hello one<2:4F>abcd<2:4L>efgh[]")
    assert box.reset() == 0


def test_a_message_that_waits_for_its_next_bytes_is_torn_too() -> None:
    box = framed()
    parcel = QueuedMessage(1, 8)
    box.extend(parcel, b"0123")
    drain(box)
    assert box.reset() == 1
    assert box.extend(parcel, b"4567") == 0
    assert not box
    assert box.waiting(1) == 0


# --- whole messages against a model -------------------------------------------------------------------------------


class AgainstModel(RuleBasedStateMachine):
    """Each message is its key and number, so that the wire can be read back."""

    def __init__(self) -> None:
        super().__init__()
        self.box = Outbox(ENTRIES, BYTES)
        self.number = 0
        self.newest = 0
        self.wire = b""
        self.pushed = 0
        self.discarded = 0

    def message(self, key: int, size: int) -> bytes:
        self.number += 1
        self.pushed += 1
        body = b"%d:%d:" % (key, self.number)
        return body + b"." * size + b"\n"

    @rule(key=st.integers(0, 3), size=st.integers(0, 400))
    def push(self, key: int, size: int) -> None:
        message = self.message(key, size)
        before = sum(self.box.dropped.values())
        dropped = self.box.push(message, key)
        self.newest = len(message)
        assert sum(self.box.dropped.values()) - before == dropped

    @rule(size=st.integers(0, 50))
    def urgent(self, size: int) -> None:
        self.box.push_urgent(self.message(URGENT, size))

    @rule(key=st.integers(0, 3))
    def discard(self, key: int) -> None:
        self.discarded += self.box.discard(key)

    @rule(count=st.integers(0, 500), parts=st.integers(1, 5))
    def send(self, count: int, parts: int) -> None:
        head = b"".join(self.box.head(parts))[:count]
        self.box.consumed(len(head))
        self.wire += head

    @invariant()
    def bounds_hold(self) -> None:
        assert self.box._data_bytes <= max(BYTES, self.newest)
        assert all(0 < len(f.messages) <= ENTRIES for f in self.box._queues.values())
        assert all(f.size == sum(p.held for p in f.messages if not p.sent) for f in self.box._queues.values())
        assert bool(self.box) == bool(self.box.pending_bytes)
        assert sorted(self.box._round_robin) == sorted(k for k, f in self.box._queues.items() if f.scheduled)

    def teardown(self) -> None:
        self.wire += drain(self.box)
        lines = self.wire.split(b"\n")
        assert lines.pop() == b""
        last: dict[bytes, int] = {}
        for line in lines:
            key, number, _ = line.split(b":")
            assert int(number) > last.get(key, 0), "order is kept per key"
            last[key] = int(number)
        assert len(lines) + sum(self.box.dropped.values()) + self.discarded == self.pushed


TestAgainstModel = AgainstModel.TestCase
TestAgainstModel.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)


def test_a_spared_key_loses_nothing_to_the_bound_of_all_keys() -> None:
    box = Outbox(10, 20)
    box.set_terms(1, 1000, spared=True)
    for _ in range(10):
        box.push(bytes(10), 1)
    assert box.push(bytes(15), 2) == 0
    assert box.push(bytes(15), 2) == 1
    assert box.dropped == {2: 1}
    assert len(drain(box)) == 115
