"""``python -m lab bench [NAME]... [--quick] [--json FILE]``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click
from rich.console import Console

from lab.bed import namespaces
from lab.bed.bench import why_no_hosts, why_no_ros
from lab.bench import (
    crosstraffic,
    fleet,
    gateway,
    idle,
    load,
    period,
    radio,
    roundtrips,
    services,
    startup,
    throughput,
    web,
)
from lab.bench.contenders import ENTRIES
from lab.web.servers import why_no_web

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    Measure = Callable[[bool, Console, Path | None], object]
    MeasureParts = Callable[[bool, Console, Path | None, tuple[str, ...]], object]


@dataclass(frozen=True, slots=True)
class Measurement:
    """One name of the command line.

    Args:
        about: What it finds out, in a few words.
        measure: Takes whether few samples will do, where to print, and a file for the result.
        needs: Each says why it cannot run here, or an empty string.
        realtime: Takes the same, and measures with nodes and agents under SCHED_FIFO.
        parts: What ``--only`` can choose of it.
        only: Takes the same and the parts that were chosen.
    """

    about: str
    measure: Measure
    needs: tuple[Callable[[], str], ...] = (why_no_ros, why_no_hosts)
    realtime: Measure | None = None
    parts: Collection[str] = ()
    only: MeasureParts | None = None


MEASUREMENTS: Final[dict[str, Measurement]] = {
    "path": Measurement(
        "how late a message is, on every path", roundtrips.path, needs=(), parts=ENTRIES, only=roundtrips.path
    ),  # leaves out what cannot start
    "period": Measurement(
        "how evenly messages arrive", period.measure, realtime=partial(period.measure, realtime=True)
    ),
    "crosstraffic": Measurement(
        "a command beside images on 100 Mbit/s",
        crosstraffic.measure,
        realtime=partial(crosstraffic.measure, realtime=True),
    ),
    "radio": Measurement(
        "a command over a radio that loses packets, has a long queue, or is cut",
        radio.measure,
        (why_no_ros, why_no_hosts),
        parts=radio.PARTS,
        only=radio.measure,
    ),
    "load": Measurement("a command while every core is busy", load.measure),
    "throughput": Measurement("how much goes through", throughput.measure),
    "startup": Measurement("how soon the first message arrives", startup.measure),
    "services": Measurement("a service call through two agents, and a direct one", services.measure),
    "fleet": Measurement("2 to 64 modules: start, rest, a stream beside classic ROS, losses", fleet.measure),
    "idle": Measurement("what an agent costs while nothing happens", idle.measure),
    "gateway": Measurement(
        "sites joined by gateways, beside a bare pair of Zenoh programs",
        gateway.measure,
        (why_no_ros, gateway.why_no_sites),
        parts=gateway.PARTS,
        only=gateway.measure,
    ),
    "web": Measurement(
        "rmpa web beside rosbridge_suite's server and foxglove-sdk's",
        web.measure,
        (why_no_ros, why_no_web),
        parts=web.PARTS,
        only=web.measure,
    ),
}


@click.command(epilog="\b\n" + "\n".join(f"{name:12} {row.about}" for name, row in MEASUREMENTS.items()))
@click.argument("names", nargs=-1, metavar="[NAME]...", type=click.Choice(list(MEASUREMENTS)))
@click.option("--quick", is_flag=True, help="Few samples: to see whether it works, not to quote.")
@click.option("--json", "file", type=click.Path(path_type=Path), help="Write the result there too (one measurement).")
@click.option(
    "--only",
    default="",
    metavar="KEYS",
    help="path: these contenders, comma-separated (lab/bench/contenders.py has them); "
    f"web: of {', '.join(web.PARTS)}; gateway: of {', '.join(gateway.PARTS)}; "
    f"radio: of {', '.join(radio.PARTS)}.",
)
@click.option(
    "--realtime",
    is_flag=True,
    help=f"{', '.join(name for name, row in MEASUREMENTS.items() if row.realtime)}: "
    "nodes and agents under SCHED_FIFO, so that other processes of this machine are out of the figures.",
)
def bench(names: tuple[str, ...], quick: bool, file: Path | None, only: str, realtime: bool) -> None:
    """Measure what is named below (default: all of it, in this order); results are written to lab/results."""
    console = Console(width=130 if not sys.stdout.isatty() else None)
    if not why_no_hosts():
        namespaces.remove_stale()
    for name in names or MEASUREMENTS:
        row = MEASUREMENTS[name]
        if reason := next(filter(None, (why() for why in row.needs)), ""):
            console.print(f"{name} is left out: {reason}", style="yellow")
        elif only and row.only:
            if unknown := sorted({*only.split(",")} - {*row.parts}):
                raise click.BadParameter(f"no {unknown[0]}; there are {', '.join(row.parts)}", param_hint="--only")
            row.only(quick, console, file, tuple(only.split(",")))
        else:
            measure = (realtime and row.realtime) or row.measure
            measure(quick, console, file)
