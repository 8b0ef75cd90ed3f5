"""Route senders under a simulated clock, with a link that records what is sent."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import TypeVar

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule

from rmpa.bridge.data.export import ExportFlow
from rmpa.bridge.data.route_sender import ReliableRouteSender, RouteSender
from rmpa.core import limits as core_limits
from rmpa.core.contract import Contract, History, Reliability
from rmpa.mesh import limits as mesh_limits
from tests.bridge.io.doubles import Clock, Link, add, running

SMALL = b"s" * 8
LARGE = b"L" * (mesh_limits.EXPRESS_MESSAGE_MAX + 1)
ROW = mesh_limits.EXPRESS_AGAIN_MESSAGES
RELIABLE = Contract(reliability=Reliability.RELIABLE)
_Sender = TypeVar("_Sender", bound=RouteSender)


@pytest.fixture(autouse=True)
def clock() -> Iterator[Clock]:
    with running(Clock()) as made:
        yield made


def best_effort(link: Link, contract: Contract | None = None, *, large: bool = False) -> RouteSender:
    return RouteSender(link, 7, contract or Contract(), large=large)


def reliable(link: Link, contract: Contract = RELIABLE, *, large: bool = False) -> ReliableRouteSender:
    return ReliableRouteSender(link, 7, contract, 5, large=large)


def fresh(make: Callable[..., _Sender], *terms: Contract, large: bool = False) -> tuple[Link, _Sender]:
    """A sender with a link of its own."""
    link = Link()
    return link, make(link, *terms, large=large)


def answer(link: Link, sender: RouteSender) -> None:
    sender.fenced(link.fences.popleft()[1])


def on_bulk(link: Link, sender: RouteSender) -> None:
    sender.message(0, LARGE)
    answer(link, sender)
    assert sender.lane == "bulk"


# --- best effort ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("history", "kept"), [(History.KEEP_LAST, 3), (History.KEEP_ALL, 10)])
def test_held_messages_keep_to_the_depth(history: History, kept: int) -> None:
    link, sender = fresh(best_effort, Contract(depth=3, history=history), large=True)
    drops = [sender.message(0, bytes([n])) for n in range(10)]
    assert drops == [0] * kept + [1] * (10 - kept)
    answer(link, sender)
    assert [payload[0] for _, _, payload in link.sent] == list(range(10 - kept, 10))
    assert link.numbers == list(range(11 - kept, 11)), "the gap says how many are missing"


def test_held_bytes_are_bounded(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_limits, "ROUTE_QUEUE_BYTES", 1000)
    link, sender = fresh(best_effort, large=True)
    assert sender.message(0, bytes(400)) == 0
    assert sender.message(0, bytes(400)) == 0
    assert sender.message(0, bytes(300)) == 1
    assert sender.message(0, bytes(5000)) == 2
    assert sender.message(0, bytes(1000)) == 1
    answer(link, sender)
    assert [len(payload) for _, _, payload in link.sent] == [1000]
    clock.advance(mesh_limits.EXPRESS_AGAIN_AFTER)
    for _ in range(ROW):
        sender.message(0, b"")
    assert link.fences
    assert sender.message(0, bytes(1000)) == 0, "the count of bytes began anew"


def test_lost_bulk_lane_delivers_nothing_late(clock: Clock) -> None:
    """What waits for the lane's next connection would come late; the fence behind it would never be answered."""
    link, sender = fresh(best_effort)
    on_bulk(link, sender)
    clock.advance(mesh_limits.EXPRESS_AGAIN_AFTER)
    for _ in range(ROW):
        sender.message(0, SMALL)
    number = link.fences.popleft()[1]
    link.log.clear()
    sender.lane_lost()
    assert link.log == [("bulk", "discard", 7), ("express", "message", 7, ROW + 1)]
    sender.fenced(number)
    sender.message(0, SMALL)
    assert link.numbers == list(range(1, ROW + 3))
    assert link.bulk.terms[7] == DEFAULT, "they hold on"


DEFAULT = (core_limits.ROUTE_QUEUE_MESSAGES, mesh_limits.ROUTE_QUEUE_AGE, mesh_limits.ROUTE_BURST_BYTES, False)


