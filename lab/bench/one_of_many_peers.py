"""The peers of ``one_of_many``: one process that plays many modules towards one agent, over real sockets.

Each module has a port of its own at one address: it announces itself and sends heartbeats, accepts the agent's link
with the protocol's real machine, offers some topics, and lets the link rest. They never dial: their GUIDs are the
higher ones.

Arguments: address, number of modules, topics of each, group, port of the group. Prints ``linked`` when all have got a
link and sent their catalogues. Runs until it is ended.
"""

from __future__ import annotations

import asyncio
import os
import random
import resource
import socket
import sys
import time
from functools import partial
from typing import TYPE_CHECKING, Final

from rmpa.bridge.messages import (
    Advertise,
    AdvertiseServices,
    Request,
    Response,
    TopicOffer,
    decode,
    encode,
    op_of,
)
from rmpa.core.identity import Guid, Identity
from rmpa.core.limits import PEER_LEASE
from rmpa.discovery import limits
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.mesh.connection import ConnectionProtocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.discovery.beacon import Address

_FIRST_PORT: Final = 20000
_NODES: Final = 4
_TYPES: Final = ("std_msgs/String", "sensor_msgs/Image", "geometry_msgs/Twist", "nav_msgs/Odometry")
_ANNOUNCEMENTS: Final = 100.0
"""A second: fewer than an agent takes from one address."""


class Crowd:
    """All modules.

    Args:
        address: Where they are.
        count: So many.
        topics: Of each.
        group: Address and port of the multicasts.
    """

    def __init__(self, address: str, count: int, topics: int, group: Address) -> None:
        self.topics = topics
        self._group = group
        self._linked: set[Module] = set()
        self._modules = [Module(self, number, address) for number in range(count)]

    async def run(self) -> None:
        """Announce all, then send heartbeats for ever."""
        for module in self._modules:
            await module.listen()
        for module in self._modules:
            self._multicast(module, BeaconKind.ANNOUNCE)
            await asyncio.sleep(1 / _ANNOUNCEMENTS)
        await self._send_heartbeats()

    def linked(self, module: Module) -> None:
        """A module has a link, and has sent its catalogue."""
        self._linked.add(module)
        if len(self._linked) == len(self._modules):
            print("linked", flush=True)

    async def _send_heartbeats(self) -> None:
        while True:
            order = random.sample(self._modules, len(self._modules))
            for module in order:
                self._multicast(module, BeaconKind.HEARTBEAT)
                await asyncio.sleep(limits.HEARTBEAT_INTERVAL / len(order))

    def _multicast(self, module: Module, kind: BeaconKind) -> None:
        module.udp.sendto(module.beacon(kind), self._group)


class Module:
    """One module.

    Args:
        crowd: All of them.
        number: From 0.
        address: Where it is.
    """

    def __init__(self, crowd: Crowd, number: int, address: str) -> None:
        port = _FIRST_PORT + number
        self.identity = Identity(Guid.of(address, port, 1), os.urandom(16), f"module{number:04}")
        self.crowd = crowd
        self._sequence = 0
        self._where = (address, port)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.udp.bind(self._where)
        self.udp.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(address))
        self.udp.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 0)

    async def listen(self) -> None:
        """Accept links."""
        await asyncio.get_running_loop().create_server(partial(Link, self), *self._where)

    def beacon(self, kind: BeaconKind) -> bytes:
        """The next beacon."""
        self._sequence += 1
        return Beacon(kind, self.identity, round(1000 * PEER_LEASE), self._sequence).serialize()

    def catalogue(self) -> tuple[bytes, ...]:
        """What it says on each new link."""
        name = self.identity.name
        offers = tuple(
            TopicOffer(f"/{name}/sensors/topic{n:02}", f"/node{n % _NODES}", _TYPES[n % len(_TYPES)])
            for n in range(self.crowd.topics)
        )
        return (
            encode(Advertise(offers, full=True)),
            encode(AdvertiseServices(full=True)),
        )


class Machine(ConnectionProtocol):
    """The machine of a ``Link``.

    Args:
        link: Which drives it.
        module: Which accepts it.
    """

    def __init__(self, link: Link, module: Module) -> None:
        self._link = link
        self._module = module
        super().__init__(module.identity, time.monotonic(), dialled=False, wall_ns=time.time_ns)

    def opened(self) -> None:
        """Say what the module offers."""
        self._link.flush()
        for payload in self._module.catalogue():
            self._link.transport.write(self.pack_control(payload))
        self.need(time.monotonic(), needed=False)
        self._module.crowd.linked(self._module)

    def control_received(self, payload: bytes) -> None:
        """Refuse each request."""
        if op_of(payload) == "ask":
            asked = decode(payload)
            assert isinstance(asked, Request)
            answer = Response(asked.number, ok=False, error="this module is only played")
            self._link.transport.write(self.pack_control(encode(answer)))

    def closed(self, reason: str) -> None:  # noqa: ARG002 - as the machine calls it
        """Close the socket."""
        self._link.transport.close()


class Link(asyncio.Protocol):
    """A connection that the agent has dialled.

    Args:
        module: Which accepts it.
    """

    def __init__(self, module: Module) -> None:
        self._module = module
        self._input = bytearray()
        self._timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin the handshake."""
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        self._machine = Machine(self, self._module)
        self.flush()

    def data_received(self, data: bytes) -> None:
        """Take frames."""
        self._input += data
        with memoryview(self._input) as view:
            taken, _ = self._machine.receive(view, time.monotonic())
        del self._input[:taken]
        self.flush()

    def connection_lost(self, exc: Exception | None) -> None:
        """The agent has ended it."""
        self._machine.lost(str(exc))
        self.flush()

    def flush(self) -> None:
        """Send what the machine has to say, and arm its timer."""
        if self._machine.output:
            self.transport.write(self._machine.take_output())
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if (due := self._machine.next_timer()) is not None:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(max(0.0, due - time.monotonic()), self._due)

    def _due(self) -> None:
        self._machine.handle_timer(time.monotonic())
        self.flush()


def main(words: Sequence[str]) -> None:
    """Run it; the arguments are those of the process."""
    address, count, topics, group, port = words
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))

    async def run() -> None:
        await Crowd(address, int(count), int(topics), (group, int(port))).run()

    asyncio.run(run())


if __name__ == "__main__":
    main(sys.argv[1:])
