"""The paths that are compared: each starts its processes once and then answers rounds of round trips."""

from __future__ import annotations

import sys
from array import array
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab.bed.namespaces import MACHINE
from lab.bed.ros import NODES, Ros, compiled
from lab.usage import Meter, Usage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from lab.bed.agents import Agent
    from lab.bed.bench import Bed
    from lab.bed.processes import Process

RELAY: Final = Path("/usr/lib/topic_tools/relay")
_ROUND_DEADLINE: Final = 120.0


@dataclass(slots=True)
class Contender:
    """One path from ``ping`` and back.

    Args:
        key: Its name in JSON.
        title: Its name in tables.
        ping: The process that takes "SIZE COUNT FILE" lines.
        processes: Every process on the path, by name.
        still: Those that may be stopped while others are measured (nobody watches whether they live).
    """

    key: str
    title: str
    ping: Process
    processes: dict[str, Process]
    still: list[Process] = field(default_factory=list)

    def round(self, size: int, count: int, scratch: Path) -> tuple[array[int], int, dict[str, Usage]]:
        """Make ``count`` round trips; return their times in ns, the number lost, and the usage by process."""
        since = self.ping.mark_events()
        meter = Meter({name: process.pid for name, process in self.processes.items()})
        self.ping.tell(f"{size} {count} {scratch}")
        event = self.ping.wait_event("round", _ROUND_DEADLINE, since=since)
        usage = meter.read()
        samples = array("Q")
        samples.frombytes(scratch.read_bytes())
        return samples, int(str(event["lost"])), usage

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


def floor_c(bed: Bed) -> Contender:
    """Raw TCP in C++."""
    shell = bed.shell()
    program = compiled("floor", NODES)
    server = shell.start(program, "serve")
    port = str(server.wait_event("up")["port"])
    return _raw("floor_c", "C, raw TCP", shell.start(program, "ping", port, commands=True), server)


def floor_python(bed: Bed) -> Contender:
    """Raw TCP in Python, with the interpreter that runs the agents."""
    shell = bed.shell()
    program = NODES / "floor.py"
    server = shell.start(sys.executable, program, "serve")
    port = str(server.wait_event("up")["port"])
    ping = shell.start(sys.executable, program, "ping", port, commands=True)
    return _raw("floor_python", "Python, raw TCP", ping, server)


def _raw(key: str, title: str, ping: Process, server: Process) -> Contender:
    ping.wait_event("ready")
    return Contender(key, title, ping, {"ping": ping, "pong": server}, [ping, server])


def direct(client: str, *, nodelay: bool) -> Callable[[Bed], Contender]:
    """One client library, straight from node to node."""

    def start(bed: Bed) -> Contender:
        shell = bed.shell()
        shell.master()
        word = "tcpNoDelay" if nodelay else "Nagle"
        key = f"{client}_{'nodelay' if nodelay else 'nagle'}"
        return _nodes(key, f"{client} direct, {word}", shell, shell, client, nodelay=nodelay)

    return start


def direct_hosts(bed: Bed) -> Contender:
    """Roscpp straight from host to host by the same kind of cable as the agents': classic ROS at its best."""
    here, there = bed.classic()
    return _nodes("roscpp_hosts", "roscpp direct, two hosts", here, there, "roscpp")


def relays(bed: Bed) -> Contender:
    """Roscpp through two C++ relays each way: as many hops as through two agents."""
    shell = bed.shell()
    shell.master()
    between = {}
    for stage, (source, target) in enumerate(
        [("/ping", "/ping1"), ("/ping1", "/ping2"), ("/pong", "/pong1"), ("/pong1", "/pong2")], start=1
    ):
        between[f"relay {stage}"] = shell.start(RELAY, source, target, f"__name:=relay{stage}")
    return _nodes("relays", "roscpp, two C++ relays", shell, shell, "roscpp", between, ask="/ping2", answer="/pong2")


def agents_hosts(bed: Bed) -> Contender:
    """Roscpp through two agents in two network namespaces."""
    a, b = bed.lab.hosts("a", "b")
    first, second = bed.agent(a, name="a"), bed.agent(b, name="b")
    return _through("agents_hosts", "roscpp, two agents, two hosts", bed, first, second)


def agents_one_host(bed: Bed) -> Contender:
    """Roscpp through two agents on the real machine."""
    first, second = bed.agent(MACHINE, name="one"), bed.agent(MACHINE, name="two")
    return _through("agents_one_host", "roscpp, two agents, one host", bed, first, second)


def _through(key: str, title: str, bed: Bed, first: Agent, second: Agent) -> Contender:
    between = {"agent 1": first.process, "agent 2": second.process}
    here, there = (bed.shell(agent.host, agent.core_port) for agent in (first, second))
    made = _nodes(key, title, here, there, "roscpp", between)
    made.still = []
    return made


def _nodes(
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
) -> Contender:
    pong = there.node(client, "velocity", "__name:=pong", cmd=ask, vel="/pong", nodelay=nodelay)
    start = here.rospy if client == "rospy" else here.roscpp
    ping = start("ping", "__name:=ping", commands=True, topic="/ping", reply=answer, nodelay=nodelay)
    ping.wait_event("ready", 30.0)
    processes = {"ping": ping, **(between or {}), "pong": pong}
    return Contender(key, title, ping, processes, list(processes.values()))


ALL: Final[dict[str, Callable[[Bed], Contender]]] = {
    "floor_c": floor_c,
    "floor_python": floor_python,
    "roscpp_nodelay": direct("roscpp", nodelay=True),
    "roscpp_nagle": direct("roscpp", nodelay=False),
    "roscpp_hosts": direct_hosts,
    "rospy_nodelay": direct("rospy", nodelay=True),
    "rospy_nagle": direct("rospy", nodelay=False),
    "relays": relays,
    "agents_hosts": agents_hosts,
    "agents_one_host": agents_one_host,
}
