"""The paths that are compared: each starts its processes once and then answers rounds of round trips."""

from __future__ import annotations

import sys
from array import array
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab.bed.bench import Bed, why_no_hosts, why_no_ros
from lab.bed.namespaces import MACHINE
from lab.bed.ros import NODES, Ros, compiled
from lab.bed.transport import require
from lab.usage import Meter, Usage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from lab.bed.plan import Transport
    from lab.bed.processes import Process

# Bytes of the messages that are measured.
SIZES: Final = (64, 64 * 1024, 1024 * 1024)
RELAY: Final = Path("/usr/lib/topic_tools/relay")
_ROUND_DEADLINE: Final = 120.0


@dataclass(slots=True)
class RoundTripPath:
    """One path from ``ping`` and back.

    Args:
        key: Its name in JSON.
        title: Its name in tables.
        ping: The process that takes "SIZE COUNT FILE" lines.
        processes: Every process on the path, by name.
        still: Those that may be stopped (SIGSTOP) while others are measured: no other process supervises them.
        transport: How messages cross where there are agents, which each round makes sure of.
    """

    key: str
    title: str
    ping: Process
    processes: dict[str, Process]
    still: list[Process] = field(default_factory=list)
    transport: Transport | None = None

    def round(self, size: int, count: int, scratch: Path) -> tuple[array[int], int, dict[str, Usage]]:
        """Make ``count`` round trips; return their times in ns, the number lost, and the usage by process.

        Raises:
            Deadline: They are not over in time.
            BedError: Messages cross otherwise than they should.
        """
        since = self.ping.mark_events()
        meter = Meter({name: process.pid for name, process in self.processes.items()})
        self.ping.tell(f"{size} {count} {scratch}")
        event = self.ping.wait_event("round", _ROUND_DEADLINE, since=since)
        usage = meter.read()
        self.require_transport()
        samples = array("Q")
        samples.frombytes(scratch.read_bytes())
        return samples, int(str(event["lost"])), usage

    def require_transport(self) -> None:
        """Make sure that messages cross as they should.

        Raises:
            BedError: They do not.
        """
        if self.transport:
            ping, pong = self.ping, self.processes["pong"]
            require(self.transport, [(ping, pong), (pong, ping)])

    @contextmanager
    def awake(self) -> Iterator[None]:
        """Let its processes run only inside."""
        for process in self.still:
            process.thaw()
        try:
            yield
        finally:
            for process in self.still:
                process.freeze()


def floor_c(bed: Bed) -> RoundTripPath:
    """Raw TCP in C++."""
    program = compiled("floor", NODES)
    return _raw(bed, "floor_c", "C, raw TCP", program)


def floor_python(bed: Bed) -> RoundTripPath:
    """Raw TCP in Python."""
    return _raw(bed, "floor_python", "Python, raw TCP", sys.executable, NODES / "floor.py")


def _raw(bed: Bed, key: str, title: str, *program: str | Path) -> RoundTripPath:
    """Both ends are one program, called with ``serve``, and with ``ping`` and the port that the other one names."""
    shell = bed.shell()
    server = shell.start(*program, "serve", name=f"{key} pong")
    port = str(server.wait_event("up")["port"])
    ping = shell.start(*program, "ping", port, name=f"{key} ping", commands=True)
    ping.wait_event("ready")
    return RoundTripPath(key, title, ping, {"ping": ping, "pong": server}, [ping, server])


def direct(client: str, *, nodelay: bool) -> Callable[[Bed], RoundTripPath]:
    """One client library, straight from node to node."""

    def start(bed: Bed) -> RoundTripPath:
        shell = bed.shell()
        shell.master()
        word = "tcpNoDelay" if nodelay else "Nagle"
        key = f"{client}_{'nodelay' if nodelay else 'nagle'}"
        return nodes(key, f"{client} direct, {word}", shell, shell, client, nodelay=nodelay)

    return start


def direct_hosts(bed: Bed) -> RoundTripPath:
    """Roscpp straight from host to host by the same kind of cable as the agents': classic ROS at its best."""
    here, there = bed.classic()
    return nodes("roscpp_hosts", "roscpp direct, two hosts", here, there, "roscpp")


