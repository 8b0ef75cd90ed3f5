"""When a stream says that a silence has ended."""

from __future__ import annotations

import asyncio
import math
import socket

from rmpa.bridge.topics.part import STALE_TICK
from rmpa.core.outbox import Outbox
from rmpa.runtime import limits
from rmpa.runtime.loop import AgentLoop
from rmpa.runtime.stream import Stream


async def after(silence: float, tick: float | None) -> float:
    """Let a stream hear nothing for so long, awake every ``tick`` seconds or not at all; its ``resumed_at``."""
    near, far = socket.socketpair()
    near.setblocking(False)
    heard = asyncio.Event()

    def take(view: memoryview) -> tuple[int, int]:
        heard.set()
        return len(view), 0

    stream = Stream(near, on_bytes=take, on_close=lambda _: None, outbox=Outbox(1, 1))
    try:
        loop = asyncio.get_running_loop()
        until = loop.time() + silence
        while tick is not None and loop.time() < until:
            await asyncio.sleep(tick)
        stream.last_in -= 0.0 if tick is not None else silence  # as if this process had been stopped
        far.send(b"x")
        await asyncio.wait_for(heard.wait(), 10.0)
        return stream.resumed_at
    finally:
        stream.close()
        far.close()


def run(silence: float, tick: float | None) -> float:
    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        return runner.run(after(silence, tick))


def test_a_silence_that_was_watched_ends_with_the_next_bytes() -> None:
    assert run(3 * limits.STALE_AGE, STALE_TICK) > 0.0


def test_a_pause_is_none() -> None:
    assert run(0.0, STALE_TICK) == -math.inf


def test_silence_ends_where_a_pause_of_this_process_begins() -> None:
    """What was sent during the pause did not wait for the network."""

    async def watch() -> tuple[float, float]:
        near, far = socket.socketpair()
        near.setblocking(False)
        heard = asyncio.Event()
        loop = asyncio.get_running_loop()

        def take(view: memoryview) -> tuple[int, int]:
            heard.set()
            return len(view), 0

        stream = Stream(near, on_bytes=take, on_close=lambda _: None, outbox=Outbox(1, 1))
        try:
            until = loop.time() + 2 * limits.STALE_AGE
            while loop.time() < until:
                await asyncio.sleep(STALE_TICK)
            paused = loop.time()
            while loop.time() < paused + 2 * limits.STALE_AGE:
                pass  # as a process that gets no CPU
            far.send(b"x")
            await asyncio.wait_for(heard.wait(), 10.0)
            return stream.resumed_at, paused
        finally:
            stream.close()
            far.close()

    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        resumed_at, paused = runner.run(watch())
    assert paused - limits.STALE_AGE < resumed_at <= paused
