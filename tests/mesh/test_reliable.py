"""Reliable delivery: each message once, in order, or counted as lost, however often links fall."""

from __future__ import annotations

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rmpa.mesh import limits
from rmpa.mesh.reliable import ACK_DELAY, ReliableReceiver, ReliableSender, ResumeTable
from tests.mesh.reliable_pair import MASK, Bounds, Pair, number_of, payload, taken

FIRSTS = (1, 0, MASK, MASK - 5, (1 << 31) - 3)
"""Where the numbering begins: also such that it wraps, or crosses the half, within a test."""


def sender(depth: int = 100, max_bytes: int = 10_000, window: int = 10, window_bytes: int = 10_000) -> ReliableSender:
    return ReliableSender(depth, max_bytes, window, window_bytes, epoch=7)


def fill(machine: ReliableSender, count: int, size: int = 0) -> None:
    for number in range(count):
        machine.offer(payload(number, size), number)


def numbers(machine: ReliableSender, most: int | None = None) -> list[int]:
    return [number_of(message.payload) for message in taken(machine, most)]


# --- the sender -----------------------------------------------------------------------------------------------


# --- the receiver ---------------------------------------------------------------------------------------------


def test_lost_lane_is_replayed_from_the_acknowledgement() -> None:
    machine = sender(depth=4)
    fill(machine, 4)
    taken(machine)
    machine.acknowledged(1)
    machine.offer(payload(4), 0)
    machine.offer(payload(5), 0)
    machine.rewind()
    assert machine.overflowed == 1
    assert numbers(machine, 1) == [2]
    machine.acknowledged(4)  # it was on its way, over the other lane
    assert numbers(machine) == [4, 5]
    machine.suspend()
    machine.rewind()
    assert taken(machine) == []


def test_without_a_first_sequence_no_gap_is_claimed() -> None:
    receiver = ReliableReceiver()
    assert receiver.gap(500, 7) == 0
    assert receiver.position() is None
    assert receiver.accept(500, 7, 0.0) == 0
    assert receiver.accept(502, 7, 0.0) == 1
    assert receiver.position() == (7, 502)


def test_it_acknowledges_after_a_delay() -> None:
    receiver = ReliableReceiver(7, first=1)
    assert receiver.next_timer() is None
    assert receiver.due_ack(1e9) is None
    receiver.accept(1, 7, 50.0)
    receiver.accept(2, 7, 50.005)
    assert receiver.next_timer() == 50.0 + ACK_DELAY
    assert receiver.due_ack(50.009) is None
    assert receiver.due_ack(50.0 + ACK_DELAY) == 2
    assert receiver.due_ack(60.0) is None
    receiver.accept(3, 7, 60.0)
    assert receiver.next_timer() == 60.0 + ACK_DELAY


def test_many_messages_or_bytes_are_acknowledged_at_once() -> None:
    receiver = ReliableReceiver(7, first=1)
    for sequence in range(1, limits.ACK_MESSAGES + 1):
        assert receiver.due_ack(0.0) is None
        receiver.accept(sequence, 7, 0.0)
    assert receiver.due_ack(0.0) == limits.ACK_MESSAGES
    receiver.accept(33, 7, 0.0, limits.ACK_BYTES - 1)
    assert receiver.due_ack(0.0) is None
    receiver.accept(34, 7, 0.0, 1)
    assert receiver.due_ack(0.0) == 34
    receiver.accept(35, 7, 0.0, 1)
    assert receiver.due_ack(0.0) is None


# --- parked senders -------------------------------------------------------------------------------------------


def parked(
    table: ResumeTable[str], key: str, *, count: int = 2, until: float = 30.0
) -> tuple[ReliableSender, list[str]]:
    machine = sender()
    fill(machine, count)
    taken(machine)
    return machine, table.park(key, machine, until)


def test_the_number_of_those_that_keep_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "RESUMES_MAX", 2)
    table: ResumeTable[str] = ResumeTable()
    assert [parked(table, key)[1] for key in "abcd"] == [[], [], ["a"], ["b"]]
    assert (len(table), table.pending_bytes) == (2, 16)


def test_table_bytes_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "RESUME_BYTES_MAX", 100)
    table: ResumeTable[str] = ResumeTable()
    for key in "abc":
        parked(table, key)
    assert table.offer("c", bytes(76), 0) == []
    assert table.pending_bytes == 100
    assert table.offer("c", bytes(1), 0) == ["a"]
    assert table.offer("a", bytes(1000), 0) == []
    assert table.offer("c", bytes(1000), 0) == ["b", "c"]
    assert (len(table), table.pending_bytes) == (0, 0)
    assert parked(table, "d", count=26)[1] == ["d"]


