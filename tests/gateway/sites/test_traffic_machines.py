"""Sequence numbers, limits, QoS and headers of topics between sites."""

from __future__ import annotations

import json
import random

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.contract import Contract, Priority, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.sites.keys import SequenceCounter, TopicHeader
from rmpa.gateway.sites.topics import qos_of
from rmpa.gateway.topics import TopicLimits
from rmpa.gateway.zenoh.threads import ZenohPriority
from rmpa.ros.wire.tcpros import TopicDescription

MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


def play(text: str) -> list[int | None]:
    """The losses after each step, or ``None`` for a message that is not new.

    A message is ``run:number``; the exporter tells its last one as ``run=number``; ``-``: nothing is subscribed now.
    """
    counter, told = SequenceCounter(), list[int | None]()
    for step in text.split():
        run, kind, number = step.partition(":") if ":" in step else step.partition("=")
        new = True
        if kind == ":":
            new = counter.take(int(run), int(number))
        elif kind:
            counter.announced(int(run), int(number))
        else:
            counter.restart()
        told.append(counter.lost if new else None)
    return told


@pytest.mark.parametrize(
    ("steps", "lost"),
    [
        pytest.param("7:5 7:6 7:6 7:9 7:9 7:8 7:10", [0, 0, None, 2, None, None, 2], id="gaps and repetitions"),
        pytest.param("7:100 8:1 8:2", [0, 0, 0], id="another run begins anew"),
        pytest.param("7:1 7=4 7:2 8=100 8:1", [0, 3, 2, 2, 2], id="a loss at the end is seen once it is told"),
        pytest.param("7=10 7=12 7:14", [0, 2, 3], id="losses before the first message"),
        pytest.param("7=10 - 7=20 7:19 7:20", [0, 0, 0, 1, 0], id="on its way while the exporter answered"),
    ],
)
def test_losses_follow_from_the_numbers(steps: str, lost: list[int | None]) -> None:
    assert play(steps) == lost


@given(st.lists(st.booleans(), min_size=1), st.integers(0, 5))
def test_everything_that_is_sent_is_received_or_counted(kept: list[bool], first: int) -> None:
    counter = SequenceCounter()
    counter.take(1, first)
    for number, comes in enumerate(kept, first + 1):
        if comes:
            counter.take(1, number)
    counter.announced(1, first + len(kept))
    assert sum(kept) + counter.lost == len(kept)


@pytest.mark.parametrize(
    ("rate", "size", "pause", "message", "count", "passes"),
    [
        (10, None, 0.01, 1, 1000, range(100, 106)),
        (None, 10_000, 0.1, 50_000, 1000, range(20, 22)),  # also of large messages
        (None, 10_000, 0.001, 100, 10_000, range(1000, 1051)),
    ],
)
def test_a_limit_lets_that_much_pass(
    rate: float | None, size: int | None, pause: float, message: int, count: int, passes: range
) -> None:
    allowed = TopicLimits(rate, size)
    assert sum(allowed.admit(number * pause, message) for number in range(count)) in passes


def test_a_limit_of_rate_drops_nothing_of_a_topic_at_that_rate_with_jitter() -> None:
    allowed, jitter = TopicLimits(10, None), random.Random(1)
    assert all(allowed.admit(number / 10 + jitter.uniform(0, 0.09), 1) for number in range(500))


def test_a_message_passes_when_the_limit_says_so() -> None:
    allowed = TopicLimits(2.0, 1000)
    assert [allowed.admit(at, 900) for at in (0.0, 0.1)] == [True, False]
    due = allowed.next(0.1, 900)
    assert 0.1 < due < 2
    assert allowed.admit(due + 1e-6, 900)


@pytest.mark.parametrize(
    ("contract", "large", "priority"),
    [
        (Contract(), False, ZenohPriority.DATA),
        (Contract(), True, ZenohPriority.DATA_LOW),
        (Contract(priority=Priority.HIGH), True, ZenohPriority.REAL_TIME),
        (Contract(priority=Priority.LOW), False, ZenohPriority.DATA_LOW),
    ],
)
def test_lanes_become_priorities(contract: Contract, large: bool, priority: ZenohPriority) -> None:
    assert qos_of(contract, large=large).priority is priority


def test_contracts_become_bounds() -> None:
    qos = qos_of(Contract(reliability=Reliability.RELIABLE, depth=7), latching=True)
    assert (qos.reliable, qos.block, qos.messages, qos.bytes, qos.cache) == (True, False, 7, limits.RELIABLE_BYTES, 1)
    assert qos_of(Contract()).bytes == limits.BEST_EFFORT_BYTES
    assert qos_of(Contract()).reliable, "Zenoh would drop large messages of it without a count"
    assert qos_of(Contract()).messages >= 1000


HEADER = TopicHeader("std_msgs/String", MD5, "string data\n", True, "/talker", 17, 42, 1)


def test_golden_header() -> None:
    assert json.loads(msgspec.json.encode(HEADER)) == {
        "type": "std_msgs/String", "md5sum": MD5, "definition": "string data\n", "latching": True, "node": "/talker",
        "run": 17, "sequence": 42, "waiting": 1,
    }  # fmt: skip
    assert TopicHeader.parse(msgspec.json.encode(HEADER)) == HEADER
    assert HEADER.description == TopicDescription("std_msgs/String", MD5, "string data\n", latching=True)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"\xff",
        b'{"type": "std_msgs/String"}',
        *(
            json.dumps({"type": "a/B", "md5sum": MD5, **wrong}).encode()
            for wrong in (
                {"md5sum": MD5.upper()},
                {"type": "a"},
                {"run": -1},
                {"sequence": 2**64},
                {"definition": 1},
                {"definition": "\ud83e"},  # half of a surrogate pair
            )
        ),
        b"[" * 100_000,
        b'{"type": "a/B", "more": "' + b"x" * limits.HEADER_MAX + b'"}',
    ],
)
def test_what_is_no_header_is_refused(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        TopicHeader.parse(data)
