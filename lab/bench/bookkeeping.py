"""What being smart costs a resource, and how soon it adapts.

Bookkeeping: processor time of measuring the quality of one message, stamped, as its output's and its input's, beside
what an agent needs to relay a message of 64 B. Reaction: a quality falls at a random moment; how long until another
profile runs, in quality windows: by the stop watch, which begins at that moment, and as the resource says it, which
counts from the beginning of the first window that showed it. A window that was good for the most part may not. A
resource on a core, in this process, with a client on a node of its own.
"""

from __future__ import annotations

import asyncio
import random
import statistics
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab import samples
from lab.bed.bench import Bed
from lab.bench import profile, schedule
from lab.figures import shapes
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, table_of, us
from rmpa.resource.decide.actions import Apply, Reacted
from rmpa.resource.declare.adaptation_settings import AdaptationSettings
from rmpa.resource.declare.qos_request import at_most
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.client import ResourceClient
from rmpa.resource.run.resource_node import ResourceNode
from rmpa.resource.run.runtime import RuntimePart
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.node.topics import Received

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from rmpa.resource.decide.actions import Action

_BATCH: Final = 1000
"""Messages between two looks at the clock of the processor."""
_SHARE: Final = 0.05
_WINDOWS: Final = 2.0
_SEED: Final = 11
_DEADLINE: Final = 30.0
_QUIET: Final = 3
"""Windows without a disturbance between two."""
_USUAL: Final = 1000.0
"""Hz at which the relay's cost is taken."""


@dataclass(frozen=True, slots=True)
class BookkeepingPlan:
    """How much is measured.

    Args:
        batches: Of messages whose quality is measured.
        window: Seconds of a quality window.
        disturbances: How many.
        relayed: Seconds of each relayed stream.
    """

    batches: int
    window: float
    disturbances: int
    relayed: float


