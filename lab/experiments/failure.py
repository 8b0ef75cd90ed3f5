"""Experiment 4, which the paper only claims: what is lost when a host dies, or its cable is out.

Section 4 of the paper: with one master "any failure of the main device running the ROS core will disable the
communication between the rest of the system devices", while with a core on each host "failures will only affect to
the device itself".
"""

from __future__ import annotations

import contextlib
import functools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

from lab.bed import transport
from lab.bed.processes import Deadline, Process, eventually
from lab.experiments import flow
from lab.experiments.contenders import COMPARED, system_of, transport_of
from lab.experiments.failure_findings import FLOWS, RATE, SCENARIOS, findings
from lab.experiments.model import Cell, Measured, Results, Value
from lab.frames import frame

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from lab.bed.plan import Client, Plan
    from lab.bed.stage import Stage
    from lab.bed.system import System
    from lab.findings import Findings

HOSTS: Final = ("joystick", "velocity", "base", "pc")
_SIZE: Final = 64
# Seconds of the sources' one round: longer than any observation.
_FOR: Final = 180.0
# Seconds that a node has to say ``up`` after its host is on again; one that cannot reach its master says nothing.
_UP_WITHIN: Final = 5.0
_FLOWING_WITHIN: Final = 30.0
_BY_HAND_WITHIN: Final = 10.0


@dataclass(frozen=True, slots=True)
class PlacedNode:
    """One node of the robot.

    Args:
        name: Its ROS name: a node that is started again takes the place of the one before.
        host: Where.
        program: Which of ours.
        options: Its options.
    """

    name: str
    host: str
    program: Literal["source", "velocity", "sink"]
    options: Mapping[str, object]


NODES: Final = (
    PlacedNode("display", "pc", "sink", {"topics": "/cmd,/vel", "nodelay": True}),
    PlacedNode("log", "velocity", "sink", {"topics": "/cmd", "nodelay": True}),
    PlacedNode("wheels", "base", "sink", {"topics": "/vel", "nodelay": True}),
    PlacedNode("lamp", "joystick", "sink", {"topics": "/state", "nodelay": True}),
    PlacedNode(
        "controller", "velocity", "velocity", {"cmd": "/cmd", "vel": "/vel", "mode": "event", "nodelay": True}
    ),
    PlacedNode("stick", "joystick", "source", {"topic": "/cmd"}),
    PlacedNode("battery", "base", "source", {"topic": "/state"}),
)
_BY_NAME: Final = {node.name: node for node in NODES}
_KEYS: Final = {one.key for one in FLOWS}
# Nodes that publish, and those of other hosts that subscribe.
_PAIRS: Final = (
    *(("stick", sink) for sink in ("log", "controller", "display")),
    ("controller", "display"),
    ("controller", "wheels"),
    ("battery", "lamp"),
)
# Sources, and the sinks at which all topics come if they send.
_LEADS: Final = (("stick", "log"), ("stick", "display"), ("stick", "wheels"), ("battery", "lamp"))


@dataclass(frozen=True, slots=True)
class FailureTimes:
    """Seconds of a cell.

    Args:
        before: Of flow before anything happens.
        node: From the kill until a node of another host is started again.
        away: From there until the host is switched on again; of a cable, how long it is out.
        after: Of observation from then on: TCP tries again after 0.2 s, then after twice as long each time.
    """

    before: float
    node: float
    away: float
    after: float


_FULL: Final = FailureTimes(2.0, 2.0, 3.0, 8.0)
_SHORT: Final = FailureTimes(0.3, 0.5, 0.8, 2.0)


