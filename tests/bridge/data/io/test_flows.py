"""What happens to each message on its way through the bridge, under a simulated clock."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.bridge.data.export import ExportFlow
from rmpa.bridge.data.quality import QosEventKind
from rmpa.bridge.data.reception import ImportFlow, LinkTime
from rmpa.core.contract import Contract, Durability, Priority, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.core.statistics import Counters
from rmpa.mesh import limits as mesh_limits
from rmpa.mesh.frames import FrameKind
from rmpa.ros import limits as ros_limits
from rmpa.runtime import limits as runtime_limits
from tests.bridge.io.doubles import Clock, Link, Outlet, add, running

BEST = Contract()
RELIABLE = Contract(reliability=Reliability.RELIABLE)
KEPT = Contract(durability=Durability.TRANSIENT_LOCAL)
BIG = 200_000


@pytest.fixture(autouse=True)
def clock() -> Iterator[Clock]:
    with running(Clock()) as made:
        yield made


def framed(payload: bytes) -> bytes:
    """A message with its length in front."""
    return len(payload).to_bytes(4, "little") + payload


def got(link: Link) -> list[tuple[int, bytes]]:
    return [(sequence, payload) for _, sequence, payload in link.sent]


# --- out ------------------------------------------------------------------------------------------------------


def test_contract_says_how_many_kept_messages_a_peer_gets() -> None:
    flow = ExportFlow()
    add(flow, 1, Link(), 7, KEPT)
    for n in range(3):
        flow.message(memoryview(bytes([n])))
    deep, deeper, plain = Link(), Link(), Link()
    add(flow, 2, deep, 7, Contract(durability=Durability.TRANSIENT_LOCAL, depth=3))
    assert got(deep) == [(3, b"\2")], "nobody had asked for more in time"
    for n in range(3, 6):
        flow.message(memoryview(bytes([n])))
    add(flow, 3, deeper, 7, Contract(durability=Durability.TRANSIENT_LOCAL, depth=2))
    assert got(deeper) == [(5, b"\4"), (6, b"\5")]
    add(flow, 4, deep, 8, Contract(durability=Durability.TRANSIENT_LOCAL, depth=3))
    assert [payload for _, _, payload in deep.sent[-3:]] == [b"\3", b"\4", b"\5"]
    add(flow, 5, plain, 7, BEST)
    assert plain.sent == [], "an old command is not for who asked for no history"
    flow.latch()
    add(flow, 5, plain, 7, BEST)
    assert got(plain) == [(6, b"\5")], "but a latching publisher's is for everybody"


def test_no_contract_keeps_more_than_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_limits, "LATCHED_MAX", 5)
    flow, late = ExportFlow(), Link()
    deep = Contract(durability=Durability.TRANSIENT_LOCAL, depth=100)
    add(flow, 1, Link(), 7, deep)
    for n in range(20):
        flow.message(memoryview(bytes([n])))
    add(flow, 2, late, 7, deep)
    assert [payload[0] for _, _, payload in late.sent] == [15, 16, 17, 18, 19]


# --- in: best effort ------------------------------------------------------------------------------------------


class Inlet:
    """A flow from a peer, and what it delivered.

    Args:
        contract: Of the route.
        error: ± bound of what is known of the peer's clock, seconds; ``None``: nothing is.
        ahead: How much that clock is ahead of ours.
        first: The first number that is not missing.
    """

    def __init__(
        self, contract: Contract = BEST, *, error: float | None = None, ahead: float = 0.0, first: int = 1
    ) -> None:
        self.outlet = Outlet()
        self.acks: list[int] = []
        self.called_back = 0
        self.time = LinkTime()
        self.time.set(ahead, error)
        self.resumed = math.inf
        """When the link's last silence ended: nothing came since."""
        self.time.resumed_at = lambda: self.resumed
        self.counters = Counters()
        output = cast("Any", self.outlet)
        self.flow = ImportFlow(output, contract, self.time, self.counters, lambda _: None, self.torn)
        self.begin(0, first)
        self.flow._had = 0  # what comes after the first is not one that the publisher has kept

    def begin(self, epoch: int, first: int) -> bool:
        """The route is opened on a link; returns whether its numbering goes on."""
        return self.flow.bind(cast("Any", self), 7, epoch, first)

    def mark(self, kind: FrameKind, route: int, sequence: int) -> None:
        """Of the link."""
        assert (kind, route) == (FrameKind.ACK, 7)
        self.acks.append(sequence)

    def torn(self) -> None:
        self.called_back += 1

    def message(self, sequence: int, payload: bytes = b"", stamp_ns: int = 0) -> None:
        self.flow.message(sequence, stamp_ns, memoryview(framed(payload)))

    def parts(self, sequence: int, payload: bytes, *cuts: int, stamp_ns: int = 0, end: int | None = None) -> None:
        """A message in parts, cut there, all but those behind ``end``."""
        wire = framed(payload)
        places = [0, *cuts, len(wire)]
        for start, stop in list(pairwise(places))[:end]:
            flags = FIRST * (start == 0) | LAST * (stop == len(wire))
            self.flow.part(sequence, stamp_ns, flags, memoryview(bytearray(wire[start:stop])))

    @property
    def got(self) -> list[bytes]:
        return [message[4:] for message in self.outlet.got]

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """Lost, late, stale, expired; the agent's own counts, which outlive the flow, say the same."""
        counts = self.flow.counts
        assert self.counters.as_dict() == {f"message.{name}": count for name, count in sorted(counts.items())}
        assert self.flow.watch.counts[QosEventKind.MESSAGES_LOST] == counts["lost"]
        return counts["lost"], counts["late"], counts["stale"], counts["expired"]


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(st.sampled_from([5, 5000, BIG]), st.sets(st.integers(4, 2 * BIG), max_size=4)), max_size=12)
)
def test_messages_in_any_parts_are_delivered_unchanged(run: list[tuple[int, set[int]]]) -> None:
    with running(Clock()):
        inlet, sent = Inlet(), []
        for sequence, (size, cuts) in enumerate(run, 1):
            payload = bytes([sequence]) * size
            inlet.parts(sequence, payload, *sorted(cut for cut in cuts if cut < size + 4))
            sent.append(payload)
        assert inlet.got == sent
        assert inlet.counts == (0, 0, 0, 0)
        assert inlet.flow.quality.messages == len(run)
        assert inlet.flow.quality.bytes == sum(size + 4 for size, _ in run)
        assert inlet.outlet.torn == 0


