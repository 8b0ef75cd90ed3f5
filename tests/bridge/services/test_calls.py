from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.data.reception import LinkTime
from rmpa.bridge.services.bodies import BodyReceiver, BodySender, Budget, LocalService, ServicePool
from rmpa.bridge.services.calls import Budgets, CallStats, Server, ShownService
from rmpa.core import limits as core_limits
from rmpa.core.errors import LimitExceeded, RemoteProtocolError, RmpaError
from rmpa.core.outbox import ABORT, FIRST, LAST, Outbox, QueuedMessage
from rmpa.mesh import limits as mesh_limits
from rmpa.ros import limits as ros_limits
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import ServiceDescription
from rmpa.runtime.tls import Buffer

# Calls over a route: every byte arrives, in whichever size; whoever will get no answer is told so at once.


DESCRIPTION = ServiceDescription("a/Add", "6a2e34150c00229791cc89ff309fff21")


SMALL = b"x" * 100


MIDDLE = bytes(range(256)) * 64


LARGE = bytes(range(251)) * 4000


class Lane:
    """One lane that hands on at once; ``slow`` keeps what comes."""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        self.outbox = Outbox(10, 1 << 20)
        self.ended = False
        self.slow = False
        self.kept: list[Callable[[], None]] = []
        self.sent = 0

    def send(self, route: int, sequence: int, stamp_ns: int, payload: Buffer) -> int:
        assert len(payload) <= core_limits.FRAGMENT_BYTES
        framed = memoryview(bytes(payload))
        self._go(lambda: self.wire.takers[route].message(sequence, stamp_ns, framed))
        return 0

    def open(self, route: int, size: int, sequence: int, stamp_ns: int) -> QueuedMessage:
        return QueuedMessage(route, size, sequence, stamp_ns)

    def extend(self, parcel: QueuedMessage, data: Buffer) -> int:
        view = memoryview(bytes(data))
        for start in range(0, len(view), core_limits.FRAGMENT_BYTES):
            part = view[start : start + core_limits.FRAGMENT_BYTES]
            flags = (0 if parcel.sent else FIRST) | LAST * (parcel.sent + len(part) == parcel.size)
            parcel.sent += len(part)
            self._go(
                lambda flags=flags, part=part: self.wire.takers[parcel.key].part(  # type: ignore[misc]
                    parcel.sequence, parcel.stamp_ns, flags, part
                )
            )
        return 0

    def set_terms(self, route: int, depth: int, max_age: float | None = None, *, spared: bool = False) -> None:
        assert (depth, max_age, spared) == (mesh_limits.KEEP_ALL_MESSAGES, None, True), (
            "nothing of a call may be dropped"
        )

    def _go(self, deliver: Callable[[], None]) -> None:
        self.sent += 1
        if self.slow:
            self.kept.append(deliver)
        else:
            deliver()


class Wire(Any):  # type: ignore[misc] # a double of what is much larger
    """A link's one direction; ``takers`` are the other side's."""

    def __init__(self) -> None:
        self.express, self.bulk = Lane(self), Lane(self)
        self.takers: dict[int, BodyReceiver] = {}
        self.closed: list[int] = []
        self.unproven: list[Callable[[], None]] | None = None

    def when_proven(self, act: Callable[[], None]) -> None:
        if self.unproven is None:
            act()
        else:
            self.unproven.append(act)

    def close_route(self, route: int) -> int:
        self.closed.append(route)
        return 0


class Kept(BodyReceiver):
    """Keeps what comes."""

    def __init__(self, budget: Budget | None = None) -> None:
        super().__init__(budget or Budget())
        self.bodies: list[tuple[int, bytes]] = []
        self.failures: list[tuple[int, str]] = []

    def body(self, sequence: int, body: bytes | bytearray) -> None:
        self.bodies.append((sequence, bytes(body)))

    def failed(self, sequence: int, reason: str) -> None:
        self.failures.append((sequence, reason))


