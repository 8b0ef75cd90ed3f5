"""The process of ``views``: a whole agent, with its control socket, in a mesh of which only this agent is real.

The other modules are simulated inside it: their links take bytes and send none, their catalogues are fed to the
bridge, and the roster names them. So core, bridge, snapshot, control socket and web server are those of a large
mesh, on one machine and without its network.

Arguments: the name, the directory of the control socket, the port of the core, peers, topics of each. ``ready`` is
printed once the graph is complete. Two operations are added to the control socket: ``holds`` returns the longest
time since the last call for which the event loop did not look at the data path, in milliseconds of processor time,
and ``change`` gives one peer another topic.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import random
import signal
import sys
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final, cast

from lab.bench.fleet_graph_agent import Holds
from rmpa.agent.agent import Agent
from rmpa.bridge.messages import (
    Advertise,
    AdvertiseServices,
    Notification,
    Request,
    Response,
    ServiceOffer,
    Source,
    TopicOffer,
    decode,
    encode,
    op_of,
)
from rmpa.bridge.session.offer_versions import OFFERS
from rmpa.config.sources import load_settings
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.discovery.events import HeardBy, PeerView
from rmpa.mesh.io.lane import LaneSender
from rmpa.mesh.lane_demand import LaneDemand
from rmpa.runtime.descriptors import raise_file_limit
from rmpa.runtime.event_loop import AgentLoop

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.mesh.io.link import PeerLink

NODES: Final = 4
"""Nodes of each peer, among which its topics are divided."""
LINKED: Final = 12
"""Peers with a link; the others are parked, as in a mesh of that size."""
_TYPES: Final = ("std_msgs/String", "sensor_msgs/Image", "geometry_msgs/Twist", "nav_msgs/Odometry")


class _Link:
    """A link that takes what is sent."""

    local_address = "10.9.0.2"
    silent = crashed = busy = parked = dialled = False
    rests = True
    rtt = 0.0004
    clock_offset, clock_error = 0.001, 0.0002
    bytes_in = bytes_out = queue_bytes = dropped = 0
    bulk_connection = None
    held: Final[list[bytes]] = []

    def __init__(self, number: int, answer: Callable[[_Link, Request], None]) -> None:
        self._answer = answer
        guid = Guid.of(f"10.{9 + number // 60000}.{number // 250}.{number % 250 + 1}", 40001, 1000)
        self.identity = Identity(guid, os.urandom(16), f"module{number:04}")
        self.guid, self.name = guid, self.identity.name
        self.remote_endpoint = guid.endpoint
        self.since = self.resumed_at = self.touched_at = time.monotonic()
        self.express, self.bulk = LaneSender("express"), LaneSender("bulk")
        self.lane_demand = LaneDemand(dialled=False, agreed=True)
        self.connection = SimpleNamespace(stream=None, remote=None)

    @property
    def heard_at(self) -> float:
        """Just now."""
        return time.monotonic()

    def send_control(self, payload: bytes) -> None:
        """Take a control message; a question is answered."""
        if op_of(payload) == "ask":
            message = decode(payload)
            assert isinstance(message, Request)
            self._answer(self, message)

    def need(self, *, needed: bool, parks: bool = False) -> None:
        """Take what the bridge says of its use."""

    def touch(self) -> None:
        """Take that the link is to be checked."""


def _topics(link: PeerLink, topics: int) -> Advertise:
    offers = (
        TopicOffer(f"/{link.name}/sensors/topic{number:02}", f"/node{number % NODES}", _TYPES[number % len(_TYPES)])
        for number in range(topics)
    )
    return Advertise(tuple(offers), full=True)


def _services(link: PeerLink) -> AdvertiseServices:
    """One for each node under a name of its own, and some under names that all modules have."""
    own = [ServiceOffer(f"/{link.name}/node{number}/start", f"/node{number}") for number in range(NODES)]
    shared = [ServiceOffer(f"/node{number}/set_parameters", f"/node{number}") for number in range(NODES)]
    return AdvertiseServices((*own, *shared), full=True)


class Crowd:
    """The simulated peers of an agent.

    Args:
        agent: It has started.
        peers: So many.
        topics: Of each.
    """

    def __init__(self, agent: Agent, peers: int, topics: int) -> None:
        self._agent = agent
        self._topics = topics
        self.links = [cast("PeerLink", _Link(number, self._answer)) for number in range(peers)]
        endpoint = agent.network.endpoint
        assert endpoint is not None
        now = time.monotonic()
        views = tuple(
            PeerView(link.identity, now, now, HeardBy.MULTICAST, HeardBy.MULTICAST, None, False, (), True)
            for link in self.links
        )
        discovery, mesh = cast("Any", endpoint.discovery), cast("Any", endpoint.mesh)
        discovery.peers, mesh.paths.problem = lambda: views, lambda _link: None
        mesh.paths.packet_bytes = lambda _link: 1500
        endpoint.mode.count(1 + peers)

    async def join(self) -> None:
        """Take all peers in, and wait until the local graph is complete; then all but ``LINKED`` are parked."""
        bridge = self._agent.bridge
        bridge.sessions.on_want = self._want
        for link in self.links:
            self._link_up(link)
            await asyncio.sleep(0)
        await self._complete()
        for link in self.links[LINKED:]:
            link.parked = True
            bridge.sessions.link_down(link)
            await asyncio.sleep(0)

    def _link_up(self, link: PeerLink) -> None:
        link.parked = False
        self._agent.bridge.sessions.link_up(link)
        for message in (_topics(link, self._topics), _services(link), Notification(OFFERS, {"version": 1})):
            self._agent.bridge.control(link, encode(message))

    def _want(self, guid: Guid) -> None:
        """Link a parked peer again, for good."""
        link = next(link for link in self.links if link.guid == guid)
        asyncio.get_running_loop().call_soon(self._link_up, link)

    def _answer(self, link: _Link, request: Request) -> None:
        """Answer as an agent of an earlier release does."""
        reply = encode(Response(request.number, ok=False, error="not known here"))
        loop = asyncio.get_running_loop()
        loop.call_soon(lambda: self._agent.bridge.control(cast("PeerLink", link), reply))

    async def _complete(self) -> None:
        while True:
            shown = sum(topic.startswith("/module") for topic in self._agent.core.state().publishers)
            if shown == len(self.links) * self._topics:
                return
            await asyncio.sleep(0.2)

    def change(self, args: dict[str, object]) -> bool:
        """``on``: whether the first peer has one topic more."""
        link = self.links[0]
        topic, node = f"/{link.name}/sensors/more", "/node0"
        offer, source = (TopicOffer(topic, node, _TYPES[0]),), (Source(topic, node),)
        message = Advertise(offer) if args.get("on") else Advertise(removed=source)
        self._agent.bridge.control(link, encode(message))
        return True


async def _serve(name: str, place: str, core_port: int, peers: int, topics: int) -> None:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, AgentLoop)
    options = {"name": name, "core_port": str(core_port), "interface": ("lo",), "multicast": "239.255.82.77:0"}
    options["multicast"] = f"239.255.82.77:{20000 + os.getpid() % 20000}"
    settings = load_settings(options, {**os.environ, "RMPA_RUNTIME_DIR": place}, host_name=name).settings
    agent, stop = Agent(settings), asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop.set)
    holds = Holds(loop)
    crowds: list[Crowd] = []

    def change(args: dict[str, object]) -> bool:
        return crowds[0].change(args)

    agent.add_operations({"holds": lambda _args: holds.take(), "change": change})
    await agent.start()
    crowd = Crowd(agent, peers, topics)
    crowds.append(crowd)
    begun = time.process_time()
    await crowd.join()
    figures = {"join_seconds": round(time.process_time() - begun, 3), "join_hold_ms": round(holds.take(), 1)}
    print("ready " + json.dumps(figures), flush=True)
    await stop.wait()
    await agent.close()


if __name__ == "__main__":
    random.seed(1)
    raise_file_limit()
    gc.disable()
    with asyncio.Runner(loop_factory=AgentLoop) as runner:
        runner.run(_serve(sys.argv[1], sys.argv[2], *map(int, sys.argv[3:6])))
