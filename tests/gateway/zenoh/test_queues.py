"""Queues of a session, and what hostile programs send."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Any

import pytest

from rmpa.gateway import limits
from rmpa.gateway.zenoh.session import ArrivedQuery, OpenSession
from rmpa.gateway.zenoh.threads import ArrivalQueue, Arrivals, QueuedPublisher, SendingLane, ZenohQos
from tests.gateway.memory_zenoh import eventually
from tests.gateway.zenoh_bed import ZenohBed, put


class Handle:
    """A publisher of Zenoh, whose transport is full until it is free."""

    def __init__(self) -> None:
        self.free = threading.Event()
        self.got: list[bytes] = []

    def put(self, payload: bytes, *, attachment: bytes | None = None) -> None:
        if not self.free.wait(20):
            raise TimeoutError
        self.got.append(payload)


@pytest.fixture
async def lane() -> AsyncIterator[SendingLane]:
    made = SendingLane(asyncio.get_running_loop(), "test lane", (TimeoutError,))
    yield made
    made.stop()
    await asyncio.to_thread(made.thread.join, 20)
    assert not made.thread.is_alive()


def publisher(lane: SendingLane, handle: Handle, qos: ZenohQos, ended: list[str] | None = None) -> QueuedPublisher:
    made = QueuedPublisher(lane, "key", qos, lambda: ended.append("undeclared") if ended is not None else None)
    made.declared(handle)
    return made


async def test_behind_a_full_transport_the_oldest_are_dropped_and_all_are_counted(lane: SendingLane) -> None:
    handle = Handle()
    made = publisher(lane, handle, ZenohQos(messages=100))
    for number in range(1000):
        put(made, b"%d" % number)
    dropped = made.dropped
    assert made.waiting <= 100
    handle.free.set()
    await eventually(lambda: not made.waiting)
    assert handle.got[-1] == b"999"
    assert (made.sent, made.dropped, made.sent + made.dropped) == (len(handle.got), dropped, 1000)


async def test_a_message_larger_than_the_bound_still_goes_alone(lane: SendingLane) -> None:
    handle = Handle()
    made = publisher(lane, handle, ZenohQos(bytes=10))
    put(made, bytes(100))
    await eventually(lambda: not made._items)  # its turn has begun
    for size in (100, 200):
        put(made, bytes(size))
    assert made.dropped == 1
    handle.free.set()
    await eventually(lambda: not made.waiting)
    assert [len(each) for each in handle.got] == [100, 200]


async def test_a_flood_does_not_starve_another_publisher_of_its_priority(lane: SendingLane) -> None:
    handle = Handle()
    flood, other = publisher(lane, handle, ZenohQos(messages=5000)), publisher(lane, handle, ZenohQos())
    for _ in range(5000):
        put(flood, bytes(1000))
    put(other, b"other")
    handle.free.set()
    await eventually(lambda: not flood.waiting and not other.waiting)
    assert handle.got.index(b"other") <= 130


async def test_a_publisher_that_cannot_send_is_undeclared_after_a_second_and_counts_the_rest(
    lane: SendingLane,
) -> None:
    handle, ended = Handle(), list[str]()
    made = publisher(lane, handle, ZenohQos(), ended)
    for _ in range(200):
        put(made, b"x")
    made.close()
    await eventually(lambda: ended)
    assert made.dropped >= 200 - 64
    handle.free.set()
    await eventually(lambda: not made.waiting)
    assert made.sent + made.dropped == 200
    assert ended == ["undeclared"]


async def test_what_zenoh_refuses_counts_as_dropped(lane: SendingLane) -> None:
    class Closed(Handle):
        def put(self, payload: bytes, *, attachment: bytes | None = None) -> None:
            raise TimeoutError

    made = publisher(lane, Closed(), ZenohQos())
    put(made, b"x")
    await eventually(lambda: made.dropped == 1)
    assert made.sent == 0


@pytest.mark.parametrize(
    ("sizes", "left"), [([1] * 100, 10), ([400] * 10 + [5000], 1)], ids=["by their number", "by their bytes"]
)
async def test_while_the_loop_is_away_the_oldest_arrivals_are_dropped_and_counted(
    sizes: list[int], left: int
) -> None:
    got: list[int] = []
    discarded: list[int] = []
    queue = ArrivalQueue(Arrivals(asyncio.get_running_loop()), got.append, 10, 1000, discarded.append)

    def flood() -> None:
        for number, size in enumerate(sizes):
            queue.add(number, size)

    thread = threading.Thread(target=flood)
    thread.start()
    thread.join()
    await eventually(lambda: len(got) == left)
    numbers = list(range(len(sizes)))
    assert (got, discarded, queue.dropped) == (numbers[-left:], numbers[:-left], len(sizes) - left)


async def test_an_error_of_one_subscriber_keeps_nothing_from_the_others(caplog: pytest.LogCaptureFixture) -> None:
    got: list[int] = []
    arrivals = Arrivals(asyncio.get_running_loop())

    def fails(_: int) -> None:
        raise ZeroDivisionError

    broken, whole = ArrivalQueue(arrivals, fails, 10, 10), ArrivalQueue(arrivals, got.append, 10, 10)
    broken.add(1)
    whole.add(2)
    await eventually(lambda: got)
    assert "could not be handled" in caplog.text


zenoh = pytest.importorskip("zenoh")

KEY = "rmpa/1/hall/arm/t/std_msgs%String/chatter"


@pytest.fixture
async def victim(net: ZenohBed) -> OpenSession:
    return await net.session()


@pytest.fixture
def eve(net: ZenohBed) -> Iterator[Any]:
    """A program of its own at the router."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([net.endpoint]))
    session = zenoh.open(config)
    yield session
    session.close()