class Call:
    """A client's request at a proxy."""

    def __init__(self, request: bytes) -> None:
        self.request = request
        self.deadline = asyncio.get_running_loop().time() + 5
        self.on_gone: Callable[[], None] | None = None
        self.answer: tuple[bool, bytes] | None = None

    def reply(self, ok: bool, body: Buffer) -> None:
        assert self.answer is None
        self.answer = (ok, bytes(body))

    def fail(self, text: str) -> None:
        self.reply(False, text.encode())

    @property
    def text(self) -> str:
        assert self.answer is not None
        assert not self.answer[0]
        return self.answer[1].decode()


class Pool:
    """The server: answers with the request backwards, unless it is told to wait."""

    service = "/add"

    def __init__(self) -> None:
        self.waiting: list[tuple[bytes, Callable[[bool, Buffer], None]]] | None = None
        self.timeouts: list[float] = []

    def call(self, body: Buffer, timeout: float, done: Callable[[bool, Buffer], None]) -> None:
        self.timeouts.append(timeout)
        if self.waiting is not None:
            self.waiting.append((bytes(body), done))
        elif bytes(body) == b"fail":
            done(False, b"it sticks")
        else:
            done(True, bytes(body)[::-1])


class Ends:
    """A caller and a server with a wire each way."""

    def __init__(self) -> None:
        self.there, self.back = Wire(), Wire()
        self.pool = Pool()
        self.served = CallStats()
        self.budgets, self.budgets_there = Budgets(), Budgets()
        self.there.name = "base"
        remote: Any = SimpleNamespace(name="/add", requests=2)
        session: Any = SimpleNamespace(link=self.there)
        self.wanted: list[ShownService] = []
        self.caller = ShownService(remote, session, self.wanted.append)
        self.caller.open(DESCRIPTION, self.budgets)
        self.stats = self.caller.stats
        self.time = LinkTime()
        self.server = Server(
            self.back, 1, cast("ServicePool", self.pool), 7.0, self.budgets_there, self.served, self.time
        )
        self.there.takers[2] = self.server
        self.back.takers[1] = self.caller

    def call(self, request: bytes) -> Call:
        call = Call(request)
        self.caller.call(cast("ServiceCall", call))
        return call

    def assert_nothing_held(self) -> None:
        held = [b.used for pair in (self.budgets, self.budgets_there) for b in (pair.outgoing, pair.incoming)]
        assert held == [0, 0, 0, 0]
        assert (self.stats.active, self.served.active, self.caller.active) == (0, 0, 0)


async def _answered(*calls: Call) -> None:
    async with asyncio.timeout(20):
        while any(call.answer is None for call in calls):
            await asyncio.sleep(0)
    await asyncio.sleep(0)


@pytest.mark.parametrize("whole", [True, False])
async def test_a_request_whose_caller_has_given_it_up_is_not_passed_to_the_server(whole: bool) -> None:
    ends, answers = Ends(), Kept()
    ends.pool.waiting = []
    ends.back.takers[1] = answers
    ends.time.set(60.0, 0.5)  # the caller's clock is a minute ahead, half a second more or less

    def come(age: float) -> None:
        stamp_ns = time.time_ns() + int((60.0 - age) * 1e9)
        framed = memoryview(len(SMALL).to_bytes(4, "little") + SMALL)
        if whole:
            ends.server.message(1, stamp_ns, framed)
        else:
            ends.server.part(1, stamp_ns, FIRST, framed[:50])
            ends.server.part(1, stamp_ns, LAST, framed[50:])

    come(1.0)
    assert len(ends.pool.waiting) == 1
    come(20.0)
    assert b"s late; the caller waits for 7 s" in answers.bodies[-1][1]
    ends.back.unproven = []  # the caller may have ended the link, whatever its clock says
    come(0.0)
    come(5.0)
    assert len(ends.pool.waiting) == 1
    for act in ends.back.unproven:
        act()
    assert len(ends.pool.waiting) == 3
    come(0.0)
    ends.server.close()
    ends.back.unproven[-1]()
    assert len(ends.pool.waiting) == 3, "the caller has left meanwhile"
    assert len(answers.bodies) == 1


