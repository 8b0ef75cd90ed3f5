"""The outbox against a plain model: bounds hold, order is kept per key, no message is torn, no byte is lost."""

from __future__ import annotations

import time

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from rmpa.core.errors import LocalProtocolError
from rmpa.core.outbox import URGENT, Outbox

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
    assert box.pending_entries == 3
    assert drain(box, 3) == b"halfnowdata"
    assert box.pending_bytes == box.pending_entries == 0


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
    assert sum(p.held for f in box._flows.values() for p in f.parcels) == box.pending_bytes == 1008
    assert box.pending_entries == 11


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
        assert all(0 < len(f.parcels) <= ENTRIES for f in self.box._flows.values())
        assert all(f.size == sum(p.held for p in f.parcels if not p.sent) for f in self.box._flows.values())
        assert bool(self.box) == bool(self.box.pending_bytes)
        assert sorted(self.box._turns) == sorted(k for k, f in self.box._flows.items() if f.turning)

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