FULL: Final = BookkeepingPlan(400, 1.0, 40, 10.0)
QUICK: Final = BookkeepingPlan(50, 0.2, 6, 2.0)


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the tables, write the files; return the result."""
    plan = QUICK if quick else FULL
    costs = asyncio.run(_bookkeeping(plan.batches))
    with Bed() as bed:
        way = schedule.agents(bed)
        stream = way.stream(bed, "/relayed")
        pids = {f"agent {number}": agent.pid for number, agent in enumerate(way.agents, 1)}
        rates = profile.ProfilePlan((_USUAL, 4 * _USUAL), plan.relayed, plan.relayed, 0.0)
        relay = list(profile.relay_costs(stream, pids, rates))
    waits, reported = asyncio.run(_reactions(plan))
    least = min(cost.total for cost in relay if cost.rate == _USUAL)
    console.print(_cost_table(costs, relay))
    console.print(_reaction_table(waits, reported, plan.window))
    targets = [
        Claim(f"measuring an {kind}, share of relaying a message", round(cost / least, 4), _SHARE)
        for kind, cost in costs.items()
    ]
    targets.append(
        Claim(
            "disturbance to reconfiguration, windows, worst (as the resource says it, without applying the profile)",
            round(max(reported) / plan.window, 2),
            _WINDOWS,
        )
    )
    result: dict[str, object] = {
        "bookkeeping_us": costs,
        "relay": [asdict(cost) for cost in relay],
        "reaction_windows": [round(wait / plan.window, 4) for wait in waits],
        "reported_windows": [round(wait / plan.window, 4) for wait in reported],
    }
    return finish(
        console,
        "bookkeeping",
        {**asdict(plan), "seed": _SEED},
        result,
        json,
        claims=targets,
        panels=shapes.bars(
            {"CPU a message": {**costs, **{f"{c.agent}, {c.rate:g} Hz": c.total for c in relay}}}, "µs"
        ),
    )


# --- bookkeeping ----------------------------------------------------------------------------------------------------


async def _bookkeeping(batches: int) -> dict[str, float]:
    """µs of processor time a message."""
    resource = Resource("measured", role="sensing", physical=False)
    output = resource.output("ranges", "sensor_msgs/Range", deadline="100 ms")
    item = resource.input("/orders", "sensor_msgs/Range", required=False, deadline="100 ms")
    resource.profile(offers={"rate": "10 Hz"}, name="only")(lambda: None)
    core = RosCore(port=0)
    await core.start()
    member = ResourceNode(resource, core.uri)
    await member.start()
    raw = output.type.serialize(output.type.make({"header": {"stamp": time.time()}, "range": 1.0}))
    received = Received(raw, {"callerid": "/somebody"}, time.time_ns(), item.type)
    parts = member.runtime.parts

    def publish() -> None:
        now_ns = time.time_ns()
        for part in parts:
            part.published(output, raw, now_ns)

    def receive() -> None:
        for part in parts:
            part.received(item, received)

    costs = {"output": _cost(publish, batches), "input": _cost(receive, batches)}
    await member.close()
    await core.close()
    return costs


def _cost(function: Callable[[], None], batches: int) -> float:
    """The median over batches; the empty loop is taken off."""

    def nothing() -> None:
        pass

    taken = [_batch(function) - _batch(nothing) for _ in range(batches)]
    return round(statistics.median(taken), 3)


def _batch(function: Callable[[], None]) -> float:
    begin = time.thread_time_ns()
    for _ in range(_BATCH):
        function()
    return (time.thread_time_ns() - begin) / _BATCH / 1e3


# --- reaction -------------------------------------------------------------------------------------------------------


async def _reactions(plan: BookkeepingPlan) -> tuple[list[float], list[float]]:
    """Seconds from each disturbance until another profile ran; and what the resource says, less the applying."""
    chance = random.Random(_SEED)
    running = disturbed = ""
    resource = Resource("disturbed", role="sensing", physical=False)
    accuracy = resource.attribute("accuracy", better="min", unit="m")

    def apply(name: str) -> Callable[[], None]:
        def applied() -> None:
            nonlocal running
            running = name

        return applied

    for name in ("one", "other"):
        resource.profile(offers={"accuracy": "1 cm"}, name=name)(apply(name))

    @resource.task(rate="50 Hz")
    def look() -> None:
        accuracy.observe(0.2 if running == disturbed else 0.01)

    core = RosCore(port=0)
    await core.start()
    # The profile that was left may be taken again at the next disturbance.
    settings = AdaptationSettings(cool_down=plan.window / 2, cool_down_max=plan.window / 2)
    member = ResourceNode(resource, core.uri, window=plan.window, settings=settings)
    await member.start()
    reacted: asyncio.Queue[float] = asyncio.Queue()
    applying = 0.0

    class Listener(RuntimePart):
        def acted(self, action: Action) -> None:
            nonlocal applying
            if isinstance(action, Apply):
                applying = time.perf_counter()
            if isinstance(action, Reacted):
                reacted.put_nowait(action.reaction - (time.perf_counter() - applying))

    member.runtime.parts.append(Listener())
    waits, reported = [], []
    async with Node("client", master_uri=core.uri) as node, ResourceClient(node, "disturbed") as client:
        await client.require(accuracy=at_most("5 cm", hard=True), timeout=_DEADLINE)
        for _ in range(plan.disturbances):
            await asyncio.sleep(plan.window * (_QUIET + chance.random()))
            while not reacted.empty():
                reacted.get_nowait()
            begin, disturbed = time.perf_counter(), running
            async with asyncio.timeout(_DEADLINE):
                reported.append(await reacted.get())
            waits.append(time.perf_counter() - begin)
            disturbed = ""
    await member.close()
    await core.close()
    return waits, reported


# --- what came out --------------------------------------------------------------------------------------------------


def _cost_table(costs: dict[str, float], relay: list[profile.Cost]) -> Table:
    table = table_of("processor time a message, µs", (), ())
    for head in ("what", "µs", f"share of the cheaper agent's at {_USUAL:g} Hz"):
        table.add_column(head, justify="left" if head == "what" else "right")
    least = min(cost.total for cost in relay if cost.rate == _USUAL)
    for kind, cost in costs.items():
        table.add_row(f"measuring the quality of an {kind}", f"{cost:.2f}", f"{100 * cost / least:.1f} %")
    for one in relay:
        table.add_row(f"relaying, {one.agent}, {one.rate:g} Hz", us(one.total), "")
    return table


def _reaction_table(waits: list[float], reported: list[float], window: float) -> Table:
    table = table_of(f"disturbance to reconfiguration, in windows of {window:g} s", (), ())
    for head in ("by", "p50", "largest", "least", "disturbances"):
        table.add_column(head, justify="left" if head == "by" else "right")
    for who, times in (("the stop watch", waits), ("the resource, without the applying", reported)):
        ordered = sorted(one / window for one in times)
        median = samples.percentile(ordered, 50)
        table.add_row(who, *map(dash, (median, ordered[-1], ordered[0])), str(len(times)))
    return table