async def test_calls_of_every_size_at_once_by_the_lane_of_their_size() -> None:
    ends = Ends()
    requests = [b"", SMALL, MIDDLE, LARGE, SMALL + b"2", MIDDLE + b"2", LARGE + b"2", b"fail"]
    calls = [ends.call(request) for request in requests]
    await _answered(*calls)
    for call in calls[:-1]:
        assert call.answer == (True, call.request[::-1])
    assert calls[-1].text == "it sticks"
    assert ends.there.express.sent == ends.back.express.sent == 4
    assert ends.there.bulk.sent > 4
    assert (ends.stats.calls, ends.stats.failed, ends.stats.problem) == (8, 1, "it sticks")
    assert (ends.served.calls, ends.served.failed) == (8, 1)
    assert len(ends.stats.latencies) == 7
    assert set(ends.pool.timeouts) == {7.0 + limits.SERVICE_GRACE}
    ends.assert_nothing_held()


async def test_a_client_that_leaves_wants_no_answer() -> None:
    ends = Ends()
    ends.pool.waiting = []
    call = ends.call(LARGE)
    async with asyncio.timeout(20):
        while not ends.pool.waiting:
            await asyncio.sleep(0)
    assert call.on_gone is not None
    call.on_gone()
    assert ends.stats.problem == "the client left in the middle of the call"
    ends.pool.waiting[0][1](True, LARGE)
    await asyncio.sleep(0)
    while ends.server._sender._task is not None:
        await asyncio.sleep(0)
    assert call.answer is None
    ends.assert_nothing_held()


async def test_who_waits_when_the_service_is_closed_is_told_why() -> None:
    ends = Ends()
    ends.pool.waiting = []
    calls = [ends.call(SMALL), ends.call(LARGE)]
    ends.caller.close("the link to base was lost")
    assert {call.text for call in calls} == {"service [/add] of base: the link to base was lost"}
    assert ends.there.closed == [2]
    ends.server.close()
    for _, done in ends.pool.waiting:
        done(True, SMALL)
    assert ends.back.express.sent == 0
    ends.assert_nothing_held()


async def test_a_reply_that_is_lost_with_the_bulk_lane_is_an_error() -> None:
    ends = Ends()
    ends.back.bulk.slow = True
    call = ends.call(b"small")
    ends.pool.waiting = []
    other = ends.call(SMALL)
    ends.pool.waiting[0][1](True, LARGE)
    while ends.server._sender._task is not None:
        await asyncio.sleep(0)
    ends.back.bulk.kept[0]()
    ends.caller.lane_lost()
    ends.server.lane_lost()
    assert call.answer == (True, b"llams")
    assert "the connection for large messages was lost" in other.text
    ends.assert_nothing_held()


async def test_a_request_on_the_bulk_lane_when_it_is_lost_is_an_error() -> None:
    ends = Ends()
    ends.there.bulk.slow = True
    large, small = ends.call(MIDDLE), ends.call(SMALL)
    ends.caller.lane_lost()
    assert "was lost in the middle of the call" in large.text
    assert small.answer == (True, SMALL[::-1])


async def test_more_than_the_budget_is_refused_and_the_rest_goes_on() -> None:
    ends = Ends()
    ends.budgets.outgoing.limit = 2 * len(MIDDLE)
    ends.pool.waiting = []
    calls = [ends.call(MIDDLE) for _ in range(3)]
    assert "of calls are under way; try again later" in calls[2].text
    ends.budgets.outgoing.limit = 1 << 20
    ends.budgets_there.incoming.limit = 1
    late = ends.call(SMALL)
    assert "requests are being served" in late.text
    ends.budgets_there.outgoing.limit = len(MIDDLE)
    for _, done in ends.pool.waiting:
        done(True, MIDDLE)
    await _answered(*calls)
    assert [call.answer and call.answer[0] for call in calls] == [True, True, False]
    ends.assert_nothing_held()


