"""The rates of this module's topics, measured where they are published, while a list of them is shown.

Nodes count what they send over each connection and tell it (``getBusStats``), which costs no message. A topic without
a connection, or of a node that does not tell, is subscribed to for a moment by a connection of the agent's own, which
the master does not know of. Publishers that work only for subscribers, as cameras do, are not woken: for the types of
``ON_DEMAND`` it is said that there is no subscriber.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import msgspec

from rmpa.bridge import limits
from rmpa.bridge.policy import Needs
from rmpa.bridge.sessions import Part, PeerSession
from rmpa.bridge.topics.direct import MEASURING
from rmpa.config.peer_rules import Access
from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE, is_own
from rmpa.ros.http.rpc import call
from rmpa.ros.node.subscription import PublisherConnection
from rmpa.ros.wire.slave_api import Sent, read_bus_stats, sent_between
from rmpa.ros.wire.tcpros import LENGTH
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.tasks import OwnedTasks

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.bridge.bridge import Bridge

# The request for the rates of the topics that a module offers: a list of ``TopicRate``.
RATES: Final = "topic.rates"
# Types of publishers that work only while there is a subscriber.
ON_DEMAND: Final = frozenset({
    "sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/PointCloud2", "stereo_msgs/DisparityImage",
    "theora_image_transport/Packet",
})  # fmt: skip
COUNTED: Final = "counted"
SAMPLED: Final = "sampled"
NO_SUBSCRIBER: Final = "no subscriber"
_CALLER: Final = f"{MEASURING}rates"


class TopicRate(msgspec.Struct, frozen=True, array_like=True):
    """What one topic's publishers in one module send.

    Attributes:
        topic: Its name in that module.
        rate: Messages a second to one subscriber; ``None``: not measured.
        bandwidth: Bytes a second, likewise.
        how: ``counted`` by the publishers, ``sampled`` by a short subscription, or why neither: ``no subscriber``.
    """

    topic: str
    rate: float | None
    bandwidth: float | None
    how: str


class Rates(Part):
    """Measures while it is asked, and for ``limits.RATES_KEPT`` after that.

    Args:
        bridge: The core, the peers and the rules.
    """

    def __init__(self, bridge: Bridge) -> None:
        self._bridge = bridge
        self._tasks = OwnedTasks()
        self._measures = False
        self._wanted = 0.0
        # By node and topic: the last counts of its connections with their time, and the rates that follow from them.
        self._counts: dict[tuple[str, str], tuple[float, Sent]] = {}
        self._rates: dict[tuple[str, str], TopicRate] = {}
        self._sampled: dict[tuple[str, str], float] = {}
        needs = Needs((Access.SUBSCRIBE,), "the topics of the answer: those that it may not have are left out")
        bridge.rpc.on_request(RATES, self._asked, needs)

    async def close(self) -> None:
        """Measure nothing any more."""
        await self._tasks.close()

    def now(self) -> tuple[TopicRate, ...]:
        """What is known of this module's topics; more is measured meanwhile."""
        self._wanted = time.monotonic() + limits.RATES_KEPT
        if not self._measures:
            self._measures = True
            self._tasks.start(self._measure(), "measure the rates of topics")
        found: dict[str, TopicRate] = {}
        for (_, topic), one in self._rates.items():
            found[topic] = _sum(found[topic], one) if topic in found else one
        return tuple(islice(found.values(), limits.RATES_MAX))

    def _asked(self, asker: PeerSession, _args: dict[str, Any]) -> tuple[TopicRate, ...]:
        offered = {source.topic for source in self._bridge.topics.exports.offered}
        gate, peer = self._bridge.context.gate, asker.link.name
        told = (one for one in self.now() if one.topic in offered)
        return tuple(one for one in told if not gate.on or gate.judge(Access.SUBSCRIBE, peer, one.topic).allowed)

    async def _measure(self) -> None:
        try:
            while time.monotonic() < self._wanted:
                state = self._bridge.core.state()
                own = [
                    (node, uri, topic, state.types.get(topic, ""))
                    for topic, nodes in state.publishers.items()
                    for node, uri in nodes.items()
                    if not is_own(node)
                ]
                present = {(node, topic) for node, _, topic, _ in own}
                for table in (self._rates, self._counts, self._sampled):
                    for key in [key for key in table if key not in present]:
                        del table[key]
                await self._count({node: uri for node, uri, _, _ in own})
                await self._sample(own)
        finally:
            self._measures = False
            self._counts.clear()
            self._rates.clear()
            self._sampled.clear()

    async def _count(self, nodes: dict[str, str]) -> None:
        """Ask each node for its counts."""
        for node, uri in nodes.items():
            began = time.monotonic()
            with contextlib.suppress(RmpaError, RosFault):
                for topic, sent in read_bus_stats(await call(uri, "getBusStats", OWN_NODE, timeout=1.0)).items():
                    self._counted(node, topic, sent)
            # A node that hangs takes its second, and the next one is asked at once.
            await asyncio.sleep(max(0.0, began + limits.RATES_PAUSE - time.monotonic()))
            if began > self._wanted:
                return
        await asyncio.sleep(limits.RATES_PAUSE)

    def _counted(self, node: str, topic: str, sent: Sent) -> None:
        key, now = (node, topic), time.monotonic()
        at, before = self._counts.get(key, (now, {}))
        self._counts[key] = now, sent
        if not sent and key in self._rates and self._rates[key].how == COUNTED:
            del self._rates[key]
        if now > at and (counted := sent_between(before, sent)) is not None:
            messages, size = counted
            self._rates[key] = TopicRate(topic, messages / (now - at), size / (now - at), COUNTED)

    async def _sample(self, own: list[tuple[str, str, str, str]]) -> None:
        """Subscribe to some of the topics that are not counted, those first whose sample is oldest."""
        left = []
        for node, uri, topic, kind in own:
            key = node, topic
            counts = self._counts.get(key)
            if counts is not None and counts[1]:
                continue
            if kind in ON_DEMAND and counts is not None:
                self._rates[key] = TopicRate(topic, None, None, NO_SUBSCRIBER)
            else:
                left.append((self._sampled.get(key, 0.0), key, uri))
        samples = [_Sample(key, uri) for _, key, uri in sorted(left)[: limits.RATES_AT_ONCE]]
        try:
            await asyncio.sleep(limits.RATES_SAMPLE if samples else 0.0)
        finally:
            for sample in samples:
                sample.close()
        for sample in samples:
            self._sampled[sample.key] = time.monotonic()
            if sample.connected:
                self._rates[sample.key] = TopicRate(sample.key[1], *sample.figures(), SAMPLED)


