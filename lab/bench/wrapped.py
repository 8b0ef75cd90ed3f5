"""What a Smart Resource costs the nodes that it wraps, and how soon it decides and changes them.

``attach``: how late messages are from one node to another, both unmodified, without and with a resource that measures
their topic, in turns: small messages, which it subscribes to, and images, which it has counted by the publisher.
``decide``: one decision among ten profiles. ``change``: a profile change of three rospy nodes with
dynamic_reconfigure, and one such call by itself, which is what a node takes.
"""

from __future__ import annotations

import asyncio
import time
from array import array
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab import samples, tables
from lab.bed.bench import TEST_NODES, Bed
from lab.findings import Claim
from lab.results import finish
from lab.tables import percentiles, table_of

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from lab.bed.processes import Process
    from lab.bed.ros import Ros

# Bytes and messages a second.
_LOADS: Final = {"small": (100, 100.0), "image": (640 * 480 * 3, 30.0)}
_LIBRARIES: Final = ("roscpp", "rospy")
_RATIO: Final = 1.02
_NODES: Final = ("one", "two", "three")
# Seconds until the resource has found the topic, and has seen how much it carries.
_SETTLE: Final = 1.5


@dataclass(frozen=True, slots=True)
class WrappedPlan:
    """How much is measured.

    Args:
        rounds: Turns without and with the resource.
        seconds: Of each round.
        changes: Of the profile.
        decisions: Likewise.
    """

    rounds: int
    seconds: float
    changes: int
    decisions: int


