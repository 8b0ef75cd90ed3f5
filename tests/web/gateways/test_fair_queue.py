from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rmpa.web.gateways.frame_writer import FairQueue


def _all(queue: FairQueue[str]) -> list[str]:
    found = []
    while (entry := queue.pop()) is not None:
        found.append(entry)
    return found


def test_subscriptions_take_turns_however_many_messages_one_has() -> None:
    queue: FairQueue[str] = FairQueue()
    for number in range(3):
        queue.push(1, f"map{number}", 10)
    queue.push(2, "state", 1)
    assert _all(queue) == ["map0", "state", "map1", "map2"]


def test_higher_priorities_go_first_and_what_is_urgent_before_all() -> None:
    queue: FairQueue[str] = FairQueue()
    queue.push(1, "low", 1, priority=-1)
    queue.push(2, "normal", 1)
    queue.push(3, "high", 1, priority=1)
    queue.push(None, "answer", 1)
    assert _all(queue) == ["answer", "high", "normal", "low"]


def test_a_full_subscription_drops_its_oldest_and_keeps_its_newest() -> None:
    queue: FairQueue[str] = FairQueue(total_bytes=100, subscription_bytes=10)
    for entry, size in (("a", 6), ("b", 6), ("c", 50)):
        queue.push(1, entry, size)
    assert queue.dropped == {1: 2}
    assert _all(queue) == ["c"]


def test_images_do_not_push_out_small_state() -> None:
    queue: FairQueue[str] = FairQueue(total_bytes=100, subscription_bytes=100)
    queue.push(1, "state", 1)
    for number in range(10):
        queue.push(2, f"image{number}", 30)
    assert queue.bytes <= 100
    assert queue.dropped == {2: 7}
    assert _all(queue) == ["state", "image7", "image8", "image9"] or queue.dropped[1] == 0


def test_low_priority_gives_way_to_high() -> None:
    queue: FairQueue[str] = FairQueue(total_bytes=10, subscription_bytes=10)
    queue.push(1, "low", 8, priority=-1)
    queue.push(2, "high", 8, priority=1)
    queue.push(1, "low2", 8, priority=-1)
    assert _all(queue) == ["high"]
    assert queue.dropped == {1: 2}


def test_one_message_larger_than_the_bound_is_sent() -> None:
    queue: FairQueue[str] = FairQueue(total_bytes=10, subscription_bytes=5)
    queue.push(1, "small", 3)
    queue.push(2, "huge", 100)
    assert _all(queue) == ["huge"]


def test_what_is_urgent_is_never_dropped_and_its_overflow_shows() -> None:
    queue: FairQueue[str] = FairQueue(total_bytes=10, subscription_bytes=10)
    queue.push(1, "message", 8)
    queue.push(None, "one", 6)
    before = queue.overflow
    queue.push(None, "two", 6)
    assert (before, queue.overflow) == (False, True)
    assert _all(queue) == ["one", "two"]
    assert queue.dropped == {1: 1}


def test_what_an_ended_subscription_had_is_not_sent() -> None:
    queue: FairQueue[str] = FairQueue()
    queue.push(1, "a", 1)
    queue.push(2, "b", 1)
    queue.end(1)
    queue.end(7)
    assert queue.bytes == 1
    assert _all(queue) == ["b"]
    assert queue.pop() is None


@given(
    st.lists(
        st.one_of(
            st.tuples(st.integers(0, 4), st.integers(0, 60), st.integers(-1, 1)), st.just("pop"), st.integers(1, 4)
        )
    )
)
def test_bytes_are_counted_and_bounded_and_order_is_kept(steps: list[tuple[int, int, int] | str | int]) -> None:
    queue: FairQueue[tuple[int, int]] = FairQueue(total_bytes=100, subscription_bytes=50)
    inside: dict[tuple[int, int], int] = {}
    last: dict[int, int] = {}
    for number, step in enumerate(steps):
        if isinstance(step, tuple):
            handle, size, priority = step
            queue.push(handle or None, (handle, number), size, priority)
            inside[handle, number] = size
        elif isinstance(step, int):
            queue.end(step)
        elif (entry := queue.pop()) is not None:
            assert entry[1] > last.get(entry[0], -1)
            last[entry[0]] = entry[1]
        assert queue.bytes <= 100 or queue.overflow or sum(queue.waiting.values()) == 1
    while (entry := queue.pop()) is not None:
        assert entry in inside
    assert queue.bytes == 0
    assert queue.pop() is None
