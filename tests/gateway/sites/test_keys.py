"""Keys, tokens, attachments, headers and numbers between sites: golden texts, and what is none."""

from __future__ import annotations

import json
import random
from dataclasses import replace

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.contract import Contract, Priority, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.rules import SourceKind
from rmpa.gateway.sites.keys import (
    AttachmentReader,
    MessageSource,
    SequenceCounter,
    SiteGateway,
    SiteModule,
    SiteSource,
    TopicHeader,
    data_key,
    parse_token,
    token_keys,
)
from rmpa.gateway.sites.topics import qos_of
from rmpa.gateway.topics import TopicLimits
from rmpa.gateway.zenoh.threads import ZenohPriority
from rmpa.ros.wire.tcpros import TopicDescription
from tests.gateway.memory_zenoh import fits

RUN = "0123456789abcdef0123456789abcdef"
ARM = SiteModule("warehouse", "arm", RUN)
SCAN = SiteSource(ARM, SourceKind.TOPIC, "sensor_msgs/LaserScan", "/lidar/driver", "/base/scan")
FOR_YARD = replace(SCAN, to="yard")
GATEWAY = SiteGateway("warehouse", 10, RUN)


@pytest.mark.parametrize(
    ("each", "token"),
    [
        (ARM, f"rmpa/1/warehouse/arm/up/{RUN}"),
        (SCAN, f"rmpa/1/warehouse/arm/up/{RUN}/t/sensor_msgs%LaserScan/%lidar%driver/%base%scan"),
        (FOR_YARD, f"rmpa/1/warehouse/arm/to/{RUN}/yard/t/sensor_msgs%LaserScan/%lidar%driver/%base%scan"),
        (GATEWAY, f"rmpa/1/warehouse/-gateway/010/{RUN}"),
        (SiteModule("home", "gateway", RUN), f"rmpa/1/home/gateway/up/{RUN}"),  # a module may be called so
        (SiteModule("s" * 63, "arm", RUN), f"rmpa/1/{'s' * 63}/arm/up/{RUN}"),
    ],
)
def test_golden_tokens(each: SiteModule | SiteSource | SiteGateway, token: str) -> None:
    assert (each.token(), parse_token(token)) == (token, each)


def test_golden_keys() -> None:
    assert SCAN.key() == "rmpa/1/warehouse/arm/t/sensor_msgs%LaserScan/base/scan"
    assert data_key("*", "*", SourceKind.SERVICE, "std_srvs/Trigger", "/stop") == "rmpa/1/*/*/s/std_srvs%Trigger/stop"
    assert FOR_YARD.key() == "rmpa/1/warehouse/arm/to/yard/t/sensor_msgs%LaserScan/base/scan"
    assert token_keys("yard") == ("rmpa/1/*/-gateway/**", "rmpa/1/*/*/up/**", "rmpa/1/*/*/to/*/yard/**")


def test_a_gateway_follows_each_token_that_is_for_all_or_for_its_site_once() -> None:
    for each, sites in ((ARM, "ab"), (SCAN, "ab"), (GATEWAY, "ab"), (replace(FOR_YARD, to="a"), "a")):
        told = [site for site in "ab" for key in token_keys(site) if fits(key, each.token())]
        assert "".join(told) == sites


def test_a_service_whose_type_is_unknown_is_announced_and_called_by_any_type() -> None:
    stop = SiteSource(ARM, SourceKind.SERVICE, "*", "/driver", "/stop")
    assert stop.token() == f"{ARM.token()}/s/-/%driver/%stop"
    assert stop.key() == "rmpa/1/warehouse/arm/s/*/stop"
    assert parse_token(stop.token()) == stop
    with pytest.raises(RemoteProtocolError):
        parse_token(f"{ARM.token()}/t/-/%driver/%stop")


@pytest.mark.parametrize("more", ["/x", "/t/a%B/%n/%t/more", "/z/a%B/%n/%t"])
def test_what_a_later_version_announces_is_ignored(more: str) -> None:
    assert parse_token(ARM.token() + more) is None
    assert parse_token(f"rmpa/1/home/arm/later/{RUN}") is None


