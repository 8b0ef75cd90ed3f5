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


def test_gaps_are_losses_and_repetitions_are_not_new() -> None:
    counter = SequenceCounter()
    assert [counter.take(7, number) for number in (5, 6, 6, 9, 9, 8, 10)] == [
        True, True, False, True, False, False, True,
    ]  # fmt: skip
    assert counter.lost == 2


def test_another_run_begins_anew_without_a_loss() -> None:
    counter = SequenceCounter()
    for run, number in ((7, 100), (8, 1), (8, 2)):
        assert counter.take(run, number)
    assert counter.lost == 0


def test_a_loss_at_the_end_is_seen_once_the_exporter_tells_its_number() -> None:
    counter = SequenceCounter()
    counter.take(7, 1)
    counter.announced(7, 4)
    assert counter.lost == 3
    counter.take(7, 2)
    assert counter.lost == 2
    counter.announced(8, 100)
    assert counter.lost == 2
    counter.take(8, 1)
    assert counter.lost == 2


def test_what_is_lost_before_the_first_message_counts_from_what_the_exporter_had_sent() -> None:
    counter = SequenceCounter()
    counter.announced(7, 10)
    assert counter.lost == 0
    counter.announced(7, 12)
    assert counter.lost == 2
    counter.take(7, 14)
    assert counter.lost == 3
    counter.restart()
    counter.announced(7, 20)
    assert counter.take(7, 19), "it was on its way while the exporter answered"
    assert counter.take(7, 20)
    assert counter.lost == 3


@given(st.lists(st.booleans(), min_size=1), st.integers(0, 5))
def test_everything_that_is_sent_is_received_or_counted(kept: list[bool], first: int) -> None:
    counter = SequenceCounter()
    counter.take(1, first)
    for number, comes in enumerate(kept, first + 1):
        if comes:
            counter.take(1, number)
    counter.announced(1, first + len(kept))
    assert sum(kept) + counter.lost == len(kept)


def test_a_limit_of_rate_lets_that_rate_pass() -> None:
    allowed = TopicLimits(10, None)
    passed = sum(allowed.admit(number / 100, 1) for number in range(1000))
    assert 100 <= passed <= 105


def test_a_limit_of_rate_drops_nothing_of_a_topic_at_that_rate_with_jitter() -> None:
    allowed = TopicLimits(10, None)
    jitter = random.Random(1)
    assert all(allowed.admit(number / 10 + jitter.uniform(0, 0.09), 1) for number in range(500))


def test_a_limit_of_size_lets_that_many_bytes_pass_also_in_large_messages() -> None:
    allowed = TopicLimits(None, 10_000)
    passed = sum(allowed.admit(number / 10, 50_000) for number in range(1000))
    assert 20 <= passed <= 21
    small = TopicLimits(None, 10_000)
    assert sum(100 * small.admit(number / 1000, 100) for number in range(10_000)) <= 105_000


def test_a_message_passes_when_the_limit_says_so() -> None:
    allowed = TopicLimits(2.0, 1000)
    assert allowed.admit(0.0, 900)
    assert not allowed.admit(0.1, 900)
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
        json.dumps({"type": "a/B", "md5sum": MD5.upper()}).encode(),
        json.dumps({"type": "a", "md5sum": MD5}).encode(),
        json.dumps({"type": "a/B", "md5sum": MD5, "run": -1}).encode(),
        json.dumps({"type": "a/B", "md5sum": MD5, "sequence": 2**64}).encode(),
        json.dumps({"type": "a/B", "md5sum": MD5, "definition": 1}).encode(),
        json.dumps({"type": "a/B", "md5sum": MD5, "definition": "\ud83e"}).encode(),  # half of a surrogate pair
        b"[" * 100_000,
        b'{"type": "a/B", "more": "' + b"x" * limits.HEADER_MAX + b'"}',
    ],
)
def test_what_is_no_header_is_refused(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        TopicHeader.parse(data)