class PaperRobot:
    """The nodes on their hosts, and what they noted.

    Args:
        system: Its hosts.
        client: Whose nodes.
        stage: Where files go.
    """

    def __init__(self, system: System, client: Client, stage: Stage) -> None:
        self.system = system
        self._client = client
        self._scratch = stage.scratch
        self._running: dict[str, Process] = {}
        self._born: dict[str, float] = {}
        self.rows: list[tuple[Value, ...]] = []
        self.moments: list[tuple[Value, ...]] = []

    def begin(self) -> None:
        """Start all nodes; return when every flow runs, on its one schedule."""
        for node in NODES:
            self._start(node)
        self._wait_up(NODES, _FLOWING_WITHIN)
        for source, sink in _LEADS:
            topics = _topics(_BY_NAME[sink])
            flow.wait_flowing(
                self._running[source], self._running[sink], topics, self._scratch, timeout=_FLOWING_WITHIN
            )
        self.system.require_transport((self._running[one], self._running[other]) for one, other in _PAIRS)
        self.collect()
        self.rows.clear()
        self._send()

    def kill(self, host: str) -> None:
        """End a host; what its nodes noted is asked for just before."""
        self.collect(host)
        self.note("down")
        self.system.kill(host)
        for node in NODES:
            if node.host == host:
                self._running.pop(node.name).end()

    def switch_on(self, host: str) -> None:
        """Switch a host on, and start its nodes as soon as its agent is ready or its master answers.

        So are nodes elsewhere that gave up for want of a master: their supervisors try again.
        """
        began = self.system.start(host)
        self.note("on", began)
        gone = {name for name, process in self._running.items() if process.returncode is not None}
        self._again([node for node in NODES if node.host == host or node.name in gone], "on up", _UP_WITHIN)

    def start_again(self, name: str, within: float) -> None:
        """Kill one node and start it at once, as its supervisor does when it crashed; it has so many seconds."""
        self.collect(_BY_NAME[name].host)
        self._running.pop(name).kill()
        self.note("node")
        until = time.monotonic() + within
        self._again([_BY_NAME[name]], "node up", within)
        time.sleep(max(0.0, until - time.monotonic()))

    def by_hand(self, down: float) -> int:
        """Start every node anew that ran before ``down``, which a new master knows nothing of; return how many."""
        old = [node for node in NODES if self._born[node.name] < down]
        self.note("by hand")
        since = time.monotonic_ns()
        for node in old:
            self._running.pop(node.name).kill()
        for node in old:
            self._start(node)
        self._wait_up(NODES, _FLOWING_WITHIN)
        self._send()

        def all_flow() -> bool:
            self.collect()
            return {row[0] for row in self.rows if isinstance(row[3], int) and row[3] > since} >= {
                f.key for f in FLOWS
            }

        with contextlib.suppress(Deadline):  # then the table shows which did not come
            eventually(all_flow, _BY_HAND_WITHIN, every=0.2)
        self.note("by hand, end")
        return len(old)

    def note(self, what: str, at: float | None = None) -> None:
        """Remember when something happened: now, or at a time of ``time.monotonic``."""
        self.moments.append((what, int(1e9 * (time.monotonic() if at is None else at))))

    def collect(self, host: str = "") -> None:
        """Take what the sinks noted so far; of one host only, if one is given."""
        for node in NODES:
            process = self._running.get(node.name)
            # A node that waits for its master hears nothing yet, and has nothing.
            if node.program == "sink" and host in {"", node.host} and process and process.events("up"):
                self._take(node, process)

    def back(self) -> bool:
        """Whether every flow ran at the end of what was collected."""
        return self._seen(time.monotonic_ns() - int(0.5e9)) == _KEYS

    def _seen(self, since: int) -> set[Value]:
        """The flows of which something came since a moment, ns."""
        return {key for key, _, _, came in self.rows if isinstance(came, int) and came > since}

    def direct(self) -> int:
        """How many of the connections between hosts are from node to node."""
        running = [(self._running.get(one), self._running.get(other)) for one, other in _PAIRS]
        return sum(bool(one and other and transport.is_direct(one.pid, other.pid)) for one, other in running)

    # --- inside -------------------------------------------------------------------------------------------------

    def _again(self, nodes: Iterable[PlacedNode], what: str, within: float) -> None:
        nodes = list(nodes)
        for node in nodes:
            self._start(node)
        with contextlib.suppress(Deadline):  # one that cannot reach its master does not come up
            self._wait_up(nodes, within)
            self.note(what)

    def _start(self, node: PlacedNode) -> None:
        self._born[node.name] = time.monotonic()
        self._running[node.name] = self.system.node(
            node.host, node.program, self._client, wait=False, name=node.name, **node.options
        )

    def _wait_up(self, nodes: Iterable[PlacedNode], within: float) -> None:
        for node in nodes:
            self._running[node.name].wait_event("up", within)

    def _send(self) -> None:
        """Let the sources send on one schedule until all is over."""
        for node in NODES:
            if node.program == "source":
                flow.begin(self._running[node.name], self._scratch, size=_SIZE, rate=RATE, count=int(_FOR * RATE))

    def _take(self, node: PlacedNode, process: Process) -> None:
        keys = {one.topic: one.key for one in FLOWS if one.sink == node.name}
        noted = flow.noted(process, _topics(node), self._scratch, settle=0.0)
        for topic, *row in noted.itertuples(index=False, name=None):
            self.rows.append((keys[str(topic)], *row))


