"""Reads the figures of direct connections from the nodes at their ends, only while somebody looks.

No agent is on the way of a direct connection. What it carries is in the statistics of its two nodes: this agent asks
the one on its machine (``getBusInfo`` and ``getBusStats``), once a second for some seconds after the last look.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from rmpa.bridge.policy import OWN_NODE
from rmpa.core.errors import RmpaError
from rmpa.observe import limits
from rmpa.observe.direct_traffic import TrafficMeter
from rmpa.ros.http.client import call
from rmpa.ros.wire.bus import BusTraffic, read_bus_info, read_bus_stats
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.tcp_connections import carried, connections

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

    from rmpa.observe.snapshot import DirectFigures
    from rmpa.ros.wire.bus import BusLink

_log = logging.getLogger(__name__)
_BEYOND: Final = "exceeds XML-RPC limits"
"""In the fault of a rospy node once a connection has carried 2 GiB (``ros.wire.bus``)."""


class DirectFlow(NamedTuple):
    """A direct connection, at the end that is on this machine.

    Args:
        node: The local node.
        uri: Its slave API.
        topic: The topic.
        subscriber: The subscriber: the local node itself, or the peer's.
        endpoint: The publisher's address and port, if the local node is the subscriber; else ``None``.
    """

    node: str
    uri: str
    topic: str
    subscriber: str
    endpoint: tuple[str, int] | None = None


@dataclass(slots=True)
class DirectSample:
    """What the local node of a flow said last.

    Args:
        connected: Whether it has the connection, and the kernel too; ``None``: not known.
        problem: Why the node tells no figures, ready to read; empty if it does, or will.
        by_kernel: Whether the readings are the kernel's for that reason.
        silent: Whether the node did not answer.
        meter: The readings.
    """

    connected: bool | None = None
    problem: str = ""
    silent: bool = False
    by_kernel: bool = False
    meter: TrafficMeter = field(default_factory=TrafficMeter)

    @property
    def figures(self) -> DirectFigures | None:
        """The figures; ``None`` if they are not known."""
        figures = self.meter.figures() if self.by_kernel or not self.problem else None
        if figures is None or not self.by_kernel:
            return figures
        return msgspec.structs.replace(figures, counted_by="kernel")

    @property
    def settled(self) -> bool:
        """Whether there are as many readings as a rate needs, or will be none."""
        return self.meter.measured or (bool(self.problem) and not self.by_kernel)


class DirectSampler:
    """Samples the local nodes of direct connections while somebody looks.

    Args:
        flows: ``(topics) -> flows``: the direct connections of these topics now, or of all with ``None``.
    """

    def __init__(self, flows: Callable[[Collection[str] | None], Iterable[DirectFlow]]) -> None:
        self._flows = flows
        self._samples: dict[DirectFlow, DirectSample] = {}
        self._until: dict[str | None, float] = {}
        """When the interest in a topic (``None``: in all) ends, monotonic seconds."""
        self._task: asyncio.Task[None] | None = None
        self._wake = asyncio.Event()
        self._sampled = asyncio.Event()

    def __getitem__(self, flow: DirectFlow) -> DirectSample:
        """What is known of a flow; nothing if it was not looked at."""
        return self._samples.get(flow) or DirectSample()

    @property
    def idle(self) -> bool:
        """Whether no node is asked."""
        return self._task is None

    @property
    def watched(self) -> int:
        """The number of topics (all of them are one) that are looked at."""
        return len(self._until)

    def look(self, topics: Collection[str] | None) -> None:
        """Sample the direct connections of topics, or of all with ``None``, for ``limits.DIRECT_LOOK`` seconds."""
        flows = list(self._flows(topics))
        if not flows:
            return
        until = asyncio.get_running_loop().time() + limits.DIRECT_LOOK
        # Only topics that have direct connections: a peer may ask for any name.
        self._until |= dict.fromkeys([None] if topics is None else {flow.topic for flow in flows}, until)
        if not all(self[flow].settled for flow in flows):
            self._wake.set()
        if self._task is None:
            self._task = asyncio.create_task(self._run(), name="figures of direct connections")

    async def settle(self, topics: Collection[str] | None) -> None:
        """Look, and wait until there are figures, for at most ``limits.DIRECT_FIRST_LOOK`` seconds."""
        self.look(topics)
        try:
            async with asyncio.timeout(limits.DIRECT_FIRST_LOOK):
                while self._task is not None and self._unsettled(topics):
                    self._sampled.clear()
                    await self._sampled.wait()
        except TimeoutError:
            pass

    async def close(self) -> None:
        """Stop."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    def _unsettled(self, topics: Collection[str] | None) -> bool:
        return any(not self[flow].settled for flow in self._flows(topics))

    def _wanted(self) -> list[DirectFlow]:
        """The flows that somebody looks at, and none that is over."""
        now = asyncio.get_running_loop().time()
        self._until = {topic: until for topic, until in self._until.items() if until > now}
        if not self._until:
            return []
        return list(self._flows(None if None in self._until else [topic for topic in self._until if topic]))

    async def _run(self) -> None:
        try:
            while flows := self._wanted():
                self._samples = {flow: self._samples.get(flow) or DirectSample() for flow in flows}
                self._wake.clear()
                await self._sample(flows)
                self._sampled.set()
                settled = all(sample.settled for sample in self._samples.values())
                pause = limits.DIRECT_SAMPLE_INTERVAL if settled else limits.DIRECT_SAMPLE_FIRST
                await self._pause(pause)
        except Exception:  # noqa: BLE001 - a task's top
            _log.exception("! figures of direct connections")
        finally:
            self._task = None
            self._samples.clear()
            self._sampled.set()

    async def _pause(self, seconds: float) -> None:
        """Wait; a look at what has not been sampled yet ends it early, once there are two samples of the rest."""
        try:
            async with asyncio.timeout(seconds):
                if seconds > limits.DIRECT_SAMPLE_FIRST:
                    await self._wake.wait()
                else:
                    await asyncio.Event().wait()
        except TimeoutError:
            pass

    async def _sample(self, flows: Collection[DirectFlow]) -> None:
        nodes: dict[str, list[DirectFlow]] = {}
        for flow in flows:
            nodes.setdefault(flow.uri, []).append(flow)
        free = asyncio.Semaphore(limits.DIRECT_SAMPLE_NODES)

        async def one(uri: str, of_node: list[DirectFlow]) -> None:
            async with free:
                await self._ask(uri, of_node)

        await asyncio.gather(*(one(uri, of_node) for uri, of_node in nodes.items()))

    async def _ask(self, uri: str, flows: list[DirectFlow]) -> None:
        """Ask one node for its connections and their traffic."""
        node, timeout = flows[0].node, limits.DIRECT_SAMPLE_TIMEOUT
        links: list[BusLink] | None = None
        stats: list[BusTraffic] = []
        problem = ""
        try:
            links = read_bus_info(await call(uri, "getBusInfo", OWN_NODE, timeout=timeout))
            stats = read_bus_stats(await call(uri, "getBusStats", OWN_NODE, timeout=timeout))
        except RosFault as fault:
            problem = f"{node} does not tell its figures: {fault.text}"
            if _BEYOND in fault.text:
                problem = f"{node} cannot tell its figures: rospy's counters end at 2 GiB"
        except RmpaError as error:
            problem = f"{node} does not tell its figures: {error}"
        now = asyncio.get_running_loop().time()
        for flow in flows:
            inbound = flow.endpoint is not None
            traffic = {one.number: one for one in stats if one.topic == flow.topic and one.inbound == inbound}
            sample = self._samples.get(flow)
            if sample is not None:
                _take(sample, flow, links, traffic, problem, now)


