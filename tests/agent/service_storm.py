"""``python -m tests.agent.service_storm [--seconds N] [--seed N]``: callers of a peer's services come and go.

Two agents in one process, and chance. Services appear, hang, and go; their link falls silent; callers probe, leave in
the middle, or stay. Each one that stays must get its answer, an error, or the end of its connection.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import random
import struct
import sys
import tempfile
import time
from collections import Counter
from contextlib import AsyncExitStack
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final

from rmpa.config.settings import ServiceSettings, Settings
from rmpa.config.values import Multicast
from rmpa.ros.wire.tcpros import encode_header, parse_service_uri
from rmpa.runtime.loop import AgentLoop
from tests.agent.test_agent import running
from tests.agent.test_services import MD5, come_back, fall_silent, serving

if TYPE_CHECKING:
    from rmpa.agent.agent import Agent

TIMEOUT: Final = 2.0
"""Seconds after which the agents give a call up."""
PATIENCE: Final = 30.0
"""Seconds within which each caller must have an answer or an end, on a busy machine too."""
SERVICES: Final = 6
CALLERS: Final = 40
"""Connections at a time."""


@dataclass(slots=True)
class Storm:
    """One run.

    Args:
        here: Where the services are.
        there: Where the callers are.
        rng: Of all chance.
        ends: How the calls of those that stayed ended, and how often.
        wrong: Those that stayed without an end, and what failed in the agents.
    """

    here: Agent
    there: Agent
    rng: random.Random

    ends: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)
    _callers: set[asyncio.Task[None]] = field(default_factory=set)
    _over: asyncio.Event = field(default_factory=asyncio.Event)

    async def run(self, seconds: float) -> None:
        """Let it rage, then wait for all callers."""
        until = time.monotonic() + seconds
        others = [asyncio.create_task(self._serve(n, until)) for n in range(SERVICES)]
        others.append(asyncio.create_task(self._cut(until)))
        known: dict[str, str] = {}
        while time.monotonic() < until:
            known, before = self._addresses(), known
            # Several come to what has just appeared, as the nodes of a launch file do.
            for name, uri in known.items():
                if before.get(name) != uri or self.rng.random() < 0.05:
                    self._come(name, uri, self.rng.randint(1, 8))
            await asyncio.sleep(0.003)
        await asyncio.gather(*self._callers)
        self._over.set()
        await asyncio.gather(*others)

    async def _serve(self, slot: int, until: float) -> None:
        """One service after the other: some answer, some never do, some stay."""
        async with AsyncExitStack() as stay:
            for number in itertools.count():
                if time.monotonic() > until:
                    break
                service = f"/storm/{slot}_{number % 3}"
                if self.rng.random() < 0.1:
                    await stay.enter_async_context(
                        serving(self.here, f"{service}_{number}", f"/server{slot}_{number}")
                    )
                async with serving(self.here, service, f"/server{slot}") as server:
                    server.keeps = self.rng.random() < 0.2
                    await asyncio.sleep(self.rng.choice((0.03, 0.1, 0.3, 1.0)))
                await asyncio.sleep(self.rng.uniform(0, 0.2))
            await self._over.wait()

    async def _cut(self, until: float) -> None:
        """The link falls silent, for less or more than services stay."""
        while time.monotonic() < until:
            await asyncio.sleep(self.rng.uniform(0.2, 2.0))
            links = fall_silent(self.here, self.there)
            await asyncio.sleep(self.rng.choice((0.0, 0.05, 0.8)))
            come_back(links)

    def _addresses(self) -> dict[str, str]:
        """The services that the callers see, with an address that a new server changes."""
        services = self.there.core.state().services.items()
        return {name: uri for name, servers in services if name.startswith("/storm/") for uri in servers.values()}

    def _come(self, service: str, uri: str, count: int) -> None:
        for _ in range(min(count, CALLERS - len(self._callers))):
            task = asyncio.create_task(self._caller(service, uri))
            self._callers.add(task)
            task.add_done_callback(self._callers.discard)

    async def _caller(self, service: str, uri: str) -> None:
        leaves = self.rng.choice(("probe", "probe", "header", "request", "", ""))
        body = self.rng.randbytes(self.rng.choice((0, 8, 5_000, 300_000)))
        try:
            async with asyncio.timeout(PATIENCE):
                end = await self._call(parse_service_uri(uri), service, leaves, body)
        except TimeoutError:
            self.wrong.append(f"{service}: nothing within {PATIENCE:g} s")
            return
        if not leaves:
            self.ends[end] += 1

    async def _call(self, address: tuple[str, int], service: str, leaves: str, body: bytes) -> str:
        try:
            reader, writer = await asyncio.open_connection(*address)
        except OSError:
            return "refused"
        try:
            header = {"service": service, "callerid": f"/caller{self.rng.random()}", "md5sum": MD5}
            writer.write(encode_header(header | ({"probe": "1"} if leaves == "probe" else {})))
            if leaves in ("probe", "header"):
                await asyncio.sleep(self.rng.uniform(0, 0.003))  # about as long as the peer takes to say the type
                return "left"
            head = await _framed(reader)
            if head.find(b"error=") >= 0:
                return "error header"
            writer.write(struct.pack("<I", len(body)) + body)
            await writer.drain()
            if leaves == "request":
                return "left"
            ok = await reader.readexactly(1)
            answer = await _framed(reader)
        except (OSError, asyncio.IncompleteReadError):
            return "closed"
        else:
            assert ok == b"\x00" or answer == body, "another one's answer"
            return "error" if ok == b"\x00" else "answer"
        finally:
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()


async def _framed(reader: asyncio.StreamReader) -> bytes:
    (size,) = struct.unpack("<I", await reader.readexactly(4))
    return await reader.readexactly(size)


async def rage(seconds: float, seed: int, a: Settings, b: Settings) -> Storm:
    """Run a storm between two agents with these settings."""
    services = ServiceSettings(timeout=TIMEOUT)
    async with running(replace(a, services=services), replace(b, services=services)) as (here, there):
        storm = Storm(here, there, random.Random(seed))
        asyncio.get_running_loop().set_exception_handler(lambda _, context: storm.wrong.append(str(context)))
        await storm.run(seconds)
        return storm


def main() -> int:
    """Run one storm, and say how the calls ended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1_000_000))
    options = parser.parse_args()
    print(f"seed {options.seed}", flush=True)
    with tempfile.TemporaryDirectory(prefix="rmpa-storm-") as home:
        multicast = Multicast(port=20_000 + options.seed % 20_000)
        a = Settings(name="a", core_port=0, interfaces=("lo",), multicast=multicast, runtime_dir=home)
        with asyncio.Runner(loop_factory=AgentLoop) as runner:
            storm = runner.run(rage(options.seconds, options.seed, a, replace(a, name="b")))
    print(dict(storm.ends))
    print("\n".join(storm.wrong))
    return 1 if storm.wrong else 0


if __name__ == "__main__":
    sys.exit(main())
