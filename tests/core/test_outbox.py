"""The outbox: bounds hold, order is kept per key, no message is torn, no byte is lost.

Here by example; ``test_outbox_machine.py`` does all that there is, against a plain model.
"""

from __future__ import annotations

import time

import pytest

from rmpa.core.errors import LocalProtocolError
from rmpa.core.outbox import Outbox, QueuedMessage


def drain(box: Outbox, step: int = 1 << 30) -> bytes:
    out = b""
    while box:
        head = b"".join(box.head())[:step]
        assert head
        out += head
        box.consumed(len(head))
    return out


def test_dropping_stays_cheap_with_many_keys() -> None:
    def cost(keys: int) -> float:
        box = Outbox(2, 1 << 30)
        for key in range(keys):
            box.push(b"x", key)
            box.push(b"x", key)
        started = time.process_time()
        for _ in range(2000):
            box.push(b"x", 0)
        return time.process_time() - started

    assert min(cost(4000) for _ in range(3)) < 20 * min(cost(10) for _ in range(3)) + 0.01


def test_out_of_turn_is_our_own_fault() -> None:
    box = Outbox(1, 1)
    with pytest.raises(LocalProtocolError):
        box.consumed(1)
    box.push(b"x", 1)
    with pytest.raises(LocalProtocolError):
        box.push_rest(b"y")
    with pytest.raises(LocalProtocolError, match="9 bytes"):
        box.extend(QueuedMessage(2, 9), bytes(10))


# --- in turns and in parts ----------------------------------------------------------------------------------------


def test_without_a_framer_bytes_leave_as_they_are() -> None:
    box = Outbox(10, 1000, fragment=4)
    parcel = QueuedMessage(1, 10)
    box.extend(parcel, b"0123456")
    box.push_urgent(b"!")
    assert drain(box) == b"!0123456"
    box.extend(parcel, b"789")
    assert drain(box) == b"789"


def test_without_a_framer_nobody_can_be_told() -> None:
    box = Outbox(10, 1000)
    parcel = QueuedMessage(1, 10)
    box.extend(parcel, b"012345")
    drain(box)
    assert box.abandon(parcel) is True
    assert box.abandon(parcel) is False


def test_a_spared_key_loses_nothing_to_the_bound_of_all_keys() -> None:
    box = Outbox(10, 20)
    box.set_terms(1, 1000, spared=True)
    for _ in range(10):
        box.push(bytes(10), 1)
    assert box.push(bytes(15), 2) == 0
    assert box.push(bytes(15), 2) == 1
    assert box.dropped == {2: 1}
    assert len(drain(box)) == 115


def test_age_counts_only_above_so_many_bytes() -> None:
    box = Outbox(10, 1000)
    box.set_terms(1, 10, 0.1, above=20)
    box.head(now=1.0)
    for _ in range(4):
        box.push(bytes(10), 1, 1.0)
    assert sum(map(len, box.head(now=1.2))) == 20
    assert box.expired == {1: 2}


def test_what_a_standstill_has_delayed_is_not_old_but_what_a_slow_socket_delays_is() -> None:
    box = Outbox(1000, 1000)
    box.set_terms(1, 1000, 0.5)
    for _ in range(64 * 3):
        box.push(bytes(1), 1, 1.0)
    assert len(box.head(now=1.1)) == 64
    box.consumed(64)
    assert len(box.head(now=9.0)) == 64, "nothing was taken for eight seconds"
    box.consumed(64)
    for tenth in range(1, 7):
        box.consumed(sum(map(len, box.head(1, now=9.0 + tenth / 10))))
    assert box.expired == {1: 64 - 6}


def test_of_a_strict_key_all_that_is_too_old_goes() -> None:
    box = Outbox(10, 1000)
    box.set_terms(1, 10, 0.5, strict=True)
    box.push(b"old", 1, now=1.0)
    box.push(b"other", 2, now=9.0)
    assert b"".join(box.head(now=9.0)) == b"other"
    assert (box.expired, box.waiting(1)) == ({1: 1}, 0)
