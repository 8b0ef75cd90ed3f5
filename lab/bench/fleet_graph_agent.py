"""The process of ``fleet_graph``: the real core and bridge of one agent, with links that only take bytes.

The peers advertise some topics each, all at once. Measured are the time to take them in, the longest time for which
the event loop did not look at the data path (in processor time), resident memory, what comparing the graph costs,
what the agent uses at rest, and how long it takes to remove a third of the peers at once.

It imports nothing that an agent does not have: memory counts. Arguments: peers, topics. Prints a ``GraphCost``.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from rmpa.agent import Agent  # noqa: F401 - the memory of a whole agent's code
from rmpa.bridge.io.bridge import Bridge
from rmpa.bridge.messages import Advertise, TopicOffer, encode
from rmpa.bridge.policy import Policy
from rmpa.config.settings import PolicySettings
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.mesh.io.lane import LaneSender
from rmpa.ros.core.embedded import RosCore
from rmpa.runtime import garbage_collector
from rmpa.runtime.event_loop import AgentLoop

if TYPE_CHECKING:
    from rmpa.mesh.io.link import PeerLink

NODES: Final = 4
"""Nodes of each peer, among which its topics are divided."""
AT_REST: Final = 20.0
"""Seconds."""
_TYPES: Final = ("std_msgs/String", "sensor_msgs/Image", "geometry_msgs/Twist", "nav_msgs/Odometry")


@dataclass(frozen=True, slots=True)
class GraphCost:
    """One number of peers.

    Args:
        peers: So many.
        topics: Of each.
        seconds: Of processor time to take all in.
        hold_ms: The longest time without a look at the data path meanwhile, milliseconds of processor time.
        empty_mb: Resident memory before.
        rss_mb: After.
        compare_ms: Of processor time to compare the whole graph with the plan, once a minute.
        rest_percent: Of a core, with no link in use and nothing that changes.
        removed_seconds: Of processor time to remove a third of the peers.
    """

    peers: int
    topics: int
    seconds: float
    hold_ms: float
    empty_mb: float
    rss_mb: float
    compare_ms: float
    rest_percent: float
    removed_seconds: float

    @property
    def bytes_per_topic(self) -> float:
        """Memory of a topic, with its share of its node and peer."""
        return (self.rss_mb - self.empty_mb) * 1e6 / (self.peers * self.topics)


class _Link:
    """A link that takes what is sent and never rests on data."""

    remote_endpoint = ("10.9.0.1", 1)
    local_address = "10.9.0.2"
    silent = crashed = busy = parked = False
    rests = True
    clock_offset = clock_error = None
    resumed_at = touched_at = -1e9

    def __init__(self, number: int) -> None:
        guid = Guid.of(f"10.{9 + number // 60000}.{number // 250}.{number % 250 + 1}", 1000)
        self.identity = Identity(guid, os.urandom(16), f"module{number:04}")
        self.guid, self.name = guid, self.identity.name

    @property
    def express(self) -> LaneSender:
        """A lane without a connection."""
        return LaneSender("express")

    bulk = express

    def send_control(self, payload: bytes) -> None:
        """Take a control message."""

    def need(self, *, needed: bool, parks: bool = False) -> None:
        """Take what the bridge says of its use."""


class Holds:
    """Notes the longest time between two looks at the data path, as processor time of the loop's thread."""

    def __init__(self, loop: AgentLoop) -> None:
        self._look = loop._direct_selector.poll_data  # noqa: SLF001 - what is measured
        self._looked = time.thread_time()
        self.longest = 0.0
        loop._poll_data = self._note  # noqa: SLF001

    def take(self) -> float:
        """The longest time since the last call, in milliseconds."""
        longest, self.longest = 1e3 * self.longest, 0.0
        return longest

    def _note(self) -> None:
        now = time.thread_time()
        self.longest = max(self.longest, now - self._looked)
        self._look()
        self._looked = time.thread_time()


async def _measure(peers: int, topics: int) -> GraphCost:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, AgentLoop)
    core = RosCore("127.0.0.1", 0)
    await core.start()
    bridge = Bridge(core, Policy(PolicySettings()), rng=random.random)
    await bridge.start()
    garbage_collector.take_over()
    empty, holds = _rss(), Holds(loop)
    links = [cast("PeerLink", _Link(number)) for number in range(peers)]
    begun = time.process_time()
    for link in links:
        bridge.sessions.link_up(link)
        bridge.control(link, encode(_catalogue(link.name, topics)))
        await asyncio.sleep(0)
    await _until(core, peers * topics)
    seconds, hold, rss = time.process_time() - begun, holds.longest, _rss()
    begun = time.process_time()
    bridge.topics.reconcile()
    while not bridge.topics._driver.idle:  # noqa: SLF001, ASYNC110 - when it has compared all
        await asyncio.sleep(0)
    compared = time.process_time() - begun
    await asyncio.sleep(5.0)
    begun, at = time.process_time(), time.monotonic()
    await asyncio.sleep(AT_REST)
    rest = (time.process_time() - begun) / (time.monotonic() - at)
    rss = max(rss, _rss())
    begun = time.process_time()
    for link in links[: peers // 3]:
        bridge.sessions.link_down(link)
        await asyncio.sleep(0)
    await _until(core, (peers - peers // 3) * topics)
    removed = time.process_time() - begun
    garbage_collector.give_back()
    await bridge.close()
    await core.close()
    figures = (seconds, 1e3 * hold, empty, rss, 1e3 * compared, 100 * rest, removed)
    return GraphCost(peers, topics, *(round(figure, 3) for figure in figures))


def _catalogue(name: str, topics: int) -> Advertise:
    offers = (
        TopicOffer(f"/{name}/sensors/topic{number:02}", f"/node{number % NODES}", _TYPES[number % len(_TYPES)])
        for number in range(topics)
    )
    return Advertise(tuple(offers), full=True)


async def _until(core: RosCore, count: int) -> None:
    """Wait until the core's graph has so many topics of peers."""
    while sum(topic.startswith("/module") for topic in core.state().publishers) != count:  # noqa: ASYNC110
        await asyncio.sleep(0.2)


def _rss() -> float:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


if __name__ == "__main__":
    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        print(json.dumps(asdict(runner.run(_measure(int(sys.argv[1]), int(sys.argv[2]))))))
