"""What a hostile program at the router can do to a gateway's session: bounds hold, each refusal is counted."""

from __future__ import annotations

import asyncio
import json
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.gateway import limits
from rmpa.gateway.zenoh.threads import ZenohQos
from tests.gateway.memory_zenoh import eventually

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterator

    from rmpa.gateway.zenoh.queries import ArrivedQuery
    from rmpa.gateway.zenoh.session import OpenSession
    from tests.gateway.zenoh_bed import ZenohBed

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
    monkeypatch.setattr(limits, "ANSWERS_WAITING_MAX", 3)
    taken: list[int] = []

    def answer(query: ArrivedQuery) -> None:
        for number in range(200):
            query.reply("q/q", bytes(200_000))
            taken.append(number)
        query.finish()

    victim.queryable("q/q", answer)
    await repeated(lambda: asyncio.to_thread(lambda: list(eve.get("q/q", timeout=2.0))), lambda _: taken)
    assert await counted(victim, "zenoh.answer.limit")
    publisher = victim.publisher(KEY, ZenohQos(), lambda _: None)
    publisher.put(b"it lives")
    await eventually(lambda: publisher.sent)
