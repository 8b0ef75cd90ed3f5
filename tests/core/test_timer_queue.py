"""Timers in order, however often they are moved."""

from __future__ import annotations

import random

from rmpa.core.counters import TimerQueue


def test_the_first_is_known_and_what_is_due_comes_in_order() -> None:
    table: TimerQueue[str] = TimerQueue()
    assert table.next() is None
    for key, at in (("late", 9.0), ("b", 2.0), ("a", 2.0), ("first", 1.0)):
        table.set(key, at)
    assert table.next() == 1.0
    assert table.take(0.5) == []
    assert table.take(2.0) == ["first", "a", "b"]
    assert (table.next(), len(table)) == (9.0, 1)


def test_moved_or_cancelled_key_is_due_at_its_last_time() -> None:
    table: TimerQueue[int] = TimerQueue()
    for at in (5.0, 1.0, 3.0, 3.0):
        table.set(1, at)
    table.set(2, 2.0)
    table.set(2, None)
    assert table.next() == 3.0
    assert table.take(10.0) == [1]
    assert table.take(10.0) == []
    table.set(1, 3.0)
    assert table.take(3.0) == [1]


def test_queue_agrees_with_a_list_and_stays_small() -> None:
    rng = random.Random(5)
    table: TimerQueue[int] = TimerQueue()
    plain: dict[int, float] = {}
    for step in range(20_000):
        key, at = rng.randrange(100), rng.choice([None, step + rng.randrange(50)])
        table.set(key, at)
        if at is None:
            plain.pop(key, None)
        else:
            plain[key] = at
        assert table.next() == min(plain.values(), default=None)
        if step % 20 == 0:
            due = sorted((at, key) for key, at in plain.items() if at <= step)
            assert table.take(step) == [key for _, key in due]
            for _, key in due:
                del plain[key]
        assert len(table._heap) <= 2 * len(table) + 65
