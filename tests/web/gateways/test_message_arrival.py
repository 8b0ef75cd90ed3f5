from __future__ import annotations

from rmpa.web import limits
from rmpa.web.gateways.message_arrival import MessageArrival

LONG = limits.MESSAGE_TIMEOUT


def test_a_message_whose_fragments_never_end_takes_too_long_whatever_comes_between_them() -> None:
    arrival, received = MessageArrival(), 0
    for now in range(0, int(LONG), 10):
        assert not arrival.takes_too_long(received, now)
        received += 7  # a fragment
        received += 6  # a pong
        arrival.control_frame(0)
    assert not arrival.takes_too_long(received, LONG + 9)
    assert arrival.takes_too_long(received, LONG + 10)


def test_messages_that_end_and_pongs_do_not() -> None:
    arrival, received = MessageArrival(), 0
    for now in range(0, int(5 * LONG), 10):
        received += 100
        assert not arrival.takes_too_long(received, now)  # it is on its way
        arrival.message_ended(received)
    for now in range(int(5 * LONG), int(10 * LONG), 10):
        received += 6 + 125
        arrival.control_frame(125)
        assert not arrival.takes_too_long(received, now)


def test_without_a_count_of_bytes_nothing_takes_too_long() -> None:
    arrival = MessageArrival()
    assert not arrival.takes_too_long(0, 0.0)
    assert not arrival.takes_too_long(0, 2 * LONG)