async def test_a_slow_link_holds_up_only_what_is_larger_than_it_takes() -> None:
    """Of a large body no more is copied than may wait; small ones go past it."""
    ends = Ends()
    pending = SimpleNamespace(pending_bytes=1 << 30)
    ends.there.bulk.outbox = cast("Outbox", pending)
    large = ends.call(LARGE)
    for _ in range(5):
        await asyncio.sleep(0)
    sent = ends.there.bulk.sent
    assert ends.call(SMALL).answer == (True, SMALL[::-1])
    assert ends.there.bulk.sent == sent
    pending.pending_bytes = 0
    await _answered(large)
    assert large.answer == (True, LARGE[::-1])


@given(st.lists(st.sampled_from([0, 1, 8191, 8192, 8193, 131067, 131068, 131069, 300_000]), max_size=6))
@settings(deadline=None)
def test_bodies_arrive_whole_and_once(sizes: list[int]) -> None:
    async def run() -> None:
        wire, kept = Wire(), Kept()
        wire.takers[5] = kept
        sender = BodySender(wire, 5)
        bodies = [(number, bytes([number]) * size) for number, size in enumerate(sizes)]
        for number, body in bodies:
            sender.send(number, body, b"!")
        while sender._task is not None:
            await asyncio.sleep(0)
        assert sorted(kept.bodies) == [(number, b"!" + body) for number, body in bodies]
        assert kept._budget.used == 0

    asyncio.run(run())


@pytest.mark.parametrize(
    ("parts", "error"),
    [
        ([(FIRST, b"\1\0")], RemoteProtocolError),
        ([(FIRST, (ros_limits.SERVICE_MESSAGE_MAX + 2).to_bytes(4, "little"))], LimitExceeded),
        ([(FIRST, b"\2\0\0\0"), (0, b"abc")], RemoteProtocolError),
        ([(FIRST, b"\2\0\0\0"), (LAST, b"a")], RemoteProtocolError),
    ],
)
def test_parts_that_cannot_be_break_the_protocol(parts: list[tuple[int, bytes]], error: type[Exception]) -> None:
    taker = Kept()

    def take() -> None:
        for flags, part in parts:
            taker.part(1, 0, flags, memoryview(part))

    with pytest.raises(error):
        take()


@pytest.mark.parametrize("payload", [b"", b"\0\0\0", b"\3\0\0\0hi", b"\1\0\0\0hi"])
def test_a_frame_that_does_not_hold_one_body_breaks_the_protocol(payload: bytes) -> None:
    taker = Kept()
    with pytest.raises(RemoteProtocolError, match="does not hold one message"):
        taker.message(1, 0, memoryview(payload))
    assert not taker.bodies


def test_parts_that_are_not_followed_are_told_and_let_go() -> None:
    taker = Kept()
    taker.part(1, 0, FIRST, memoryview(b"\4\0\0\0ab"))
    taker.part(1, 0, LAST | ABORT, memoryview(b""))
    taker.part(2, 0, FIRST, memoryview(b"\4\0\0\0ab"))
    taker.part(3, 0, FIRST, memoryview(b"\1\0\0\0"))
    taker.part(2, 0, LAST, memoryview(b"cd"))
    taker.part(3, 0, LAST, memoryview(b"x"))
    assert [sequence for sequence, _ in taker.failures] == [1, 2]
    assert taker.bodies == [(3, b"x")]
    assert taker._budget.used == 0


# The connections to one server: calls at once, each over its own, and no call lost with one that was closed.


MD5 = "6a2e34150c00229791cc89ff309fff21"