def _topics(node: PlacedNode) -> list[str]:
    return str(node.options["topics"]).split(",")


def _master(robot: PaperRobot, times: FailureTimes) -> None:
    robot.kill("pc")
    time.sleep(times.node)
    robot.start_again("wheels", times.away)
    robot.switch_on("pc")


def _host(robot: PaperRobot, times: FailureTimes) -> None:
    robot.kill("velocity")
    time.sleep(times.away)
    robot.switch_on("velocity")


def _cable(robot: PaperRobot, times: FailureTimes, longer: float = 0.0) -> None:
    robot.note("down")
    robot.system.cut("velocity")
    time.sleep(times.away + longer)
    robot.note("on")
    robot.system.restore("velocity")
    robot.note("on up")


_PLAYED: Final[Mapping[str, Callable[[PaperRobot, FailureTimes], None]]] = {
    "master": _master,
    "host": _host,
    "cable": _cable,
    "cable-long": functools.partial(_cable, longer=2.0),
}


_ABOUT: Final = f"""\
Four hosts: *joystick* sends CMD, *velocity* answers each with VEL, *base* takes VEL and sends STATE to the joystick,
*pc* shows CMD and VEL; {RATE:g} Hz each. Three things happen, each to a robot of its own:

* *pc*, where classic ROS has its master, is **killed** (the cable goes first, so that no connection is closed in
  order, then every process by SIGKILL). While it is away, a node of *base* crashes and its supervisor starts it
  again. Then *pc* is switched on.
* *velocity* is **killed**, and switched on again.
* The **cable** of *velocity* is pulled out, and put in again: after 3 s and, in a run of its own, after 5 s.

Nodes have fixed names; those of a host are started as soon as its agent is ready or its master answers. A message is
lost if it was due between the failure and the end of the observation and never came. RMPA runs twice: through its
agents, and *direct*, from node to node, as it is shown to be before anything fails. Where classic ROS does not
recover, it gets one more chance: in the end whatever still runs from before the failure is started again by hand.
"""


class Failure:
    """The experiment."""

    name: Final = "failure"
    title: Final = "4. What a failure takes along (claimed in section 4 of the paper)"
    about: Final = _ABOUT

    def cells(self, plan: Plan) -> list[Cell]:
        """Each scenario with each client, all in turns."""
        scenarios = ["master"] if plan.short else list(SCENARIOS)
        times = _SHORT if plan.short else _FULL
        seconds = 6.0 + times.before + times.node + times.away + times.after
        return [
            Cell(self.name, {**one.kind_settings, "client": client, "scenario": scenario, "round": 1}, seconds)
            for client in (plan.clients[-1:] if plan.short else plan.clients)
            for scenario in scenarios
            for one in COMPARED
        ]

    def measure(self, cell: Cell, stage: Stage) -> Measured:
        """Let the robot run, let it fail, and take what came."""
        client: Client = cell.settings["client"]  # type: ignore[assignment]  # cells() put it there
        times = _SHORT if stage.plan.short else _FULL
        with stage.system(system_of(cell), HOSTS, way=transport_of(cell)) as system:
            robot = PaperRobot(system, client, stage)
            robot.begin()
            time.sleep(times.before)
            down = time.monotonic()
            _PLAYED[str(cell.settings["scenario"])](robot, times)
            time.sleep(times.after)
            robot.collect()
            robot.note("end")
            direct = robot.direct()
            by_hand = 0 if robot.back() else robot.by_hand(down)
        tables = {
            "flows": frame(("flow", "sequence", "due_ns", "came_ns"), robot.rows),
            "moments": frame(("what", "at_ns"), robot.moments),
        }
        return Measured(tables, {"by_hand": by_hand, "rate": RATE, "direct": direct, "connections": len(_PAIRS)})

    def findings(self, results: Results) -> Findings:
        """Say what was lost, and what came back."""
        return findings(results)


EXPERIMENT: Final = Failure()
