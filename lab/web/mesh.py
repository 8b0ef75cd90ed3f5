"""A control socket that shows a mesh of many modules: a real agent's answers, with modules added to its snapshots.

``rmpa web`` then serves pages with so many modules and topics, whose figures move as those of a real mesh do, while
one machine runs them. With ``--churn`` modules come and go, and topics are withdrawn for others with new names.
Events: ``up`` when the socket is there.
"""

from __future__ import annotations

import argparse
import math
import socket
import socketserver
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from lab.nodes.node import say
from rmpa.core.facts import LatencyInfo, LinkInfo, RouteInfo, ServiceInfo, TopicInfo
from rmpa.core.statistics import SampleSpread
from rmpa.observe.control_client import ControlClient, ControlReply, ControlRequest
from rmpa.observe.snapshot import PeerInfo, Snapshot

if TYPE_CHECKING:
    from collections.abc import Iterator

TOPICS_EACH: Final = 20
SERVICES_EACH: Final = 4
# One topic in so many flows; the others are offered, and this module does not subscribe to them.
_ACTIVE: Final = 3
# Seconds.
_SNAPSHOT_EVERY: Final = 0.1
# Of a message: a nav_msgs/Odometry.
_BYTES: Final = 712
# With churn one module in so many is away, each time another one.
_ABSENT: Final = 8
# With churn a module with a new name stays for so many changes.
_VISIT: Final = 30


class Mesh:
    """The modules, by a clock.

    Args:
        name: Of this module, which a real agent stands for.
        modules: With this one.
        churn: Seconds from one change of modules and topics to the next; 0: nothing but figures changes.
    """

    def __init__(self, name: str, modules: int = 16, churn: float = 0.0) -> None:
        self._name = name
        self._modules = modules
        self._churn = churn
        # Seconds since the epoch; the figures move from there on.
        self.began = time.time()

    def add(self, real: Snapshot) -> Snapshot:
        """A real agent's snapshot with the modules, which it would say if they were there."""
        age = real.taken - self.began
        turn = int(age / self._churn) if self._churn else 0
        names = [*self._names(turn)]
        topics = [topic for number, name in names for topic in _topics(number, name, turn, age)]
        services = [service for _, name in names for service in _services(name)]
        return msgspec.structs.replace(
            real,
            agent=msgspec.structs.replace(real.agent, name=self._name),
            peers=tuple(_peer(number, name, age) for number, name in names),
            topics=tuple(sorted((*real.topics, *topics), key=lambda topic: topic.name)),
            services=(*real.services, *services),
        )

    def _names(self, turn: int) -> Iterator[tuple[int, str]]:
        for number in range(1, self._modules):
            if not self._churn or (turn + number) % _ABSENT:
                yield number, f"module_{number:02d}"
        if self._churn:
            yield self._modules, f"visitor_{turn // _VISIT}"


def _wave(number: int, age: float, share: float) -> float:
    """A factor around 1 that moves by ``share``, for each number in its own time."""
    return 1 + share * math.sin(age * (0.3 + 0.07 * (number % 11)) + number)


def _peer(number: int, name: str, age: float) -> PeerInfo:
    received = int(40_000 * age * _wave(number, 0.0, 0.5))
    link = LinkInfo(
        remote=f"10.0.0.{number}:40001",
        dialled=bool(number % 2),
        up_ago=age,
        rtt=3e-4 * _wave(number, age, 0.3),
        clock_offset=0.002 * _wave(number, age / 100, 0.1),
        clock_error=2e-4 * _wave(number, age, 0.2),
        bytes_in=received,
        bytes_out=received // 3,
        heard_ago=0.1,
    )
    return PeerInfo(
        name=name,
        guid=f"10.0.0.{number}:40001#1",
        instance=f"{number:032x}",
        addresses=(f"10.0.0.{number}",),
        state="linked",
        since_ago=age,
        found_ago=age + 1,
        beacon_ago=age % 5,
        source="multicast",
        link=link,
        topics_in=TOPICS_EACH,
        topics_out=3,
    )


