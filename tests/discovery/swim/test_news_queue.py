"""The queue of news: order, number of sendings, what replaces what, and its bound."""

from __future__ import annotations

import random

from rmpa.core.guid import Guid
from rmpa.discovery import limits
from rmpa.discovery.swim.news_queue import NewsQueue
from rmpa.discovery.swim.packets import MemberState, News


def news(number: int, state: MemberState = MemberState.ALIVE, accuser: bytes = b"", incarnation: int = 0) -> News:
    run = number.to_bytes(8, "big")
    return News(Guid.of(f"10.0.{number // 200}.{1 + number % 200}", 4000), run, state, incarnation, 0, accuser)


def test_what_was_sent_least_often_goes_first() -> None:
    queue = NewsQueue()
    queue.add(news(1))
    queue.add(news(2))
    assert queue.take(30, 9) == [news(1)]
    assert queue.take(30, 9) == [news(2)]
    queue.add(news(3))
    assert queue.take(60, 9) == [news(3), news(1)]


def test_news_is_sent_a_number_of_times_and_then_dropped() -> None:
    queue = NewsQueue()
    queue.add(news(1))
    assert [len(queue.take(1000, 3)) for _ in range(5)] == [1, 1, 1, 0, 0]
    assert len(queue) == 0


def test_newer_news_of_a_member_replaces_its_suspicions() -> None:
    queue = NewsQueue()
    first, second = bytes([1] * 8), bytes([2] * 8)
    for accuser in (first, second, first):
        queue.add(news(1, MemberState.SUSPECT, accuser))
    assert len(queue) == 2, "each accuser confirms the other"
    queue.add(news(1, incarnation=1))
    assert queue.take(1000, 9) == [news(1, incarnation=1)]
    queue.add(news(1, MemberState.SUSPECT, first, 1))
    assert [one.state for one in queue.take(1000, 9)] == [MemberState.SUSPECT]


def test_the_queue_is_bounded_whatever_comes() -> None:
    queue, rng = NewsQueue(), random.Random(1)
    for _ in range(3 * limits.NEWS_QUEUE_MAX):
        accuser = rng.choice([b"", rng.randbytes(8)])
        state = MemberState.SUSPECT if accuser else rng.choice([MemberState.ALIVE, MemberState.FAILED])
        queue.add(news(rng.randrange(20_000), state, accuser))
        if rng.random() < 0.05:
            queue.take(1000, 4)
        assert len(queue) <= limits.NEWS_QUEUE_MAX
    while queue.take(1100, 4):
        pass
    assert len(queue) == 0
    assert queue._accused == {}
