"""What the gateway to ROS 2 by rclpy costs, beside a relay of rclpy, on one host with ROS 2's own discovery.

::

    RMPA    roscpp source ─ agent ─ gateway ─ half ═ echo of rclpy ═ half ─ gateway ─ agent ─ roscpp sink
    rclpy   rclpy source ═ relay of rclpy ═ echo of rclpy ═ the same relay ═ rclpy sink             (═ is DDS)

Both go there and back with the same echo. What is compared is the whole way from due to there: so RMPA's has
a hop from ROS 1's node to its agent and one from agent to gateway each way, in the place of which the relay has
DDS. All nodes of rclpy pass bytes, which is the fastest that rclpy can.
"""

from __future__ import annotations

import statistics
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab.bed.bench import TEST_NODES, Bed
from lab.bed.gateways import GatewayProcess, python_of
from lab.bed.processes import Process, eventually
from lab.bed.ros import NODES, Ros, compiled
from lab.bench.schedule import LatencyScore, MeasuredStream
from lab.findings import Claim
from lab.results import finish
from lab.tables import percentiles, size, table_of, usage_table
from lab.usage import Meter

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from rich.console import Console

    from lab.bed.agents import Agent

# What ``--only`` can choose.
PARTS: Final = ("streams", "idle", "start")
_DISTRIBUTION: Final = "jazzy"
_MB: Final = 1024 * 1024
# Size, rate, and what the ratio of the p50 is to be.
_STREAMS: Final = ((64, 100.0, 1.5), (_MB, 30.0, 1.6))
_CPU_FACTOR: Final = 0.6
_IDLE_TARGET: Final = 1.0
_START_TARGET: Final = 1.0
_NODES, _TOPICS = 10, 20
_SETTLE: Final = 6.0
_DEADLINE: Final = 60.0
_CONFIG: Final = '[gateway.ros2]\nenabled = true\nvia = "rclpy"\npython = "{python}"\n'


@dataclass(frozen=True, slots=True)
class _Plan:
    """How much is measured: turns of each way, seconds of each, of idling, and starts of a node."""

    rounds: int
    seconds: float
    idle: float
    starts: int


FULL: Final = _Plan(8, 6.0, 30.0, 15)
QUICK: Final = _Plan(3, 3.0, 10.0, 4)


class _Hall:
    """A module, a gateway to ROS 2, and nodes, on one host."""

    def __init__(self, bed: Bed, stack: ExitStack) -> None:
        self.bed = bed
        self.host = bed.lab.host("robot", 0)
        self.host.ip("link", "set", "lo", "multicast", "on")
        self.agent: Agent = bed.agent(self.host, name="robot")
        config = _CONFIG.format(python=python_of(_DISTRIBUTION))
        self.gateway = GatewayProcess(self.host, bed.home, name="gate", log_level="warning", config=config)
        stack.enter_context(self.gateway)
        self.gateway.start()
        self.gateway.wait_ready()
        self.agent.wait_peer(self.gateway.name)
        self.shell: Ros = bed.shell(self.host, self.agent.core_port)

    def rclpy(self, *words: str, domain: int = 0) -> Process:
        """Start a node of rclpy."""
        env = {"PYTHONPATH": str(NODES), "ROS_DOMAIN_ID": str(domain)}
        argv: list[str | Path] = [python_of(_DISTRIBUTION), NODES / "rclpy_node.py", *words]
        made = self.shell.start(*argv, name=f"rclpy {words[0]}", env=env, commands=True)
        made.wait_event("up", _DEADLINE)
        return made

    def streams(self) -> dict[str, MeasuredStream]:
        """The two ways; that of rclpy alone is in a domain of its own."""
        echo = self.rclpy("relay", "/there", "/back")
        between = {"agent": self.agent.process, "gateway": self.gateway.process, "echo": echo}
        target = self.shell.start(compiled("sink"), "--topics", "/back", "--nodelay", name="sink", commands=True)
        source = self.shell.start(compiled("source"), "--topic", "/there", "--nodelay", name="source", commands=True)
        rmpa = MeasuredStream(self.bed, source, target, "/back", between)
        rmpa.pids["half"] = self.gateway.half()
        relay = self.rclpy("relay", "/there", "/on", "/back", "/home", domain=1)
        between = {"relay": relay, "echo": self.rclpy("relay", "/on", "/back", domain=1)}
        source, target = self.rclpy("source", "/there", domain=1), self.rclpy("sink", "/home", domain=1)
        plain = MeasuredStream(self.bed, source, target, "/home", between)
        for each in (rmpa, plain):
            each.wait_flowing()
        return {"rmpa": rmpa, "rclpy": plain}


def why_no_ros2() -> str:
    """Why rclpy cannot be measured here, or an empty string."""
    return "" if python_of(_DISTRIBUTION).exists() else f"ROS 2 {_DISTRIBUTION} is not there (scripts/install-ros2)"


