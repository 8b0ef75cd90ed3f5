"""The monitor's page with a mesh of many modules: what it costs the server, and how it is in a real browser."""

from __future__ import annotations

import asyncio
import itertools
import json
import statistics
import time
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from lab.bed.chromium import BINARY, Chromium, PageError
from lab.bed.processes import BedError, Process
from lab.usage import Meter
from lab.web.servers import program, rmpa_web
from lab.web.websocket import WebSocket
from rmpa.web.monitor.messages import SUBPROTOCOL

if TYPE_CHECKING:
    from collections.abc import Iterator

    from lab.bed.agents import Agent
    from lab.bed.bench import Bed

MODULE: Final = "pc"
# Seconds after the first state: the hub has read the graph, and rates are smooth.
_SETTLE: Final = 3.0
_FRAMES: Final = """
new Promise((done) => {
  const times = [];
  const step = (now) => {
    times.push(now);
    if (now - times[0] < SECONDS * 1000) requestAnimationFrame(step);
    else done(times);
  };
  requestAnimationFrame(step);
})
"""
_SHOWN: Final = """
new MutationObserver((_, observer) => {
  if (document.querySelectorAll("[data-module]").length >= MODULES) {
    window.shownAt = performance.now();
    observer.disconnect();
  }
}).observe(document, { childList: true, subtree: true });
"""
_PAINTED: Final = "performance.getEntriesByName('first-contentful-paint').length"
_LOADED: Final = """
[performance.getEntriesByName("first-contentful-paint")[0].startTime, window.shownAt,
 [...performance.getEntriesByType("navigation"), ...performance.getEntriesByType("resource")]
   .reduce((sum, each) => sum + each.transferSize, 0)]
"""


def why_no_browser() -> str:
    """Why the pages cannot be measured in a browser here, or an empty string."""
    return "" if BINARY else "Chromium is not installed (scripts/install-chromium)"


@dataclass(frozen=True, slots=True)
class Served:
    """One page's WebSocket over a span; each state and patch is acknowledged at once.

    Args:
        cpu_percent: Of ``rmpa web``, of one core.
        rss: Its resident bytes.
        state_bytes: Of the first state.
        patches: A second.
        patch_bytes: Of the patches, a second.
    """

    cpu_percent: float
    rss: int
    state_bytes: int
    patches: float
    patch_bytes: float


@dataclass(frozen=True, slots=True)
class Browsed:
    """The page in a browser.

    Args:
        frames: A second.
        longest_ms: The longest time from one frame to the next.
        first_paint_ms: From the navigation to the first contentful paint; the median of the loads.
        shown_ms: From the navigation until all modules are there, likewise.
        bytes: That one load transfers by HTTP, headers included.
        cpu_percent: Of ``rmpa web`` while the frames were counted.
    """

    frames: float
    longest_ms: float
    first_paint_ms: float
    shown_ms: float
    bytes: int
    cpu_percent: float


@contextmanager
def served_mesh(bed: Bed, agent: Agent, modules: int, churn: float = 0.0) -> Iterator[tuple[Process, int]]:
    """``rmpa web`` and its port, in a mesh of so many modules behind a real agent; see ``lab.web.mesh``."""
    place = bed.home / "mesh"
    place.mkdir(mode=0o700)
    assert agent.runtime_dir is not None
    words = ["--agent", str(agent.runtime_dir / f"{agent.name}.sock"), "--socket", str(place / f"{MODULE}.sock")]
    with program("lab.web.mesh", *words, "--modules", str(modules), "--churn", str(churn)):
        process, port = rmpa_web(bed, agent, control=False, runtime_dir=place)
        with process:
            yield process, port


def serve(process: Process, port: int, seconds: float) -> Served:
    """What one page costs the server, without a browser on the same machine.

    Raises:
        BedError: The server shows no mesh.
    """
    with WebSocket(port, "/monitor", SUBPROTOCOL) as client:
        first = _next_state(client, "state")
        _follow(client, _SETTLE)
        meter = Meter({"web": process.pid})
        patches, size = _follow(client, seconds)
        usage = meter.read()["web"]
    return Served(usage.percent, usage.rss, first, patches / usage.wall, size / usage.wall)


def _next_state(client: WebSocket, op: str) -> int:
    """Wait for one of these and acknowledge it; returns its bytes."""
    while True:
        text = client.receive()
        message: dict[str, Any] = json.loads(text) if isinstance(text, str) else {}
        if message.get("op") in ("state", "patch"):
            client.send(json.dumps({"op": "ack", "n": message["n"]}))
            if message["op"] == op and (op == "patch" or "modules" in message["state"]):
                return len(text)


def _follow(client: WebSocket, seconds: float) -> tuple[int, int]:
    """Acknowledge patches for a while; returns how many there were, and their bytes."""
    count, size, end = 0, 0, time.monotonic() + seconds
    while time.monotonic() < end:
        size += _next_state(client, "patch")
        count += 1
    return count, size


def browse(process: Process, port: int, modules: int, seconds: float, loads: int) -> Browsed:
    """Open the first page so many times, then count its frames.

    Raises:
        BedError: The page does not show the mesh.
    """
    try:
        return asyncio.run(_browse(process, port, modules, seconds, loads))
    except PageError as error:
        raise BedError(f"the monitor's page: {error}") from None


async def _browse(process: Process, port: int, modules: int, seconds: float, loads: int) -> Browsed:
    url = f"http://127.0.0.1:{port}/"
    async with Chromium() as page:
        await page.look(still=False)
        script = _SHOWN.replace("MODULES", str(modules))
        await page.send("Page.addScriptToEvaluateOnNewDocument", source=script)
        found = []
        for number in range(loads + 1):
            await page.goto(f"{url}?load={number}")
            await page.wait(f"location.search === '?load={number}' && window.shownAt && {_PAINTED}")
            found.append(await page.run(_LOADED))
        await asyncio.sleep(_SETTLE)
        meter = Meter({"web": process.pid})
        times = await page.run(_FRAMES.replace("SECONDS", str(seconds)))
        usage = meter.read()["web"]
    gaps = [after - before for before, after in itertools.pairwise(times)]
    paints, shown, sizes = zip(*found[1:], strict=True)  # the first load starts the browser's own parts as well
    return Browsed(
        len(gaps) / (times[-1] - times[0]) * 1e3,
        max(gaps),
        statistics.median(paints),
        statistics.median(shown),
        int(statistics.median(sizes)),
        usage.percent,
    )
