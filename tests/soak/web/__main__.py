"""``python -m tests.soak.web [--seconds N] [--seed N]``: what comes and goes around ``rmpa web`` must not leak.

Modules, topics, clients and the views of a page in Chromium come and go at ten times the usual pace (``churn``). The
resident memory of ``rmpa web`` and the page's heap after a forced garbage collection are sampled all the time: the
floor of neither may rise in the second half. Afterwards the server must have as few open files as before. Needs
Chromium, and neither root nor ROS 1. Within eight minutes there are too few samples to tell.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import sys
import time
from dataclasses import dataclass
from typing import Final

import psutil

from lab.bed.bench import Bed
from lab.bed.chromium import BINARY, Chromium, PageError
from lab.bed.processes import BedError, Process
from lab.web.page import served_mesh
from rmpa.core.errors import RmpaError
from tests.soak.held import MB, growth, too_much
from tests.soak.web.churn import MESH_EVERY, Clients, Topics, Views

_SAMPLES: Final = 60
_SAMPLE_EVERY: Final = 15.0
"""Seconds between samples at the least: a garbage collection of a page takes some time itself."""
_MODULES: Final = 16
_HEAP_GROWTH: Final = 1 * MB
"""That the floor of the page's heap may rise by in the second half; it has some 5 MB."""
_NODES_GROWTH: Final = 0.2
"""Share by which the page may have more DOM nodes in the last fifth of the samples than in the third fifth."""
_QUIET: Final = 3.0
"""Seconds on the first view before the page is measured: what other views had is released."""
_GIVEN_BACK: Final = 60.0
"""Seconds in which the server releases what its clients had: subscriptions linger, pings find who has vanished."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Bytes of a process or of a heap.

    Args:
        at: Seconds since the soak began.
        rss: Bytes.
    """

    at: float
    rss: int


class WebSoak:
    """One run.

    Args:
        seconds: How long, without start and end.
        seed: Of what clients and pages do.
    """

    def __init__(self, seconds: float, seed: int) -> None:
        self.problems: list[str] = []
        self._seconds = seconds
        self._rng = random.Random(seed)
        self._server: list[Sample] = []
        self._heap: list[Sample] = []
        self._nodes: list[int] = []

    async def run(self, process: Process, port: int, master_uri: str) -> None:
        """Churn, sample and judge; see ``problems``."""
        async with Chromium() as page:
            topics = Topics(master_uri)
            clients, views = Clients(port, topics, self._rng), Views(page, port, topics, self._rng)
            await views.open()
            server = psutil.Process(process.pid)
            files = server.num_fds()
            tasks = [asyncio.create_task(each.run()) for each in (topics, clients, views)]
            try:
                await self._sample(page, server, views, clients, topics, tasks)
            except (PageError, psutil.Error) as error:
                self.problems.append(f"{error!r}\n{process.output[-2000:]}")
            for task in tasks:
                task.cancel()
            ended = await asyncio.gather(*tasks, return_exceptions=True)
            self.problems += [f"{one!r}" for one in ended if isinstance(one, Exception)]
            self.problems += clients.problems[:20] + [f"the page says: {error}" for error in page.errors[:20]]
            self.problems += [
                f"no message came to any {kind} client" for kind, n in clients.messages.items() if not n
            ]
            await self._wait_released(server, files)
        self._judge()

    async def _sample(
        self,
        page: Chromium,
        server: psutil.Process,
        views: Views,
        clients: Clients,
        topics: Topics,
        tasks: list[asyncio.Task[None]],
    ) -> None:
        began = time.monotonic()
        period = max(_SAMPLE_EVERY, self._seconds / _SAMPLES)
        while (now := time.monotonic() - began) < self._seconds and not any(task.done() for task in tasks):
            await asyncio.sleep(period - _QUIET)
            async with views.turn:
                await views.show("")
                await asyncio.sleep(_QUIET)
                await page.send("HeapProfiler.collectGarbage")
                heap = int((await page.send("Runtime.getHeapUsage"))["usedSize"])
                nodes = int((await page.send("Memory.getDOMCounters"))["nodes"])
            now = time.monotonic() - began
            self._server.append(Sample(now, server.memory_info().rss))
            self._heap.append(Sample(now, heap))
            self._nodes.append(nodes)
            print(
                f"{now:6.0f} s  rmpa web {self._server[-1].rss / MB:.1f} MB, {server.num_fds()} fds; "
                f"page {heap / MB:.2f} MB, {nodes} nodes; so far {clients.came} clients, "
                f"{sum(clients.messages.values())} messages, {topics.made} topics, {views.shown} views",
                flush=True,
            )

    async def _wait_released(self, server: psutil.Process, files: int) -> None:
        deadline = time.monotonic() + _GIVEN_BACK
        while server.is_running() and (held := server.num_fds()) > files:
            if time.monotonic() > deadline:
                self.problems.append(f"rmpa web has {held} open files, {files} before")
                return
            await asyncio.sleep(1.0)

    def _judge(self) -> None:
        for what, samples, most in (("rmpa web", self._server, None), ("the page", self._heap, _HEAP_GROWTH)):
            rose = growth(samples)
            shown = "too few samples to tell" if rose is None else f"{rose / MB:+.2f} MB in the second half"
            print(f"{what}: {samples[0].rss / MB:.1f} MB at first, {samples[-1].rss / MB:.1f} MB at last; {shown}")
            if text := too_much(samples, most):
                self.problems.append(f"{what}: {text}")
        fifth = len(self._nodes) // 5
        if fifth:
            middle, last = min(self._nodes[2 * fifth : 3 * fifth]), min(self._nodes[-fifth:])
            print(f"the page: at least {middle} DOM nodes in the third fifth, {last} in the last")
            if last > (1 + _NODES_GROWTH) * middle:
                self.problems.append(f"the page: DOM nodes rose from {middle} to {last}")


def main() -> int:
    """Run the soak; return 1 if something went wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak.web", description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0, help="how long (default: 3600)")
    parser.add_argument("--seed", type=int, default=None, help="of the churn (default: a new one, printed)")
    options = parser.parse_args()
    if BINARY is None:
        print("the soak cannot run here: Chromium is not installed (scripts/install-chromium)", file=sys.stderr)
        return 2
    seed = options.seed if options.seed is not None else random.SystemRandom().randrange(1 << 32)
    print(f"seed {seed}", flush=True)
    soak = WebSoak(options.seconds, seed)
    try:
        with Bed() as bed:
            agent = bed.agent()
            with served_mesh(bed, agent, _MODULES, MESH_EVERY) as (process, port):
                asyncio.run(soak.run(process, port, agent.snapshot().agent.core_uri))
    except (BedError, RmpaError) as error:
        soak.problems.append(str(error))
    except KeyboardInterrupt:
        soak.problems.append("interrupted")
    if soak.problems:
        print(f"\nFAILED (seed {seed})")
        for problem in soak.problems:
            print(f"* {problem}")
        return 1
    print(f"no failure in {options.seconds:g} s (seed {seed})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
