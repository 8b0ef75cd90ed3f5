"""What a hostile program at the router can do to a gateway's session: bounds hold, each refusal is counted."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.gateway import limits
from rmpa.gateway.zenoh.threads import ZenohQos
from tests.gateway.zenoh_bed import ZenohBed, bed, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from rmpa.gateway.zenoh.queries import ArrivedQuery
    from rmpa.gateway.zenoh.session import OpenSession

zenoh = pytest.importorskip("zenoh")

KEY = "rmpa/1/hall/arm/t/std_msgs%String/chatter"


@pytest.fixture
async def net() -> AsyncIterator[ZenohBed]:
    async with bed() as made:
        yield made


@pytest.fixture
def eve(net: ZenohBed) -> Iterator[Any]:
    """A program of its own at the router."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([net.endpoint]))
    session = zenoh.open(config)
    yield session
    session.close()


async def counted(session: OpenSession, reason: str) -> int:
    """Wait until something was refused for this reason; return how often."""
    total = 0
    async with asyncio.timeout(20):
        while not total:
            total += session.take_refused().get(reason, 0)
            await asyncio.sleep(0.01)
    return total


async def test_answers_that_never_end_are_bounded_and_the_query_ends_with_the_first(
    net: ZenohBed, eve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "REPLIES_MAX", 100)
    victim = await net.session()
    stop = asyncio.Event()

    def answer(query: Any) -> None:
        for _ in range(20_000):
            if stop.is_set():
                break
            query.reply(query.key_expr, b"x" * 100)

    queryable = eve.declare_queryable("a/b", answer, complete=True)
    async with asyncio.timeout(20):
        while not (replies := await victim.get("a/b", timeout=10.0)):
            await asyncio.sleep(0.02)
    stop.set()
    assert len(replies) == 100
    assert await counted(victim, "zenoh.reply.limit")
    await asyncio.to_thread(queryable.undeclare)


async def test_one_large_answer_comes_and_the_bytes_of_more_are_bounded(
    net: ZenohBed, eve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "REPLY_BYTES_MAX", 100_000)
    victim = await net.session()

    def answer(query: Any) -> None:
        for _ in range(3):
            query.reply(query.key_expr, b"x" * 150_000)

    queryable = eve.declare_queryable("a/b", answer, complete=True)
    async with asyncio.timeout(20):
        while not (replies := await victim.get("a/b", timeout=5.0)):
            await asyncio.sleep(0.02)
    assert [len(reply.payload) for reply in replies] == [150_000]
    await asyncio.to_thread(queryable.undeclare)


async def test_messages_and_queries_with_giant_attachments_are_dropped_and_counted(net: ZenohBed, eve: Any) -> None:
    victim = await net.session()
    got: list[bytes] = []
    asked: list[bytes] = []

    def answer(query: ArrivedQuery) -> None:
        asked.append(query.attachment)
        query.finish()

    victim.subscribe(KEY, lambda sample: got.append(sample.payload))
    victim.queryable("q/q", answer)
    publisher = eve.declare_publisher(KEY, congestion_control=zenoh.CongestionControl.BLOCK)
    await until(lambda: publisher.matching_status.matching)
    publisher.put(b"giant", attachment=b"a" * 1_000_000)
    publisher.put(b"fits", attachment=b"a" * limits.ATTACHMENT_MAX)
    await until(lambda: got)
    assert got == [b"fits"]
    assert await counted(victim, "zenoh.attachment.long") == 1

    def ask(size: int) -> None:
        list(eve.get("q/q", attachment=b"a" * size, timeout=1.0))

    async with asyncio.timeout(20):
        while b"a" not in asked:
            await asyncio.to_thread(ask, 1)
    await asyncio.to_thread(ask, 1_000_000)
    assert await counted(victim, "zenoh.attachment.long") == 1
    assert set(asked) == {b"a"}


async def test_giant_keys_are_dropped_and_counted(net: ZenohBed, eve: Any) -> None:
    victim = await net.session()
    tokens: list[str] = []
    victim.watch_tokens("rmpa/1/**", lambda key, _: tokens.append(key))
    long = "rmpa/1/" + "a" * 2 * limits.ZENOH_KEY_MAX
    held = [eve.liveliness().declare_token(key) for key in (long, "rmpa/1/hall/arm/up/00")]
    await until(lambda: tokens)
    assert tokens == ["rmpa/1/hall/arm/up/00"]
    assert await counted(victim, "zenoh.key.long")
    for token in held:
        await asyncio.to_thread(token.undeclare)


async def test_a_client_that_asks_and_does_not_read_fills_no_memory(
    net: ZenohBed, eve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Answers wait in order for Zenoh; what is beyond the bound ends its query."""
    monkeypatch.setattr(limits, "ANSWERS_WAITING_MAX", 3)
    victim = await net.session()
    taken: list[int] = []

    def answer(query: ArrivedQuery) -> None:
        for number in range(200):
            query.reply("q/q", bytes(200_000))
            taken.append(number)
        query.finish()

    victim.queryable("q/q", answer)
    async with asyncio.timeout(20):
        while not taken:
            await asyncio.to_thread(lambda: list(eve.get("q/q", timeout=2.0)))
    assert await counted(victim, "zenoh.answer.limit")
    publisher = victim.publisher(KEY, ZenohQos(), lambda _: None)
    publisher.put(b"it lives")
    await until(lambda: publisher.sent)