def _topics(number: int, name: str, turn: int, age: float) -> Iterator[TopicInfo]:
    for index in range(TOPICS_EACH):
        # One topic of a module has a new name at each turn.
        generation = (turn + index) // TOPICS_EACH
        suffix = f"_{generation}" if generation else ""
        active = index % _ACTIVE == 0
        yield TopicInfo(
            name=f"/{name}/topic_{index:02d}{suffix}",
            type="nav_msgs/Odometry",
            md5="cd5e73d190d741a2f92e81eda573aca7",
            subscribers=("/viewer",) if active else (),
            routes=(_route(number * TOPICS_EACH + index, name, active=active, age=age),),
            policy="bridge.allow has /**",
        )


def _route(number: int, peer: str, *, active: bool, age: float) -> RouteInfo:
    if not active:
        return RouteInfo(peer=peer, node=f"/{peer}/node", direction="in", state="idle", type="nav_msgs/Odometry")
    rate = (1.0 + number * 7 % 50) * _wave(number, age, 0.05)
    period = SampleSpread(
        count=600, mean=1 / rate, sd=2e-4, min=0.9 / rate, max=1.2 / rate, p50=1 / rate, p99=1.1 / rate
    )
    middle = 0.001 * _wave(number, age, 0.3)
    return RouteInfo(
        peer=peer,
        node=f"/{peer}/node",
        direction="in",
        state="open",
        type="nav_msgs/Odometry",
        messages=int(rate * age),
        bytes=int(rate * age) * _BYTES,
        age=abs(math.sin(age * 7)) / rate,
        rate=rate,
        bandwidth=rate * _BYTES,
        period=period,
        jitter=0.1 / rate,
        latency=LatencyInfo(
            count=600,
            mean=middle,
            sd=middle / 5,
            min=middle / 2,
            max=3 * middle,
            p50=middle,
            p99=2 * middle,
            last=middle,
            error=2e-4,
        ),
        lane="express",
        contract={"reliability": "reliable", "history": 10.0},
        transport="relay",
    )


def _services(name: str) -> Iterator[ServiceInfo]:
    for index in range(SERVICES_EACH):
        yield ServiceInfo(
            name=f"/{name}/service_{index}", node=f"/{name}/node", direction="in", peer=name, type="std_srvs/SetBool"
        )


class ControlProxy(socketserver.ThreadingUnixStreamServer):
    """A control socket in front of an agent's, which adds a mesh to its snapshots.

    Args:
        path: Of the new socket.
        agent: Of the agent's.
        mesh: Is added.
    """

    daemon_threads = True

    def __init__(self, path: Path, agent: Path, mesh: Mesh) -> None:
        self.agent = agent
        # The newest reply, made beforehand: a real agent needs a millisecond for it, this program ten.
        self.snapshot = b""
        self._mesh = mesh
        self._make()
        threading.Thread(target=self._keep_fresh, name="snapshots", daemon=True).start()
        super().__init__(str(path), _Connection)

    def _keep_fresh(self) -> None:
        while True:
            time.sleep(_SNAPSHOT_EVERY)
            self._make()

    def _make(self) -> None:
        with ControlClient(self.agent) as client:
            self.snapshot = ControlReply(ok=True, value=self._mesh.add(client.snapshot())).serialize()


class _Connection(socketserver.StreamRequestHandler):
    server: ControlProxy

    def handle(self) -> None:
        with socket.socket(socket.AF_UNIX) as behind:
            behind.connect(str(self.server.agent))
            answers = behind.makefile("rb")
            for line in self.rfile:
                if ControlRequest.parse(line).op == "snapshot":
                    self.wfile.write(self.server.snapshot)
                else:
                    behind.sendall(line)
                    self.wfile.write(answers.readline())


def main() -> None:
    """Serve until the process is ended."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--agent", type=Path, required=True, help="the agent's control socket")
    parser.add_argument("--socket", type=Path, required=True, help="the socket to make; its stem names the module")
    parser.add_argument("--modules", type=int, default=16)
    parser.add_argument("--churn", type=float, default=0.0)
    given = parser.parse_args()
    mesh = Mesh(given.socket.stem, given.modules, given.churn)
    with ControlProxy(given.socket, given.agent, mesh) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        say("up")
        threading.Event().wait()


if __name__ == "__main__":
    main()
