"""``python -m lab bench [NAME]... [--quick] [--json FILE]``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click
from rich.console import Console

from lab.bed import namespaces
from lab.bed.bench import why_no_hosts, why_no_ros
from lab.bench import (
    gateway,
    idle,
    load,
    radio,
    record,
    ros2,
    roundtrips,
    services,
    startup,
    throughput,
    web,
    wrapped,
)
from lab.bench.contenders import ENTRIES
from lab.web.servers import why_no_web

if TYPE_CHECKING:
    from collections.abc import Callable, Collection


@dataclass(frozen=True, slots=True)
class Measurement:
    """One name of the command line.

    Args:
        about: What it finds out, in a few words.
        measure: Takes whether few samples will do, where to print, a file for the result; and the parts, if any.
        needs: Each says why it cannot run here, or an empty string.
        parts: What ``--only`` can choose of it.
    """

    about: str
    measure: Callable[..., object]
    needs: tuple[Callable[[], str], ...] = (why_no_ros, why_no_hosts)
    parts: Collection[str] = ()


_WEB: Final = "rmpa web beside foxglove-sdk's server"
_GATEWAY: Final = "sites joined by gateways, beside a bare pair of Zenoh programs"
_ROS2: Final = "the gateway to ROS 2 by rclpy, beside a relay of rclpy"
MEASUREMENTS: Final[dict[str, Measurement]] = {
    # What of path cannot start here is left out.
    "path": Measurement("how late a message is, on every path", roundtrips.path, (), ENTRIES),
    "radio": Measurement(
        "a command over a radio that loses packets, has a long queue, or is cut", radio.measure, parts=radio.PARTS
    ),
    "load": Measurement("a command while every core is busy", load.measure),
    "throughput": Measurement("how much goes through", throughput.measure),
    "startup": Measurement("how soon the first message arrives", startup.measure),
    "services": Measurement("a service call through two agents, and a direct one", services.measure),
    "record": Measurement("what recording costs, beside rosbag record", record.measure),
    "idle": Measurement("what an agent costs while nothing happens", idle.measure),
    "wrapped": Measurement("what a Smart Resource costs the nodes that it wraps", wrapped.measure, (why_no_ros,)),
    "gateway": Measurement(_GATEWAY, gateway.measure, (why_no_ros, gateway.why_no_sites), gateway.PARTS),
    "ros2": Measurement(_ROS2, ros2.measure, (why_no_ros, why_no_hosts, ros2.why_no_ros2), ros2.PARTS),
    "web": Measurement(_WEB, web.measure, (why_no_ros, why_no_web), web.PARTS),
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
    f"radio: of {', '.join(radio.PARTS)}; ros2: of {', '.join(ros2.PARTS)}.",
)
def bench(names: tuple[str, ...], quick: bool, file: Path | None, only: str) -> None:
    """Measure what is named below (default: all of it, in this order); results are written to lab/results."""
    console = Console(width=130 if not sys.stdout.isatty() else None)
    if not why_no_hosts():
        namespaces.remove_stale()
    for name in names or MEASUREMENTS:
        row = MEASUREMENTS[name]
        if reason := next(filter(None, (why() for why in row.needs)), ""):
            console.print(f"{name} is left out: {reason}", style="yellow")
        elif only and row.parts:
            if unknown := sorted({*only.split(",")} - {*row.parts}):
                raise click.BadParameter(f"no {unknown[0]}; there are {', '.join(row.parts)}", param_hint="--only")
            row.measure(quick, console, file, tuple(only.split(",")))
        else:
            row.measure(quick, console, file)
