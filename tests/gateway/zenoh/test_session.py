"""A session against real routers and sessions of eclipse-zenoh, on loopback."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import StartError
from rmpa.gateway.zenoh.config import ZenohConfig
from rmpa.gateway.zenoh.session import open_session
from rmpa.gateway.zenoh.threads import ZenohPriority, ZenohQos
from tests.gateway.zenoh_bed import bed, free_port, until

if TYPE_CHECKING:
    from rmpa.gateway.zenoh.queries import ArrivedQuery
    from rmpa.gateway.zenoh.threads import ZenohSample

pytest.importorskip("zenoh")


async def test_a_burst_of_a_thousand_messages_arrives_whole_and_in_order_with_key_and_attachment() -> None:
    async with bed() as net:
        sender, receiver = await net.session(), await net.session()
        got: list[ZenohSample] = []
        matching: list[bool] = []
        receiver.subscribe("t/*", got.append)
        publisher = sender.publisher("t/x", ZenohQos(), matching.append)
        await until(lambda: matching and matching[-1])
        for number in range(1000):
            assert publisher.put(memoryview(b"%d" % number), b"a%d" % number) == 0
        await until(lambda: len(got) == 1000)
        assert [sample.payload for sample in got] == [b"%d" % number for number in range(1000)]
        assert (got[7].key, got[7].attachment) == ("t/x", b"a7")
        assert (publisher.sent, publisher.dropped, publisher.waiting) == (1000, 0, 0)


async def test_matching_tells_when_subscribers_come_and_go_and_begins_with_what_is() -> None:
    async with bed() as net:
        sender, receiver = await net.session(), await net.session()
        matching: list[bool] = []
        sender.publisher("t/x", ZenohQos(cache=1), matching.append)
        await until(lambda: matching == [False])
        subscription = receiver.subscribe("t/**", lambda _: None)
        await until(lambda: matching == [False, True])
        subscription.close()
        await until(lambda: matching == [False, True, False])


async def test_a_late_subscriber_gets_what_the_cache_keeps_and_an_early_one_gets_it_once() -> None:
    async with bed() as net:
        sender, receiver = await net.session(), await net.session()
        early: list[bytes] = []
        late: list[bytes] = []
        matching: list[bool] = []
        receiver.subscribe("t/x", lambda sample: early.append(sample.payload), history=True)
        publisher = sender.publisher("t/x", ZenohQos(cache=1), matching.append)
        await until(lambda: matching and matching[-1])
        publisher.put(b"first")
        publisher.put(b"last")
        await until(lambda: b"last" in early)
        receiver.subscribe("t/x", lambda sample: late.append(sample.payload), history=True)
        await until(lambda: late)
        assert late == [b"last"]
        assert early == [b"first", b"last"]
        for number in range(200):  # ros2/rmw_zenoh#710: a history that is replayed must not stop the publisher
            publisher.put(b"%d" % number)
        await until(lambda: early[-1] == late[-1] == b"199")
        assert (len(early), len(late)) == (202, 201)


async def test_tokens_are_told_to_early_and_late_watchers_and_go_with_their_session() -> None:
    async with bed() as net:
        owner, watcher = await net.session(), await net.session()
        seen: list[tuple[str, bool]] = []
        watcher.watch_tokens("up/**", lambda key, alive: seen.append((key, alive)))
        tokens = [owner.token(f"up/{number}") for number in range(3)]
        await until(lambda: len(seen) == 3)
        tokens[1].close()
        await until(lambda: seen[-1] == ("up/1", False))
        late: list[tuple[str, bool]] = []
        watcher.watch_tokens("up/**", lambda key, alive: late.append((key, alive)))
        await until(lambda: len(late) == 2)
        await owner.close()
        await until(lambda: len(seen) == 6)
        assert set(seen[4:]) == {("up/0", False), ("up/2", False)}


async def test_queries_are_answered_refused_left_without_an_answer_and_not_asked() -> None:
    async with bed() as net:
        server, client = await net.session(), await net.session()

        def answer(query: ArrivedQuery) -> None:
            if query.payload == b"fail":
                query.reply_error("no such bone")
            elif query.payload == b"twice":
                query.reply("s/y", b"one")
                query.reply("s/y", b"two", b"att")
                query.finish()
            else:
                query.finish()

        server.queryable("s/*", answer)
        server.token("ready")
        ready: list[str] = []
        client.watch_tokens("ready", lambda key, _: ready.append(key))
        await until(lambda: ready)
        replies = await client.get("s/y?a=1", b"twice", priority=ZenohPriority.REAL_TIME)
        assert [(r.key, r.payload, r.attachment, r.ok) for r in replies] == [
            ("s/y", b"one", b"", True),
            ("s/y", b"two", b"att", True),
        ]
        (refused,) = await client.get("s/y", b"fail")
        assert (refused.ok, refused.payload) == (False, b"no such bone")
        assert await client.get("s/y", b"nothing") == []
        assert await client.get("elsewhere") == []


async def test_a_query_that_is_never_answered_ends_with_its_time_out_and_no_answers() -> None:
    async with bed() as net:
        server, client = await net.session(), await net.session()
        kept: list[ArrivedQuery] = []
        server.queryable("s", kept.append)
        asked = asyncio.create_task(client.get("s", timeout=0.3))
        assert await asked == []


async def test_all_complete_asks_each_server() -> None:
    async with bed() as net:
        servers = [await net.session(), await net.session()]
        client = await net.session()

        def server_of(number: int) -> None:
            def answer(query: ArrivedQuery) -> None:
                query.reply("s", b"%d" % number)
                query.finish()

            servers[number].queryable("s", answer)
            servers[number].token(f"ready/{number}")

        for number in range(2):
            server_of(number)
        ready: list[str] = []
        client.watch_tokens("ready/*", lambda key, _: ready.append(key))
        await until(lambda: len(ready) == 2)
        assert len(await client.get("s")) == 1
        assert {r.payload for r in await client.get("s", all_complete=True)} == {b"0", b"1"}


async def test_nothing_is_called_after_close() -> None:
    async with bed() as net:
        sender, receiver = await net.session(), await net.session()
        got: list[bytes] = []
        other: list[bytes] = []
        matching: list[bool] = []
        closed = receiver.subscribe("t/x", lambda sample: got.append(sample.payload))
        receiver.subscribe("t/x", lambda sample: other.append(sample.payload))
        publisher = sender.publisher("t/x", ZenohQos(), matching.append)
        await until(lambda: matching and matching[-1])
        closed.close()
        publisher.put(b"x")
        await until(lambda: other)
        assert got == []


async def test_a_closed_publisher_sends_what_waits_first() -> None:
    async with bed() as net:
        sender, receiver = await net.session(), await net.session()
        got: list[bytes] = []
        matching: list[bool] = []
        receiver.subscribe("t/x", lambda sample: got.append(sample.payload))
        publisher = sender.publisher("t/x", ZenohQos(), matching.append)
        await until(lambda: matching and matching[-1])
        for _ in range(500):
            publisher.put(bytes(10_000))
        publisher.close()
        await until(lambda: len(got) == 500)
        assert publisher.put(b"late") == 1


async def test_a_session_that_cannot_be_opened_says_where_why_and_what_to_do() -> None:
    port = free_port()
    with pytest.raises(StartError, match=rf"zenoh tcp/127\.0\.0\.1:{port}: .*connect.*; .*--connect") as refused:
        await open_session(ZenohConfig(connect=(f"tcp/127.0.0.1:{port}",)))
    assert "cargo" not in str(refused.value)
    async with bed() as net:
        with pytest.raises(StartError, match=r"Address already in use.*; choose another --listen"):
            await open_session(ZenohConfig("router", listen=(net.endpoint,)))


async def test_a_key_that_zenoh_does_not_allow_is_refused_at_once() -> None:
    async with bed() as net:
        session = await net.session()
        with pytest.raises(ValueError, match="not a key expression"):
            session.subscribe("a//b", lambda _: None)


async def test_the_process_ends_after_close() -> None:
    program = """
import asyncio
from tests.gateway.zenoh_bed import bed
from rmpa.gateway.zenoh.threads import ZenohQos
async def main():
    async with bed() as net:
        session = await net.session()
        session.publisher("t/x", ZenohQos(cache=1), lambda _: None)
        session.subscribe("t/*", lambda _: None, history=True)
        session.queryable("t/*", lambda _: None)
asyncio.run(main())
print("ended")
"""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", program, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    out, err = await asyncio.wait_for(process.communicate(), 40)
    assert (process.returncode, out, err) == (0, b"ended\n", b"")