@pytest.mark.parametrize(
    ("first", "then"),
    [
        (b"", None), (b"\1\0\0", None), (b"\xff\xff\xff\xff", None),
        ((ros_limits.MESSAGE_MAX - 3).to_bytes(4, "little"), None), (b"\3\0\0\0abcd", None),
        (b"\3\0\0\0ab", (2, 0, b"cd")), (b"\3\0\0\0ab", (2, LAST, b"")), (b"\3\0\0\0ab", (2, 0, b"c")),
        (b"\3\0\0\0ab", (3, LAST, b"c")), (b"\3\0\0\0ab", (4, 0, b"c")), (b"\3\0\0\0ab", (3, LAST | ABORT, b"")),
    ],
)  # fmt: skip
@pytest.mark.parametrize("contract", [BEST, RELIABLE], ids=["best_effort", "reliable"])
def test_parts_that_make_no_message_are_the_peers_error(
    first: bytes, then: tuple[int, int, bytes] | None, contract: Contract
) -> None:
    inlet = Inlet(contract)
    inlet.begin(1, 2)
    parts = [(2, FIRST, first)] if then is None else [(2, FIRST, first), then]
    for sequence, flags, part in parts[:-1]:
        inlet.flow.part(sequence, 0, flags, memoryview(part))
    sequence, flags, part = parts[-1]
    with pytest.raises(RemoteProtocolError):
        inlet.flow.part(sequence, 0, flags, memoryview(part))
    assert inlet.got == []
    inlet.flow.torn()
    assert not inlet.outlet.in_the_middle


