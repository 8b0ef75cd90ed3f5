"""The module *pc*: watches every topic and shows the peers, and how regularly and how late messages arrive.

rmpa up --name pc &
python pc.py
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import locale
import math
import os
import signal
import sys
import time
from typing import TYPE_CHECKING

from rich.console import Console
from rich.live import Live

import table
from module import arguments, joined, run
from rate import Rate
from rmpa.core.errors import RmpaError
from rmpa.observe.control_client import ControlClient, choose_agent
from sites import SITES
from watch import HERE, MODULES, TOPICS, PoseView, View, Watch

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from rmpa import Node, Received
    from rmpa.observe.snapshot import Snapshot

PROFILE = "std_msgs/String"
"""The type of a resource's topic that says which profile it runs."""
LOOKS = 4
"""Looks a second at our agent, and drawings of the table."""
SWITCH = 2e-4
"""Seconds after which the thread that draws gives way to one that receives; Python's 5 ms would spoil the figures."""


async def pc(master_uri: str, screen: Screen, *, events: bool, sites: bool) -> None:
    """Subscribe to everything, look at our agent, and show it all until we are cancelled; then the summary."""
    away = {name: site for site, names in SITES.items() for name in names if HERE not in names} if sites else {}
    watch = Watch(time.monotonic(), away)
    if events:
        _follow(sys.stdin.fileno(), watch, screen, asyncio.current_task())
    looking = asyncio.create_task(_look(watch, away))
    try:
        with screen:
            async with joined("pc", master_uri, PROFILE, *(about.type for about in TOPICS.values())) as node:
                await _subscribe(node, watch)
                async for _ in Rate(screen.rate):
                    view = watch.view(time.monotonic())
                    await asyncio.to_thread(screen.show, view, watch.trail())
    finally:
        looking.cancel()
        screen.summarise(watch.view(time.monotonic(), whole=True))


async def _subscribe(node: Node, watch: Watch) -> None:
    def counting(topic: str) -> Callable[[Received], None]:
        def came(received: Received) -> None:
            now = time.monotonic()
            header = getattr(received.message, "header", None)
            latency = None
            if header is not None:
                latency = (received.stamp_ns - header.stamp.sec * 10**9 - header.stamp.nanosec) * 1e-9
            watch.message(topic, now, latency)
            if topic == "/odom":
                watch.pose(_pose(received), now)

        return came

    def running(module: str) -> Callable[[Received], None]:
        return lambda received: watch.profile(module, str(received.message.data))

    for topic, about in TOPICS.items():
        await node.subscribe(topic, about.type, counting(topic))
    for module in MODULES:
        if module != HERE:  # each is a Smart Resource of its own name
            await node.subscribe(f"/{module}/profile", PROFILE, running(module))


def _pose(received: Received) -> PoseView:
    pose, twist = received.message.pose.pose, received.message.twist.twist
    heading = 2 * math.atan2(pose.orientation.z, pose.orientation.w)
    return PoseView(
        float(pose.position.x),
        float(pose.position.y),
        math.remainder(heading, math.tau),
        float(twist.linear.x),
        float(twist.angular.z),
    )


async def _look(watch: Watch, away: Mapping[str, str]) -> None:
    """Ask the own agent for its peers, and for the latency of messages without a header."""
    counted: dict[str, int] = {}
    async for _ in Rate(LOOKS):
        with contextlib.suppress(RmpaError):
            snapshot = await asyncio.to_thread(_snapshot)
            now = time.monotonic()
            # A module that came back has a new GUID; its ghost may still be listed beside it.
            peers = sorted(snapshot.peers, key=lambda peer: peer.state == "linked")
            watch.peers({peer.name: peer.state for peer in peers} | _states_away(snapshot, away), now)
            for topic, messages, latency in _measured(snapshot):
                if counted.get(topic) != messages:  # each message at most once
                    counted[topic] = messages
                    watch.latency(topic, now, latency)


def _snapshot() -> Snapshot:
    with ControlClient(choose_agent(os.environ, HERE).path) as agent:
        return agent.snapshot()


