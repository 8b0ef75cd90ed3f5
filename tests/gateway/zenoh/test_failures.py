"""Sessions whose other sides freeze or are killed: how soon it is seen, and what the others lose."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from rmpa.gateway import limits
from rmpa.gateway.zenoh.threads import ZenohPriority, ZenohQos
from tests.gateway.zenoh_bed import ZenohBed, bed, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytest.importorskip("zenoh")

FAR_END = """
import asyncio, sys
from rmpa.gateway.zenoh.config import ZenohConfig
from rmpa.gateway.zenoh.session import open_session
async def main():
    session = await open_session(ZenohConfig(connect=(sys.argv[1],)))
    session.subscribe("t/**", lambda sample: None)
    session.token("up/far")
    await asyncio.Event().wait()
asyncio.run(main())
"""


@asynccontextmanager
async def far_end(net: ZenohBed) -> AsyncIterator[int]:
    """A process with a session; its process id."""
    process = await asyncio.create_subprocess_exec(sys.executable, "-c", FAR_END, net.endpoint)
    try:
        yield process.pid
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()


@pytest.mark.timeout(240)
async def test_a_frozen_subscriber_holds_the_others_up_for_a_lease_at_most_and_nothing_is_lost_uncounted() -> None:
    async with bed() as net, far_end(net) as pid:
        sender, receiver = await net.session(), await net.session()
        got: list[int] = []
        fast: list[float] = []
        receiver.subscribe("t/bulk", lambda sample: got.append(int.from_bytes(sample.payload[:4], "little")))
        receiver.subscribe("fast", lambda _: fast.append(time.monotonic()))
        matching: list[bool] = []
        bulk = sender.publisher("t/bulk", ZenohQos(messages=50, priority=ZenohPriority.DATA_LOW), matching.append)
        quick = sender.publisher("fast", ZenohQos(priority=ZenohPriority.REAL_TIME), matching.append)
        await until(lambda: matching.count(True) == 2)
        os.kill(pid, signal.SIGSTOP)
        count = 0
        stalled = 0.0
        last = time.monotonic()
        while time.monotonic() < last + 4.0 and count < 400:
            bulk.put(count.to_bytes(4, "little") + bytes(1_000_000))
            quick.put(b"x")
            count += 1
            before = time.monotonic()
            await asyncio.sleep(0.01)
            stalled = max(stalled, time.monotonic() - before)
        await until(lambda: not bulk.waiting and not quick.waiting, 90.0)
        await until(lambda: len(got) == bulk.sent and len(fast) == quick.sent, 90.0)
        assert bulk.sent + bulk.dropped == count
        assert quick.sent == count, "what has priority finds room"
        assert stalled < limits.LEASE, "a put does not wait for the frozen subscriber"
        assert list(sender.endpoints) == [net.endpoint], "the sender's own link lives"