@pytest.mark.parametrize("payload", [b"", b"\0\0\0", b"\3\0\0\0hi", b"\1\0\0\0hi"])
@pytest.mark.parametrize("contract", [BEST, RELIABLE], ids=["best_effort", "reliable"])
def test_a_frame_that_does_not_hold_one_message_breaks_the_protocol(payload: bytes, contract: Contract) -> None:
    inlet = Inlet(contract)
    with pytest.raises(RemoteProtocolError, match="does not hold one message"):
        inlet.flow.message(1, 0, memoryview(payload))
    assert inlet.got == []


@pytest.mark.parametrize("contract", [BEST, RELIABLE], ids=["best_effort", "reliable"])
def test_late_message_does_not_disturb_one_in_parts(contract: Contract) -> None:
    inlet = Inlet(contract)
    inlet.begin(1, 1)
    for sequence in (1, 2, 3):
        inlet.message(sequence, bytes([sequence]))
    inlet.parts(4, bytes(BIG), 50, end=1)
    inlet.message(3, b"again")
    inlet.parts(2, bytes(BIG), 100, 200)
    inlet.flow.part(1, 0, LAST | ABORT, memoryview(b""))
    inlet.flow.part(4, 0, LAST, memoryview(bytes(BIG + 4 - 50)))
    inlet.message(5, b"\5")
    assert inlet.got == [b"\1", b"\2", b"\3", bytes(BIG), b"\5"]
    assert inlet.counts == (0, 2, 0, 0)
    assert inlet.called_back == 0


# --- in: what is old ------------------------------------------------------------------------------------------

OLD = runtime_limits.STALE_AGE + 0.01
HOLD = mesh_limits.STALE_HOLD
NEWEST = Contract(depth=1)


def burst(inlet: Inlet, clock: Clock, ages: list[float], first: int = 2) -> None:
    """Messages of these ages, all at once, numbered from ``first`` on."""
    for sequence, age in enumerate(ages, first):
        inlet.message(sequence, bytes([sequence]), stamp_ns=clock.wall_ns() - round(age * 1e9))


def test_the_hold_is_counted_from_the_first_of_the_burst(clock: Clock) -> None:
    """A source that stays late for ever must not be held for ever."""
    inlet = Inlet(NEWEST, error=0.001, first=2)
    for sequence in range(2, 60):
        burst(inlet, clock, [2.0], first=sequence)
        clock.advance(HOLD / 3)
    assert len(inlet.got) >= 58 / 4 - 1
    clock.advance(HOLD)
    assert inlet.counts[2] + len(inlet.got) == 58


@pytest.mark.parametrize("ahead", [-3600.0, 3600.0])
def test_the_peers_clock_is_what_dates_its_messages(clock: Clock, ahead: float) -> None:
    inlet = Inlet(NEWEST, error=0.001, ahead=ahead, first=2)
    inlet.message(2, b"new", stamp_ns=clock.wall_ns() + round(ahead * 1e9))
    assert inlet.got == [b"new"]
    inlet.message(3, b"old", stamp_ns=clock.wall_ns() + round((ahead - OLD) * 1e9))
    assert inlet.got == [b"new"]
    inlet.message(4, b"newer", stamp_ns=clock.wall_ns() + round(ahead * 1e9))
    assert inlet.got == [b"new", b"newer"]


def test_messages_from_before_a_silence_are_stale(clock: Clock) -> None:
    inlet = Inlet(NEWEST, error=0.001, first=2)
    inlet.resumed = clock.now - 0.5
    burst(inlet, clock, [0.9, 0.7, 0.55, 0.3])  # the third was held up for 50 ms, and by us for the rest
    assert inlet.got == [b"\4", b"\5"]
    assert inlet.counts == (0, 0, 2, 0)


