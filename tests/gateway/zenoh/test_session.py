"""A session against real routers and sessions of eclipse-zenoh, on loopback."""

from __future__ import annotations

import pytest

from rmpa.core.errors import StartError
from rmpa.gateway.zenoh.config import ZenohConfig
from rmpa.gateway.zenoh.session import ArrivedQuery, OpenSession, open_session
from rmpa.gateway.zenoh.threads import QueuedPublisher, ZenohPriority, ZenohQos, ZenohSample
from tests.gateway.memory_zenoh import eventually
from tests.gateway.zenoh_bed import ZenohBed, free_port, put

pytest.importorskip("zenoh")

Pair = tuple[OpenSession, OpenSession]


async def matched(sender: OpenSession, cache: int = 0) -> QueuedPublisher:
    """A publisher of t/x, once it has a subscriber."""
    matching: list[bool] = []
    publisher = sender.publisher("t/x", ZenohQos(cache=cache), matching.append)
    await eventually(lambda: matching and matching[-1])
    return publisher


async def ready(client: OpenSession, *servers: OpenSession) -> None:
    """Wait until the client hears of what the servers declared before."""
    heard: set[str] = set()  # a token may be told twice: as one that is there, and as a new one
    for number, server in enumerate(servers):
        server.token(f"ready/{number}")
    client.watch_tokens("ready/*", lambda key, _: heard.add(key))
    await eventually(lambda: len(heard) == len(servers))


async def test_a_burst_arrives_whole_and_in_order_with_key_and_attachment_also_from_a_closed_publisher(
    pair: Pair,
) -> None:
    sender, receiver = pair
    got: list[ZenohSample] = []
    receiver.subscribe("t/*", got.append)
    publisher = await matched(sender)
    for number in range(1000):
        put(publisher, b"%d" % number, b"a%d" % number)
    await eventually(lambda: len(got) == 1000)
    assert [sample.payload for sample in got] == [b"%d" % number for number in range(1000)]
    assert got[7].attachment == b"a7"
    assert (publisher.sent, publisher.dropped, publisher.waiting) == (1000, 0, 0)
    for _ in range(500):
        put(publisher, bytes(10_000))
    publisher.close()
    await eventually(lambda: len(got) == 1500)
    put(publisher, b"late")
    assert publisher.dropped == 1


async def test_a_late_subscriber_gets_what_the_cache_keeps_and_an_early_one_gets_it_once(pair: Pair) -> None:
    sender, receiver = pair
    early: list[bytes] = []
    late: list[bytes] = []
    receiver.subscribe("t/x", lambda sample: early.append(sample.payload), history=True)
    publisher = await matched(sender, cache=1)
    put(publisher, b"first")
    put(publisher, b"last")
    await eventually(lambda: b"last" in early)
    receiver.subscribe("t/x", lambda sample: late.append(sample.payload), history=True)
    await eventually(lambda: late)
    assert (early, late) == ([b"first", b"last"], [b"last"])
    for number in range(200):  # ros2/rmw_zenoh#710: a history that is replayed must not stop the publisher
        put(publisher, b"%d" % number)
    await eventually(lambda: early[-1] == late[-1] == b"199")
    assert (len(early), len(late)) == (202, 201)


async def test_tokens_are_told_to_early_and_late_watchers_and_go_with_their_session(pair: Pair) -> None:
    owner, watcher = pair
    seen: list[tuple[str, bool]] = []
    late: list[tuple[str, bool]] = []
    watcher.watch_tokens("up/**", lambda key, alive: seen.append((key, alive)))
    tokens = [owner.token(f"up/{number}") for number in range(3)]
    await eventually(lambda: len(seen) == 3)
    tokens[1].close()
    await eventually(lambda: seen[-1] == ("up/1", False))
    watcher.watch_tokens("up/**", lambda key, alive: late.append((key, alive)))
    await eventually(lambda: len(late) == 2)
    await owner.close()
    await eventually(lambda: len(seen) == 6)
    assert set(seen[4:]) == {("up/0", False), ("up/2", False)}


async def test_queries_are_answered_refused_left_without_an_answer_and_not_asked(pair: Pair) -> None:
    server, client = pair
    kept: list[ArrivedQuery] = []

    def answer(query: ArrivedQuery) -> None:
        if query.payload == b"fail":
            query.reply_error("no such bone")
        elif query.payload == b"hang":
            kept.append(query)
        elif query.payload == b"ask":
            query.reply(b"one", b"att")
        else:
            query.finish()

    server.queryable("s/*", answer)
    await ready(client, server)
    (reply,) = await client.get("s/y?a=1", b"ask", priority=ZenohPriority.REAL_TIME)
    assert (reply.payload, reply.attachment, reply.ok) == (b"one", b"att", True)
    (refused,) = await client.get("s/y", b"fail")
    assert (refused.ok, refused.payload) == (False, b"no such bone")
    assert await client.get("s/y", b"nothing") == []
    assert await client.get("elsewhere") == []
    assert await client.get("s/y", b"hang", timeout=0.3) == []
    kept.pop().finish()  # it came, and ended by its time-out


async def test_a_session_that_cannot_be_opened_says_where_why_and_what_to_do(net: ZenohBed) -> None:
    port = free_port()
    with pytest.raises(StartError, match=rf"zenoh tcp/127\.0\.0\.1:{port}: .*connect.*; .*--connect") as refused:
        await open_session(ZenohConfig(connect=(f"tcp/127.0.0.1:{port}",)))
    assert "cargo" not in str(refused.value)
    with pytest.raises(StartError, match=r"Address already in use.*; choose another --listen"):
        await open_session(ZenohConfig("router", listen=(net.endpoint,)))
    session = await net.session()
    with pytest.raises(ValueError, match="not a key expression"):
        session.subscribe("a//b", lambda _: None)