@pytest.mark.parametrize(
    ("contract", "terms"),
    [
        (Contract(), DEFAULT),
        (Contract(depth=3), (3, None, 0, False)),
        (Contract(depth=core_limits.ROUTE_QUEUE_MESSAGES), (core_limits.ROUTE_QUEUE_MESSAGES, None, 0, False)),
        (Contract(lifespan=0.5), (core_limits.ROUTE_QUEUE_MESSAGES, 0.5, 0, False)),
        (Contract(depth=3, history=History.KEEP_ALL), (mesh_limits.KEEP_ALL_MESSAGES, None, 0, False)),
        (
            Contract(depth=3, lifespan=0.5, reliability=Reliability.RELIABLE),
            (mesh_limits.KEEP_ALL_MESSAGES, None, 0, True),
        ),
    ],
)
def test_both_lanes_get_the_bounds(contract: Contract, terms: tuple[object, ...]) -> None:
    link = Link()
    add(ExportFlow(), 1, link, 7, contract)
    assert link.express.terms == link.bulk.terms == {7: terms}


BEST_EFFORT = Contract()


def cut(sent: int, missed: int, after: int, contract: Contract = BEST_EFFORT, *, size: int = 1) -> list[int]:
    """The numbers that a second link carries, where the peer has what came up to ``after`` over the first one."""
    sender = RouteSender(Link(), 7, contract)
    for _ in range(sent):
        sender.message(0, bytes(size))
    sender.suspend()
    for _ in range(missed):
        sender.message(0, bytes(size))
    link = Link()
    following = sender.following
    sender.resume(link, 8, after)
    sender.message(0, bytes(size))
    assert not link.numbers or following <= link.numbers[0]
    assert sender.last == sent + missed + 1
    return link.numbers


def test_without_a_link_the_depth_bounds_what_waits() -> None:
    assert cut(5, 3, after=2, contract=Contract(depth=2)) == [7, 8, 9]
    assert cut(5, 0, after=2, contract=Contract(depth=1)) == [5, 6]


# --- best effort, in parts ------------------------------------------------------------------------------------

BIG = 300_000


# --- down-sampling --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hertz", [30.01, 29.99, 30.0])
def test_nearly_equal_rate_loses_only_the_surplus(clock: Clock, hertz: float) -> None:
    link, sender = fresh(best_effort, Contract(max_rate=30.0))
    for _ in range(9_000):
        sender.message(0, SMALL)
        clock.advance(1 / hertz)
    assert len(link.sent) >= 8_995


@settings(deadline=None, max_examples=60)
@given(st.sampled_from([1.0, 30.0, 200.0]), st.lists(st.floats(0, 3), min_size=1, max_size=80))
def test_rate_is_kept_and_the_newest_is_sent(rate: float, gaps: list[float]) -> None:
    with running(Clock()) as clock:
        link, went = Link(), []
        sender = best_effort(link, Contract(max_rate=rate))
        for number, gap in enumerate(gaps):
            before = len(link.sent)
            sender.message(number, number.to_bytes(4, "big"))
            if len(link.sent) > before:
                went.append(clock.now)
            until = clock.now + gap / rate
            while clock.now < until:
                before = len(link.sent)
                clock.advance(min([until, *(due for due in clock.due if due > clock.now)]) - clock.now)
                if len(link.sent) > before:
                    went.append(clock.now)
        clock.advance(10 / rate)
        order = [int.from_bytes(payload, "big") for _, _, payload in link.sent]
        assert order == sorted(set(order))
        assert order[-1] == len(gaps) - 1, "the newest is never lost"
        for first in range(len(went)):
            for last in range(first + 1, len(went)):
                assert last - first <= (went[last] - went[first]) * rate + 0.6 + 1e-3


def test_nothing_more_happens_when_it_is_closed(clock: Clock) -> None:
    link, sender = fresh(best_effort, Contract(max_rate=10.0))
    sender.message(0, b"a")
    sender.message(0, b"b")
    sender.close()
    clock.advance(1.0)
    assert len(link.sent) == 1
    held = best_effort(link, large=True)
    held.message(0, LARGE)
    held.close()
    answer(link, held)
    held.lane_lost()
    held.message(0, SMALL)
    held.acknowledged(3)
    assert not held.begin(0, BIG)
    assert len(link.sent) == 1


