from __future__ import annotations

from rmpa.web import limits
from rmpa.web.hub.topics import ReceivedMessage
from rmpa.web.rosbridge.delivery import QueuedBytes, Throttle


def _message(number: int, size: int = 1) -> ReceivedMessage:
    return ReceivedMessage("/t", "t/T", memoryview(bytes(size)), number)


def _numbers(messages: list[ReceivedMessage]) -> list[int]:
    return [each.stamp_ns for each in messages]


def _throttle(interval: float, length: int) -> Throttle:
    throttle = Throttle(QueuedBytes())
    throttle.configure(interval, length)
    return throttle


def test_without_an_interval_all_are_sent_at_once() -> None:
    throttle = _throttle(0, 0)
    assert [n for number in range(5) for n in _numbers(throttle.offer(_message(number), 0))] == [0, 1, 2, 3, 4]


def test_without_a_queue_messages_within_the_interval_are_dropped() -> None:
    throttle = _throttle(1.0, 0)
    sent = [n for number in range(30) for n in _numbers(throttle.offer(_message(number), number / 10))]
    assert sent == [0, 10, 20]
    assert throttle.next_timer() is None


def test_a_full_queue_drops_its_oldest_and_sends_one_in_each_interval() -> None:
    throttle = _throttle(1.0, 2)
    assert _numbers(throttle.offer(_message(0), 0)) == [0]
    for number in (1, 2, 3):
        assert not throttle.offer(_message(number), 0.1)
    assert throttle.next_timer() == 1.0
    assert not throttle.due(0.9)
    assert _numbers(throttle.due(1.0)) == [2]
    assert _numbers(throttle.due(2.5)) == [3]
    assert throttle.next_timer() is None


def test_a_shorter_interval_takes_effect_at_once() -> None:
    throttle = _throttle(10.0, 3)
    throttle.offer(_message(0), 0)
    throttle.offer(_message(1), 0)
    throttle.offer(_message(2), 0)
    throttle.configure(1.0, 3)
    assert throttle.next_timer() == 1.0
    throttle.configure(0.0, 3)
    assert _numbers(throttle.due(1.0)) == [1, 2]


def test_queues_are_bounded_in_bytes_and_give_them_back() -> None:
    total = QueuedBytes()
    size = limits.QUEUE_BYTES_MAX // 4
    throttles = [Throttle(total) for _ in range(8)]
    for throttle in throttles:
        throttle.configure(100.0, 10**9)
        assert throttle.length == limits.QUEUE_MESSAGES_MAX
        for number in range(20):
            throttle.offer(_message(number, size), 0)
        assert throttle._bytes <= limits.QUEUE_BYTES_MAX
    assert total.used <= limits.QUEUES_BYTES_MAX
    for throttle in throttles:
        throttle.clear()
    assert total.used == 0


def test_one_message_always_fits() -> None:
    throttle = _throttle(1.0, 5)
    throttle.offer(_message(0), 0)
    throttle.offer(_message(1, 2 * limits.QUEUES_BYTES_MAX), 0)
    assert _numbers(throttle.due(1.0)) == [1]