def relays(bed: Bed) -> RoundTripPath:
    """Roscpp through two C++ relays each way: as many hops as through two agents."""
    shell = bed.shell()
    shell.master()
    between = {}
    for stage, (source, target) in enumerate(
        [("/ping", "/ping1"), ("/ping1", "/ping2"), ("/pong", "/pong1"), ("/pong1", "/pong2")], start=1
    ):
        between[f"relay {stage}"] = shell.start(RELAY, source, target, f"__name:=relay{stage}")
    return nodes("relays", "roscpp, two C++ relays", shell, shell, "roscpp", between, ask="/ping2", answer="/pong2")


def through(
    key: str, title: str, transport: Transport, *, network: int | None = None, flags: Sequence[str] = ()
) -> Callable[[Bed], RoundTripPath]:
    """Roscpp by two agents: in two network namespaces, or without a network both on the real machine."""

    def start(bed: Bed) -> RoundTripPath:
        names = f"{key}_a", f"{key}_b"
        hosts = bed.lab.hosts(*names, network=network) if network is not None else (MACHINE, MACHINE)
        pair = [
            bed.agent(host, name=name, flags=flags, way=transport) for host, name in zip(hosts, names, strict=True)
        ]
        here, there = (bed.shell(agent.host, agent.core_port) for agent in pair)
        between = {f"agent {number}": agent.process for number, agent in enumerate(pair, 1)}
        made = nodes(key, title, here, there, "roscpp", between)
        made.still, made.transport = [], transport
        made.require_transport()
        return made

    return start


def nodes(
    key: str,
    title: str,
    here: Ros,
    there: Ros,
    client: str,
    between: dict[str, Process] | None = None,
    *,
    nodelay: bool = True,
    ask: str = "/ping",
    answer: str = "/pong",
) -> RoundTripPath:
    """ROS nodes as both ends: ``ping`` in ``here``, ``pong`` in ``there``, and the processes ``between`` by name."""
    pong = there.node(client, "velocity", "__name:=pong", cmd=ask, vel="/pong", nodelay=nodelay)
    start = here.rospy if client == "rospy" else here.roscpp
    ping = start("ping", "__name:=ping", commands=True, topic="/ping", reply=answer, nodelay=nodelay)
    ping.wait_event("ready", 30.0)
    processes = {"ping": ping, **(between or {}), "pong": pong}
    return RoundTripPath(key, title, ping, processes, list(processes.values()))


@dataclass(frozen=True, slots=True)
class Entry:
    """A contender that may take part.

    Args:
        start: Starts its processes.
        needs: Each says why it cannot run here, or an empty string.
    """

    start: Callable[[Bed], RoundTripPath]
    needs: tuple[Callable[[], str], ...] = ()

    def why_not(self) -> str:
        """Why it cannot take part here, or an empty string."""
        return next(filter(None, (why() for why in self.needs)), "")


_ROS: Final = (why_no_ros,)
_HOSTS: Final = (why_no_ros, why_no_hosts)
# All paths of ROS and RMPA, each at its best.
ENTRIES: Final[dict[str, Entry]] = {
    "floor_c": Entry(floor_c, needs=_ROS),  # compiled with the nodes' flags
    "floor_python": Entry(floor_python),
    "roscpp_nodelay": Entry(direct("roscpp", nodelay=True), needs=_ROS),
    "roscpp_nagle": Entry(direct("roscpp", nodelay=False), needs=_ROS),
    "roscpp_hosts": Entry(direct_hosts, needs=_HOSTS),
    "rospy_nodelay": Entry(direct("rospy", nodelay=True), needs=_ROS),
    "rospy_nagle": Entry(direct("rospy", nodelay=False), needs=_ROS),
    "relays": Entry(relays, needs=_ROS),
    "agents_hosts": Entry(through("agents_hosts", "roscpp, two agents, two hosts", "relay", network=0), needs=_HOSTS),
    "agents_one_host": Entry(through("agents_one_host", "roscpp, two agents, one host", "relay"), needs=_ROS),
    "direct_hosts": Entry(
        through("direct_hosts", "roscpp, RMPA direct, two hosts", "direct", network=1), needs=_HOSTS
    ),
    "direct_one_host": Entry(
        through("direct_one_host", "roscpp, RMPA direct, one host", "direct", flags=("--domain", "1")), needs=_ROS
    ),
}