async def repeated(ask: Callable[[], Awaitable[Any]], done: Callable[[Any], object]) -> Any:
    """Ask until it is done: a declaration needs a moment to be known."""
    async with asyncio.timeout(20):
        while not done(answer := await ask()):
            await asyncio.sleep(0.02)
    return answer


async def counted(session: OpenSession, reason: str) -> int:
    """Wait until something was refused for this reason; return how often."""

    async def taken() -> int:
        return session.take_refused().get(reason, 0)

    return int(await repeated(taken, bool))


@pytest.mark.parametrize(
    ("bound", "most", "size", "sizes"),
    [("REPLIES_MAX", 100, 100, [100] * 100), ("REPLY_BYTES_MAX", 100_000, 150_000, [150_000])],
    ids=["answers", "bytes of answers, of which one always comes"],
)
async def test_answers_that_never_end_are_bounded_and_the_query_ends_with_the_first(
    victim: OpenSession,
    eve: Any,
    monkeypatch: pytest.MonkeyPatch,
    bound: str,
    most: int,
    size: int,
    sizes: list[int],
) -> None:
    monkeypatch.setattr(limits, bound, most)
    stop = asyncio.Event()

    def answer(query: Any) -> None:
        for _ in range(20_000):
            if stop.is_set():
                break
            query.reply(query.key_expr, b"x" * size)

    queryable = eve.declare_queryable("a/b", answer, complete=True)
    replies = await repeated(lambda: victim.get("a/b", timeout=10.0), len)
    stop.set()
    assert [len(reply.payload) for reply in replies] == sizes
    assert await counted(victim, "zenoh.reply.limit")
    await asyncio.to_thread(queryable.undeclare)


async def test_messages_and_queries_with_giant_attachments_are_dropped_and_counted(
    victim: OpenSession, eve: Any
) -> None:
    got: list[bytes] = []
    asked: list[bytes] = []

    def answer(query: ArrivedQuery) -> None:
        asked.append(query.attachment)
        query.finish()

    victim.subscribe(KEY, lambda sample: got.append(sample.payload))
    victim.queryable("q/q", answer)
    publisher = eve.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
    await eventually(lambda: publisher.matching_status.matching)
    publisher.put(b"giant", attachment=b"a" * 1_000_000)
    publisher.put(b"fits", attachment=b"a" * limits.ATTACHMENT_MAX)
    await eventually(lambda: got == [b"fits"])
    assert await counted(victim, "zenoh.attachment.long") == 1

    async def ask(size: int) -> None:
        await asyncio.to_thread(lambda: list(eve.get("q/q", attachment=b"a" * size, timeout=1.0)))

    await repeated(lambda: ask(1), lambda _: asked)
    await ask(1_000_000)
    assert await counted(victim, "zenoh.attachment.long") == 1
    assert set(asked) == {b"a"}


async def test_giant_keys_are_dropped_and_counted(victim: OpenSession, eve: Any) -> None:
    tokens: list[str] = []
    victim.watch_tokens("rmpa/1/**", lambda key, _: tokens.append(key))
    long = "rmpa/1/" + "a" * 2 * limits.ZENOH_KEY_MAX
    held = [eve.liveliness().declare_token(key) for key in (long, "rmpa/1/hall/arm/up/00")]
    await eventually(lambda: tokens == ["rmpa/1/hall/arm/up/00"])
    assert await counted(victim, "zenoh.key.long")
    for token in held:
        await asyncio.to_thread(token.undeclare)


async def test_a_client_that_asks_and_does_not_read_fills_no_memory(
    victim: OpenSession, eve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Answers wait in order for Zenoh; what is beyond the bound ends its query."""
    monkeypatch.setattr(limits, "ANSWERS_WAITING_MAX", 1)
    taken: list[ArrivedQuery] = []
    held: list[Any] = []

    def answer(query: ArrivedQuery) -> None:
        query.reply(bytes(200_000))
        taken.append(query)

    def ask() -> None:
        held.extend(eve.get("q/q", timeout=5.0) for _ in range(200))

    victim.queryable("q/q", answer)
    await repeated(lambda: asyncio.to_thread(ask), lambda _: len(taken) > 100)
    assert await counted(victim, "zenoh.answer.limit")
    publisher = victim.publisher(KEY, ZenohQos(), lambda _: None)
    put(publisher, b"it lives")
    await eventually(lambda: publisher.sent)