class Desk:
    """A server whose calls wait to be answered, and a pool for it."""

    def __init__(self, node: SlaveNode) -> None:
        self.node = node
        self.calls: list[ServiceCall] = []
        self.lost = 0
        self.endpoint = ServiceEndpoint(
            "/add", "/adder", self.calls.append, description=ServiceDescription("a/Add", MD5), timeout=30.0
        )
        node.add_service(self.endpoint)
        self.pool = ServicePool("/add", LocalService("/adder", node.service_uri), self._lost)
        self.answers: dict[bytes, tuple[bool, bytes]] = {}

    def _lost(self) -> None:
        self.lost += 1

    def call(self, body: bytes, timeout: float = 20.0) -> None:
        def done(ok: bool, answer: Buffer) -> None:
            assert body not in self.answers
            self.answers[body] = ok, bytes(answer)

        self.pool.call(body, timeout, done)

    async def until(self, *, calls: int = 0, answers: int = 0, lost: int = 0) -> None:
        async with asyncio.timeout(20):
            while len(self.calls) < calls or len(self.answers) < answers or self.lost < lost:
                await asyncio.sleep(0.001)


@pytest.fixture
async def desk() -> AsyncIterator[Desk]:
    node = SlaveNode("/adder", "127.0.0.1", "http://127.0.0.1:1/")
    await node.start()
    made = Desk(node)
    yield made
    made.pool.close("the test ends")
    await made.pool.closed()
    await node.close()


async def test_calls_are_made_at_once_as_far_as_may_be_and_the_rest_waits(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "SERVICE_POOL", 3)
    monkeypatch.setattr(limits, "SERVICE_QUEUE", 4)
    for number in range(6):
        desk.call(b"%d" % number)
        if number == 2:
            await desk.until(calls=3)
    assert len(desk.calls) == desk.pool.size == 3
    for number in (6, 7):
        desk.call(b"%d" % number)
    assert b"calls wait for its server already" in desk.answers[b"7"][1]
    for number in range(7):
        await desk.until(calls=number + 1)
        desk.calls[number].reply(True, desk.calls[number].request)
    await desk.until(answers=8)
    assert sum(ok for ok, _ in desk.answers.values()) == 7


async def test_a_connection_that_the_server_closed_meanwhile_is_replaced(desk: Desk) -> None:
    await desk.pool.describe()
    desk.endpoint.withdraw()
    desk.node.remove_service("/add")
    desk.node.add_service(
        ServiceEndpoint("/add", "/adder", desk.calls.append, description=ServiceDescription("a/Add", MD5))
    )
    desk.call(b"1")
    await desk.until(calls=1)
    desk.calls[0].reply(True, b"one")
    await desk.until(answers=1)
    assert desk.answers[b"1"] == (True, b"one")
    desk.node.remove_service("/add")


async def test_a_server_that_is_not_there(desk: Desk) -> None:
    port = desk.node.service_uri.rpartition(":")[2]
    await desk.node.close()
    for body in (b"1", b"2"):
        desk.call(body)
    await desk.until(answers=2, lost=1)
    assert all(not ok and port.encode() in text for ok, text in desk.answers.values())
    with pytest.raises(RmpaError):
        await desk.pool.describe()


async def test_a_call_whose_time_is_over_costs_its_connection(desk: Desk) -> None:
    desk.call(b"1", timeout=0.05)
    await desk.until(calls=1, answers=1)
    assert b"no answer within" in desk.answers[b"1"][1]
    assert desk.pool.size == 0


async def test_what_nobody_uses_is_closed(desk: Desk) -> None:
    await desk.pool.describe()
    now = asyncio.get_running_loop().time()
    desk.pool.close_idle(now - 10)
    assert not desk.pool.unused
    desk.pool.close_idle(now + 10)
    assert desk.pool.unused


async def test_the_end_answers_everybody(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SERVICE_POOL", 1)
    for body in (b"1", b"2"):
        desk.call(body)
    await desk.until(calls=1)
    desk.pool.close("its server has gone")
    await desk.until(answers=2)
    assert b"its server has gone" in desk.answers[b"2"][1]
    assert not desk.answers[b"1"][0]