def _take(
    sample: DirectSample,
    flow: DirectFlow,
    links: list[BusLink] | None,
    traffic: dict[int, BusTraffic],
    problem: str,
    now: float,
) -> None:
    """Judge what a node said of one of its flows."""
    sample.problem, sample.silent, sample.by_kernel = problem, links is None, False
    if links is None:
        # The node may be stopped, or too busy; the kernel still knows whether it has a connection.
        sample.connected = _stands(flow.endpoint)
        return
    found = next((link for link in links if _is(link, flow)), None)
    sample.connected = found is not None and _stands(flow.endpoint, found.local_port) is not False
    if found is None:
        sample.problem = problem or f"{flow.node} has no such connection now"
        return
    counts = traffic.get(found.number)
    if counts is None:
        # roscpp lists only the publisher of a subscription that connected last.
        sample.problem = problem or f"{flow.node} does not tell the figures of this connection"
        counts = _by_kernel(found)
    sample.by_kernel = bool(sample.problem) and counts is not None
    if counts is not None:
        sample.meter.take(found, counts, now)


def _by_kernel(link: BusLink) -> BusTraffic | None:
    """What the kernel has counted of a connection; ``None`` if it cannot be named, or the kernel does not tell."""
    try:
        found = carried(link.local_port, link.remote) if link.local_port and link.remote else None
    except ValueError:
        return None  # the node gives a host name
    if found is None:
        return None
    return BusTraffic(link.number, link.topic, link.inbound, found[1] if link.inbound else found[0], None, None)


def _is(link: BusLink, flow: DirectFlow) -> bool:
    if link.topic != flow.topic or not link.connected or link.inbound != (flow.endpoint is not None):
        return False
    return link.remote == flow.endpoint if flow.endpoint is not None else link.other == flow.subscriber


def _stands(endpoint: tuple[str, int] | None, port: int | None = None) -> bool | None:
    """Whether the kernel has a connection to a publisher, from a local port if that is known; ``None``: not known."""
    found = connections(remote=endpoint) if endpoint is not None else None
    if found is None:
        return None
    return any(port in (None, one.local[1]) and one.state == "ESTABLISHED" for one in found)