def _states_away(snapshot: Snapshot, away: Mapping[str, str]) -> dict[str, str]:
    """The modules of other sites whose messages come here: they are linked, by gateways."""
    nodes = [route.node for topic in snapshot.topics for route in topic.routes if route.state == "open"]
    return {
        name: "linked"
        for name, site in away.items()
        if any(node.startswith(f"/rmpa/{site}/{name}/") for node in nodes)
    }


def _measured(snapshot: Snapshot) -> Iterator[tuple[str, int, float]]:
    """Topics without a header, how many messages of them came, and how long the last one was on the way."""
    for topic in snapshot.topics:
        if topic.name in TOPICS and not TOPICS[topic.name].stamped:
            for route in topic.routes:
                if route.direction == "in" and route.latency is not None:
                    yield topic.name, route.messages, route.latency.last


def _follow(descriptor: int, watch: Watch, screen: Screen, task: asyncio.Task[None] | None) -> None:
    """Take the supervisor's news from a pipe, one JSON object a line; end when it is closed."""
    rest = b""
    loop = asyncio.get_running_loop()

    def readable() -> None:
        nonlocal rest
        data = os.read(descriptor, 65536)
        if not data:
            loop.remove_reader(descriptor)
            if task is not None:
                task.cancel()
            return
        *lines, rest = (rest + data).split(b"\n")
        for text in lines:
            _tell(watch, screen, json.loads(text))

    loop.add_reader(descriptor, readable)


def _tell(watch: Watch, screen: Screen, news: dict[str, object]) -> None:
    module, at = str(news.get("module")), news.get("at")
    if news["event"] == "note":
        note = f"{module}: {news['text']}"
        watch.note(note)
        screen.note(note)
    elif isinstance(at, float):
        (watch.started if news["event"] == "started" else watch.killed)(module, at)


class Screen:
    """Where it is shown: a live table on a terminal, else a line each second; JSON if asked for.

    Args:
        as_json: One object a line.
    """

    def __init__(self, *, as_json: bool) -> None:
        self._json = as_json
        self._console = Console()
        self._live: Live | None = None
        self._summarised = False
        if self._console.is_terminal and not as_json:
            self._live = Live(console=self._console, auto_refresh=False)
        self._unicode = "utf" in (sys.stdout.encoding or locale.getpreferredencoding()).lower()
        self.rate = LOOKS if self._live else 1

    def __enter__(self) -> None:
        if self._live:
            self._live.start()

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def show(self, view: View, trail: list[tuple[float, float]]) -> None:
        """Show the present; called in a thread, so that drawing does not delay receiving."""
        if self._live:
            self._live.update(table.live(view, trail, unicode=self._unicode), refresh=True)
        elif self._json:
            print(table.json_line(view), flush=True)
        else:
            print(table.line(view), flush=True)

    def note(self, text: str) -> None:
        """Show a note at once where lines are printed; the table and JSON show it with the rest."""
        if not self._live and not self._json and not self._summarised:
            print(f"        {text}", flush=True)

    def summarise(self, view: View) -> None:
        """Show the whole run."""
        self._summarised = True
        if self._json:
            print(table.json_summary(view), flush=True)
        else:
            # A pipe or a file takes lines of any length: nothing is wrapped there.
            self._console.print(*table.summary(view), sep="\n", soft_wrap=not self._console.is_terminal)


if __name__ == "__main__":
    parser = arguments(__doc__)
    parser.add_argument("--json", action="store_true", help="one JSON object a second, and the summary as the last")
    parser.add_argument("--events", action="store_true", help="read the supervisor's news on standard input")
    parser.add_argument("--sites", action="store_true", help="two of the modules are at another site")
    options = parser.parse_args()
    sys.setswitchinterval(SWITCH)
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)  # we are not the terminal's foreground job: the supervisor is
    with contextlib.suppress(BrokenPipeError):
        run(pc(options.master, Screen(as_json=options.json), events=options.events, sites=options.sites))