FULL: Final = WrappedPlan(20, 4.0, 100, 5000)
QUICK: Final = WrappedPlan(2, 2.0, 10, 500)


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure all of it, print the tables, write the file; return the result."""
    plan = QUICK if quick else FULL
    attached = {
        (library, load): asyncio.run(_attach(plan, library, load)) for library in _LIBRARIES for load in _LOADS
    }
    changes = asyncio.run(_change(plan.changes))
    decided = _decide(plan.decisions)
    table = table_of(
        "with a resource attached, µs", ("nodes", "load", "resource"), ("p50", "p95", "p99", "p99.9", "max")
    )
    result: dict[str, object] = {}
    claims = []
    for (library, load), ways in attached.items():
        found = {way: samples.summary(late) for way, late in ways.items()}
        for way, one in found.items():
            table.add_row(library, load, way, *percentiles(one))
            result[f"{library} {load} {way}"] = asdict(one)
        value = tables.ratio(found["attached"].p50, found["alone"].p50)
        claims.append(Claim(f"{load}, {library}: latency with the resource / without, p50", value, _RATIO))
    console.print(table)
    for name, took in (*changes.items(), ("decision", decided)):
        result[f"{name} ms"] = asdict(samples.summary(took))
    change, call = (samples.summary(changes[name]).p50 for name in ("change", "call"))
    claims.append(Claim("a profile change of three nodes, less one call, ms, p50", (change or 0) - (call or 0), 500))
    claims.append(Claim("a decision, ms, p50", samples.summary(decided).p50, 1.0))
    return finish(console, "wrapped", asdict(plan), result, json, claims=claims)


async def _attach(plan: WrappedPlan, library: str, load: str) -> dict[str, list[float]]:
    """Microseconds from due to arrival, by way."""
    from rmpa.resource.description import read_description
    from rmpa.resource.node import ResourceNode

    size, rate = _LOADS[load]
    took: dict[str, list[float]] = {"alone": [], "attached": []}
    text = (
        b'role = "sensing"\n[output.data]\ntopic = "/cam/data"\ntype = "std_msgs/UInt8MultiArray"\n'
        b'[profile.only]\noffers = { rate = "30 Hz" }\n'
    )
    with Bed() as bed:
        shell = bed.shell()
        source, sink = await asyncio.to_thread(_ends, shell, library)
        for turn in range(2 * plan.rounds):
            way = ("alone", "attached")[(turn + turn // 2) % 2]
            one = ResourceNode(await asyncio.to_thread(read_description, text, bed.home / "cam.toml"), shell.uri)
            if way == "attached":
                await one.start()
            await asyncio.to_thread(_round, bed, source, sink, size, rate, _SETTLE)
            took[way] += await asyncio.to_thread(_round, bed, source, sink, size, rate, plan.seconds)
            if way == "attached":
                await one.close()
    return took


def _ends(shell: Ros, library: str) -> tuple[Process, Process]:
    """The publisher and the subscriber."""
    shell.master()
    sink = shell.node(library, "sink", topics="/cam/data", commands=True)
    source = shell.node(library, "source", topic="/cam/data", commands=True)
    sink.wait_event("up")
    source.wait_event("connected")
    return source, sink


def _round(bed: Bed, source: Process, sink: Process, size: int, rate: float, seconds: float) -> list[float]:
    """Microseconds of one round."""
    since, count, path = source.mark_events(), max(1, round(rate * seconds)), bed.home / "arrivals"
    number = int(time.monotonic() * 1000) % 2**31
    source.tell(f"{number} {size} {rate} {count} {bed.home / 'sent'}")
    source.wait_event("sent", seconds + 30.0, since=since)
    since = sink.mark_events()
    sink.tell(f"{number} {path} 0.2")
    sink.wait_event("noted", 30.0, since=since)
    rows = array("Q", path.read_bytes())
    return [(rows[at + 3] - rows[at + 2]) / 1e3 for at in range(0, len(rows), 4)]


async def _change(count: int) -> dict[str, list[float]]:
    """Milliseconds of a change of all nodes, and of one call."""
    from rmpa.resource.description import read_description
    from rmpa.resource.node import ResourceNode

    parameters = "".join(f'[parameter.{key}]\nnode = "{key}"\ndynamic = "int_"\ndefault = 1\n' for key in _NODES)
    profiles = "".join(
        f"[profile.{name}]\noffers = {{}}\nset = {{ {', '.join(f'{key} = {value}' for key in _NODES)} }}\n"
        for name, value in (("low", 2), ("high", 9))
    )
    nodes = "".join(f"[node.{key}]\n" for key in _NODES)
    took: dict[str, list[float]] = {"change": [], "call": []}
    with Bed() as bed:
        shell = bed.shell()
        await asyncio.to_thread(_start, shell)
        text = f'role = "sensing"\n{nodes}{parameters}{profiles}'.encode()
        resource = await asyncio.to_thread(read_description, text, bed.home / "trio.resource.toml")
        one = ResourceNode(resource, shell.uri)
        await one.start()
        node = one.runtime.node
        for number in range(count):
            began = time.perf_counter()
            await one.configuration.set({"profile": ("high", "low")[number % 2]})
            took["change"].append((time.perf_counter() - began) * 1e3)
            began = time.perf_counter()
            config = {"ints": [{"name": "int_", "value": (9, 2)[number % 2]}]}
            await node.call_service("/one/set_parameters", "dynamic_reconfigure/Reconfigure", {"config": config})
            took["call"].append((time.perf_counter() - began) * 1e3)
        await one.close()
    return took


def _start(shell: Ros) -> None:
    shell.master()
    for key in _NODES:
        shell.rospy("tunable", nodes=TEST_NODES, name=key).wait_event("up")


def _decide(count: int) -> list[float]:
    """Milliseconds of a decision among ten profiles by five requirements."""
    from rmpa.resource.decision import Decider, Profile
    from rmpa.resource.quality import MEASURED, QoSRequest

    names = ("rate", "latency", "period_sd", "bandwidth", "loss")
    profiles = [Profile(f"p{n}", dict.fromkeys(names, (n + 1) / 10), cost=n) for n in range(10)]
    decider = Decider("bench", MEASURED, profiles)
    bounds = {
        name: (QoSRequest(at_least=0.5) if name == "rate" else QoSRequest(at_most=0.5)).bound(MEASURED[name])
        for name in names
    }
    took = []
    for _ in range(count):
        began = time.perf_counter()
        decider.decide(bounds)
        took.append((time.perf_counter() - began) * 1e3)
    return took