@pytest.mark.parametrize(
    "key",
    [
        "", "rmpa/1/home", f"rmpa/2/home/arm/up/{RUN}", f"rmpa/1/ho-me/arm/up/{RUN}", f"rmpa/1/home/4rm/up/{RUN}",
        f"rmpa/1/{'s' * 64}/arm/up/{RUN}", f"rmpa/1/home/arm/up/{RUN[:-1]}", f"rmpa/1/home/arm/up/{RUN.upper()}",
        f"rmpa/1/home/-gateway/first/{RUN}", f"rmpa/1/home/-gateway/1000/{RUN}", f"rmpa/1/home/-gateway/²/{RUN}",
        f"rmpa/1/home/arm/up/{RUN}/t/std_msgs/%node/%topic",
        f"rmpa/1/home/arm/to/{RUN}/ya-rd/t/std_msgs%String/%node/%topic",
        f"rmpa/1/home/arm/up/{RUN}/t/std_msgs%String/node/%topic",
        f"rmpa/1/home/arm/up/{RUN}/t/std_msgs%String/%node/%to pic",
        f"rmpa/1/home/arm/up/{RUN}/t/std_msgs%String/%node/%{'a' * limits.KEY_MAX}",
    ],
)  # fmt: skip
def test_what_is_no_token_is_refused(key: str) -> None:
    with pytest.raises(RemoteProtocolError):
        parse_token(key)


# --- The attachment between sites -----------------------------------------------------------------------------------

SENT = MessageSource("992ce8a1687cec8c8bd883ec73ca41d1", "/talker", ("warehouse", "cloud"), latched=True)
GOLDEN = (
    bytes.fromhex("01 01 0700000000000000 15cd5b0700000000 992ce8a1687cec8c8bd883ec73ca41d1")
    + b"\x07/talker\x02\x09warehouse\x05cloud"
)


def test_golden_bytes() -> None:
    assert SENT.writer()(7, 123456789) == GOLDEN
    for later in (b"", b"more"):  # what later versions add is ignored
        assert AttachmentReader().read(GOLDEN + later) == (7, 123456789, SENT)
    for length in range(len(GOLDEN)):
        with pytest.raises(RemoteProtocolError):
            AttachmentReader().read(GOLDEN[:length])


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        (b"\x01\x01\x07", b"\x02\x01\x07", "version 2"), (b"/talker", b"talker/", "no global name"),
        (b"/talker", b"/t\xff\xfeker", "not UTF-8"), (b"\x02\x09", b"\x00\x09", "passed 0 sites"),
        (b"\x02\x09", b"\xff\x09", "passed 255 sites"), (b"cloud", b"cl-ud", "names the site"),
    ],
)  # fmt: skip
def test_what_ros_does_not_allow_is_refused(old: bytes, new: bytes, problem: str) -> None:
    with pytest.raises(RemoteProtocolError, match=problem):
        AttachmentReader().read(GOLDEN.replace(old, new, 1))


def test_a_loop_is_bounded() -> None:
    path = tuple(f"s{number}" for number in range(limits.PATH_MAX + 1))
    with pytest.raises(RemoteProtocolError, match="sites"):
        AttachmentReader().read(MessageSource("0" * 32, "/n", path).writer()(1, 0))


def test_the_run_is_read_back_and_a_reader_knows_each_source_again() -> None:
    first = SENT._replace(run=2**63 - 1)
    second = first._replace(node="/other", latched=False)
    reader = AttachmentReader()
    for number, each in enumerate((first, second, first, second), 1):
        assert reader.read(each.writer()(number, -5)) == (number, -5, each)
    assert first.writer()(7, 123456789) == GOLDEN + (2**63 - 1).to_bytes(8, "little")


# --- Sequence numbers, limits, QoS and headers of topics between sites ----------------------------------------------

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