def _sum(one: TopicRate, other: TopicRate) -> TopicRate:
    """Of two publishers of one topic."""
    if one.rate is None or other.rate is None:
        return one if other.rate is None else other
    return TopicRate(one.topic, one.rate + other.rate, (one.bandwidth or 0.0) + (other.bandwidth or 0.0), one.how)


class _Sample:
    """The first messages of a connection; their bytes are counted and not kept (``PartsTaker``).

    Args:
        key: The publishing node and its topic.
        uri: The node's slave API.
    """

    def __init__(self, key: tuple[str, str], uri: str) -> None:
        self.key = key
        # Whether the publisher has accepted the connection.
        self.connected = False
        self._latched = False
        self._ends: list[float] = []
        self._bytes = self._size = self._left = 0
        self._link = PublisherConnection(
            key[1], uri, _CALLER, on_message=self._message, on_parts=self, on_header=self._header
        )
        self._link.start()

    def close(self) -> None:
        """Disconnect."""
        self._link.close()

    def _header(self, fields: Mapping[str, str]) -> None:
        self.connected, self._latched = True, fields.get("latching") == "1"

    def _message(self, framed: memoryview) -> None:
        self.begin(len(framed))
        self.part(framed)

    def begin(self, size: int) -> None:
        """A message begins."""
        self._size = self._left = size

    def part(self, part: memoryview) -> None:
        """A part of it has come."""
        self._left -= len(part)
        if self._left > 0:
            return
        if self._latched:
            self._latched = False  # what is latched comes first, and says nothing of the rate
            return
        self._ends.append(time.monotonic())
        self._bytes += self._size - LENGTH.size
        count = len(self._ends)
        if count >= limits.RATES_MESSAGES or (count > 2 and self._bytes >= limits.RATES_BYTES):
            asyncio.get_running_loop().call_soon(self.close)

    def abort(self) -> None:
        """The rest does not come."""

    def figures(self) -> tuple[float, float]:
        """Messages and bytes a second."""
        count = len(self._ends)
        span = self._ends[-1] - self._ends[0] if count > 1 else 0.0
        rate = (count - 1) / span if span > 0 else count / limits.RATES_SAMPLE
        return rate, rate * self._bytes / count if count else 0.0