def test_parked_sender_keeps_its_own_bounds() -> None:
    table: ResumeTable[str] = ResumeTable()
    machine = sender(depth=3)
    table.park("a", machine, 30.0)
    for number in range(10):
        assert table.offer("a", payload(number), 0) == []
    assert table.pending_bytes == machine.pending_bytes == 12
    assert table.claim("a") is machine
    machine.resume(0)
    assert numbers(machine) == [7, 8, 9]


# --- every interleaving ---------------------------------------------------------------------------------------


class EveryInterleaving(RuleBasedStateMachine):
    """Anything may happen at any time; ``Pair`` compares it with what must be."""

    @initialize(
        depth=st.sampled_from([8, 1000, 20, 1000, 3, 1]),
        max_bytes=st.sampled_from([1 << 20, 1 << 20, 300, 60]),
        window=st.sampled_from([5, 100, 2, 1]),
        window_bytes=st.sampled_from([1 << 20, 100, 20]),
        first=st.sampled_from(FIRSTS),
        says_first=st.sampled_from([True, True, True, False]),
    )
    def begin(self, depth: int, max_bytes: int, window: int, window_bytes: int, first: int, says_first: bool) -> None:
        self.pair = Pair(Bounds(depth, max_bytes, window, window_bytes, first), says_first=says_first)

    @rule(sizes=st.lists(st.integers(0, 60), min_size=1, max_size=8))
    def offer(self, sizes: list[int]) -> None:
        for size in sizes:
            self.pair.offer(size)

    @rule(sizes=st.lists(st.integers(0, 60), min_size=1, max_size=8), pieces=st.integers(1, 3))
    def offer_and_send(self, sizes: list[int], pieces: int) -> None:
        for size in sizes:
            self.pair.offer(size)
            self.pair.send(None, pieces)

    @rule(most=st.sampled_from([None, None, 1, 2]), pieces=st.integers(1, 3))
    def send(self, most: int | None, pieces: int) -> None:
        self.pair.send(most, pieces)

    @precondition(lambda self: self.pair.data)
    @rule(count=st.integers(1, 12))
    def arrive(self, count: int) -> None:
        for _ in range(min(count, len(self.pair.data))):
            self.pair.arrive()

    @precondition(lambda self: self.pair.ghosts)
    @rule(count=st.integers(1, 6))
    def haunt(self, count: int) -> None:
        for _ in range(min(count, len(self.pair.ghosts))):
            self.pair.haunt()

    @rule(seconds=st.sampled_from([0.0, 0.004, 0.01, 0.02]))
    def tick(self, seconds: float) -> None:
        self.pair.tick(seconds)

    @precondition(lambda self: self.pair.acks)
    @rule()
    def hear(self) -> None:
        self.pair.hear()

    @precondition(lambda self: self.pair.linked and self.pair.data)
    @rule(ghosts=st.integers(0, 8), again=st.booleans())
    def cut_under_way(self, ghosts: int, again: bool) -> None:
        self.pair.cut(ghosts)
        if again:
            self.pair.resume()

    @rule()
    def hesitate(self) -> None:
        self.pair.hesitate()

    @precondition(lambda self: self.pair.linked and self.pair.data)
    @rule()
    def lose_lane(self) -> None:
        self.pair.lose_lane()

    @precondition(lambda self: self.pair.linked)
    @rule()
    def cut(self) -> None:
        self.pair.cut(0)

    @precondition(lambda self: not self.pair.linked)
    @rule()
    def resume(self) -> None:
        self.pair.resume()

    @rule()
    def drain(self) -> None:
        self.pair.drain()

    @rule(what=st.sampled_from(["nothing", "nothing", "nothing", "sender", "receiver"]))
    def begin_anew(self, what: str) -> None:
        if what == "sender":
            self.pair.fresh_sender()
        elif what == "receiver":
            self.pair.fresh_receiver()

    @invariant()
    def agrees(self) -> None:
        if hasattr(self, "pair"):
            self.pair.check()

    def teardown(self) -> None:
        if hasattr(self, "pair"):
            self.pair.drain()


TestEveryInterleaving = EveryInterleaving.TestCase
TestEveryInterleaving.settings = settings(max_examples=200, stateful_step_count=50, deadline=None)