# --- reliable -------------------------------------------------------------------------------------------------


def test_later_acknowledgement_outweighs_the_position() -> None:
    """Of two links that come up at once, the message of the one that is given up comes last."""
    new, (_, sender) = Link(), fresh(reliable)
    for _ in range(3):
        sender.message(0, SMALL)
    sender.acknowledged(2)
    sender.suspend()
    sender.resume(new, 8, 1)
    assert new.numbers == [3]


class FallingLink(RuleBasedStateMachine):
    """Each lane brings what it likes when it likes; bulk falls, links fall; the peer leaves out what it has."""

    def __init__(self) -> None:
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.patch.setattr(mesh_limits, "RELIABLE_WINDOW_MESSAGES", 4)
        self.patch.setattr(mesh_limits, "EXPRESS_AGAIN_MESSAGES", 3)
        self.running = running(Clock())
        self.clock = self.running.__enter__()
        self.link = Link()
        self.sender = reliable(self.link)
        self.published = 0
        self.came = 0
        self.ways: dict[str, deque[tuple[str, int]]] = {"express": deque(), "bulk": deque()}
        self.marks: deque[tuple[str, int]] = deque()

    def collect(self) -> None:
        """What the sender gave to the lanes is under way."""
        for lane, kind, *rest in self.link.log:
            if kind == "discard":
                self.ways[str(lane)].clear()
            else:
                assert isinstance(rest[-1], int)
                self.ways[str(lane)].append((str(kind), rest[-1]))
        self.link.log.clear()

    @rule(payload=st.sampled_from([SMALL, LARGE]), count=st.integers(1, 5))
    def publish(self, payload: bytes, count: int) -> None:
        for _ in range(count):
            self.sender.message(0, payload)
        self.published += count
        self.collect()

    @rule(seconds=st.sampled_from([0.01, mesh_limits.EXPRESS_AGAIN_AFTER]))
    def wait(self, seconds: float) -> None:
        self.clock.advance(seconds)

    @rule(lane=st.sampled_from(["express", "bulk"]), count=st.sampled_from([1, 2, 1000]))
    def carry(self, lane: str, count: int) -> None:
        for _ in range(min(count, len(self.ways[lane]))):
            kind, number = self.ways[lane].popleft()
            if kind == "fence":
                self.marks.append(("fenced", number))
                continue
            assert number <= self.came + 1, "something is missing before it"
            self.came = max(self.came, number)
            self.marks.append(("ack", self.came))

    @precondition(lambda self: self.marks)
    @rule(count=st.sampled_from([1, 1000]))
    def mark(self, count: int) -> None:
        for _ in range(min(count, len(self.marks))):
            kind, number = self.marks.popleft()
            (self.sender.fenced if kind == "fenced" else self.sender.acknowledged)(number)
        self.collect()

    @rule(gone=st.integers(0, 3))
    def lose_bulk(self, gone: int) -> None:
        """What the connection had is lost; what waited for it in the lane's queue is not."""
        for _ in range(min(gone, len(self.ways["bulk"]))):
            self.ways["bulk"].popleft()
        self.sender.lane_lost()
        self.collect()

    @rule(meanwhile=st.integers(0, 3), payload=st.sampled_from([SMALL, LARGE]))
    def lose_link(self, meanwhile: int, payload: bytes) -> None:
        self.sender.suspend()
        self.link = Link()
        for way in self.ways.values():
            way.clear()
        self.marks.clear()
        for _ in range(meanwhile):
            self.sender.message(0, payload)
        self.published += meanwhile
        self.sender.resume(self.link, 7, self.came)
        self.collect()

    def teardown(self) -> None:
        """Everything that was published arrives."""
        try:
            for _ in range(self.published + 5):
                self.carry("express", 1000)
                self.carry("bulk", 1000)
                self.mark(1000)
            assert self.came == self.published
            assert self.sender.sender.idle
            assert not any(self.ways.values())
        finally:
            self.running.__exit__(None, None, None)
            self.patch.undo()
            super().teardown()


TestFallingLink = FallingLink.TestCase
TestFallingLink.settings = settings(max_examples=80, stateful_step_count=40, deadline=None)