def measure(quick: bool, console: Console, json: Path | None = None, only: Sequence[str] = ()) -> dict[str, object]:
    """Measure all parts or ``only`` these, print the tables, write the file; return the result."""
    plan = QUICK if quick else FULL
    result: dict[str, object] = {}
    claims: list[Claim] = []
    for name, part in {"streams": _streams, "idle": _idle, "start": _start}.items():
        if name in (only or PARTS):
            console.print(name, style="dim")
            with Bed() as bed, ExitStack() as stack:
                result[name] = part(_Hall(bed, stack), plan, console, claims)
    return finish(console, "ros2", asdict(plan), result, json, claims=claims)


def _streams(hall: _Hall, plan: _Plan, console: Console, claims: list[Claim]) -> object:
    ways = hall.streams()
    scores = {(key, each): LatencyScore() for each, *_ in _STREAMS for key in ways}
    for turn in range(plan.rounds):
        for each, rate, _ in _STREAMS:
            for key in sorted(ways, reverse=bool(turn % 2)):
                scores[key, each].add(ways[key].run(each, rate, plan.seconds, settle=1.0))
    table = table_of("there and back, µs", ("way", "size"), ("p50", "p95", "p99", "p99.9", "max", "came", "lost"))
    for (key, each), score in scores.items():
        found = score.summary
        table.add_row(key, size(each), *percentiles(found), str(found.count), str(found.lost))
    console.print(table)
    rows = [(f"{key}, {size(each)}", score.usage, score.messages) for (key, each), score in scores.items()]
    console.print(usage_table("processes on the way", rows, "message there and back"))
    for each, rate, wanted in _STREAMS:
        rmpa, plain = scores["rmpa", each], scores["rclpy", each]
        text = f"{size(each)} at {rate:.0f} Hz, there and back, p50, RMPA / a relay of rclpy"
        claims.append(Claim(text, _ratio(rmpa.median_of_rounds(50.0), plain.median_of_rounds(50.0)), wanted))
        claims.append(Claim(f"{size(each)}: lost by RMPA where rclpy loses {plain.lost}", rmpa.lost, plain.lost))
    # On the same way the half and the echo hear and publish the same messages.
    used = scores["rmpa", 64].usage
    text = "64 B, processor time, half / the echo beside it by rclpy's executor (each hears and publishes one a trip)"
    claims.append(Claim(text, _ratio(used["half"].cpu, used["echo"].cpu), _CPU_FACTOR))
    return {f"{key} {each}": score.row(20_000.0) for (key, each), score in scores.items()}


def _ratio(value: float | None, base: float | None) -> float | None:
    return round(value / base, 3) if value and base else None


def _idle(hall: _Hall, plan: _Plan, console: Console, claims: list[Claim]) -> Mapping[str, float]:
    hall.rclpy("crowd").tell(f"{_NODES} {_TOPICS} idle")
    last = f"/idle/t{_NODES - 1}_{_TOPICS - 1}"
    eventually(lambda: last in hall.shell.graph_topics(), _DEADLINE, what=f"{last} at the module")
    time.sleep(_SETTLE)
    meter = Meter({"gateway": hall.gateway.pid, "half": hall.gateway.half()})
    time.sleep(plan.idle)
    found = {name: round(one.percent, 3) for name, one in meter.read().items()}
    console.print(f"idle at {_NODES * _TOPICS} topics, % of a core: {found}")
    text = f"idle at {_NODES * _TOPICS} topics of {_NODES} nodes, gateway and half, % of a core"
    claims.append(Claim(text, round(sum(found.values()), 2), _IDLE_TARGET))
    return found


def _start(hall: _Hall, plan: _Plan, console: Console, claims: list[Claim]) -> dict[str, list[float]]:
    """A node of rclpy beside it tells how much of the time is ROS 2's own discovery."""
    module, beside = hall.shell.rospy("watcher", nodes=TEST_NODES, period=0.005), hall.rclpy("watch")
    module.wait_event("up")
    taken: dict[str, list[float]] = {"module": [], "rclpy": []}
    for turn in range(plan.starts):
        node = hall.rclpy("crowd")
        beside.tell(f"/new{turn}/t0_0")
        node.tell(f"1 1 new{turn}")
        begun = int(str(node.wait_event("made", _DEADLINE)["ns"]))
        for key, process, name in (
            ("module", module, f"/rmpa/ros2/new{turn}_0"),
            ("rclpy", beside, f"/new{turn}/t0_0"),
        ):
            there = process.wait_event("there", _DEADLINE, where=lambda e, n=name: n in e.values())  # type: ignore[misc]
            taken[key].append(round((int(str(there["ns"])) - begun) / 1e9, 3))
        node.end()
    console.print(f"from before rclpy.init() to the topic, s: {taken}")
    middle = {key: round(statistics.median(times), 3) for key, times in taken.items()}
    text = (
        f"from the start of a node of rclpy to its topic at a module (a node of rclpy: {middle['rclpy']}), median, s"
    )
    claims.append(Claim(text, middle["module"], _START_TARGET))
    return taken