def test_a_kept_message_is_as_old_as_it_is(clock: Clock) -> None:
    inlet = Inlet(NEWEST, error=0.001)
    burst(inlet, clock, [60.0] * 3, first=1)
    assert inlet.got == [b"\1"]


def test_beyond_its_lifespan_a_message_is_worth_nothing(clock: Clock) -> None:
    inlet = Inlet(Contract(lifespan=0.5), error=0.01)
    burst(inlet, clock, [0.4, 0.505, 0.52, 60.0], first=1)
    assert inlet.got == [b"\1", b"\2"]
    old = clock.wall_ns() - 10**9
    inlet.parts(5, bytes(BIG), 50, 60, stamp_ns=old)
    assert inlet.outlet.parts == 0
    inlet.parts(6, bytes(BIG), 50, 60, stamp_ns=clock.wall_ns())
    inlet.message(7, b"", stamp_ns=old)
    clock.advance(1.0)
    assert inlet.got == [b"\1", b"\2", bytes(BIG)]
    assert inlet.counts == (0, 0, 0, 4)
    assert inlet.flow.watch.counts == {QosEventKind.LIFESPAN_EXPIRED: 4}


def test_closed_nothing_happens_any_more(clock: Clock) -> None:
    inlet = Inlet(NEWEST, error=0.001, first=2)
    burst(inlet, clock, [9.0])
    inlet.parts(3, bytes(BIG), 50, end=1)
    burst(inlet, clock, [9.0, 8.0], first=4)
    inlet.flow.close()
    assert clock.due == []
    clock.advance(1.0)
    assert inlet.got == []
    owes = Inlet(RELIABLE)
    owes.message(1)
    owes.flow.close()
    clock.advance(1.0)
    assert owes.acks == []


# --- in: what the subscribers have already ----------------------------------------------------------------------


def replayed(kept: list[bytes], sent: list[bytes], contract: Contract = BEST, *, cut: bool = False) -> list[bytes]:
    """What subscribers that have ``kept`` get of ``sent``."""
    inlet = Inlet(contract)
    inlet.begin(1, 1)
    inlet.flow.expect_replay(framed(payload) for payload in kept)
    for sequence, payload in enumerate(sent, 1):
        if cut:
            inlet.parts(sequence, payload, 6)
        else:
            inlet.message(sequence, payload)
    assert inlet.flow.quality.messages == len(inlet.got)
    assert inlet.counts == (0, 0, 0, 0)
    assert inlet.outlet.torn == 0
    return inlet.got


@pytest.mark.parametrize("cut", [False, True], ids=["whole", "in_parts"])
@pytest.mark.parametrize("contract", [BEST, RELIABLE], ids=["best_effort", "reliable"])
@pytest.mark.parametrize(
    ("kept", "sent", "new"),
    [
        ("", "abc", "abc"), ("a", "a", ""), ("a", "ab", "b"), ("a", "aa", "a"), ("a", "ba", "ba"),
        ("abc", "abc", ""), ("abc", "bcd", "d"), ("abc", "cde", "de"), ("abc", "def", "def"),
        ("abc", "dabc", "dabc"), ("aaa", "aaaa", "a"),
    ],
)  # fmt: skip
def test_a_new_route_brings_nothing_again(kept: str, sent: str, new: str, contract: Contract, cut: bool) -> None:
    def messages(letters: str) -> list[bytes]:
        return [letter.encode() * 100 for letter in letters]

    assert replayed(messages(kept), messages(sent), contract, cut=cut) == messages(new)


# --- in: reliable ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("priority", "size", "lane"),
    [
        (Priority.HIGH, BIG, "express"), (Priority.LOW, 1, "bulk"), (Priority.NORMAL, 1, "express"),
        (Priority.NORMAL, BIG, "bulk"),
    ],
)  # fmt: skip
def test_the_lane_as_the_monitor_shows_it(priority: Priority, size: int, lane: str) -> None:
    inlet = Inlet(Contract(priority=priority))
    inlet.parts(1, bytes(size), 4)
    assert inlet.flow.lane == lane
